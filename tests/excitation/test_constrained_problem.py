"""Constraints as a search sees them: numbers of a motion, at its peaks; and leads."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation.constraints import Clearance, ForceLimits, TipLimits
from jaxid.excitation.criteria import CRITERIA
from jaxid.excitation.criterion_gradient import value_and_gradient
from jaxid.excitation.design import minimise
from jaxid.excitation.feasible_candidates import evaluate, shrink_to_constraints
from jaxid.excitation.problem import (
    CHECKED_INSTANTS,
    COARSE_STEP,
    WATCHED_INSTANTS,
    ExcitationProblem,
)
from jaxid.excitation.watched_constraints import (
    PEAKS,
    count_watched,
    linearise,
    watch,
    watched_excess,
)
from jaxid.robot.collision import Capsule, CollisionModel, HalfSpace
from jaxid.trajectory.lead_in_and_out import LeadsBasis

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
    forces = ForceLimits(pendulum, np.linspace(0.5, 0.2, pendulum.size), margin=0.2)
    return forces, TipLimits(1.2), Clearance(shapes, distance=0.02)


@pytest.fixture(scope="module")
def problem(pendulum, constraints):
    return ExcitationProblem(
        pendulum, BASIS, constraints=constraints, noise=np.ones(1), samples=100
    )


def checked(problem, x):
    """All constraints of one motion at all checked instants."""
    return np.concatenate(problem.constraint_values(x), axis=1)


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_gradients_are_central_differences_with_and_without_a_compiler(
    pendulum, criterion
):
    one = ExcitationProblem(
        pendulum, BASIS, criterion=criterion, noise=np.ones(1), samples=100
    )
    x = one.limits.random(jax.random.key(2), 3)
    for sharpness in (None, 4.0):
        values, gradients = value_and_gradient(one, x, sharpness, 64)
        function = functools.partial(one.value, sharpness=sharpness, samples=64)
        expected = jax.vmap(jax.value_and_grad(function))(x)
        np.testing.assert_allclose(values, expected[0], rtol=1e-11)
        size = np.abs(expected[1]).max()
        np.testing.assert_allclose(gradients, expected[1], atol=1e-9 * size)
        quotients = np.zeros_like(gradients)
        for k, step in enumerate(1e-5 * np.eye(x.shape[1])):
            sides = [
                value_and_gradient(one, x + s * step, sharpness, 64) for s in (1, -1)
            ]
            quotients[:, k] = (sides[0][0] - sides[1][0]) / 2e-5
        np.testing.assert_allclose(gradients, quotients, atol=1e-6 * size)


def test_derivatives_are_central_differences(problem):
    x = np.asarray(problem.limits.random(jax.random.key(2), 2))
    watched = watch(problem, x)
    values, slopes = linearise(problem, x, watched)
    assert slopes.shape == (2, count_watched(problem), x.shape[1])
    assert values.shape[1] == (len(WATCHED_INSTANTS) + PEAKS) * 3
    h, quotients = 1e-5, np.zeros_like(slopes)
    for k, e in enumerate(h * np.eye(x.shape[1])):
        near, far = (
            [linearise(problem, x + s * m * e, watched)[0] for s in (1, -1)]
            for m in (1, 2)
        )
        quotients[..., k] = (8 * (near[0] - near[1]) - (far[0] - far[1])) / (12 * h)
    # A force that passes through zero within the difference has no derivative there.
    wrong = np.linalg.norm(slopes - quotients, axis=2) > 1e-6 * np.linalg.norm(
        slopes, axis=2
    )
    assert (wrong.sum(axis=1) <= 2).all()
    assert np.linalg.norm(slopes) > 1.0


def assert_forward_mode_is_reverse_mode(function, x):
    both = jax.jit(lambda x: (jax.jacfwd(function)(x), jax.jacrev(function)(x)))
    forward, reverse = both(x)
    np.testing.assert_allclose(forward, reverse, atol=1e-9 * np.abs(reverse).max())


@pytest.mark.parametrize("criterion", CRITERIA.values(), ids=CRITERIA)
def test_forward_mode_is_reverse_mode(pendulum, criterion):
    problem = ExcitationProblem(
        pendulum, BASIS, criterion=criterion, noise=np.ones(1), samples=100
    )
    x = problem.random(jax.random.key(3))
    assert_forward_mode_is_reverse_mode(problem.value, x)
    assert np.isfinite(jax.jit(jax.hessian(problem.value))(x)).all()


def test_forward_mode_is_reverse_mode_for_constraints(problem):
    x = problem.random(jax.random.key(3))
    assert_forward_mode_is_reverse_mode(problem.inequalities, x)


def test_the_highest_peaks_are_watched(problem):
    x = problem.limits.random(jax.random.key(4), 1)[0]
    values = checked(problem, x)
    assert values.shape == (CHECKED_INSTANTS, 3)
    (found,) = linearise(problem, x[None], watch(problem, x[None]))[0]
    found = found.reshape(3, -1).max(axis=1)
    np.testing.assert_allclose(found, values[::COARSE_STEP].max(axis=0), atol=1e-9)
    at_watched_instants = values[WATCHED_INSTANTS].max()
    assert watched_excess(problem, x[None])[0] == pytest.approx(
        at_watched_instants, abs=1e-9
    )


def test_peaks_between_the_checked_instants_count(problem, pendulum):
    x = problem.random(jax.random.key(5))
    motion = problem.trajectory(x).motion(
        np.linspace(0.0, BASIS.duration, 20 * CHECKED_INSTANTS)
    )
    robot = pendulum.model.robot
    finer = jax.jit(lambda m: [c(robot, m) for c in problem.constraints])(motion)
    finer = np.concatenate([np.asarray(values).max(axis=0) for values in finer])
    found = np.array([f.value for f in problem.findings(x)])
    assert (found >= checked(problem, x).max(axis=0)).all()
    np.testing.assert_allclose(found, finer, atol=2e-7)
    assert problem.excess(x) == pytest.approx(found.max(), abs=1e-6)
    assert float(problem.violation(x)) == pytest.approx(found.max(), abs=1e-9)


def test_a_motion_is_made_as_small_as_its_constraints_need(problem):
    x = problem.random(jax.random.key(6))
    assert problem.excess(x) > 0.02
    small = shrink_to_constraints(problem, x)
    assert small.excess[0] <= 0.0
    rows = BASIS.rows(BASIS.instants(50))[0]
    size, whole = (
        np.ptp(problem.limits.coefficients(np.asarray(y)) @ rows.T)
        for y in (small.x[0], x)
    )
    larger = problem.limits.grid().shrink(x, float(1.01 * size / whole))
    assert evaluate(problem, larger[None]).excess[0] > 0.0


def test_limits_of_force_are_those_that_were_given(problem, pendulum, constraints):
    weak = dataclasses.replace(pendulum.model.robot.limits, force=np.array([1.0]))
    given = ExcitationProblem(
        pendulum,
        BASIS,
        weak,
        constraints=constraints[:1],
        noise=np.ones(1),
        samples=100,
    )
    x = problem.random(jax.random.key(7))
    # The robot's own limit of force is 9.
    highest = checked(problem, x)[:, 0].max() + 1.0
    np.testing.assert_allclose(
        checked(given, x)[:, 0].max() + 1.0, 9.0 * highest, rtol=1e-6
    )


def test_a_design_with_leads_keeps_all_constraints(
    problem, constraints, shapes, excess, monkeypatch
):
    for stages in (
        "SCHEDULE",
        "CONSTRAINED_SCHEDULE",
    ):  # the last stage alone has all to keep as well
        monkeypatch.setattr(f"jaxid.excitation.search.{stages}", ())
    plan = minimise(problem, starts=2, generations=0)
    assert plan.feasible
    assert excess(plan) <= 0.0
    robot, end = problem.base.model.robot, float(plan.trajectory.duration)
    motion = plan.trajectory.motion(np.linspace(0.0, end, 8000))

    @jax.jit
    def judged(m):
        return [jnp.max(c(robot, m)) for c in constraints], shapes.clearance(robot, m.q)

    values, clearance = judged(motion)
    assert -0.05 < max(map(float, values)) <= 0.0, "something binds"
    assert float(np.min(clearance)) >= 0.02
    ends = plan.trajectory.motion(np.array([0.0, end]))
    np.testing.assert_allclose(ends.qd, 0.0, atol=1e-12)
    np.testing.assert_allclose(ends.qdd, 0.0, atol=1e-12)
