"""Results on disk: pages and figures for people, numbers for programs.

Each result is written atomically.
"""

import csv
import itertools
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxid.arrays import AnyArray
from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit, load_fit
from jaxid.identification.parameter_changes import LEVEL, Comparison, Verdict
from jaxid.identification.uncertainty import Uncertainty
from jaxid.io import atomic_folder, json_text, read_json
from jaxid.result_table import Remark, Status, Table
from jaxid.validation.verdict import Report

from .estimates import comparison_figure, parameter_figure
from .figure import Figure
from .identification import identification_page
from .page import render_page
from .physics import error_scene, friction_figure, gravity_figure
from .residuals import autocorrelation_figure, filter_figure, residual_figure
from .result_records import (
    SCHEMAS,
    comparison_rows,
    header,
    parameter_rows,
    plain,
    result_record,
    table_rows,
)
from .torques import bar_figure, error_figure, torque_figure

MODEL = "model.json"
"""File of a report that holds the fit, for `load_fit` and `jaxid export`."""
FIGURE_FILE = re.compile(r"[\w.-]+\.(svg|png|pdf)")
"""Name of a file that holds a figure of a report."""
Estimates = tuple[Sequence[str], Sequence[str], AnyArray, Uncertainty]
"""Names, units, values and uncertainty of some estimates."""


def write_report(folder: Path, report: Report, suffix: str = "") -> list[Path]:
    """Write `report.html`, `result.json`, `parameters.csv`, `model.json`; return them.

    With a `suffix` (`svg`, `png` or `pdf`) each figure is also written to a file of
    that format. A folder that exists keeps its other files; files of an earlier report
    in it are replaced.
    """
    figures = report_figures(report)
    pictures = [f"{stem}.{suffix}" for stem in figures] if suffix else []
    names = ["report.html", "result.json", "parameters.csv", MODEL, *pictures]
    record = {**result_record(report), "files": names}
    page = identification_page(report, figures)
    with atomic_folder(folder, _earlier_figures) as staging:
        for name, figure in zip(pictures, figures.values(), strict=False):
            figure.save(staging / name)
        write_json(staging / "result.json", record)
        write_csv(staging / "parameters.csv", parameter_rows(report.fit))
        report.fit.save(staging / MODEL)
        (staging / "report.html").write_text(page, encoding="utf-8")
    return [folder / name for name in names]


def report_figures(report: Report) -> dict[str, Figure]:
    """Return all figures of a report by the names of their files, without suffix."""
    fit = report.fit
    robot = fit.base.model.robot
    longest_log = max(report.identification, key=lambda errors: len(errors.time))
    shown_log = report.verification[0] if report.verification else longest_log
    figures = {
        "errors": error_figure(report.identification, report.verification, robot),
        "parameters": parameter_figure(fit),
        "friction": friction_figure(fit, report.identification),
        "gravity": gravity_figure(fit, shown_log),
        "robot": error_scene(fit, shown_log),
    }
    if report.claimed:
        groups = (
            ("by the robot's file", report.claimed),
            ("identified", report.every_error),
        )
        title = "Torque errors before and after"
        figures["before_and_after"] = bar_figure(groups, robot, title)
    if report.choice is not None:
        figures["filter"] = filter_figure(report.choice)
    spectra = fit.residual_spectra
    if spectra is not None:
        figures["residuals"] = residual_figure(spectra, robot)
        figures["autocorrelation"] = autocorrelation_figure(longest_log, robot, spectra)
    return figures | _torque_figures(report)


def _torque_figures(report: Report) -> dict[str, Figure]:
    """Return a figure for each log."""
    robot = report.fit.base.model.robot
    figures: dict[str, Figure] = {}
    for role in ("identification", "verification"):
        for errors in getattr(report, role):
            name = _unique_name(f"torque_{safe_name(errors.name)}", role, figures)
            title = errors.name if errors.name == role else f"{errors.name} ({role})"
            figures[name] = torque_figure(errors, robot, title)
    return figures


def _unique_name(stem: str, role: str, names: Iterable[str]) -> str:
    """Return a name for a file that is new also where case is ignored."""
    names_in_use = {name.lower() for name in names}
    candidate = stem
    numbers = itertools.count(2)
    while candidate.lower() in names_in_use:
        candidate = f"{stem}_{role}"
        role = f"{role}_{next(numbers)}"
    return candidate


