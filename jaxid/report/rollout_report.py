"""Reports of identifications by simulated motions: motions, errors, numbers."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import Vector
from jaxid.export.servo_actuators import (
    export_servo_mjcf,
    gain_finding,
    simulator_table,
    simulator_values,
)
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    significant,
    sort_remarks,
)
from jaxid.robot.robot import Robot
from jaxid.rollout import RolloutErrors, ServoFit, TorqueRolloutFit
from jaxid.rollout.contact_evidence import contact_finding
from jaxid.validation.judgement import Judgement

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
from .page import Section, Settings, folded, provenance, render_page
from .result_files import write_page_and_table
from .result_records import Record, estimate_rows, verdict_rows

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
    "The simulation was not validated on an unseen log: use `--verify`",
    Status.DOUBTFUL,
)
"""Doubt about a simulation that was compared with the logs of its fit only."""


@dataclasses.dataclass(frozen=True, eq=False)
class RolloutReport(Summarised):
    """Content of a report.

    Attributes:
        robot: The robot.
        errors: Errors of simulations.
        unseen: Whether these logs were not used for the fit.
        findings: Findings on the fit and the logs.
        settings: Facts, command and text of the experiment file.
    """

    robot: Robot
    errors: RolloutErrors
    unseen: bool
    findings: Sequence[Remark]
    settings: Settings

    def result_tables(self) -> list[Table]:
        """Return what the logs determine."""
        raise NotImplementedError

    def rows(self) -> list[Record]:
        """Return the parameters that the logs determine, one row for each."""
        raise NotImplementedError

    def numbers(self) -> Record:
        """Return further numbers for programs."""
        raise NotImplementedError

    def write_models(self, folder: Path) -> list[Path]:
        """Write the robot for simulators, if it can be; return files and folders."""
        return []

    @property
    def judgement(self) -> Judgement:
        """Findings, the most severe first, and the verdict that sums them up."""
        findings = sort_remarks([*self._judge_errors(), *self.findings])
        verdict = Remark("A good simulation: nothing speaks against it", Status.GOOD)
        if findings[0].status is Status.DOUBTFUL:
            text = "A usable simulation; look at what is marked ! before you rely on it"
            verdict = Remark(text, Status.DOUBTFUL)
        return Judgement(tuple(findings), verdict)

    def _judge_errors(self) -> Iterator[Remark]:
        """Compare the simulation with its baselines, and joints with each other."""
        if not self.unseen:
            yield NOT_VALIDATED
        errors = 1e3 * self.errors.total()
        worst_joint = int(np.argmax(errors))
        joint_name = self.errors.joint_names[worst_joint]
        error = f"{significant(errors[worst_joint])} {self._units[worst_joint]} RMS"
        is_good = self._is_good
        comparison = "closer to the robot than its baselines"
        if not is_good.all():
            joints = ", ".join(np.array(self.errors.joint_names)[~is_good])
            comparison = f"hardly closer to the robot than a baseline ({joints})"
        yield Remark(
            f"The simulation is {comparison}; the largest error, {error}, is at "
            f"{joint_name}",
            Status.GOOD if is_good.all() else Status.DOUBTFUL,
        )

    @property
    def _is_good(self) -> np.ndarray:
        """For which joints the simulation is better than all baselines."""
        errors = self.errors
        baselines = [errors.total(name) for name in errors.baselines]
        return errors.total() < MAX_RATIO * np.min(baselines, axis=0)

    @property
    def _units(self) -> list[str]:
        """Unit of each joint's errors."""
        return [f"m{self.robot.joint_unit(j)}" for j in range(self.robot.joints)]

    def error_tables(self) -> list[Table]:
        """Return the errors beside those of the baselines, and those by motion."""
        errors = self.errors
        logs = "logs that the fit has not seen" if self.unseen else "logs of the fit"
        comparison = Table(
            f"errors on {logs}, {errors.sample_words} (RMS)",
            Column("joint", errors.joint_names),
            Column("unit", self._units),
            Column(f"simulation,\n{errors.manner}", 1e3 * errors.total()),
            *self.further_errors(),
            *(Column(BASELINES[x], 1e3 * errors.total(x)) for x in errors.baselines),
            status=[Status.GOOD if x else Status.DOUBTFUL for x in self._is_good],
        )
        rms = 1e3 * errors.rms()
        columns = map(Column, errors.joint_names, rms.T, self._units)
        motions = Column("motion", errors.motions)
        return [comparison, Table("errors of each motion", motions, *columns)]

    def further_errors(self) -> list[Column]:
        """Return errors of other simulations with the same parameters."""
        return []

    @property
    def verdict(self) -> Remark:
        """Whether the simulation may be used, in one sentence."""
        return self.judgement.verdict

    def overview(self) -> list[Table]:
        """Return the verdict, the findings and the errors, in few lines."""
        title = f"{self.robot.name}: simulated motion"
        findings = Table(title, remarks=self.judgement.overview())
        return [findings, self.error_tables()[0]]

    def tables(self) -> list[Table]:
        """Return estimates and errors, then all findings and the verdict."""
        judgement = self.judgement
        lines = [*judgement.findings, judgement.verdict]
        tables = [*self.result_tables(), *self.error_tables()]
        return [*tables, Table("", remarks=lines)]

    def write(self, folder: Path) -> list[Path]:
        """Write a page, the numbers as JSON and CSV, and models for simulators."""
        models = self.write_models(folder)
        rows = self.rows()
        record = self._record(rows)
        files = write_page_and_table(folder, "rollout", self._page(), record, rows)
        return files + models

    def _page(self) -> str:
        """Return the page as HTML."""
        errors = self.errors
        motions = range(min(MAX_FIGURES, len(errors.motions)))
        figures = [motion_figure(errors, motion, self._units) for motion in motions]
        # The motion with the largest error shows most.
        motion = int(np.argmax(errors.rms().max(axis=1)))
        scene = compared_poses(
            self.robot,
            errors.time[motion],
            errors.measured[motion].T,
            errors.simulated[motion].T,
            title=f"{errors.motions[motion]}: measured and simulated robot",
        )
        sections: list[Section] = [
            ("At a glance", self._glance()),
            ("Errors", self.error_tables()),
            ("Measured and simulated motion", [scene, *figures]),
            ("What the logs determine", self.result_tables()),
            provenance(self.settings),
        ]
        return render_page(f"{self.robot.name}: simulated motion", sections)

    def _glance(self) -> list[Any]:
        """Return the first section: verdict, what is wrong, and what is not."""
        judgement = self.judgement
        faults = judgement.faults
        other_findings = [x for x in judgement.findings if x not in faults]
        blocks: list[Any] = [judgement.verdict]
        if faults:
            blocks.append(faults)
        if other_findings:
            blocks.append(folded("What else was checked", other_findings))
        return blocks

    def _record(self, rows: list[Record]) -> Record:
        """Return the content of `rollout.json`."""
        errors = self.errors
        kinds = ("simulated", *errors.baselines)
        return {
            "verdict": verdict_rows(self.judgement),
            "joints": errors.joint_names,
            "parameters": rows,
            "errors": {
                "motions": errors.motions,
                "unseen": self.unseen,
                **{kind: errors.rms(kind) for kind in kinds},
            },
            **self.numbers(),
        }


