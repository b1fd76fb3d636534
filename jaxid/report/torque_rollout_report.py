"""Report of rollouts with torques: measured and simulated windows, parameters."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.measurement.observations import Observations
from jaxid.result_table import Column, Remark, Status, Table
from jaxid.rollout import TorqueRolloutFit

from .figure import Figure
from .page import Section, Settings, provenance, render_page
from .result_files import write_page_and_table
from .result_records import Record, estimate_rows
from .servo_rollout_report import MAX_FIGURES, in_milli, motion_panel


@dataclasses.dataclass(frozen=True, eq=False)
class TorqueRolloutReport:
    """Content of the report.

    Attributes:
        fit: Fit of rollouts.
        logs: Logs of the errors.
        unseen: Whether the fit has not seen these logs.
        findings: Findings on the logs.
        notes: Notes on the experiment and the logs.
        settings: Command and text of the experiment file.
    """

    fit: TorqueRolloutFit
    logs: Sequence[Observations]
    unseen: bool
    findings: list[Remark]
    notes: list[Remark]
    settings: Settings

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """Errors after a horizon: of the fit of torques, and of rollouts [rad or m]."""
        fit = self.fit
        return np.array(
            [fit.errors_at(self.logs, fit.horizon, p) for p in (fit.start, None)]
        )

    @property
    def verdict(self) -> Remark:
        """Whether simulations are closer to the robot than those of the torque fit."""
        torque_fit_errors, rollout_errors = np.nan_to_num(self.errors, nan=np.inf)
        is_closer = bool((rollout_errors < torque_fit_errors).all())
        comparison = "closer" if is_closer else "no closer"
        sizes = f"{in_milli(rollout_errors)} instead of {in_milli(torque_fit_errors)}"
        return Remark(
            f"Simulations are {comparison} to the robot than with the fit of torques: "
            f"errors after {self.fit.horizon:g} s of {sizes} mrad or mm",
            Status.GOOD if is_closer else Status.DOUBTFUL,
        )

    def error_table(self) -> Table:
        """Return the errors of each joint after a horizon."""
        place = "logs that the fit has not seen" if self.unseen else "logs of the fit"
        torque_fit_errors, rollout_errors = 1e3 * self.errors
        return Table(
            f"errors after {self.fit.horizon:g} s on {place}",
            Column("joint", self.fit.joint_names),
            Column("fit of torques", torque_fit_errors, "mrad or mm"),
            Column("rollouts", rollout_errors, "mrad or mm"),
        )

    def tables(self) -> list[Table]:
        """Return estimates and errors."""
        remarks = [*self.notes, *self.findings]
        return [self.fit.summary(), self.error_table(), Table("", remarks=remarks)]

    def write(self, folder: Path) -> list[Path]:
        """Write a page, and the numbers as JSON and CSV; return the files."""
        fit = self.fit
        figures = [self._figure(log) for log in self.logs[:MAX_FIGURES]]
        sections: list[Section] = [
            ("Verdict", [self.verdict, self.findings]),
            ("Errors", [self.error_table()]),
            ("Measured and simulated motion", figures),
            ("Parameters", [fit.summary(), self.notes]),
            provenance(self.settings),
        ]
        page = render_page("Simulations under recorded torques", sections)
        unknowns = np.flatnonzero(fit.free)
        names = [fit.rollout.names[k] for k in unknowns]
        units = [fit.rollout.units[k] for k in unknowns]
        rows = estimate_rows(names, units, fit.unknowns[unknowns], fit.uncertainty)
        return write_page_and_table(folder, "rollout", page, self._record(rows), rows)

    def _record(self, rows: list[Record]) -> Record:
        """Return the content of `rollout.json`."""
        fit = self.fit
        torque_fit, rollouts = self.errors
        return {
            "kind": "torques",
            "joints": fit.joint_names,
            "horizon": fit.horizon,
            "parameters": rows,
            "covariance": fit.uncertainty.covariance,
            "rms": fit.rms,
            "errors": {
                "unseen": self.unseen,
                "fit_of_torques": torque_fit,
                "rollouts": rollouts,
            },
            "notes": [remark.text for remark in (*self.findings, *self.notes)],
        }

    def _figure(self, log: Observations) -> Figure:
        """Return measured positions, and those simulated in windows."""
        fit = self.fit
        time, measured_positions, simulated_positions = fit.simulate(log)
        panels = [
            motion_panel(
                name,
                time,
                measured_positions[:, j],
                simulated_positions[:, j],
                np.isfinite(simulated_positions[:, j]),
            )
            for j, name in enumerate(fit.joint_names)
        ]
        title = f"{log.name}: measured, and simulated in windows of {fit.horizon:g} s"
        return Figure(title, panels, columns=2, height=3.6)
