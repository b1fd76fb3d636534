"""Constraints of a motion beside the limits of the joints: forces, end-effector, collisions."""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, as_array
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import on_samples
from jaxid.dynamics.model import Coordinates, Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTransition, Reversal
from jaxid.errors import InputError
from jaxid.robot.collision import CollisionModel
from jaxid.robot.kinematics import tip_placement
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import complete_limits


class Finding(NamedTuple):
    """A limited quantity, and how far a motion is from the limit.

    Attributes:
        name: Name of the quantity, as it reads in a sentence: `torque of joint 3`.
        size: Physical size of a constraint's value of 1.
        unit: Physical unit.
        limit: Limit of the quantity in this unit; NaN if it has no name.
        least: Whether the quantity must not fall below the limit, rather than not rise above it.
        note: Origin of the limit: `12 less a margin of 50 %`.
        value: Relative excess over the limit; negative or zero where it is kept.
        usage: Function of the relative excess that returns the used fraction of the limit.
    """

    name: str
    size: float
    unit: str
    limit: float = math.nan
    least: bool = False
    note: str = ""
    value: float = math.nan
    usage: Callable[[float], float] = lambda value: 1.0 + value

    @property
    def excess(self) -> float:
        """Excess over the limit in physical units."""
        return self.value * self.size

    @property
    def used(self) -> float:
        """Used fraction of the limit, from 0 to 1; NaN where that means nothing."""
        return self.usage(self.value)

    @property
    def reached(self) -> float:
        """Physical quantity where it is nearest to its limit, or furthest beyond it."""
        return self.limit - self.excess if self.least else self.limit + self.excess

    @property
    def bound(self) -> str:
        """The limit in words; empty if it has no name."""
        if math.isnan(self.limit):
            return ""
        note = f" ({self.note})" if self.note else ""
        return f"{'at least' if self.least else 'at most'} {self.limit:.4g} {self.unit}{note}"

    def __str__(self) -> str:
        """Return one sentence."""
        bound = f": {self.bound}" if self.bound else ""
        if self.value > 0 and self.least:
            return f"{self.name} falls short of its limit by {self.excess:.3g} {self.unit}{bound}"
        if self.value > 0:
            return (
                f"{self.name} exceeds its limit by {self.excess:.3g} {self.unit} "
                f"({100 * self.value:.3g} %){bound}"
            )
        return f"{self.name} keeps its limit with {-self.excess:.3g} {self.unit} to spare{bound}"


class AbstractConstraint(eqx.Module):
    """Limits on a motion that are not linear in the joints' motion.

    Each sample of a motion is evaluated by itself, so that solvers can ask for values and
    derivatives at any instants. Values are smooth where possible, and relative: in units of the
    limit, or of another size that `entries` names.
    """

    @abstractmethod
    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the excess over each limit at each sample; zero or negative where it is kept.

        Runs under `jit`, `vmap` and derivatives with respect to the motion.

        Args:
            robot: Robot that moves.
            motion: Joint motion with any leading axes.
        """

    @abstractmethod
    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the limited quantities in the order of the values, without their values."""

    def describe(self, robot: Robot, values: Float[AnyArray, "*batch values"]) -> list[Finding]:
        """Return the limited quantities with their largest values.

        Args:
            robot: Robot that moves.
            values: Values of the constraint.
        """
        entries = self.entries(robot)
        peaks = np.asarray(values).reshape(-1, len(entries)).max(axis=0)
        return [e._replace(value=float(v)) for e, v in zip(entries, peaks, strict=True)]


class _Geometry(eqx.Module):
    """Robot and capsules, whose functions of one sample are compiled."""

    robot: Robot
    capsules: Any = None

    def axes(self, q) -> Float[Array, "capsules 2 3"]:
        """Return the ends of the capsules' axes at one pose."""
        return self.capsules.ends(self.robot, q)

    def tip(self, q, qd, qdd) -> Float[Array, "3 3"]:
        """Return position, velocity and acceleration of the end-effector at one sample."""

        def place(q):
            return tip_placement(self.robot, q)[1]

        def speed(q, qd):
            return jax.jvp(place, (q,), (qd,))[1]

        velocity, acceleration = jax.jvp(speed, (q, qd), (qd, qdd))
        return jnp.stack([place(q), velocity, acceleration])


