"""Text of an experiment file: its tables and keys, and whether its files are there.

What is wrong with them is said before the methods are loaded, which takes seconds: this
module imports neither them nor JAX. `experiment/` reads the values.
"""

import difflib
import tomllib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from jaxid.errors import InputError
from jaxid.measurement.log_columns import Selection, Selections
from jaxid.measurement.text_format import TEXT_SUFFIXES, TextColumns
from jaxid.robot.xml_files import read_xml

TomlTable = dict[str, Any]
"""Table of a TOML file, or arguments that are made of one."""
LOAD = ("mass", "centre_of_mass", "inertia", "body")
INERTIA = ("xx", "yy", "zz", "xy", "xz", "yz")
KEYS: dict[str, tuple[str, ...]] = {
    "robot": (
        "urdf",
        "mjcf",
        "tip",
        "base",
        "xacro_arguments",
        "builtin",
        "name",
        "gravity",
        "base_rotation",
        "base_position",
        "snap_tolerance",
        "tool",
    ),
    "robot.tool": LOAD,
    "robot.tool.inertia": INERTIA,
    "load": LOAD,
    "load.inertia": INERTIA,
    "limits": (
        "angle_unit",
        "position_min",
        "position_max",
        "velocity",
        "acceleration",
        "jerk",
        "force",
    ),
    "drives": ("gear_ratios", "matrix", "zero", "angle_unit", "max_torques"),
    "model": (
        "principal_axes",
        "viscous",
        "load",
        "motor_ripple",
        "joint_ripple",
        "rotor_inertia",
        "offset",
        "coulomb",
        "square_root",
        "springs",
    ),
    "model.coulomb": ("epsilon", "hard", "asymmetric", "presliding", "stribeck"),
    "recording": (
        "angles",
        "forces",
        "velocities",
        "time",
        "sample_time",
        "time_unit",
        "angle_unit",
        "velocity_unit",
        "force_unit",
        "torque_constants",
        "rated_angles",
        "rated_velocities",
        "rated_forces",
        "angle_signs",
        "force_signs",
        "angle_offsets",
        "force_gains",
        "unwrap",
        "side",
        "forces_side",
        "forces_file",
        "velocities_file",
        "commands",
        "lerobot_calibration",
        "force_delay",
        "largest_gap",
        "bad_rows",
        "start",
        "stop",
    ),
    "filter": (
        "kind",
        "cutoff",
        "order",
        "force_cutoff",
        "margin",
        "window",
        "velocity",
        "acceleration",
        "period",
        "harmonics",
    ),
    "rows": ("step", "factors", "min_speed"),
    "estimator": (
        "kind",
        "weights",
        "ridge",
        "uncertainty",
        "pull",
        "mass_max",
        "radius",
        "mass_min",
        "centre_min",
        "centre_max",
        "total_mass",
    ),
    "rollout": (
        "bodies",
        "stiffness",
        "damping",
        "feed_forward",
        "alike",
        "contacts",
        "samples",
        "horizon",
    ),
    "excitation": (
        "criterion",
        "harmonics",
        "omega",
        "rest",
        "spline",
        "leads",
        "samples",
        "noise",
        "starts",
        "generations",
        "time",
        "seed",
        "sample_time",
        "controller",
        "ros",
        "nominal",
        "force_margin",
        "tip_speed",
        "tip_acceleration",
        "workspace",
    ),
    "excitation.spline": ("points", "duration"),
    "excitation.leads": ("time", "periods"),
    "collision": (
        "distance",
        "fit",
        "packages",
        "floor",
        "capsules",
        "boxes",
        "pairs",
    ),
}
"""Names of the keys of each table; tests compare them with the arguments of TABLES."""
FORMER_KEYS = {
    ("model", "coulomb", "dead_zone"): 0.0,
    ("rollout", "friction"): True,
    ("rollout", "saturation"): True,
    ("rollout", "integral"): False,
    ("rollout", "torque_rows"): False,
    ("rollout", "gains"): False,
    ("rollout", "load_friction"): False,
    ("excitation", "polish"): 4,
}
"""Keys that earlier templates wrote, with the values that change nothing."""


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
    """Return the tables of an experiment file, whose names and keys are known."""
    try:
        tables = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        fault = str(error).rstrip(".")
        raise InputError(
            f"{path.name}: the file is not TOML in UTF-8: {fault}."
        ) from error
    _drop_former_keys(tables)
    try:
        _require_tables(tables)
        _require_known_keys(tables)
        with within("robot"):
            _require_robot(tables["robot"], path.parent)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    return tables


def _drop_former_keys(tables: TomlTable) -> None:
    """Remove keys that earlier templates wrote, at the values that change nothing."""
    for (*places, key), value in FORMER_KEYS.items():
        table = _table_at(tables, places)
        if isinstance(table, dict) and table.get(key) == value:
            del table[key]


def _table_at(tables: TomlTable, places: Iterable[str]) -> Any:
    """Return a table within tables; None if it is missing."""
    table: Any = tables
    for place in places:
        table = table.get(place) if isinstance(table, dict) else None
    return table


def _require_tables(tables: TomlTable) -> None:
    """Reject tables that are unknown, no tables, or missing."""
    check_names(tables, [name for name in KEYS if "." not in name])
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"`{name}` must be a table, but is {table!r}.")
    if "robot" not in tables:
        raise InputError(
            "the table `[robot]` is missing: give it `urdf`, `mjcf` or `builtin`."
        )


def _require_known_keys(tables: TomlTable) -> None:
    """Reject keys that no table of this name has."""
    for name, keys in KEYS.items():
        table = _table_at(tables, name.split("."))
        if isinstance(table, dict):
            check_names(table, keys, name)


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
        for key in ("tip", "base", "xacro_arguments"):
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
        channels += [
            channel
            for channel in ("forces", "velocities")
            if f"{channel}_file" not in recording
        ]
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


def check_names(
    table: TomlTable, known_names: Iterable[str], place: str = "the file"
) -> None:
    """Reject a key of a table, or a table of the file, that is not known."""
    known_names = list(known_names)
    for name in table:
        if name in known_names:
            continue
        is_file = place == "the file"
        path = name if is_file else f"{place}.{name}"
        similar_names = difflib.get_close_matches(name, known_names, n=1, cutoff=0.6)
        if similar_names:
            raise InputError(
                f"`{path}` is not a known key: did you mean `{similar_names[0]}`?"
            )
        owner = place if is_file else f"the table `[{place}]`"
        raise InputError(
            f"`{path}` is not a known key: {owner} has {', '.join(known_names)}."
        )


@contextmanager
def within(place: str, file: str = "") -> Iterator[None]:
    """Name a table in errors of deeper layers, and the file if it is not named yet."""
    try:
        yield
    except (InputError, FileNotFoundError) as error:
        raise InputError(f"{file}{': ' if file else ''}`{place}`: {error}") from error
