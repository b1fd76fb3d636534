"""Content of result files: all results as plain numbers, lists and texts."""

import datetime
import importlib.metadata
import math
import platform
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxid.arrays import AnyArray
from jaxid.identification.comparison import Comparison, parameter_kinds
from jaxid.identification.estimators.solutions import LARGEST_UNCERTAINTY
from jaxid.identification.fit import Fit
from jaxid.identification.uncertainty import Uncertainty
from jaxid.robot.robot import Robot
from jaxid.validation import Definiteness, TorqueErrors

SCHEMAS = {
    "result.json": "jaxid-result/1",
    "comparison.json": "jaxid-comparison/1",
    "payload.json": "jaxid-payload/1",
    "gains.json": "jaxid-gains/1",
    "states.json": "jaxid-states/1",
    "demo.json": "jaxid-demo/1",
}
"""Files that hold results, and the schemas in them."""


class Alternative(NamedTuple):
    """Another solution of the same equations, shown beside a fit.

    Attributes:
        fit: Other fit.
        errors: Errors of the other fit on the same recordings.
        names: Names of the fit's own solution and of the other one.
    """

    fit: Fit
    errors: Sequence[TorqueErrors]
    names: tuple[str, str]


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: arrays become lists, NaN and infinity become null."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | jax.Array):
        return plain(np.asarray(value).tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)


def versions() -> dict[str, str]:
    """Return the versions of the software that computed a result."""
    try:
        own = importlib.metadata.version("jaxid-robotics")
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    return {
        "jaxid": own,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def header(file: str) -> dict[str, Any]:
    """Return schema, date and versions, the first entries of a result file."""
    date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    return {"schema": SCHEMAS[file], "made": {"date": date, "versions": versions()}}


def identification_record(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    notes: Sequence[str],
    alternative: Alternative | None = None,
) -> dict[str, Any]:
    """Return the content of `result.json`."""
    base, model, robot = fit.base, fit.base.model, fit.base.model.robot
    return plain(
        {
            **header("result.json"),
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
                "identification": [_error_record(e, robot) for e in identification],
                "verification": [_error_record(e, robot) for e in verification],
            },
            "mass_matrix": {
                "positive_definite": definiteness.positive_definite,
                "smallest_eigenvalue": definiteness.smallest,
                "pose": definiteness.pose,
                "indefinite_share": definiteness.indefinite,
                "poses": definiteness.poses,
            },
            "beside": alternative
            and {
                "way": alternative.names[1],
                "solution": str(alternative.fit.solution),
                "errors": [_error_record(e, robot) for e in alternative.errors],
            },
            "settings": settings,
            "notes": tuple(dict.fromkeys((*robot.notes, *fit.notes, *notes))),
        }
    )


