"""Design problem: criterion, limits and constraints as functions of one vector; its candidates."""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Float,
    Int,
    PRNGKeyArray,
    namespace,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.program.gradient import pull_back
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.trajectory import AbstractBasis, LinearTrajectory

from . import criteria
from .coefficient_limits import JointLimits, scale_samples
from .constraints import AbstractConstraint, Finding
from .criteria import AbstractCriterion, Information, Sharpness
from .interior_point import Evaluation

CHECKED = 8160
"""Instants at which constraints are checked."""
EVERY = 8
"""Instants from one to the next at which peaks are looked for during a search."""
WATCHED = np.arange(0, CHECKED, CHECKED // 48)
"""Equidistant instants at which the worst value of each constraint is watched in a search."""
PEAKS = 48
"""Further watched values of each constraint: its highest peaks."""
MARGIN = 1e-3
"""Relative distance that is kept from constraints, for what happens between instants."""
PENALTY = 3.0
"""Penalty of a relative excess beside the criterion's logarithm, where it is to be improved."""
NEAR = 0.1
"""Relative excess from which a motion is not made smaller until it keeps its constraints."""
SURE = 0.02
"""Relative distance from all limits from which fewer instants tell that they are kept."""
SEARCHED = 64
"""Samples on which motions with few coefficients are evaluated during a search."""


Watched = Sequence[tuple[Int[np.ndarray, " values"], Int[np.ndarray, " values"]]]
"""Instants and entries of the watched values of each constraint."""


class ExcitationProblem:
    """The problem of finding a motion that determines the base parameters well (Eq. 36).

    Its unknown is one vector x of scaled coefficients: each of them alone meets a limit
    of its joint near one. `value`, `inequalities` and `violation` are functions of x
    that run under `jit`, `vmap` and `grad`, so that any solver can be put around them.

    Args:
        base: Base parameters to be determined.
        basis: Family of trajectories; Fourier series of five harmonics at 0.8 rad/s if
            None.
        limits: Limits of the joints, and of their forces for constraints that keep
            those; the robot's if None. Unknown limits are assumed as in
            `random_fourier_series`.
        criterion: Criterion to be minimised; D-optimality if None.
        constraints: Constraints beside the limits of the joints.
        noise: Standard deviation of each joint's force noise [N m or N]; 1 % of the
            largest forces if None. Its inverse weights the criterion, like the
            estimator.
        prior: Information of earlier experiments in the same noise, the inverse of
            their covariance; the design adds to it.
        samples: Number of measured samples of one run.

    Attributes:
        limits: Limits of the joints on the trajectories of the basis.
        robot: Robot with the limits that constraints ask it for.
        sizes: Typical sizes of the base parameters: the standard deviation of each in
            random motions if it were the only unknown one.

    Raises:
        InputError: If arguments do not fit.
        RuntimeError: If JAX runs in single precision.
    """

    def __init__(
        self,
        base: BaseParameters,
        basis: AbstractBasis | None = None,
        limits: Limits | None = None,
        criterion: AbstractCriterion | None = None,
        constraints: tuple[AbstractConstraint, ...] = (),
        *,
        noise: Float[AnyArray, " joints"] | None = None,
        prior: Float[AnyArray, "base base"] | None = None,
        samples: int = 800,
    ):
        require_float64("designing a motion")
        robot = base.model.robot
        self.base, self.criterion = (
            base,
            criteria.DOptimal() if criterion is None else criterion,
        )
        self.limits = JointLimits(
            robot, FourierBasis(5, 0.8) if basis is None else basis, limits
        )
        self.basis = self.limits.basis
        self.constraints, self.samples = tuple(constraints), samples
        self.noise = assumed_noise(robot) if noise is None else np.asarray(noise, float)
        self.prior = (
            np.zeros((base.size, base.size)) if prior is None else np.asarray(prior)
        )
        if prior is not None and not self.criterion.weighted:
            raise InputError(
                "`prior` needs a weighted criterion, but that is the "
                f"{self.criterion.name}."
            )
        if self.prior.shape != (base.size, base.size):
            raise InputError(
                f"`prior` must have {base.size} rows and columns, but has shape "
                f"{self.prior.shape}."
            )
        if self.noise.shape != (robot.joints,) or not (self.noise > 0).all():
            raise InputError(
                "`noise` must hold one positive number for each joint, but is "
                f"{self.noise}."
            )
        self.robot = robot.replace(limits=self.limits.limits)
        self._regressor = base.joint_regressor
        self._rows = np.asarray(self.basis.rows(self.basis.instants(CHECKED))[:3])
        self._samples: dict[int, tuple[np.ndarray, ...]] = {}
        self._judged = jax.jit(jax.value_and_grad(self._criterion, argnums=(0, 1)))
        self.sizes = np.ones(base.size)
        motions = self.limits.random(jax.random.key(0), 8)
        squares = np.mean(
            [np.diag(self.information(x).weighted) for x in motions], axis=0
        )
        self.sizes = 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))

    @property
    def size(self) -> int:
        """Number of scaled coefficients."""
        return int(np.prod(self.limits.shape))

    def trajectory(self, x: Float[AnyArray, " scaled"]) -> LinearTrajectory:
        """Return the trajectory of scaled coefficients."""
        return self.basis.trajectory(self.limits.coefficients(x))

    def random(self, key: PRNGKeyArray) -> Float[Array, " scaled"]:
        """Draw a random motion that fills the limits of the joints, as scaled coefficients."""
        return self.limits.random(key, 1)[0]

    def value(
        self,
        x: Float[AnyArray, " scaled"],
        sharpness: Sharpness = None,
        samples: int | None = None,
    ) -> Float[Array, ""]:
        """Return the logarithm of the criterion of one run.

        Args:
            x: Scaled coefficients.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
            samples: Number of evaluated samples, which stand for all measured ones; all
                of them if None.
        """
        return self.values(jnp.asarray(x)[None], sharpness, samples)[0]

    def inequalities(
        self, x: Float[AnyArray, " scaled"]
    ) -> Float[Array, " inequalities"]:
        """Return what must not be positive: relative excess over all limits and constraints.

        Limits of the joints hold for all times if these are not positive. Constraints
        are evaluated at equidistant instants, with a small margin.

        Args:
            x: Scaled coefficients.
        """
        use = self.limits.grid(SEARCHED).use(jnp.asarray(x)).reshape(-1)
        limits = jnp.concatenate([use, -use]) - 1.0
        if not self.constraints:
            return limits
        watched = self._constrained(x, WATCHED)
        return jnp.concatenate([limits, watched.reshape(-1) + MARGIN])

    def violation(self, x: Float[AnyArray, " scaled"]) -> Float[Array, ""]:
        """Return the largest relative excess over all limits and constraints, for all times.

        Args:
            x: Scaled coefficients.
        """
        excess = jnp.max(jnp.abs(self.limits.grid().use(jnp.asarray(x)))) - 1.0
        tops = _tops(self._constrained(x)) if self.constraints else excess
        return jnp.maximum(excess, jnp.max(tops))

    def values(
        self,
        x: Float[Array, "starts scaled"],
        sharpness: Sharpness = None,
        samples: int | None = None,
    ) -> Float[Array, " starts"]:
        """Return `value` of several motions at once."""
        plain, weighted = criteria.informations(
            self.base,
            self.basis,
            self.limits.coefficients(x),
            samples=self.samples if samples is None else samples,
            measured=self.samples,
            weights=1.0 / self.noise,
            prior=self.prior,
        )

        def evaluate(plain: Array, weighted: Array) -> Array:
            return self._criterion(plain, weighted, sharpness)

        return jax.vmap(evaluate)(jnp.asarray(plain), jnp.asarray(weighted))

    def _criterion(self, plain: Array, weighted: Array, sharpness: Sharpness) -> Array:
        return self.criterion(Information(plain, weighted, self.sizes), sharpness)

    def value_and_gradient(
        self,
        x: Float[np.ndarray, "starts scaled"],
        sharpness: float | None,
        samples: int,
    ) -> tuple[Float[np.ndarray, " starts"], Float[np.ndarray, "starts scaled"]]:
        """Return `value` of several motions and its derivatives, in NumPy."""
        rows = self._sampled(samples)
        coefficients = self.limits.coefficients(x)
        arrays = [np.einsum("sk,bjk->jbs", part, coefficients) for part in rows]
        regressor = self._regressor
        columns = [np.swapaxes(y, 0, 1) for y in regressor.in_numpy(*arrays)]
        plain, weighted = np.zeros((2, len(x), self.base.size, self.base.size))
        scale, w = self.samples / samples, 1.0 / self.noise
        places = [np.ix_(own, own) for own in regressor.columns]
        for place, y, weight in zip(places, columns, w, strict=True):
            gram = scale * (y @ np.swapaxes(y, 1, 2))
            plain[:, *place] += gram
            weighted[:, *place] += weight**2 * gram
        weighted += self.prior
        values, by_plain, by_weighted = self._judge(plain, weighted, sharpness)
        pulled = np.zeros((len(self.noise), self.base.size, *arrays[0].shape[1:]))
        for joint, (place, y, weight) in enumerate(
            zip(places, columns, w, strict=True)
        ):
            slope = by_plain[:, *place] + weight**2 * by_weighted[:, *place]
            both = scale * (slope + np.swapaxes(slope, 1, 2))
            pulled[joint, regressor.columns[joint]] = np.swapaxes(both @ y, 0, 1)
        slopes = pull_back(
            regressor.program, pulled.reshape(-1, *pulled.shape[2:]), *arrays
        )
        parts = zip(slopes, rows, strict=True)
        gradient = sum(np.einsum("jbs,sk->bjk", slope, part) for slope, part in parts)
        return values, (gradient * np.asarray(self.limits.scale)).reshape(x.shape)

    def _judge(
        self, plain: np.ndarray, weighted: np.ndarray, sharpness: float | None
    ) -> tuple[np.ndarray, ...]:
        """Return the criterion of several motions, and its derivatives by their information."""
        found = [
            self._judged(*matrices, sharpness)
            for matrices in zip(plain, weighted, strict=True)
        ]
        values, slopes = zip(*found, strict=True)
        return np.array(values), *(np.array(x) for x in zip(*slopes, strict=True))

    def _sampled(self, samples: int) -> tuple[np.ndarray, ...]:
        """Return the rows of the basis at samples of a run."""
        if samples not in self._samples:
            rows = np.asarray(self.basis.rows(self.basis.times(samples))[:3])
            self._samples[samples] = tuple(rows)
        return self._samples[samples]

    def evaluate(
        self,
        x: Float[np.ndarray, "starts scaled"],
        sharpness: float | None,
        watched: Sequence[Watched],
    ) -> list[Evaluation]:
        """Return the criterion, and the watched values of constraints, of several motions."""
        count = scale_samples(SEARCHED, self.basis)
        values, gradients = self.value_and_gradient(x, sharpness, count)
        excess, slopes = self.linearise(x, watched)
        parts = zip(values.tolist(), gradients, excess + MARGIN, slopes, strict=True)
        return [Evaluation(*one) for one in parts]

    def linearise(
        self, x: Float[np.ndarray, "starts scaled"], watched: Sequence[Watched]
    ) -> tuple[
        Float[np.ndarray, "starts values"], Float[np.ndarray, "starts values scaled"]
    ]:
        """Return watched values of the constraints of several motions, and their derivatives."""
        coefficients, scale = self.limits.coefficients(x), np.asarray(self.limits.scale)
        excess: list[np.ndarray] = [np.zeros((len(x), 0))]
        derivatives: list[np.ndarray] = [np.zeros((len(x), 0, x.shape[-1]))]
        for constraint, places in zip(
            self.constraints, zip(*watched, strict=True), strict=True
        ):
            instants, entries = (np.array(part) for part in zip(*places, strict=True))
            rows = self._rows[:, instants]
            q, qd, qdd = np.einsum("obwk,bjk->obwj", rows, coefficients, optimize=True)
            motion = Motion(*(part.reshape(instants.size, -1) for part in (q, qd, qdd)))
            values, slopes = constraint.linearise(self.robot, motion, entries.ravel())
            by_x = np.zeros((*instants.shape, *scale.shape))
            for J, part in zip(slopes, rows, strict=False):
                by_x += J.reshape(*instants.shape, -1, 1) * part[:, :, None]
            excess.append(values.reshape(instants.shape))
            derivatives.append((by_x * scale).reshape(*instants.shape, -1))
        return np.concatenate(excess, axis=1), np.concatenate(derivatives, axis=1)

    @property
    def conditions(self) -> int:
        """Number of watched values of one motion."""
        return len(self.constraints) * (len(WATCHED) + PEAKS)

    def watched(self, x: Float[np.ndarray, " scaled"]) -> Watched:
        """Return the values to be watched near a motion, as instants and places in the entries.

        Of each constraint these are the worst value at equidistant instants, and
        highest peaks.
        """
        found = []
        for values in self._by_constraint(x, slice(None, None, EVERY)):
            peaks = np.where(are_peaks(values, 0), values, -np.inf)
            highest = np.argsort(peaks, axis=None)[-PEAKS:]
            highest = np.resize(highest, PEAKS)
            time, entry = np.unravel_index(highest, values.shape)
            at = np.concatenate([WATCHED // EVERY, time])
            worst = values[WATCHED // EVERY].argmax(axis=1)
            found.append((EVERY * at, np.concatenate([worst, entry])))
        return found

    def watched_excess(self, x: Float[np.ndarray, " scaled"]) -> float:
        """Return the largest excess of the constraints at the equidistant watched instants."""
        return max(
            (float(v.max()) for v in self._by_constraint(x, WATCHED)), default=-np.inf
        )

    def _by_constraint(self, x: AnyArray, instants: Any) -> list[np.ndarray]:
        coefficients = self.limits.coefficients(np.asarray(x))
        motion = Motion(*(part[instants] @ coefficients.T for part in self._rows))
        return [np.asarray(c(self.robot, motion)) for c in self.constraints]

    def checked(
        self, x: Float[AnyArray, " scaled"]
    ) -> Float[np.ndarray, "checked values"]:
        """Return all constraints of one motion at all checked instants."""
        return np.concatenate(self._by_constraint(x, slice(None)), axis=1)

    def information(self, x: Float[AnyArray, " scaled"]) -> Information:
        """Return the information of one run, computed in NumPy."""
        coefficients = self.limits.coefficients(np.asarray(x))
        motion = Motion(
            *(part @ coefficients.T for part in self._sampled(self.samples))
        )
        weights = 1.0 / self.noise
        return criteria.information(self.base, motion, weights, self.prior, self.sizes)

    def excess(self, x: Float[AnyArray, " scaled"]) -> float:
        """Return the largest excess over constraints for all times; minus infinity if none."""
        if not self.constraints:
            return -np.inf
        # What is far from its limits need not be known closely.
        rough = self._by_constraint(x, slice(None, None, EVERY))
        coarse = float(_tops(np.concatenate(rough, axis=1)).max())
        return (
            coarse if not -SURE < coarse < NEAR else float(_tops(self.checked(x)).max())
        )

    def findings(self, x: Float[AnyArray, " scaled"]) -> list[Finding]:
        """Return all limited quantities with their largest values."""
        found: list[Finding] = []
        tops = _tops(self.checked(x)) if self.constraints else np.zeros(0)
        for constraint in self.constraints:
            width, start = len(constraint.entries(self.robot)), len(found)
            found += constraint.describe(self.robot, tops[start : start + width])
        return found

    def _constrained(
        self, x: AnyArray, instants: Any = slice(None)
    ) -> Float[Array, "instants values"]:
        coefficients = self.limits.coefficients(jnp.asarray(x))
        motion = Motion(*(part[instants] @ coefficients.T for part in self._rows))
        return jnp.concatenate(
            [c(self.robot, motion) for c in self.constraints], axis=-1
        )


def assumed_noise(robot: Robot) -> Float[np.ndarray, " joints"]:
    """Return standard deviations of the forces' noise where none are given [N m or N]."""
    return 0.01 * np.asarray(robot.max_forces)


def are_peaks(values: np.ndarray, axis: int) -> np.ndarray:
    """Return whether values are not below their neighbours along an axis that closes on itself."""
    return (values >= np.roll(values, 1, axis)) & (values >= np.roll(values, -1, axis))


def _tops(values: AnyArray) -> Float[AnyArray, " values"]:
    """Return the highest of each value, also between instants: the tops of parabolas."""
    xp = namespace(values)
    before, peak, after = values[:-2], values[1:-1], values[2:]
    bend = 2 * peak - before - after
    top = (peak >= before) & (peak >= after) & (bend > 0)
    rise = xp.where(top, (after - before) ** 2 / (8 * xp.where(top, bend, 1.0)), 0.0)
    return xp.maximum((peak + rise).max(axis=0), xp.maximum(values[0], values[-1]))


class Candidates(NamedTuple):
    """The best motion of each start so far, certified to keep the limits of the joints."""

    x: Float[AnyArray, "starts scaled"]  # scaled coefficients
    value: Float[AnyArray, " starts"]  # logarithm of the criterion, exact
    # relative excess of the worst constraint; not positive where all are kept
    excess: Float[AnyArray, " starts"]

    @property
    def broken(self) -> Float[np.ndarray, " starts"]:
        """Excess where a constraint is not kept; zero elsewhere."""
        return np.maximum(np.asarray(self.excess), 0.0)

    @property
    def best_value(self) -> float:
        """Value of the criterion itself for the best motion."""
        return float(np.exp(self.value[int(self.order()[0])]))

    def order(self) -> np.ndarray:
        """Return the starts from best to worst; motions that keep their constraints come first."""
        return np.lexsort((np.asarray(self.value), self.broken))

    def promising(self) -> np.ndarray:
        """Return the starts, the most promising first: a small excess is soon mended."""
        return np.argsort(np.asarray(self.value) + PENALTY * self.broken, kind="stable")

    def placed(self, places: Any, other: "Candidates") -> "Candidates":
        """Return the same motions with others at some places."""
        whole = Candidates(*(np.array(part) for part in self))
        for part, new in zip(whole, other, strict=True):
            part[places] = new
        return whole

    def improved(self, other: "Candidates") -> "Candidates":
        """Return start by start the better of two."""
        a, b = self.broken, other.broken
        better = (b < a) | ((b == a) & (other.value < self.value))
        return Candidates(
            np.where(better[:, None], other.x, self.x),
            np.where(better, other.value, self.value),
            np.where(better, other.excess, self.excess),
        )

    def survivors(self, other: "Candidates") -> "Candidates":
        """Return as many of both together as these are, the best first, duplicates last."""
        both = Candidates(
            *(np.concatenate([a, b]) for a, b in zip(self, other, strict=True))
        )
        order = both.order()
        again = np.diff(both.value[order], prepend=np.nan) <= 2e-5  # one found twice
        again &= np.diff(both.broken[order], prepend=np.nan) == 0.0
        order = np.concatenate([order[~again], order[again]])[: len(self.value)]
        return Candidates(*(np.asarray(part)[order] for part in both))


def evaluate(
    problem: ExcitationProblem, x: Float[AnyArray, "starts scaled"]
) -> Candidates:
    """Return motions as they are, with their exact values."""
    x = np.asarray(x)
    known = [jax.tree.map(jnp.asarray, problem.information(one)) for one in x]
    values = np.array([float(problem.criterion(one)) for one in known])
    excess = np.array([problem.excess(one) for one in x])
    finite = np.isfinite(values) & ~np.isnan(excess)
    return Candidates(
        x, np.where(finite, values, np.inf), np.where(finite, excess, np.inf)
    )


def evaluate_within_limits(
    problem: ExcitationProblem, x: Float[AnyArray, "starts scaled"]
) -> Candidates:
    """Return motions after they were made to keep the limits of the joints for all times.

    Where they almost keep the other constraints, they are made smaller until they do;
    without constraints they fill their limits where that is better.
    """
    grid = problem.limits.grid()

    def mended(y: np.ndarray) -> np.ndarray:
        if not 0.0 < problem.excess(y) <= NEAR:
            return y
        fractions = (0.9995, 0.998, 0.995, 0.99, 0.98, 0.96, 0.93, 0.9)
        smaller = (np.asarray(grid.shrink(y, fraction)) for fraction in fractions)
        return next((z for z in smaller if problem.excess(z) <= 0.0), y)

    # A larger motion mostly tells more, but a condition number may well become worse by
    # it.
    growths = (1.0,) if problem.constraints else (1.0, 1.05)
    scaled = [
        [np.asarray(grid.scale_into_limits(y, growth=growth)) for y in np.asarray(x)]
        for growth in growths
    ]
    found = [evaluate(problem, np.array([mended(y) for y in some])) for some in scaled]
    return functools.reduce(Candidates.improved, found)


def shrink_to_constraints(
    problem: ExcitationProblem, x: Float[AnyArray, " scaled"]
) -> Candidates:
    """Return a motion made so small that it keeps all constraints; unchanged if no size does."""
    x, shrink = np.asarray(x), problem.limits.grid().shrink

    def keeps(fraction: float) -> bool:
        return problem.excess(shrink(x, fraction)) <= 0.0

    step = 0.05
    low = next((s for s in np.arange(1.0 - step, 0.0, -step) if keeps(s)), None)
    if low is None:
        return evaluate(problem, x[None])
    high = low + step
    for _ in range(6):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if keeps(middle) else (low, middle)
    return evaluate(problem, shrink(x, low)[None])
