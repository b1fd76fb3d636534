"""Meaning and units of the columns of a log, and logs in SI units."""

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import Matrix, Vector
from jaxid.errors import InputError
from jaxid.io import FilePath
from jaxid.robot.limits_and_drives import per_joint
from jaxid.units import NM, PERCENT, RAD, RAD_PER_S, Quantity, S, Unit

from .log_files import Complaints, LogTable, Selection, open_log_file
from .recording import positive_time
from .time_series import NamedChannels

Units = Unit | float | tuple[Unit | float, ...]
"""One unit for all joints, or one for each; a number is the size of one in SI units."""
PerJoint = tuple[float, ...] | None
"""One number for each joint, or the default for all."""
FORCE_QUANTITIES = (Quantity.FORCE, Quantity.CURRENT, Quantity.SHARE)
"""Quantities that columns of forces may hold."""
RATED_VALUES = {
    "angle_unit": ("rated_angles", "[rad or m]"),
    "velocity_unit": ("rated_velocities", "[rad/s or m/s]"),
    "force_unit": ("rated_forces", "[N m or N; A with `torque_constants`]"),
}
"""Values of 100 %, and their units, which a column of shares needs."""
MOTOR_COUNTS = 4096
"""Counts of a turn of the motors that LeRobot calibrates."""
GRIPPER = "gripper"
"""Motor whose angles LeRobot writes from 0 to 100; those of others from -100."""
COUNTER_SIZE = 2**16
"""Number after which counters of drives begin again."""
MIN_OVERFLOW = 0.75
"""Smallest step of a counter that begins again, relative to its size."""
JOINT_CHANNELS = ("angles", "forces", "velocities", "commands")
"""Channels that have one column for each joint."""
OTHER_CHANNELS = ("wrench", "gyro", "accelerometer", "contact")
"""Channels of a force sensor and of a floating base."""


