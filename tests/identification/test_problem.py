"""The regression problem against the observation matrix, only formed in these tests."""

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid

WEIGHTS = np.array([0.3, 2.0])


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
    return [
        np.concatenate(x)
        for x in zip(*(dense(base, o) for o in recordings), strict=True)
    ]


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
    def information(factors):
        R, _ = factors.weighted(WEIGHTS)
        return R.T @ R

    blocks = jid.RegressionProblem(base, recordings, divisions=7).blocks
    assert len(blocks.parts) == 14
    whole = information(jid.RegressionProblem(base, recordings, divisions=1).factors)
    parted = information(
        blocks.select(k for k in range(14) if k != 3).total
    ) + information(blocks.parts[3])
    for found in (information(blocks.total), parted):
        np.testing.assert_allclose(found, whole, rtol=1e-12, atol=1e-10)


@pytest.mark.parametrize("cached", [0, 10**9])
def test_passes_visit_every_row_that_the_factors_stand_for(
    base, recordings, matrix, cached
):
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


def test_chunks_change_only_rounding(base):
    smooth = jid.ZeroPhaseButterworth(20.0, margin=0.2)
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=6000, noise=0.3, filter=smooth, every=10)
    parts = []
    for samples in (6000, 1000):
        problem = jid.RegressionProblem(base, [o])
        problem.samples_per_chunk = samples
        chunks = problem.chunks()
        parts.append(
            np.concatenate([np.hstack([*c.columns, c.forces]) for c in chunks])
        )
    np.testing.assert_allclose(*parts, rtol=0, atol=1e-11 * np.abs(parts[0]).max())


def test_factors_alone_give_no_pass(base, recordings):
    blocks = jid.RegressionProblem(base, recordings).blocks
    problem = jid.RegressionProblem(base, blocks=blocks)
    for refused in (lambda: next(problem.chunks()), lambda: problem.with_base(base)):
        with pytest.raises(ValueError, match="needs the rows themselves"):
            refused()
