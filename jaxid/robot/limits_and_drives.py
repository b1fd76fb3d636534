"""Limits and drives of a robot's joints, and numbers that may be in other units."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, Numbers, given, namespace
from jaxid.errors import InputError

FAR, FARTHEST = 10.0, 1000.0
"""Lengths that may be in millimetres, and that no robot has [m]."""

PerJoint = Float[AnyArray, " joints"]
Batch = Float[AnyArray, "*batch joints"]


class Limits(eqx.Module):
    """Limits of every joint, in the joint's own unit ([rad] or [m]); infinite where unknown.

    Limits that are not given are infinite. JAX arrays are taken as they are, so that
    limits can be traced and batched; all others are checked and copied.

    Args:
        joints: Number of joints; that of the given limits if None.
        position_min: Lower end of each range [rad or m].
        position_max: Upper end of each range [rad or m].
        velocity: Largest speeds [rad/s or m/s].
        acceleration: Largest accelerations [rad/s² or m/s²].
        jerk: Largest jerks [rad/s³ or m/s³].
        force: Largest generalised forces [N m or N].
        assumed: Names of fields whose numbers nobody published, or `field of joint`
            where only one joint's number is assumed.

    Raises:
        InputError: If a limit has the wrong length, is not positive although it is a
            magnitude, or leaves a joint no range.
    """

    joints: dataclasses.InitVar[int | None] = None
    _: dataclasses.KW_ONLY
    position_min: PerJoint = eqx.field(converter=given, default=None)
    position_max: PerJoint = eqx.field(converter=given, default=None)
    velocity: PerJoint = eqx.field(converter=given, default=None)
    acceleration: PerJoint = eqx.field(converter=given, default=None)
    jerk: PerJoint = eqx.field(converter=given, default=None)
    force: PerJoint = eqx.field(converter=given, default=None)
    assumed: tuple[str, ...] = eqx.field(static=True, default=())

    def __post_init__(self, joints: int | None):
        magnitudes = ("velocity", "acceleration", "jerk", "force")
        sizes = {name: getattr(self, name) for name in magnitudes}
        n = _count(joints, self.position_min, self.position_max, *sizes.values())
        self.position_min = per_joint("position_min", self.position_min, n, -np.inf)
        self.position_max = per_joint("position_max", self.position_max, n, np.inf)
        for name, value in sizes.items():
            setattr(self, name, _magnitudes(name, value, n))
        low, high = self.position_min, self.position_max
        if (
            isinstance(low, np.ndarray)
            and isinstance(high, np.ndarray)
            and (low >= high).any()
        ):
            j = int(np.flatnonzero(low >= high)[0])
            raise InputError(
                f"`position_min` of joint {j + 1} must be below {high[j]:g}, but is "
                f"{low[j]:g}."
            )


class Drives(Hashable):
    r"""The motors of a robot: $q_M = A (q - q_0)$ and, by equal power, $Q = A^T M$ (Eq. 19).

    For independent axes $A$ is the diagonal matrix of gear ratios; a wrist whose motors
    turn more than one axis has entries beside the diagonal. Drives without arguments
    are direct.

    Args:
        joints: Number of joints; that of the given values if None.
        reduction: $A$, motor angle for joint angle: one gear ratio for each joint, or a
            matrix; [1] for a revolute joint, [rad/m] for a rail.
        zero: Joint angle $q_0$ at which the motor angles are zero [rad or m].
        max_torques: Largest torque of each motor, on the motor's side [N m]; infinite
            if unknown.
        rotor_inertia: Inertia of each motor, on the motor's side [kg m²]; NaN if
            unknown. It is displayed only: the inertia that the joints feel is
            identified.

    Raises:
        InputError: If a length is wrong, the matrix is not invertible, or a number is
            out of range.
    """

    joints: dataclasses.InitVar[int | None] = None
    _: dataclasses.KW_ONLY
    reduction: Float[AnyArray, "joints joints"] = eqx.field(
        converter=given, default=None
    )
    zero: PerJoint = eqx.field(converter=given, default=None)
    max_torques: PerJoint = eqx.field(converter=given, default=None)
    rotor_inertia: PerJoint = eqx.field(converter=given, default=None)

    def __post_init__(self, joints: int | None):
        n = _count(
            joints, self.reduction, self.zero, self.max_torques, self.rotor_inertia
        )
        matrix = np.eye(n) if self.reduction is None else self.reduction
        if not isinstance(matrix, jax.Array) or matrix.ndim != 2:
            matrix = np.array(matrix, dtype=np.float64)
            matrix = np.diag(matrix) if matrix.shape == (n,) else matrix
            if matrix.shape != (n, n) or not np.isfinite(matrix).all():
                raise InputError(
                    f"`reduction` must hold {n} or {n} x {n} finite ratios, not "
                    f"{matrix.shape}."
                )
            largest = np.abs(matrix).max(axis=1)
            if not largest.all() or np.linalg.cond(matrix / largest[:, None]) > 1e8:
                raise InputError(
                    "`reduction` must be invertible: is a gear ratio zero?"
                )
        self.reduction = matrix
        self.zero = per_joint("zero", self.zero, n, 0.0)
        _require("zero", self.zero, np.isfinite, "finite")
        self.max_torques = _magnitudes("max_torques", self.max_torques, n)
        self.rotor_inertia = per_joint("rotor_inertia", self.rotor_inertia, n, np.nan)
        _require(
            "rotor_inertia", self.rotor_inertia, lambda x: ~(x < 0), "zero or more"
        )

    @property
    def is_direct(self) -> bool:
        """Whether motors and joints coincide: unit gears and no offset."""
        eye = np.eye(len(self.zero))
        return np.array_equal(self.reduction, eye) and not np.any(self.zero)

    @property
    def _inverse(self) -> Float[AnyArray, "joints joints"]:
        return namespace(self.reduction).linalg.inv(self.reduction)

    def _zeros(self, like: AnyArray) -> AnyArray:
        return namespace(like, self.zero).broadcast_to(self.zero, like.shape)

    def joint_angles(self, motor_angles: Batch) -> Batch:
        """Return joint angles [rad or m] of motor angles [rad]."""
        return self.joint_velocities(motor_angles) + self._zeros(motor_angles)

    def joint_velocities(self, motor_velocities: Batch) -> Batch:
        """Return joint velocities [rad/s or m/s] of motor velocities [rad/s], or accelerations."""
        return motor_velocities @ self._inverse.T

    def joint_forces(self, motor_torques: Batch) -> Batch:
        """Return generalised forces [N m or N] of motor torques [N m] (Eq. 19)."""
        return motor_torques @ self.reduction

    def motor_angles(self, angles: Batch) -> Batch:
        """Return motor angles [rad] of joint angles [rad or m]."""
        return self.motor_velocities(angles - self._zeros(angles))

    def motor_velocities(self, velocities: Batch) -> Batch:
        """Return motor velocities [rad/s] of joint velocities [rad/s or m/s]."""
        return velocities @ self.reduction.T

    def motor_torques(self, forces: Batch) -> Batch:
        """Return motor torques [N m] of generalised forces [N m or N]."""
        return forces @ self._inverse

    @property
    def max_forces(self) -> PerJoint:
        r"""Largest generalised forces of the motors, $|A|^T M_{max}$ [N m or N] (Eq. 30)."""
        weights = np.abs(self.reduction)
        used = np.where(weights > 0, self.max_torques[:, None], 0.0)
        return (weights * used).sum(axis=0)


def _count(joints: int | None, *values: Numbers | None) -> int:
    """Return the number of joints: as given, or as many as the first of the values holds."""
    given = [np.shape(x) for x in values if x is not None]
    if joints is None and not any(given):
        raise InputError(
            "`joints` must be given where no list with one number for each joint is."
        )
    return next(shape[0] for shape in given if shape) if joints is None else joints


def per_joint(name: str, value: Numbers | None, joints: int, unknown: float) -> Any:
    """Check and copy one number for each joint; JAX arrays are taken as they are.

    `unknown` stands in place of None; if it is NaN, the values may contain NaN.
    """
    if isinstance(value, jax.Array):
        return value
    array = (
        np.full(joints, unknown) if value is None else np.array(value, dtype=np.float64)
    )
    if array.shape != (joints,):
        raise InputError(
            f"`{name}` must hold one number for each joint ({joints}), but has shape "
            f"{array.shape}."
        )
    if not np.isnan(unknown):
        _require(name, array, lambda x: ~np.isnan(x), "a number")
    return array


def _magnitudes(name: str, value: Numbers | None, joints: int) -> Any:
    values = per_joint(name, value, joints, np.inf)
    _require(name, values, lambda x: x > 0, "positive")
    return values


def _require(name: str, values: AnyArray, rule: Any, words: str) -> None:
    """Check a rule that reads after "must be", unless the values are a JAX array."""
    if isinstance(values, np.ndarray) and not np.all(rule(values)):
        j = int(np.flatnonzero(~rule(values))[0])
        raise InputError(
            f"`{name}` must be {words}, but that of joint {j + 1} is {values[j]:g}."
        )


def range_fault(low: float, high: float, revolute: bool) -> str:
    """Return why no joint has such a range [rad or m], as the predicate of a sentence; or ""."""
    ends = [x for x in (low, high) if np.isfinite(x)]
    far = max(ends, key=abs, default=0.0)
    if abs(far) <= (8 * np.pi if revolute else FARTHEST):
        return ""
    if revolute:
        return f"ranges to {far:g} rad, which is {abs(far) / (2 * np.pi):.3g} turns"
    return f"ranges to {far:g} m, which no robot does"


def far_notes(owner: str, lengths: Numbers) -> tuple[str, ...]:
    """Return a note if the largest of some lengths [m] may be in millimetres."""
    sizes = np.abs(np.asarray(lengths, np.float64))
    far = sizes[np.isfinite(sizes) & (sizes > FAR)].tolist()
    return (f"{owner} is {max(far):g} m: is the length in millimetres?",) if far else ()


def limit_notes(
    names: Sequence[str], revolute: Sequence[bool], limits: Limits
) -> Iterator[str]:
    """Yield notes on limits that may be in millimetres or in degrees per second."""
    low = limits.position_min
    high = limits.position_max
    speeds = limits.velocity
    if not all(isinstance(x, np.ndarray) and x.ndim == 1 for x in (low, high, speeds)):
        return
    fast: dict[float, list[str]] = {}
    for name, turns, speed, *ends in zip(
        names, revolute, speeds, low, high, strict=True
    ):
        if not turns:
            yield from far_notes(f"joint `{name}`: an end of its range", ends)
        elif 50.0 < speed < np.inf:
            fast.setdefault(float(speed), []).append(name)
    for speed, group in fast.items():
        yield (
            f"{owners('joint', group)}: a velocity of up to {speed:g} rad/s is "
            f"{30 * speed / np.pi:.4g} turns a minute: is the limit in degrees per "
            "second, or none?"
        )


def owners(kind: str, names: Sequence[str]) -> str:
    """Return how a note names one or several joints or links."""
    return f"{kind}s {listed(names)}" if len(names) > 1 else f"{kind} `{names[0]}`"


def listed(names: Sequence[str]) -> str:
    """Return names in backticks, the first eight of them."""
    shown = ", ".join(f"`{name}`" for name in names[:8])
    return shown if len(names) <= 8 else f"{shown} and {len(names) - 8} more"
