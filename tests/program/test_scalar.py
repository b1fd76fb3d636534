"""Simplification of expressions: while they are built, and with all uses known."""

import importlib
import math
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxid.program import evaluate, trace
from jaxid.program.scalar import (
    Graph,
    Operation,
    add,
    apply,
    divide,
    integer_power,
    logic,
    multiply,
    negate,
    power,
    select,
)

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def graph():
    return Graph()


@pytest.fixture
def x(graph):
    return graph.node(Operation.INPUT, 0, 0)


@pytest.fixture
def y(graph):
    return graph.node(Operation.INPUT, 0, 1)


def minus(x, y):
    return add(x, negate(y))


def test_equal_expressions_are_one_object(x, y):
    assert multiply(x, y) is multiply(y, x)
    assert add(x, y) is add(y, x)
    assert multiply(negate(x), y) is negate(multiply(x, y))
    assert multiply(negate(x), negate(y)) is multiply(x, y)
    assert minus(x, y) is negate(minus(y, x))
    assert minus(negate(x), y) is negate(add(x, y))
    assert minus(x, x) == 0.0
    assert add(x, x) is multiply(2.0, x)
    assert negate(negate(x)) is x


def test_constants_vanish_and_merge(x):
    assert multiply(0.0, x) == 0.0
    assert multiply(1.0, x) is x
    assert multiply(-1.0, x) is negate(x)
    assert add(x, 0.0) is x
    assert multiply(2.0, multiply(3.0, x)) is multiply(6.0, x)
    assert divide(x, 4.0) is multiply(0.25, x)
    assert divide(0.0, x) == 0.0
    assert minus(x, 2.0) is negate(minus(2.0, x))
    assert add(2.0, 3.0) == 5.0
    assert negate(2.0) == -2.0


def test_merged_factors_do_not_overflow(x):
    product = multiply(1e-200, multiply(1e-200, x))
    assert product.operands[0] == 1e-200
    assert divide(x, 0.0).operation is Operation.DIVIDE


def test_constants_are_computed_by_ieee_754():
    assert divide(1.0, 0.0) == math.inf
    assert math.isnan(divide(0.0, 0.0))
    assert math.isnan(apply(Operation.SQUARE_ROOT, -1.0))
    assert apply(Operation.SINE, 0.5) == np.sin(0.5)


def test_signs_move_out_of_odd_functions_and_vanish_in_even_ones(x):
    assert apply(Operation.SINE, negate(x)) is negate(apply(Operation.SINE, x))
    assert apply(Operation.COSINE, negate(x)) is apply(Operation.COSINE, x)
    assert apply(Operation.EXPONENTIAL, negate(x)) is not apply(
        Operation.EXPONENTIAL, x
    )


def test_powers_are_products(x):
    square = multiply(x, x)
    assert integer_power(x, 4) is multiply(square, square)
    assert power(x, 3.0) is multiply(x, square)
    assert power(x, -2.0) is divide(1.0, square)
    assert power(x, 0.5) is apply(Operation.SQUARE_ROOT, x)
    assert power(x, 0.3).operation is Operation.POWER


def test_known_choices_are_made(x, y):
    less = apply(Operation.LESS, x, y)
    assert select(True, x, y) is x
    assert select(False, x, y) is y
    assert select(less, x, x) is x
    assert logic(Operation.AND, less, False) is False
    assert logic(Operation.AND, less, True) is less
    assert logic(Operation.OR, True, less) is True
    assert logic(Operation.OR, less, False) is less
    assert logic(Operation.AND, less, less) is less
    # This comparison finds NaN.
    assert apply(Operation.NOT_EQUAL, x, x).operation is Operation.NOT_EQUAL


@given(
    st.lists(st.tuples(*[st.integers(0, 4)] * 3), min_size=2, max_size=9),
    st.integers(0, 9),
)
@settings(max_examples=30, deadline=None, derandomize=True)
def test_sums_of_products_keep_their_value(terms, split):
    c = np.array([0.5, -0.3, 2.0, 1.7, 0.0])

    def function(x):
        def total(some):
            return sum(
                (-1) ** i * c[k] * x[i] * x[j] * (1.0 + x[i]) for i, j, k in some
            )

        first = total(terms[:split]) + jnp.zeros(())
        return jnp.stack([first, first - total(terms[split:]), jnp.sin(total(terms))])

    x = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    got = evaluate(trace(function, (5,)), x)
    want = [function(column) for column in x.T]
    np.testing.assert_allclose(got.T, want, rtol=1e-13, atol=1e-14)


def test_operations_of_a_seven_joint_regressor(monkeypatch):
    """Exact numbers, which show a careless change of the compiler, or of JAX."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    benchmark = importlib.import_module("fences")
    n = (benchmark.JOINTS,)
    program = trace(benchmark.regressor, n, n, n)
    assert (program.counts.multiplications, program.counts.additions) == (842, 640)
    assert (program.counts.functions, program.counts.divisions) == (12, 0)
    assert int(program.nonzeros.sum()) == 255

    p = np.random.default_rng(0).uniform(0.5, 1.5, (7, 10))
    program = trace(
        lambda *x: jnp.einsum("jbk,bk->j", benchmark.regressor(*x), p), n, n, n
    )
    assert program.counts.multiplications < 842 + 255
