"""Report of an identification without torques: motions, their simulation, numbers."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import Float
from jaxid.export.servo_actuators import (
    export_servo_mjcf,
    simulator_table,
    simulator_values,
)
from jaxid.result_table import Column, Remark, Status, Table, significant
from jaxid.robot.robot import Robot
from jaxid.rollout import RolloutErrors, ServoFit
from jaxid.rollout.contact_evidence import contact_finding
from jaxid.validation.judgement import SEVERITIES, Judgement

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
from .result_records import Record, verdict_rows

MAX_FIGURES = 6
"""Motions whose figures the page shows."""
MAX_RATIO = 0.9
"""Error of a good simulation, relative to those of the baselines."""
RATIOS = (
    "Positions tell torques only in units of the servo's stiffness. Parameters that "
    "the logs tell only together are merged"
)
"""How the table of parameters is read."""
NOT_VALIDATED = Remark(
    "The simulation was not validated on an unseen log: use `--verify`",
    Status.DOUBTFUL,
)
"""Doubt about a simulation that was compared with the logs of its fit only."""


@dataclasses.dataclass(frozen=True, eq=False)
class RolloutReport:
    """Content of the report.

    Attributes:
        robot: The robot.
        fit: Identified servos.
        errors: Errors of free-running simulations.
        windows: Errors of windows of one second that start from measured states [rad or
            m].
        unseen: Whether these logs were not used for the fit.
        samples: Number of MJCF files to draw.
        settings: Facts, command and text of the experiment file.
    """

    robot: Robot
    fit: ServoFit
    errors: RolloutErrors
    windows: Float[np.ndarray, " joints"]
    unseen: bool
    samples: int
    settings: Settings

    @property
    def judgement(self) -> Judgement:
        """Findings, the most severe first, and the verdict that sums them up."""
        doubts = [Remark(note, Status.DOUBTFUL) for note in self.fit.notes]
        return judge_simulation([*self._judge_errors(), *doubts])

    def _judge_errors(self) -> Iterator[Remark]:
        """Compare the simulation with its baselines, and motions and joints."""
        if not self.unseen:
            yield NOT_VALIDATED
        names = np.array(self.fit.joint_names)
        errors = 1e3 * self.errors.total()
        worst_joint = int(np.argmax(errors))
        unit = milli_units(self.robot)[worst_joint]
        text = (
            "The simulation moves more like the robot than a linear joint does; it errs"
        )
        error = f"{significant(errors[worst_joint])} {unit} RMS"
        status = Status.GOOD
        if not self._is_good.all():
            joints = ", ".join(names[~self._is_good])
            text = (
                f"The simulation is hardly better than a baseline ({joints}); it errs"
            )
            status = Status.DOUBTFUL
        yield Remark(f"{text} most at {names[worst_joint]}, by {error}", status)
        contact = contact_finding(self.robot, self.errors)
        if contact is not None:
            yield Remark(contact, Status.DOUBTFUL)
        combinations = self.fit.combinations
        disagreements = sum(not c.agrees for c in combinations)
        if disagreements:
            yield Remark(
                f"Motions or equal joints differ in {disagreements} of "
                f"{len(combinations)} parameters by more than noise: their intervals "
                "are wider, and they are marked !"
            )

    @property
    def _is_good(self) -> np.ndarray:
        """For which joints the simulation is better than both baselines."""
        errors = self.errors
        baseline = np.minimum(errors.total("linear"), errors.total("command"))
        return errors.total() < MAX_RATIO * baseline

    @property
    def has_stiffness(self) -> bool:
        """Whether simulators can be given absolute numbers."""
        return bool(np.isfinite(self.fit.stiffness).any())

    def error_tables(self) -> list[Table]:
        """Return the errors beside those of the baselines, and those by motion."""
        errors = self.errors
        units = milli_units(self.robot)
        logs = "logs that the fit has not seen" if self.unseen else "logs of the fit"
        comparison = Table(
            f"errors on {logs}, every sample (RMS)",
            Column("joint", errors.joint_names),
            Column("unit", units),
            Column("simulation,\nfree-running", 1e3 * errors.total()),
            Column("simulation,\nwindows of 1 s", 1e3 * self.windows),
            Column("linear joint\nwith delay", 1e3 * errors.total("linear")),
            Column("copied\ncommand", 1e3 * errors.total("command")),
            status=[Status.GOOD if x else Status.DOUBTFUL for x in self._is_good],
        )
        rms = 1e3 * errors.rms()
        columns = map(Column, errors.joint_names, rms.T, units)
        motions = Column("motion", errors.motions)
        return [comparison, Table("errors of each motion", motions, *columns)]

    def result_tables(self) -> list[Table]:
        """Return what the logs determine, and the numbers for simulators."""
        parameters = self.fit.summary()
        # Its notes are findings.
        parameters.remarks = (Remark(RATIOS),)
        if not self.has_stiffness:
            text = "No weight tells a stiffness: name it by `rollout.stiffness`."
            return [parameters, Table("", remarks=[text])]
        return [parameters, simulator_table(self.fit)]

    def tables(self) -> list[Table]:
        """Return estimates and errors, then all findings and the verdict."""
        judgement = self.judgement
        lines = [*judgement.findings, judgement.verdict]
        tables = [*self.result_tables(), *self.error_tables()]
        return [*tables, Table("", remarks=lines)]

    def write(self, folder: Path) -> list[Path]:
        """Write a page, the numbers as JSON and CSV, and MJCF if bodies are known.

        Files that are drawn from the estimates' distribution lie in a folder.
        """
        models = []
        if self.has_stiffness and self.fit.bodies is not None:
            path = folder / "robot.xml"
            files = export_servo_mjcf(self.fit, path, samples=self.samples)
            models = [path, *dict.fromkeys(file.parent for file in files[1:])]
        rows = estimate_rows(self.fit)
        record = self._record(rows)
        files = write_page_and_table(folder, "rollout", self._page(), record, rows)
        return files + models

    def _page(self) -> str:
        """Return the page as HTML."""
        errors = self.errors
        parameters, simulators = self.result_tables()
        units = milli_units(self.robot)
        motions = range(min(MAX_FIGURES, len(errors.motions)))
        figures = [motion_figure(errors, motion, units) for motion in motions]
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
            ("At a glance", glance(self.judgement)),
            ("Errors", self.error_tables()),
            ("Measured and simulated motion", [scene, *figures]),
            ("What the logs determine", [parameters]),
            ("For simulators", [simulators]),
            provenance(self.settings),
        ]
        return render_page(f"{self.robot.name}: servos of its joints", sections)

    def _record(self, rows: list[Record]) -> Record:
        """Return the content of `rollout.json`."""
        fit = self.fit
        errors = self.errors
        return {
            "kind": "commands",
            "verdict": verdict_rows(self.judgement),
            "joints": fit.joint_names,
            "combinations": rows,
            "covariance": fit.covariance,
            "errors": {
                "motions": errors.motions,
                "unseen": self.unseen,
                "simulated": errors.rms("simulated"),
                "linear": errors.rms("linear"),
                "command": errors.rms("command"),
                "windows": self.windows,
            },
            "simulators": simulator_values(fit) if self.has_stiffness else None,
        }


def judge_simulation(findings: Sequence[Remark]) -> Judgement:
    """Return findings, the most severe first, and the verdict that sums them up."""
    # Sorting keeps the order of findings with one severity.
    ordered = sorted(findings, key=lambda x: SEVERITIES.index(x.status))
    verdict = Remark("A good simulation: nothing speaks against it", Status.GOOD)
    if ordered[0].status is Status.DOUBTFUL:
        text = "A usable simulation; look at what is marked ! before you rely on it"
        verdict = Remark(text, Status.DOUBTFUL)
    return Judgement(tuple(ordered), verdict)


def glance(judgement: Judgement) -> list[Any]:
    """Return the first section of a page: verdict, what is wrong, and what is not."""
    faults = judgement.faults
    other_findings = [x for x in judgement.findings if x not in faults]
    blocks: list[Any] = [judgement.verdict]
    if faults:
        blocks.append(faults)
    if other_findings:
        blocks.append(folded("What else was checked", other_findings))
    return blocks


def milli_units(robot: Robot) -> list[str]:
    """Return the unit of each joint's errors."""
    return [f"m{robot.joint_unit(j)}" for j in range(robot.joints)]


