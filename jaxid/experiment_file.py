"""Text of an experiment file: tables, keys and values, and whether its files are there.

What is wrong with them is said before the methods are loaded, which takes seconds: this
module imports neither them nor JAX. `experiment/` makes objects of the values.
"""

import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxid.errors import InputError
from jaxid.experiment_values import (
    Bounds,
    Column,
    Corner,
    Count,
    Finite,
    Fraction,
    Magnitude,
    PerJoint,
    Positive,
    Positives,
    Times,
    TomlTable,
    Units,
    Vector,
    check_names,
    decode_table,
)
from jaxid.measurement.log_columns import Selection, Selections
from jaxid.measurement.text_format import TEXT_SUFFIXES, TextColumns
from jaxid.robot.xml_files import read_xml
from jaxid.units import Unit

ANGLE_UNIT = Literal["rad", "deg"]
SIDE = Literal["joint", "motor"]
INERTIA = {
    "xx": Magnitude,
    "yy": Magnitude,
    "zz": Magnitude,
    "xy": float,
    "xz": float,
    "yz": float,
}
LOAD = {"mass": Positive, "centre_of_mass": Vector, "inertia": INERTIA, "body": str}
DRY_FRICTION = {
    "epsilon": Positives,
    "hard": bool,
    "asymmetric": bool,
    "presliding": bool,
    "stribeck": Positives,
}
SPLINE = {"points": int, "duration": np.ndarray}
LEADS = {"time": Positive, "periods": Annotated[int, Bounds(minimum=1, maximum=1000)]}
CAPSULE = {
    "name": str,
    "body": str,
    "start": Vector,
    "radius": Positive,
    "end": Vector,
}
BOX = {"name": str, "centre": Vector, "size": Vector, "rotation": Vector}
KEYS: dict[str, TomlTable] = {
    "robot": {
        "urdf": str,
        "mjcf": str,
        "tip": str,
        "base": str,
        "xacro_arguments": dict[str, str | bool | int | float],
        "builtin": Literal[
            "tx90l_on_rail",
            "tx40",
            "ur10",
            "ur10e",
            "panda",
            "iiwa14",
            "kr300",
            "planar_arm",
        ],
        "floating": bool,
        "imu": str,
        "contacts": dict[str, str | float],
        "name": str,
        "gravity": Vector,
        "base_rotation": Vector,
        "base_position": Vector,
        "snap_tolerance": Magnitude,
        "tool": LOAD,
    },
    "load": LOAD,
    "sensor": {
        "wrench": Column,
        "sign": float,
        "rotation": Vector,
        "position": Vector,
        "in_ground": bool,
        "under_base": bool,
    },
    "limits": {
        "angle_unit": ANGLE_UNIT,
        "position_min": PerJoint,
        "position_max": PerJoint,
        "velocity": PerJoint,
        "acceleration": PerJoint,
        "jerk": PerJoint,
        "force": PerJoint,
    },
    "drives": {
        "gear_ratios": list[Finite],
        "matrix": list[PerJoint],
        "zero": list[Finite],
        "angle_unit": ANGLE_UNIT,
        "max_torques": list[Positive],
    },
    "model": {
        "principal_axes": bool,
        "viscous": bool | Literal["asymmetric"],
        "load": bool,
        "motor_ripple": tuple[Count, ...],
        "joint_ripple": tuple[Count, ...],
        "rotor_inertia": bool,
        "offset": bool,
        "coulomb": (bool, DRY_FRICTION),
        "square_root": bool,
        "springs": bool,
        "passive_friction": bool,
    },
    "recording": {
        "angles": Column,
        "forces": Column,
        "velocities": Column,
        "gyro": Column,
        "accelerometer": Column,
        "contact": Column,
        "contact_inverted": bool,
        "time": str | int | tuple[str | int, str | int],
        "sample_time": float,
        "time_unit": Unit,
        "angle_unit": Units,
        "velocity_unit": Units,
        "force_unit": Units,
        "gyro_unit": Unit,
        "accelerometer_unit": Annotated[float, Bounds(above=0.0)],
        "torque_constants": PerJoint,
        "rated_angles": PerJoint,
        "rated_velocities": PerJoint,
        "rated_forces": PerJoint,
        "angle_signs": PerJoint,
        "force_signs": PerJoint,
        "angle_offsets": PerJoint,
        "force_gains": PerJoint,
        "unwrap": bool,
        "side": SIDE,
        "forces_side": SIDE,
        "forces_file": str,
        "commands": Column,
        "lerobot_calibration": str,
        "force_delay": float,
        "largest_gap": Annotated[float, Bounds(above=1.0)],
        "bad_rows": Annotated[float, Bounds(minimum=0.0, below=1.0)],
        "start": float,
        "stop": float,
        "imu_offset": bool,
    },
    "filter": {
        "kind": Literal["butterworth", "paper", "periodic"],
        "cutoff": float | list[float],
        "order": int,
        "force_cutoff": float,
        "margin": float,
        "velocity": float,
        "acceleration": float,
        "period": float,
        "harmonics": int,
    },
    "rows": {
        "step": Count,
        "min_speed": Magnitude | list[Magnitude],
    },
    "estimator": {
        "kind": Literal["weighted", "least_squares", "huber", "tukey", "consistent"],
        "weights": Literal["maximum_forces", "residual_variances"],
        "ridge": Fraction | Literal["cross_validated"],
        "uncertainty": Literal["spectral", "jackknife", "independent"],
        "pull": Magnitude,
        "mass_max": np.ndarray,
        "radius": np.ndarray,
        "mass_min": np.ndarray,
        "total_mass": float,
    },
    "rollout": {
        "bodies": bool,
        "stiffness": Positive | PerJoint,
        "damping": Positive | PerJoint,
        "feed_forward": Positive | PerJoint,
        "alike": list[list[str]],
        "contacts": list[Times] | dict[str, list[Times]],
        "samples": Annotated[int, Bounds(minimum=0, maximum=10_000)],
        "horizon": Positive,
    },
    "calibration": {
        "observation": Literal[
            "point_contact",
            "plane_contact",
            "known_distance",
            "measured_position",
            "measured_pose",
            "eye_in_hand",
        ],
        "joints": Column,
        "position": Column,
        "attitude": Column,
        "angle_unit": ANGLE_UNIT,
        "length_unit": Literal["m", "mm"],
        "distance": Positive,
        "parts": Annotated[int, Bounds(minimum=1, maximum=100)],
        "compliance": bool,
        "masses": list[Magnitude],
    },
    "excitation": {
        "criterion": Literal[
            "condition_number",
            "weighted_condition_number",
            "scaled_condition_number",
            "d_optimal",
            "a_optimal",
            "e_optimal",
        ],
        "harmonics": Annotated[int, Bounds(minimum=1, maximum=50)],
        "omega": Annotated[float, Bounds(above=0.0, maximum=1000.0)],
        "rest": bool,
        "spline": SPLINE,
        "leads": (bool, LEADS),
        "samples": Annotated[int, Bounds(minimum=2, maximum=10_000_000)],
        "noise": list[Annotated[float, Bounds(above=0.0, below=1e9)]],
        "starts": Count,
        "generations": Annotated[int, Bounds(minimum=0, maximum=10_000)],
        "time": Positive,
        "seed": Annotated[int, Bounds(minimum=0, maximum=2**32 - 1)],
        "sample_time": Annotated[float, Bounds(minimum=1e-5)],
        "controller": Literal["franka", "kuka_fri", "kuka_rsi", "universal_robots"],
        "ros": Literal["yaml", "mcap"],
        "nominal": str,
        "force_margin": Annotated[float, Bounds(minimum=0.0, below=1.0)],
        "tip_speed": Positive,
        "tip_acceleration": Positive,
        "workspace": tuple[Corner, Corner],
        "pose": dict[str, float],
        "ground_friction": Positive,
        "support_margin": Annotated[float, Bounds(minimum=0.0, below=1.0)],
        "sole_radius": Positive,
    },
    "collision": {
        "distance": Positive,
        "fit": bool,
        "packages": str,
        "floor": Finite | Literal["base"] | bool,
        "capsules": [CAPSULE],
        "boxes": [BOX],
        "pairs": list[tuple[str, str]],
    },
}
"""Keys of each table, and what their values may be, as `decode_value` takes it."""