@dataclasses.dataclass(frozen=True)
class Columns:
    """Columns of a log that hold the time, the angles and the forces of a robot.

    A group of columns is a tuple of names, a pattern such as `"q{}"` (`{}` is the
    number of the joint, counted from 1 or from 0), a tuple of positions from 0 (files
    without a header), or one name: that of the column of a single joint, or of a whole
    array (samples x joints), whose columns are `"q[{}]"`. Fields of bags are
    `"/topic.field[{}]"`, or `"/topic.field.joint"` by names.

    Angles become `sign * rated angle * unit * value + offset`, velocities
    `sign * rated velocity * unit * value`, and forces
    `sign * gain * torque constant * rated force * unit * value`. A unit is one
    for all joints, or one for each; as a number it is the angle [rad or m], velocity or
    force [N m or N] of a one in the log, like `0.00153` for counts of an encoder.

    Attributes:
        angles: Joint or motor angles; `{}` is the number of the joint, counted from 1
            or from 0.
        forces: Joint forces, motor torques or motor currents.
        velocities: Measured velocities, on the same side as the angles, like `"dq{}"`;
            None if there are none.
        commands: Commanded angles, like `"cmd{}"`, in units and signs of the angles;
            with them `forces` may be None, for `jaxid rollout`.
        gyro: Angular velocity of a floating base, like `"gyro{}"`: x, y, z in the frame
            of its IMU.
        accelerometer: Acceleration that its IMU measures, gravity included, like
            `"acc{}"`.
        contact: Whether each foot stands (1) or not (0), like `"contact{}"`, in the
            order of the robot's contacts.
        contact_inverted: Whether 1 means that a foot does not stand.
        time: Time stamps, or a list of two columns with seconds and nanoseconds;
            `sample_time`, or the clock of bags and LeRobot data sets, if None.
        sample_time: Time between two rows [s], instead of time stamps, like `0.001`.
        time_unit: Unit of the stamps.
        angle_unit: Unit of the angles; or the angle for a value of 1 in the log [rad or
            m], as a number such as 0.00153 for the counts of an encoder; "%" and "‰"
            need `rated_angles`.
        velocity_unit: Unit of the velocities, like `"rad/s"`; the angles' unit per
            second if None.
        force_unit: Unit of the forces, or the force for a value of 1 in the log [N m or
            N]; currents need `torque_constants`, "%" and "‰" need `rated_forces`.
        gyro_unit: Unit of the gyroscope.
        accelerometer_unit: Acceleration for a value of 1 in the log [m/s²], like
            `9.80665`.
        torque_constants: Torque of each motor for its current [N m/A].
        rated_angles: Angle of each joint at 100 % minus that at 0 % [rad or m].
        rated_velocities: Velocity of each joint at 100 % [rad/s or m/s].
        rated_forces: Rated force of each drive, to which "%" or "‰" in the log refer [N
            m or N; A with `torque_constants`].
        angle_signs: +1 or -1 for each joint, for the angles and velocities.
        force_signs: +1 or -1 for each joint.
        angle_offsets: Offsets that are added to the angles [rad or m], like `0.0`.
        force_gains: Ratio of the true forces to those of the log, as found with a known
            load.
        angles_on_motor_side: Whether angles and velocities are the motors', before the
            gears.
        forces_on_motor_side: Whether forces are the motors', before the gears.
        unwrap: Whether to remove jumps of the angles by full turns.
        wrench: Three forces and three moments of a force sensor [N, N m]; with them
            `forces` may be None.
        wrench_sign: 1 for the wrench of the sensor on what is behind it, -1 for the
            opposite one.
        joint_names: Names of the robot's joints: arrays of bags are read by them, if
            the messages name their elements so; by place if None.
    """

    angles: Selection
    forces: Selection | None = None
    velocities: Selection | None = None
    commands: Selection | None = None
    gyro: Selection | None = None
    accelerometer: Selection | None = None
    contact: Selection | None = None
    contact_inverted: bool = False
    time: str | int | tuple[str | int, str | int] | None = None
    sample_time: float | None = None
    time_unit: Unit = S
    angle_unit: Units = RAD
    velocity_unit: Units | None = None
    force_unit: Units = NM
    gyro_unit: Unit = RAD_PER_S
    accelerometer_unit: float = 1.0
    torque_constants: PerJoint = None
    rated_angles: PerJoint = None
    rated_velocities: PerJoint = None
    rated_forces: PerJoint = None
    angle_signs: PerJoint = None
    force_signs: PerJoint = None
    angle_offsets: PerJoint = None
    force_gains: PerJoint = None
    angles_on_motor_side: bool = False
    forces_on_motor_side: bool = False
    unwrap: bool = False
    wrench: Selection | None = None
    wrench_sign: float = 1.0
    joint_names: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        """Make tuples of lists and arrays, and refuse contradictions."""
        for name, value in dict(vars(self)).items():
            if isinstance(value, Iterable) and not isinstance(value, str):
                object.__setattr__(self, name, tuple(value))
        if self.time is not None and self.sample_time is not None:
            raise InputError(
                "give `time` (a column) or `sample_time` [s], but not both."
            )
        if self.sample_time is not None:
            positive_time(self.sample_time)
        measured = (self.forces, self.wrench, self.commands)
        if measured.count(None) == len(measured):
            raise InputError(
                "`forces` is missing: it names the columns of the forces of the joints."
            )
        self._require_unit("time_unit", Quantity.TIME)
        self._require_unit("angle_unit", Quantity.COORDINATE, Quantity.SHARE)
        self._require_unit("velocity_unit", Quantity.VELOCITY, Quantity.SHARE)
        self._require_unit("gyro_unit", Quantity.VELOCITY)
        force = Quantity.FORCE if self.torque_constants is None else Quantity.CURRENT
        self._require_unit("force_unit", force, *FORCE_QUANTITIES)
        self._require("angle_signs", lambda s: abs(s) == 1, "+1 or -1")
        self._require("force_signs", lambda s: abs(s) == 1, "+1 or -1")
        self._require("force_gains", lambda g: 0 < g < np.inf, "positive")
        self._require(
            "torque_constants", lambda c: c != 0 and np.isfinite(c), "finite, not zero"
        )
        for name, (rated_name, unit) in RATED_VALUES.items():
            self._require(rated_name, lambda x: 0 < x < np.inf, "positive")
            if self._has_shares(name) != (getattr(self, rated_name) is not None):
                raise InputError(
                    f"`{rated_name}` {unit} are needed if `{name}` is "
                    '"%" or "‰", and only then.'
                )
        quantities = [unit.quantity for unit in _units(self.force_unit)]
        has_currents = Quantity.CURRENT in quantities
        has_constants = self.torque_constants is not None
        if has_currents != has_constants and not (
            has_constants and self._has_shares("force_unit")
        ):
            raise InputError(
                "`torque_constants` [N m/A] are needed if `force_unit` is a current, "
                "and only then."
            )

    def _has_shares(self, name: str) -> bool:
        """Return whether a unit is a share of a rated value."""
        return Quantity.SHARE in [unit.quantity for unit in _units(getattr(self, name))]

    @property
    def angle_symbol(self) -> str:
        """Unit of the angles of joints that turn; several symbols if they differ."""
        symbols = dict.fromkeys(unit.symbol for unit in _units(self.angle_unit))
        return ", ".join(symbol for symbol in symbols if symbol not in ("m", "mm"))

    def _require_unit(self, name: str, *quantities: Quantity) -> None:
        """Check what units measure, and make units of the first quantity of numbers."""
        units = getattr(self, name)
        if isinstance(units, tuple):
            units = tuple(_as_unit(name, unit, quantities[0]) for unit in units)
        elif units is not None:
            units = _as_unit(name, units, quantities[0])
        object.__setattr__(self, name, units)
        words = " or ".join(dict.fromkeys(quantity.value for quantity in quantities))
        for unit in _units(units):
            if unit.quantity not in quantities:
                raise InputError(
                    f"`{name}` must measure {words}, but `{unit.symbol}` measures "
                    f"{unit.quantity.value}."
                )

    def _require(self, name: str, rule: Callable[[float], Any], words: str) -> None:
        values = getattr(self, name) or ()
        if not all(map(rule, values)):
            numbers = ", ".join(f"{x:g}" for x in values)
            raise InputError(
                f"`{name}` must be {words} for each joint, but is {numbers}."
            )

    def to_si(self, channels: NamedChannels) -> NamedChannels:
        """Convert the numbers of a log to SI units, by channel (samples x columns)."""
        joints = channels["angles"].shape[1]

        def numbers(name: str, default: float = 1.0) -> Vector:
            """Return an attribute's numbers of all joints; units become factors."""
            values = getattr(self, name)
            if isinstance(values, Unit):
                values = joints * (values,)
            if values is not None:
                values = [x.factor if isinstance(x, Unit) else x for x in values]
            return per_joint(name, values, joints, default)

        signs = numbers("angle_signs")
        angle_scale = signs * numbers("angle_unit") * numbers("rated_angles")
        velocity_scale = angle_scale
        if self.velocity_unit is not None:
            velocity_unit = numbers("velocity_unit")
            velocity_scale = signs * velocity_unit * numbers("rated_velocities")
        # A log of currents has torque constants, which are one otherwise.
        gains = numbers("force_unit") * numbers("force_signs") * numbers("force_gains")
        scales = {
            "angles": angle_scale,
            "commands": angle_scale,
            "velocities": velocity_scale,
            "forces": gains * numbers("torque_constants") * numbers("rated_forces"),
            "wrench": self.wrench_sign,
            "gyro": self.gyro_unit.factor,
            "accelerometer": self.accelerometer_unit,
            "contact": 1.0,
        }
        si = {name: values * scales[name] for name, values in channels.items()}
        if self.contact_inverted and "contact" in si:
            si["contact"] = 1.0 - si["contact"]
        offsets = numbers("angle_offsets", 0.0)
        for name in {"angles", "commands"} & si.keys():
            si[name] = si[name] + offsets
        return si


