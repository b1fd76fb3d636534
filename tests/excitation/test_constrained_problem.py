"""Constraints as a search sees them: by a motion's numbers, at its peaks; and with leads."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation.constraints.clearance import Clearance
from jaxid.excitation.constraints.forces import JointForces, NominalForces
from jaxid.excitation.constraints.tip import TipSpeed
from jaxid.excitation.criteria import ConditionNumber, DOptimal
from jaxid.excitation.design import design_excitation
from jaxid.excitation.judge import PRICE, Best, Judge
from jaxid.excitation.limits import CERTIFIED, JointLimits, calmed
from jaxid.excitation.problem import CHECKED, MARGIN, PEAKS, WATCHED, Context, Problem
from jaxid.excitation.search import random_starts
from jaxid.robot.collision import Capsule, CollisionModel, HalfSpace
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.leads import LeadsBasis

BASIS = LeadsBasis(3, 1.1, lead=0.4)


@pytest.fixture(scope="module")
def shapes(pendulum):
    return CollisionModel(
        pendulum.model.robot,
        (Capsule("hand", 0, start=(0.2, 0, 0), end=(1.0, 0, 0), radius=0.05),),
        (HalfSpace("wall", normal=(1.0, 0.0, 0.0), height=-0.3),),
        (("hand", "wall"),),
    )


@pytest.fixture(scope="module")
def constraints(pendulum, shapes):
    nominal = NominalForces.of(pendulum, np.linspace(0.5, 0.2, pendulum.size))
    return JointForces(nominal, margin=0.2), TipSpeed(1.2), Clearance(shapes, distance=0.02)


@pytest.fixture(scope="module")
def problem(pendulum, constraints):
    limits = JointLimits.of(pendulum.model.robot, BASIS)
    return Problem(
        pendulum,
        limits,
        DOptimal(),
        constraints,
        weights=np.ones(1),
        prior=np.zeros((pendulum.size, pendulum.size)),
        sizes=np.ones(pendulum.size),
        measured=100,
    )


def test_derivatives_by_numbers_are_central_differences(problem):
    y = np.asarray(random_starts(problem.limits, jax.random.key(2), 1))
    context = Context(None, problem.peaks(y))
    evaluate = jax.jit(problem.evaluation())
    slopes = np.asarray(evaluate(y, context).slopes)[0]
    assert slopes.shape == (problem.conditions, y.shape[1])
    assert problem.conditions == (WATCHED + PEAKS) * 3
    h, quotients = 1e-5, np.zeros_like(slopes)
    for k in range(y.shape[1]):
        e = np.zeros_like(y)
        e[0, k] = h
        near, far = (
            [np.asarray(evaluate(y + s * m * e, context).excess)[0] for s in (1, -1)]
            for m in (1, 2)
        )
        quotients[:, k] = (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * h)
    # A force that passes through zero within the difference has no derivative there.
    wrong = np.linalg.norm(slopes - quotients, axis=1) > 1e-6 * np.linalg.norm(slopes, axis=1)
    assert wrong.sum() <= 2
    assert np.linalg.norm(slopes) > 1.0


def test_the_highest_peaks_are_watched(problem):
    y = np.asarray(random_starts(problem.limits, jax.random.key(4), 2))
    watched = np.asarray(problem.peaks(y))
    for one, instants in zip(y, watched, strict=True):
        values = problem.checked(one)
        assert values.shape == (CHECKED, 3)
        np.testing.assert_array_equal(values[instants].max(axis=0), values.max(axis=0))
    evaluate = jax.jit(problem.evaluation())
    seen = np.asarray(evaluate(y, Context(None, watched)).excess) - MARGIN
    highest = [problem.checked(one).max() for one in y]
    np.testing.assert_allclose(seen.max(axis=1), highest, atol=1e-9)


def test_peaks_between_the_checked_instants_count(problem):
    y = np.asarray(random_starts(problem.limits, jax.random.key(5), 1))[0]
    x = np.asarray(problem.limits.numbers(y))
    duration = problem.basis.duration
    motion = problem.basis.trajectory(x).motion(np.linspace(0.0, duration, 20 * CHECKED))
    finer = np.concatenate(
        [np.asarray(c(problem.robot, motion)).max(axis=0) for c in problem.constraints]
    )
    found = np.array([f.value for f in problem.findings(x)])
    checked = problem.checked(y).max(axis=0)
    assert (found >= checked).all()
    np.testing.assert_allclose(found, finer, atol=2e-7)
    assert problem.excess(x) == found.max()


def test_a_motion_is_made_as_small_as_its_constraints_need(problem):
    judge = Judge(problem)
    y = np.asarray(random_starts(problem.limits, jax.random.key(6), 1))
    assert judge(y).excess[0] > 0.02
    small = judge.shrunk(y[0])
    assert small.excess[0] <= 0.0
    size = np.ptp(problem.limits.numbers(small.y[0]) @ BASIS.rows(BASIS.instants(50))[0].T)
    whole = np.ptp(problem.limits.numbers(y[0]) @ BASIS.rows(BASIS.instants(50))[0].T)
    fine = problem.limits.grid(CERTIFIED)
    larger = calmed(fine, problem.limits.still, jnp.asarray(y[0]), float(1.01 * size / whole))
    assert judge(np.asarray(larger)[None]).excess[0] > 0.0


def test_a_small_excess_does_not_outweigh_a_better_value():
    best = Best(np.zeros((3, 1)), np.array([-1.0, -1.5, -1.6]), np.array([-0.1, 0.01, 1.0]))
    assert list(best.order()) == [0, 1, 2]
    assert list(best.promising()) == [1, 0, 2]
    assert 0.01 * PRICE < 0.5


def test_the_best_of_two_generations_live_on_and_none_twice():
    parents = Best(np.arange(3.0)[:, None], np.array([-1.0, -2.0, -3.0]), np.array([-1.0, -1, 0.2]))
    children = Best(
        np.arange(10.0, 13.0)[:, None], np.array([-2.0, -1.5, np.inf]), np.array([-1.0, -1, np.inf])
    )
    best = parents.survivors(children)
    assert list(best.y[:, 0]) == [1.0, 11.0, 0.0]
    assert list(best.value) == [-2.0, -1.5, -1.0]
    assert list(parents.survivors(parents).y[:, 0]) == [1.0, 0.0, 2.0]


def test_a_motion_is_enlarged_to_its_limits_only_where_that_is_better(pendulum):
    """A condition number may well become worse: what a polished motion gained would be lost."""
    for criterion in (ConditionNumber(), DOptimal()):
        free = Problem(
            pendulum,
            JointLimits.of(pendulum.model.robot, FourierBasis(3, 1.1)),
            criterion,
            (),
            weights=np.ones(1),
            prior=np.zeros((pendulum.size, pendulum.size)),
            sizes=np.ones(pendulum.size),
            measured=100,
        )
        y = 0.97 * np.asarray(random_starts(free.limits, jax.random.key(8), 20))
        judge = Judge(free)
        as_they_are, within = judge(y), judge.within(y)
        assert (within.value <= as_they_are.value + 1e-9).all()
        larger = np.abs(within.y).max(axis=1) > 1.02 * np.abs(y).max(axis=1)
        assert larger.any()
        assert not larger.all()


def test_limits_of_force_are_those_that_were_given(problem, pendulum, constraints):
    weak = dataclasses.replace(pendulum.model.robot.limits, force=np.array([1.0]))
    given = Problem(
        pendulum,
        JointLimits.of(pendulum.model.robot, BASIS, weak),
        DOptimal(),
        constraints[:1],
        weights=np.ones(1),
        prior=np.zeros((pendulum.size, pendulum.size)),
        sizes=np.ones(pendulum.size),
        measured=100,
    )
    y = np.asarray(random_starts(problem.limits, jax.random.key(7), 1))[0]
    # The robot's own limit of force is 9.
    highest = problem.checked(y)[:, 0].max() + 1.0
    np.testing.assert_allclose(given.checked(y)[:, 0].max() + 1.0, 9.0 * highest, rtol=1e-6)


def test_motions_of_many_numbers_are_seen_as_well_as_those_of_few(pendulum):
    limits = [JointLimits.of(pendulum.model.robot, FourierBasis(n, 0.5)) for n in (5, 31)]
    assert [x.grid(64).kinds[0].stop for x in limits] == [64, 366]
    assert all(x.grid(64).bound > 0.96 for x in limits)


def test_a_design_with_leads_keeps_all_constraints_in_them_too(pendulum, constraints, shapes):
    robot = pendulum.model.robot
    plan = design_excitation(
        pendulum,
        basis=BASIS,
        constraints=constraints,
        starts=3,
        generations=2,
        polish=0,
        samples=100,
    )
    assert plan.feasible
    t = np.linspace(0.0, float(plan.trajectory.duration), 8000)
    motion = plan.trajectory.motion(t)
    assert max(float(np.max(c(robot, motion))) for c in constraints) <= 0.0
    assert float(np.min(shapes.clearance(robot, motion.q))) >= 0.02
    lim = robot.limits
    assert np.all(np.asarray(motion.q) <= lim.position_max)
    assert np.all(np.asarray(motion.q) >= lim.position_min)
    assert np.all(np.abs(motion.qd) <= lim.velocity)
    assert np.all(np.abs(motion.qdd) <= lim.acceleration)
    values = [f.value for f in plan.findings]
    assert max(values) > -0.05, "something binds"
    ends = plan.trajectory.motion(np.array([0.0, float(plan.trajectory.duration)]))
    np.testing.assert_allclose(ends.qd, 0.0, atol=1e-12)
    np.testing.assert_allclose(ends.qdd, 0.0, atol=1e-12)
