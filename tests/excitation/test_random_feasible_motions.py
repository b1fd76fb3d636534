"""Random motions that keep constraints: large where joints have room, best first."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation.constraints import AbstractConstraint, Finding
from jaxid.excitation.design import minimise
from jaxid.excitation.problem import ExcitationProblem
from jaxid.excitation.random_feasible_motions import random_feasible_motions
from jaxid.trajectory.fourier import FourierBasis

BASIS = FourierBasis(3, 1.1)
ELBOW, ROOM = 0.3, 0.02


class NarrowElbow(AbstractConstraint):
    """The second joint stays near one angle, which few random poses have."""

    def __call__(self, robot, motion):
        return jnp.abs(motion.q[..., 1:] - ELBOW) / ROOM - 1.0

    def entries(self, robot):
        return (Finding("angle of the elbow", ROOM, "rad"),)


@pytest.fixture(scope="module")
def problem(base):
    constraints = (NarrowElbow(),)
    return ExcitationProblem(
        base, BASIS, constraints=constraints, noise=np.ones(2), samples=200
    )


@pytest.fixture(scope="module")
def motions(problem):
    return random_feasible_motions(problem, np.random.default_rng(0), 4)


def test_a_joint_without_room_does_not_stop_the_others(problem, motions):
    assert (motions.excess <= 0.0).all()
    times = np.linspace(0.0, BASIS.duration, 200)
    q = np.array([problem.trajectory(x).motion(times).q for x in motions.x])
    swing = np.ptp(q, axis=1)
    assert (swing[:, 0] > 0.5).all()
    assert (swing[:, 1] > 0.1 * ROOM).all()
    assert (np.abs(q[..., 1] - ELBOW) <= 1.01 * ROOM).all()


def test_the_best_come_first_and_a_seed_gives_the_same(problem, motions):
    assert (np.diff(motions.value) >= 0.0).all()
    again = random_feasible_motions(problem, np.random.default_rng(0), 4)
    np.testing.assert_array_equal(again.x, motions.x)


def test_without_time_a_design_is_as_good_as_the_best_random_motion(problem):
    key = jax.random.key(0)
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    best_value = random_feasible_motions(problem, random, 4).value[0]
    plan = minimise(problem, key=key, starts=4, generations=0, seconds=0.0)
    assert plan.feasible
    assert plan.history[-1] <= 1.05 * np.exp(best_value)