def with_lerobot_calibration(
    arguments: dict[str, Any], path: Path, joint_names: Sequence[str]
) -> dict[str, Any]:
    """Return arguments of `Columns`, with the scales of a calibration file of LeRobot.

    Percent are those of each joint's calibrated range, from -100 to 100, or from 0 to
    100 of the gripper; angles count from its middle. Motors are those with the names of
    the joints, or else the first ones by their numbers.

    Raises:
        InputError: If the file is another one, has too few motors, or the angles are
            not in percent.
    """
    unit = arguments.setdefault("angle_unit", PERCENT)
    if unit is not PERCENT:
        symbol = getattr(unit, "symbol", unit)
        raise InputError(
            f'`lerobot_calibration` is for `angle_unit = "%"`, but that is {symbol}: '
            'write "%". For degrees, leave the calibration out: LeRobot then counts '
            "from the middle of each range."
        )
    try:
        motors = json.loads(path.read_text("utf-8"))
        names = [*joint_names]
        if not set(names) <= set(motors):
            motor_names = sorted(motors, key=lambda name: motors[name]["id"])
            names = motor_names[: len(joint_names)]
        ranges = [
            motors[name]["range_max"] - motors[name]["range_min"] for name in names
        ]
        half_ranges = np.array(ranges, np.float64) * np.pi / MOTOR_COUNTS
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(
            f"`{path.name}` must be a calibration file of LeRobot, which holds `id`, "
            "`range_min` and `range_max` of each motor: check the path "
            f"({type(error).__name__}: {error})."
        ) from error
    if len(names) < len(joint_names) or not (half_ranges > 0).all():
        raise InputError(
            f"`{path.name}` must hold a range for each of the {len(joint_names)} "
            f"joints, but holds {ranges} counts: choose another file, or calibrate "
            "the arm again."
        )
    is_gripper = np.array([name == GRIPPER for name in names])
    offsets = np.array(arguments.get("angle_offsets") or 0.0)
    return arguments | {
        "rated_angles": np.where(is_gripper, 2 * half_ranges, half_ranges),
        "angle_offsets": offsets + np.where(is_gripper, -half_ranges, 0.0),
    }


