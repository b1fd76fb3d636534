"""Reads a robot's log: which file, which columns, which units."""

from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns, Selection
from jaxid.measurement.recording import Recording
from jaxid.measurement.tables import Table, read_table


def read_recording(
    path: str | Path,
    columns: Columns,
    name: str | None = None,
    *,
    forces_path: str | Path | None = None,
    velocities_path: str | Path | None = None,
    largest_gap: float | int = 1.75,
) -> Recording:
    """Reads a log as CSV (any separator, with or without header), Parquet, NPZ or MAT.

    Args:
        path: Of the file with the angles, and with the rest if no other is named.
        columns: What the columns hold.
        name: Of the recording; the file's if None.
        forces_path: Of the file with the forces.
        velocities_path: Of the file with the velocities.
        largest_gap: Longest pause that is bridged by interpolation, in sample times; longer ones
            split the recording into segments.

    Raises:
        InputError: If a file, a column, a number or the time is not what it should be; the
            message names file, column and line.
    """
    table = read_table(path)
    forces_table = table if forces_path is None else read_table(forces_path)
    velocities_table = table if velocities_path is None else read_table(velocities_path)

    own = {"angles": columns.angles, "time": columns.time}
    other = {"forces": columns.forces, "velocities": columns.velocities}
    homes = {"forces": forces_path, "velocities": velocities_path}
    table.refuse_shared(own | {what: s for what, s in other.items() if homes[what] is None})
    angles = table.array("angles", columns.angles)
    joints = angles.shape[1]
    forces = _like(angles, table, forces_table, "forces", columns.forces)
    velocities = None
    if columns.velocities is not None:
        velocities = _like(angles, table, velocities_table, "velocities", columns.velocities)
        velocities = velocities * columns.velocity_scale(joints)
    elif velocities_path is not None:
        raise InputError("`velocities_path` is given, but `Columns.velocities` names no columns.")
    stamps = None
    if columns.time is not None:
        stamps, dates = table.stamps(columns.time)
        stamps = stamps if dates else stamps * columns.time_unit.factor
        if len(stamps) != len(angles):
            raise InputError(
                f"`time` of `{table.source}` has {len(stamps)} stamps for {len(angles)} samples of "
                "the angles: arrays must have one row for each sample (transpose them)."
            )
    return Recording.of(
        angles * columns.angle_scale(joints) + columns.angle_shift(joints),
        forces * columns.force_scale(joints),
        velocities=velocities,
        time=stamps,
        sample_time=columns.sample_time,
        angles_on_motor_side=columns.angles_on_motor_side,
        forces_on_motor_side=columns.forces_on_motor_side,
        largest_gap=largest_gap,
        name=Path(path).stem if name is None else name,
        first_row=1 if table.first_line is None else table.first_line,
    )


def _like(
    angles: np.ndarray, angles_table: Table, table: Table, what: str, selection: Selection
) -> np.ndarray:
    array = table.array(what, selection)
    if len(array) != len(angles):
        raise InputError(
            f"`{what}` in `{table.source}` have {len(array)} samples, but the angles in "
            f"`{angles_table.source}` have {len(angles)}: they must be of one run, row by row."
        )
    if array.shape[1] != angles.shape[1]:
        raise InputError(
            f"`{what}` in `{table.source}` have {array.shape[1]} joints, but the angles in "
            f"`{angles_table.source}` have {angles.shape[1]}: name one column for each joint."
        )
    return array
