"""Identification from logs: they are read, filtered, fitted, judged and reported."""

import dataclasses
import functools
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.combination import without_bounds
from jaxid.identification.delay import with_unknown_delay
from jaxid.identification.encoder_resolution import resolution_note
from jaxid.identification.fit_result import Fit
from jaxid.identification.problem import RegressionProblem
from jaxid.io import FilePath
from jaxid.measurement.columns import Columns
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.report.identification_page import body_table, motor_tables
from jaxid.report.result_files import write_report
from jaxid.result_table import Remark, Summarised, Table, significant
from jaxid.robot.collision_geometry import BodyShape
from jaxid.robot.virtual_joints import GROUP
from jaxid.validation.diagnosis import mistakes_in_logs
from jaxid.validation.judgement import Judgement, Report, judge
from jaxid.validation.torque_errors import (
    TorqueErrors,
    error_table,
    errors_of_parameters,
    validate,
)

from .log_loading import LoadedLog, fitted_share, load_logs, select_filter
from .robot_file import RobotFile, base_parameters_of, claimed_parameters
from .setup import Paths, Progress, Setup, ignore_progress

INTERVAL = 1.96
"""Half a 95 % interval over the standard deviation."""
MAX_COLUMNS = 5
"""Largest number of logs whose errors are shown one by one in few lines."""


@dataclasses.dataclass(frozen=True, eq=False)
class IdentificationReport(Summarised, Report):
    """Identified model, its validation, and the judgement, which notebooks show.

    Attributes:
        robot_file: Description whose shapes the page shows; None without a file.
    """

    robot_file: RobotFile | None = None

    @property
    def shapes(self) -> list[BodyShape]:
        """Shapes of the robot's bodies in its file, as far as they can be read."""
        if self.robot_file is None:
            return []
        # The file does not know of a sensor under the base.
        first = GROUP if self.fit.base.model.robot.has_base_sensor else 0
        return [
            (body + first if body >= 0 else body, shape)
            for body, shape in self.robot_file.shapes()
        ]

    @functools.cached_property
    def judgement(self) -> Judgement:
        """Findings, the most severe first, and the verdict that sums them up."""
        return judge(self)

    @property
    def verdict(self) -> Remark:
        """Whether the model may be used, in one sentence."""
        return self.judgement.verdict

    def overview(self) -> list[Table]:
        """Return the verdict, the findings and the torque errors, in few lines."""
        base = self.fit.base
        robot = base.model.robot
        groups = {errors.name: [errors] for errors in self.every_error}
        if len(groups) > MAX_COLUMNS:
            groups = {
                "logs of the fit": self.identification,
                "other logs": self.verification,
            }
        joint_errors = {name: logs for name, logs in groups.items() if logs}
        title = f"{robot.name}: {len(robot.driven)} joints, {base.size} base parameters"
        return [
            Table(title, facts=total_mass(self.fit), remarks=self.judgement.overview()),
            error_table(joint_errors, robot.joint_names),
        ]

    def tables(self) -> list[Table]:
        """Return estimates and torque errors, then all findings and the verdict."""
        fit = self.fit
        robot = fit.base.model.robot
        tables = [robot.summary(), *motor_tables(robot), fit.summary()]
        if fit.consistency is not None:
            names = [robot.body_names[body] for body in robot.solid_bodies]
            tables.append(body_table(fit.consistency, names, self.claimed_bodies))
        tables += self.validation.tables()
        findings = self.judgement.findings
        sentences = {finding.text for finding in findings}
        for table in tables:
            # What is judged below is not said twice.
            remarks = [x for x in table.remarks if x.text not in sentences]
            table.remarks = tuple(remarks)
        lines = [dataclasses.replace(x, detail="") for x in findings]
        return [*tables, Table("", remarks=[*lines, self.verdict])]

    def save(self, folder: FilePath, figures: str = "") -> list[Path]:
        """Write a report, and return the paths of its files.

        They are `report.html`, `result.json`, `parameters.csv` and `model.json`.

        Args:
            folder: Folder of the report; other files in it are kept.
            figures: Format of files with the figures, if they are wanted: "svg", "png"
                or "pdf".
        """
        return write_report(Path(folder), self, figures)


