"""Limits and drives of a robot's joints, and numbers that may be in other units."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    Joints,
    ManyJoints,
    Numbers,
    Texts,
    Vector,
    given,
    namespace,
)
from jaxid.errors import InputError

DOUBTFUL_LENGTH = 10.0
"""Length from which on the unit may be a millimetre [m]."""
MAX_LENGTH = 1000.0
"""Length that no robot reaches [m]."""
MAX_LINK_LENGTH = 50.0
"""Length that no link of a robot has [m]."""
MAX_STATED_LENGTH = 1e5
"""Longest rail that a file can state, in millimetres; longer ones are no limits."""
MAX_STATED_ANGLE = 720.0
"""Largest end of a range that a file can state, in degrees; others are no limits."""
MAX_RANGE_ANGLE = 8 * np.pi
"""Largest end of the range of a joint in radians, but for whole eighth turns [rad]."""
EIGHTH_TURN = np.pi / 4
DOUBTFUL_SPEED = 50.0
"""Speed from which on the unit may be a degree per second [rad/s]."""
FULL_TURN = 2 * np.pi + 0.01
"""Angle up to which every number is in radians; a full turn may be rounded [rad]."""


class Limits(eqx.Module):
    """Limits of every joint, in its own unit ([rad] or [m]); infinite where unknown.

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
    position_min: Joints = eqx.field(converter=given, default=None)
    position_max: Joints = eqx.field(converter=given, default=None)
    velocity: Joints = eqx.field(converter=given, default=None)
    acceleration: Joints = eqx.field(converter=given, default=None)
    jerk: Joints = eqx.field(converter=given, default=None)
    force: Joints = eqx.field(converter=given, default=None)
    assumed: Texts = eqx.field(static=True, default=())

    def __post_init__(self, joints: int | None):
        # All but the ends of the ranges are sizes, which must be positive.
        names = ("velocity", "acceleration", "jerk", "force")
        magnitudes = {name: getattr(self, name) for name in names}
        ends = (self.position_min, self.position_max)
        n = _count(joints, *ends, *magnitudes.values())
        low = per_joint("position_min", self.position_min, n, -np.inf)
        high = per_joint("position_max", self.position_max, n, np.inf)
        self.position_min = low
        self.position_max = high
        for name, value in magnitudes.items():
            setattr(self, name, _magnitudes(name, value, n))
        # Traced limits have no values to compare.
        if isinstance(low, np.ndarray) and isinstance(high, np.ndarray):
            _require_ranges(low, high)


class Drives(Hashable):
    r"""Motors: $q_M = A (q - q_0)$ and, by equal power, $Q = A^T M$ (Eq. 19).

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
        stated_ratios: Gear ratios that the robot's file states, which are proposed for
            `reduction` where a log needs it; 1 where it states none.

    Raises:
        InputError: If a length is wrong, the matrix is not invertible, or a number is
            out of range.
    """

    joints: dataclasses.InitVar[int | None] = None
    _: dataclasses.KW_ONLY
    reduction: Float[AnyArray, "joints joints"] = eqx.field(
        converter=given, default=None
    )
    zero: Joints = eqx.field(converter=given, default=None)
    max_torques: Joints = eqx.field(converter=given, default=None)
    rotor_inertia: Joints = eqx.field(converter=given, default=None)
    stated_ratios: Joints = eqx.field(converter=given, default=None)

    def __post_init__(self, joints: int | None):
        n = _count(
            joints,
            self.reduction,
            self.zero,
            self.max_torques,
            self.rotor_inertia,
        )
        self.reduction = _reduction_matrix(self.reduction, n)
        self.zero = per_joint("zero", self.zero, n, 0.0)
        _require("zero", self.zero, np.isfinite, "finite")
        self.max_torques = _magnitudes("max_torques", self.max_torques, n)
        rotor_inertia = per_joint("rotor_inertia", self.rotor_inertia, n, np.nan)
        # NaN, which is not negative, is an unknown inertia.
        _require("rotor_inertia", rotor_inertia, lambda x: ~(x < 0), "zero or more")
        self.rotor_inertia = rotor_inertia
        self.stated_ratios = per_joint("stated_ratios", self.stated_ratios, n, 1.0)

    @property
    def is_direct(self) -> bool:
        """Whether motors and joints coincide: unit gears and no offset."""
        unit_gears = np.eye(len(self.zero))
        return np.array_equal(self.reduction, unit_gears) and not np.any(self.zero)

    @property
    def lack_stated_ratios(self) -> bool:
        """Whether the robot's file states gears, but these drives are direct."""
        return self.is_direct and bool(np.any(self.stated_ratios != 1.0))

    @property
    def _inverse(self):
        """Joint angle for motor angle."""
        return namespace(self.reduction).linalg.inv(self.reduction)

    def _zeros(self, like: AnyArray):
        """Return `zero` in the shape of a batch of angles."""
        return namespace(like, self.zero).broadcast_to(self.zero, like.shape)

    def joint_angles(self, motor_angles: ManyJoints) -> ManyJoints:
        """Return joint angles [rad or m] of motor angles [rad]."""
        return self.joint_velocities(motor_angles) + self._zeros(motor_angles)

    def joint_velocities(self, motor_velocities: ManyJoints) -> ManyJoints:
        """Return joint velocities, or accelerations, of those of the motors."""
        return motor_velocities @ self._inverse.T

    def joint_forces(self, motor_torques: ManyJoints) -> ManyJoints:
        """Return generalised forces [N m or N] of motor torques [N m] (Eq. 19)."""
        return motor_torques @ self.reduction

    def motor_angles(self, angles: ManyJoints) -> ManyJoints:
        """Return motor angles [rad] of joint angles [rad or m]."""
        return self.motor_velocities(angles - self._zeros(angles))

    def motor_velocities(self, velocities: ManyJoints) -> ManyJoints:
        """Return motor velocities [rad/s] of joint velocities [rad/s or m/s]."""
        return velocities @ self.reduction.T

    def motor_torques(self, forces: ManyJoints) -> ManyJoints:
        """Return motor torques [N m] of generalised forces [N m or N]."""
        return forces @ self._inverse

    @property
    def max_forces(self) -> Joints:
        r"""Largest forces of the motors, $|A|^T M_{max}$ [N m or N] (Eq. 30)."""
        weights = np.abs(self.reduction)
        # A motor without largest torque does not limit joints that it does not turn.
        torques = np.where(weights > 0, self.max_torques[:, None], 0.0)
        return (weights * torques).sum(axis=0)


