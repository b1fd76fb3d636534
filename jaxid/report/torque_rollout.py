"""Report of rollouts with torques: measured and simulated windows, parameters."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.io import atomic_folder
from jaxid.measurement.observations import Observations
from jaxid.result_table import Column, Remark, Status, Table
from jaxid.rollout import TorqueRolloutFit

from .figure import Figure
from .page import Section, provenance, render_page
from .result_files import estimate_rows, write_csv, write_json
from .result_records import header
from .rollout import MAX_FIGURES, in_milli, motion_panel


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
    settings: Mapping[str, Any]

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
        torque_fit, rollouts = np.nan_to_num(self.errors, nan=np.inf)
        is_closer = bool((rollouts < torque_fit).all())
        return Remark(
            f"Simulations are {'closer' if is_closer else 'no closer'} to the robot "
            f"than with the fit of torques: errors after {self.fit.horizon:g} s of "
            f"{in_milli(rollouts)} instead of {in_milli(torque_fit)} mrad or mm",
            Status.GOOD if is_closer else Status.DOUBTFUL,
        )

    def error_table(self) -> Table:
        """Return the errors of each joint after a horizon."""
        place = "logs that the fit has not seen" if self.unseen else "logs of the fit"
        torque_fit, rollouts = 1e3 * self.errors
        return Table(
            f"errors after {self.fit.horizon:g} s on {place}",
            Column("joint", self.fit.joint_names),
            Column("fit of torques", torque_fit, "mrad or mm"),
            Column("rollouts", rollouts, "mrad or mm"),
        )

    def tables(self) -> list[Table]:
        """Return estimates and errors."""
        remarks = [*self.notes, *self.findings]
        return [self.fit.summary(), self.error_table(), Table("", remarks=remarks)]

    def write(self, folder: Path) -> list[Path]:
        """Write the page, `rollout.json` and `rollout.csv`."""
        fit = self.fit
        sections: list[Section] = [
            ("Verdict", [self.verdict, self.findings]),
            ("Errors", [self.error_table()]),
            (
                "Measured and simulated motion",
                [self._figure(log) for log in self.logs[:MAX_FIGURES]],
            ),
            ("Parameters", [fit.summary(), self.notes]),
            provenance(self.settings),
        ]
        page = render_page("Simulations under recorded torques", sections)
        unknowns = np.flatnonzero(fit.free)
        names = [fit.rollout.names[k] for k in unknowns]
        units = [fit.rollout.units[k] for k in unknowns]
        rows = estimate_rows((names, units, fit.unknowns[unknowns], fit.uncertainty))
        files = ["rollout.html", "rollout.json", "rollout.csv"]
        with atomic_folder(folder) as staging:
            write_json(staging / "rollout.json", {**self._record(rows), "files": files})
            write_csv(staging / "rollout.csv", rows)
            (staging / "rollout.html").write_text(page, encoding="utf-8")
        return [folder / file for file in files]

    def _record(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        """Return the content of `rollout.json`."""
        fit = self.fit
        torque_fit, rollouts = self.errors
        return {
            **header("rollout.json"),
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
        time, measured, simulated = fit.simulate(log)
        panels = [
            motion_panel(
                name,
                time,
                measured[:, j],
                simulated[:, j],
                np.isfinite(simulated[:, j]),
            )
            for j, name in enumerate(fit.joint_names)
        ]
        title = f"{log.name}: measured, and simulated in windows of {fit.horizon:g} s"
        return Figure(title, panels, columns=2, height=3.6)
