"""Design problem: criterion and constraints as functions of one vector (Eq. 36)."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    PRNGKeyArray,
    namespace,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.packed_regressor import JointRegressor
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.loop_closing import reachable
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.trajectory import AbstractBasis, LinearTrajectory

from .coefficient_limits import JointLimits, ScaledMotion
from .constraints import AbstractConstraint, Finding, LoopLimits
from .criteria import AbstractCriterion, DOptimal, Information, information
from .criteria.functions_of_eigenvalues import Scalar, Sharpness
from .criteria.information_matrix import BaseMatrix, JointVector
from .criterion_gradient import criterion_value

CHECKED_INSTANTS = 8160
"""Instants at which constraints are checked."""
COARSE_STEP = 8
"""Instants from one to the next of a coarse check."""
WATCHED_INSTANTS = np.arange(0, CHECKED_INSTANTS, CHECKED_INSTANTS // 48)
"""Equidistant instants at which a search watches each constraint's worst value."""
SEARCH_SAMPLES = 64
"""Samples on which motions with few coefficients are evaluated during a search."""
MARGIN = 1e-3
"""Relative distance kept from constraints, for what happens between instants."""
MIN_COARSE_ROOM = 0.02
"""Relative distance from all limits from which a coarse check suffices."""
MAX_COARSE_EXCESS = 0.1
"""Relative excess above limits from which a coarse check suffices."""


