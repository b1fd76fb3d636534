import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from sample_functions import (
    SIZE,
    chain,
    every_operation,
    random_functions,
    reference,
    samples,
)

from jaxid.errors import InputError
from jaxid.program import evaluate, lower, trace
from jaxid.program.xla import fenced_nodes, hidden_one


def close(a, b, rtol=1e-12, atol=1e-12):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol), a, b
    )


@given(random_functions())
@settings(max_examples=5, deadline=None, derandomize=True)
def test_a_lowered_program_equals_its_function(function):
    x = samples(0, (5,))
    lowered = lower(trace(function, (SIZE,), (SIZE,)))
    close(jax.jit(lowered.dense)(*x), reference(function, *x))


@given(random_functions(smooth=True))
@settings(max_examples=4, deadline=None, derandomize=True)
def test_the_derivative_of_a_lowered_program_is_its_functions(function):
    x, y = samples(1, ())
    lowered = lower(trace(function, (SIZE,), (SIZE,)))
    close(
        jax.jit(jax.jacfwd(lowered.dense))(x, y),
        jax.jit(jax.jacfwd(function))(x, y),
        rtol=1e-10,
        atol=1e-10,
    )


def test_values_derivatives_and_batches():
    lowered = lower(trace(chain, (3,), (3,)))
    x = samples(2, (6,))

    def loss(f, a, b):
        return jnp.sum(jnp.sin(f(a, b)))

    @jax.jit
    def original(a, b):
        return jnp.moveaxis(jax.vmap(chain, in_axes=-1)(a, b), 0, -1)

    a, b = jnp.asarray(x[0]), jnp.asarray(x[1])
    close(jax.jit(lowered.dense)(a, b), original(a, b))
    gradient = jax.jit(jax.grad(lambda *x: loss(lowered.dense, *x), (0, 1)))
    close(
        gradient(a, b), jax.jit(jax.grad(lambda *x: loss(original, *x), (0, 1)))(a, b)
    )
    one, other = (
        jax.jit(lambda *x, f=f: jax.jvp(f, x, x)) for f in (lowered.dense, original)
    )
    close(one(a, b), other(a, b))
    hessian = jax.jit(jax.hessian(lambda a: loss(lowered.dense, a, b[:, :1])))(a[:, :1])
    close(
        hessian, jax.jit(jax.hessian(lambda a: loss(original, a, b[:, :1])))(a[:, :1])
    )
    mapped = jax.jit(jax.vmap(lowered.dense, in_axes=-1, out_axes=-1))(a, b)
    close(mapped, original(a, b))


def test_nan_in_one_sample_stays_there():
    lowered = lower(trace(chain, (3,), (3,)))
    x = samples(3, (4,))
    clean = np.asarray(jax.jit(lowered.dense)(*x))
    x[0, 0, 0] = np.nan
    dirty = np.asarray(jax.jit(lowered.dense)(*x))
    assert np.isnan(dirty[..., 0]).any()
    np.testing.assert_array_equal(dirty[..., 1:], clean[..., 1:])


@pytest.mark.parametrize("first", [0.0, -0.0, -3.0, np.inf, -np.inf, np.nan, -np.nan])
def test_no_first_entry_changes_what_a_fence_returns(first):
    for dtype in (np.float64, np.float32):
        x = np.array([1.1, np.nan, np.inf, -0.0, 1e-30], dtype)
        got = np.asarray(jax.jit(lambda a, b: a / hidden_one(b))(x, dtype(first)))
        np.testing.assert_array_equal(got, x)
        np.testing.assert_array_equal(np.signbit(got), np.signbit(x))
        assert got.dtype == dtype


def test_xla_does_not_fold_the_division_away():
    program = trace(chain, (3,), (3,))
    x = samples(0, (64,))
    text = jax.jit(lower(program, True).dense).lower(*x).compile().as_text()
    circular = [
        k for k in fenced_nodes(program) if program.nodes[k].operation in ("sin", "cos")
    ]
    # Sines are stacked behind one fence, cosines behind another.
    assert text.count(" divide(") == len(fenced_nodes(program)) - len(circular) + 2


@pytest.mark.parametrize("fence", [False, True])
def test_single_precision_stays_single(fence):
    lowered = lower(
        trace(
            lambda a, b: chain(a, b) + jnp.where(a > 0, 1.0, 0.0)[:, None], (3,), (3,)
        ),
        fence,
    )
    x = samples(4, (5,)).astype(np.float32)
    packed = jax.jit(lowered)(*x)
    assert {p.dtype for p in packed} == {np.dtype(np.float32)}
    close(
        jax.jit(lowered.dense)(*x), evaluate(lowered.program, *x), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("batch", [(), (0,), (2, 3)])
def test_batches_and_packed_constants(batch):
    def function(a, b):
        return {"a": a * b[0], "b": np.array(2.0)}

    lowered, (x, y) = lower(trace(function, (3,), (1,))), samples(5, batch, count=2)
    close(jax.jit(lowered.dense)(x, y[:1]), evaluate(lowered.program, x, y[:1]))
    assert lowered(x, y[:1])[3] == 2.0
    close(lowered.dense(x, np.ones(1)), evaluate(lowered.program, x, np.ones(1)))
    with pytest.raises(InputError, match="put the batch last"):
        lowered(np.ones((4, 3)), np.ones((4, 1)))


def test_all_operations_agree_with_numpy():
    program = trace(every_operation, (), ())
    x = np.linspace(-2.1, 2.0, 50)
    close(jax.jit(lower(program).dense)(x, 1.0 - x), evaluate(program, x, 1.0 - x))
    close(evaluate(program, x, 1.0 - x), jax.jit(every_operation)(x, 1.0 - x))


def test_sines_of_computed_angles():
    program = trace(lambda x: jnp.sin(x[0] + x[1]) * jnp.cos(jnp.cos(x[0])), (2,))
    x = samples(6, (9,), (2,), 1)[0]
    close(lower(program).dense(x), evaluate(program, x), 1e-14, 1e-15)


def test_fences_stand_where_much_would_be_computed_again():
    def dear_and_shared(x):
        y = jnp.exp(x)
        return jnp.stack([y + 1.0, y + 2.0]), x + x

    program = trace(dear_and_shared, ())
    (fenced,) = fenced_nodes(program)
    assert program.nodes[fenced].operation == "exp"
    assert fenced_nodes(trace(lambda x: (x * x) * (x * x + 1.0), ())) == frozenset()