class TipMotion(NamedTuple):
    """Motion of the end-effector's origin, in the frame of the ground.

    Attributes:
        position: Position [m].
        velocity: Velocity [m/s].
        acceleration: Acceleration without gravity [m/s²].
    """

    position: Float[Array, "*batch 3"]
    velocity: Float[Array, "*batch 3"]
    acceleration: Float[Array, "*batch 3"]


def tip_motion(robot: Robot, motion: Motion) -> TipMotion:
    """Return the motion of the end-effector's origin, in the frame of the ground.

    Args:
        robot: Robot that moves.
        motion: Joint motion with any leading axes.
    """
    geometry = _Geometry(robot)
    states = on_samples(geometry, geometry.tip, motion.q, motion.qd, motion.qdd)
    return TipMotion(*(states[..., k, :] for k in range(3)))


class Clearance(AbstractConstraint):
    """Least distance between the surfaces of shapes that must not collide.

    Values count in units of 0.1 m: two shapes that overlap by 0.17 m where 0.03 m are required
    give 2.

    Attributes:
        model: Shapes and pairs.
        distance: Least distance between surfaces [m].
    """

    model: CollisionModel
    distance: float = 0.03

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the missing distance of each pair."""
        geometry = _Geometry(robot, self.model)
        ends = on_samples(geometry, geometry.axes, motion.q)
        return (self.distance - self.model.clearances(ends)) / 0.1

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the pairs."""

        def usage(value: float) -> float:
            left = self.distance - 0.1 * value
            return self.distance / left if left > 0 else math.inf

        return tuple(
            Finding(f"the clearance of {name}", 0.1, "m", self.distance, least=True, usage=usage)
            for name in self.model.pair_names
        )


class TipSpeed(AbstractConstraint):
    """Largest speed of the end-effector.

    Attributes:
        limit: Largest speed [m/s].

    Raises:
        InputError: If it is not positive.
    """

    limit: float

    def __check_init__(self):
        _check_positive("TipSpeed", self.limit, "m/s")

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess of the speed."""
        return _length(tip_motion(robot, motion).velocity / self.limit)[..., None] - 1.0

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the speed."""
        return (Finding("the speed of the end-effector", self.limit, "m/s", self.limit),)


class TipAcceleration(AbstractConstraint):
    """Largest acceleration of the end-effector.

    Attributes:
        limit: Largest acceleration [m/s²].

    Raises:
        InputError: If it is not positive.
    """

    limit: float

    def __check_init__(self):
        _check_positive("TipAcceleration", self.limit, "m/s²")

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess of the acceleration."""
        return _length(tip_motion(robot, motion).acceleration / self.limit)[..., None] - 1.0

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the acceleration."""
        return (Finding("the acceleration of the end-effector", self.limit, "m/s²", self.limit),)


class Workspace(AbstractConstraint):
    """Box that the end-effector's origin must not leave; its edges are parallel to the axes.

    Values count in half edges of the box. A side at infinity is open, and then the opposite one
    counts in metres.

    Attributes:
        low: Smallest coordinates; minus infinity where the box is open [m].
        high: Largest coordinates; infinity where the box is open [m].

    Raises:
        InputError: If these are no corners of a box, or all sides are open.
    """

    low: Float[AnyArray, "3"] = eqx.field(converter=lambda x: as_array("low", x))
    high: Float[AnyArray, "3"] = eqx.field(converter=lambda x: as_array("high", x))

    def __check_init__(self):
        corners = np.asarray(self.low), np.asarray(self.high)
        if any(x.shape != (3,) or np.isnan(x).any() for x in corners):
            raise InputError("`low` and `high` of a workspace must hold three numbers each [m].")
        if (corners[0] >= corners[1]).any():
            raise InputError(f"`low` {self.low} must be below `high` {self.high} [m].")
        if not np.isfinite(corners).any():
            raise InputError("one side of `low` and `high` must be finite, but all are open.")

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the excess over each side."""
        p = tip_motion(robot, motion).position
        along = jnp.stack([p[..., axis] * sign for axis, sign, *_ in self._sides], axis=-1)
        ends, sizes = (np.array([side[k] for side in self._sides]) for k in (2, 3))
        return (along - jnp.broadcast_to(ends, along.shape)) / jnp.broadcast_to(sizes, along.shape)

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the coordinates that have a limit."""
        found = []
        for axis, sign, end, size in self._sides:
            entry = Finding(f"{'xyz'[axis]} of the end-effector", size, "m", sign * end, sign < 0)
            if not np.isfinite(self.low[axis] + self.high[axis]):
                note = "the other side is open"
                entry = entry._replace(note=note, usage=lambda value: math.nan)
            found.append(entry)
        return tuple(found)

    @property
    def _sides(self) -> list[tuple[int, float, float, float]]:
        """Axis, sign, end and half edge of each side that is not open."""
        low, high = np.asarray(self.low), np.asarray(self.high)
        half = np.where(np.isfinite(high - low), 0.5 * (high - low), 1.0)
        return [
            (axis, sign, float(end), float(half[axis]))
            for axis in range(3)
            for sign, end in ((1.0, high[axis]), (-1.0, -low[axis]))
            if np.isfinite(end)
        ]


