import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import SIZE, chain, random_functions, reference, samples

from jaxid.program import FREE, evaluate, trace


@given(random_functions())
@settings(max_examples=15, deadline=None, derandomize=True)
def test_a_program_equals_its_function(function):
    x = samples(0, (5,))
    program = trace(function, (SIZE,), (SIZE,))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        evaluate(program, *x),
        reference(function, *x),
    )


@pytest.mark.parametrize(
    "function",
    [
        jax.jacfwd(chain),
        jax.jacrev(chain),
        lambda a, b: jax.jvp(chain, (a, b), (b, a)),
        lambda a, b: jax.vjp(chain, a, b)[1](jnp.outer(b, a)),
        lambda a, b: jax.linear_transpose(lambda r: chain(a, r), b)(jnp.outer(a, b)),
        lambda a, b: jax.hessian(lambda x: jnp.sum(chain(x, b)[1]))(a),
        lambda a, b: jax.jit(chain)(a, b),
        lambda a, b: jax.checkpoint(chain)(a, b),
        lambda a, b: jax.nn.relu(a) + jax.nn.sigmoid(b) + jax.nn.softplus(a),
        lambda a, b: jnp.where(jnp.abs(a) < 0.5, 0.0, jnp.sign(a) * (jnp.abs(a) - 0.5)),
        lambda a, b: jax.jacfwd(lambda x: jnp.maximum(x, b) * jnp.clip(x, -0.2, 0.4))(
            a
        ),
        lambda a, b: (
            jnp.where((a > 0) & ~(b > 0) | (a <= b), a, b) + (a >= b).astype(a.dtype)
        ),
        lambda a, b: jax.grad(lambda x: jnp.sum(x[np.array([2, 0, 2])] * b))(a),
        lambda a, b: a.at[1].set(b[2]).at[np.array([0, 0])].add(b[:2]),
        lambda a, b: jax.lax.dynamic_update_slice(a, b[:2], (1,)),
        lambda a, b: jnp.pad(a, (1, 2)) + jnp.tile(b, 2) + jnp.repeat(a, 2)[::-1],
        lambda a, b: tuple(a) + tuple(jnp.split(b, 3)),
        lambda a, b: jnp.einsum("ij,j,k->ik", jnp.outer(a, b), b, a),
        lambda a, b: (
            jnp.abs(a) ** 2.5 + a**-2 + jnp.arctan2(a, b) + jax.lax.rsqrt(b * b + 1.0)
        ),
        lambda a, b: (
            jnp.sqrt(a * a)
            + jnp.log1p(b * b)
            + jnp.prod(a)
            + jnp.trace(jnp.outer(a, b))
        ),
        lambda a, b: jax.grad(lambda x: jnp.sum(jnp.arcsin(0.5 * x) + jnp.tanh(b * x)))(
            a
        ),
        lambda a, b: [np.arange(3.0), jnp.zeros((2, 0)), 2.0 * a],
    ],
)
def test_a_program_equals_what_jax_makes_of_functions(function):
    x = samples(1, (4,))
    program = trace(function, (3,), (3,))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        evaluate(program, *x),
        reference(function, *x),
    )


def test_shared_work_is_done_once_and_dead_work_never():
    program = trace(lambda x: jnp.stack([x[0] * x[1] + 1.0, x[1] * x[0], x[2]]), (3,))
    counts = program.counts
    assert (counts.multiplications, counts.additions, counts.total) == (1, 1, 2)
    program = trace(lambda x: (x * jnp.exp(x))[:1] * 0.0 + x[1], (2,))
    assert program.counts.total == 0


def test_nonzeros_tell_which_outputs_can_differ_from_zero():
    program = trace(lambda x: {"a": jnp.diag(x), "b": 3.0}, (2,))
    np.testing.assert_array_equal(program.nonzeros["a"], np.eye(2, dtype=bool))
    assert program.nonzeros["b"]


def test_constants_of_an_input_are_folded():
    offset = np.array([0.0, 0.2, 0.5])
    known = np.where(offset == 0.2, FREE, offset)
    program = trace(lambda r, q: r * q, known, (3,))
    assert program.counts.multiplications == 2
    q = np.array([2.0, 3.0, 4.0])
    np.testing.assert_array_equal(
        evaluate(program, np.full(3, 7.0), q), [0.0, 21.0, 2.0]
    )


@pytest.mark.parametrize(
    ("function", "word"),
    [
        (
            lambda x: jax.lax.while_loop(lambda c: c < 3, lambda c: c + x[0], 0.0),
            "while",
        ),
        (lambda x: jax.lax.cond(x[0] > 0, lambda: x, lambda: -x), "cond"),
        (jnp.sort, "sort"),
        (jnp.max, "reduce_max"),
        (jnp.cumsum, "cumsum"),
        (lambda x: x[jnp.argmax(x)], "argmax"),
        (lambda x: jnp.ones(3)[x.astype(int)[0]], "int64"),
        (jnp.floor, "floor"),
    ],
)
def test_what_a_program_cannot_do_is_refused_by_name(function, word):
    with pytest.raises(ValueError, match=rf"`trace` cannot translate .*{word}"):
        trace(function, (3,))


def test_loops_of_known_length_are_unrolled():
    def sums(x):
        return jax.lax.scan(lambda c, y: (c * x[0] + y, c), 1.0, x, reverse=True)

    x = np.array([0.5, 2.0, 3.0])
    for ours, expected in zip(evaluate(trace(sums, (3,)), x), sums(x), strict=True):
        np.testing.assert_allclose(ours, expected, rtol=1e-15)


def test_a_traced_value_in_the_closure_is_refused():
    with pytest.raises(ValueError, match="closes over a value that JAX is tracing"):
        jax.jit(lambda c: trace(lambda x: x * c, (2,)).counts.total)(jnp.float64(2.0))


def test_tracing_works_inside_of_another_trace():
    @jax.jit
    def outer(x):
        program = trace(lambda y: y[np.array([1, 0])] * jnp.eye(2)[0], (2,))
        assert program.counts.total == 0
        return x + sum(jax.tree.leaves(program.nonzeros)[0].astype(float))

    assert outer(jnp.float64(1.0)) == 2.0


def test_constants_stay_in_float64_where_jax_runs_in_float32():
    third, m, x = 1 / 3, np.array([[0.1, 0.2], [0.3, 1e-9]]), np.array([1.0, 3.0])
    with jax.enable_x64(False):
        program = trace(lambda x: (m @ x)[np.array([1, 0])] + third, (2,))
        found = evaluate(program, x)
        slope = trace(
            lambda x: 0.1 * jax.grad(lambda y: jnp.sum(y[np.array([0, 0])]))(x), (2,)
        )
        assert evaluate(slope, np.ones(2))[0] == 0.2
    np.testing.assert_allclose(found, (m @ x)[::-1] + third, rtol=1e-15)
