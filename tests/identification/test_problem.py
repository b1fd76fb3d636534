"""The regression problem against the observation matrix, which only these tests form."""

import itertools

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid

WEIGHTS = np.array([0.3, 2.0])


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


@pytest.fixture(scope="module")
def recordings(base):
    p = standard_parameters(base.model)
    mask = np.random.default_rng(0).random((300, 2)) < 0.7
    return (
        observations(base.model, p, samples=300, noise=0.3, mask=mask),
        observations(base.model, p, samples=200, noise=0.3, seed=3),
    )


@pytest.fixture(scope="module")
def matrix(base, recordings):
    return [np.concatenate(x) for x in zip(*(dense(base, o) for o in recordings), strict=True)]


def test_factors_have_the_information_of_the_weighted_matrix(base, recordings, matrix):
    theta, forces, joint = matrix
    factors = jid.RegressionProblem(base, recordings).factors
    A, b = WEIGHTS[joint, None] * theta, WEIGHTS[joint] * forces
    R, z = factors.weighted(WEIGHTS)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(R.T @ z, A.T @ b, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(z @ z, b @ b, rtol=1e-12)
    p = np.linspace(-1, 1, base.size)
    expected = [np.sum((theta @ p - forces)[joint == j] ** 2) for j in range(2)]
    np.testing.assert_allclose(factors.residual_squares(p), expected, rtol=1e-12)
    np.testing.assert_allclose(factors.rows, np.bincount(joint))


def test_blocks_divide_time_and_sum_to_the_whole(base, recordings):
    blocks = jid.RegressionProblem(base, recordings, divisions=7).blocks
    assert len(blocks.parts) == 14
    a, b, without, part = (
        x.weighted(WEIGHTS)[0]
        for x in (
            blocks.total,
            jid.RegressionProblem(base, recordings, divisions=1).factors,
            blocks.without(3),
            blocks.parts[3],
        )
    )
    np.testing.assert_allclose(a.T @ a, b.T @ b, rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(without.T @ without + part.T @ part, a.T @ a, rtol=1e-12, atol=1e-10)
    few = blocks.condense(4)
    assert len(few.parts) == 4
    np.testing.assert_array_equal(few.total.rows, blocks.total.rows)
    c = few.total.weighted(WEIGHTS)[0]
    np.testing.assert_allclose(c.T @ c, a.T @ a, rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("cached", [0, 10**9])
def test_passes_visit_every_row_that_the_factors_stand_for(base, recordings, matrix, cached):
    problem = jid.RegressionProblem(base, recordings)
    problem.cached_numbers = cached
    assert problem.factors.rows.sum() == len(matrix[0])
    for _ in range(2):
        theta, forces = [], []
        for chunk in problem.chunks():
            full = np.zeros((*chunk.forces.shape, base.size))
            for j, own in enumerate(chunk.indices):
                full[:, j, list(own)] = chunk.columns[j]
            theta.append(full[chunk.mask])
            forces.append(chunk.forces[chunk.mask])
        np.testing.assert_allclose(np.concatenate(theta), matrix[0], atol=1e-12)
        np.testing.assert_allclose(np.concatenate(forces), matrix[1], atol=1e-12)


def test_columns_are_evaluated_once(base, recordings, monkeypatch):
    evaluate, evaluated = jid.BaseParameters.regressor_rows, []
    monkeypatch.setattr(
        jid.BaseParameters, "regressor_rows", lambda *x: evaluated.append(x) or evaluate(*x)
    )
    jid.identify(base, recordings, jid.estimators.LeastSquares())
    assert len(evaluated) == len(recordings)


def test_rows_with_weights_of_their_own_make_the_factors_of_numpy(base, recordings, matrix):
    problem = jid.RegressionProblem(base, recordings)
    p, scale = standard_parameters(base.model)[: base.size], np.array([1.0, 3.0])
    theta, forces, joint = matrix
    w = 1 / np.sqrt(1 + ((forces - theta @ p) / scale[joint]) ** 2)
    expected, *_ = np.linalg.lstsq(w[:, None] * theta, w * forces, rcond=None)
    blocks = problem.reweighted(p, lambda e, mask: 1 / (1 + (e / scale) ** 2))
    got, *_ = np.linalg.lstsq(*blocks.total.weighted(np.ones(2)), rcond=None)
    np.testing.assert_allclose(got, expected, rtol=1e-9)


def test_a_fold_of_other_columns_is_that_of_numpy(base, recordings):
    """Squared sums of the residuals of both joints, as one column of all parameters."""
    p = standard_parameters(base.model)[: base.size]
    problem = jid.RegressionProblem(base, recordings, divisions=3)

    def equations(chunk):
        r = np.where(chunk.mask, chunk.residuals(p), 0.0)
        return [np.column_stack([r[:, :1], r[:, 1:]])]

    blocks = problem.fold(equations, [(0,)], 1)
    r = [np.where(chunk.mask, e, 0.0) for chunk, e in problem.residuals(p)]
    expected = np.concatenate(r)
    R = blocks.total.joints[0].R
    np.testing.assert_allclose(R.T @ R, expected.T @ expected, rtol=1e-10)
    rows = [part.joints[0].rows for part in blocks.parts]
    assert len(rows) == 6
    assert sum(rows) == 500


def test_chunks_change_only_rounding(base):
    smooth = jid.ZeroPhaseButterworth(20.0, margin=0.2)
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=6000, noise=0.3, filter=smooth, every=10)
    parts = []
    for samples in (6000, 1000):
        problem = jid.RegressionProblem(base, [o])
        problem.samples_per_chunk = samples
        chunks = list(problem.chunks())
        parts.append([np.concatenate([c.columns[1] for c in chunks])])
        parts[-1].append(np.concatenate([c.forces for c in chunks]))
        starts = [c.rows.start for c in chunks]
        assert all(a < b for a, b in itertools.pairwise(starts))
    for a, b in zip(*parts, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(a).max())


def test_factors_alone_give_no_pass(base, recordings):
    blocks = jid.RegressionProblem(base, recordings).blocks
    problem = jid.RegressionProblem(base, blocks=blocks)
    assert not problem.has_samples
    for refused in (lambda: next(problem.chunks()), lambda: problem.with_base(base)):
        with pytest.raises(ValueError, match="needs the rows themselves"):
            refused()
