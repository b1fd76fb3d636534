"""Design problem: criterion, trajectories, limits and constraints as functions of one vector."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Int, PRNGKeyArray, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints import AbstractConstraint, Finding
from jaxid.excitation.criteria import AbstractCriterion, DOptimal, Sharpness
from jaxid.excitation.information import Information, information, information_map
from jaxid.excitation.interior_point import Evaluation, map_starts
from jaxid.excitation.limits import JointLimits, scale_samples
from jaxid.robot.joints import Limits
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.trajectory import AbstractBasis, LinearTrajectory

CHECKED = 8160
"""Instants at which constraints are checked."""
WATCHED = 48
"""Equidistant instants at which constraints are always watched during a search."""
PEAKS = 10
"""Further watched instants for each value of the constraints: its highest peaks."""
MARGIN = 1e-3
"""Relative distance that is kept from constraints, for what happens between instants."""
SEARCHED = 64
"""Samples on which motions with few coefficients are evaluated during a search."""


class ExcitationProblem:
    """The problem of finding a motion that determines the base parameters well (Eq. 36).

    Its unknown is one vector x of scaled coefficients: each of them alone meets a limit of its
    joint near one. `value`, `inequalities` and `violation` are functions of x that run under `jit`,
    `vmap` and `grad`, so that any solver can be put around them.

    Attributes:
        base: Base parameters to be determined.
        limits: Limits of the joints on the trajectories of the basis.
        criterion: Criterion to be minimised.
        constraints: Constraints beside the limits of the joints.
        noise: Standard deviation of each joint's force noise [N m or N].
        prior: Information of earlier experiments.
        samples: Number of measured samples of one run.
        sizes: Typical sizes of the base parameters: the standard deviation of each in random
            motions if it were the only unknown one.
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
        """Check the arguments and prepare the functions.

        Args:
            base: Base parameters to be determined.
            basis: Family of trajectories; Fourier series of five harmonics at 0.8 rad/s if None.
            limits: Limits of the joints, and of their forces for constraints that keep those; the
                robot's if None. Unknown limits are assumed as in `random_fourier_series`.
            criterion: Criterion to be minimised; D-optimality if None.
            constraints: Constraints beside the limits of the joints.
            noise: Standard deviation of each joint's force noise [N m or N]; 1 % of the largest
                forces if None. Its inverse weights the criterion, like the estimator.
            prior: Information of earlier experiments in the same noise, the inverse of their
                covariance; the design adds to it.
            samples: Number of measured samples of one run.

        Raises:
            InputError: If arguments do not fit.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("designing a motion")
        robot = base.model.robot
        self.base, self.criterion = base, DOptimal() if criterion is None else criterion
        self.limits = JointLimits(robot, FourierBasis(5, 0.8) if basis is None else basis, limits)
        self.constraints, self.samples = tuple(constraints), samples
        self.noise = assumed_noise(robot) if noise is None else np.asarray(noise, float)
        self.prior = np.zeros((base.size, base.size)) if prior is None else np.asarray(prior)
        _check(self, given_prior=prior is not None)
        # Constraints ask the robot for its limits of force.
        self._robot = robot.replace(limits=self.limits.limits)
        self._rows = np.asarray(self.basis.rows(self.basis.instants(CHECKED))[:3])
        self._maps: dict[int, Callable] = {}
        self._checked = jax.jit(self._constrained)
        self.sizes = np.ones(base.size)
        self.sizes = self._typical_sizes()

    @property
    def basis(self) -> AbstractBasis:
        """Family of trajectories."""
        return self.limits.basis

    @property
    def size(self) -> int:
        """Number of scaled coefficients."""
        return int(np.prod(self.limits.shape))

    @property
    def search_samples(self) -> int:
        """Number of samples on which motions are evaluated during a search."""
        return scale_samples(SEARCHED, self.basis)

    def trajectory(self, x: Float[AnyArray, " scaled"]) -> LinearTrajectory:
        """Return the trajectory of scaled coefficients."""
        return self.basis.trajectory(self.limits.coefficients(x))

    def random(self, key: PRNGKeyArray) -> Float[Array, " scaled"]:
        """Draw a random motion that fills the limits of the joints, as scaled coefficients."""
        return self.limits.random(key, 1)[0]

    def value(
        self, x: Float[AnyArray, " scaled"], sharpness: Sharpness = None, samples: int | None = None
    ) -> Float[Array, ""]:
        """Return the logarithm of the criterion of one run.

        Args:
            x: Scaled coefficients.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
            samples: Number of evaluated samples, which stand for all measured ones; all of them if
                None, `search_samples` are mostly enough.
        """
        return self.values(jnp.asarray(x)[None], sharpness, samples)[0]

    def inequalities(self, x: Float[AnyArray, " scaled"]) -> Float[Array, " inequalities"]:
        """Return what must not be positive: relative excess over all limits and constraints.

        Limits of the joints hold for all times if these are not positive. Constraints are evaluated
        at equidistant instants, with a small margin.

        Args:
            x: Scaled coefficients.
        """
        grid, y = self.limits.grid(SEARCHED), jnp.asarray(x).reshape(self.limits.shape)
        rows = jnp.einsum("jrk,jk->jr", grid.R, y) - grid.c
        limits = jnp.concatenate([rows.reshape(-1), -rows.reshape(-1)]) / grid.bound - 1.0
        if not self.constraints:
            return limits
        watched = self._constrained_at(jnp.asarray(x), self._watched)
        return jnp.concatenate([limits, watched.reshape(-1) + MARGIN])

    def violation(self, x: Float[AnyArray, " scaled"]) -> Float[Array, ""]:
        """Return the largest relative excess over all limits and constraints, for all times.

        Args:
            x: Scaled coefficients.
        """
        grid, y = self.limits.grid(), jnp.asarray(x).reshape(self.limits.shape)
        rows = jnp.einsum("jrk,jk->jr", grid.R, y) - grid.c
        excess = jnp.max(jnp.abs(rows)) / grid.bound - 1.0
        if not self.constraints:
            return excess
        return jnp.maximum(excess, jnp.max(self._tops(self._constrained(jnp.asarray(x)))))

    def values(
        self,
        x: Float[Array, "starts scaled"],
        sharpness: Sharpness = None,
        samples: int | None = None,
    ) -> Float[Array, " starts"]:
        """Return `value` of several motions at once."""
        count = self.samples if samples is None else samples
        if count not in self._maps:
            self._maps[count] = information_map(
                self.base,
                self.basis,
                samples=count,
                measured=self.samples,
                weights=1.0 / self.noise,
                prior=self.prior,
            )
        plain, weighted = self._maps[count](self.limits.coefficients(x))

        def evaluate(plain: Array, weighted: Array) -> Array:
            return self.criterion(Information(plain, weighted, self.sizes), sharpness)

        return jax.vmap(evaluate)(jnp.asarray(plain), jnp.asarray(weighted))

    def evaluate(
        self,
        x: Float[Array, "starts scaled"],
        sharpness: Sharpness,
        instants: Int[Array, "starts instants"],
        samples: int | None = None,
    ) -> Evaluation:
        """Return the criterion and the constraints of several motions, with their derivatives.

        Args:
            x: Scaled coefficients.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
            instants: Checked instants at which constraints are evaluated, from `watched_instants`.
            samples: Number of evaluated samples; `search_samples` if None.
        """
        count = self.search_samples if samples is None else samples
        values, pull = jax.vjp(lambda y: self.values(y, sharpness, count), x)
        evaluation = Evaluation.unconstrained(values, pull(jnp.ones_like(values))[0])
        if not self.constraints:
            return evaluation
        excess, slopes = map_starts(self.linearise, x, instants)
        starts, size = x.shape
        # At the peaks of one value only this value counts: the others have their own peaks.
        entries = excess.shape[-1]
        always = np.arange(WATCHED * entries)
        peaks = np.arange(PEAKS * entries) * entries + np.repeat(np.arange(entries), PEAKS)
        chosen = np.concatenate([always, WATCHED * entries + peaks])
        return evaluation._replace(
            excess=excess.reshape(starts, -1)[:, chosen] + MARGIN,
            slopes=slopes.reshape(starts, -1, size)[:, chosen],
        )

    def linearise(
        self, x: Float[Array, " scaled"], instants: Int[AnyArray, " instants"]
    ) -> tuple[Float[Array, "instants values"], Float[Array, "instants values scaled"]]:
        """Return all constraints of one motion at checked instants, and their derivatives.

        Args:
            x: Scaled coefficients.
            instants: Indices of checked instants.
        """
        rows = jnp.asarray(self._rows)[:, instants]
        coefficients = self.limits.coefficients(x)
        motion = [part @ coefficients.T for part in rows]
        # Samples are independent: one pull gives a value's derivatives at all of them.
        values, pull = jax.vjp(lambda *parts: self._evaluated(Motion(*parts)), *motion)
        each = jnp.eye(values.shape[1])[:, None, :]
        by_motion = jax.vmap(lambda one: pull(jnp.broadcast_to(one, values.shape)))(each)
        scale = np.asarray(self.limits.scale)
        slopes = sum(
            jnp.einsum("vtj,tk,jk->tvjk", J, part, scale)
            for J, part in zip(by_motion, rows, strict=True)
        )
        return values, jnp.reshape(slopes, (*values.shape, x.shape[-1]))

    @property
    def conditions(self) -> int:
        """Number of values that `evaluate` gives for the constraints of one motion."""
        entries = sum(len(c.entries(self._robot)) for c in self.constraints)
        return (WATCHED + PEAKS) * entries

    def watched_instants(self, x: Float[Array, "starts scaled"]) -> Int[Array, "starts instants"]:
        """Return the instants at which constraints are watched: equidistant, and highest peaks."""
        if not self.constraints:
            return jnp.zeros((len(x), 0), int)

        def one(x: Array) -> Array:
            values = self._constrained(x).T
            peak = (values >= jnp.roll(values, 1, 1)) & (values >= jnp.roll(values, -1, 1))
            highest = jax.lax.top_k(jnp.where(peak, values, -jnp.inf), PEAKS)[1]
            return jnp.concatenate([jnp.asarray(self._watched, highest.dtype), highest.reshape(-1)])

        return jax.lax.map(one, x)

    def watched_excess(self, x: Float[Array, "starts scaled"]) -> Float[Array, " starts"]:
        """Return the largest excess of the constraints at the equidistant watched instants."""
        return jax.lax.map(lambda y: jnp.max(self._constrained_at(y, self._watched)), x)

    def checked(self, x: Float[AnyArray, " scaled"]) -> Float[np.ndarray, "checked values"]:
        """Return all constraints of one motion at all checked instants."""
        return np.asarray(self._checked(np.asarray(x)))

    def information(self, x: Float[AnyArray, " scaled"]) -> Information:
        """Return the information of one run, computed in NumPy."""
        rows = np.asarray(self.basis.rows(self.basis.times(self.samples))[:3])
        coefficients = np.asarray(self.limits.coefficients(np.asarray(x)))
        motion = Motion(*(part @ coefficients.T for part in rows))
        return information(self.base, motion, 1.0 / self.noise, self.prior, self.sizes)

    def exact_value(self, x: Float[AnyArray, " scaled"]) -> float:
        """Return the logarithm of the criterion of one run, from information in NumPy."""
        return float(self.criterion(jax.tree.map(jnp.asarray, self.information(x))))

    def excess(self, x: Float[AnyArray, " scaled"]) -> float:
        """Return the largest excess over constraints for all times; minus infinity if none."""
        return float(self._tops(self.checked(x)).max()) if self.constraints else -np.inf

    def findings(self, x: Float[AnyArray, " scaled"]) -> list[Finding]:
        """Return all limited quantities with their largest values."""
        if not self.constraints:
            return []
        tops, found = self._tops(self.checked(x)), []
        for constraint in self.constraints:
            width, start = len(constraint.entries(self._robot)), len(found)
            found += constraint.describe(self._robot, tops[start : start + width])
        return found

    @functools.cached_property
    def _watched(self) -> Int[np.ndarray, " watched"]:
        return np.arange(0, CHECKED, CHECKED // WATCHED)

    def _constrained(self, x: AnyArray) -> Float[Array, "checked values"]:
        return self._constrained_at(jnp.asarray(x), slice(None))

    def _constrained_at(self, x: Array, instants: Any) -> Float[Array, "instants values"]:
        coefficients = self.limits.coefficients(x)
        return self._evaluated(Motion(*(part[instants] @ coefficients.T for part in self._rows)))

    def _evaluated(self, motion: Motion) -> Float[Array, "*batch values"]:
        return jnp.concatenate([c(self._robot, motion) for c in self.constraints], axis=-1)

    def _tops(self, values: AnyArray) -> Float[AnyArray, " values"]:
        """Return the highest of each value, also between instants: the tops of parabolas."""
        xp = np if isinstance(values, np.ndarray) else jnp
        before, peak, after = values[:-2], values[1:-1], values[2:]
        bend = 2 * peak - before - after
        top = (peak >= before) & (peak >= after) & (bend > 0)
        rise = xp.where(top, (after - before) ** 2 / (8 * xp.where(top, bend, 1.0)), 0.0)
        return xp.maximum((peak + rise).max(axis=0), xp.maximum(values[0], values[-1]))

    def _typical_sizes(self) -> Float[np.ndarray, " base"]:
        motions = self.limits.random(jax.random.key(0), 8)
        squares = np.mean([np.diag(self.information(x).weighted) for x in motions], axis=0)
        return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))


def assumed_noise(robot: Robot, fraction: float = 0.01) -> Float[np.ndarray, " joints"]:
    """Return standard deviations of the forces' noise where none are given [N m or N].

    Args:
        robot: Robot with its largest forces.
        fraction: Standard deviation as a fraction of the largest forces.
    """
    return fraction * np.asarray(robot.max_forces)


def _check(problem: ExcitationProblem, given_prior: bool) -> None:
    base, noise, prior = problem.base, problem.noise, problem.prior
    joints = base.model.robot.joints
    if noise.shape != (joints,) or not (noise > 0).all():
        raise InputError(
            f"`noise` must hold one positive number for each joint ({joints}), but is {noise}."
        )
    if problem.samples < 2:
        raise InputError(f"`samples` must be at least 2, but is {problem.samples}.")
    if prior.shape != (base.size, base.size):
        raise InputError(
            f"`prior` must be a matrix of the {base.size} base parameters, but has shape "
            f"{prior.shape}."
        )
    if given_prior and not problem.criterion.weighted:
        raise InputError(
            f"`prior` is in units of the noise, which the {problem.criterion.name} does not use: "
            "choose a weighted criterion."
        )
