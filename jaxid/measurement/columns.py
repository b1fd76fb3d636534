"""Meaning and units of the columns of a log."""

from collections.abc import Iterable

import equinox as eqx
import numpy as np

from jaxid.errors import InputError
from jaxid.measurement import units
from jaxid.measurement.units import Quantity, Unit
from jaxid.robot.joints import per_joint

Selection = str | int | tuple[str | int, ...]
"""A name, a pattern with `{}` for the joint's number, a position from 0, or several."""


def _selection(value: Selection | range | list) -> Selection:
    return value if isinstance(value, str | int) else tuple(value)


def _optional_selection(value: Selection | range | list | None) -> Selection | None:
    return None if value is None else _selection(value)


def _numbers(value: Iterable[float | int] | np.ndarray | None) -> tuple[float, ...] | None:
    return None if value is None else tuple(float(v) for v in value)


def _number(value: float | int | None) -> float | None:
    return None if value is None else float(value)


def _units(value: Unit | Iterable[Unit]) -> Unit | tuple[Unit, ...]:
    return value if isinstance(value, Unit) else tuple(value)


def _optional_units(value: Unit | Iterable[Unit] | None) -> Unit | tuple[Unit, ...] | None:
    return None if value is None else _units(value)


class Columns(eqx.Module):
    """Columns of a log that hold the time, the angles and the forces of a robot.

    A group of columns is a tuple of names, a pattern such as `"q{}"` (`{}` stands for the joints'
    numbers, from 1 or from 0), a tuple of positions from 0 (files without a header), or one name:
    that of the column of a single joint, or of a whole array (samples x joints) in NPZ and MAT
    files.

    Angles become `sign * unit * value + offset`, velocities `sign * unit * value`, and forces
    `sign * gain * torque constant * unit * value`. A unit is one for all joints, or one for each.

    Attributes:
        angles: Joint or motor angles.
        forces: Joint forces, motor torques or motor currents.
        velocities: Measured velocities, on the same side as the angles, like `"dq{}"`; None if
            there are none.
        time: Time stamps; None if `sample_time` is given.
        sample_time: Time between two rows [s], instead of time stamps, like `0.001`.
        time_unit: Unit of the stamps.
        angle_unit: Unit of the angles.
        velocity_unit: Unit of the velocities, like `"rad/s"`; the angles' unit per second if
            None.
        force_unit: Unit of the forces; currents need `torque_constants`.
        torque_constants: Torque of each motor for its current [N m/A].
        angle_signs: +1 or -1 for each joint, for the angles and velocities.
        force_signs: +1 or -1 for each joint.
        angle_offsets: Offsets that are added to the angles [rad or m], like `0.0`.
        force_gains: Ratio of the true forces to those of the log, as a known load tells.
        angles_on_motor_side: Whether angles and velocities are the motors', before the gears.
        forces_on_motor_side: Whether forces are the motors', before the gears.
    """

    angles: Selection = eqx.field(static=True, converter=_selection)
    forces: Selection = eqx.field(static=True, converter=_selection)
    velocities: Selection | None = eqx.field(
        static=True, converter=_optional_selection, default=None
    )
    time: str | int | None = eqx.field(static=True, default=None)
    sample_time: float | None = eqx.field(static=True, converter=_number, default=None)
    time_unit: Unit = eqx.field(static=True, default=units.S)
    angle_unit: Unit | tuple[Unit, ...] = eqx.field(
        static=True, converter=_units, default=units.RAD
    )
    velocity_unit: Unit | tuple[Unit, ...] | None = eqx.field(
        static=True, converter=_optional_units, default=None
    )
    force_unit: Unit | tuple[Unit, ...] = eqx.field(static=True, converter=_units, default=units.NM)
    torque_constants: tuple[float, ...] | None = eqx.field(
        static=True, converter=_numbers, default=None
    )
    angle_signs: tuple[float, ...] | None = eqx.field(static=True, converter=_numbers, default=None)
    force_signs: tuple[float, ...] | None = eqx.field(static=True, converter=_numbers, default=None)
    angle_offsets: tuple[float, ...] | None = eqx.field(
        static=True, converter=_numbers, default=None
    )
    force_gains: tuple[float, ...] | None = eqx.field(static=True, converter=_numbers, default=None)
    angles_on_motor_side: bool = eqx.field(static=True, default=False)
    forces_on_motor_side: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        """Refuse contradictions."""
        if (self.time is None) == (self.sample_time is None):
            raise InputError(
                "`Columns` needs either `time` (the column of the time stamps) or `sample_time` "
                "[s] (rows are equally far apart), but has "
                + ("neither." if self.time is None else "both: leave out the one not to trust.")
            )
        if self.sample_time is not None and not 0 < self.sample_time < np.inf:
            raise InputError(f"`sample_time` must be positive [s], but is {self.sample_time:g}.")
        for name, given, allowed in (
            ("time_unit", self.time_unit, (Quantity.TIME,)),
            ("angle_unit", self.angle_unit, (Quantity.COORDINATE,)),
            ("velocity_unit", self.velocity_unit, (Quantity.VELOCITY,)),
            ("force_unit", self.force_unit, (Quantity.FORCE, Quantity.CURRENT)),
        ):
            for one in _each(given):
                if one.quantity not in allowed:
                    raise InputError(
                        f"`{name}` must measure {' or '.join(q.value for q in allowed)}, "
                        f"but `{one.symbol}` measures {one.quantity.value}."
                    )
        for name in ("angle_signs", "force_signs"):
            signs = getattr(self, name)
            if signs is not None and any(abs(s) != 1 for s in signs):
                raise InputError(f"`{name}` must be +1 or -1 for each joint, but is {signs}.")
        constants = self.torque_constants
        if constants is not None and not all(c != 0 and np.isfinite(c) for c in constants):
            raise InputError(
                "`torque_constants` must be numbers other than zero [N m/A], but are "
                f"{', '.join(f'{c:g}' for c in constants)}."
            )
        if self.force_gains is not None and not all(0 < g < np.inf for g in self.force_gains):
            raise InputError(
                f"`force_gains` must be positive for each joint, but is {self.force_gains}."
            )
        current = any(u.quantity is Quantity.CURRENT for u in _each(self.force_unit))
        if current != (self.torque_constants is not None):
            raise InputError(
                "`torque_constants` [N m/A] are needed when `force_unit` is a current, and only "
                "then: " + ("add them." if current else "leave them out or set `force_unit`.")
            )

    def angle_scale(self, joints: int) -> np.ndarray:
        """Return the factors from the numbers in the log to angles [rad or m]."""
        signs = _per_joint("angle_signs", self.angle_signs, joints, 1.0)
        return signs * _factors("angle_unit", self.angle_unit, joints)

    def angle_shift(self, joints: int) -> np.ndarray:
        """Return the offsets of the angles [rad or m]."""
        return _per_joint("angle_offsets", self.angle_offsets, joints, 0.0)

    def velocity_scale(self, joints: int) -> np.ndarray:
        """Return the factors from the numbers in the log to velocities [rad/s or m/s]."""
        if self.velocity_unit is None:
            return self.angle_scale(joints)
        signs = _per_joint("angle_signs", self.angle_signs, joints, 1.0)
        return signs * _factors("velocity_unit", self.velocity_unit, joints)

    def force_scale(self, joints: int) -> np.ndarray:
        """Return the factors from the numbers in the log to forces [N m or N]."""
        scale = _factors("force_unit", self.force_unit, joints)
        scale = scale * _per_joint("force_signs", self.force_signs, joints, 1.0)
        scale = scale * _per_joint("force_gains", self.force_gains, joints, 1.0)
        return scale * _per_joint("torque_constants", self.torque_constants, joints, 1.0)


def _each(given: Unit | tuple[Unit, ...] | None) -> tuple[Unit, ...]:
    if given is None:
        return ()
    return (given,) if isinstance(given, Unit) else given


def _factors(name: str, given: Unit | tuple[Unit, ...], joints: int) -> np.ndarray:
    if isinstance(given, Unit):
        return np.full(joints, given.factor)
    return _per_joint(name, tuple(one.factor for one in given), joints, 1.0)


def _per_joint(
    name: str, value: tuple[float, ...] | None, joints: int, default: float
) -> np.ndarray:
    return per_joint(name, None if value is None else np.array(value), joints, default)
