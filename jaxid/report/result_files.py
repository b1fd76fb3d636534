"""Results on disk: pages and figures for people, numbers for programs, written atomically."""

import csv
import datetime
import math
import re
import unicodedata
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.errors import InputError
from jaxid.identification.estimators.regularisation_and_weights import (
    LARGEST_UNCERTAINTY,
)
from jaxid.identification.fit_result import Fit, load_fit
from jaxid.identification.parameter_changes import (
    LEVEL,
    Comparison,
    Verdict,
    parameter_kinds,
)
from jaxid.identification.uncertainty import Uncertainty
from jaxid.io import atomic_folder, json_text, read_json
from jaxid.result_table import Remark, Status, Table, versions
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors
from jaxid.validation.verdict import Report, verdict

from .estimates import comparison_figure, parameter_figure
from .figure import Figure
from .identification import identification_page
from .page import render_page
from .physics import error_scene, friction_figure, gravity_figure
from .residuals import autocorrelation_figure, filter_figure, residual_figure
from .torques import bar_figure, error_figure, torque_figure

MODEL = "model.json"
"""File of a report that holds the fit, for `load` and `jaxid export`."""
SCHEMAS = {
    f"{kind}.json": f"jaxid-{kind}/1"
    for kind in (
        "result",
        "comparison",
        "payload",
        "gains",
        "states",
        "demo",
        "rollout",
    )
}
"""Files that hold results, and the schemas in them."""
Estimates = tuple[Sequence[str], Sequence[str], AnyArray, Uncertainty]
"""Names, units, values and uncertainty of some estimates."""


def write_report(folder: Path, report: Report, suffix: str = "") -> list[Path]:
    """Write `report.html`, `result.json`, `parameters.csv` and `model.json`; return them.

    With a `suffix` (`svg`, `png` or `pdf`) each figure is also written to a file of
    that format. A folder that exists keeps its other files; files of an earlier report
    in it are replaced.
    """
    record, figures = _record(report), _draw(report)
    page = identification_page(report, figures)
    names = ["report.html", "result.json", "parameters.csv", MODEL]
    with atomic_folder(folder, _earlier_files) as staging:
        for stem, figure in figures.items() if suffix else ():
            names.append(f"{stem}.{suffix}")
            figure.save(staging / names[-1])
        write_json(staging / "result.json", {**record, "files": names})
        write_csv(staging / "parameters.csv", parameter_rows(report.fit))
        report.fit.save(staging / MODEL)
        (staging / "report.html").write_text(page, encoding="utf-8")
    return [folder / name for name in names]


def _draw(report: Report) -> dict[str, Figure]:
    """Return all figures of a report by the names of their files, without suffix."""
    robot = report.fit.base.model.robot
    spectra = report.fit.residual_spectra
    longest = max(report.identification, key=lambda errors: len(errors.time))
    shown = report.verification[0] if report.verification else longest
    figures: dict[str, Figure] = {
        "errors": error_figure(report.identification, report.verification, robot),
        "parameters": parameter_figure(report.fit),
        "friction": friction_figure(report.fit, report.identification),
        "gravity": gravity_figure(report.fit, shown),
        "robot": error_scene(report.fit, shown),
    }
    if report.claimed:
        groups = (
            ("by the robot's file", report.claimed),
            ("identified", report.every_error),
        )
        figures["before_and_after"] = bar_figure(
            groups, robot, "Torque errors before and after"
        )
    if report.choice is not None:
        figures["filter"] = filter_figure(report.choice)
    if spectra is not None:
        figures["residuals"] = residual_figure(spectra, robot)
        figures["autocorrelation"] = autocorrelation_figure(longest, robot, spectra)
    used: set[str] = set()
    for role in ("identification", "verification"):
        for errors in getattr(report, role):
            stem = safe_name(errors.name)
            more = (f"{stem}_{role}_{k}" for k in range(2, 10_000))
            # Unique also where case is ignored.
            stem = next(
                x for x in (stem, f"{stem}_{role}", *more) if x.lower() not in used
            )
            used.add(stem.lower())
            title = errors.name if errors.name == role else f"{errors.name} ({role})"
            figures[f"torque_{stem}"] = torque_figure(errors, robot, title)
    return figures


def safe_name(name: str) -> str:
    """Return a name that every file system takes: ASCII letters, digits, `-`, `_`, inner dots."""
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_only).strip(".-")[:80].strip(".-")
    return safe or "recording"


def _earlier_files(folder: Path) -> set[str]:
    """Return the figures that an earlier report in this folder has written."""
    if schema_of(folder / "result.json") != SCHEMAS["result.json"]:
        return set()
    files = read_json(folder / "result.json").get("files", ())
    return {f for f in files if re.fullmatch(r"[\w.-]+\.(svg|png|pdf)", f)}


def schema_of(path: Path) -> str:
    """Return the schema that a result file names; nothing for other files."""
    try:
        schema = str(read_json(path)["schema"])
    except (OSError, ValueError, KeyError, TypeError):
        return ""
    return schema if schema.startswith("jaxid-") else ""