class NominalForces(eqx.Module):
    """Expected forces of a motion, and their uncertainty.

    Near standstill dry friction counts in the direction that is worse: a joint that reverses passes
    through both, between any two samples.

    Attributes:
        base: Base parameters.
        parameters: Nominal values of the base parameters: of a CAD model, or of an earlier fit.
        covariance: Covariance of the nominal values; None if they count as known.
        deviations: Number of standard deviations of the force that must fit below the limit.

    Raises:
        InputError: If there is not one number for each base parameter, the covariance is not
            positive, or `deviations` is negative.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"] = eqx.field(
        converter=lambda x: np.array(as_array("parameters", x), np.float64)
    )
    covariance: Float[AnyArray, "base base"] | None = eqx.field(
        converter=lambda x: None if x is None else np.array(as_array("covariance", x), np.float64),
        default=None,
    )
    deviations: float = eqx.field(converter=float, default=2.0)

    def __check_init__(self):
        p, C, size = np.asarray(self.parameters), self.covariance, self.base.size
        if p.shape != (size,) or not np.isfinite(p).all():
            raise InputError(
                f"`parameters` must hold one finite number for each base parameter ({size}), "
                f"but has shape {p.shape}: `base.from_standard` makes them of standard ones."
            )
        if not 0 <= self.deviations < np.inf:
            raise InputError(f"`deviations` must not be negative, but is {self.deviations:g}.")
        if C is None:
            return
        if C.shape != (size, size) or not np.isfinite(C).all():
            raise InputError(
                f"`covariance` must be a finite matrix of {size} rows and columns, but has shape "
                f"{C.shape}."
            )
        least = np.linalg.eigvalsh(0.5 * (C + C.T))[0]
        if least < -1e-9 * np.abs(C).max():
            raise InputError(f"`covariance` has a negative eigenvalue ({least:.3g}).")

    def __call__(
        self, motion: Motion, to_motors: Float[AnyArray, "joints joints"], scale: AnyArray
    ) -> Float[Array, "*batch joints"]:
        """Return absolute forces plus the standard deviations that must fit below the limits.

        Args:
            motion: Joint motion.
            to_motors: Matrix from joint forces to the limited ones.
            scale: Limits; a negligible fraction of them makes standard deviations smooth at zero.
        """
        forces = on_samples(self, self.forces, motion.q, motion.qd, motion.qdd)
        size = jnp.max(jnp.abs(forces @ to_motors), axis=-2)
        if self.covariance is None:
            return size
        rows = jnp.einsum("...jb,jm->...mb", self.base.regressor(motion), to_motors)
        variance = jnp.einsum("...mb,bc,...mc->...m", rows, self.covariance, rows)
        smooth = jnp.broadcast_to((1e-12 * scale) ** 2, variance.shape)
        return size + self.deviations * jnp.sqrt(jnp.maximum(variance, 0.0) + smooth)

    def forces(self, q: Coordinates, qd: Coordinates, qdd: Coordinates) -> Float[Array, "3 joints"]:
        """Return the forces of one sample: as expected, and with dry friction to either side."""
        model = self.base.model
        p = self.base.to_standard(jnp.asarray(self.parameters))
        # Below this fraction of its largest speed a joint may be about to reverse.
        width = 0.02 * np.asarray(complete_limits(model.robot).velocity)
        models = (model, _reversing(model, 1.0, width), _reversing(model, -1.0, width))
        found = jnp.stack([jnp.asarray(m.forces(p, q, qd, qdd)) for m in models])
        return found if model.robot.tool is None else found + model.known_forces(q, qd, qdd)[None]


def _reversing(model: Model, side: float, width: Float[np.ndarray, " joints"]) -> Model:
    """Return a model whose dry friction near standstill acts to one side."""

    def is_transition(part: Any) -> bool:
        return isinstance(part, AbstractTransition)

    terms = jax.tree.map(
        lambda part: Reversal(part, side, width) if is_transition(part) else part,
        model.terms,
        is_leaf=is_transition,
    )
    return eqx.tree_at(lambda m: m.terms, model, terms)


class AbstractForceLimits(AbstractConstraint):
    """Largest forces of the joints, or torques of their motors.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Unused fraction of the limits, from 0 to 1.
    """

    nominal: NominalForces
    margin: float = 0.1

    @abstractmethod
    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """Return the limits without the margin [N m or N]; infinite where there is none."""

    @abstractmethod
    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """Return the matrix from forces of the joints to the limited ones."""

    @abstractmethod
    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """Return the name of a limited force and its unit."""

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess over each limit."""
        limits = (1 - self.margin) * self.limits(robot)
        forces = self.nominal(motion, self.to_limited(robot), limits)
        limited = np.flatnonzero(np.isfinite(limits))
        size = jnp.broadcast_to(limits[limited], (*forces.shape[:-1], len(limited)))
        return forces[..., limited] / size - 1.0

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the forces that have a limit."""
        found = []
        for number, whole in enumerate(self.limits(robot).tolist()):
            if np.isfinite(whole):
                name, unit = self.named(robot, number)
                note = f"{whole:.4g} less a margin of {100 * self.margin:.4g} %"
                limit = (1 - self.margin) * whole
                found.append(Finding(name, limit, unit, limit, note=note if self.margin else ""))
        return tuple(found)


class JointForces(AbstractForceLimits):
    r"""Limits of the joints' forces, with room for their uncertainty.

    $$|Q_i| + k\,\sigma_i \le (1 - m)\,Q_{i,max}$$

    The forces are those of nominal parameters; their standard deviation is that of the nominal
    parameters, propagated through the regressor. Joints without a limit are left out.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Unused fraction of the limits, from 0 to 1.
    """

    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """Return the robot's largest forces."""
        return np.asarray(robot.limits.force)

    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """Return the identity."""
        return np.eye(robot.joints)

    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """Return the name and unit of a joint's force."""
        return f"the force of joint `{robot.joint_names[number]}`", robot.force_unit(number)


class MotorTorques(AbstractForceLimits):
    """Limits of the motors' torques, on the motors' side.

    Like `JointForces`, for robots whose drives are known: where a motor turns several joints, its
    torque is not that of one of them.

    Attributes:
        nominal: Nominal parameters and their uncertainty.
        margin: Unused fraction of the limits, from 0 to 1.
    """

    def limits(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """Return the drives' largest torques."""
        return np.asarray(robot.drives.max_torques)

    def to_limited(self, robot: Robot) -> Float[np.ndarray, "joints joints"]:
        """Return the matrix from joint forces to motor torques."""
        return np.linalg.inv(np.asarray(robot.drives.reduction))

    def named(self, robot: Robot, number: int) -> tuple[str, str]:
        """Return the name and unit of a motor's torque."""
        return f"the torque of motor {number + 1}", "N m"


def _length(vector: Array) -> Array:
    """Return the length of vectors, smooth at zero and there at most 1e-6 too large."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + 1e-6**2)


def _check_positive(name: str, limit: float, unit: str) -> None:
    if not 0 < limit < np.inf:
        raise InputError(f"`limit` of `{name}` must be positive [{unit}], but is {limit:g}.")
