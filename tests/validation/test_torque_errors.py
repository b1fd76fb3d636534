"""Torque errors by hand, and mass matrices that are known to be definite or not."""

import dataclasses

import numpy as np
import pytest
from virtual import fit_of, observations, planar_base, standard_parameters

import jaxid as jid
from jaxid.validation.torque_errors import TorqueErrors, definiteness, torque_errors


def errors(counted=None):
    measured, predicted = np.random.default_rng(0).normal(size=(2, 50, 2)) * [10.0, 1.0]
    counted = np.ones((50, 2), bool) if counted is None else counted
    limits = np.array([100.0, 5.0])
    speeds = np.where(np.arange(50)[:, None] >= [20, 0], 1.0, 0.0)
    data = measured, predicted, counted, limits, speeds, predicted - measured, speeds
    return TorqueErrors("log", np.arange(50) * 0.01, *data)


def test_errors_are_those_of_the_paper():
    e = errors()
    silent = dataclasses.replace(e, measured=np.asarray(e.measured) * [1.0, 0.0])
    np.testing.assert_array_equal(np.isnan(silent.rms_relative), [False, True])
    by_hand = (
        sum(np.abs(p - m) for p, m in zip(e.predicted, e.measured, strict=True)) / 50
    )
    np.testing.assert_allclose(e.mean, by_hand)
    np.testing.assert_allclose(e.mean_percent, by_hand * [1.0, 20.0])
    np.testing.assert_allclose(
        e.rms**2, np.var(e.errors, axis=0) + e.errors.mean(axis=0) ** 2
    )
    relative = np.linalg.norm(e.predicted - e.measured) / np.linalg.norm(e.measured)
    np.testing.assert_allclose(e.relative, relative)
    assert dataclasses.replace(e, predicted=e.measured).relative == 0.0


def test_errors_that_depend_on_speed_are_told_from_noise():
    rng, t = np.random.default_rng(1), np.arange(4000) * 0.01
    speeds = np.stack([np.sin(t), np.sin(1.3 * t), np.sin(2.1 * t)], axis=1)
    # The last error is that of a Stribeck effect, twice as large as the noise at most.
    shape = 2.0 * np.sign(speeds) * np.exp(-((speeds / 0.1) ** 2)) * [0.0, 0.0, 1.0]
    false = 0
    for _ in range(50):
        x = rng.normal(size=shape.shape) + shape
        e = TorqueErrors("", t, x, 0 * x, shape < 9.0, np.ones(3), speeds, -x, speeds)
        *steady, found = e.depend_on_speed
        assert found
        false += any(steady)
    assert false <= 3


def test_wrong_parameters_are_no_other_shape_of_friction():
    base = planar_base()
    p = standard_parameters(base.model)
    o = observations(base.model, p, samples=2000, noise=0.4)
    wrong = np.asarray(base.from_standard(p)) * np.where(
        np.char.find(base.names, "fv") < 0, 1, 3
    )
    e = torque_errors(fit_of(base, wrong), o)
    as_unexplained = dataclasses.replace(e, unexplained=e.errors)
    assert all(as_unexplained.depend_on_speed)
    assert not any(e.depend_on_speed)
    right = torque_errors(fit_of(base, base.from_standard(p)), o)
    np.testing.assert_allclose(e.unexplained, right.unexplained, atol=1e-9)


def test_rows_that_do_not_count_change_nothing():
    counted = np.ones((50, 2), bool)
    counted[10:20, 0] = False
    e = errors(counted)
    spoilt = dataclasses.replace(e, measured=np.where(counted, e.measured, 1e9))
    for name in ("mean", "rms", "rms_relative", "relative"):
        np.testing.assert_allclose(getattr(spoilt, name), getattr(e, name))
    np.testing.assert_allclose(e.mean[0], np.abs(e.errors[counted[:, 0], 0]).mean())


@pytest.mark.parametrize(("inertias", "share"), [((0.3, 0.2), 0.0), ((0.3, -0.2), 1.0)])
def test_definiteness_of_a_diagonal_mass_matrix(inertias, share):
    limits = jid.Limits(2, position_min=[-1.0, 0.5], position_max=[1.0, 2.0])
    robot = jid.robots.planar_arm(2, 0.4).replace(limits=limits)
    base = jid.base_parameters(jid.Model(robot, (jid.RotorInertia(),)))
    found = definiteness(fit_of(base, np.array(inertias)), 50)
    assert found.positive_definite == (share == 0.0)
    assert found.indefinite == share
    assert found.smallest == pytest.approx(min(inertias))
    assert -1.0 <= found.pose[0] <= 1.0
    assert 0.5 <= found.pose[1] <= 2.0
