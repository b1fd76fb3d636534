"""Results on disk: pages and figures for people, numbers for programs.

Each result is written atomically.
"""

import csv
import re
import unicodedata
from pathlib import Path

from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.identification.model_file import load_fit
from jaxid.io import atomic_folder, json_text, read_json
from jaxid.result_table import Status
from jaxid.validation.judgement import Report

from .figure import Figure
from .friction_figures import error_scene, friction_figure
from .identification_page import identification_page
from .residual_spectra import residual_figure
from .result_records import (
    SCHEMAS,
    Record,
    header,
    plain,
    result_record,
    table_rows,
)
from .torques import bar_figure, torque_figure

MODEL = "model.json"
"""File of a report that holds the fit, for `load_fit` and `jaxid export`."""
FIGURE_FILE = re.compile(r"[\w.-]+\.(svg|png|pdf)")
"""Name of a file that holds a figure of a report."""


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
        write_csv(staging / "parameters.csv", table_rows(**report.fit.columns()))
        report.fit.save(staging / MODEL)
        (staging / "report.html").write_text(page, encoding="utf-8")
    return [folder / name for name in names]


def report_figures(report: Report) -> dict[str, Figure]:
    """Return all figures of a report by the names of their files, without suffix."""
    fit = report.fit
    robot = fit.base.model.robot
    shown_logs = report.verification or report.identification
    roles = {
        "identification": report.identification,
        "verification": report.verification,
    }
    figures = {
        "errors": bar_figure(roles, robot),
        "friction": friction_figure(fit, report.identification),
        "robot": error_scene(fit, shown_logs[0], report.shapes),
    }
    if report.claimed:
        groups = {
            "by the robot's file": report.claimed,
            "identified": report.every_error,
        }
        title = "Torque errors before and after"
        figures["before_and_after"] = bar_figure(groups, robot, title)

    if fit.residual_spectra is not None:
        figures["residuals"] = residual_figure(fit.residual_spectra, robot)
    for role, logs in roles.items():
        for errors in logs:
            # The number keeps logs apart whose names are safe in the same way.
            name = f"torque_{len(figures)}_{safe_name(errors.name)}"
            title = f"{errors.name} ({role})"
            figures[name] = torque_figure(errors, robot, title)
    return figures


def safe_name(name: str) -> str:
    """Return a name that every file system takes.

    It consists of ASCII letters, digits, `-`, `_` and inner dots.
    """
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe_text = (
        re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_only).strip(".-")[:80].strip(".-")
    )
    return safe_text or "recording"


def _earlier_figures(folder: Path) -> set[str]:
    """Return the figures that an earlier report in this folder has written."""
    if schema_of(folder / "result.json") != SCHEMAS["result.json"]:
        return set()
    files = read_json(folder / "result.json").get("files")
    texts = map(str, files) if isinstance(files, list) else ()
    return {file for file in texts if FIGURE_FILE.fullmatch(file)}


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
    try:
        # The first remark of a verdict sums the others up.
        remarks = read_result(report).get("verdict", ())[1:]
        return [r["text"] for r in remarks if r["status"] == Status.BAD.name.lower()]
    except (KeyError, TypeError) as error:
        raise InputError(
            f"`{report}`: `result.json` is damaged: identify again."
        ) from error


def read_result(report: Path) -> Record:
    """Return the content of a report's `result.json`; nothing of a model alone."""
    path = (report if report.is_dir() else report.parent) / "result.json"
    return read_json(path) if schema_of(path) == SCHEMAS["result.json"] else {}


def write_page_and_table(
    folder: Path, stem: str, page: str, content: Record, rows: list[Record]
) -> list[Path]:
    """Write `report.html`, and the files for programs with this stem; return them."""
    names = ["report.html", f"{stem}.json", f"{stem}.csv"]
    with atomic_folder(folder) as staging:
        (staging / names[0]).write_text(page, encoding="utf-8")
        write_json(staging / names[1], {**header(names[1]), **content})
        write_csv(staging / names[2], rows)
    return [folder / name for name in names]


def write_json(path: Path, content: Record) -> None:
    """Write a file that programs read exactly and people can read."""
    path.write_text(json_text(plain(content)), encoding="utf-8")


def write_csv(path: Path, rows: list[Record]) -> None:
    """Write rows with the same keys below a line of these keys."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
