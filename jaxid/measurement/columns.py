"""Meaning and units of the columns of a log, and logs in SI units."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import optional
from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import per_joint
from jaxid.units import NM, RAD, Quantity, S, Unit

from .log_files import LogTable, Selection, open_log_file
from .recording import positive_time

Units = Unit | tuple[Unit, ...]
"""One unit for all joints, or one for each."""
PerJoint = tuple[float, ...] | None
"""One number for each joint, or the default for all."""


def _listed(value: Any) -> Any:
    return (
        value if value is None or isinstance(value, str | int | Unit) else tuple(value)
    )


class Columns(eqx.Module):
    """Columns of a log that hold the time, the angles and the forces of a robot.

    A group of columns is a tuple of names, a pattern such as `"q{}"` (`{}` stands for
    the joints' numbers, from 1 or from 0), a tuple of positions from 0 (files without a
    header), or one name: that of the column of a single joint, or of a whole array
    (samples x joints), whose columns are `"q[{}]"`. Fields of bags are
    `"/topic.field[{}]"`, or `"/topic.field.joint"` by names.

    Angles become `sign * unit * value + offset`, velocities `sign * unit * value`, and
    forces `sign * gain * torque constant * unit * value`. A unit is one for all joints,
    or one for each.

    Attributes:
        angles: Joint or motor angles; `{}` stands for the joints' numbers, from 1 or
            from 0.
        forces: Joint forces, motor torques or motor currents.
        velocities: Measured velocities, on the same side as the angles, like `"dq{}"`;
            None if there are none.
        time: Time stamps; None for `sample_time`, or the clock of bags and LeRobot data
            sets.
        sample_time: Time between two rows [s], instead of time stamps, like `0.001`.
        time_unit: Unit of the stamps.
        angle_unit: Unit of the angles.
        velocity_unit: Unit of the velocities, like `"rad/s"`; the angles' unit per
            second if None.
        force_unit: Unit of the forces; currents need `torque_constants`.
        torque_constants: Torque of each motor for its current [N m/A].
        angle_signs: +1 or -1 for each joint, for the angles and velocities.
        force_signs: +1 or -1 for each joint.
        angle_offsets: Offsets that are added to the angles [rad or m], like `0.0`.
        force_gains: Ratio of the true forces to those of the log, as a known load
            tells.
        angles_on_motor_side: Whether angles and velocities are the motors', before the
            gears.
        forces_on_motor_side: Whether forces are the motors', before the gears.
        unwrap: Whether angles jump by full turns, which is undone.
    """

    angles: Selection = eqx.field(static=True, converter=_listed)
    forces: Selection = eqx.field(static=True, converter=_listed)
    velocities: Selection | None = eqx.field(
        static=True, converter=_listed, default=None
    )
    time: str | int | None = eqx.field(static=True, default=None)
    sample_time: float | None = eqx.field(static=True, converter=optional, default=None)
    time_unit: Unit = eqx.field(static=True, default=S)
    angle_unit: Units = eqx.field(static=True, converter=_listed, default=RAD)
    velocity_unit: Units | None = eqx.field(
        static=True, converter=_listed, default=None
    )
    force_unit: Units = eqx.field(static=True, converter=_listed, default=NM)
    torque_constants: PerJoint = eqx.field(static=True, converter=_listed, default=None)
    angle_signs: PerJoint = eqx.field(static=True, converter=_listed, default=None)
    force_signs: PerJoint = eqx.field(static=True, converter=_listed, default=None)
    angle_offsets: PerJoint = eqx.field(static=True, converter=_listed, default=None)
    force_gains: PerJoint = eqx.field(static=True, converter=_listed, default=None)
    angles_on_motor_side: bool = eqx.field(static=True, default=False)
    forces_on_motor_side: bool = eqx.field(static=True, default=False)
    unwrap: bool = eqx.field(static=True, default=False)

    def __check_init__(self) -> None:
        """Refuse contradictions."""
        if self.time is not None and self.sample_time is not None:
            raise InputError(
                "give `time` (a column) or `sample_time` [s], but not both."
            )
        if self.sample_time is not None:
            positive_time(self.sample_time)
        self._require_unit("time_unit", Quantity.TIME)
        self._require_unit("angle_unit", Quantity.COORDINATE)
        self._require_unit("velocity_unit", Quantity.VELOCITY)
        self._require_unit("force_unit", Quantity.FORCE, Quantity.CURRENT)
        self._require("angle_signs", lambda s: abs(s) == 1, "+1 or -1")
        self._require("force_signs", lambda s: abs(s) == 1, "+1 or -1")
        self._require("force_gains", lambda g: 0 < g < np.inf, "positive")
        self._require(
            "torque_constants", lambda c: c != 0 and np.isfinite(c), "finite, not zero"
        )
        current = any(u.quantity is Quantity.CURRENT for u in _units(self.force_unit))
        if current != (self.torque_constants is not None):
            raise InputError(
                "`torque_constants` [N m/A] are needed if `force_unit` is a current, "
                "and only then."
            )

    def _require_unit(self, name: str, *allowed: Quantity) -> None:
        for one in _units(getattr(self, name)):
            if one.quantity not in allowed:
                raise InputError(
                    f"`{name}` must measure {' or '.join(q.value for q in allowed)}, "
                    f"but `{one.symbol}` measures {one.quantity.value}."
                )

    def _require(self, name: str, rule: Callable[[float], Any], words: str) -> None:
        values = getattr(self, name) or ()
        if not all(map(rule, values)):
            shown = ", ".join(f"{x:g}" for x in values)
            raise InputError(
                f"`{name}` must be {words} for each joint, but is {shown}."
            )

    def to_si(
        self, angles: np.ndarray, velocities: np.ndarray | None, forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Convert the numbers of a log to SI units (samples x joints)."""
        joints = angles.shape[1]

        def factors(name: str) -> np.ndarray:
            unit = getattr(self, name)
            if isinstance(unit, Unit):
                return np.full(joints, unit.factor)
            return per_joint(name, [one.factor for one in unit], joints, 1.0)

        def values(name: str, default: float = 1.0) -> np.ndarray:
            return per_joint(name, getattr(self, name), joints, default)

        signs = values("angle_signs")
        angle_scale = signs * factors("angle_unit")
        if velocities is not None:
            velocity_scale = angle_scale
            if self.velocity_unit is not None:
                velocity_scale = signs * factors("velocity_unit")
            velocities = velocities * velocity_scale
        # A log of currents has torque constants, which are one otherwise.
        gains = factors("force_unit") * values("force_signs") * values("force_gains")
        force_scale = gains * values("torque_constants")
        offsets = values("angle_offsets", 0.0)
        return angles * angle_scale + offsets, velocities, forces * force_scale