@dataclasses.dataclass(frozen=True, eq=False)
class ServoRolloutReport(RolloutReport):
    """Report of joints behind position servos, without torques.

    Attributes:
        fit: Identified servos.
        windows: Errors of windows of one second that start from measured states [rad or
            m].
        samples: Number of MJCF files to draw.
    """

    fit: ServoFit
    windows: Vector
    samples: int

    def _judge_errors(self) -> Iterator[Remark]:
        """Judge the errors, and name a contact that the geometry shows."""
        yield from super()._judge_errors()
        # Windows that start from measured states cannot show a contact.
        contact = contact_finding(self.robot, self.errors)
        if contact is not None:
            yield Remark(contact, Status.DOUBTFUL)

    @property
    def has_stiffness(self) -> bool:
        """Whether simulators can be given absolute numbers."""
        return bool(np.isfinite(self.fit.stiffness).any())

    def further_errors(self) -> list[Column]:
        """Return the errors in windows."""
        return [Column("simulation,\nwindows of 1 s", 1e3 * self.windows)]

    def result_tables(self) -> list[Table]:
        """Return what the logs determine, and the numbers for simulators."""
        parameters = self.fit.summary()
        # Its notes are findings.
        parameters.remarks = parameters.remarks[:1]
        if not self.has_stiffness:
            text = "No known load determines a stiffness: set `rollout.stiffness`."
            return [parameters, Table("", remarks=[text])]
        return [parameters, simulator_table(self.fit)]

    def write_models(self, folder: Path) -> list[Path]:
        """Write MJCF if bodies are known.

        Files that are drawn from the estimates' distribution lie in a folder.
        """
        if not self.has_stiffness or self.fit.bodies is None:
            return []
        path = folder / "robot.xml"
        files = export_servo_mjcf(self.fit, path, samples=self.samples)
        return [path, *dict.fromkeys(file.parent for file in files[1:])]

    def rows(self) -> list[Record]:
        """Return parameters and combinations, one row for each."""
        rows = []
        for combination in self.fit.combinations:
            low, high = combination.interval()
            row = dict(vars(combination))
            del row["coefficients"]
            joint = self.fit.joint_names[combination.joint]
            rows.append({**row, "joint": joint, "low_95": low, "high_95": high})
        return rows

    def numbers(self) -> Record:
        """Return errors in windows, and the numbers for simulators."""
        return {
            "kind": "commands",
            "windows": self.windows,
            "covariance": self.fit.uncertainty.covariance,
            "simulators": simulator_values(self.fit) if self.has_stiffness else None,
        }


