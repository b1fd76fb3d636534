"""Content of the result files for programs: numbers in SI units, by name."""

import datetime
import math
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from jaxid.identification.estimators.regularisation_and_weights import (
    LARGEST_UNCERTAINTY,
)
from jaxid.identification.fit_result import Fit
from jaxid.identification.parameter_changes import Comparison, parameter_kinds
from jaxid.result_table import versions
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors
from jaxid.validation.verdict import Report, verdict

KINDS = ("result", "comparison", "payload", "gains", "states", "demo", "rollout")
SCHEMAS = {f"{kind}.json": f"jaxid-{kind}/1" for kind in KINDS}
"""Files that hold results, and the schemas in them."""


def header(file: str) -> dict[str, Any]:
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


def table_rows(**columns: Any) -> list[dict[str, Any]]:
    """Return a dictionary for each row of some columns."""
    lists = [
        column.tolist() if isinstance(column, np.ndarray | jax.Array) else column
        for column in columns.values()
    ]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _attributes(source: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(source, name) for name in names}


def result_record(report: Report) -> dict[str, Any]:
    """Return the content of `result.json`."""
    fit = report.fit
    base = fit.base
    model = base.model
    robot = model.robot
    definiteness = report.definiteness
    return {
        **header("result.json"),
        "verdict": [
            {"status": remark.status.name.lower(), "text": remark.text}
            for remark in verdict(report)
        ],
        "robot": _robot_record(robot),
        "base_parameters": parameter_rows(fit),
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
            "identification": [_error_record(e, robot) for e in report.identification],
            "verification": [_error_record(e, robot) for e in report.verification],
        },
        "mass_matrix": {
            **_attributes(definiteness, "positive_definite", "pose", "poses"),
            "smallest_eigenvalue": definiteness.smallest,
            "indefinite_share": definiteness.indefinite,
        },
        "settings": report.settings,
        "notes": report.every_note,
    }


def _robot_record(robot: Robot) -> dict[str, Any]:
    """Return names, units, limits; geometry, drives and tool are in the model file."""
    joints = range(robot.joints)
    limits = robot.limits
    rows = table_rows(
        name=robot.joint_names,
        kind=["revolute" if turns else "prismatic" for turns in robot.revolute],
        unit=[robot.joint_unit(j) for j in joints],
        force_unit=[robot.force_unit(j) for j in joints],
        **_attributes(limits, "position_min", "position_max"),
        **_attributes(limits, "velocity", "acceleration", "jerk", "force"),
    )
    return {"name": robot.name, "source": robot.source, "joints": rows}


def parameter_rows(fit: Fit) -> list[dict[str, Any]]:
    """Return the base parameters, one row for each, in their order."""
    intervals = fit.intervals(0.95)
    return table_rows(
        name=fit.base.names,
        expression=fit.base.expressions,
        unit=fit.base.units,
        group=parameter_kinds(fit.base),
        estimate=fit.parameters,
        standard_deviation=fit.standard_deviations,
        relative=fit.relative_standard_deviations,
        low_95=intervals[:, 0],
        high_95=intervals[:, 1],
        degrees_of_freedom=fit.uncertainty.dof,
        naive_standard_deviation=fit.naive_standard_deviations,
        ratio_to_naive=fit.uncertainty.ratios,
    )


def _fit_record(fit: Fit) -> dict[str, Any]:
    names = fit.base.names
    return {
        **_attributes(fit, "estimator", "solution", "recordings", "rows", "weights"),
        **_attributes(fit, "residual", "residual_rms", "covariance"),
        "condition_numbers": _attributes(
            fit.condition_numbers, "raw", "weighted", "scaled"
        ),
        "naive_covariance": fit.uncertainty.naive_covariance,
        "jackknife_standard_deviations": fit.uncertainty.jackknife,
        "residuals": _spectra_record(fit),
        "undetermined": [
            {
                "sentence": direction.sentence(fit.base),
                "parameters": [names[k] for k in direction.parts],
                **_attributes(direction, "shares", "singular_value", "uncertainty"),
            }
            for direction in fit.undetermined
        ],
        "undetermined_above": LARGEST_UNCERTAINTY,
    }


def _spectra_record(fit: Fit) -> dict[str, Any] | None:
    """Return the spectra of the residuals; None for a fit that has none."""
    spectra = fit.residual_spectra
    if spectra is None:
        return None
    return {
        **_attributes(spectra, "white", "departure", "limit", "band"),
        **_attributes(spectra, "frequency", "density"),
        "slow_share": spectra.low_frequency,
        "filter_gain": spectra.gain,
    }


def consistency_record(fit: Fit) -> dict[str, Any] | None:
    """Return all standard parameters of a physically consistent estimate, or None."""
    consistency = fit.consistency
    if consistency is None or fit.full_parameters is None:
        return None
    model = fit.base.model
    return {
        "error_bound": consistency.error_bound,
        "iterations": consistency.iterations,
        "price": consistency.residual_increase,
        "assumed": consistency.bounds,
        "active_bounds": consistency.active,
        "shares_of_a_body": consistency.margins,
        "proved": consistency.certified,
        "masses_from_bounds": [f"m{k + 1}" for k in consistency.masses_from_bounds],
        "standard_parameters": table_rows(
            name=model.parameter_names,
            unit=model.parameter_units,
            estimate=fit.full_parameters,
            follows_from_forces_alone=consistency.determined,
        ),
    }


def _error_record(errors: TorqueErrors, robot: Robot) -> dict[str, Any]:
    rows = table_rows(
        name=robot.joint_names,
        unit=[robot.force_unit(j) for j in range(robot.joints)],
        rows=np.asarray(errors.counted).sum(axis=0),
        **_attributes(errors, "mean", "rms", "mean_percent", "rms_percent"),
        **_attributes(errors, "rms_relative", "offset", "rms_at_rest", "rms_in_motion"),
    )
    return {"relative": errors.relative, "recording": errors.name, "joints": rows}


def comparison_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the parameters of two fits, one row for each, with their differences."""
    first = comparison.first
    second = comparison.second
    indices = list(comparison.indices)
    return table_rows(
        name=comparison.names,
        expression=[first.base.expressions[k] for k in indices],
        unit=comparison.units,
        group=comparison.kinds,
        first=np.asarray(first.parameters)[indices],
        first_standard_deviation=first.standard_deviations[indices],
        second=np.asarray(second.parameters)[indices],
        second_standard_deviation=second.standard_deviations[indices],
        difference=comparison.difference,
        half_width=comparison.half_widths,
        p_value=comparison.p_values,
        adjusted_p_value=comparison.adjusted_p_values,
        verdict=[verdict.value for verdict in comparison.verdicts],
    )