def _fit_record(fit: Fit) -> dict[str, Any]:
    numbers, spectra = fit.condition_numbers, fit.residual_spectra
    return {
        "estimator": str(fit.estimator),
        "solution": str(fit.solution),
        "recordings": fit.recordings,
        "rows": fit.rows,
        "weights": fit.weights,
        "condition_numbers": {
            "raw": numbers.raw,
            "weighted": numbers.weighted,
            "scaled": numbers.scaled,
        },
        "residual": fit.residual,
        "residual_rms": fit.residual_rms,
        "covariance": fit.covariance,
        "naive_covariance": fit.uncertainty.naive_covariance,
        "jackknife_standard_deviations": fit.uncertainty.jackknife,
        "residuals": spectra
        and {
            "white": spectra.white,
            "departure": spectra.departure,
            "limit": spectra.limit,
            "slow_share": spectra.low_frequency,
            "band": spectra.band,
            "frequency": spectra.frequency,
            "density": spectra.density,
            "filter_gain": spectra.gain,
        },
        "undetermined": [
            {
                "sentence": direction.sentence(fit.base),
                "parameters": [fit.base.names[k] for k in direction.parts],
                "shares": direction.shares,
                "singular_value": direction.singular_value,
                "uncertainty": direction.uncertainty,
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
    columns = {
        "name": model.parameter_names,
        "unit": model.parameter_units,
        "estimate": np.asarray(fit.full_parameters).tolist(),
        "follows_from_forces_alone": found.determined.tolist(),
    }
    return {
        "price": found.residual_increase,
        "error_bound": found.error_bound,
        "proved": found.outcome.name == "CERTIFIED",
        "outcome": found.outcome.value,
        "iterations": found.iterations,
        "assumed": str(found.bounds),
        "active_bounds": found.active,
        "masses_from_bounds": [f"m{k + 1}" for k in found.masses_from_bounds],
        "shares_of_a_body": found.margins,
        "standard_parameters": _rows(columns),
    }


def parameter_rows(fit: Fit) -> list[dict[str, Any]]:
    """Return the base parameters, one row for each, in their order."""
    low, high = fit.intervals(0.95).T.tolist()
    return _rows(
        {
            "name": fit.base.names,
            "expression": fit.base.expressions,
            "unit": fit.base.units,
            "group": parameter_kinds(fit.base),
            "estimate": np.asarray(fit.parameters).tolist(),
            "standard_deviation": fit.standard_deviations.tolist(),
            "relative": fit.relative_standard_deviations.tolist(),
            "low_95": low,
            "high_95": high,
            "degrees_of_freedom": np.asarray(fit.uncertainty.dof).tolist(),
            "naive_standard_deviation": fit.naive_standard_deviations.tolist(),
            "ratio_to_naive": fit.uncertainty.ratios.tolist(),
        }
    )


def comparison_rows(comparison: Comparison) -> list[dict[str, Any]]:
    """Return the parameters of two fits and their differences, one row for each."""
    first, second, k = comparison.first, comparison.second, list(comparison.indices)
    return _rows(
        {
            "name": comparison.names,
            "expression": [first.base.expressions[i] for i in k],
            "unit": comparison.units,
            "group": comparison.kinds,
            "first": np.asarray(first.parameters)[k].tolist(),
            "first_standard_deviation": first.standard_deviations[k].tolist(),
            "second": np.asarray(second.parameters)[k].tolist(),
            "second_standard_deviation": second.standard_deviations[k].tolist(),
            "difference": np.asarray(comparison.difference).tolist(),
            "half_width": comparison.half_widths.tolist(),
            "p_value": comparison.p_values.tolist(),
            "adjusted_p_value": comparison.adjusted_p_values.tolist(),
            "verdict": [v.value for v in comparison.verdicts],
        }
    )


def estimate_rows(
    names: Sequence[str], units: Sequence[str], values: AnyArray, uncertainty: Uncertainty
) -> list[dict[str, Any]]:
    """Return estimates of a payload, of gains or of states, one row for each."""
    return _rows(
        {
            "name": names,
            "unit": units,
            "estimate": np.asarray(values).tolist(),
            "standard_deviation": uncertainty.standard_deviations.tolist(),
            "half_width": uncertainty.half_widths().tolist(),
        }
    )


def _rows(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _robot_record(robot: Robot) -> dict[str, Any]:
    limits, drives, tool = robot.limits, robot.drives, robot.tool
    names = ("position_min", "position_max", "velocity", "acceleration", "jerk", "force")
    return {
        "name": robot.name,
        "source": robot.source,
        "joints": [
            {
                "name": name,
                "kind": "revolute" if revolute else "prismatic",
                "unit": robot.joint_unit(j),
                "force_unit": robot.force_unit(j),
                "parent": robot.parent[j],
                "axis": robot.axis[j],
                "rotation": robot.rotation[j],
                "offset": robot.offset[j],
                **{key: getattr(limits, key)[j] for key in names},
            }
            for j, (name, revolute) in enumerate(
                zip(robot.joint_names, robot.revolute, strict=True)
            )
        ],
        "gravity": robot.gravity,
        "drives": {
            "reduction": drives.reduction,
            "zero": drives.zero,
            "max_torques": drives.max_torques,
            "rotor_inertia": drives.rotor_inertia,
        },
        "tool": tool
        and {
            "body": tool.body,
            "mass": tool.mass,
            "centre_of_mass": tool.centre_of_mass,
            "inertia": tool.inertia,
        },
        "tip": {
            "body": robot.tip_body,
            "rotation": robot.tip_rotation,
            "offset": robot.tip_offset,
        },
    }


def _error_record(errors: TorqueErrors, robot: Robot) -> dict[str, Any]:
    columns = {
        "name": robot.joint_names,
        "unit": [robot.force_unit(j) for j in range(robot.joints)],
        "rows": np.asarray(errors.counted).sum(axis=0),
        "mean": errors.mean,
        "rms": errors.rms,
        "mean_percent": errors.mean_percent,
        "rms_percent": errors.rms_percent,
        "rms_relative": errors.rms_relative,
    }
    return {"recording": errors.name, "relative": errors.relative, "joints": _rows(columns)}