def read_experiment_text(path: Path) -> str:
    """Return the text of an experiment file."""
    if not path.is_file():
        raise InputError(
            f"`{path}` is not a file: check its path, "
            "or write one with `jaxid init arm.urdf`."
        )
    try:
        return path.read_bytes().decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = 1 + error.object.count(b"\n", 0, error.start)
        raise InputError(
            f"{path.name}: the file is not TOML in UTF-8: line {line} holds bytes that "
            "are not text."
        ) from error


def parse_tables(text: str, path: Path) -> TomlTable:
    """Return the tables of an experiment file, with values of the declared types."""
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        fault = str(error).rstrip(".")
        raise InputError(
            f"{path.name}: the file is not TOML in UTF-8: {fault}."
        ) from error
    try:
        _require_tables(tables)
        tables = {
            name: decode_table(table, KEYS[name], name)
            for name, table in tables.items()
        }
        with within("robot"):
            _require_robot(tables["robot"], path.parent)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    return tables


def _require_tables(tables: TomlTable) -> None:
    """Reject tables that are unknown, no tables, or missing."""
    check_names(tables, KEYS)
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"`{name}` must be a table, but is {table!r}.")
    if "robot" not in tables:
        raise InputError(
            "the table `[robot]` is missing: give it `urdf`, `mjcf` or `builtin`."
        )
    if "angles" not in tables.get("recording", {"angles": ""}):
        raise InputError("`recording.angles` is missing: `[recording]` needs it.")


