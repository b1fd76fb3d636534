"""Reads the results of two identifications, and writes what has changed between them."""

import datetime
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.runs.comparison import Comparison
from jaxid.identification.runs.estimates import Estimates
from jaxid.io import atomic_folder, read_json
from jaxid.report.compared import comparison_figure
from jaxid.report.content import plain, versions
from jaxid.report.style import save
from jaxid.report.write import write_csv, write_json

SCHEMA = "jaxid-comparison/1"
RESULT = "jaxid-result/"
ROUNDED = 1e-6
"""Correlation by which a covariance may fail to be one, from rounding."""
UNGROUPED = "base parameters"
"""Kind of every parameter in files that do not tell it."""


def read_estimates(folder: Path, label: str | None = None) -> Estimates:
    """Reads the base parameters and their covariance from a report.

    Args:
        folder: That `write_report` has written, or its `result.json`.
        label: Of the run; the folder's name if None.

    Raises:
        InputError: If there is no result, or the file lacks something.
    """
    path = folder if folder.is_file() else folder / "result.json"
    if not path.is_file():
        raise InputError(
            f"`{folder}` must be a folder that `jaxid identify` has written, but holds no "
            "`result.json`."
        )
    try:
        content = read_json(path)
    except ValueError as error:
        raise InputError(f"`{path}` is no JSON file: {error}; identify again.") from None
    if not isinstance(content, dict) or not str(content.get("schema")).startswith(RESULT):
        raise InputError(
            f"`{path}` must be the result of an identification (`schema` = `{RESULT}…`): identify "
            "again."
        )
    rows = _list(content, "base_parameters", path)
    columns = {
        key: [_entry(row, key, path, k) for k, row in enumerate(rows)]
        for key in ("name", "expression", "unit", "estimate")
    }
    fit = content.get("fit")
    found = _list(fit if isinstance(fit, dict) else {}, "covariance", path)
    covariance = _numbers(found, "fit.covariance", path)
    size = len(rows)
    if covariance.shape != (size, size):
        raise InputError(
            f"`{path}`: `fit.covariance` must be {size} x {size}, one row for each base parameter, "
            f"but has shape {covariance.shape}: identify again."
        )
    # What is not finite is null in JSON, and nothing is known of it.
    covariance = np.where(np.isnan(covariance), np.inf, covariance)
    estimates = _numbers(columns["estimate"], "estimate", path)
    freedom = _numbers([_freedom(row) for row in rows], "degrees_of_freedom", path)
    for key, values, sound in (
        ("estimate", estimates, np.isfinite(estimates)),
        ("degrees_of_freedom", freedom, freedom >= 0.0),
    ):
        if not sound.all():
            k = int(np.flatnonzero(~sound)[0])
            raise InputError(
                f"`{path}` is damaged: `base_parameters[{k}].{key}` is {values[k]:g}; identify "
                "again."
            )
    if not _is_covariance(covariance):
        raise InputError(
            f"`{path}` is damaged: `fit.covariance` is none, for some combination of parameters "
            "has a negative variance; identify again."
        )
    return Estimates(
        label=(path.parent.resolve().name if label is None else label),
        names=tuple(columns["name"]),
        expressions=tuple(columns["expression"]),
        units=tuple(columns["unit"]),
        groups=tuple(str(row.get("group", UNGROUPED)) for row in rows),
        parameters=estimates,
        covariance=covariance,
        freedom=freedom,
    )


def _is_covariance(covariance: np.ndarray) -> bool:
    """Whether variances and covariances, as far as they are known, fit each other."""
    variances = np.diag(covariance)
    known = np.isfinite(variances)
    C = covariance[np.ix_(known, known)]
    if not known.any():
        return True
    if not (np.isfinite(C).all() and (variances >= 0.0).all()):
        return False
    deviations = np.sqrt(variances[known])
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.where(C == 0.0, 0.0, C / deviations / deviations[:, None])
    if not np.isfinite(correlation).all() or np.abs(correlation - correlation.T).max() > ROUNDED:
        return False
    return bool(np.linalg.eigvalsh(correlation).min() > -ROUNDED)


def _list(content: Mapping[str, Any], key: str, path: Path) -> list[Any]:
    found = content.get(key)
    if not isinstance(found, list) or not found:
        raise InputError(f"`{path}` has no `{key}`: identify again.")
    return found


def _entry(row: Any, key: str, path: Path, number: int) -> Any:
    if not isinstance(row, dict) or row.get(key) is None:
        raise InputError(f"`{path}`: `base_parameters[{number}]` has no `{key}`: identify again.")
    return row[key]


def _numbers(values: list[Any], key: str, path: Path) -> np.ndarray:
    try:
        return np.array(values, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"`{path}`: `{key}` must hold numbers: identify again.") from None


def _freedom(row: Mapping[str, Any]) -> Any:
    found = row.get("degrees_of_freedom")
    return np.inf if found is None else found


def write_comparison(
    folder: Path, comparison: Comparison, sources: Sequence[Path] = ()
) -> list[Path]:
    """Writes `comparison.json`, `comparison.csv` and `comparison.png`, all of them or nothing.

    Args:
        folder: Of the files; made with its parents.
        comparison: Of two runs.
        sources: Where the two runs come from, for the record.

    Returns:
        The files.

    Raises:
        InputError: If `folder` is a file.
    """
    rows = _rows(comparison)
    content = plain(
        {
            "schema": SCHEMA,
            "made": {
                "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "versions": versions(),
            },
            "first": comparison.first.label,
            "second": comparison.second.label,
            "sources": [str(source) for source in sources],
            "level": comparison.level,
            "parameters": rows,
            "covariance_of_differences": comparison.covariance,
            "groups": [
                {
                    "name": g.name,
                    "parameters": g.size,
                    "statistic": g.statistic,
                    "p_value": g.p_value,
                    "changed": g.changed,
                }
                for g in comparison.groups
            ],
        }
    )
    names = ["comparison.json", "comparison.csv", "comparison.png"]
    with atomic_folder(folder) as staging:
        write_json(staging / names[0], content)
        write_csv(staging / names[1], rows)
        save(comparison_figure(comparison), staging / names[2])
    return [folder / name for name in names]


def _rows(comparison: Comparison) -> list[dict[str, Any]]:
    first, second = comparison.first, comparison.second
    columns = {
        "name": first.names,
        "expression": first.expressions,
        "unit": first.units,
        "group": first.groups,
        "first": np.asarray(first.parameters).tolist(),
        "first_standard_deviation": first.standard_deviations.tolist(),
        "second": np.asarray(second.parameters).tolist(),
        "second_standard_deviation": second.standard_deviations.tolist(),
        "difference": np.asarray(comparison.difference).tolist(),
        "half_width": comparison.half_widths.tolist(),
        "p_value": comparison.p_values.tolist(),
        "adjusted_p_value": comparison.adjusted_p_values.tolist(),
        "verdict": [v.value for v in comparison.verdicts],
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
