"""Least squares beside NIST's certified values, and what must not depend on units or order."""

import numpy as np
import pytest
from strd import PROBLEMS, exact

from jaxid.identification.estimators import Complete
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Factors, JointFactor

DIGITS = {
    "Norris": 12,
    "Pontius": 11,
    "NoInt1": 14,
    "NoInt2": 14,
    "Filip": 6,
    "Longley": 10,
    "Wampler1": 8,
    "Wampler2": 11,
    "Wampler3": 8,
    "Wampler4": 7,
    "Wampler5": 5,
}
"""Digits that all estimates of a problem have at least, with any order of the rows."""


def solved(X, y):
    """By the path that identification takes: a joint's factor, then its decomposition."""
    size = X.shape[1]
    joint = JointFactor(tuple(range(size)), np.zeros((0, size + 1)), 0)
    for part in np.array_split(np.column_stack([X, y]), 2):
        joint = joint.append(part)
    found = Decomposition.of(*Factors((joint,), size).weighted(np.ones(1)))
    inverse = Complete().inverse(found.values)
    return found.solve(inverse), found, inverse


def arrays(name):
    problem = PROBLEMS[name]
    X = np.array([[float(x) for x in column] for column in problem.columns]).T
    return X, np.array([float(y) for y in problem.response])


def digits(found, known):
    error = np.abs(np.asarray(found) - known) / np.abs(known)
    return float(-np.log10(max(error.max(), 1e-15)))


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_certified_values_are_those_of_exact_arithmetic(name):
    problem = PROBLEMS[name]
    found = np.array([float(x) for x in exact(problem)])
    np.testing.assert_allclose(found, problem.certified, rtol=1e-14)


@pytest.mark.parametrize("name", PROBLEMS)
def test_certified_digits_are_reached_in_any_order_of_the_rows(name):
    X, y = arrays(name)
    order = np.random.default_rng(3).permutation(len(y))
    for rows in (slice(None), order):
        p, _, _ = solved(X[rows], y[rows])
        assert digits(p, np.array(PROBLEMS[name].certified)) >= DIGITS[name]


@pytest.mark.parametrize("name", ["Norris", "Pontius", "NoInt1", "Filip", "Longley", "Wampler3"])
def test_certified_standard_deviations_are_reached(name):
    X, y = arrays(name)
    _, found, inverse = solved(X, y)
    rest = found.rest / np.sqrt(X.shape[0] - X.shape[1])
    deviations = rest * np.sqrt(np.diag(found.inverse_information(inverse)))
    # What is left of the responses is a difference: it has fewer digits than they have.
    assert digits(deviations, np.array(PROBLEMS[name].deviations)) >= 5


@pytest.mark.parametrize("name", ["Longley", "Pontius", "Wampler3"])
def test_units_of_columns_change_nothing_but_the_units_of_estimates(name):
    X, y = arrays(name)
    factors = 2.0 ** np.random.default_rng(0).integers(-9, 10, X.shape[1])
    p, found, _ = solved(X, y)
    q, other, _ = solved(X * factors, y)
    np.testing.assert_allclose(q * factors, p, rtol=1e-9)
    np.testing.assert_allclose(other.values, found.values, rtol=1e-12)
