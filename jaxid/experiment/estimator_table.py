"""The table `[estimator]` of an experiment file: how rows become parameters."""

import inspect
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.identification import estimators
from jaxid.identification.consistency import (
    BodyBounds,
    EntropicPull,
    consistency_margin,
)
from jaxid.identification.estimators.regularisation_and_weights import default_weights
from jaxid.identification.estimators_by_name import ESTIMATORS, LOSSES
from jaxid.identification.uncertainty import UNCERTAINTIES, AbstractUncertainty
from jaxid.trajectory.files import load_trajectory

from .decoder import Bounds, Fraction, Magnitude, OneOf, decode, keys_of, quoted
from .robot_tables import RobotSource, named

SOLUTION = ("ridge", "truncate", "prior")
KEYS_OF_SETTINGS: dict[str, tuple[str, ...]] = {
    "weights": ("weights",),
    "solution": SOLUTION,
    "loss": ("limit",),
    "references": ("reference",),
    "starts": ("reference_start",),
    "bounds": tuple(keys_of(BodyBounds)),
    "margin": ("margin",),
    "pull": ("prior", "pull"),
}
"""Keys from which each setting of an estimator is made."""
KINDS_OF_KEYS = {
    "essential": ("weighted", "least_squares", "huber", "tukey"),
    "nonlinear_friction": ("weighted", "least_squares"),
}
"""Kinds of estimators with which a method that repeats the estimate goes together."""


def keys_of_kind(kind: str) -> tuple[str, ...]:
    """Return the keys of one kind of estimator, apart from those of all kinds."""
    settings = inspect.signature(ESTIMATORS[kind]).parameters
    keys = [key for name in settings for key in KEYS_OF_SETTINGS.get(name, ())]
    methods = [key for key, kinds in KINDS_OF_KEYS.items() if kind in kinds]
    return (*keys, *methods)


KINDS = {kind: keys_of_kind(kind) for kind in ESTIMATORS}
"""Keys of each kind of estimator; others are for all kinds."""
ALTERNATIVES = (
    ("nonlinear_friction", ("prior", "uncertainty", "essential")),
    ("essential", SOLUTION),
    ("truncate", ("ridge",)),
)
"""Keys that do not go together with others."""


class Estimation(NamedTuple):
    """Choice of how rows become parameters."""

    estimator: estimators.AbstractEstimator  # estimator of the file
    # least squares with the same weights and solution
    plain: estimators.LeastSquares | estimators.WeightedLeastSquares
    uncertainty: AbstractUncertainty  # method of the standard deviations
    # held-out error that leaving out parameters may cost (fraction); None to keep all
    essential: float | None
    nonlinear: bool  # whether the shape of friction is sought too
    notes: tuple[str, ...]  # assumptions, in sentences


