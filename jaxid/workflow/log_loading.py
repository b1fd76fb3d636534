"""Logs of a setup: read, filtered and examined; one of many samples stays on disk."""

import contextlib
import dataclasses
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.filter_selection import choose_filter
from jaxid.io import FilePath
from jaxid.measurement.columns import Columns
from jaxid.measurement.force_sensors import along_sensor_axes
from jaxid.measurement.imu_offset import without_imu_offset
from jaxid.measurement.log_files import estimated_rows
from jaxid.measurement.observations import Observations
from jaxid.measurement.reading import read_excerpt, read_recording, scan_log
from jaxid.measurement.recording import Recording, remove_delay
from jaxid.measurement.time_grid import NeedsMemory
from jaxid.robot.robot import Robot
from jaxid.units import NM
from jaxid.validation.contact_flags import CheckedContacts, check_contacts
from jaxid.validation.diagnosis import Diagnosis, diagnose
from jaxid.validation.torque_errors import comparison_step

from .setup import Progress, Setup, ignore_progress

LONG_LOG_ROWS = 500_000
"""Samples from which a log is read part by part."""
BRIDGED_PERIODS = 0.1
"""Pause that is bridged in any case, in periods of the largest cut-off frequency."""
MAX_CHOICE_SAMPLES = 60_000
"""Samples by which a filter is chosen, in all logs together: a few CPU seconds."""
MIN_SPEED_OF_MOTION = 1e-9
"""Speed below which a joint rests [rad/s or m/s]."""
MIN_SAMPLE_TIME = 1e-6
"""Sample time below which the unit of the time must be wrong [s]."""


class LoadedLog(NamedTuple):
    """Log as it is used."""

    observations: Observations  # filtered log
    diagnosis: Diagnosis  # findings on the log, and the log as it was read

    @property
    def findings(self) -> list[str]:
        """Findings on the log, each behind its name."""
        name = self.diagnosis.log.name
        return [f"{name}: {text}" for text in self.diagnosis.findings]


def read_log(setup: Setup, log: FilePath, columns: Columns) -> Recording:
    """Read a log into memory."""
    path = Path(log)
    reading = setup.reading
    filters = (setup.filter, *setup.filter_candidates)
    max_cutoff = max(getattr(x, "cutoff", np.inf) for x in filters)
    recording = read_recording(
        path,
        columns,
        largest_gap=reading.largest_gap,
        bridged=BRIDGED_PERIODS / max_cutoff,
        bad_rows=reading.bad_rows,
        start=reading.start,
        stop=reading.stop,
        forces_path=reading.forces_path(path),
    )
    require_plausible(recording, path, setup.robot)
    if reading.force_delay:
        recording = remove_delay(recording, reading.force_delay)
    if reading.imu_offset:
        recording = without_imu_offset(recording, setup.robot, setup.filter)
    if reading.in_ground:
        recording = along_sensor_axes(recording, setup.robot)
    return recording


def require_plausible(recording: Recording, log: Path, robot: Robot) -> None:
    """Reject a recording of another number of joints, or with a wrong unit of time."""
    joints = len(robot.driven)
    if recording.joints != joints:
        raise InputError(
            f"`recording.angles` names {recording.joints} of the columns of "
            f"`{log.name}`, but `{robot.name}` has {joints} joints: name one "
            "column for each, or choose another robot (`robot.tip`)."
        )
    if recording.sample_time < MIN_SAMPLE_TIME:
        rate = 1 / recording.sample_time
        raise InputError(
            f"`{log.name}` has {rate:.3g} samples in a second: check `time_unit`."
        )


def read_commands(setup: Setup, log: Path, columns: Columns) -> Recording:
    """Read a log with the commanded angles in place of forces.

    Raises:
        InputError: If the columns of the commands are not named, or not in the log.
    """
    if columns.commands is None:
        raise InputError(
            "`recording.commands` is missing: it names the columns of the "
            'commanded angles, like "cmd{}".'
        )
    # A robot without torques may have no columns of them.
    columns = dataclasses.replace(
        columns,
        forces=None,
        force_unit=NM,
        torque_constants=None,
        rated_forces=None,
        velocities=None,
    )
    recording = read_log(setup, log, columns)
    return dataclasses.replace(recording, forces=recording.commands)


def is_long(log: Path) -> bool:
    """Return whether a log is better read part by part than as a whole."""
    return estimated_rows(log) >= LONG_LOG_ROWS


def load_logs(
    setup: Setup,
    logs: Sequence[Path],
    columns: Columns,
    progress: Progress = ignore_progress,
) -> list[LoadedLog]:
    """Read and diagnose logs, whose names differ afterwards.

    Raises:
        InputError: If nothing moves in one of them.
    """
    stems = [path.stem for path in logs]
    loaded_logs = []
    for path in logs:
        name = None
        if stems.count(path.stem) > 1:
            name = f"{Path(os.path.realpath(path)).parent.name}/{path.stem}"
        log = load_log(setup, path, columns, progress, name)
        if log.diagnosis.statistics.speed.max() < MIN_SPEED_OF_MOTION:
            raise InputError(
                f"no joint moves in `{log.observations.name}`: "
                "name other columns, or leave this log out."
            )
        loaded_logs.append(log)
    return loaded_logs


