"""MuJoCo as physics of another origin: the same forces, experiments and parameters."""

import numpy as np
import pytest
from mujoco_robot import MujocoRobot

import jaxid as jid
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import ConstantOffset, RigidBodies, RotorInertia
from jaxid.robot import library
from jaxid.robot.limits_and_drives import Limits
from jaxid.simulation.friction_and_ripple import SmoothFriction
from jaxid.simulation.mechanics import Servo
from jaxid.simulation.tx90l import virtual_tx90l_on_rail
from jaxid.simulation.virtual import Sensors, VirtualRobot, random_bodies
from jaxid.trajectory.fourier import random_fourier_series

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra `mujoco`)")


def ur10(tool=False):
    robot, random = library.ur10(), np.random.default_rng(0)
    if tool:
        robot = robot.with_tool(mass=2.0, centre_of_mass=(0.01, 0.02, 0.1))
    bodies = random_bodies(robot, np.array([8.0, 12.0, 6.0, 3.0, 2.0, 1.0]), random)
    return VirtualRobot(
        robot=robot,
        terms=(RigidBodies(), RotorInertia()),
        values=np.concatenate([bodies.ravel(), np.linspace(1.0, 0.1, 6)]),
        friction=SmoothFriction(np.linspace(20.0, 1.0, 6), np.zeros(6)),
        sensors=Sensors(1e-9, np.zeros(6), np.zeros(6)),
    )


@pytest.mark.parametrize(
    "virtual", [virtual_tx90l_on_rail(disturbed=False), ur10(), ur10(tool=True)]
)
def test_forces_of_a_motion_are_mujocos(virtual):
    virtual = virtual.replace(
        friction=SmoothFriction(
            virtual.friction.viscous, 0.0 * virtual.friction.coulomb
        ),
        heating=None,
    )
    n = virtual.robot.joints
    motion = Motion(*np.random.default_rng(1).normal(size=(3, 50, n)))
    ours, theirs = virtual.forces(motion), MujocoRobot(virtual).forces(motion)
    np.testing.assert_allclose(
        ours, theirs, rtol=1e-9, atol=1e-9 * np.abs(theirs).max()
    )


# Tolerances are those of docs/virtual_robot.md: MuJoCo's dry friction is a constraint,
# ours a tanh.
@pytest.mark.parametrize(("dry", "tolerance"), [(0.0, 0.001), (1.0, 0.01)])
def test_the_same_experiment_gives_the_same_torques(dry, tolerance):
    virtual = virtual_tx90l_on_rail(disturbed=False)
    n = np.ones(virtual.robot.joints)
    virtual = virtual.replace(friction=virtual.friction.scaled(n, dry * n))
    trajectory = random_fourier_series(virtual.robot, omega=0.8, reach=0.7, seed=1)

    def known(motion):
        return virtual.model.inverse_dynamics(virtual.parameters, motion)

    ours, theirs = (
        machine.track(trajectory, feed_forward=known, duration=1.5, substeps=4, seed=1)
        for machine in (virtual, MujocoRobot(virtual))
    )
    most = np.asarray(virtual.robot.max_forces)
    difference = np.sqrt(np.mean((ours.forces - theirs.forces) ** 2, axis=0)) / most
    assert difference.max() < tolerance
    apart = np.abs(np.asarray(ours.actual.q) - np.asarray(theirs.actual.q)).max(axis=0)
    assert apart.max() < 2e-3


def test_mujocos_data_lead_to_the_true_parameters():
    virtual = ur10()
    trajectory = random_fourier_series(virtual.robot, omega=1.0, reach=0.8, seed=3)
    run = MujocoRobot(virtual).track(
        trajectory, feed_forward=virtual.forces, duration=6.0, substeps=2, seed=0
    )
    base = jid.base_parameters(virtual.model)
    rows = jid.Subsample(20)
    fit = jid.identify(
        base,
        jid.observe(run.recording, virtual.robot, jid.ZeroPhaseButterworth(20.0), rows),
    )
    truth = np.asarray(base.from_standard(virtual.parameters))
    wanted = np.asarray(base.inverse_dynamics(truth, run.actual))
    error = np.sqrt(np.mean((fit.predict(run.actual) - wanted) ** 2, axis=0))
    assert (error < 2e-3 * np.asarray(virtual.robot.max_forces)).all()
    masses = np.array([n.startswith(("m", "Ia")) for n in base.names])
    np.testing.assert_allclose(
        np.asarray(fit.parameters)[masses],
        truth[masses],
        atol=0.02 * np.abs(truth[masses]).max(),
    )


def test_what_mujoco_does_not_know_is_refused():
    virtual = ur10()
    values = np.concatenate([virtual.values, np.ones(6)])
    other = virtual.replace(terms=(*virtual.terms, ConstantOffset()), values=values)
    with pytest.raises(ValueError, match="`terms`"):
        MujocoRobot(other).plant(1e-3)


def test_an_unstable_simulation_is_an_error_and_writes_no_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    virtual = ur10()
    plant = MujocoRobot(virtual).plant(1e-3)
    plant.start(*np.zeros((3, 6)))
    with pytest.raises(ArithmeticError, match="unstable"):
        plant.step([1e300] * 6)
    without_limits = virtual.robot.replace(limits=Limits(6))
    stiff = Servo(np.full(6, 1e12), np.full(6, 1e12))
    motion = random_fourier_series(virtual.robot, omega=0.8, seed=1)
    robot = MujocoRobot(virtual.replace(robot=without_limits))
    with pytest.raises(ValueError, match=r"diverged .* `servo`"):
        robot.track(motion, servo=stiff, duration=0.5, seed=0)
    assert not list(tmp_path.iterdir())
