"""Writes the report of an identification: numbers for programs, figures for people."""

import csv
import re
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jaxid.identification.filter_choice import FilterChoice
from jaxid.identification.fit import Fit
from jaxid.identification.runs.run import Run
from jaxid.identification.runs.update import save_run
from jaxid.io import atomic_folder, json_text, read_json
from jaxid.report.autocorrelation import autocorrelation_figure
from jaxid.report.bars import error_figure
from jaxid.report.content import Beside, parameters, result
from jaxid.report.estimates import parameter_figure
from jaxid.report.filters import filter_figure
from jaxid.report.identified import PAGE, identification_page
from jaxid.report.page import write_page
from jaxid.report.residuals import residual_figure
from jaxid.report.style import save
from jaxid.report.torques import torque_figure
from jaxid.validation import Definiteness, TorqueErrors

LONGEST_NAME = 80
MODEL = "model.json"
"""File of a report that holds the fit, for `load` and `jaxid export`."""
RUN = "run.npz"
"""File of a report that keeps what its logs have told, to add, compare and combine later."""
OWN = r"[A-Za-z0-9._-]+\.(png|pdf)|run\.npz"
"""Files that not every report has; those of an earlier one go."""


def write_report(
    folder: Path,
    fit: Fit,
    identification: tuple[TorqueErrors, ...],
    verification: tuple[TorqueErrors, ...],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    notes: tuple[str, ...] = (),
    beside: Beside | None = None,
    choice: FilterChoice | None = None,
    run: Run | None = None,
    doubts: tuple[str, ...] = (),
    pdf: bool = False,
) -> list[Path]:
    """Writes `report.html`, `result.json`, `parameters.csv`, `model.json`, `run.npz` and figures.

    A folder that is there already keeps its other files; figures of recordings that an earlier
    report left in it go.

    Args:
        folder: Of the report; made with its parents.
        fit: The estimates.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Of the mass matrix.
        settings: How the result came about, for the record.
        notes: What the reader should know, in sentences.
        beside: Another way to solve the same equations.
        choice: Of the filter, where it was left to the logs.
        run: What the recordings have told, for later runs; no `run.npz` if None.
        doubts: About the logs, in sentences.
        pdf: Whether figures are written as PDF too.

    Returns:
        The files.

    Raises:
        InputError: If there are no errors to show, or `folder` is a file.
    """
    robot = fit.base.model.robot
    named = _file_names(identification, verification)
    content = result(fit, identification, verification, definiteness, settings, notes, beside)
    figures = {"errors": error_figure(identification, verification, robot)}
    figures["parameters"] = parameter_figure(fit)
    if choice is not None:
        figures["filter"] = filter_figure(choice)
    if fit.residual_spectra is not None:
        figures["residuals"] = residual_figure(fit.residual_spectra, robot)
        longest = max(identification, key=lambda errors: len(errors.time))
        figures["autocorrelation"] = autocorrelation_figure(longest, robot, fit.residual_spectra)
    for stem, role, errors in named:
        title = errors.name if errors.name == role else f"{errors.name} ({role})"
        figures[stem] = torque_figure(errors, robot, title)
    suffixes = (".png", ".pdf") if pdf else (".png",)
    drawn = [f"{stem}{suffix}" for stem in figures for suffix in suffixes]
    names = [PAGE, "result.json", "parameters.csv", MODEL, *drawn]
    names += [RUN] if run is not None else []
    content["files"] = names
    with atomic_folder(folder, _earlier) as staging:
        write_json(staging / "result.json", content)
        write_csv(staging / "parameters.csv", parameters(fit))
        fit.save(staging / MODEL)
        page = identification_page(
            *(fit, identification, verification, definiteness, settings, figures, notes, doubts)
        )
        write_page(staging / PAGE, page)
        if run is not None:
            save_run(staging / RUN, run)
        for stem, figure in figures.items():
            for suffix in suffixes:
                save(figure, staging / f"{stem}{suffix}")
    return [folder / name for name in names]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Writes a file that programs read exactly and people can read."""
    path.write_text(json_text(content), encoding="utf-8")


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Writes rows with the same keys below a line of these keys."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def _file_names(
    identification: Iterable[TorqueErrors], verification: Iterable[TorqueErrors]
) -> list[tuple[str, str, TorqueErrors]]:
    """A file name without suffix for every recording, its own also where case is ignored."""
    used: set[str] = set()
    named = []
    for role, recordings in (("identification", identification), ("verification", verification)):
        for errors in recordings:
            stem = safe_name(errors.name)
            choices = (stem, f"{stem}_{role}", *(f"{stem}_{role}_{k}" for k in range(2, 10_000)))
            name = next(c for c in choices if c.lower() not in used)
            used.add(name.lower())
            named.append((f"torque_{name}", role, errors))
    return named


def safe_name(name: str) -> str:
    """A name that every file system takes: ASCII letters, digits, `-`, `_` and inner dots."""
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_only).strip(".-")[:LONGEST_NAME].strip(".-")
    return safe or "recording"


def _earlier(folder: Path) -> set[str]:
    """What an earlier report in this folder says it has written, and not every report has."""
    try:
        content = read_json(folder / "result.json")
        if not str(content["schema"]).startswith("jaxid-result/"):
            return set()
        return {f for f in content["files"] if re.fullmatch(OWN, f)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()