def _units(units: Units | None) -> tuple[Unit, ...]:
    """Return one unit or several as a tuple; an empty one if there is none."""
    return (units,) if isinstance(units, Unit) else units or ()


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """Channels of a log in SI units, from one or several files.

    The first file holds the angles.
    """

    tables: tuple[LogTable, ...]
    columns: Columns

    def read(
        self, start: int = 0, stop: int | None = None
    ) -> tuple[np.ndarray, np.ndarray | None, np.ndarray]:
        """Return angles, velocities and forces of some rows, as they were recorded."""
        arrays: dict[str, np.ndarray] = {}
        for table in self.tables:
            channels = [channel for channel in table.channels if channel != "time"]
            part = table.read(channels, start, stop)
            for channel, names in part.channels.items():
                blocks = [part.numbers(name) for name in names]
                arrays[channel] = np.concatenate(blocks, axis=1)
        angles = arrays["angles"]
        for channel, array in arrays.items():
            if array.shape[1] != angles.shape[1]:
                raise InputError(
                    f"`{channel}` have {array.shape[1]} columns, but the angles in "
                    f"`{self.tables[0].source}` have {angles.shape[1]}: name one for "
                    "each joint."
                )
        return self.columns.to_si(angles, arrays.get("velocities"), arrays["forces"])

    @property
    def bad_rows(self) -> dict[int, str]:
        """Complaints about rows that were read and are bad, by their positions."""
        complaints = {}
        for table in self.tables:
            for number, text in (table.bad_rows or {}).items():
                complaints[number - table.first_row] = f"{text} of `{table.source}`"
        return complaints

    def stamps(self, start: int = 0, stop: int | None = None) -> np.ndarray:
        """Return time stamps [s]; integers and dates count from `start`."""
        table = self.tables[0].read(("time",), start, stop)
        return table.stamps(self.columns.time_unit.factor)


def open_log(
    path: str | Path,
    columns: Columns,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    *,
    on_disk: bool = False,
    is_lenient: bool = False,
) -> Log:
    """Open the files of a log; with `on_disk`, texts and arrays stay on the disk.

    Rows that cannot be read are an error, unless `is_lenient`: then `Log.bad_rows`
    names them.
    """
    if velocities_path is not None and columns.velocities is None:
        raise InputError(
            "`velocities_path` is given, but `Columns.velocities` names no columns."
        )
    channels: dict[str, tuple[str | Path, Selection | None]] = {
        "angles": (path, columns.angles),
        "forces": (forces_path or path, columns.forces),
    }
    if columns.velocities is not None:
        channels["velocities"] = (velocities_path or path, columns.velocities)
    if columns.time is not None or columns.sample_time is None:
        channels["time"] = (path, columns.time)

    selections: dict[Path, dict[str, Selection | None]] = {}
    for channel, (file_path, selection) in channels.items():
        selections.setdefault(Path(file_path), {})[channel] = selection
    tables = []
    for file_path, file_selections in selections.items():
        file = open_log_file(file_path, file_selections)
        names = file.channels(file_selections)
        bad_rows = {} if is_lenient else None
        tables.append(file.table(names, on_disk, bad_rows))
    _require_equal_rows(tables)
    return Log(tuple(tables), columns)


def _require_equal_rows(tables: Sequence[LogTable]) -> None:
    first = tables[0]
    for table in tables:
        if table.rows != first.rows:
            raise InputError(
                f"`{table.source}` has {table.rows} rows, but `{first.source}` has "
                f"{first.rows}: files of one run must agree row by row."
            )