def safe_name(name: str) -> str:
    """Return a name that every file system takes.

    It consists of ASCII letters, digits, `-`, `_` and inner dots.
    """
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_only).strip(".-")[:80].strip(".-")
    return safe or "recording"


def _earlier_figures(folder: Path) -> set[str]:
    """Return the figures that an earlier report in this folder has written."""
    if schema_of(folder / "result.json") != SCHEMAS["result.json"]:
        return set()
    files = read_json(folder / "result.json").get("files", ())
    return {file for file in files if FIGURE_FILE.fullmatch(file)}


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
    """Return why a report's model must not be used, by its verdict; else nothing."""
    path = (report if report.is_dir() else report.parent) / "result.json"
    if schema_of(path) != SCHEMAS["result.json"]:
        return []
    # The first remark of a verdict sums the others up.
    remarks = read_json(path).get("verdict", ())[1:]
    return [r["text"] for r in remarks if r["status"] == Status.BAD.name.lower()]


def write_comparison(
    folder: Path, comparison: Comparison, sources: Sequence[Path] = ()
) -> list[Path]:
    """Write `report.html`, `comparison.json` and `comparison.csv`; return the files."""
    first = comparison.first
    second = comparison.second
    rows = comparison_rows(comparison)
    content = {
        "first": first.name,
        "second": second.name,
        "sources": [str(source) for source in sources],
        "level": LEVEL,
        "parameters": rows,
        "covariance_of_differences": comparison.uncertainty.covariance,
        "groups": comparison.groups,
    }
    changes = comparison.verdicts.count(Verdict.CHANGED)
    count = Remark(f"{changes} of {len(rows)} parameters have changed")
    sections = [
        ("Result", [count, comparison.group_summary()]),
        ("Estimates side by side", [comparison_figure(comparison)]),
        ("All parameters", [comparison.summary()]),
    ]
    title = f"{first.base.model.robot.name}: two runs compared"
    page = render_page(title, sections, f"{first.name} and {second.name}")
    return _write_page_and_table(folder, "comparison", page, content, rows)


def write_estimates(
    folder: Path,
    kind: str,
    estimates: Sequence[Estimates],
    content: Mapping[str, Any],
    sources: Mapping[str, Sequence[Path]],
    tables: Sequence[Table],
    doubts: Sequence[Remark] = (),
) -> list[Path]:
    """Write a payload, gains or states; return the files.

    The files are a page, `{kind}.json` and `{kind}.csv`. The page shows the `tables`,
    and the `doubts` above them.

    Args:
        folder: Folder of the files.
        kind: What is written, like "payload".
        estimates: Groups of estimates; the covariance of the first is written, too.
        content: Further content of the JSON file.
        sources: Logs and reports of each run, by its name.
        tables: Tables of the page.
        doubts: Doubts about the logs.
    """
    rows = []
    for group in estimates:
        rows += estimate_rows(group)
    _, _, _, first_uncertainty = estimates[0]

    paths_of_runs = {}
    source_facts = []
    for run, paths in sources.items():
        names = [str(path) for path in paths]
        paths_of_runs[run] = names
        source_facts.append((run, ", ".join(names)))

    record = {
        "sources": paths_of_runs,
        "level": LEVEL,
        "parameters": rows,
        "covariance": first_uncertainty.covariance,
        **content,
    }
    results = [doubts, *tables] if doubts else tables
    sections = [("Result", results), ("Logs", [Table("", facts=source_facts)])]
    page = render_page(f"{kind.capitalize()}: results", sections)
    return _write_page_and_table(folder, kind, page, record, rows)


def estimate_rows(estimates: Estimates) -> list[dict[str, Any]]:
    """Return the rows of a CSV file for some estimates."""
    names, units, values, uncertainty = estimates
    return table_rows(
        name=names,
        unit=units,
        estimate=values,
        standard_deviation=uncertainty.standard_deviations,
        half_width=uncertainty.half_widths(),
    )


def _write_page_and_table(
    folder: Path,
    stem: str,
    page: str,
    content: Mapping[str, Any],
    rows: list[dict[str, Any]],
) -> list[Path]:
    """Write `report.html`, and the files for programs with this stem."""
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
