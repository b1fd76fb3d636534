"""Children of motions: of which parents their joints are, and which of them are kept."""

import jax
import numpy as np
import pytest

from jaxid.excitation.constraints.tip import TipSpeed
from jaxid.excitation.criteria import DOptimal
from jaxid.excitation.judge import Judge
from jaxid.excitation.limits import JointLimits
from jaxid.excitation.offspring import Offspring
from jaxid.excitation.problem import Problem
from jaxid.excitation.search import random_starts
from jaxid.trajectory.fourier import FourierBasis

BASIS = FourierBasis(3, 1.1)


def problem_of(base, constraints=()):
    return Problem(
        base,
        JointLimits.of(base.model.robot, BASIS),
        DOptimal(),
        constraints,
        weights=np.ones(base.model.robot.joints),
        prior=np.zeros((base.size, base.size)),
        sizes=np.ones(base.size),
        measured=200,
    )


@pytest.fixture(scope="module")
def problem(base):
    return problem_of(base)


def test_when_a_motion_begins_and_which_way_it_runs_does_not_matter(problem):
    """What children rely on: all joints retimed together tell the same."""
    y = np.asarray(random_starts(problem.limits, jax.random.key(0), 1))[0]
    x = problem.limits.numbers(y)
    retimed = [problem.value(x @ T.T) for T in BASIS.retimings()[::9]]
    np.testing.assert_allclose(retimed, problem.value(x), atol=1e-9)


def test_each_joint_of_a_child_moves_as_in_a_parent(problem):
    y = np.asarray(random_starts(problem.limits, jax.random.key(1), 6))
    children = np.asarray(Offspring(problem)(y, jax.random.key(2)))
    own = problem.limits.numbers(y)
    foreign = 0
    for place, child in enumerate(problem.limits.numbers(children)):
        for joint, x in enumerate(child):
            if np.array_equal(x, own[place, joint]):
                continue
            foreign += 1
            others = np.delete(own[:, joint], place, axis=0)
            possible = np.einsum("rvw,ow->orv", BASIS.retimings(), others).reshape(-1, len(x))
            assert np.abs(possible - x).max(axis=1).min() < 1e-9 * np.abs(x).max()
    assert 6 <= foreign < own.shape[0] * own.shape[1]
    again = Offspring(problem)(y, jax.random.key(2))
    np.testing.assert_array_equal(again, children)
    # A joint's limits are its own affair: children keep them like their parents.
    assert (problem.limits.use(problem.limits.numbers(children[0]))[:3] < 1.01).all()


def test_the_most_promising_children_are_kept(problem, monkeypatch):
    y = np.asarray(random_starts(problem.limits, jax.random.key(3), 6))
    judge = Judge(problem)
    many = judge(Offspring(problem)(y, jax.random.key(4))).value
    monkeypatch.setattr("jaxid.excitation.offspring.TRIED", 1)
    firsts = [judge(Offspring(problem)(y, jax.random.key(k))).value for k in range(4)]
    assert np.mean(many) < min(np.mean(one) for one in firsts)


def test_constraints_count_among_children(base):
    limited = problem_of(base, (TipSpeed(1.5),))
    y = np.asarray(random_starts(limited.limits, jax.random.key(5), 6))
    slow = np.asarray(limited.worst(Offspring(limited)(y, jax.random.key(6))))
    free = np.asarray(limited.worst(Offspring(problem_of(base))(y, jax.random.key(6))))
    assert slow.mean() < free.mean() - 0.05


def test_a_single_motion_has_children_too(problem):
    y = np.asarray(random_starts(problem.limits, jax.random.key(7), 1))
    child = np.asarray(Offspring(problem)(y, jax.random.key(8)))
    assert child.shape == y.shape
    assert np.isfinite(child).all()
    assert not np.array_equal(child, y)
