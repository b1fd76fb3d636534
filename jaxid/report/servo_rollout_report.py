"""Report of an identification without torques: motions, their simulation, numbers."""

import dataclasses
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
from jaxid.rollout import RolloutErrors, ServoFit

from .figure import Figure
from .figure_elements import (
    ERROR,
    GREY,
    MEASUREMENT_COLOUR,
    PREDICTION_COLOUR,
    Curve,
    Panel,
)
from .page import Section, Settings, provenance, render_page
from .result_files import write_page_and_table
from .result_records import Record

MAX_FIGURES = 6
"""Motions whose figures the page shows."""
MAX_RATIO = 0.9
"""Error of a good simulation, relative to those of the baselines."""


@dataclasses.dataclass(frozen=True, eq=False)
class RolloutReport:
    """Content of the report.

    Attributes:
        fit: Identified servos.
        errors: Errors of free-running simulations.
        windows: Errors of windows of one second that start from measured states [rad or
            m].
        unseen: Whether these logs were not used for the fit.
        samples: Number of MJCF files to draw.
        settings: Facts, command and text of the experiment file.
    """

    fit: ServoFit
    errors: RolloutErrors
    windows: Float[np.ndarray, " joints"]
    unseen: bool
    samples: int
    settings: Settings

    @property
    def verdict(self) -> Remark:
        """Whether the simulation is closer to the robot than a linear joint."""
        simulation_errors = self.errors.total()
        linear_errors = self.errors.total("linear")
        is_worse = simulation_errors >= linear_errors
        text = "The simulation moves more like the robot than a linear joint does"
        status = Status.GOOD
        if is_worse.any():
            joints = ", ".join(np.array(self.errors.joint_names)[is_worse])
            text = f"The simulation is no better than a linear joint ({joints})"
            status = Status.DOUBTFUL
        sizes = f"{in_milli(simulation_errors)} instead of {in_milli(linear_errors)}"
        return Remark(f"{text}: errors of {sizes} mrad or mm", status)

    @property
    def has_stiffness(self) -> bool:
        """Whether simulators can be given absolute numbers."""
        return bool(np.isfinite(self.fit.stiffness).any())

    def error_table(self) -> Table:
        """Return the errors of the simulation beside those of the baselines."""
        errors = self.errors
        simulation = 1e3 * errors.total("simulated")
        linear_errors = 1e3 * errors.total("linear")
        command = 1e3 * errors.total("command")
        is_doubtful = simulation > MAX_RATIO * np.minimum(linear_errors, command)
        logs = (
            "logs that the fit has not seen" if self.unseen else "the logs of the fit"
        )
        return Table(
            f"errors of {logs} [mrad or mm]",
            Column("joint", errors.joint_names),
            Column("simulation,\nfree-running", simulation),
            Column("simulation,\nwindows of 1 s", 1e3 * self.windows),
            Column("linear joint\nwith delay", linear_errors),
            Column("copied\ncommand", command),
            status=[Status.DOUBTFUL if doubt else Status.GOOD for doubt in is_doubtful],
        )

    def tables(self) -> list[Table]:
        """Return the estimates, their errors, and the numbers for simulators.

        The errors stand beside those of the baselines, and by motion.
        """
        tables = [self.fit.summary(), self.error_table(), self.errors.summary()]
        return [*tables, simulator_table(self.fit)] if self.has_stiffness else tables

    def write(self, folder: Path) -> list[Path]:
        """Write a page, the numbers as JSON and CSV, and MJCF if bodies are known."""
        models = []
        if self.has_stiffness and self.fit.bodies is not None:
            path = folder / "robot.xml"
            models = export_servo_mjcf(self.fit, path, samples=self.samples)
        rows = estimate_rows(self.fit)
        record = self._record(rows)
        files = write_page_and_table(folder, "rollout", self._page(), record, rows)
        return files + models

    def _page(self) -> str:
        """Return the page as HTML."""
        errors = self.errors
        parameters = self.fit.summary()
        simulators: Any = "No weight tells a stiffness: name it by `rollout.stiffness`."
        if self.has_stiffness:
            simulators = simulator_table(self.fit)
        text = (
            "Positions tell torques only in units of the servo's stiffness. Parameters "
            "that the logs tell only together are merged."
        )
        motions = range(min(MAX_FIGURES, len(errors.motions)))
        figures = [motion_figure(errors, motion) for motion in motions]
        sections: list[Section] = [
            ("Verdict", [self.verdict]),
            ("Errors", [self.error_table(), errors.summary()]),
            ("Measured and simulated motion", figures),
            ("What the logs determine", [text, parameters]),
            ("For simulators", [simulators]),
            provenance(self.settings),
        ]
        return render_page("Joints behind position servos", sections)

    def _record(self, rows: list[Record]) -> Record:
        """Return the content of `rollout.json`."""
        fit = self.fit
        errors = self.errors
        return {
            "kind": "commands",
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
            "notes": fit.notes,
        }


def estimate_rows(fit: ServoFit) -> list[Record]:
    """Return the parameters that the logs determine, one row for each."""
    rows = []
    for combination in fit.combinations:
        low, high = combination.interval()
        row = combination._asdict()
        del row["coefficients"]
        joint = fit.joint_names[combination.joint]
        rows.append({**row, "joint": joint, "low_95": low, "high_95": high})
    return rows


def in_milli(errors: np.ndarray) -> str:
    """Return errors in thousandths of their unit."""
    return ", ".join(significant(1e3 * float(error)) for error in errors)


def motion_figure(errors: RolloutErrors, motion: int) -> Figure:
    """Return measured and simulated positions of all joints in a motion, and errors."""
    time = np.asarray(errors.time[motion])
    panels = []
    for j, name in enumerate(errors.joint_names):
        panel = motion_panel(
            name,
            time,
            measured_positions=np.asarray(errors.measured[motion])[j],
            simulated_positions=np.asarray(errors.simulated[motion])[j],
            is_counted=np.asarray(errors.counted[motion])[j] > 0,
        )
        positions = np.asarray(errors.command[motion])[j]
        command = Curve(time, positions, "commanded", GREY, width=0.6)
        panels.append(dataclasses.replace(panel, curves=[command, *panel.curves]))
    title = f"{errors.motions[motion]}: measured and simulated, free-running"
    return Figure(title, panels, columns=2, height=3.6)


def motion_panel(
    name: str,
    time: np.ndarray,
    measured_positions: np.ndarray,
    simulated_positions: np.ndarray,
    is_counted: np.ndarray,
) -> Panel:
    """Return measured and simulated positions of a joint, and the errors that count."""
    errors = 1e3 * (simulated_positions - measured_positions)
    rms = np.nan
    if is_counted.any():
        rms = float(np.sqrt(np.mean(errors[is_counted] ** 2)))
    error = Curve(time, errors, "error", ERROR, width=0.7)
    return Panel(
        [
            Curve(time, measured_positions, "measured", MEASUREMENT_COLOUR, width=1.9),
            Curve(time, simulated_positions, "simulated", PREDICTION_COLOUR, width=0.9),
        ],
        title=name,
        value=f"RMS {significant(rms)} mrad or mm",
        y="position",
        unit="rad or m",
        below=[Panel([error], y="error", unit="mrad or mm", share=0.6)],
    )
