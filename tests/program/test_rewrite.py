import importlib.util
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxid.program import evaluate, trace

FENCES = Path(__file__).resolve().parents[2] / "benchmarks" / "fences.py"


def counts(function, *shapes):
    c = trace(function, *shapes).counts
    return c.multiplications, c.additions, c.negations


def test_a_common_factor_is_drawn_out_of_a_sum():
    assert counts(lambda x: 0.3 * x[0] - 0.3 * x[1] + x[2], (3,)) == (1, 2, 0)
    assert counts(lambda x: x[0] * x[1] + x[2] + x[1] * x[3], (4,)) == (1, 2, 0)
    assert counts(lambda x: sum(0.5 * x[k] for k in range(4)), (4,)) == (1, 3, 0)


def test_products_that_are_needed_elsewhere_stay():
    def function(x):
        a, b = 0.3 * x[0], 0.3 * x[1]
        return jnp.stack([a + b, a, b])

    assert counts(function, (2,)) == (2, 1, 0)


def test_a_negated_difference_is_turned_around():
    assert counts(lambda x: -(x[0] - x[1]), (2,)) == (0, 1, 0)
    assert counts(lambda x: jnp.stack([x[0] - x[1], x[1] - x[0]]), (2,)) == (0, 1, 1)


@given(st.lists(st.tuples(*[st.integers(0, 4)] * 3), min_size=2, max_size=9), st.integers(0, 9))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_sums_of_products_keep_their_value(terms, split):
    c = np.array([0.5, -0.3, 2.0, 1.7, 0.0])

    def function(x):
        def total(some):
            return sum((-1) ** i * c[k] * x[i] * x[j] * (1.0 + x[i]) for i, j, k in some)

        first = total(terms[:split]) + jnp.zeros(())
        return jnp.stack([first, first - total(terms[split:]), jnp.sin(total(terms))])

    x = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    got = evaluate(trace(function, (5,)), x)
    want = [function(column) for column in x.T]
    np.testing.assert_allclose(got.T, want, rtol=1e-13, atol=1e-14)


def test_operations_of_a_seven_joint_regressor(monkeypatch):
    """Exact numbers: a careless change of the compiler, or of JAX, shows here at once."""
    monkeypatch.syspath_prepend(FENCES.parent)
    specification = importlib.util.spec_from_file_location("fences", FENCES)
    benchmark = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(benchmark)
    n = (benchmark.JOINTS,)
    program = trace(benchmark.regressor, n, n, n)
    assert (program.counts.multiplications, program.counts.additions) == (842, 640)
    assert (program.counts.functions, program.counts.divisions) == (12, 0)
    assert int(program.nonzeros.sum()) == 255

    p = np.random.default_rng(0).uniform(0.5, 1.5, (7, 10))
    program = trace(lambda *x: jnp.einsum("jbk,bk->j", benchmark.regressor(*x), p), n, n, n)
    assert program.counts.multiplications < 842 + 255
