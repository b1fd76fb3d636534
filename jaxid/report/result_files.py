"""Reports on disk: pages and figures for people, numbers for programs, written atomically."""

import csv
import dataclasses
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from jaxid.arrays import AnyArray
from jaxid.errors import InputError
from jaxid.identification.choices import FilterChoice
from jaxid.identification.comparison import LEVEL, Comparison
from jaxid.identification.fit import Fit, load
from jaxid.io import atomic_folder, json_text, read_json
from jaxid.report.errors import error_figure
from jaxid.report.identification import identification_page
from jaxid.report.parameters import comparison_figure, filter_figure, parameter_figure
from jaxid.report.residuals import autocorrelation_figure, residual_figure
from jaxid.report.result_json import (
    SCHEMAS,
    Alternative,
    comparison_rows,
    header,
    identification_record,
    parameter_rows,
    plain,
)
from jaxid.report.style import save
from jaxid.report.torques import torque_figure
from jaxid.validation import Definiteness, TorqueErrors

MODEL = "model.json"
"""File of a report that holds the fit, for `load` and `jaxid export`."""


def write_report(
    folder: Path,
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    notes: Sequence[str] = (),
    alternative: Alternative | None = None,
    choice: FilterChoice | None = None,
    doubts: Sequence[str] = (),
    pdf: bool = False,
) -> list[Path]:
    """Write `report.html`, `result.json`, `parameters.csv`, `model.json` and figures.

    A folder that exists keeps its other files; files of an earlier report in it are replaced.

    Args:
        folder: Folder of the report; made with its parents.
        fit: Identified parameters.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Definiteness of the mass matrix.
        settings: Origin of the result, for the record.
        notes: Notes for the reader, in sentences.
        alternative: Another solution of the same equations.
        choice: Choice of the filter, where it was left to the logs.
        doubts: Doubts about the logs, in sentences.
        pdf: Whether figures are written as PDF too.

    Returns:
        The files.

    Raises:
        InputError: If there are no errors to show, or `folder` is a file.
    """
    record = identification_record(
        fit, identification, verification, definiteness, settings, notes, alternative
    )
    figures = _figures(fit, identification, verification, choice)
    page = identification_page(
        fit, identification, verification, definiteness, settings, figures, notes, doubts
    )
    suffixes = (".png", ".pdf") if pdf else (".png",)
    names = ["report.html", "result.json", "parameters.csv", MODEL]
    names += [f"{stem}{suffix}" for stem in figures for suffix in suffixes]
    with atomic_folder(folder, _earlier_files) as staging:
        write_json(staging / "result.json", {**record, "files": names})
        write_csv(staging / "parameters.csv", parameter_rows(fit))
        fit.save(staging / MODEL)
        (staging / "report.html").write_text(page, encoding="utf-8")
        for stem, figure in figures.items():
            for suffix in suffixes:
                save(figure, staging / f"{stem}{suffix}")
    return [folder / name for name in names]


def _figures(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    choice: FilterChoice | None,
) -> dict[str, Figure]:
    """Return all figures of a report by the names of their files, without suffix."""
    robot = fit.base.model.robot
    figures = {
        "errors": error_figure(identification, verification, robot),
        "parameters": parameter_figure(fit),
    }
    if choice is not None:
        figures["filter"] = filter_figure(choice)
    if fit.residual_spectra is not None:
        figures["residuals"] = residual_figure(fit.residual_spectra, robot)
        longest = max(identification, key=lambda errors: len(errors.time))
        figures["autocorrelation"] = autocorrelation_figure(longest, robot, fit.residual_spectra)
    roles = (("identification", identification), ("verification", verification))
    recordings = [(role, errors) for role, group in roles for errors in group]
    for (role, errors), stem in zip(recordings, _stems(recordings), strict=True):
        title = errors.name if errors.name == role else f"{errors.name} ({role})"
        figures[f"torque_{stem}"] = torque_figure(errors, robot, title)
    return figures