def load_log(
    setup: Setup,
    path: Path,
    columns: Columns,
    progress: Progress = ignore_progress,
    name: str | None = None,
) -> LoadedLog:
    """Read and diagnose a log; one of many samples stays on the disk."""
    notes = ()
    if is_long(path):
        try:
            return _load_in_parts(setup, path, columns, progress, name)
        except NeedsMemory as reason:
            notes = (f"{path.name} is long, but had to be read as a whole: {reason}",)

    progress(f"reading {path.name}", 0.0)
    recording = read_log(setup, path, columns)
    if name is not None:
        recording = dataclasses.replace(recording, name=name)
    progress(f"filtering {path.name}", 0.0)
    checked = CheckedContacts(recording)
    if setup.robot.contacts:
        checked = check_contacts(
            setup.base,
            recording,
            setup.filter,
            partial(progress, f"looking through {path.name}"),
        )
        recording = checked.recording
    observations = setup.observe(recording)
    commanded_motion = None
    if recording.commands is not None:
        commanded_motion = dataclasses.replace(
            recording, angles=recording.commands, velocities=None
        )
    diagnosis = diagnose(
        recording, setup.robot, observations=observations, commands=commanded_motion
    )
    findings = (*diagnosis.findings, *checked.findings)
    diagnosis = dataclasses.replace(
        diagnosis, findings=findings, leg_mistakes=checked.mistakes
    )
    observations = observations.replace(notes=(*observations.notes, *notes))
    return LoadedLog(observations, diagnosis)


def _load_in_parts(
    setup: Setup, path: Path, columns: Columns, progress: Progress, name: str | None
) -> LoadedLog:
    """Open and diagnose a log that need not fit into memory.

    Raises:
        NeedsMemory: If it can be read as a whole only.
    """
    progress(f"opening {path.name}", 0.0)
    observations = open_long_log(setup, path, columns, name)
    diagnosis = diagnose(
        observations,
        setup.robot,
        min_speed=setup.min_speed,
        progress=partial(progress, f"looking through {path.name}"),
    )
    notes = (*observations.notes, *diagnosis.notes)
    step = comparison_step(observations)
    if step > 1:
        rows = f"one of every {step} of its {observations.rows} rows"
        notes = (*notes, f"{observations.name}: torque errors and figures use {rows}")
    return LoadedLog(observations.replace(notes=notes), diagnosis)


def open_long_log(
    setup: Setup, path: Path, columns: Columns, name: str | None = None
) -> Observations:
    """Open a log that need not fit into memory.

    Raises:
        NeedsMemory: If it can be read as a whole only.
    """
    reading = setup.reading
    if reading.force_delay:
        raise NeedsMemory("`recording.force_delay` shifts the angles of whole logs")
    return scan_log(
        path,
        columns,
        setup.robot,
        setup.filter,
        setup.decimation,
        setup.min_speed,
        name,
        largest_gap=reading.largest_gap,
        start=reading.start,
        stop=reading.stop,
        forces_path=reading.forces_path(path),
    )


def select_filter(
    setup: Setup,
    logs: Sequence[Path],
    columns: Columns,
    progress: Progress = ignore_progress,
    held_out: float | None = None,
) -> Setup:
    """Return the setup with the filter that suits some logs best; a note says why.

    The last part of each log, the fraction `held_out`, stays unseen. Of many samples
    only some are used.
    """
    if not setup.filter_candidates or not logs:
        return setup
    if setup.robot.floating:
        # Stretches between two changes of contact are too short for a comparison.
        return dataclasses.replace(setup, filter_candidates=())
    rows = sum(map(estimated_rows, logs))
    step = max(1, round(rows / MAX_CHOICE_SAMPLES))
    excerpts = []
    for log in logs[::step]:
        progress(f"reading {log.name}", 0.0)
        excerpts.append(load_excerpt(setup, log, columns, held_out))
    choice = choose_filter(
        setup.base,
        excerpts,
        setup.filter_candidates,
        estimator=setup.unbounded_estimator,
        min_speed=setup.min_speed,
        row_step=setup.decimation.step,
        progress=partial(progress, "choosing the filter"),
    )
    return dataclasses.replace(
        setup,
        unknowns=setup.base,
        filter=choice.filter,
        filter_candidates=(),
        notes=(*setup.notes, str(choice)),
    )


def load_excerpt(
    setup: Setup, log: Path, columns: Columns, held_out: float | None = None
) -> Recording:
    """Read a part of a log that is large enough for a choice between filters.

    The last part of the log, the fraction `held_out`, stays unseen.
    """
    share = 1.0 if held_out is None else fitted_share(held_out)
    if is_long(log):
        with contextlib.suppress(NeedsMemory):
            # Slow rows are masked later; here they would cost a pass over the log.
            fast_setup = dataclasses.replace(setup, min_speed=None)
            long_log = open_long_log(fast_setup, log, columns)
            return read_excerpt(long_log, MAX_CHOICE_SAMPLES, share)
    recording = read_log(setup, log, columns)
    share = min(share, MAX_CHOICE_SAMPLES / recording.samples)
    return recording if share == 1.0 else recording.split(share)[0]


def fitted_share(held_out: float) -> float:
    """Return the fraction of each log that is fitted, as a user would write it."""
    return round(1.0 - held_out, 12)
