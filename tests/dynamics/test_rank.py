"""Which columns depend on earlier ones: Gram-Schmidt, brute force, LAPACK's ranks."""

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings, strategies as st

from jaxid.dynamics.rank import gram_schmidt, rank_by_singular_values, regrouping


def with_dependent_columns(seed: int, rows: int, columns: int, rank: int) -> np.ndarray:
    """Random columns of which only some are new; others mix at most three of these."""
    rng = np.random.default_rng(seed)
    new = {0, *rng.choice(np.arange(1, columns), rank - 1, replace=False)}
    W = np.zeros((rows, columns))
    for k in range(columns):
        if k in new:
            W[:, k] = rng.normal(size=rows)
        else:
            earlier = rng.choice(k, min(k, 3), replace=False)
            W[:, k] = W[:, earlier] @ rng.uniform(0.5, 2.0, len(earlier))
    return W * rng.uniform(0.3, 3.0, columns)


def first_columns_that_raise_the_rank(W: np.ndarray) -> tuple[int, ...]:
    ranks = [
        0,
        *(np.linalg.matrix_rank(W[:, : k + 1], tol=1e-8) for k in range(W.shape[1])),
    ]
    return tuple(k for k in range(W.shape[1]) if ranks[k + 1] > ranks[k])


@given(
    seed=st.integers(0, 10**6), columns=st.integers(2, 14), share=st.floats(0.0, 1.0)
)
@settings(max_examples=60, deadline=None)
def test_columns_that_raise_the_rank_are_chosen(seed, columns, share):
    rank = 1 + int(share * (columns - 1))
    W = with_dependent_columns(seed, 40, columns, rank)
    found = gram_schmidt(W)
    assert found.independent == first_columns_that_raise_the_rank(W)
    assert len(found.independent) == np.linalg.matrix_rank(W)
    assert len(found.independent) == rank_by_singular_values(W)
    assert len(found.dependent) == scipy.linalg.null_space(W).shape[1]
    assert sorted(found.independent + found.dependent) == list(range(columns))
    assert found.gap > 1e6


def test_kappa_explains_dependent_columns_by_earlier_ones():
    W = with_dependent_columns(5, 40, 14, 8)
    found = gram_schmidt(W)
    kappa, left, _ = regrouping(W, found.independent, found.dependent)
    first, second = np.array(found.independent), np.array(found.dependent)
    assert left < 1e-13
    np.testing.assert_allclose(W[:, first] @ kappa, W[:, second], atol=1e-12)
    assert not kappa[first[:, None] > second].any()


def test_the_choice_does_not_depend_on_the_scale_of_columns():
    W = with_dependent_columns(7, 40, 12, 7)
    scales = 10.0 ** np.random.default_rng(0).uniform(-4, 4, 12)
    assert gram_schmidt(W).independent == gram_schmidt(W * scales).independent


def test_a_column_of_rounding_counts_as_zero():
    W = with_dependent_columns(3, 40, 8, 8)
    noisy = np.insert(W, 4, 1e-16 * np.random.default_rng(1).normal(size=40), axis=1)
    found = gram_schmidt(noisy)
    assert found.dependent == (4,)
    assert rank_by_singular_values(noisy) == 8
    kappa, _, _ = regrouping(noisy, found.independent, found.dependent)
    assert not kappa.any()


@pytest.mark.parametrize("columns", [1, 5])
def test_extremes(columns):
    full = np.random.default_rng(0).normal(size=(20, columns))
    assert gram_schmidt(full).dependent == ()
    assert gram_schmidt(full).gap > 1e6
    assert rank_by_singular_values(full) == columns
    assert gram_schmidt(np.zeros((20, columns))).independent == ()
    assert rank_by_singular_values(np.zeros((20, columns))) == 0
    wide = np.random.default_rng(1).normal(size=(3, 6))
    assert gram_schmidt(wide).independent == (0, 1, 2)
    assert rank_by_singular_values(wide) == 3


def test_a_small_share_counts_with_its_size():
    # Gram-Schmidt sees a share of 1e-8 that is far above rounding; it must say how
    # sure it is.
    rng = np.random.default_rng(2)
    W = np.linalg.qr(rng.normal(size=(40, 4)))[0]
    nearly = np.column_stack([W, W[:, 0] + 1e-8 * rng.normal(size=40)])
    found = gram_schmidt(nearly)
    assert found.dependent == ()
    assert 1e-9 < found.smallest_independent < 1e-6
    assert gram_schmidt(nearly, tolerance=1e-6).dependent == (4,)