class LogParts(NamedTuple):
    """Observations that are fitted, and observations for the validation."""

    training_logs: list[Observations]
    unseen_logs: list[Observations]

    @property
    def every(self) -> list[Observations]:
        """All observations."""
        return [*self.training_logs, *self.unseen_logs]


def identify_logs(
    setup: Setup,
    logs: Paths,
    columns: Columns,
    held_out: float | None = None,
    verify: Paths = (),
    progress: Progress = ignore_progress,
) -> IdentificationReport:
    """Identify a robot with logs, and validate with others or the rest of them.

    Args:
        setup: How logs become parameters.
        logs: Paths of logs.
        columns: Meaning of the columns of the logs.
        held_out: Fraction of each log, its last part, that is kept for the validation.
        verify: Paths of further logs for the validation.
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Raises:
        InputError: If a log cannot be used, or would count twice.
    """
    logs = [Path(log) for log in logs]
    verify = [Path(log) for log in verify]
    require_separate_logs(logs, verify, held_out)
    setup = select_filter(setup, logs, columns, progress, held_out)
    loaded_logs = load_logs(setup, [*logs, *verify], columns, progress)
    fitted_logs = loaded_logs[: len(logs)]
    parts = split_logs(loaded_logs, len(logs), held_out)
    progress("finding base parameters", 0.0)
    base = setup.base
    rows = RegressionProblem(
        base, parts.training_logs, partial(progress, "factorising the rows")
    )
    fit = setup.fit(rows)

    progress_of_search = partial(progress, "looking for mistakes")
    progress_of_search(0.0)
    # Bounds would hide what is wrong.
    diagnoses = [log.diagnosis for log in fitted_logs]
    bodies = setup.file_bodies
    mistakes = mistakes_in_logs(
        diagnoses, without_bounds(fit), bodies, progress_of_search
    )
    if mistakes.delay is not None:
        fit = with_unknown_delay(fit, rows, mistakes.delay)
    validation = validate(
        fit, parts.every, progress=partial(progress, "predicting torques")
    )
    notes = [note for part in parts.every for note in part.notes]
    for diagnosis in diagnoses:
        notes += [f"{diagnosis.log.name}: {note}" for note in diagnosis.notes]
    notes += resolution_notes(fit, fitted_logs)
    notes += mistakes.remarks
    doubts = [text for log in loaded_logs for text in log.findings]
    unseen_mistakes = [
        f"{log.diagnosis.log.name}: {text}"
        for log in loaded_logs[len(logs) :]
        for text in log.diagnosis.leg_mistakes
    ]
    claims = errors_of_claims(setup, fit, parts.every)
    return IdentificationReport(
        fit,
        validation.errors[: len(parts.training_logs)],
        validation.errors[len(parts.training_logs) :],
        validation.definiteness,
        settings={
            "identification": list(map(str, logs)),
            "verification": list(map(str, verify)),
            "split": None if held_out is None else fitted_share(held_out),
            "filter": str(setup.filter),
            "decimation": str(setup.decimation),
            "min_speed": setup.min_speed,
        },
        notes=(*setup.notes, *dict.fromkeys(notes)),
        doubts=[*doubts, *mistakes.doubts],
        mistakes=(*mistakes.certain, *unseen_mistakes),
        claimed=claims.errors,
        claimed_loads=claims.load_errors,
        claimed_parameters=claims.parameters,
        claimed_bodies=claims.bodies,
        robot_file=setup.robot_file,
    )


