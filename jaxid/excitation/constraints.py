"""Constraints of a motion beside the limits of the joints: forces, end-effector, collisions."""

import functools
import math
import operator
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Int, as_array, namespace
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import in_numpy, on_samples, program_of
from jaxid.dynamics.model import Coordinates
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTransition, Reversal
from jaxid.errors import InputError
from jaxid.program.gradient import pull_back
from jaxid.robot.collision import CollisionModel
from jaxid.robot.forward_kinematics import tip_placement
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import complete_limits


class Finding(NamedTuple):
    """A limited quantity, and how far a motion is from the limit.

    Attributes:
        name: Name of the quantity, as it reads in a sentence: `torque of joint 3`.
        size: Physical size of a constraint's value of 1.
        unit: Physical unit.
        limit: Limit of the quantity in this unit; NaN if it has no name.
        least: Whether the quantity must not fall below the limit, rather than not rise
            above it.
        note: Origin of the limit: `12 less a margin of 50 %`.
        value: Relative excess over the limit; negative or zero where it is kept.
        usage: Function of the relative excess that returns the used fraction of the
            limit.
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

    def __str__(self) -> str:
        """Return one sentence."""
        note = f" ({self.note})" if self.note else ""
        bound = (
            f": at {'least' if self.least else 'most'} {self.limit:.4g} "
            f"{self.unit}{note}"
        )
        bound = "" if math.isnan(self.limit) else bound
        amount = f"{abs(self.excess):.3g} {self.unit}"
        if self.value <= 0:
            return f"{self.name} keeps its limit with {amount} to spare{bound}"
        if self.least:
            return f"{self.name} falls short of its limit by {amount}{bound}"
        return (
            f"{self.name} exceeds its limit by {amount} ({100 * self.value:.3g} "
            f"%){bound}"
        )


BLOCK = 96
"""Samples for which derivatives are compiled: those that the search watches of one motion."""


class AbstractConstraint(eqx.Module):
    """Limits on a motion that are not linear in the joints' motion.

    Each sample of a motion is evaluated by itself, so that solvers can ask for values
    and derivatives at any instants. Values are smooth where possible, and relative: in
    units of the limit, or of another size that `entries` names.
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

    def linearise(
        self, robot: Robot, motion: Motion, chosen: Int[np.ndarray, " samples"]
    ) -> tuple[
        Float[np.ndarray, " samples"], list[Float[np.ndarray, "samples joints"]]
    ]:
        """Return one value of each sample, and its derivatives by q, qd, qdd, in NumPy.

        Derivatives by qd and qdd may be left out where values depend on q only.

        Args:
            robot: Robot that moves.
            motion: Joint motion in NumPy, with one axis of samples.
            chosen: Place of each sample's value in `entries`.
        """
        run, samples = _compiled(_Same(self, robot)), len(chosen)
        # Another number of samples would compile anew.
        padded = np.resize(np.arange(samples), BLOCK * -(-samples // BLOCK)).reshape(
            -1, BLOCK
        )
        parts = (chosen, motion.q, motion.qd, motion.qdd)
        found = [run(*(x[block] for x in parts)) for block in padded]
        values, *slopes = (
            np.concatenate(x)[:samples] for x in zip(*found, strict=True)
        )
        return values, slopes

    def describe(
        self, robot: Robot, values: Float[AnyArray, "*batch values"]
    ) -> list[Finding]:
        """Return the limited quantities with the largest of their values."""
        entries = self.entries(robot)
        peaks = np.asarray(values).reshape(-1, len(entries)).max(axis=0)
        return [e._replace(value=float(v)) for e, v in zip(entries, peaks, strict=True)]


class _Same:
    """Constraint and robot as the key of a compiled function: by identity, as their arrays are."""

    def __init__(self, constraint: AbstractConstraint, robot: Robot):
        self.parts = constraint, robot

    def __hash__(self) -> int:
        return hash(tuple(map(id, self.parts)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and all(
            map(operator.is_, self.parts, other.parts)
        )


@functools.lru_cache(maxsize=16)
def _compiled(key: _Same) -> Callable:
    constraint, robot = key.parts

    @jax.jit
    def linearised(chosen: Array, *parts: Array) -> tuple[Array, ...]:
        def value(*parts: Array) -> Array:
            values = constraint(robot, Motion(*parts))
            return jnp.take_along_axis(values, chosen[:, None], axis=1)[:, 0]

        values, pull = jax.vjp(value, *parts)
        return values, *pull(jnp.ones_like(values))

    return linearised


def _pull(
    owner: eqx.Module, definition: Callable, weights: np.ndarray, *arrays: AnyArray
) -> list[Float[np.ndarray, "samples joints"]]:
    """Return derivatives of weighted results of a method for one sample, for rows of samples."""
    program = program_of(owner, definition, *(x.shape[1:] for x in arrays))
    slopes = pull_back(
        program, weights.reshape(len(weights), -1).T, *(np.asarray(x).T for x in arrays)
    )
    return [x.T for x in slopes]


def tip_motion(robot: Robot, motion: Motion) -> tuple[Float[AnyArray, "*batch 3"], ...]:
    """Return position, velocity and acceleration of the end-effector's origin [m, s].

    They are those in the frame of the ground, without gravity.

    Args:
        robot: Robot that moves.
        motion: Joint motion with any leading axes.
    """

    def place(q):
        return tip_placement(robot, q)[1]

    def speed(q, qd):
        return jax.jvp(place, (q,), (qd,))[1]

    def tip(q, qd, qdd):
        velocity, acceleration = jax.jvp(speed, (q, qd), (qd, qdd))
        return jnp.stack([place(q), velocity, acceleration])

    states = on_samples(robot, tip, motion.q, motion.qd, motion.qdd)
    return tuple(states[..., k, :] for k in range(3))


class Clearance(AbstractConstraint):
    """Least distance between the surfaces of shapes that must not collide.

    Values count in units of 0.1 m: two shapes that overlap by 0.17 m where 0.03 m are
    required give 2.

    Attributes:
        model: Shapes and pairs.
        distance: Least distance between surfaces [m]; half of the largest one of two
            bodies that are nearer in every pose.
    """

    model: CollisionModel
    distance: float = 0.03

    @property
    def distances(self) -> Float[np.ndarray, " pairs"]:
        """Least distance of each pair [m]."""
        return np.minimum(self.distance, 0.5 * np.array(self.model.room))

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the missing distance of each pair."""
        ends = eqx.Partial(self.model.ends, robot)
        gaps = self.model.clearances(on_samples(ends, ends.__call__, motion.q))
        return (jnp.broadcast_to(self.distances, gaps.shape) - gaps) / 0.1

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the pairs."""

        def usage(value: float, distance: float) -> float:
            left = distance - 0.1 * value
            return distance / left if left > 0 else math.inf

        return tuple(
            Finding(
                f"the clearance of {name}",
                0.1,
                "m",
                distance,
                least=True,
                usage=functools.partial(usage, distance=distance),
            )
            for name, distance in zip(
                self.model.pair_names, self.distances.tolist(), strict=True
            )
        )


def _corner(x: Any) -> np.ndarray:
    return np.asarray(as_array("workspace", x), np.float64)


class TipLimits(AbstractConstraint):
    """Limits of the end-effector: speed, acceleration, and a box parallel to the axes.

    Values of the box count in half of its edges, or in metres where the opposite side
    is open.

    Attributes:
        speed: Largest speed; infinity for none [m/s].
        acceleration: Largest acceleration; infinity for none [m/s²].
        low: Smallest coordinates of the origin; minus infinity where the box is open
            [m].
        high: Largest coordinates; infinity where the box is open [m].

    Raises:
        InputError: If a limit is not positive, or `low` and `high` are no corners of a
            box.
    """

    speed: float = math.inf
    acceleration: float = math.inf
    low: Float[AnyArray, "3"] = eqx.field(converter=_corner, default=(-math.inf,) * 3)
    high: Float[AnyArray, "3"] = eqx.field(converter=_corner, default=(math.inf,) * 3)

    def __check_init__(self):
        if not (self.speed > 0 and self.acceleration > 0):
            raise InputError(
                "`speed` [m/s] and `acceleration` [m/s²] must be positive, but are "
                f"{self.speed:g} "
                f"and {self.acceleration:g}."
            )
        if (
            self.low.shape != (3,)
            or self.high.shape != (3,)
            or not (self.low < self.high).all()
        ):
            raise InputError(
                "`low` and `high` must hold three numbers each, and `low` the smaller "
                "ones, but "
                f"are {self.low} and {self.high} [m]."
            )

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess over each limit."""
        position, velocity, acceleration = tip_motion(robot, motion)
        values = []
        for vector, limit in (
            (velocity, self.speed),
            (acceleration, self.acceleration),
        ):
            if math.isfinite(limit):
                # Smooth at zero, and there at most 1e-6 too large.
                values.append(
                    jnp.sqrt(jnp.sum((vector / limit) ** 2, axis=-1) + 1e-6**2) - 1.0
                )
        for axis, sign, end, size in self._sides:
            values.append((sign * position[..., axis] - end) / size)
        return jnp.stack(values, axis=-1)

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the quantities that have a limit."""
        found = []
        rates = {
            "speed": (self.speed, "m/s"),
            "acceleration": (self.acceleration, "m/s²"),
        }
        for name, (limit, unit) in rates.items():
            if math.isfinite(limit):
                found.append(
                    Finding(f"the {name} of the end-effector", limit, unit, limit)
                )
        for axis, sign, end, size in self._sides:
            entry = Finding(
                f"{'xyz'[axis]} of the end-effector", size, "m", sign * end, sign < 0
            )
            if not np.isfinite(self.low[axis] + self.high[axis]):
                note = "the other side is open"
                entry = entry._replace(note=note, usage=lambda value: math.nan)
            found.append(entry)
        return tuple(found)

    @property
    def _sides(self) -> list[tuple[int, float, float, float]]:
        """Axis, sign, end and half edge of each side that is not open."""
        half = 0.5 * (self.high - self.low)
        half = np.where(np.isfinite(half), half, 1.0)
        return [
            (axis, sign, float(end), float(half[axis]))
            for axis in range(3)
            for sign, end in ((1.0, self.high[axis]), (-1.0, -self.low[axis]))
            if np.isfinite(end)
        ]


class ForceLimits(AbstractConstraint):
    r"""Limits of the joints' forces and of the motors' torques, with room for their uncertainty.

    $$|Q_i| + k\,\sigma_i \le (1 - m)\,Q_{i,max}$$

    The forces are those of nominal parameters; their standard deviation is that of the
    nominal parameters, propagated through the regressor. Near standstill dry friction
    counts in the direction that is worse: a joint that reverses passes through both,
    between any two samples. Joints and motors without a limit are left out.

    Attributes:
        base: Base parameters.
        parameters: Nominal values of the base parameters: of a CAD model, or of an
            earlier fit.
        covariance: Covariance of the nominal values; None if they count as known.
        margin: Unused fraction $m$ of the limits, from 0 to 1.
        deviations: Number $k$ of standard deviations that must fit below the limits.

    Raises:
        InputError: If there is not one number for each base parameter, or the
            covariance is not finite.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"] = eqx.field(
        converter=lambda x: np.array(as_array("parameters", x), np.float64)
    )
    covariance: Float[AnyArray, "base base"] | None = eqx.field(
        converter=lambda x: (
            None if x is None else np.array(as_array("covariance", x), np.float64)
        ),
        default=None,
    )
    margin: float = 0.1
    deviations: float = eqx.field(converter=float, default=2.0)

    def __check_init__(self):
        p, C, size = np.asarray(self.parameters), self.covariance, self.base.size
        if p.shape != (size,) or not np.isfinite(p).all():
            raise InputError(
                "`parameters` must hold one finite number for each base parameter "
                f"({size}), "
                f"but has shape {p.shape}: `base.from_standard` makes them of "
                "standard ones."
            )
        if C is None:
            return
        fits = C.shape == (size, size) and np.isfinite(C).all()
        if not fits or np.linalg.eigvalsh(C)[0] < -1e-9 * np.abs(C).max():
            raise InputError(
                f"`covariance` must be a finite matrix of {size} rows and columns "
                "without "
                "negative eigenvalues."
            )

    def __call__(self, robot: Robot, motion: Motion) -> Float[Array, "*batch values"]:
        """Return the relative excess over each limit."""
        limits, to_limited = self._limited(robot)
        forces = self._forces(motion)
        xp = namespace(forces)
        size = xp.max(xp.abs(forces @ to_limited), axis=-2)
        if self.covariance is not None:
            rows = xp.einsum("...jb,jm->...mb", self.base.regressor(motion), to_limited)
            variance = xp.einsum("...mb,bc,...mc->...m", rows, self.covariance, rows)
            # A negligible fraction of the limits makes standard deviations smooth at
            # zero.
            smooth = xp.broadcast_to((1e-12 * limits) ** 2, variance.shape)
            size = size + self.deviations * xp.sqrt(xp.maximum(variance, 0.0) + smooth)
        return size / xp.broadcast_to(limits, size.shape) - 1.0

    def _limited(self, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
        """Return all limits, and the matrix from joint forces to what they limit."""
        whole = self._whole(robot)
        finite = np.isfinite(whole)
        to_motors = np.linalg.inv(np.asarray(robot.drives.reduction))
        to_limited = np.concatenate([np.eye(robot.joints), to_motors], axis=1)[
            :, finite
        ]
        return (1 - self.margin) * whole[finite], to_limited

    def _forces(self, motion: Motion) -> Float[AnyArray, "*batch 3 joints"]:
        known = not isinstance(motion.q, jax.Array) and motion.q.ndim == 2
        return (in_numpy if known else on_samples)(
            self, self.forces, motion.q, motion.qd, motion.qdd
        )

    def linearise(
        self, robot: Robot, motion: Motion, chosen: Int[np.ndarray, " samples"]
    ) -> tuple[
        Float[np.ndarray, " samples"], list[Float[np.ndarray, "samples joints"]]
    ]:
        """Return one relative excess of each sample, and its derivatives, in NumPy."""
        limits, to_limited = self._limited(robot)
        samples = np.arange(len(chosen))
        sides = np.einsum("tsj,jt->ts", self._forces(motion), to_limited[:, chosen])
        side = np.abs(sides).argmax(axis=1)
        largest = sides[samples, side]
        weights = np.zeros((len(samples), 3, robot.joints))
        scale = np.sign(largest) / limits[chosen]
        weights[samples, side] = (to_limited[:, chosen] * scale).T
        slopes = _pull(self, self.forces, weights, motion.q, motion.qd, motion.qdd)
        size = np.abs(largest)
        if self.covariance is not None:
            base, share = self.base, to_limited[:, chosen].T
            rows = np.einsum("tjb,tj->tb", np.asarray(base.regressor(motion)), share)
            spread = rows @ self.covariance
            smooth = (1e-12 * limits[chosen]) ** 2
            deviation = np.sqrt(np.maximum((rows * spread).sum(axis=1), 0.0) + smooth)
            weight = self.deviations / deviation / limits[chosen]
            weights = share[:, :, None] * (spread * weight[:, None])[:, None]
            more = _pull(base, base.columns, weights, *base.model.arguments(motion))
            slopes = [x + y for x, y in zip(slopes, more, strict=True)]
            size = size + self.deviations * deviation
        return size / limits[chosen] - 1.0, slopes

    def forces(
        self, q: Coordinates, qd: Coordinates, qdd: Coordinates
    ) -> Float[Array, "3 joints"]:
        """Return the forces of one sample: as expected, and with dry friction to either side."""
        model = self.base.model
        p = self.base.to_standard(jnp.asarray(self.parameters))
        # Below this fraction of its largest speed a joint may be about to reverse.
        width = 0.02 * np.asarray(complete_limits(model.robot).velocity)

        def is_transition(part: Any) -> bool:
            return isinstance(part, AbstractTransition)

        def reversing(part: Any, side: float) -> Any:
            return Reversal(part, side, width) if is_transition(part) else part

        sides = [eqx.Partial(reversing, side=side) for side in (1.0, -1.0)]
        models = [
            model,
            *(jax.tree.map(side, model, is_leaf=is_transition) for side in sides),
        ]
        found = jnp.stack([jnp.asarray(m.forces(p, q, qd, qdd)) for m in models])
        return found + model.known_forces(q, qd, qdd)[None]

    def entries(self, robot: Robot) -> tuple[Finding, ...]:
        """Return the forces and torques that have a limit."""
        joints = [
            (f"the force of joint `{name}`", robot.force_unit(k))
            for k, name in enumerate(robot.joint_names)
        ]
        motors = [(f"the torque of motor {k + 1}", "N m") for k in range(robot.joints)]
        found = []
        for (name, unit), whole in zip(
            joints + motors, self._whole(robot).tolist(), strict=True
        ):
            note = (
                f"{whole:.4g} less a margin of {100 * self.margin:.4g} %"
                if self.margin
                else ""
            )
            limit = (1 - self.margin) * whole
            found.append(Finding(name, limit, unit, limit, note=note))
        return tuple(entry for entry in found if np.isfinite(entry.limit))

    @staticmethod
    def _whole(robot: Robot) -> np.ndarray:
        """Return the limits of all joints, then of all motors [N m or N]."""
        return np.concatenate([robot.limits.force, robot.drives.max_torques])
