"""Report of an identification without torques: measured and simulated motion, and its numbers."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.export.servo_actuators import (
    export_servo_mjcf,
    simulator_table,
    simulator_values,
)
from jaxid.io import atomic_folder
from jaxid.result_table import Column, Remark, Status, Table, significant
from jaxid.rollout import PARAMETERS, RolloutErrors, ServoFit

from .figure import Figure
from .figure_elements import ERROR, GREY, MEASURED, PREDICTED, Curve, Panel
from .page import Section, provenance, render_page
from .result_files import write_csv, write_json
from .result_records import header, plain

SHOWN = 6
"""Motions whose figures the page shows."""


class RolloutReport(NamedTuple):
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
    settings: Mapping[str, Any]

    @property
    def verdict(self) -> Remark:
        """Whether the simulation is closer to the robot than a linear joint."""
        return rollout_verdict(self.errors)

    @property
    def has_stiffness(self) -> bool:
        """Whether simulators can be given absolute numbers."""
        return bool(np.isfinite(self.fit.stiffness).any())

    def write(self, folder: Path) -> list[Path]:
        """Write the page, `rollout.json`, `rollout.csv`, and MJCF if bodies are known."""
        return write_rollout(folder, self)

    def tables(self) -> list[Table]:
        """Return estimates, errors beside the baselines and by motion, numbers for simulators."""
        found = [self.fit.summary(), comparison_table(self), self.errors.summary()]
        return [*found, simulator_table(self.fit)] if self.has_stiffness else found


def comparison_table(report: RolloutReport) -> Table:
    """Return the errors of the simulation beside those of the baselines."""
    errors, kinds = report.errors, ("simulated", "linear", "command")
    free = [1e3 * errors.total(kind) for kind in kinds]
    worse = free[0] > 0.9 * np.minimum(free[1], free[2])
    where = "logs that the fit has not seen" if report.unseen else "the logs of the fit"
    return Table(
        f"errors of {where} [mrad or mm]",
        Column("joint", errors.joint_names),
        Column("simulation,\nfree-running", free[0]),
        Column("simulation,\nwindows of 1 s", 1e3 * report.windows),
        Column("linear joint\nwith delay", free[1]),
        Column("copied\ncommand", free[2]),
        status=[Status.DOUBTFUL if x else Status.GOOD for x in worse],
    )


def motion_figure(errors: RolloutErrors, motion: int) -> Figure:
    """Return measured and simulated positions of all joints in one motion, and the errors."""
    time, panels = np.asarray(errors.time[motion]), []
    kinds = (errors.command, errors.measured, errors.simulated, errors.counted)
    channels = [np.asarray(x[motion]) for x in kinds]
    for name, command, measured, simulated, counted in zip(
        errors.joint_names, *channels, strict=True
    ):
        commanded = Curve(time, command, "commanded", GREY, width=0.6)
        panel = motion_panel(name, time, measured, simulated, counted > 0)
        panels.append(dataclasses.replace(panel, curves=[commanded, *panel.curves]))
    title = f"{errors.motions[motion]}: measured and simulated, free-running"
    return Figure(title, panels, columns=2, height=3.6)


def motion_panel(
    name: str,
    time: np.ndarray,
    measured: np.ndarray,
    simulated: np.ndarray,
    counted: np.ndarray,
) -> Panel:
    """Return measured and simulated positions of a joint, and the errors of what counts below."""
    wrong = 1e3 * (simulated - measured)
    rms = np.sqrt(np.mean(wrong[counted] ** 2)) if counted.any() else np.nan
    error = Curve(time, wrong, "error", ERROR, width=0.7)
    curves = [
        Curve(time, measured, "measured", MEASURED, width=1.9),
        Curve(time, simulated, "simulated", PREDICTED, width=0.9),
    ]
    below = [Panel([error], y="error", unit="mrad or mm", share=0.6)]
    said = f"RMS {significant(float(rms))} mrad or mm"
    return Panel(curves, name, said, y="position", unit="rad or m", below=below)


def rollout_verdict(errors: RolloutErrors) -> Remark:
    """Return in words whether the simulation is closer to the robot than a linear joint."""
    total, linear = errors.total(), errors.total("linear")
    worse = [
        n for n, x, y in zip(errors.joint_names, total, linear, strict=True) if x >= y
    ]
    text = "The simulation moves more like the robot than a linear joint does"
    if worse:
        text = f"The simulation is no better than a linear joint ({', '.join(worse)})"
    sizes = (
        ", ".join(significant(1e3 * x) for x in values) for values in (total, linear)
    )
    return Remark(
        f"{text}: errors of {' instead of '.join(sizes)} mrad or mm",
        Status.DOUBTFUL if worse else Status.GOOD,
    )


def rollout_page(report: RolloutReport, figures: Sequence[Figure]) -> str:
    """Return the page of an identification without torques as HTML."""
    fit, errors = report.fit, report.errors
    parameters = fit.summary()
    simulators: list[Any] = [
        "No weight tells a stiffness: name it by `rollout.stiffness`."
    ]
    if report.has_stiffness:
        simulators = [simulator_table(fit)]
    sections: list[Section] = [
        ("Verdict", [report.verdict, parameters.remarks]),
        ("Errors", [comparison_table(report), errors.summary()]),
        ("Measured and simulated motion", figures),
        (
            "What the logs determine",
            [
                "Positions tell torques only in units of the servo's stiffness. "
                "Parameters that "
                "the logs tell only together are merged.",
                Table(
                    "",
                    *parameters.columns,
                    facts=parameters.facts,
                    status=parameters.status,
                ),
            ],
        ),
        ("For simulators", simulators),
        provenance(report.settings),
    ]
    return render_page("Joints behind position servos", sections)


def write_rollout(folder: Path, report: RolloutReport) -> list[Path]:
    """Write the page, `rollout.json`, `rollout.csv`, and MJCF if bodies are known."""
    fit, count = report.fit, min(SHOWN, len(report.errors.motions))
    figures = [motion_figure(report.errors, k) for k in range(count)]
    rows = [
        {
            "joint": fit.joint_names[c.joint],
            "parameter": c.name,
            "meaning": c.meaning,
            "unit": c.unit,
            "estimate": c.value,
            "standard_deviation": c.deviation,
            "low_95": c.interval()[0],
            "high_95": c.interval()[1],
        }
        for c in fit.combinations
    ]
    names = ["rollout.html", "rollout.json", "rollout.csv"]
    with atomic_folder(folder) as staging:
        if report.has_stiffness and fit.bodies is not None:
            made = export_servo_mjcf(fit, staging / "robot.xml", samples=report.samples)
            names += [p.name for p in made]
        write_json(staging / "rollout.json", {**_record(report, rows), "files": names})
        write_csv(staging / "rollout.csv", rows)
        page = rollout_page(report, figures)
        (staging / "rollout.html").write_text(page, encoding="utf-8")
    return [folder / name for name in names]


def _record(report: RolloutReport, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the content of `rollout.json`."""
    fit, errors = report.fit, report.errors
    simulators = None
    if report.has_stiffness:
        values = simulator_values(fit)
        limits = values.pop("effort_limit")
        simulators = {
            **values,
            "effort_limit": np.where(np.isfinite(limits), limits, -1.0),
        }
    return plain(
        {
            **header("rollout.json"),
            "kind": "commands",
            "joints": fit.joint_names,
            "combinations": rows,
            "symbols": [x.symbol for x in PARAMETERS],
            "parameters": fit.parameters,
            "free": fit.free,
            "covariance": fit.covariance,
            "hold": fit.hold,
            "errors": {
                "motions": errors.motions,
                "unseen": report.unseen,
                **{
                    kind: errors.rms(kind)
                    for kind in ("simulated", "linear", "command")
                },
                "windows": report.windows,
            },
            "contacts": [c._asdict() for c in (*fit.contacts, *errors.contacts)],
            "simulators": simulators,
            "notes": fit.notes,
        }
    )