def decode_estimator(table: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the arguments of `build_estimation`, and the bounds of bodies.

    Raises:
        InputError: If a key is wrong, belongs to another kind, or does not go with
            another one.
    """
    given, bounds = decode(
        [build_estimation, BodyBounds], table, "estimator", complete=False
    )
    owners = [KINDS["weighted"], KINDS["consistent"]]
    if not any(name in owners[0] and name not in owners[1] for name in given):
        kind = given.get("kind", "consistent")
    else:
        kind = given.setdefault("kind", "weighted")
    for name in (*given, *bounds):
        owners = [owner for owner, keys in KINDS.items() if name in keys]
        if owners and kind not in owners:
            raise InputError(
                f"`estimator.{name}`: belongs to `kind = {quoted(owners)}`."
            )
    defaults = {name: key.default for name, key in keys_of(build_estimation).items()}
    changed = {
        name for name, value in given.items() if value and value != defaults[name]
    }
    for name, others in ALTERNATIVES:
        if both := [other for other in others if {name, other} <= changed]:
            raise InputError(
                f"`estimator`: `{name}` does not go with `{both[0]}`: choose one."
            )
    return given, bounds


def build_estimation(
    model: Model,
    source: RobotSource,
    folder: Path,
    bounds: dict[str, Any],
    *,
    kind: Annotated[str, OneOf(ESTIMATORS)] = "consistent",
    weights: Literal["maximum_forces", "residual_variances"] | None = None,
    ridge: Fraction | Literal["cross_validated"] | None = None,
    truncate: Fraction | None = None,
    prior: Literal["urdf", "mjcf"] | None = None,
    essential: Annotated[float, Bounds(least=0.0, below=1.0)] | None = None,
    nonlinear_friction: bool = False,
    uncertainty: Annotated[str, OneOf(UNCERTAINTIES)] = "spectral",
    limit: float | None = None,
    reference: str | list[str] | None = None,
    reference_start: float | list[float] = 0.0,
    margin: Fraction | None = None,
    pull: Magnitude = 1.0,
) -> Estimation:
    """Estimator of the parameters from the rows, and of their standard deviations.

    Args:
        model: Model with the effects whose parameters are wanted.
        source: Source of the robot, for a prior.
        folder: Folder of the experiment file.
        bounds: Bounds of bodies, in place of those from the robot's geometry.
        kind: "consistent": weighted least squares over bodies that can exist;
            "weighted": without that; "least_squares": every newton metre counts the
            same; "huber", "tukey": rows that the model cannot explain count less, or
            not at all; "instrumental": for noisy angles. Without it, what the other keys belong to.
        weights: Weights of the joints: "maximum_forces" (Eq. 30), the default where
            they are known; or "residual_variances": what the model leaves unexplained.
        ridge: Strength of a pull of undetermined combinations towards zero, relative to
            the best-determined one, like `"cross_validated"`: as much as predicts
            left-out parts of the logs best; or a number like 0.01.
        truncate: Singular value below which directions are left out, relative to the
            largest, like `0.01`.
        prior: Prior of what the logs do not determine: "urdf" or "mjcf" takes the
            inertias of the robot's file; with `ridge`, `truncate` or `kind =
            "consistent"`, which takes them by itself if such bodies can exist.
        essential: Held-out error that leaving out parameters may cost in all
            (fraction), like `0.02`: keeps only parameters without which unseen data are
            predicted worse.
        nonlinear_friction: Whether to find `epsilon` and `stribeck` of each joint too,
            and to keep them if they predict unseen parts of the logs better.
        uncertainty: Method of the standard deviations: "spectral"; "jackknife": from
            blocks of time left out in turn; "independent": as if rows were independent,
            far too small.
        limit: Standard deviations up to which a residual counts fully ("huber"), or
            from which it does not count ("tukey"), like `4.0`.
        reference: File of the commanded motion ("instrumental"), like
            `"trajectory.json"`; or a list with one for each log.
        reference_start: Time stamp at which it began [s], like `0.0`; or a list.
        margin: Fraction of a ball that each body contains ("consistent"), like `0.01`.
        pull: Strength of a pull towards the prior, or towards balls ("consistent"); 0
            for none.

    Raises:
        InputError: If keys do not go together, or a file cannot be read.
    """
    robot = model.robot
    joint_weights, notes = default_weights(robot)
    if weights == "residual_variances" or kind == "least_squares":
        joint_weights, notes = estimators.ResidualVariances(), ()
    elif weights == "maximum_forces":
        try:
            _ = robot.max_forces
        except InputError as error:
            raise InputError(f'`weights = "maximum_forces"`: {error}') from error
    solution: estimators.AbstractSolution = estimators.Complete()
    if truncate is not None:
        solution = estimators.Truncated(truncate)
    elif ridge == "cross_validated":
        solution = estimators.CrossValidated()
    elif ridge is not None:
        solution = estimators.Ridge(ridge)
    plain = estimators.WeightedLeastSquares(joint_weights, solution)
    bodies = None if prior is None else source.parameters(folder)
    if prior is not None and bodies is None:
        raise InputError("`prior` needs a robot with `robot.urdf` or `robot.mjcf`.")
    settings: dict[str, Any] = {"weights": joint_weights, "solution": solution}
    match kind:
        case "least_squares":
            plain = estimators.LeastSquares(solution)
        case "huber" | "tukey" if limit is not None:
            settings["loss"] = LOSSES[kind](limit)
        case "instrumental":
            if reference is None:
                raise InputError(
                    '`reference` is missing: `kind = "instrumental"` needs it.'
                )
            files = [reference] if isinstance(reference, str) else reference
            one_start = not isinstance(reference_start, list)
            starts = [reference_start] if one_start else reference_start
            settings["references"] = tuple(load_trajectory(folder / x) for x in files)
            settings["starts"] = tuple(starts)
        case "consistent":
            if bodies is None:
                bodies = _possible_bodies(source, folder)
            if "ellipsoid_centre" in bounds and "ellipsoid_axes" not in bounds:
                raise InputError(
                    "`ellipsoid_centre` needs `ellipsoid_axes`: the half axes [m]."
                )
            if bounds:
                settings["bounds"] = BodyBounds.from_geometry(robot).replace(**bounds)
            settings["margin"] = margin or 0.0
            settings["pull"] = EntropicPull(bodies, pull) if pull else None
            settings["throw"] = False
    build = ESTIMATORS[kind]
    fitting = {
        k: settings[k] for k in inspect.signature(build).parameters if k in settings
    }
    estimator = build(**fitting)
    if bodies is not None and kind != "consistent":
        if isinstance(solution, estimators.Complete):
            raise InputError(
                "`prior` needs `ridge` or `truncate`: without them the logs decide "
                "everything."
            )
        known = named(bodies)
        p = np.array([known.get(name, 0.0) for name in model.parameter_names])
        estimator = estimators.RelativeTo(p, estimator)
    method = UNCERTAINTIES[uncertainty]()
    return Estimation(estimator, plain, method, essential, nonlinear_friction, notes)


def _possible_bodies(
    source: RobotSource, folder: Path
) -> Float[np.ndarray, "bodies 10"] | None:
    """Return the bodies of the URDF file if all of them can exist, as those of a robot do."""
    try:
        bodies = source.parameters(folder)
    except InputError:
        return None
    if bodies is None or not (consistency_margin(bodies) > 0.0).all():
        return None
    return bodies
