import gc
import math
import weakref

import numpy as np
import pytest

from jaxid.program.operations import Operation
from jaxid.program.scalar import (
    Graph,
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


@pytest.fixture
def graph():
    return Graph()


def leaf(graph, k):
    return graph.node(Operation.INPUT, 0, k)


def test_equal_expressions_are_one_object(graph):
    x, y = leaf(graph, 0), leaf(graph, 1)
    assert x * y is y * x
    assert x + y is y + x
    assert (-x) * y is -(x * y)
    assert (-x) * (-y) is x * y
    assert x - y is -(y - x)
    assert -x - y is -(x + y)
    assert x - x == 0.0
    assert x + x is 2.0 * x
    assert negate(negate(x)) is x


def test_constants_vanish_and_merge(graph):
    x = leaf(graph, 0)
    assert 0.0 * x == 0.0
    assert 1.0 * x is x
    assert -1.0 * x is -x
    assert x + 0.0 is x
    assert 2.0 * (3.0 * x) is 6.0 * x
    assert divide(x, 4.0) is 0.25 * x
    assert divide(0.0, x) == 0.0
    assert (x - 2.0) is -(2.0 - x)
    assert add(2.0, 3.0) == 5.0
    assert multiply(0.0, x) == 0.0


def test_merged_factors_do_not_overflow(graph):
    x = leaf(graph, 0)
    product = 1e-200 * (1e-200 * x)
    assert product.operands[0] == 1e-200
    assert divide(x, 0.0).operation is Operation.DIVIDE


def test_constants_fold_as_ieee_754_says():
    assert divide(1.0, 0.0) == math.inf
    assert math.isnan(divide(0.0, 0.0))
    assert math.isnan(apply(Operation.SQUARE_ROOT, -1.0))
    assert apply(Operation.SINE, 0.5) == np.sin(0.5)


def test_signs_move_out_of_odd_functions_and_vanish_in_even_ones(graph):
    x = leaf(graph, 0)
    assert apply(Operation.SINE, -x) is -apply(Operation.SINE, x)
    assert apply(Operation.COSINE, -x) is apply(Operation.COSINE, x)
    assert apply(Operation.EXPONENTIAL, -x) is not apply(Operation.EXPONENTIAL, x)


def test_powers_are_products(graph):
    x = leaf(graph, 0)
    square = x * x
    assert integer_power(x, 4) is square * square
    assert power(x, 3.0) is x * square
    assert power(x, -2.0) is divide(1.0, square)
    assert power(x, 0.5) is apply(Operation.SQUARE_ROOT, x)
    assert power(x, 0.3).operation is Operation.POWER


def test_choices_that_are_known_are_made(graph):
    x, y = leaf(graph, 0), leaf(graph, 1)
    less = apply(Operation.LESS, x, y)
    assert select(True, x, y) is x
    assert select(False, x, y) is y
    assert select(less, x, x) is x
    assert logic(Operation.AND, less, False) is False
    assert logic(Operation.AND, less, True) is less
    assert logic(Operation.OR, True, less) is True
    assert logic(Operation.OR, less, False) is less
    assert logic(Operation.AND, less, less) is less


def test_a_comparison_with_itself_is_kept_because_it_finds_nan(graph):
    x = leaf(graph, 0)
    assert apply(Operation.NOT_EQUAL, x, x).operation is Operation.NOT_EQUAL


def test_a_graph_dies_with_its_scalars():
    class Watched(Graph):
        __slots__ = ("__weakref__",)

    graph = Watched()
    x = leaf(graph, 0) * 2.0
    alive = weakref.ref(graph)
    del graph, x
    gc.collect()
    assert alive() is None


def test_negation_of_a_number_is_a_number():
    assert negate(2.0) == -2.0
