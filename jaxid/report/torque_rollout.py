"""Report of rollouts with torques: measured and simulated windows, beside other methods."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.io import atomic_folder
from jaxid.result_table import Remark, Status, Table, significant
from jaxid.rollout import METHODS, MethodComparison, TorqueRolloutFit, WindowPaths

from .figure import Figure
from .page import Section, provenance, render_page
from .result_files import header, plain, write_csv, write_json
from .rollout import SHOWN, motion_panel

WINDOWS = 10.0
"""Largest time of a log whose windows a figure shows [s]."""


class TorqueRolloutReport(NamedTuple):
    """Content of the report.

    Attributes:
        fit: Fit of rollouts.
        comparison: Errors beside those of other methods.
        paths: Measured and simulated positions of logs.
        findings: Findings on the logs.
        notes: Notes on the experiment and the logs.
        settings: Command and text of the experiment file.
    """

    fit: TorqueRolloutFit
    comparison: MethodComparison
    paths: Sequence[WindowPaths]
    findings: list[Remark]
    notes: list[Remark]
    settings: Mapping[str, Any]

    @property
    def verdict(self) -> Remark:
        """Whether simulations are closer to the robot than those of the fit of torques."""
        found = self.comparison
        plain, *_, own = found.errors[:, -1]
        closer = bool((own < plain).all())
        text = f"Simulations are {'closer' if closer else 'no closer'} to the robot than with the "
        sizes = (", ".join(significant(1e3 * x) for x in errors) for errors in (own, plain))
        text += f"fit of torques: errors after {found.horizons[-1]:g} s of "
        text += f"{' instead of '.join(sizes)} mrad or mm"
        other = f"Closest on these logs: {found.best}."
        detail = "" if found.best == METHODS[-1] else other
        return Remark(text, Status.GOOD if closer else Status.DOUBTFUL, detail)

    def tables(self) -> list[Table]:
        """Return estimates, and errors of all methods."""
        return [
            self.fit.summary(),
            self.comparison.summary(),
            Table("", remarks=[*self.notes, *self.findings]),
        ]

    def write(self, folder: Path) -> list[Path]:
        """Write the page, `rollout.json` and `rollout.csv`."""
        rows, names = self._rows(), ["rollout.html", "rollout.json", "rollout.csv"]
        page = self._page([window_figure(self.fit, path) for path in self.paths[:SHOWN]])
        with atomic_folder(folder) as staging:
            write_json(staging / "rollout.json", {**self._record(rows), "files": names})
            write_csv(staging / "rollout.csv", rows)
            (staging / "rollout.html").write_text(page, encoding="utf-8")
        return [folder / name for name in names]

    def _page(self, figures: Sequence[Figure]) -> str:
        sections: list[Section] = [
            ("Verdict", [self.verdict, self.findings]),
            ("Errors", [self.comparison.summary()]),
            ("Measured and simulated motion", figures),
            ("Parameters", [self.fit.summary(), self.notes]),
            provenance(self.settings),
        ]
        return render_page("Simulations under recorded torques", sections)

    def _rows(self) -> list[dict[str, Any]]:
        fit, free = self.fit, np.flatnonzero(self.fit.free)
        deviations, half = fit.uncertainty.standard_deviations, fit.uncertainty.half_widths()
        return [
            {
                "parameter": fit.rollout.names[k],
                "unit": fit.rollout.units[k],
                "estimate": fit.unknowns[k],
                "standard_deviation": deviations[i],
                "low_95": fit.unknowns[k] - half[i],
                "high_95": fit.unknowns[k] + half[i],
            }
            for i, k in enumerate(free)
        ]

    def _record(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        fit, found = self.fit, self.comparison
        methods = zip(METHODS, found.parameters, found.errors, found.torque_errors, strict=True)
        keys = ("method", "parameters", "errors", "torque_errors")
        return plain(
            {
                **header("rollout.json"),
                "kind": "torques",
                "joints": found.joint_names,
                "horizon": fit.horizon,
                "torque_rows": fit.torque_rows,
                "unknowns": rows,
                "covariance": fit.uncertainty.covariance,
                "rms": fit.rms,
                "errors": {
                    "unseen": found.unseen,
                    "horizons": found.horizons,
                    "base_parameters": fit.rollout.base.names,
                    "methods": [dict(zip(keys, method, strict=True)) for method in methods],
                },
                "notes": [r.text for r in (*self.findings, *self.notes)],
            }
        )


def window_figure(fit: TorqueRolloutFit, path: WindowPaths) -> Figure:
    """Return measured and simulated positions of all joints in windows of a log, and the errors."""
    shown = path.time - path.time[0] <= WINDOWS
    channels = (path.measured[shown].T, path.simulated[shown].T)
    panels = [
        motion_panel(name, path.time[shown], measured, simulated, np.isfinite(simulated))
        for name, measured, simulated in zip(
            fit.rollout.base.model.robot.joint_names, *channels, strict=True
        )
    ]
    title = f"{path.name}: measured, and simulated in windows of {fit.horizon:g} s"
    return Figure(title, panels, columns=2, height=3.6)
