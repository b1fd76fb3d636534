"""Forward dynamics: the inverse of inverse dynamics, and a step that keeps energy."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import RigidBodies, RotorInertia
from jaxid.robot import library
from jaxid.robot.robot import Robot
from jaxid.simulation.friction_and_ripple import LuGreFriction, SmoothFriction
from jaxid.simulation.mechanics import DriveTrain, SimulatedPlant
from jaxid.simulation.virtual import random_bodies

ZERO = np.zeros(2)
FREE = SmoothFriction(ZERO, ZERO)


def cart():
    """A rail and a pendulum, hanging at q = 0."""
    return Robot(
        "cart",
        revolute=(False, True),
        axis=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=np.zeros((2, 3)),
    )


MODEL = Model(cart(), (RigidBodies(), RotorInertia()))
BODIES = np.array(
    [
        [8.0, 0, 0, 0, 1, 1, 1, 0, 0, 0],
        [2.0, 0, 0, -0.8, 0.4, 0.4, 0.1, 0, 0, 0],
    ]
)
PARAMETERS = np.concatenate([BODIES.ravel(), [1.5, 0.05]])


def plant(friction=FREE, step=1e-3):
    return SimulatedPlant(DriveTrain(MODEL, friction, None, step), PARAMETERS)


def moved(machine, u, steps, ramp=1):
    """Positions, velocities, accelerations after steps; the force may come slowly."""
    rows = []
    for k in range(steps):
        machine.step([min((k + 1) / ramp, 1.0) * x for x in u])
        rows.append(machine.read())
    return np.array(rows).reshape(steps, 3, 2).transpose(1, 0, 2)


def test_forward_dynamics_is_the_inverse_of_inverse_dynamics():
    robot, random = library.planar_arm(3), np.random.default_rng(0)
    bodies = random_bodies(robot, np.linspace(20.0, 2.0, 3), random)
    model, p = (
        Model(robot),
        np.concatenate([bodies.ravel(), random.uniform(0.1, 1.0, 9)]),
    )
    q, qd, qdd = random.normal(size=(3, 20, 3))
    forces = model.inverse_dynamics(p, Motion(q, qd, qdd))
    np.testing.assert_allclose(
        model.forward_dynamics(p, q, qd, forces), qdd, rtol=1e-9, atol=1e-9
    )


def test_energy_is_kept_without_friction():
    machine = plant()
    start = np.array([0.2, 2.0])
    machine.start(
        start, ZERO, np.asarray(MODEL.forward_dynamics(PARAMETERS, start, ZERO, ZERO))
    )
    q, qd, _ = moved(machine, ZERO, 4000)
    potential = np.asarray(MODEL.potential_energy(PARAMETERS, q))
    energy = MODEL.kinetic_energy(PARAMETERS, q, qd) + potential
    assert np.abs(energy - energy[0]).max() < 2e-4 * np.ptp(potential)

    # By a Runge-Kutta method of high order.
    def rate(_, x):
        qdd = MODEL.forward_dynamics(PARAMETERS, x[:2], x[2:], ZERO)
        return np.concatenate([x[2:], qdd])

    exact = solve_ivp(rate, (0, 1.0), [*start, 0, 0], method="DOP853", rtol=1e-10)
    np.testing.assert_allclose(q[999], exact.y[:2, -1], atol=2e-5)


LUGRE = LuGreFriction(
    viscous=np.array([10.0, 0.1]),
    coulomb=np.array([30.0, 3.0]),
    breakaway=np.array([36.0, 3.6]),
)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_stiction_holds_below_the_breakaway_force_and_lets_go_above(sign):
    machine = plant(LUGRE)
    machine.start(ZERO, ZERO, ZERO)
    # The pendulum hangs; the rail is pushed with 95 % of what it withstands.
    # It comes slowly, for a sudden force bends the bristles twice as far.
    q, _, _ = moved(machine, [sign * 0.95 * 36.0, 0.0], 6000, ramp=2000)
    assert np.ptp(q[5000:, 0]) < 2e-6
    assert 0.9 * 5e-4 < sign * q[-1, 0] < 4 * 5e-4
    machine.start(ZERO, ZERO, ZERO)
    q, qd, _ = moved(machine, [sign * 1.05 * 36.0, 0.0], 3000, ramp=1000)
    assert sign * q[-1, 0] > 0.1
    # And without a push it comes to rest and stays there.
    q, qd, _ = moved(machine, ZERO, 8000)
    assert np.abs(qd[-1, 0]) < 1e-6


def test_lugre_at_speed_is_stribecks_curve():
    for speed in (0.02, 0.05, 0.5):
        machine, qd = plant(LUGRE), np.array([speed, 0.0])
        machine.start(ZERO, qd, ZERO)
        steady = np.asarray(LUGRE.steady(qd))
        level = 30.0 + 6.0 * np.exp(-((speed / 0.05) ** 2)) + 10.0 * speed
        assert steady[0] == pytest.approx(level * 1.0, rel=0.04)
        _, speeds, _ = moved(machine, [level, 0.0], 50)
        np.testing.assert_allclose(speeds[:, 0], speed, rtol=2e-3)
