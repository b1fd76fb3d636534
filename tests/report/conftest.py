"""A small robot with a rail and a pendulum, fitted to a noisy virtual log."""

import dataclasses

import numpy as np
import pytest

import jaxid as jid
from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.terms import RigidBodies
from jaxid.identification.estimators import LeastSquares
from jaxid.identification.identify import identify
from jaxid.measurement.filters import ZeroPhaseButterworth
from jaxid.measurement.observations import observe
from jaxid.robot.joints import Limits
from jaxid.robot.robot import Robot
from jaxid.simulation.friction import SmoothFriction
from jaxid.simulation.virtual import Sensors, VirtualRobot, random_bodies
from jaxid.trajectory.fourier import random_fourier_series
from jaxid.validation import Validation, validate


def cart() -> Robot:
    return Robot(
        "cart",
        revolute=(False, True),
        axis=[(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=np.zeros((2, 3)),
        joint_names=("rail", "swing_$1_$"),
        limits=Limits(2, velocity=[1.0, 3.0], force=[200.0, 30.0]),
        tip_offset=(0.0, 0.0, 0.4),
    )


@pytest.fixture(scope="session")
def validated():
    """A fit of the cart with its validation on two recordings."""
    robot = cart()
    random = np.random.default_rng(0)
    bodies = random_bodies(robot, np.array([8.0, 2.0]), random)
    virtual = VirtualRobot(
        robot=robot,
        terms=(RigidBodies(),),
        values=bodies.ravel(),
        friction=SmoothFriction(np.array([3.0, 0.2]), np.array([5.0, 0.4])),
        sensors=Sensors(
            encoder_step=1e-6,
            white_noise=np.array([0.5, 0.05]),
            coloured_noise=np.zeros(2),
            memory=0.1,
        ),
    )
    observations = [
        observe(
            virtual.measure(
                random_fourier_series(robot, omega=1.5, seed=s),
                duration=4.0,
                sample_time=0.005,
                seed=s,
                name=name,
            ),
            robot,
            ZeroPhaseButterworth(10.0),
        )
        for s, name in ((1, "first/run"), (2, "second"))
    ]
    fit = identify(base_parameters(virtual.model), observations[0], LeastSquares())
    return fit, validate(fit, observations)


@pytest.fixture
def fit(validated):
    return validated[0]


@pytest.fixture
def validation(validated) -> Validation:
    return validated[1]


@pytest.fixture
def warm(fit):
    """Return the same robot with a third of the rail's friction."""
    p = np.array(fit.parameters)
    p[fit.base.names.index("fv1")] /= 3.0
    return dataclasses.replace(fit, parameters=p, recordings=("warm",))


@pytest.fixture(scope="session")
def consistent():
    """Return a fit of possible bodies with friction that drives: the bound at zero decides."""
    robot = jid.robots.planar_arm(2, 0.4)
    model = jid.Model(robot, (jid.RigidBodies(), jid.ViscousFriction()))
    t = np.arange(0.0, 6.0, 0.01)
    motion = jid.random_fourier_series(robot, omega=1.5, seed=0).motion(t)
    p = np.zeros(model.size)
    p[[0, 1, 6, 5, 10, 11, 16, 15]] = [2.0, 0.4, 0.11, 0.11, 1.0, 0.2, 0.06, 0.06]
    p[-2:] = [0.3, -0.3]
    forces = np.array(model.inverse_dynamics(p, motion))
    forces += np.random.default_rng(0).normal(0.0, 0.05, forces.shape)
    log = jid.Recording.of(np.asarray(motion.q), forces, time=t)
    o = jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0))
    estimator = jid.PhysicallyConsistent(jid.estimators.ResidualVariances(0))
    return jid.identify(jid.base_parameters(model), o, estimator)
