"""What a result file holds: everything that was found, as plain numbers, lists and texts."""

import datetime
import importlib.metadata
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxid.identification.excited import LARGEST_UNCERTAINTY, UndeterminedDirection
from jaxid.identification.fit import Fit
from jaxid.identification.runs.estimates import groups
from jaxid.identification.solutions import AbstractSpectralSolution
from jaxid.measurement.observations import Observations
from jaxid.report.bodies import consistency_content
from jaxid.robot.robot import Robot
from jaxid.validation import Definiteness, TorqueErrors, torque_errors

SCHEMA = "jaxid-result/1"
LEVEL = 0.95
"""Share of cases in which the intervals `low_95` to `high_95` hold the truth, of 1."""
DISTRIBUTION = "jaxid-robotics"


@dataclass(frozen=True)
class Beside:
    """Another way to solve the same equations, to be shown beside a fit.

    Attributes:
        solution: The way.
        errors: What it leaves on the same recordings.
        ways: Names of the fit's own way and of this one; those of the solutions if None.
    """

    solution: AbstractSpectralSolution
    errors: tuple[TorqueErrors, ...]
    ways: tuple[str, str] | None = None

    @classmethod
    def of(
        cls,
        fit: Fit,
        observations: Sequence[Observations],
        ways: tuple[str, str] | None = None,
    ) -> "Beside":
        """Judges another fit on some recordings."""
        return cls(fit.solution, tuple(torque_errors(fit, o) for o in observations), ways)


def plain(value: Any) -> Any:
    """A value as JSON can hold it: arrays become lists, what is no finite number becomes null."""
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


def result(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    settings: Mapping[str, Any],
    notes: Sequence[str],
    beside: Beside | None = None,
) -> dict[str, Any]:
    """Everything that was found, ready for JSON."""
    base, model, robot = fit.base, fit.base.model, fit.base.model.robot
    return plain(
        {
            "schema": SCHEMA,
            "made": {
                "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
                "versions": versions(),
            },
            "robot": _robot(robot),
            "base_parameters": parameters(fit),
            "lengths": base.lengths,
            "model": {
                "terms": [str(term) for term in model.terms],
                "standard_names": model.parameter_names,
                "standard_units": model.parameter_units,
                "independent": base.indices,
                "dependent": base.dependent,
                "kappa": base.kappa,
            },
            "fit": {
                "estimator": str(fit.estimator),
                "solution": str(fit.solution),
                "recordings": fit.recordings,
                "rows": fit.rows,
                "weights": fit.weights,
                "condition_numbers": {
                    "raw": fit.condition_numbers.raw,
                    "weighted": fit.condition_numbers.weighted,
                    "scaled": fit.condition_numbers.scaled,
                },
                "residual": fit.residual,
                "residual_rms": fit.residual_rms,
                "covariance": fit.covariance,
                "naive_covariance": fit.uncertainty.naive_covariance,
                "jackknife_standard_deviations": fit.uncertainty.jackknife,
                "residuals": _residuals(fit),
                "undetermined": [_direction(fit, d) for d in fit.undetermined],
                "undetermined_above": LARGEST_UNCERTAINTY,
            },
            "consistency": consistency_content(fit),
            "errors": {
                "identification": [_errors(e, robot) for e in identification],
                "verification": [_errors(e, robot) for e in verification],
            },
            "mass_matrix": {
                "positive_definite": definiteness.positive_definite,
                "smallest_eigenvalue": definiteness.smallest,
                "pose": definiteness.pose,
                "indefinite_share": definiteness.indefinite,
                "poses": definiteness.poses,
            },
            "beside": beside
            and {
                "way": beside.ways and beside.ways[1],
                "solution": str(beside.solution),
                "errors": [_errors(e, robot) for e in beside.errors],
            },
            "settings": settings,
            "notes": tuple(dict.fromkeys((*robot.notes, *fit.notes, *notes))),
        }
    )


def parameters(fit: Fit) -> list[dict[str, Any]]:
    """The base parameters, one entry for each, in their order."""
    columns = zip(
        fit.base.names,
        fit.base.expressions,
        fit.base.units,
        groups(fit.base),
        np.asarray(fit.parameters).tolist(),
        fit.standard_deviations.tolist(),
        fit.relative_standard_deviations.tolist(),
        *fit.intervals(LEVEL).T.tolist(),
        np.asarray(fit.uncertainty.freedom).tolist(),
        fit.naive_standard_deviations.tolist(),
        fit.uncertainty.ratios.tolist(),
        strict=True,
    )
    keys = (
        *("name", "expression", "unit", "group", "estimate", "standard_deviation", "relative"),
        *("low_95", "high_95", "degrees_of_freedom"),
        *("naive_standard_deviation", "ratio_to_naive"),
    )
    return [dict(zip(keys, row, strict=True)) for row in columns]


def versions() -> dict[str, str]:
    """Of what computed the result."""
    try:
        own = importlib.metadata.version(DISTRIBUTION)
    except importlib.metadata.PackageNotFoundError:
        own = "not installed"
    return {
        "jaxid": own,
        "jax": jax.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }


def _robot(robot: Robot) -> dict[str, Any]:
    limits, drives, tool = robot.limits, robot.drives, robot.tool
    names = ("position_min", "position_max", "velocity", "acceleration", "jerk", "force")
    return {
        "name": robot.name,
        "source": robot.source,
        "joints": [
            {
                "name": name,
                "kind": "revolute" if turns else "prismatic",
                "unit": robot.joint_unit(j),
                "force_unit": robot.force_unit(j),
                "parent": robot.parent[j],
                "axis": robot.axis[j],
                "rotation": robot.rotation[j],
                "offset": robot.offset[j],
                **{key: getattr(limits, key)[j] for key in names},
            }
            for j, (name, turns) in enumerate(zip(robot.joint_names, robot.revolute, strict=True))
        ],
        "gravity": robot.gravity,
        "drives": {
            "reduction": drives.reduction,
            "zero": drives.zero,
            "max_torques": drives.max_torques,
            "rotor_inertia": drives.rotor_inertia,
        },
        "tool": None
        if tool is None
        else {
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


def _residuals(fit: Fit) -> dict[str, Any] | None:
    """Spectra of the residuals, and whether they are white."""
    spectra = fit.residual_spectra
    if spectra is None:
        return None
    return {
        "white": spectra.white,
        "departure": spectra.departure,
        "limit": spectra.limit,
        "slow_share": spectra.slow,
        "band": spectra.band,
        "frequency": spectra.frequency,
        "density": spectra.density,
        "filter_gain": spectra.gain,
    }


def _direction(fit: Fit, direction: UndeterminedDirection) -> dict[str, Any]:
    return {
        "sentence": direction.sentence(fit.base),
        "parameters": [fit.base.names[k] for k in direction.parts],
        "shares": direction.shares,
        "singular_value": direction.singular_value,
        "uncertainty": direction.uncertainty,
    }


def _errors(errors: TorqueErrors, robot: Robot) -> dict[str, Any]:
    columns = {
        "rows": np.asarray(errors.counted).sum(axis=0),
        "mean": errors.mean,
        "rms": errors.rms,
        "mean_percent": errors.mean_percent,
        "rms_percent": errors.rms_percent,
        "rms_relative": errors.rms_relative,
    }
    return {
        "recording": errors.name,
        "relative": errors.relative,
        "joints": [
            {
                "name": name,
                "unit": robot.force_unit(j),
                **{key: values[j] for key, values in columns.items()},
            }
            for j, name in enumerate(robot.joint_names)
        ],
    }
