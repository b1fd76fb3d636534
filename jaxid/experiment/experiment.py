"""Experiment: the objects that the user's TOML file describes."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxid.errors import InputError
from jaxid.experiment_file import (
    TomlTable,
    parse_tables,
    read_experiment_text,
    within,
)
from jaxid.identification.consistency import BodyBounds
from jaxid.io import FilePath
from jaxid.measurement.columns import Columns
from jaxid.measurement.filters import FILTERS
from jaxid.measurement.log_files import summarise_columns
from jaxid.robot.inertia import Tool
from jaxid.robot.virtual_joints import driven_robot, with_driven
from jaxid.workflow.excitation_settings import Excitation
from jaxid.workflow.force_sensor_payload import ForceSensor
from jaxid.workflow.geometry_calibration import CalibrationSettings
from jaxid.workflow.log_rollout import ServoSettings, TorqueSettings
from jaxid.workflow.setup import LogReading, Setup
from jaxid.workflow.surroundings import Collision, Surroundings

from .decoder import call, decode
from .robot_tables import (
    RobotSource,
    known_load,
    replace_drives,
    replace_limits,
    require_floating_base,
    require_gears,
    require_joint_lists,
)
from .setup_tables import (
    Effects,
    Sides,
    build_columns,
    build_estimation,
    build_rows,
    build_setup,
)

TABLES: dict[str, tuple[Callable, ...]] = {
    "robot": (RobotSource,),
    "load": (known_load,),
    "sensor": (ForceSensor,),
    "limits": (replace_limits,),
    "drives": (replace_drives,),
    "model": (Effects,),
    "recording": (Columns, Sides, LogReading),
    "filter": tuple(FILTERS.values()),
    "rows": (build_rows,),
    "estimator": (build_estimation, BodyBounds),
    "rollout": (ServoSettings, TorqueSettings),
    "calibration": (CalibrationSettings,),
    "excitation": (Excitation,),
    "collision": (Collision,),
}
"""Tables of an experiment file, and functions whose arguments are their keys."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Content of an experiment file."""

    path: Path  # path of the file
    text: str  # text of the file
    source: RobotSource  # source of the robot
    setup: Setup  # how logs become parameters
    columns: Columns | None  # columns of the logs; None if the file does not say
    # known load that is on the robot in some logs only; None if the file does not say
    load: Tool | float | None
    # force sensor at the end-effector or under the base; None if the file does not say
    sensor: ForceSensor | None
    # settings of simulations that follow commands, or torques
    rollout: ServoSettings | TorqueSettings
    calibration: CalibrationSettings  # files of poses, and what was measured in them
    excitation: Excitation  # settings of the motion to design
    collision: Collision  # shapes that must keep a distance, as the file describes them

    @functools.cached_property
    def surroundings(self) -> Surroundings:
        """Shapes of robot and surroundings, found when they are first asked for."""
        with within("collision", self.path.name):
            return self.collision.build(
                self.setup.robot, self.setup.robot_file, self.source.base_plane
            )

    def require_columns(self, logs: Sequence[Path]) -> Columns:
        """Return the columns of some logs.

        Raises:
            InputError: If the file does not describe them.
        """
        if self.columns is not None:
            return self.columns
        names = summarise_columns(logs[0])
        description = f"columns of `{logs[0].name}`, which has {names}"
        raise InputError(
            f"{self.path.name}: the table `[recording]` "
            f"is missing: it names {description}."
        )

    def identification(self, logs: Sequence[Path]) -> tuple[Setup, Columns]:
        """Return how logs become parameters, with the sensor under the base.

        Raises:
            InputError: If the file does not describe the columns of the logs.
        """
        columns = self.require_columns(logs)
        if self.sensor is None or not self.sensor.under_base:
            return self.setup, columns
        with within("sensor", self.path.name):
            setup = self.sensor.beside(self.setup, columns)
        return setup, self.sensor.columns(columns)


def load_experiment(path: FilePath) -> Experiment:
    """Load an experiment file; paths in it are relative to its folder."""
    path = Path(path)
    return parse_experiment(read_experiment_text(path), path)


def parse_experiment(text: str, path: Path) -> Experiment:
    """Return the experiment of a text; other paths are relative to its folder."""
    tables = parse_tables(text, path)
    try:
        experiment = _build(tables, text, path)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    if "collision" in tables:
        _ = experiment.surroundings  # for its mistakes
    return experiment


def _build(tables: TomlTable, text: str, path: Path) -> Experiment:
    """Return the experiment that the tables of a file describe."""
    source = call(RobotSource, tables["robot"], "robot")
    with within("robot"):
        robot_file = source.robot_file(path.parent)
        robot = source.build(robot_file)
    joints = driven_robot(robot)
    require_joint_lists(tables, joints)
    for name, replace in (("limits", replace_limits), ("drives", replace_drives)):
        if name in tables:
            joints = call(replace, tables[name], name, joints)
    robot = with_driven(robot, joints)
    columns = None
    reading = LogReading()
    sensor = None
    if "sensor" in tables:
        sensor = call(ForceSensor, tables["sensor"], "sensor")
    if "recording" in tables:
        columns, reading = build_columns(
            tables["recording"], joints, path.parent, getattr(sensor, "wrench", None)
        )
        require_gears(joints, columns)
        require_floating_base(robot, columns)
    load = None
    if "load" in tables:
        load_of_robot = call(known_load, tables["load"], "load")
        with within("load"):
            load = load_of_robot(robot)
    return Experiment(
        path,
        text,
        source,
        build_setup(tables, robot, robot_file, reading),
        columns,
        load,
        sensor,
        _build_rollout(tables.get("rollout", {}), columns),
        call(CalibrationSettings, tables.get("calibration", {}), "calibration"),
        _build_excitation(tables.get("excitation", {}), path.parent),
        _build_collision(tables.get("collision", {}), path.parent),
    )


def _build_rollout(
    table: TomlTable, columns: Columns | None
) -> ServoSettings | TorqueSettings:
    """Return the settings for logs of commands if the file names them, or of torques.

    Raises:
        InputError: If a setting is given that is for logs of the other kind.
    """
    servo, torque = decode([ServoSettings, TorqueSettings], table, "rollout")
    settings = TorqueSettings(**torque)
    other_settings = ServoSettings(**servo)
    kind = "commands"
    if columns is not None and columns.commands is not None:
        settings = ServoSettings(**servo)
        other_settings = TorqueSettings(**torque)
        kind = "forces` without `recording.commands"
    for field in dataclasses.fields(other_settings):
        if getattr(other_settings, field.name) != field.default:
            raise InputError(
                f"`rollout.{field.name}` is for logs with `recording.{kind}`."
            )
    return settings


def _build_excitation(table: TomlTable, folder: Path) -> Excitation:
    """Return the settings of the motion, with paths that count from the folder."""
    excitation = call(Excitation, table, "excitation")
    nominal = excitation.nominal
    return dataclasses.replace(
        excitation,
        nominal=None if nominal is None else str(folder / nominal),
    )


def _build_collision(table: TomlTable, folder: Path) -> Collision:
    """Return the shapes of the file, with paths that count from the folder."""
    collision = call(Collision, table, "collision")
    packages = collision.packages
    return dataclasses.replace(
        collision, packages=None if packages is None else str(folder / packages)
    )
