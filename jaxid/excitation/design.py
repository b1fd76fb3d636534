"""Design of the motion of an experiment (Eq. 36)."""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray, PRNGKeyArray, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.trajectory import AbstractBasis, LinearTrajectory

from .coefficient_limits import ScaledMotions
from .compiled_search import compiled_search, plan_parts
from .constraints import AbstractConstraint
from .criteria import AbstractCriterion
from .criteria.information_matrix import BaseMatrix, JointVector
from .design_on_feet import DesignOnFeet, design_on_feet
from .design_result import (
    DesignProgress,
    DesignStatus,
    ExcitationPlan,
    progress_status,
)
from .feasible_candidates import (
    Candidates,
    criterion_values,
    evaluate,
    evaluate_within_limits,
    shrink_to_constraints,
)
from .motions_on_feet import Standing
from .problem import ExcitationProblem
from .random_feasible_motions import random_feasible_motions
from .search import count_steps, search

Solver = Callable[[ExcitationProblem, ScaledMotions], AnyArray]
"""A solver of excitation problems: from random motions to better ones."""


SEARCH_SHARE = 0.65
"""Share of a limited time after which only the limits are kept more closely."""
MIN_DURATION = 1e-3
"""Duration of a search whose time was over before it began [s]."""
MAX_SHRUNK = 4
"""Motions that are made smaller where none keeps all constraints."""


def design_excitation(
    base: BaseParameters,
    *,
    limits: Limits | None = None,
    harmonics: int = 5,
    omega: float = 0.8,
    basis: AbstractBasis | None = None,
    criterion: AbstractCriterion | None = None,
    constraints: tuple[AbstractConstraint, ...] = (),
    noise: JointVector | None = None,
    prior: BaseMatrix | None = None,
    samples: int = 800,
    seconds: float | None = None,
    standing: Standing | None = None,
    **settings: Any,
) -> ExcitationPlan:
    r"""Find the motion that determines base parameters best within limits (Eq. 36).

    The problem is an `ExcitationProblem`, which `minimise` solves: that names further
    settings. A robot on its feet has other motions (`MotionOnFeet`): it moves its trunk
    and lifts one foot after another. The limits of the joints hold for all times, not
    only at samples. The same
    key gives the same motion.

    Args:
        base: Base parameters to be determined.
        limits: Limits of the joints, and of their forces for constraints that keep
            those; the robot's if None. Unknown limits are assumed as in
            `random_fourier_series`.
        harmonics: Number of harmonics of the Fourier series.
        omega: Fundamental frequency of the series [rad/s].
        basis: Family of trajectories in place of Fourier series: for instance
            `RestToRestBasis`.
        criterion: Criterion to be minimised; D-optimality if None.
        constraints: Constraints beside the limits of the joints.
        noise: Standard deviation of each joint's force noise [N m or N]; 1 % of the
            largest forces if None. Its inverse weights the criterion, like the
            estimator.
        prior: Information of earlier experiments in the same noise, the inverse of
            their covariance; the design adds to it.
        samples: Number of measured samples of one run of the motion.
        seconds: Time after which the best motion so far is returned, counted from this
            call, with all that is compiled [s]; None for all steps.
        standing: How a robot on its feet stands, and what keeps it from falling.
        settings: Arguments of `minimise`: `solver`, `starts`, `generations`, `key`,
            `progress`, `begin`, `throw`. Those of a robot on its feet are `starts`,
            `generations`, `key`, `progress` and `begin`.

    Raises:
        InputError: If arguments do not fit, or no motion keeps all constraints: the
            message says which limit is exceeded, and by how much.
        KeyboardInterrupt: If Ctrl-C came before a motion kept all constraints.
        RuntimeError: If JAX runs in single precision.
    """
    start_time = time.monotonic()
    if base.model.robot.floating:
        require_float64("designing a motion")
        if standing is None or basis is not None:
            raise InputError(
                f"`{base.model.robot.name}` stands on its feet: its motion needs "
                "`standing` (`jid.excitation.Standing`), with nominal parameters, and "
                "no `basis`."
            )
        limits_and_noise = (limits, criterion, constraints, noise, prior, samples)
        design = DesignOnFeet(base, standing, harmonics, omega, *limits_and_noise)
        if seconds is not None:
            seconds -= time.monotonic() - start_time
        return design_on_feet(design, seconds=seconds, **settings)
    basis = FourierBasis(harmonics, omega) if basis is None else basis
    problem = ExcitationProblem(
        base,
        basis,
        limits,
        criterion,
        constraints,
        noise=noise,
        prior=prior,
        samples=samples,
    )
    if seconds is not None:
        seconds -= time.monotonic() - start_time
    return minimise(problem, seconds=seconds, **settings)