class ExcitationProblem:
    """The problem of a motion that determines the base parameters well (Eq. 36).

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
        constraints: Constraints beside the limits of the joints and of closed loops.
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
        noise: JointVector | None = None,
        prior: BaseMatrix | None = None,
        samples: int = 800,
    ):
        require_float64("designing a motion")
        robot = base.model.robot
        if robot.floating:
            raise InputError(
                f"`{robot.name}` has a floating base, whose motion follows from its "
                "contacts: use `jid.design_excitation` with `standing`."
            )
        self.base = base
        self.basis = FourierBasis(5, 0.8) if basis is None else basis
        self.limits = JointLimits(robot, self.basis, limits)
        self.robot = robot.replace(limits=self.limits.limits)
        self.criterion = DOptimal() if criterion is None else criterion
        loop_limits = (LoopLimits(),) if robot.loops else ()
        self.constraints = (*constraints, *loop_limits)
        self.linearisations = [c.linearisation(self.robot) for c in self.constraints]
        self.samples = samples
        self.noise = assumed_noise(robot) if noise is None else np.asarray(noise, float)
        zero_prior = np.zeros((base.size, base.size))
        self.prior = zero_prior if prior is None else np.asarray(prior)
        if prior is not None and not self.criterion.weighted:
            raise InputError(
                f"`prior` needs a weighted criterion, not the {self.criterion.name}."
            )
        if self.prior.shape != (base.size, base.size):
            raise InputError(
                f"`prior` must have {base.size} rows and columns, "
                f"but has shape {self.prior.shape}."
            )
        if self.noise.shape != (robot.joints,) or not (self.noise > 0).all():
            raise InputError(
                "`noise` must hold one positive number "
                f"for each joint, but is {self.noise}."
            )
        self.weights = 1.0 / self.noise
        # From the coordinates of the motors: the program closes the loops.
        _, *shapes = base.model.input_shapes
        self.regressor = JointRegressor(base, base.columns, (robot.joints,), *shapes)
        instants = self.basis.instants(CHECKED_INSTANTS)
        self.checked_rows = np.asarray(self.basis.rows(instants)[:3])
        self._sample_rows: dict[int, np.ndarray] = {}
        self.criterion_and_slopes = jax.jit(
            jax.value_and_grad(self.criterion_of, argnums=(0, 1))
        )
        self.sizes = np.ones(base.size)
        self.sizes = self._typical_sizes()

    def _typical_sizes(self):
        """Return each parameter's deviation if it were the only one."""
        motions = self.limits.random(jax.random.key(0), 8)
        weighted_matrices = [self.information(x).weighted for x in motions]
        squares = np.mean([np.diag(matrix) for matrix in weighted_matrices], axis=0)
        return 1.0 / np.sqrt(np.where(squares > 0, squares, 1.0))

    @property
    def size(self) -> int:
        """Number of scaled coefficients."""
        return int(np.prod(self.limits.shape))

    def trajectory(self, x: ScaledMotion) -> LinearTrajectory:
        """Return the trajectory of scaled coefficients."""
        return self.basis.trajectory(self.limits.coefficients(x))

    def random(self, key: PRNGKeyArray) -> Array:
        """Draw scaled coefficients of a motion that fills the limits of the joints."""
        return self.limits.random(key, 1)[0]

    def value(
        self,
        x: ScaledMotion,
        sharpness: Sharpness = None,
        samples: int | None = None,
    ) -> Scalar:
        """Return the logarithm of the criterion of one run.

        Args:
            x: Scaled coefficients.
            sharpness: Sharpness of smooth extremes of eigenvalues; exact if None.
            samples: Number of evaluated samples, which represent all measured ones; all
                of them if None.
        """
        samples = self.samples if samples is None else samples
        return criterion_value(self, samples, jnp.asarray(x), sharpness)

    def criterion_of(
        self,
        plain_matrix: Array,
        weighted_matrix: Array,
        sharpness: Sharpness,
    ):
        """Return the logarithm of the criterion of one motion's information."""
        information = Information(plain_matrix, weighted_matrix, self.sizes)
        return self.criterion(information, sharpness)

    def inequalities(self, x: ScaledMotion) -> Array:
        """Return what must not be positive: excess over limits and constraints.

        Limits of the joints hold for all times if these are not positive. Constraints
        are evaluated at equidistant instants, with a small margin.

        Args:
            x: Scaled coefficients.
        """
        x = jnp.asarray(x)
        use = self.limits.grid(SEARCH_SAMPLES).use(x).reshape(-1)
        excess = [use - 1.0, -use - 1.0]
        for values in self.constraint_values(x, WATCHED_INSTANTS):
            excess.append(values.reshape(-1) + MARGIN)
        return jnp.concatenate(excess)

    def violation(self, x: ScaledMotion) -> Scalar:
        """Return the largest excess over limits and constraints, for all times.

        Args:
            x: Scaled coefficients.
        """
        x = jnp.asarray(x)
        violation = jnp.max(jnp.abs(self.limits.grid().use(x))) - 1.0
        for values in self.constraint_values(x):
            violation = jnp.maximum(violation, jnp.max(highest_values(values)))
        return violation

    def constraint_values(
        self,
        x: ScaledMotion,
        instants: Any = slice(None),
    ) -> list[AnyArray]:
        """Return the values of each constraint at some of the checked instants.

        Args:
            x: Scaled coefficients, in NumPy or JAX.
            instants: Places among the checked instants; all of them by default.
        """
        coefficients = self.limits.coefficients(x)
        motion = Motion(
            *(part[instants] @ coefficients.T for part in self.checked_rows)
        )
        return [constraint(self.robot, motion) for constraint in self.constraints]

    def sample_rows(self, samples: int) -> np.ndarray:
        """Return the rows of the basis, up to accelerations, at samples of a run."""
        if samples not in self._sample_rows:
            times = self.basis.times(samples)
            self._sample_rows[samples] = np.asarray(self.basis.rows(times)[:3])
        return self._sample_rows[samples]

    def information(self, x: ScaledMotion) -> Information:
        """Return the information of one run, computed in NumPy."""
        coefficients = self.limits.coefficients(np.asarray(x))
        rows = self.sample_rows(self.samples)
        q, qd, qdd = (part @ coefficients.T for part in rows)
        motion = Motion(reachable(self.robot, q), qd, qdd)
        return information(self.base, motion, self.weights, self.prior, self.sizes)

    def excess(self, x: ScaledMotion) -> float:
        """Return the largest excess over constraints; minus infinity if none."""
        if not self.constraints:
            return -np.inf
        coarse_excess = self._largest_excess(x, slice(None, None, COARSE_STEP))
        # A motion that is far from its limits need not be checked closely.
        if -MIN_COARSE_ROOM < coarse_excess < MAX_COARSE_EXCESS:
            return self._largest_excess(x, slice(None))
        return coarse_excess

    def _largest_excess(self, x: AnyArray, instants: slice):
        """Return the largest value of all constraints, also between these instants."""
        values = self.constraint_values(np.asarray(x), instants)
        return max(
            float(highest_values(np.asarray(samples)).max()) for samples in values
        )

    def findings(self, x: ScaledMotion) -> list[Finding]:
        """Return all limited quantities with their largest values."""
        findings = []
        values = self.constraint_values(np.asarray(x))
        for constraint, samples in zip(self.constraints, values, strict=True):
            tops = highest_values(np.asarray(samples))
            findings += constraint.describe(self.robot, tops)
        return findings


def assumed_noise(robot: Robot) -> np.ndarray:
    """Return the assumed standard deviations of the forces' noise [N m or N]."""
    return 0.01 * np.asarray(robot.max_forces)


def highest_values(values: AnyArray) -> AnyArray:
    """Return the highest of the values at instants, also between: tops of parabolas."""
    xp = namespace(values)
    previous_values = values[:-2]
    middle_values = values[1:-1]
    next_values = values[2:]
    bend = 2 * middle_values - previous_values - next_values
    is_peak = (
        (middle_values >= previous_values) & (middle_values >= next_values) & (bend > 0)
    )

    # The top of the parabola through three values is above the middle one.
    divisor = 8 * xp.where(is_peak, bend, 1.0)
    rise = xp.where(is_peak, (next_values - previous_values) ** 2 / divisor, 0.0)
    end_values = xp.maximum(values[0], values[-1])
    return xp.maximum((middle_values + rise).max(axis=0), end_values)