def require_separate_logs(
    logs: Sequence[Path], verify: Sequence[Path] = (), held_out: float | None = None
) -> None:
    """Reject logs that would count twice, or verify a model that has seen them."""
    if held_out is not None and not 0 < held_out < 1:
        raise InputError(
            f"`held_out` must lie between 0 and 1, like 0.4, but is {held_out:g}."
        )
    places = [os.path.realpath(log) for log in logs]
    for number, log in enumerate(logs):
        if places[number] in places[:number]:
            raise InputError(f"`{log}` is given twice: its rows would count twice.")
    shared_places = set(places) & {os.path.realpath(log) for log in verify}
    if shared_places:
        raise InputError(
            f"`{Path(min(shared_places)).name}` is given both for the fit and for "
            "validation: use `--split`, or `held_out` in Python."
        )


def split_logs(
    logs: Sequence[LoadedLog], count: int, held_out: float | None
) -> LogParts:
    """Return the first `count` logs, or first parts, for the fit, and all the rest."""
    observations = [log.observations for log in logs]
    fitted_logs = observations[:count]
    unseen_logs = observations[count:]
    if held_out is None:
        return LogParts(fitted_logs, unseen_logs)
    share = fitted_share(held_out)
    training_logs = []
    remaining_parts = []
    for log in fitted_logs:
        first_part, remaining_part = log.split(share)
        name = f"{log.name}, first {100 * share:g} %"
        training_logs.append(first_part.replace(name=name))
        remaining_parts.append(remaining_part.replace(name=f"{log.name}, rest"))
    return LogParts(training_logs, [*remaining_parts, *unseen_logs])


def resolution_notes(fit: Fit, logs: Sequence[LoadedLog]) -> list[str]:
    """Return what the resolution of the encoders explains, log by log."""
    notes = []
    for observations, diagnosis in logs:
        recording = diagnosis.log
        has_joints_only = not fit.base.model.robot.virtual and not diagnosis.faulty
        if isinstance(recording, Recording) and has_joints_only:
            texts = resolution_note(fit, recording, observations)
            notes += [f"{recording.name}: {text}" for text in texts]
    return notes


class Claims(NamedTuple):
    """Parameters that the robot's file claims, compared with logs."""

    errors: tuple[TorqueErrors, ...] = ()  # torque errors on each log
    load_errors: tuple[TorqueErrors, ...] = ()  # without friction, on the first log
    parameters: np.ndarray | None = None  # base parameters; NaN without a claim
    bodies: np.ndarray | None = None  # their inertial parameters [bodies, 10]


def errors_of_claims(setup: Setup, fit: Fit, logs: Sequence[Observations]) -> Claims:
    """Return torque errors of the parameters claimed by the robot's file, if any."""
    if setup.robot_file is None:
        return Claims()
    values = setup.robot_file.claims()
    if not values:
        return Claims()
    base = fit.base
    parameters = base_parameters_of(values, base)
    errors = errors_of_parameters(fit, parameters, logs)
    # Files often state friction that nobody has measured.
    loads = {k: x for k, x in values.items() if not k.startswith(("fv", "fc"))}
    load_errors = errors[:1]
    if len(loads) < len(values):
        load_parameters = base_parameters_of(loads, base)
        load_errors = errors_of_parameters(fit, load_parameters, logs[:1])
    bodies = setup.robot_file.bodies()
    return Claims(errors, load_errors, claimed_parameters(values, base), bodies)


def total_mass(fit: Fit) -> list[tuple[str, str]]:
    """Return the total mass of a robot on legs with its 95 % interval; else nothing."""
    base = fit.base
    if not base.model.robot.floating:
        return []
    masses = np.zeros(base.model.size)
    masses[: 10 * len(base.model.robot.solid_bodies) : 10] = 1.0
    total = masses[list(base.indices)]
    with np.errstate(invalid="ignore"):
        variance = total @ np.asarray(fit.covariance) @ total
    if not np.isfinite(variance):
        return [("total mass", "not determined")]
    mass = significant(float(total @ fit.parameters), 5)
    width = significant(INTERVAL * float(np.sqrt(variance)), 2)
    return [("total mass", f"{mass} ± {width} kg (95 %)")]
