"""Reports of identifications by simulated motions: errors, motions, models."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import Vector
from jaxid.export.servo_actuators import (
    export_servo_mjcf,
    gain_findings,
    simulator_table,
    simulator_values,
)
from jaxid.io import FilePath
from jaxid.result_table import Column, Remark, Status, Table, significant
from jaxid.robot.robot import Robot
from jaxid.rollout import RolloutErrors, ServoFit, TorqueRolloutFit
from jaxid.rollout.contact_evidence import contact_findings

from .figure import Figure
from .figure_elements import (
    ERROR,
    GREY,
    MEASUREMENT_COLOUR,
    PREDICTION_COLOUR,
    Curve,
    Panel,
)
from .motion_figures import compared_poses
from .result_records import Record, estimate_rows
from .several_runs_report import Answer, RunsReport

MAX_FIGURES = 6
"""Motions whose figures the page shows."""
MAX_RATIO = 0.9
"""Error of a good simulation, relative to those of the baselines."""
BASELINES = {
    "linear": "linear joint\nwith delay",
    "command": "copied\ncommand",
    "fit_of_torques": "fit of\ntorques",
}
"""Headers of the errors of baselines."""
NOT_VALIDATED = Remark(
    "The simulation was not validated on another log: use `--verify`",
    Status.DOUBTFUL,
)
"""Doubt about a simulation that was compared with the logs of its fit only."""
HOW_TO_READ = "If a row names several parameters, the logs determine only their sum."
"""How to read the table of estimates."""
Sources = Mapping[str, Sequence[Path]]
"""Logs of the `fit`, and those for its `validation`, which it has not seen."""


@dataclasses.dataclass(frozen=True, eq=False)
class RolloutReport(RunsReport):
    """Result of rollouts; servos are also written for MuJoCo.

    Attributes:
        samples: Number of MJCF files to draw.
    """

    samples: int = 0

    def save(self, folder: FilePath) -> list[Path]:
        """Write page and numbers, and the robot for MuJoCo if its bodies are known."""
        files = super().save(folder)
        fit = self.result
        if not isinstance(fit, ServoFit) or fit.bodies is None or not fit.has_stiffness:
            return files
        path = Path(folder) / "robot.xml"
        models = export_servo_mjcf(fit, path, samples=self.samples)
        return [*files, path, *dict.fromkeys(file.parent for file in models[1:])]


def servo_report(
    robot: Robot,
    fit: ServoFit,
    errors: RolloutErrors,
    windows: Vector,
    sources: Sources,
    samples: int,
) -> RolloutReport:
    """Return the report of joints behind position servos.

    Args:
        robot: The robot.
        fit: Identified servos.
        errors: Errors of simulations.
        windows: Errors of windows of one second that start from measured states [rad or
            m].
        sources: Logs.
        samples: Number of MJCF files to draw.
    """
    findings = [*gain_findings(fit), *contact_findings(robot, errors)]
    disagreements = sum(not c.agrees for c in fit.combinations)
    if disagreements:
        text = (
            f"In {disagreements} of {len(fit.combinations)} parameters, motions or "
            "equal joints differ by more than noise: these parameters have wider "
            "intervals, and are marked !"
        )
        findings.append(Remark(text))
    rows = []
    for c in fit.combinations:
        low, high = c.interval()
        row = {
            "name": c.name,
            "joint": fit.joint_names[c.joint],
            "kind": c.meaning,
            "unit": c.unit,
            "estimate": c.value,
            "standard_deviation": c.deviation,
            "dof": c.dof,
            "agrees": c.agrees,
            "low_95": low,
            "high_95": high,
        }
        rows.append(row)
    content: Record = {"kind": "commands", "windows": windows}
    content["simulators"] = simulator_values(fit) if fit.has_stiffness else None
    column = Column("simulation,\nwindows of 1 s", 1e3 * windows)
    report = _report(robot, fit, errors, sources, findings, content, rows, [column])
    tables = [simulator_table(fit)] if fit.has_stiffness else []
    details = [*report.details, *tables]
    return dataclasses.replace(report, samples=samples, details=details)


def torque_report(
    robot: Robot,
    fit: TorqueRolloutFit,
    errors: RolloutErrors,
    sources: Sources,
    findings: Sequence[Remark],
) -> RolloutReport:
    """Return the report of simulations under recorded torques.

    Args:
        robot: The robot.
        fit: Fit of rollouts.
        errors: Errors of simulations.
        sources: Logs.
        findings: Findings on the logs.
    """
    run = fit.run
    rows = estimate_rows(run.names, run.units, fit.unknowns, fit.uncertainty)
    for row, kind, dof in zip(rows, run.kinds, fit.uncertainty.dof, strict=True):
        row.update(kind=kind, dof=float(dof))
    content = {"kind": "torques", "horizon": fit.horizon}
    return _report(robot, fit, errors, sources, findings, content, rows)


def _report(
    robot: Robot,
    fit: ServoFit | TorqueRolloutFit,
    errors: RolloutErrors,
    sources: Sources,
    findings: Sequence[Remark],
    content: Record,
    rows: list[Record],
    columns: Sequence[Column] = (),
) -> RolloutReport:
    """Return what reports of both kinds have in common.

    Args:
        robot: The robot.
        fit: The fit.
        errors: Errors of simulations.
        sources: Logs.
        findings: Findings on fit and logs.
        content: Numbers for programs.
        rows: Estimates, one row each.
        columns: Further columns of the table of errors.
    """
    is_unseen = "validation" in sources
    units = [f"m{robot.joint_unit(j)}" for j in range(robot.joints)]
    is_good = _is_good(errors)
    doubts = [] if is_unseen else [NOT_VALIDATED]
    if not is_good.all():
        joints = ", ".join(np.array(errors.joint_names)[~is_good])
        text = f"The simulation is hardly closer to the robot than a baseline: {joints}"
        doubts.append(Remark(text, Status.DOUBTFUL))
    logs = "logs that the fit did not use" if is_unseen else "logs of the fit"
    comparison = Table(
        f"errors on {logs}, {errors.sample_words} (RMS)",
        Column("joint", errors.joint_names),
        Column("unit", units),
        Column(f"simulation,\n{errors.manner}", 1e3 * errors.total()),
        *columns,
        *(Column(BASELINES[x], 1e3 * errors.total(x)) for x in errors.baselines),
        status=[Status.GOOD if x else Status.DOUBTFUL for x in is_good],
    )
    kinds = ("simulated", *errors.baselines)
    error_record = {kind: errors.rms(kind) for kind in kinds}
    error_record |= {"motions": errors.motions, "unseen": is_unseen}
    return RolloutReport(
        "rollout",
        fit,
        _answer(robot, errors, units),
        rows,
        {**content, "joints": errors.joint_names, "errors": error_record},
        sources,
        findings=[*doubts, *findings],
        details=[comparison, errors.summary(units)],
    )


def _is_good(errors: RolloutErrors) -> np.ndarray:
    """Return for which joints the simulation is better than all baselines."""
    rival_errors = [errors.total(name) for name in errors.baselines]
    return errors.total() < MAX_RATIO * np.min(rival_errors, axis=0)


def _answer(robot: Robot, errors: RolloutErrors, units: Sequence[str]) -> Answer:
    """Return what the page says and shows: the largest errors, and the motions."""
    totals = 1e3 * errors.total()
    joint = int(np.argmax(totals))
    unit = units[joint]
    name = errors.joint_names[joint]
    error = f"{significant(totals[joint])} {unit}"
    sentence = f"The largest error of the simulation, {error} RMS, is at joint `{name}`"
    if _is_good(errors).all():
        sentence = (
            "The simulation is closer to the robot than its baselines; the largest "
            f"error, {error} RMS, is at joint `{name}`"
        )
    numbers = [(error, f"simulation, largest error, joint {name}")]
    for baseline in errors.baselines:
        value = significant(1e3 * errors.total(baseline)[joint])
        words = BASELINES[baseline].replace("\n", " ")
        numbers.append((f"{value} {unit}", f"{words}, joint {name}"))

    # The motion with the largest error shows most.
    motion = int(np.argmax(errors.rms().max(axis=1)))
    scene = compared_poses(
        robot,
        errors.time[motion],
        errors.measured[motion].T,
        errors.simulated[motion].T,
        title=(
            f"{errors.motions[motion]}: measured and simulated robot (on screen blue "
            "and orange)"
        ),
    )
    motions = range(min(MAX_FIGURES, len(errors.motions)))
    figures = [scene, *(motion_figure(errors, k, units) for k in motions)]
    title = f"{robot.name}: simulated motion"
    return Answer(title, sentence, numbers, figures, HOW_TO_READ)


def motion_figure(errors: RolloutErrors, motion: int, units: Sequence[str]) -> Figure:
    """Return measured and simulated positions of all joints in a motion, and errors."""
    time = errors.time[motion]
    measured = errors.measured[motion]
    simulated = errors.simulated[motion]
    commands = errors.baselines.get("command")
    panels = []
    for j, name in enumerate(errors.joint_names):
        curves = [
            Curve(time, measured[j], "measured", MEASUREMENT_COLOUR, width=1.9),
            Curve(time, simulated[j], "simulated", PREDICTION_COLOUR, width=0.9),
        ]
        if commands is not None:
            path = commands[motion][j]
            curve = Curve(time, path, "commanded", GREY, width=0.6, dashed=True)
            curves.insert(0, curve)
        rms = significant(1e3 * errors.rms()[motion, j])
        joint_errors = 1e3 * (simulated[j] - measured[j])
        error = Curve(time, joint_errors, "error", ERROR, width=0.7)
        panel = Panel(
            curves,
            title=name,
            value=f"RMS {rms} {units[j]}",
            y="position",
            unit=units[j].removeprefix("m"),
            below=[Panel([error], y="error", unit=units[j], share=0.6)],
        )
        panels.append(panel)
    title = f"{errors.motions[motion]}: measured, and simulated {errors.manner}"
    return Figure(title, panels, columns=2, height=3.6)