def read_fit(report: Path) -> Fit:
    """Read the fit of a report, or a model file."""
    path = report if report.is_file() else report / MODEL
    if not path.is_file():
        raise InputError(
            f"`{report}` must be a folder of `jaxid identify`, but holds no `{MODEL}`."
        )
    return load_fit(path)


def read_faults(report: Path) -> list[str]:
    """Return why the model of a report must not be used, as its verdict says; nothing if it may."""
    path = (report if report.is_dir() else report.parent) / "result.json"
    if schema_of(path) != SCHEMAS["result.json"]:
        return []
    _, *remarks = read_json(path).get("verdict", ({},))
    return [r["text"] for r in remarks if r["status"] == Status.BAD.name.lower()]


def write_comparison(
    folder: Path, comparison: Comparison, sources: Sequence[Path] = ()
) -> list[Path]:
    """Write `report.html`, `comparison.json` and `comparison.csv`; return the files."""
    first, second = comparison.first, comparison.second
    k = list(comparison.indices)
    rows = _rows(
        name=comparison.names,
        expression=[first.base.expressions[i] for i in k],
        unit=comparison.units,
        group=comparison.kinds,
        first=np.asarray(first.parameters)[k],
        first_standard_deviation=first.standard_deviations[k],
        second=np.asarray(second.parameters)[k],
        second_standard_deviation=second.standard_deviations[k],
        difference=comparison.difference,
        half_width=comparison.half_widths,
        p_value=comparison.p_values,
        adjusted_p_value=comparison.adjusted_p_values,
        verdict=[v.value for v in comparison.verdicts],
    )
    content = {
        "first": first.name,
        "second": second.name,
        "sources": [str(source) for source in sources],
        "level": comparison.level,
        "parameters": rows,
        "covariance_of_differences": comparison.uncertainty.covariance,
        "groups": comparison.groups,
    }
    count = (
        f"{comparison.verdicts.count(Verdict.CHANGED)} of {len(k)} parameters "
        "have changed"
    )
    sections = [
        ("Result", [Remark(count), comparison.group_summary()]),
        ("Estimates side by side", [comparison_figure(comparison)]),
        ("All parameters", [comparison.summary()]),
    ]
    title = f"{first.base.model.robot.name}: two runs compared"
    lead = f"{first.name} and {second.name}"
    return _write_table(
        folder, "comparison", content, rows, render_page(title, sections, lead)
    )


def write_estimates(
    folder: Path,
    kind: str,
    estimates: Sequence[Estimates],
    content: Mapping[str, Any],
    sources: Mapping[str, Sequence[Path]],
    tables: Sequence[Table],
    doubts: Sequence[Remark] = (),
) -> list[Path]:
    """Write a payload, gains or states as a page, `{kind}.json` and `{kind}.csv`; return them.

    The page shows the `tables`, and the `doubts` above them.
    """
    rows = [row for each in estimates for row in estimate_rows(each)]
    everything = {
        "sources": {key: [str(p) for p in paths] for key, paths in sources.items()},
        "level": LEVEL,
        "parameters": rows,
        "covariance": estimates[0][-1].covariance,
        **content,
    }
    logs = Table(
        "", facts=[(key, ", ".join(map(str, paths))) for key, paths in sources.items()]
    )
    blocks = [*([doubts] if doubts else []), *tables]
    page = render_page(
        f"{kind.capitalize()}: results", [("Result", blocks), ("Logs", [logs])]
    )
    return _write_table(folder, kind, everything, rows, page)


def estimate_rows(estimates: Estimates) -> list[dict[str, Any]]:
    """Return the rows of a CSV file for some estimates."""
    names, units, values, uncertainty = estimates
    return _rows(
        name=names,
        unit=units,
        estimate=values,
        standard_deviation=uncertainty.standard_deviations,
        half_width=uncertainty.half_widths(),
    )