def _as_unit(name: str, unit: Unit | float, quantity: Quantity) -> Unit:
    """Return a unit, or one of the size that a number tells."""
    if isinstance(unit, Unit):
        return unit
    if not np.isfinite(unit) or unit == 0:
        raise InputError(
            f"`{name}` must be a unit or a finite number other than zero (the value of "
            f"1 in the log), but is {unit}."
        )
    return Unit(f"{unit:g}", float(unit), quantity)


def _units(units: Any) -> tuple[Unit, ...]:
    """Return one unit or several as a tuple; an empty one if there is none."""
    return (units,) if isinstance(units, Unit) else units or ()


@dataclasses.dataclass(frozen=True, eq=False)
class Log:
    """Channels of a log in SI units, from one or several files.

    The first file holds the angles.
    """

    tables: tuple[LogTable, ...]
    columns: Columns
    notes: list[str] = dataclasses.field(default_factory=list)

    def read(self, start: int = 0, stop: int | None = None) -> NamedChannels:
        """Return some rows of all channels but the time, as they were recorded.

        Raises:
            InputError: If a channel has a wrong number of columns.
        """
        arrays: NamedChannels = {}
        for table in self.tables:
            channels = [x for x in table.channels if x != "time"]
            for channel, array in _numbers(table, channels, start, stop).items():
                arrays[channel] = array
                # A part does not tell how often a counter began again before.
                is_whole = start == 0 and stop is None
                if is_whole and channel in JOINT_CHANNELS:
                    arrays[channel] = self._without_overflows(channel, array)
        joints = arrays["angles"].shape[1]
        source = self.tables[0].source
        for channel, array in arrays.items():
            columns = array.shape[1]
            if channel in JOINT_CHANNELS and columns != joints:
                raise InputError(
                    f"`{channel}` have {columns} columns, but the angles in `{source}` "
                    f"have {joints}: name one for each joint."
                )
            if channel == "wrench" and columns != 6:
                raise InputError(
                    f"`wrench` has {columns} columns in `{source}`, but must name "
                    "three forces, then three moments."
                )
        return self.columns.to_si(arrays)

    def _without_overflows(self, channel: str, array: Matrix) -> Matrix:
        """Return a channel whose counter goes on where it began again; note it."""
        size = COUNTER_SIZE
        is_inside = -0.5 * size <= array.min() and array.max() < size
        if not (is_inside and (array == np.round(array)).all()):
            return array
        # No motion and no force changes that much between two samples.
        max_steps = np.abs(np.diff(array, axis=0)).max(axis=0, initial=0.0)
        begins_again = max_steps > MIN_OVERFLOW * size
        if not begins_again.any():
            return array
        self.notes.append(
            f"`{channel}` jump by {size}, as a counter does when it overflows: the "
            "jumps were removed"
        )
        counts = np.unwrap(array, period=size, axis=0)
        turns = np.round(np.median(counts, axis=0) / size)
        return counts - size * np.where(begins_again, turns, 0.0)

    @property
    def bad_rows(self) -> Complaints:
        """Complaints about rows that were read and are bad, by their positions."""
        complaints = {}
        for table in self.tables:
            for number, text in (table.bad_rows or {}).items():
                complaints[number - table.first_row] = f"{text} of `{table.source}`"
        return complaints

    def stamps(self, start: int = 0, stop: int | None = None) -> Vector:
        """Return time stamps [s]; integers and dates count from `start`."""
        table = self.tables[0].read(("time",), start, stop)
        return table.stamps(self.columns.time_unit.factor)


