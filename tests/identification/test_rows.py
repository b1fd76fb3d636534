"""Rows: their passes and their factors tell the same."""

import numpy as np
import pytest
from virtual import dense, observations, standard_parameters

import jaxid as jid
from jaxid.identification import rows as module
from jaxid.identification.factors import factorise


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.ConstantOffset())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


@pytest.fixture(scope="module")
def recordings(base):
    p = standard_parameters(base.model)
    mask = np.random.default_rng(0).random((300, 2)) < 0.7
    return (
        observations(base.model, p, samples=300, noise=0.3, mask=mask),
        observations(base.model, p, samples=200, noise=0.3, seed=3),
    )


@pytest.mark.parametrize("held", [0, 10**9])
def test_passes_go_through_every_row_that_the_factors_stand_for(
    base, recordings, held, monkeypatch
):
    monkeypatch.setattr(module, "HELD", held)
    rows = jid.Rows.of(base, recordings)
    expected = [np.concatenate(x) for x in zip(*(dense(base, o) for o in recordings), strict=True)]
    for _ in range(2):
        theta, forces = [], []
        for chunk in rows.chunks():
            full = np.zeros((*chunk.forces.shape, base.size))
            for j, own in enumerate(chunk.acting):
                full[:, j, list(own)] = chunk.columns[j]
            theta.append(full[chunk.counted])
            forces.append(chunk.forces[chunk.counted])
        np.testing.assert_allclose(np.concatenate(theta), expected[0], atol=1e-12)
        np.testing.assert_allclose(np.concatenate(forces), expected[1], atol=1e-12)


def test_rows_with_weights_of_their_own_make_the_factors_of_numpy(base, recordings):
    rows = jid.Rows.of(base, recordings)
    p = standard_parameters(base.model)[: base.size]
    theta, forces, joint = (
        np.concatenate(x) for x in zip(*(dense(base, o) for o in recordings), strict=True)
    )
    r = forces - theta @ p
    scale = np.array([1.0, 3.0])
    blocks = rows.reweighted(p, lambda e, counted: 1 / (1 + (e / scale) ** 2))
    w = 1 / np.sqrt(1 + (r / scale[joint]) ** 2)
    expected, *_ = np.linalg.lstsq(w[:, None] * theta, w * forces, rcond=None)
    got, *_ = np.linalg.lstsq(*blocks.total.weighted(np.ones(2)), rcond=None)
    np.testing.assert_allclose(got, expected, rtol=1e-9)
    plain = rows.reweighted(p, lambda e, counted: np.ones_like(e))
    for a, b in zip(plain.parts, factorise(base, recordings).parts, strict=True):
        np.testing.assert_allclose(a.residual_squares(p), b.residual_squares(p), rtol=1e-10)


def test_rows_of_other_columns_are_of_the_same_recordings(base, recordings):
    less = jid.base_parameters(jid.Model(base.model.robot, base.model.terms[:2]))
    rows = jid.Rows.of(base, recordings).with_base(less)
    expected = jid.identify(less, recordings, jid.LeastSquares())
    fit = jid.fit_rows(rows, jid.LeastSquares())
    np.testing.assert_array_equal(fit.parameters, expected.parameters)
    assert fit.recordings == expected.recordings


def test_factors_alone_give_no_pass(base, recordings):
    rows = jid.Rows(base, factorise(base, recordings))
    assert not rows.seen
    for refused in (lambda: next(rows.chunks()), lambda: rows.with_base(base)):
        with pytest.raises(ValueError, match="needs the rows themselves, but only their factors"):
            refused()
