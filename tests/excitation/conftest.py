"""Small arms whose programs compile in a second, and one finished design per kind."""

import jax
import numpy as np
import pytest

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.excitation.problem import ExcitationProblem
from jaxid.robot import library
from jaxid.robot.limits_and_drives import Limits
from jaxid.trajectory.fourier import FourierBasis


@pytest.fixture(scope="package")
def arm():
    return library.planar_arm(2).replace(
        limits=Limits(
            2,
            position_min=[-2.0, -1.0],
            position_max=[1.0, 2.5],
            velocity=[2.0, 3.0],
            acceleration=[4.0, 9.0],
            force=[80.0, 20.0],
        )
    )


@pytest.fixture(scope="package")
def base(arm):
    return base_parameters(Model(arm))


@pytest.fixture(scope="package")
def free(base):
    """The design problem of the arm without constraints."""
    return ExcitationProblem(base, FourierBasis(3, 1.1), noise=np.ones(2), samples=200)


@pytest.fixture(scope="package")
def parents(free):
    return free.limits.random(jax.random.key(1), 6)


@pytest.fixture(scope="package")
def pendulum():
    """The base parameters of one joint, for designs that differ in their settings."""
    limits = Limits(
        1,
        position_min=[-2.0],
        position_max=[2.0],
        velocity=[2.0],
        acceleration=[4.0],
        force=[9.0],
    )
    return base_parameters(Model(library.planar_arm(1).replace(limits=limits)))


@pytest.fixture(scope="package")
def random():
    return np.random.default_rng(0)


@pytest.fixture(scope="package")
def excess():
    """A function of a plan: largest excess of dense samples over the joints' limits."""

    def excess(plan):
        motion = plan.trajectory.motion(
            np.linspace(0.0, float(plan.trajectory.duration), 8000)
        )
        own = plan.base.model.robot.limits
        q, qd, qdd = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd))
        beyond = q - own.position_max, own.position_min - q, abs(qd) - own.velocity
        return max(float(np.max(x)) for x in (*beyond, abs(qdd) - own.acceleration))

    return excess
