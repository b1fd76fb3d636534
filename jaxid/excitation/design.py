"""Designs the motion of an experiment (Eq. 36)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, PRNGKeyArray, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.excitation.constraints.constraint import AbstractConstraint
from jaxid.excitation.criteria import AbstractCriterion, DOptimal
from jaxid.excitation.judge import Best
from jaxid.excitation.limits import JointLimits
from jaxid.excitation.plan import ExcitationPlan
from jaxid.excitation.polish import Polish
from jaxid.excitation.problem import Problem
from jaxid.excitation.search import Search, Searched, random_starts
from jaxid.excitation.state import fingerprint, load_state, save_state
from jaxid.robot.limits import Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.basis import AbstractBasis
from jaxid.trajectory.fourier import FourierBasis

NOISE = 0.01
"""Standard deviation of the noise that is assumed, as a share of the largest forces."""
REFERENCES = 8
"""Random motions that give the parameters their sizes."""


class DesignProgress(NamedTuple):
    """How far a design is.

    Attributes:
        share: Done, of 1.
        doing: What comes next, in words.
        best: Value of the criterion for the best motion so far that keeps all limits, or of the
            best in all if none does.
        feasible: Whether it keeps all limits.
    """

    share: float
    doing: str
    best: float
    feasible: bool


class _State(NamedTuple):
    """Everything that a design has done so far."""

    searched: Searched
    order: np.ndarray
    polished: int
    best: Best


def design_excitation(
    base: BaseParameters,
    *,
    limits: Limits | None = None,
    harmonics: int = 5,
    omega: float = 0.8,
    basis: AbstractBasis | None = None,
    criterion: AbstractCriterion | None = None,
    constraints: tuple[AbstractConstraint, ...] = (),
    starts: int = 32,
    generations: int = 12,
    polish: int = 4,
    key: PRNGKeyArray | None = None,
    noise: Float[AnyArray, " joints"] | None = None,
    prior: Float[AnyArray, "base base"] | None = None,
    nominal: Float[AnyArray, " base"] | None = None,
    samples: int = 800,
    progress: Callable[[DesignProgress], None] | None = None,
    state: str | Path | None = None,
    resume: bool = False,
    throw: bool = True,
) -> ExcitationPlan:
    r"""Finds the motion that determines the base parameters best within all limits (Eq. 36).

    Many random starts are improved at once by an interior point method that is JAX from end to end,
    and so are their descendants, which move some joints as one parent does and some as the other;
    the best of them are polished one by one. Joint limits hold for all times, not only at samples.
    Ctrl-C ends the design with the best motion so far. The same key gives the same motion.

    Args:
        base: Whose parameters the motion shall determine.
        limits: Of the joints, and of their forces for constraints that keep those; the robot's own
            if None. What is unknown is assumed as in
            `random_fourier_series`.
        harmonics: Number of harmonics of the Fourier series.
        omega: Its ground frequency [rad/s].
        basis: Trajectories to choose from, in place of Fourier series: for instance
            `RestToRestBasis`. `harmonics` and `omega` are not used then.
        criterion: What is made small; D-optimality if None.
        constraints: What must be kept beside the joints' limits.
        starts: Random motions to start from.
        generations: How often the motions found have children, of which the best live on.
        polish: How many of the best are polished; 0 for the path that is JAX alone.
        key: Of the random motions; `jax.random.key(0)` if None.
        noise: Standard deviation of each joint's force noise [N m or N]; 1 % of the largest forces
            if None. The weights of the criterion are its inverse, like the estimator's.
        prior: Information of earlier experiments in the same noise, the inverse of their
            covariance: the design adds to it.
        nominal: Base parameters as far as they are known, NaN where not, for relative deviations.
        samples: Measured samples of one run of the motion.
        progress: Is told after each step how far the design is.
        state: File in which the design keeps its state, so that it can be resumed.
        resume: Goes on from the state file if there is one.
        throw: Whether a design that finds no feasible motion is an error; otherwise the plan says
            which limits are not kept.

    Raises:
        InputError: If arguments do not fit, or no motion keeps all constraints: the message says
            which limit is exceeded, and by how much.
        KeyboardInterrupt: If Ctrl-C came before a motion kept all constraints.
        RuntimeError: If JAX runs in single precision.
    """
    require_float64("designing a motion")
    criterion = DOptimal() if criterion is None else criterion
    basis = FourierBasis(harmonics, omega) if basis is None else basis
    key = jax.random.key(0) if key is None else key
    _check(base, criterion, starts, generations, polish, samples, prior)
    robot = base.model.robot
    noise = assumed_noise(robot) if noise is None else np.asarray(noise, float)
    if noise.shape != (robot.joints,) or not (noise > 0).all():
        raise InputError(
            f"`noise` must hold one positive number for each joint ({robot.joints}), "
            f"but is {noise}."
        )
    problem = Problem(
        base,
        JointLimits.of(robot, basis, limits),
        criterion,
        tuple(constraints),
        weights=1.0 / noise,
        prior=np.zeros((base.size, base.size)) if prior is None else np.asarray(prior),
        sizes=np.ones(base.size),
        measured=samples,
    )
    problem.sizes = _sizes(problem)
    path = None if state is None else Path(state)
    design = _Design(problem, starts, generations, polish, key, progress, path)
    found, interrupted = design.run(resume)
    plan = _plan(problem, found, key, starts, noise, nominal, interrupted)
    if throw and not plan.feasible:
        unkept = "; ".join(plan.diagnosis)
        if interrupted:
            raise KeyboardInterrupt(f"stopped before a motion kept all limits: {unkept}")
        if path is not None:
            # The design is done: to go on with it would end in the same place.
            path.unlink(missing_ok=True)
        raise InputError(f"no motion was found that keeps all limits: {unkept}")
    return plan


def assumed_noise(robot: Robot) -> Float[np.ndarray, " joints"]:
    """Standard deviations of the forces' noise where none are given [N m or N].

    Args:
        robot: With its largest forces.
    """
    return NOISE * np.asarray(robot.max_forces)


def _check(base, criterion, starts, generations, polish, samples, prior) -> None:
    for name, value, least in (
        ("starts", starts, 1),
        ("generations", generations, 0),
        ("polish", polish, 0),
        ("samples", samples, 2),
    ):
        if value < least:
            raise InputError(f"`{name}` must be at least {least}, but is {value}.")
    if prior is not None and np.shape(prior) != (base.size, base.size):
        raise InputError(
            f"`prior` must be a matrix of the {base.size} base parameters, but has shape "
            f"{np.shape(prior)}."
        )
    if prior is not None and not criterion.weighted:
        raise InputError(
            f"`prior` is in units of the noise, which the {criterion.name} does not know: choose "
            "a weighted criterion."
        )


_last: list[tuple[Any, Search, Polish]] = []


def _tools(problem: Problem, starts: int, generations: int, digest: str) -> tuple[Search, Polish]:
    """What solves a problem; the last ones are kept, for designs that differ in their keys only."""
    parts = problem.base, problem.limits, problem.criterion, problem.constraints
    identity = digest, jax.tree.structure(parts)
    if not _last or _last[0][0] != identity:
        _last[:] = [(identity, Search(problem, starts, generations), Polish(problem))]
    return _last[0][1:]


class _Design:
    """The steps of a design, one after the other."""

    def __init__(self, problem, starts, generations, polish, key, progress, path):
        self._progress, self._path, self._key = progress, path, key
        self._polished = min(polish, starts)
        p = problem
        self._digest = fingerprint(
            (p.base, p.limits, p.criterion, p.constraints, p.weights, p.prior),
            [type(x).__name__ for x in (p.criterion, p.basis, *p.constraints)],
            (repr(p.basis), p.measured, starts, generations),
        )
        self._search, self._polish = _tools(problem, starts, generations, self._digest)
        self._problem = self._search.problem

    def run(self, resume: bool) -> tuple[_State, bool]:
        """All steps; the last state, and whether Ctrl-C has ended them."""
        digest = fingerprint(self._digest, self._polished, jax.random.key_data(self._key))
        searched = self._search.begin(self._key)
        state = _State(searched, searched.best.promising(), 0, searched.best)
        if resume and self._path is not None and self._path.is_file():
            state = load_state(self._path, digest, state)
            state = jax.tree.map(np.asarray, state)
        total = self._search.legs + 4 * self._polished
        try:
            self._tell(state, total)
            while (step := self._next(state)) is not None:
                state = step
                if self._path is not None:
                    save_state(self._path, digest, state)
                self._tell(state, total)
        except KeyboardInterrupt:
            return self._kept(state), True
        return self._kept(state), False

    def _kept(self, state: _State) -> _State:
        """With smaller motions where no other keeps all constraints."""
        if (np.asarray(state.best.excess) <= 0.0).any():
            return state
        best = state.best
        for place, y in enumerate(np.asarray(best.y)):
            best = best.improved_at(place, self._search.judge.shrunk(y))
        return state._replace(best=best)

    def _next(self, state: _State) -> _State | None:
        if int(state.searched.leg) < self._search.legs:
            searched = self._search.advance(state.searched, self._key)
            return _State(searched, searched.best.promising(), 0, searched.best)
        done = int(state.polished)
        if done >= self._polished:
            return None
        place = int(state.order[done])
        start = np.asarray(state.searched.best.y[place])
        best = state.best.improved_at(place, self._polish(start))
        return state._replace(polished=done + 1, best=best)

    def _tell(self, state: _State, total: int) -> None:
        if self._progress is None:
            return
        done = int(state.searched.leg) + 4 * int(state.polished)
        first = int(state.best.order()[0])
        searching = int(state.searched.leg) < self._search.legs
        self._progress(
            DesignProgress(
                done / total,
                "searching from many starts" if searching else "polishing the best",
                float(np.exp(state.best.value[first])),
                bool(state.best.excess[first] <= 0.0),
            )
        )


def _sizes(problem: Problem) -> np.ndarray:
    """The deviation of each parameter in random motions if it were the only unknown one."""
    random = _numbers(problem, random_starts(problem.limits, jax.random.key(0), REFERENCES))
    squares = np.mean([np.diag(problem.information(x).weighted) for x in random], axis=0)
    return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))


def _numbers(problem: Problem, y: Float[AnyArray, "starts scaled"]) -> list[np.ndarray]:
    return [np.asarray(problem.limits.numbers(np.asarray(one))) for one in y]


def _plan(problem, state: _State, key, starts, noise, nominal, interrupted) -> ExcitationPlan:
    first = int(state.best.order()[0])
    (x,) = _numbers(problem, state.best.y[first][None])
    middle = int(np.argsort(np.asarray(state.searched.first))[starts // 2])
    random = _numbers(problem, random_starts(problem.limits, key, starts))[middle]
    return ExcitationPlan(
        base=problem.base,
        trajectory=problem.basis.trajectory(x),
        criterion=problem.criterion,
        limits=problem.limits,
        numbers=x,
        information=problem.information(x),
        reference=problem.information(random),
        noise=noise,
        samples=problem.measured,
        findings=tuple(problem.findings(x)),
        nominal=None if nominal is None else np.asarray(nominal),
        interrupted=interrupted,
    )
