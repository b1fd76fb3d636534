"""Laws of every friction, and of torque ripple."""

import numpy as np
import pytest

from jaxid.robot import library
from jaxid.simulation import LuGreFriction, SmoothFriction, TorqueRipple

VISCOUS, COULOMB = np.array([3.0, 0.2, 1.0]), np.array([5.0, 0.4, 2.0])
FRICTIONS = [
    SmoothFriction(VISCOUS, COULOMB),
    SmoothFriction(VISCOUS, COULOMB, stribeck=0.3 * COULOMB),
    LuGreFriction(VISCOUS, COULOMB, 1.2 * COULOMB),
]
STEP = 1e-3
FAST = np.array([0.3, -0.8, 1.5])


@pytest.mark.parametrize("friction", FRICTIONS)
def test_a_step_at_a_speed_that_lasts_has_the_steady_friction(friction):
    z = friction.settled(FAST)
    force, slope, bent, rate = friction.over_step(FAST, FAST, z, STEP)
    np.testing.assert_allclose(force + slope * FAST, friction.steady(FAST), rtol=1e-12)
    np.testing.assert_allclose(bent + rate * FAST, z, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("friction", FRICTIONS)
def test_friction_brakes_alike_in_both_directions(friction):
    steady = np.asarray(friction.steady(FAST))
    assert (steady * FAST > 0).all()
    np.testing.assert_allclose(friction.steady(-FAST), -steady)
    none = 0.0 * FAST
    force, slope, *_ = friction.over_step(none, none, friction.settled(none), STEP)
    np.testing.assert_array_equal(force, 0.0)
    assert (np.asarray(slope) > 0).all()


@pytest.mark.parametrize("friction", FRICTIONS)
def test_temperature_scales_viscous_and_dry_friction_apart(friction):
    ones = np.ones(3)
    viscous, dry = friction.scaled(ones, 0.0 * ones), friction.scaled(0.0 * ones, ones)
    np.testing.assert_allclose(viscous.steady(FAST), VISCOUS * FAST, rtol=1e-12)
    whole = friction.scaled(0.5 * ones, 2.0 * ones).steady(FAST)
    parts = 0.5 * viscous.steady(FAST) + 2.0 * dry.steady(FAST)
    np.testing.assert_allclose(whole, parts, rtol=1e-12)
    np.testing.assert_allclose(
        friction.scaled(ones, 2.0 * ones).parameters[3:], 2.0 * COULOMB
    )


def test_ripple_goes_round_with_the_motor():
    robot = library.tx40()
    ripple = TorqueRipple(np.full(6, 0.5), np.full(6, 4.0), np.zeros(6))
    q = np.random.default_rng(0).normal(size=6)
    turn = robot.drives.joint_velocities(np.full(6, 2 * np.pi))
    forces = np.asarray(ripple.forces(robot, q))
    np.testing.assert_allclose(ripple.forces(robot, q + turn), forces, atol=1e-9)
    assert np.abs(forces).max() <= 0.5
