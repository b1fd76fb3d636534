"""Report of rollouts with torques: measured and simulated windows, beside other methods."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.io import atomic_folder
from jaxid.result_table import Remark, Status, Table, significant
from jaxid.rollout import METHODS, MethodComparison, TorqueRolloutFit

from .figure import Figure
from .page import Section, provenance, render_page
from .result_files import estimate_rows, header, plain, write_csv, write_json
from .rollout import SHOWN, motion_panel


class TorqueRolloutReport(NamedTuple):
    """Content of the report.

    Attributes:
        fit: Fit of rollouts.
        comparison: Errors beside those of other methods.
        paths: Names of logs, with times, measured and simulated positions of their
            windows.
        findings: Findings on the logs.
        notes: Notes on the experiment and the logs.
        settings: Command and text of the experiment file.
    """

    fit: TorqueRolloutFit
    comparison: MethodComparison
    paths: Sequence[tuple[str, np.ndarray, np.ndarray, np.ndarray]]
    findings: list[Remark]
    notes: list[Remark]
    settings: Mapping[str, Any]

    @property
    def verdict(self) -> Remark:
        """Whether simulations are closer to the robot than those of the fit of torques."""
        found = self.comparison
        plain, *_, own = np.nan_to_num(found.errors[:, -1], nan=np.inf)
        closer = bool((own < plain).all())
        text = (
            f"Simulations are {'closer' if closer else 'no closer'} to the robot "
            "than with the "
        )
        sizes = (
            ", ".join(significant(1e3 * x) for x in errors) for errors in (own, plain)
        )
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
        fit, free = self.fit, np.flatnonzero(self.fit.free)
        names, units = (
            [x[k] for k in free] for x in (fit.rollout.names, fit.rollout.units)
        )
        rows = estimate_rows((names, units, fit.unknowns[free], fit.uncertainty))
        files = ["rollout.html", "rollout.json", "rollout.csv"]
        sections: list[Section] = [
            ("Verdict", [self.verdict, self.findings]),
            ("Errors", [self.comparison.summary()]),
            ("Measured and simulated motion", [*map(self._figure, self.paths[:SHOWN])]),
            ("Parameters", [fit.summary(), self.notes]),
            provenance(self.settings),
        ]
        page = render_page("Simulations under recorded torques", sections)
        with atomic_folder(folder) as staging:
            write_json(staging / "rollout.json", {**self._record(rows), "files": files})
            write_csv(staging / "rollout.csv", rows)
            (staging / "rollout.html").write_text(page, encoding="utf-8")
        return [folder / name for name in files]

    def _record(self, rows: list[dict[str, Any]]) -> dict[str, Any]:
        fit, found = self.fit, self.comparison
        methods = zip(
            METHODS, found.parameters, found.errors, found.torque_errors, strict=True
        )
        keys = ("method", "parameters", "errors", "torque_errors")
        errors = {
            "unseen": found.unseen,
            "horizons": found.horizons,
            "base_parameters": fit.rollout.base.names,
            "methods": [dict(zip(keys, method, strict=True)) for method in methods],
        }
        content = {
            "kind": "torques",
            "joints": found.joint_names,
            "horizon": fit.horizon,
            "torque_rows": fit.torque_rows,
            "parameters": rows,
            "covariance": fit.uncertainty.covariance,
            "rms": fit.rms,
            "errors": errors,
            "notes": [r.text for r in (*self.findings, *self.notes)],
        }
        return plain({**header("rollout.json"), **content})

    def _figure(self, path: tuple[str, np.ndarray, np.ndarray, np.ndarray]) -> Figure:
        name, time, measured, simulated = path
        joints = zip(self.comparison.joint_names, measured.T, simulated.T, strict=True)
        panels = [motion_panel(j, time, q, y, np.isfinite(y)) for j, q, y in joints]
        title = f"{name}: measured, and simulated in windows of {self.fit.horizon:g} s"
        return Figure(title, panels, columns=2, height=3.6)
