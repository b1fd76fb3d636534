"""Torque errors by hand, and mass matrices that are known to be definite or not."""

import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.fit import ConditionNumbers
from jaxid.identification.uncertainty import Uncertainty
from jaxid.validation import TorqueErrors, definiteness, position_range


def errors(counted=None):
    rng = np.random.default_rng(0)
    measured, predicted = rng.normal(size=(2, 50, 2)) * [10.0, 1.0]
    counted = np.ones((50, 2), bool) if counted is None else counted
    return TorqueErrors(
        "log", np.arange(50) * 0.01, measured, predicted, counted, np.array([100.0, 5.0])
    )


def test_errors_are_those_of_the_paper():
    e = errors()
    by_hand = np.zeros(2)
    for row in range(50):
        by_hand += np.abs(e.predicted[row] - e.measured[row])
    np.testing.assert_allclose(e.mean, by_hand / 50)
    np.testing.assert_allclose(e.mean_percent, by_hand / 50 * [1.0, 20.0])
    np.testing.assert_allclose(e.rms**2, np.var(e.errors, axis=0) + e.errors.mean(axis=0) ** 2)
    assert (e.rms >= e.mean).all()
    np.testing.assert_allclose(
        e.relative, np.linalg.norm(e.predicted - e.measured) / np.linalg.norm(e.measured)
    )


def test_rows_that_do_not_count_change_nothing():
    counted = np.ones((50, 2), bool)
    counted[10:20, 0] = False
    e = errors(counted)
    spoilt = TorqueErrors(
        e.name, e.time, np.where(counted, e.measured, 1e9), e.predicted, counted, e.max_forces
    )
    for name in ("mean", "rms", "rms_relative", "explained", "relative"):
        np.testing.assert_allclose(getattr(spoilt, name), getattr(e, name))
    np.testing.assert_allclose(e.mean[0], np.abs(e.errors[counted[:, 0], 0]).mean())


def test_a_joint_without_any_force_has_no_relative_error():
    e = errors()
    measured = np.asarray(e.measured) * [1.0, 0.0]
    silent = TorqueErrors(e.name, e.time, measured, e.predicted, e.counted, e.max_forces)
    for found in (silent.rms_relative, silent.explained):
        np.testing.assert_array_equal(np.isnan(found), [False, True])
    assert np.isfinite(silent.relative)


def test_a_perfect_prediction_explains_everything():
    e = errors()
    perfect = TorqueErrors(e.name, e.time, e.measured, e.measured, e.counted, e.max_forces)
    np.testing.assert_allclose(perfect.explained, 1.0)
    assert perfect.relative == 0.0


def fit_of(parameters):
    """A planar arm's fit with given rotor inertias and nothing else."""
    robot = jid.robots.planar_arm(2, 0.4).replace(
        limits=jid.Limits(2, position_min=[-1.0, 0.5], position_max=[1.0, 2.0])
    )
    base = jid.base_parameters(jid.Model(robot, (jid.RotorInertia(),)))
    return jid.Fit(
        base=base,
        parameters=np.array(parameters),
        uncertainty=Uncertainty(np.eye(2), np.full(2, np.inf), np.eye(2)),
        weights=np.ones(2),
        condition_numbers=ConditionNumbers(1.0, 1.0, 1.0),
        rows=(1, 1),
        residual_rms=np.ones(2),
        residual=0.0,
        undetermined=(),
        estimator=jid.estimators.LeastSquares(),
        solution=jid.estimators.Complete(),
        recordings=(),
        notes=(),
    )


@pytest.mark.parametrize(("inertias", "share"), [((0.3, 0.2), 0.0), ((0.3, -0.2), 1.0)])
def test_definiteness_of_a_diagonal_mass_matrix(inertias, share):
    found = definiteness(fit_of(inertias), poses=50)
    assert found.positive_definite == (share == 0.0)
    assert found.indefinite == share
    assert found.smallest == pytest.approx(min(inertias))
    assert -1.0 <= found.pose[0] <= 1.0
    assert 0.5 <= found.pose[1] <= 2.0


def test_an_arm_of_real_bodies_has_a_definite_mass_matrix():
    model = jid.Model(jid.robots.panda(), (jid.RigidBodies(),))
    base = jid.base_parameters(model)
    body = [2.0, 0.02, 0.01, 0.04, 0.03, 0.03, 0.02, 0.0, 0.0, 0.0]
    p = np.asarray(base.from_standard(np.tile(body, 7)))
    fit = fit_of((1.0, 1.0))
    arm = jid.Fit(**{**vars(fit), "base": base, "parameters": p})
    found = definiteness(arm, poses=200)
    assert found.positive_definite
    flipped = jid.Fit(**{**vars(arm), "parameters": -p})
    assert definiteness(flipped, poses=200).indefinite == 1.0


def test_unlimited_joints_turn_once():
    low, high = position_range(jid.robots.planar_arm(2))
    np.testing.assert_allclose(low, [-np.pi] * 2)
    np.testing.assert_allclose(high, [np.pi] * 2)
    low, high = position_range(jid.robots.tx90l_on_rail())
    assert (low[0], high[0]) == (-1.5, 1.5)
