"""The table `[estimator]` of an experiment file: how rows become parameters."""

import inspect
from typing import Annotated, Literal, NamedTuple

from jaxid.errors import InputError
from jaxid.identification import estimators
from jaxid.identification.consistency import BodyBounds
from jaxid.identification.estimators.regularisation_and_weights import (
    DefaultWeights,
    default_weights,
)
from jaxid.identification.estimators_by_name import ESTIMATORS
from jaxid.identification.uncertainty import UNCERTAINTIES, AbstractUncertainty
from jaxid.robot.robot import Robot
from jaxid.workflow.allowed_values import (
    Fraction,
    Magnitude,
    OneOf,
    quoted,
)
from jaxid.workflow.robot_file import RobotFile
from jaxid.workflow.setup import pull_to_bodies

from .decoder import TomlTable, decode, keys_of, within

KEYS_OF_SETTINGS: dict[str, tuple[str, ...]] = {
    "weights": ("weights",),
    "solution": ("ridge",),
    "bounds": tuple(keys_of(BodyBounds)),
    "pull": ("pull",),
}
"""Keys from which each setting of an estimator is made."""


def keys_of_kind(kind: str) -> tuple[str, ...]:
    """Return the keys of one kind of estimator, apart from those of all kinds."""
    settings = inspect.signature(ESTIMATORS[kind]).parameters
    keys = [key for name in settings for key in KEYS_OF_SETTINGS.get(name, ())]
    if kind in ("weighted", "least_squares"):
        keys.append("nonlinear_friction")
    return tuple(keys)


# Instrumental variables need a motion, which a file cannot hold.
KINDS = {kind: keys_of_kind(kind) for kind in ESTIMATORS if kind != "instrumental"}
"""Keys of each kind of estimator; others are for all kinds."""


class Estimation(NamedTuple):
    """Choice of how rows become parameters."""

    estimator: estimators.AbstractEstimator  # estimator of the file
    # least squares with the same weights and solution
    least_squares: estimators.LeastSquares | estimators.WeightedLeastSquares
    uncertainty: AbstractUncertainty  # method of the standard deviations
    nonlinear_friction: bool  # whether the shape of friction is sought too
    notes: tuple[str, ...]  # assumptions, in sentences


def decode_estimator(table: TomlTable) -> tuple[TomlTable, TomlTable]:
    """Return the arguments of `build_estimation`, and the bounds of bodies.

    Raises:
        InputError: If a key is wrong, belongs to another kind, or does not go with
            another one.
    """
    arguments, bounds = decode(
        [build_estimation, BodyBounds], table, "estimator", complete=False
    )
    weighted_keys = set(KINDS["weighted"]) - set(KINDS["consistent"])
    if weighted_keys & arguments.keys():
        arguments.setdefault("kind", "weighted")
    kind = arguments.get("kind", "consistent")
    for name in (*arguments, *bounds):
        owners = [owner for owner, keys in KINDS.items() if name in keys]
        if owners and kind not in owners:
            raise InputError(
                f"`estimator.{name}`: belongs to `kind = {quoted(owners)}`."
            )
    has_other_uncertainty = arguments.get("uncertainty", "spectral") != "spectral"
    if has_other_uncertainty and arguments.get("nonlinear_friction"):
        raise InputError(
            "`estimator`: `nonlinear_friction` "
            "does not go with `uncertainty`: choose one."
        )
    return arguments, bounds


def build_estimation(
    robot: Robot,
    robot_file: RobotFile | None,
    bounds: TomlTable,
    *,
    kind: Annotated[str, OneOf(KINDS)] = "consistent",
    weights: Literal["maximum_forces", "residual_variances"] | None = None,
    ridge: Fraction | Literal["cross_validated"] | None = None,
    nonlinear_friction: bool = False,
    uncertainty: Annotated[str, OneOf(UNCERTAINTIES)] = "spectral",
    pull: Magnitude = 1.0,
) -> Estimation:
    """Estimator of the parameters from the rows, and of their standard deviations.

    Args:
        robot: The robot.
        robot_file: File of the robot, whose bodies are the prior of consistent ones.
        bounds: Bounds of bodies, in place of those from the robot's geometry.
        kind: "consistent": weighted least squares over bodies that can exist;
            "weighted": without that; "least_squares": every newton metre counts the
            same; "huber", "tukey": rows that the model cannot explain count less, or
            not at all. Without it, what the other keys belong to.
        weights: Weights of the joints: "maximum_forces" (Eq. 30), the default where
            they are known; or "residual_variances": what the model leaves unexplained.
        ridge: Strength of a pull of undetermined combinations towards zero, relative to
            the best-determined one, like `"cross_validated"`: as much as predicts
            left-out parts of the logs best; or a number like 0.01.
        nonlinear_friction: Whether to find `epsilon` and `stribeck` of each joint too,
            and to keep them if they predict unseen parts of the logs better.
        uncertainty: Method of the standard deviations: "spectral"; "jackknife": from
            blocks of time left out in turn; "independent": as if rows were independent,
            far too small.
        pull: Strength of a pull towards the bodies of the robot's file, or towards
            balls if those cannot exist ("consistent"); 0 for none.

    Raises:
        InputError: If keys do not go together, or a file cannot be read.
    """
    joint_weights, notes = default_weights(robot)
    if weights == "residual_variances" or kind == "least_squares":
        joint_weights, notes = DefaultWeights(estimators.ResidualVariances(), ())
    elif weights == "maximum_forces":
        with within('weights = "maximum_forces"'):
            _ = robot.max_forces
    solution = build_solution(ridge)
    least_squares = estimators.WeightedLeastSquares(joint_weights, solution)
    settings: TomlTable = {"weights": joint_weights, "solution": solution}
    if kind == "least_squares":
        least_squares = estimators.LeastSquares(solution)
    if kind == "consistent":
        if bounds:
            settings["bounds"] = BodyBounds.from_geometry(robot).replace(**bounds)
        settings["pull"] = pull_to_bodies(robot_file, pull)
    build = ESTIMATORS[kind]
    names = inspect.signature(build).parameters.keys() & settings.keys()
    estimator = build(**{name: settings[name] for name in names})
    return Estimation(
        estimator,
        least_squares,
        UNCERTAINTIES[uncertainty](),
        nonlinear_friction,
        notes,
    )


def build_solution(
    ridge: float | Literal["cross_validated"] | None,
) -> estimators.AbstractSolution:
    """Return how undetermined combinations are treated."""
    if ridge == "cross_validated":
        return estimators.CrossValidated()
    if ridge is not None:
        return estimators.Ridge(ridge)
    return estimators.Complete()