def servo_findings(fit: ServoFit) -> list[Remark]:
    """Return doubts about identified servos, and what motions do not agree on."""
    findings = [Remark(note, Status.DOUBTFUL) for note in fit.notes]
    gains = gain_finding(fit)
    if gains is not None:
        findings.append(gains)
    disagreements = sum(not c.agrees for c in fit.combinations)
    if disagreements:
        text = (
            f"Motions or equal joints differ in {disagreements} of "
            f"{len(fit.combinations)} parameters by more than noise: their intervals "
            "are wider, and they are marked !"
        )
        findings.append(Remark(text))
    return findings


@dataclasses.dataclass(frozen=True, eq=False)
class TorqueRolloutReport(RolloutReport):
    """Report of simulations under recorded torques.

    Attributes:
        fit: Fit of rollouts.
    """

    fit: TorqueRolloutFit

    def result_tables(self) -> list[Table]:
        """Return the estimates."""
        return [self.fit.summary()]

    def rows(self) -> list[Record]:
        """Return the estimates, one row for each."""
        fit = self.fit
        return estimate_rows(fit.names, fit.units, fit.unknowns, fit.uncertainty)

    def numbers(self) -> Record:
        """Return the horizon and the covariance of the estimates."""
        covariance = self.fit.uncertainty.covariance
        return {
            "kind": "torques",
            "horizon": self.fit.horizon,
            "covariance": covariance,
        }


def motion_figure(errors: RolloutErrors, motion: int, units: Sequence[str]) -> Figure:
    """Return measured and simulated positions of all joints in a motion, and errors."""
    time = errors.time[motion]
    joint_errors = 1e3 * (errors.simulated[motion] - errors.measured[motion])
    paths = {
        "measured": (errors.measured, MEASUREMENT_COLOUR, 1.9),
        "simulated": (errors.simulated, PREDICTION_COLOUR, 0.9),
    }
    if "command" in errors.baselines:
        commands = errors.baselines["command"]
        paths = {"commanded": (commands, GREY, 0.6), **paths}
    panels = []
    for j, name in enumerate(errors.joint_names):
        curves = [
            Curve(
                time,
                path[motion][j],
                label,
                colour,
                width=width,
                dashed=label == "commanded",
            )
            for label, (path, colour, width) in paths.items()
        ]
        rms = significant(errors.rms()[motion, j] * 1e3)
        error = Curve(time, joint_errors[j], "error", ERROR, width=0.7)
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