def estimate_rows(fit: ServoFit) -> list[Record]:
    """Return the parameters that the logs determine, one row for each."""
    rows = []
    for combination in fit.combinations:
        low, high = combination.interval()
        row = dict(vars(combination))
        del row["coefficients"]
        joint = fit.joint_names[combination.joint]
        rows.append({**row, "joint": joint, "low_95": low, "high_95": high})
    return rows


def motion_figure(errors: RolloutErrors, motion: int, units: Sequence[str]) -> Figure:
    """Return measured and simulated positions of all joints in a motion, and errors."""
    time = errors.time[motion]
    panels = []
    for j, name in enumerate(errors.joint_names):
        measured_positions = errors.measured[motion][j]
        simulated_positions = errors.simulated[motion][j]
        panel = motion_panel(
            name, units[j], time, measured_positions, simulated_positions
        )
        positions = errors.command[motion][j]
        command = Curve(time, positions, "commanded", GREY, width=0.6)
        panels.append(dataclasses.replace(panel, curves=[command, *panel.curves]))
    title = f"{errors.motions[motion]}: measured and simulated, free-running"
    return Figure(title, panels, columns=2, height=3.6)


def motion_panel(
    name: str,
    unit: str,
    time: np.ndarray,
    measured_positions: np.ndarray,
    simulated_positions: np.ndarray,
) -> Panel:
    """Return measured and simulated positions of a joint, and their errors.

    Args:
        name: Name of the joint.
        unit: Unit of the errors: mrad or mm.
        time: Instants of the samples [s].
        measured_positions: Measured positions.
        simulated_positions: Simulated positions, NaN between two simulations.
    """
    errors = 1e3 * (simulated_positions - measured_positions)
    rms = float(np.sqrt(np.nanmean(errors**2)))
    error = Curve(time, errors, "error", ERROR, width=0.7)
    return Panel(
        [
            Curve(time, measured_positions, "measured", MEASUREMENT_COLOUR, width=1.9),
            Curve(time, simulated_positions, "simulated", PREDICTION_COLOUR, width=0.9),
        ],
        title=name,
        value=f"RMS {significant(rms)} {unit}",
        y="position",
        unit=unit.removeprefix("m"),
        below=[Panel([error], y="error", unit=unit, share=0.6)],
    )