def minimise(
    problem: ExcitationProblem,
    solver: Solver | None = None,
    *,
    starts: int = 32,
    generations: int = 12,
    key: PRNGKeyArray | None = None,
    progress: Callable[[DesignProgress], None] | None = None,
    begin: LinearTrajectory | None = None,
    seconds: float | None = None,
    throw: bool = True,
) -> ExcitationPlan:
    """Solve an excitation problem from many starts.

    Random motions are improved together by an interior point method, and so are their
    descendants, which move some joints as one parent and some as the other. With
    constraints the search starts from small motions that keep them, so that there is a
    result after seconds. Ctrl-C ends the design with the best motion so far.

    Args:
        problem: Problem to be solved.
        solver: Another solver: a function of the problem and of random motions [starts,
            scaled] that returns better motions. What comes out is made to keep the
            limits of the joints for all times, and the best motion is taken. By
            default the search runs in NumPy on a CPU, and as one program of JAX
            (`CompiledSearch`) where JAX has a GPU.
        starts: Number of random motions to start from.
        generations: Number of generations.
        key: Key of the random motions; `jax.random.key(0)` if None.
        progress: Callback, called with the progress after each step.
        begin: Motion of the same basis in place of the first random one, to go on with.
        seconds: Time after which the best motion so far is returned [s]; None for all
            steps.
        throw: Whether to raise an error if no feasible motion is found; otherwise the
            plan says which limits are not kept.

    Raises:
        InputError: If a number is too small, or no motion keeps all constraints.
        KeyboardInterrupt: If Ctrl-C came before a motion kept all constraints.
    """
    for name, value, minimum in (
        ("starts", starts, 1),
        ("generations", generations, 0),
    ):
        if value < minimum:
            raise InputError(f"`{name}` must be at least {minimum}, but is {value}.")
    if begin is not None and begin.coefficients.shape != problem.limits.shape:
        raise InputError("`begin` must be a motion of the problem's basis.")
    start_time = time.monotonic()
    key = jax.random.key(0) if key is None else key
    random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    if problem.constraints:
        x = random_feasible_motions(problem, random, starts).x
    else:
        x = problem.limits.random(key, starts)
    values = criterion_values(problem, x)
    median_motion = x[np.argsort(values)[starts // 2]]
    if solver is None:
        duration = math.inf if seconds is None else max(seconds, MIN_DURATION)
        clock = Clock(start_time, duration)
        outcome = _run_search(problem, x, begin, generations, random, clock, progress)
    else:
        outcome = _run_solver(problem, x, solver)
    motion = outcome.candidates.best_motion
    plan = ExcitationPlan(
        base=problem.base,
        trajectory=problem.trajectory(motion),
        criterion=problem.criterion,
        limits=problem.limits.limits,
        assumed=problem.limits.assumed,
        use=problem.limits.use(problem.limits.coefficients(motion)),
        information=problem.information(motion),
        reference=problem.information(median_motion),
        noise=problem.noise,
        samples=problem.samples,
        findings=tuple(problem.findings(motion)),
        status=outcome.status,
        history=np.asarray(outcome.history),
    )
    if throw and not plan.feasible:
        excess = "; ".join(plan.diagnosis)
        if plan.interrupted:
            raise KeyboardInterrupt(
                f"stopped before a motion kept all limits: {excess}"
            )
        raise InputError(f"no motion was found that keeps all limits: {excess}")
    return plan


class Clock(NamedTuple):
    """Time of a search."""

    start_time: float  # time of `time.monotonic` [s]
    duration: float  # time after which it ends; infinite for all steps [s]


class Outcome(NamedTuple):
    """Result of a search or of another solver."""

    candidates: Candidates
    history: list[float]  # value of the criterion of the best motion after each step
    status: DesignStatus


def _run_solver(
    problem: ExcitationProblem,
    x: ScaledMotions,
    solver: Solver,
):
    """Improve motions by a solver, then make them keep the limits of the joints."""
    candidates = evaluate_within_limits(problem, np.asarray(solver(problem, x)))
    history = [evaluate(problem, x).best_value, candidates.best_value]
    return Outcome(candidates, history, DesignStatus.GIVEN)


def _run_search(
    problem: ExcitationProblem,
    x: ScaledMotions,
    begin: LinearTrajectory | None,
    generations: int,
    random: np.random.Generator,
    clock: Clock,
    progress: Callable[[DesignProgress], None] | None,
):
    """Do all steps of a search, or those until the time is over or Ctrl-C."""
    deadline = clock.start_time + SEARCH_SHARE * clock.duration
    if begin is not None:
        x[0] = problem.limits.scaled(begin.coefficients)
    # With constraints the search looks for one motion that keeps them first.
    candidates = evaluate_within_limits(problem, x[:1] if problem.constraints else x)
    run = search
    steps = count_steps(problem, len(x), generations)
    if jax.default_backend() == "gpu":
        run = compiled_search
        steps = len(plan_parts(problem, generations).origin)
    history = []
    try:
        for step in run(problem, x, candidates, generations, random, deadline):
            candidates = step.candidates
            history.append(candidates.best_value)
            elapsed_time = time.monotonic() - clock.start_time
            if progress is not None:
                fraction = (len(history) - 1) / steps
                if math.isfinite(clock.duration):
                    fraction = elapsed_time / clock.duration
                fraction = min(fraction, 1.0)
                trajectory = problem.trajectory(candidates.best_motion)
                value = candidates.best_value
                progress(
                    DesignProgress(
                        fraction,
                        step.task,
                        value,
                        candidates.is_feasible,
                        trajectory,
                    )
                )
            if elapsed_time > clock.duration and candidates.is_feasible:
                break
    except KeyboardInterrupt:
        return Outcome(candidates, history, DesignStatus.STOPPED)
    if not candidates.is_feasible:
        for place in candidates.order()[:MAX_SHRUNK]:
            smaller_motion = shrink_to_constraints(problem, candidates.x[place])
            candidates = candidates.improved(np.array([place]), smaller_motion)
    return Outcome(candidates, history, progress_status(history))