def _numbers(
    table: LogTable, channels: Sequence[str], start: int, stop: int | None
) -> dict[str, Matrix]:
    """Return the numbers of some channels of a file, as they were recorded."""
    part = table.read(channels, start, stop)
    arrays = {}
    for channel, names in part.channels.items():
        blocks = {name: part.numbers(name) for name in names}
        _require_values(table.source, channel, blocks)
        arrays[channel] = np.concatenate([*blocks.values()], axis=1)
    return arrays


def _require_values(source: str, channel: str, blocks: dict[str, Matrix]) -> None:
    """Refuse columns without any number, which drivers write that measure nothing."""
    empty_columns = [
        name
        for name, block in blocks.items()
        if not np.isfinite(block).any(axis=0).all()
    ]
    if empty_columns:
        cure = "name other columns"
        if channel == "velocities":
            cure = "leave `velocities` out: the angles suffice"
        raise InputError(
            f"all values of `{'`, `'.join(empty_columns)}` of `{source}` are empty or "
            f"NaN: the driver reports no `{channel}`; {cure}."
        )


def open_log(
    path: FilePath,
    columns: Columns,
    forces_path: FilePath | None = None,
    *,
    on_disk: bool = False,
) -> Log:
    """Open the files of a log; with `on_disk`, texts stay on the disk.

    Rows that cannot be read are an error there; otherwise `Log.bad_rows` names them.
    """
    paths = {"forces": forces_path or path}
    selections: dict[Path, dict[str, Selection | None]] = {}
    for channel in (*JOINT_CHANNELS, *OTHER_CHANNELS):
        selection = getattr(columns, channel)
        if selection is not None:
            file_path = Path(paths.get(channel, path))
            selections.setdefault(file_path, {})[channel] = selection
    if columns.time is not None or columns.sample_time is None:
        selections[Path(path)]["time"] = columns.time
    tables = []
    for file_path, file_selections in selections.items():
        file = open_log_file(file_path, file_selections, columns.joint_names)
        bad_rows = None if on_disk else {}
        tables.append(file.table(file.channels(), on_disk, bad_rows))
    for table in tables:
        if table.rows != tables[0].rows:
            raise InputError(
                f"`{table.source}` has {table.rows} rows, but `{tables[0].source}` has "
                f"{tables[0].rows}: files of one run must agree row by row."
            )
    return Log(tuple(tables), columns)