def _require_robot(table: TomlTable, folder: Path) -> None:
    """Reject a robot without one source, or with a file that is not there or no XML."""
    sources = [key for key in ("urdf", "mjcf", "builtin") if key in table]
    if len(sources) != 1:
        words = " and ".join(f"`{key}`" for key in sources) or "none of them"
        raise InputError(
            f"one of `urdf`, `mjcf` and `builtin` is needed, but there is {words}; "
            "give a Denavit-Hartenberg table to `from_dh` in Python."
        )
    source = sources[0]
    if source == "builtin":
        for key in ("tip", "base", "xacro_arguments", "floating", "imu", "contacts"):
            if key in table:
                raise InputError(
                    f"`{key}` belongs to `urdf`, not to `builtin`: remove it."
                )
    elif isinstance(table[source], str):
        path = folder / table[source]
        if not path.is_file():
            raise InputError(
                f"`{source}`: `{path}` is not a file: paths are relative to this file."
            )
        read_xml(path)


def require_text_columns(tables: TomlTable, logs: Iterable[Path]) -> None:
    """Reject text logs without the columns that an experiment file names."""
    selections = _select_columns(tables.get("recording", {}))
    for log in logs:
        if log.suffix.lower() in TEXT_SUFFIXES and log.is_file():
            TextColumns(log, selections).channels()


def _select_columns(recording: TomlTable) -> Selections:
    """Return the columns that each log must have, as far as the file alone tells."""
    channels = ["angles", "time"]
    # Not every command reads the forces beside commands.
    if "commands" not in recording:
        channels.append("velocities")
        if "forces_file" not in recording:
            channels.append("forces")
    selections: dict[str, Selection] = {}
    for channel in channels:
        value = recording.get(channel)
        columns: tuple[Any, ...] = (value,)
        if isinstance(value, list):
            columns = tuple(value)
        are_names = all(isinstance(column, str | int) for column in columns)
        # The robot, which is not loaded yet, tells the names of its joints.
        if are_names and "{name}" not in str(value):
            selections[channel] = columns if isinstance(value, list) else columns[0]
    return selections


@contextmanager
def within(place: str, file: str = "") -> Iterator[None]:
    """Name a table in errors of deeper layers, and the file if it is not named yet."""
    try:
        yield
    except (InputError, FileNotFoundError) as error:
        raise InputError(f"{file}{': ' if file else ''}`{place}`: {error}") from error
