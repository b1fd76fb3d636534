"""How logs are read: files, parts, gaps, bad rows, and the delay of the forces."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.log_files import Selection
from jaxid.measurement.reading import MAX_BAD_ROWS, read_recording
from jaxid.measurement.recording import Recording, remove_delay
from jaxid.robot.robot import Robot
from jaxid.units import NM

from .allowed_values import Bounds

MIN_SAMPLE_TIME = 1e-6
"""Sample time below which the unit of the time must be wrong [s]."""


@dataclasses.dataclass(frozen=True)
class LogReading:
    """Files and parts of the logs, and how they are read.

    Attributes:
        forces_file: File of the forces, if they lie in another file beside the log,
            like `"{}_torque.csv"`: "{}" stands for the log's name without its suffix.
        velocities_file: File of the velocities, likewise, like `"{}_speed.csv"`.
        commands: Columns of the commanded angles, like `"cmd{}"`: with them `jaxid
            inspect` tells a delay in spite of disturbances, and `jaxid rollout` needs
            no `forces`.
        force_delay: Time by which forces stand later in the log than angles [s].
        largest_gap: Longest pause that is bridged, in sample times; a tenth of the
            period of the filter's cut-off frequency is bridged in any case.
        bad_rows: Fraction of the rows that may be bad, and are left out.
        start: Start of the part of every log that is used [s], like `0.0`.
        stop: End of that part [s], like `10.0`.
    """

    forces_file: str | None = None
    velocities_file: str | None = None
    commands: Selection | None = None
    force_delay: float = 0.0
    largest_gap: Annotated[float, Bounds(above=1.0)] = 1.75
    bad_rows: Annotated[float, Bounds(minimum=0.0, below=1.0)] = MAX_BAD_ROWS
    start: float = -np.inf
    stop: float = np.inf

    def files(self, log: Path) -> dict[str, Any]:
        """Return the paths of the files beside a log, as the readers take them."""
        return {
            "forces_path": file_beside(log, self.forces_file),
            "velocities_path": file_beside(log, self.velocities_file),
        }

    def read(
        self, log: Path, columns: Columns, robot: Robot, bridged: float
    ) -> Recording:
        """Read a log into memory.

        Args:
            log: Path of the log.
            columns: Meaning of its columns.
            robot: Robot of the log.
            bridged: Pause that is bridged in any case [s].
        """
        recording = read_recording(
            log,
            columns,
            largest_gap=self.largest_gap,
            bridged=bridged,
            bad_rows=self.bad_rows,
            **self.files(log),
        )
        require_plausible(recording, log, robot)
        if np.isfinite((self.start, self.stop)).any():
            recording = recording.crop(self.start, self.stop)
        if self.force_delay:
            recording = remove_delay(recording, self.force_delay)
        return recording

    def read_commands(
        self, log: Path, columns: Columns, robot: Robot, bridged: float
    ) -> Recording:
        """Read a log with the commanded angles in place of forces.

        Raises:
            InputError: If the columns of the commands are not named, or not in the log.
        """
        if self.commands is None:
            raise InputError(
                "`recording.commands` is missing: it names the columns of the "
                'commanded angles, like "cmd{}".'
            )
        # Readers know no commands: they read them as forces, with their units ...
        measured_columns = dataclasses.replace(
            columns,
            forces=self.commands,
            force_unit=NM,
            force_signs=None,
            force_gains=None,
            torque_constants=None,
            velocities=None,
        )
        # ... and once more as angles, in the units and signs of these.
        command_columns = dataclasses.replace(
            measured_columns, angles=self.commands, forces=columns.angles
        )
        try:
            measured = self.read(log, measured_columns, robot, bridged)
        except InputError as error:
            text = str(error).replace("`forces`", "`commands`")
            raise InputError(text) from None
        commands = self.read(log, command_columns, robot, bridged)
        return dataclasses.replace(measured, forces=commands.angles)


def file_beside(log: Path, pattern: str | None) -> Path | None:
    """Return the file beside a log that a pattern such as "{}_torque.csv" names."""
    return None if pattern is None else log.parent / pattern.replace("{}", log.stem)


def require_plausible(recording: Recording, log: Path, robot: Robot) -> None:
    """Reject a recording of another number of joints, or with a wrong unit of time."""
    if recording.joints != robot.joints:
        raise InputError(
            f"`recording.angles` names {recording.joints} of the columns of "
            f"`{log.name}`, but `{robot.name}` has {robot.joints} joints: name one "
            "column for each, or choose another robot (`robot.tip`)."
        )
    if recording.sample_time < MIN_SAMPLE_TIME:
        rate = 1 / recording.sample_time
        raise InputError(
            f"`{log.name}` has {rate:.3g} samples in a second: check `time_unit`."
        )
