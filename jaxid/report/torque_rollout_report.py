"""Report of rollouts with torques: measured and simulated windows, parameters."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.measurement.observations import Observations
from jaxid.result_table import Column, Remark, Status, Table
from jaxid.rollout import TorqueRolloutFit
from jaxid.validation.judgement import Judgement

from .figure import Figure
from .page import Section, Settings, provenance, render_page
from .result_files import write_page_and_table
from .result_records import Record, estimate_rows, verdict_rows
from .servo_rollout_report import (
    MAX_FIGURES,
    NOT_VALIDATED,
    glance,
    judge_simulation,
    milli_units,
    motion_panel,
)


@dataclasses.dataclass(frozen=True, eq=False)
class TorqueRolloutReport:
    """Content of the report.

    Attributes:
        fit: Fit of rollouts.
        logs: Logs of the errors.
        unseen: Whether the fit has not seen these logs.
        findings: Findings on the experiment and the logs.
        settings: Command and text of the experiment file.
    """

    fit: TorqueRolloutFit
    logs: Sequence[Observations]
    unseen: bool
    findings: list[Remark]
    settings: Settings

    @functools.cached_property
    def errors(self) -> np.ndarray:
        """Errors after a horizon: of the fit of torques, and of rollouts [rad or m]."""
        fit = self.fit
        return np.array(
            [fit.errors_at(self.logs, fit.horizon, p) for p in (fit.start, None)]
        )

    @property
    def judgement(self) -> Judgement:
        """Findings, the most severe first, and the verdict that sums them up."""
        doubts = [] if self.unseen else [NOT_VALIDATED]
        torque_fit_errors, rollout_errors = np.nan_to_num(self.errors, nan=np.inf)
        is_closer = bool((rollout_errors < torque_fit_errors).all())
        comparison = Remark(
            f"Simulations are {'closer' if is_closer else 'no closer'} to the robot "
            "than with the fit of torques",
            Status.GOOD if is_closer else Status.DOUBTFUL,
        )
        return judge_simulation([*doubts, comparison, *self.findings])

    def error_table(self) -> Table:
        """Return the errors of each joint after a horizon."""
        place = "logs that the fit has not seen" if self.unseen else "logs of the fit"
        torque_fit_errors, rollout_errors = 1e3 * self.errors
        return Table(
            f"errors after {self.fit.horizon:g} s on {place}",
            Column("joint", self.fit.joint_names),
            Column("unit", self._units),
            Column("fit of torques", torque_fit_errors),
            Column("rollouts", rollout_errors),
        )

    @property
    def _units(self) -> list[str]:
        return milli_units(self.fit.rollout.base.model.robot)

    def tables(self) -> list[Table]:
        """Return estimates and errors, then all findings and the verdict."""
        judgement = self.judgement
        lines = [*judgement.findings, judgement.verdict]
        return [self.fit.summary(), self.error_table(), Table("", remarks=lines)]

    def write(self, folder: Path) -> list[Path]:
        """Write a page, and the numbers as JSON and CSV; return the files."""
        fit = self.fit
        figures = [self._figure(log) for log in self.logs[:MAX_FIGURES]]
        sections: list[Section] = [
            ("At a glance", glance(self.judgement)),
            ("Errors", [self.error_table()]),
            ("Measured and simulated motion", figures),
            ("Parameters", [fit.summary()]),
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
            "verdict": verdict_rows(self.judgement),
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
        }

    def _figure(self, log: Observations) -> Figure:
        """Return measured positions, and those simulated in windows."""
        fit = self.fit
        time, measured_positions, simulated_positions = fit.simulate(log)
        panels = [
            motion_panel(
                name,
                self._units[j],
                time,
                measured_positions[:, j],
                simulated_positions[:, j],
            )
            for j, name in enumerate(fit.joint_names)
        ]
        title = f"{log.name}: measured, and simulated in windows of {fit.horizon:g} s"
        return Figure(title, panels, columns=2, height=3.6)