def _stems(recordings: Iterable[tuple[str, TorqueErrors]]) -> list[str]:
    """Return a file name without suffix for every recording, unique also where case is ignored."""
    stems: list[str] = []
    used: set[str] = set()
    for role, errors in recordings:
        stem = safe_name(errors.name)
        choices = (stem, f"{stem}_{role}", *(f"{stem}_{role}_{k}" for k in range(2, 10_000)))
        stems.append(next(choice for choice in choices if choice.lower() not in used))
        used.add(stems[-1].lower())
    return stems


def safe_name(name: str) -> str:
    """Return a name that every file system takes: ASCII letters, digits, `-`, `_`, inner dots."""
    ascii_only = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    safe = re.sub(r"[^A-Za-z0-9._-]+", "-", ascii_only).strip(".-")[:80].strip(".-")
    return safe or "recording"


def _earlier_files(folder: Path) -> set[str]:
    """Return the figures and factors that an earlier report in this folder has written."""
    try:
        content = read_json(folder / "result.json")
        if content["schema"] != SCHEMAS["result.json"]:
            return set()
        return {f for f in content["files"] if re.fullmatch(r"[\w.-]+\.(png|pdf)|run\.npz", f)}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def read_fit(folder: Path, name: str | None = None) -> Fit:
    """Read the fit of a report.

    Args:
        folder: Folder that `write_report` has written.
        name: Name of the fit; the folder's name if None.

    Raises:
        InputError: If the folder holds no report, or its model file is damaged.
    """
    folder = folder.parent if folder.is_file() else folder
    if not (folder / MODEL).is_file():
        raise InputError(
            f"`{folder}` must be a folder that `jaxid identify` has written, but holds no "
            f"`{MODEL}`."
        )
    name = folder.resolve().name if name is None else name
    return dataclasses.replace(load(folder / MODEL), name=name)


def write_comparison(
    folder: Path, comparison: Comparison, sources: Sequence[Path] = ()
) -> list[Path]:
    """Write `comparison.json`, `comparison.csv` and `comparison.png`.

    Args:
        folder: Folder of the files; made with its parents.
        comparison: Comparison of two fits.
        sources: Reports that were compared, for the record.

    Returns:
        The files.

    Raises:
        InputError: If `folder` is a file.
    """
    rows = comparison_rows(comparison)
    content = {
        "first": comparison.first.name,
        "second": comparison.second.name,
        "sources": [str(source) for source in sources],
        "level": comparison.level,
        "parameters": rows,
        "covariance_of_differences": comparison.uncertainty.covariance,
        "groups": comparison.groups,
    }
    figures = {"comparison.png": comparison_figure(comparison)}
    return _write_table(folder, "comparison", content, rows, figures)


def write_estimates(
    folder: Path,
    kind: str,
    rows: list[dict[str, Any]],
    covariance: AnyArray,
    content: Mapping[str, Any],
    sources: Mapping[str, Sequence[Path]],
) -> list[Path]:
    """Write the estimates of a payload, of gains or of states as JSON and CSV.

    Args:
        folder: Folder of the files; made with its parents.
        kind: Name of both files without suffix: `payload`, `gains` or `states`.
        rows: Rows of the table, as `estimate_rows` makes them.
        covariance: Covariance of the estimates, or of the first of them.
        content: Further content of the JSON file.
        sources: Logs and reports that were used, for the record.

    Returns:
        The files.

    Raises:
        InputError: If `folder` is a file.
    """
    everything = {
        "sources": {key: [str(p) for p in paths] for key, paths in sources.items()},
        "level": LEVEL,
        "parameters": rows,
        "covariance": covariance,
        **content,
    }
    return _write_table(folder, kind, everything, rows, {})


def _write_table(
    folder: Path,
    stem: str,
    content: Mapping[str, Any],
    rows: list[dict[str, Any]],
    figures: Mapping[str, Figure],
) -> list[Path]:
    names = [f"{stem}.json", f"{stem}.csv", *figures]
    with atomic_folder(folder) as staging:
        write_json(staging / names[0], plain({**header(names[0]), **content}))
        write_csv(staging / names[1], rows)
        for name, figure in figures.items():
            save(figure, staging / name)
    return [folder / name for name in names]


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a file that programs read exactly and people can read."""
    path.write_text(json_text(content), encoding="utf-8")


def write_csv(path: Path, rows: list[dict[str, Any]]) -> None:
    """Write rows with the same keys below a line of these keys."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
