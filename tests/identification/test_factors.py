"""Factors stand for the observation matrix, which only these tests form."""

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification.factors import factorise, reduced_rows

WEIGHTS = np.array([0.3, 2.0])


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


@pytest.fixture(scope="module")
def observed(base):
    mask = np.random.default_rng(3).random((400, 2)) < 0.7
    return observations(base.model, standard_parameters(base.model), noise=0.3, mask=mask)


def test_weighted_factor_has_the_information_of_the_weighted_matrix(base, observed):
    theta, forces, joint = dense(base, observed)
    w = WEIGHTS[joint][:, None]
    R, z = factorise(base, [observed]).total.weighted(WEIGHTS)
    np.testing.assert_allclose(R.T @ R, (w * theta).T @ (w * theta), rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(R.T @ z, (w * theta).T @ (w[:, 0] * forces), rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(z @ z, np.sum((w[:, 0] * forces) ** 2), rtol=1e-12)


def test_residual_squares_of_each_joint(base, observed):
    theta, forces, joint = dense(base, observed)
    p = np.linspace(-1, 1, base.size)
    expected = [np.sum((theta @ p - forces)[joint == j] ** 2) for j in range(2)]
    total = factorise(base, [observed]).total
    np.testing.assert_allclose(total.residual_squares(p), expected, rtol=1e-12)
    np.testing.assert_allclose(total.rows, np.bincount(joint))


def test_blocks_divide_time_and_sum_to_the_whole(base, observed):
    blocks = factorise(base, [observed, observed], blocks=7)
    assert len(blocks.parts) == 14
    whole = factorise(base, [observed, observed], blocks=1)
    a, b = (x.total.weighted(WEIGHTS)[0] for x in (blocks, whole))
    np.testing.assert_allclose(a.T @ a, b.T @ b, rtol=1e-12, atol=1e-10)
    without = blocks.without(3).weighted(WEIGHTS)[0]
    part = blocks.parts[3].weighted(WEIGHTS)[0]
    np.testing.assert_allclose(without.T @ without + part.T @ part, a.T @ a, rtol=1e-12, atol=1e-10)


def test_chunks_change_only_rounding(base):
    filtered = observations(
        base.model,
        standard_parameters(base.model),
        samples=6000,
        noise=0.3,
        filter=jid.ZeroPhaseButterworth(20.0, margin=0.2),
        every=10,
    )
    whole, pieces = (
        [
            np.concatenate(x)
            for x in zip(*((c[1], f) for _, c, f in reduced_rows(base, filtered, n)), strict=False)
        ]
        for n in (6000, 1000)
    )
    for a, b in zip(whole, pieces, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11 * np.abs(a).max())


def test_columns_are_filtered_like_forces(base):
    p = standard_parameters(base.model)
    smooth = jid.ZeroPhaseButterworth(2.0, margin=0.5)
    o = observations(base.model, p, samples=2000, filter=smooth, every=5)
    fit = jid.identify(base, o, jid.LeastSquares())
    # Coulomb friction has edges: were columns not filtered, the fit could not be exact.
    np.testing.assert_allclose(fit.parameters, base.from_standard(p), rtol=1e-9)