def _reduction_matrix(reduction: Any, joints: int):
    """Check gear ratios and return them as a matrix; one of JAX stays as it is."""
    if isinstance(reduction, jax.Array) and reduction.ndim == 2:
        return reduction
    if reduction is None:
        return np.eye(joints)
    matrix = np.array(reduction, dtype=np.float64)
    if matrix.shape == (joints,):
        matrix = np.diag(matrix)
    if matrix.shape != (joints, joints) or not np.isfinite(matrix).all():
        raise InputError(
            f"`reduction` must hold {joints} or {joints} x {joints} "
            f"finite ratios, not {matrix.shape}."
        )
    # Gear ratios of different sizes are no sign of a singular matrix.
    row_sizes = np.abs(matrix).max(axis=1, keepdims=True)
    if not row_sizes.all() or np.linalg.cond(matrix / row_sizes) > 1e8:
        raise InputError("`reduction` must be invertible: is a gear ratio zero?")
    return matrix


def _count(joints: int | None, *values: Numbers | None):
    """Return the number of joints: as given, or that of the first values."""
    if joints is not None:
        return joints
    for value in values:
        if value is not None and np.shape(value):
            return np.shape(value)[0]
    raise InputError("give `joints`, or a list with one number for each joint.")


def per_joint(name: str, value: Numbers | None, joints: int, unknown: float) -> Any:
    """Check and copy one number for each joint; JAX arrays are taken as they are.

    None becomes `unknown` for all joints; if that is NaN, the values may contain NaN.
    """
    if isinstance(value, jax.Array):
        return value
    if value is None:
        return np.full(joints, unknown)
    array = np.array(value, dtype=np.float64)
    if array.shape != (joints,):
        raise InputError(
            f"`{name}` must hold one number for each joint "
            f"({joints}), but has shape {array.shape}."
        )
    if not np.isnan(unknown):
        _require(name, array, lambda x: ~np.isnan(x), "a number")
    return array


def _magnitudes(name: str, value: Numbers | None, joints: int):
    """Check and copy one positive number for each joint; infinite if None."""
    values = per_joint(name, value, joints, np.inf)
    _require(name, values, lambda x: x > 0, "positive")
    return values


def _require(name: str, values: AnyArray, rule: Any, words: str):
    """Check a rule that reads after "must be", unless the values are a JAX array."""
    if not isinstance(values, np.ndarray):
        return
    faults = np.flatnonzero(~rule(values))
    if faults.size:
        joint = faults[0]
        raise InputError(
            f"`{name}` must be {words}, but that "
            f"of joint {joint + 1} is {values[joint]:g}."
        )


def _require_ranges(low: Vector, high: Vector):
    """Reject ranges whose lower end is not below the upper one."""
    faults = np.flatnonzero(low >= high)
    if faults.size:
        joint = faults[0]
        raise InputError(
            f"`position_min` of joint {joint + 1} must be "
            f"below {high[joint]:g}, but is {low[joint]:g}."
        )