def _write_table(
    folder: Path,
    stem: str,
    content: Mapping[str, Any],
    rows: list[dict[str, Any]],
    page: str,
) -> list[Path]:
    names = ["report.html", f"{stem}.json", f"{stem}.csv"]
    with atomic_folder(folder) as staging:
        (staging / names[0]).write_text(page, encoding="utf-8")
        write_json(staging / names[1], {**header(names[1]), **content})
        write_csv(staging / names[2], rows)
    return [folder / name for name in names]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file that programs read exactly and people can read."""
    path.write_text(json_text(plain(content)), encoding="utf-8")


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with the same keys below a line of these keys."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: arrays become lists, NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, bool | int | str) else str(value)


def header(file: str) -> dict[str, Any]:
    """Return schema, date and versions, the first entries of a result file."""
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"schema": SCHEMAS[file], "made": {"date": date, "versions": versions()}}


def _entries(source: Any, names: str, **renamed: str) -> dict[str, Any]:
    """Return attributes by their names, and those whose keys differ from them."""
    keys = {**{name: name for name in names.split()}, **renamed}
    return {key: getattr(source, name) for key, name in keys.items()}


def _rows(**columns: Any) -> list[dict[str, Any]]:
    """Return a dictionary for each row of some columns."""
    values = (
        x.tolist() if isinstance(x, np.ndarray | jax.Array) else x
        for x in columns.values()
    )
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


def _record(report: Report) -> dict[str, Any]:
    """Return the content of `result.json`."""
    fit, base = report.fit, report.fit.base
    model, robot = base.model, base.model.robot
    return {
        **header("result.json"),
        "verdict": [
            {"status": remark.status.name.lower(), "text": remark.text}
            for remark in verdict(report)
        ],
        "robot": _robot_record(robot),
        "base_parameters": parameter_rows(fit),
        "lengths": base.lengths,
        "model": {
            "terms": [str(term) for term in model.terms],
            "standard_names": model.parameter_names,
            "standard_units": model.parameter_units,
            "independent": base.indices,
            "dependent": base.dependent,
            "kappa": base.kappa,
        },
        "fit": _fit_record(fit),
        "consistency": consistency_record(fit),
        "errors": {
            role: [_error_record(errors, robot) for errors in getattr(report, role)]
            for role in ("identification", "verification")
        },
        "mass_matrix": _entries(
            report.definiteness,
            "positive_definite pose poses",
            smallest_eigenvalue="smallest",
            indefinite_share="indefinite",
        ),
        "settings": report.settings,
        "notes": report.every_note,
    }


def parameter_rows(fit: Fit) -> list[dict[str, Any]]:
    """Return the base parameters, one row for each, in their order."""
    low, high = fit.intervals(0.95).T
    return _rows(
        name=fit.base.names,
        expression=fit.base.expressions,
        unit=fit.base.units,
        group=parameter_kinds(fit.base),
        estimate=fit.parameters,
        standard_deviation=fit.standard_deviations,
        relative=fit.relative_standard_deviations,
        low_95=low,
        high_95=high,
        degrees_of_freedom=fit.uncertainty.dof,
        naive_standard_deviation=fit.naive_standard_deviations,
        ratio_to_naive=fit.uncertainty.ratios,
    )


def _fit_record(fit: Fit) -> dict[str, Any]:
    spectra = fit.residual_spectra
    kept = "estimator solution recordings rows weights residual residual_rms covariance"
    return {
        **_entries(fit, kept),
        "condition_numbers": _entries(fit.condition_numbers, "raw weighted scaled"),
        "naive_covariance": fit.uncertainty.naive_covariance,
        "jackknife_standard_deviations": fit.uncertainty.jackknife,
        "residuals": spectra
        and _entries(
            spectra,
            "white departure limit band frequency density",
            slow_share="low_frequency",
            filter_gain="gain",
        ),
        "undetermined": [
            {
                "sentence": direction.sentence(fit.base),
                "parameters": [fit.base.names[k] for k in direction.parts],
                **_entries(direction, "shares singular_value uncertainty"),
            }
            for direction in fit.undetermined
        ],
        "undetermined_above": LARGEST_UNCERTAINTY,
    }


def consistency_record(fit: Fit) -> dict[str, Any] | None:
    """Return all standard parameters of a physically consistent estimate; None for others."""
    found, model = fit.consistency, fit.base.model
    if found is None or fit.full_parameters is None:
        return None
    return {
        **_entries(
            found,
            "error_bound iterations",
            price="residual_increase",
            assumed="bounds",
            active_bounds="active",
            shares_of_a_body="margins",
        ),
        "proved": found.certified,
        "masses_from_bounds": [f"m{k + 1}" for k in found.masses_from_bounds],
        "standard_parameters": _rows(
            name=model.parameter_names,
            unit=model.parameter_units,
            estimate=fit.full_parameters,
            follows_from_forces_alone=found.determined,
        ),
    }


def _robot_record(robot: Robot) -> dict[str, Any]:
    """Return names, units and limits; geometry, drives and tool are in the model file."""
    joints = range(robot.joints)
    limits = "position_min position_max velocity acceleration jerk force"
    return {
        **_entries(robot, "name source"),
        "joints": _rows(
            name=robot.joint_names,
            kind=[
                "revolute" if revolute else "prismatic" for revolute in robot.revolute
            ],
            unit=[robot.joint_unit(j) for j in joints],
            force_unit=[robot.force_unit(j) for j in joints],
            **_entries(robot.limits, limits),
        ),
    }


def _error_record(errors: TorqueErrors, robot: Robot) -> dict[str, Any]:
    return {
        **_entries(errors, "relative", recording="name"),
        "joints": _rows(
            name=robot.joint_names,
            unit=[robot.force_unit(j) for j in range(robot.joints)],
            rows=np.asarray(errors.counted).sum(axis=0),
            **_entries(
                errors,
                "mean rms mean_percent rms_percent rms_relative offset rms_at_rest "
                "rms_in_motion",
            ),
        ),
    }
