"""Content of the result files for programs: numbers in SI units, by name."""

import datetime
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.identification.fit_result import Fit
from jaxid.identification.parameter_changes import Comparison
from jaxid.identification.uncertainty import Uncertainty
from jaxid.result_table import SCHEMAS, Remark, versions
from jaxid.robot.robot import Robot
from jaxid.validation.judgement import Report, judge
from jaxid.validation.torque_errors import TorqueErrors

Record = dict[str, Any]
"""Object of a JSON file, or row of a CSV file."""


def header(file: str) -> Record:
    """Return schema, date and versions, the first entries of a result file."""
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"schema": SCHEMAS[file], "made": {"date": date, "versions": versions()}}


def plain(value: Any) -> Any:
    """Return a value for JSON: arrays become lists, NaN and infinity become null."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        value = np.asarray(value).tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(entry) for entry in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def table_rows(**columns: Any) -> list[Record]:
    """Return a dictionary for each row of some columns."""
    lists = [
        column.tolist() if isinstance(column, np.ndarray | jax.Array) else column
        for column in columns.values()
    ]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def result_record(report: Report) -> Record:
    """Return the content of `result.json`; `model.json` holds robot, model and fit."""
    fit = report.fit
    robot = fit.base.model.robot
    judgement = judge(report)
    undetermined_records = []
    for direction in fit.undetermined:
        names = [fit.base.names[k] for k in direction.parts]
        sentence = direction.sentence(fit.base)
        undetermined_records.append(
            {"sentence": sentence, "parameters": names, **vars(direction)}
        )
    return {
        **header("result.json"),
        "verdict": verdict_rows([judgement.verdict, *judgement.findings]),
        "robot": robot.name,
        "base_parameters": table_rows(**fit.columns()),
        "fit": {
            "estimator": fit.estimator,
            "recordings": fit.recordings,
            "rows": fit.rows,
            "weights": fit.weights,
            "residual": fit.residual,
            "residual_rms": fit.residual_rms,
            "covariance": fit.covariance,
            "condition_numbers": vars(fit.condition_numbers),
            "undetermined": undetermined_records,
        },
        "consistency": consistency_record(fit),
        "errors": {
            "identification": [error_record(e, robot) for e in report.identification],
            "verification": [error_record(e, robot) for e in report.verification],
        },
        "mass_matrix": {
            "positive_definite": report.definiteness.positive_definite,
            **vars(report.definiteness),
        },
        "settings": report.settings,
        "notes": report.every_note,
    }


def verdict_rows(remarks: Iterable[Remark]) -> list[Record]:
    """Return a verdict and findings, one row for each."""
    return [{"status": x.status.name.lower(), "text": x.text} for x in remarks]


def consistency_record(fit: Fit) -> Record | None:
    """Return all standard parameters of a physically consistent estimate, or None."""
    if fit.consistency is None or fit.full_parameters is None:
        return None
    parameters = table_rows(
        name=fit.base.model.parameter_names,
        unit=fit.base.model.parameter_units,
        estimate=fit.full_parameters,
    )
    return {**vars(fit.consistency), "standard_parameters": parameters}


def error_record(errors: TorqueErrors, robot: Robot) -> Record:
    """Return the torque errors of one recording, joint by joint."""
    rows = table_rows(
        name=robot.joint_names,
        unit=[robot.force_unit(j) for j in range(robot.joints)],
        rows=errors.counted.sum(axis=0),
        mean=errors.mean,
        rms=errors.rms,
        mean_percent=errors.mean_percent,
        rms_relative=errors.rms_relative,
    )
    return {"relative": errors.relative, "recording": errors.name, "joints": rows}


def estimate_rows(
    names: Sequence[str], units: Sequence[str], values: AnyArray, spread: Uncertainty
) -> list[Record]:
    """Return some estimates with their uncertainty, one row for each."""
    return table_rows(
        name=names,
        unit=units,
        estimate=values,
        standard_deviation=spread.standard_deviations,
        half_width=spread.half_widths(),
    )


def comparison_rows(comparison: Comparison) -> list[Record]:
    """Return the parameters of two fits, one row for each, with their differences."""
    first_fit = comparison.first
    second_fit = comparison.second
    indices = list(comparison.indices)
    return table_rows(
        name=comparison.names,
        expression=[first_fit.base.expressions[k] for k in indices],
        unit=comparison.units,
        group=comparison.kinds,
        first=first_fit.parameters[indices],
        first_standard_deviation=first_fit.standard_deviations[indices],
        second=second_fit.parameters[indices],
        second_standard_deviation=second_fit.standard_deviations[indices],
        difference=comparison.difference,
        half_width=comparison.half_widths,
        p_value=comparison.p_values,
        adjusted_p_value=comparison.adjusted_p_values,
        verdict=[verdict.value for verdict in comparison.verdicts],
    )