def of_joints(owner: Any, joints: Sequence[int]) -> Any:
    """Return limits or drives of some joints alone."""
    fields = {}
    for field in dataclasses.fields(owner):
        values = getattr(owner, field.name, None)
        if isinstance(values, np.ndarray):
            axes = [joints] * values.ndim
            fields[field.name] = values[np.ix_(*axes)]
    return dataclasses.replace(owner, joints=len(joints), **fields)


def complete_limits(robot: Any) -> Limits:
    """Return the limits of a robot, with assumed ones for those that are unknown.

    Assumed are: half a turn or 1 m to either side; 90 degrees/s or 0.5 m/s; the
    acceleration that reaches the largest speed in 0.25 s.
    """
    limits = robot.limits
    is_revolute = np.array(robot.revolute, bool)
    half_range = np.where(is_revolute, np.pi, 1.0)
    speed = np.where(is_revolute, np.pi / 2, 0.5)
    low = np.asarray(limits.position_min)
    high = np.asarray(limits.position_max)
    has_low = np.isfinite(low)
    has_high = np.isfinite(high)

    # A range that is open on one side is as long as one that is open on both.
    assumed_low = np.where(has_high, high - 2 * half_range, -half_range)
    assumed_high = np.where(has_low, low + 2 * half_range, half_range)
    velocity = np.where(np.isfinite(limits.velocity), limits.velocity, speed)
    has_acceleration = np.isfinite(limits.acceleration)
    return dataclasses.replace(
        limits,
        position_min=np.where(has_low, low, assumed_low),
        position_max=np.where(has_high, high, assumed_high),
        velocity=velocity,
        acceleration=np.where(has_acceleration, limits.acceleration, velocity / 0.25),
    )


def range_fault(low: float, high: float, revolute: bool) -> str:
    """Return a predicate that says why no joint has such a range; or ""."""
    max_end = MAX_STATED_ANGLE if revolute else MAX_STATED_LENGTH
    # Files state huge ends where a joint has no limits.
    ends = [end for end in (low, high) if abs(end) <= max_end]
    end = max(ends, key=abs, default=0.0)
    if revolute and seems_in_degrees(end):
        return f"ranges to {end:g} rad, which is {abs(end) / (2 * np.pi):.3g} turns"
    if not revolute and abs(end) > MAX_LENGTH:
        return f"ranges to {end:g} m, further than any robot"
    return ""


def seems_in_degrees(angle: float) -> bool:
    """Return whether an angle is far too large for radians, and no eighth turns."""
    rest = abs(angle) % EIGHTH_TURN
    rounding = min(rest, EIGHTH_TURN - rest)
    return bool(abs(angle) > MAX_RANGE_ANGLE and rounding > 1e-3)


def length_notes(owner: str, lengths: Numbers) -> list[str]:
    """Return a note if the largest of some lengths [m] may be in millimetres."""
    sizes = np.abs(np.asarray(lengths, np.float64))
    length = sizes[np.isfinite(sizes)].max(initial=0.0)
    if length <= DOUBTFUL_LENGTH:
        return []
    return [f"{owner} is {length:g} m: is the length in millimetres?"]


def limit_notes(
    names: Sequence[str],
    revolute: Sequence[bool],
    limits: Limits,
) -> list[str]:
    """Return notes on limits that may be in millimetres or in degrees per second."""
    rows = (limits.position_min, limits.position_max, limits.velocity)
    if not all(isinstance(row, np.ndarray) and row.ndim == 1 for row in rows):
        return []
    notes = []
    joints_by_speed: dict[float, list[str]] = {}
    for name, turns, low, high, speed in zip(names, revolute, *rows, strict=True):
        if not turns:
            notes += length_notes(f"joint `{name}`: an end of its range", (low, high))
        elif DOUBTFUL_SPEED < speed < np.inf:
            joints_by_speed.setdefault(float(speed), []).append(name)
    for speed, joints in joints_by_speed.items():
        notes.append(
            f"{owners('joint', joints)}: a velocity of up to {speed:g} rad/s is "
            f"{30 * speed / np.pi:.4g} turns a minute: is the limit in degrees per "
            "second, or is there none?"
        )
    return notes


def owners(kind: str, names: Sequence[str]) -> str:
    """Return how a note names one or several joints or links."""
    return f"{kind}s {listed(names)}" if len(names) > 1 else f"{kind} `{names[0]}`"


def listed(names: Sequence[str]) -> str:
    """Return names in backticks, the first eight of them."""
    words = ", ".join(f"`{name}`" for name in names[:8])
    return words if len(names) <= 8 else f"{words} and {len(names) - 8} more"


def are_degrees(rpy: Vector):
    """Return whether an attitude must be in degrees: people write whole or half ones.

    Programs that add up turns write angles in radians beyond a full turn.
    """
    is_round = (np.abs(rpy) > FULL_TURN) & (2 * rpy % 1 == 0)
    return is_round.any() or any(map(seems_in_degrees, rpy))
