"""The table `[estimator]` of an experiment file: how rows become parameters.

Each `kind` takes the keys of the functions and classes that `KINDS` lists for it.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.experiment.decoder import (
    Bounds,
    Fraction,
    Positive,
    decode,
    keys_of,
    quoted,
    within,
)
from jaxid.experiment.method_tables import pop_kind
from jaxid.experiment.robot_tables import RobotSource
from jaxid.identification.consistency import BodyBounds, EntropicPull, PhysicallyConsistent
from jaxid.identification.estimators import (
    AbstractEstimator,
    AbstractSolution,
    AbstractWeights,
    Complete,
    CrossValidated,
    GeneralisedLeastSquares,
    Huber,
    InstrumentalVariables,
    IterativelyReweighted,
    LeastSquares,
    MaximumForces,
    RelativeTo,
    ResidualVariances,
    Ridge,
    Truncated,
    Tukey,
    WeightedLeastSquares,
)
from jaxid.identification.uncertainty import (
    AbstractUncertainty,
    BlockJackknife,
    IndependentRows,
    SpectralSandwich,
)
from jaxid.robot.robot import Robot
from jaxid.trajectory.files import load_trajectory

Bodies = Float[np.ndarray, "bodies 10"] | None


class Estimation(NamedTuple):
    """Choice of how rows become parameters.

    Attributes:
        estimator: Estimator of the file.
        plain: Least squares with the same weights and solution.
        uncertainty: Method of the standard deviations.
        essential: Held-out error that leaving out parameters may cost (fraction); None to keep all.
        nonlinear: Whether the shape of friction is sought too.
        regularised: Whether the estimator keeps small what the logs do not decide.
        notes: Assumptions, in sentences.
    """

    estimator: AbstractEstimator
    plain: LeastSquares | WeightedLeastSquares
    uncertainty: AbstractUncertainty
    essential: float | None
    nonlinear: bool
    regularised: bool
    notes: list[str]


def choose_uncertainty(
    *, uncertainty: Literal["spectral", "jackknife", "independent"] = "spectral"
) -> AbstractUncertainty:
    """Return the method of the standard deviations.

    Args:
        uncertainty: Method of the standard deviations: "spectral"; "jackknife": from blocks of time
            left out in turn; "independent": as if rows were independent, far too small.
    """
    methods = {
        "spectral": SpectralSandwich,
        "jackknife": BlockJackknife,
        "independent": IndependentRows,
    }
    return methods[uncertainty]()


def choose_weights(
    robot: Robot, *, weights: Literal["maximum_forces", "residual_variances"] | None = None
) -> tuple[AbstractWeights, list[str]]:
    """Return the weights of the joints, and what is assumed.

    Args:
        robot: Robot with the joints.
        weights: Weights of the joints: "maximum_forces" (Eq. 30), the default where they are known;
            or "residual_variances": what the model leaves unexplained.

    Raises:
        InputError: If the weights need forces that are not known.
    """
    if weights == "residual_variances":
        return ResidualVariances(), []
    try:
        _ = robot.max_forces
    except InputError as error:
        if weights is not None:
            raise InputError(f'`weights = "maximum_forces"`: {error}') from error
        note = (
            "the largest forces of the joints are not known: joints are weighted by the residuals' "
            "variances."
        )
        return ResidualVariances(), [note]
    return MaximumForces(), []


def choose_solution(
    *,
    ridge: Fraction | Literal["cross_validated"] | None = None,
    truncate: Fraction | None = None,
) -> AbstractSolution:
    """Return the solution of the normal equations.

    Args:
        ridge: Strength of a pull of undetermined combinations towards zero, relative to the
            best-determined one, like `"cross_validated"`: as much as predicts left-out parts of the
            logs best; or a number like 0.01.
        truncate: Singular value below which directions are left out, relative to the largest, like
            `0.01`.

    Raises:
        InputError: If both are given.
    """
    if truncate is not None and ridge is not None:
        raise InputError("give `truncate` or `ridge`, but not both.")
    if truncate is not None:
        return Truncated(truncate)
    if ridge is None:
        return Complete()
    return CrossValidated() if isinstance(ridge, str) else Ridge(ridge)


def read_prior(
    source: RobotSource, folder: Path, *, prior: Literal["urdf"] | None = None
) -> Bodies:
    """Return the bodies' parameters of a prior; None without one.

    Args:
        source: Source of the robot.
        folder: Folder of the experiment file.
        prior: Prior of what the logs do not determine: "urdf" takes the inertias of the URDF file;
            with `ridge`, `truncate` or `kind = "consistent"`.

    Raises:
        InputError: If there is no URDF file.
    """
    if prior is None:
        return None
    bodies = source.parameters(folder)
    if bodies is None:
        raise InputError('`prior = "urdf"` needs a robot with `robot.urdf`.')
    return bodies


def choose_parameters(
    *, essential: Annotated[float, Bounds(least=0.0, below=1.0)] | None = None
) -> float | None:
    """Return the price of leaving parameters out.

    Args:
        essential: Held-out error that leaving out parameters may cost in all (fraction), like
            `0.02`: keeps only parameters without which unseen data are predicted worse.
    """
    return essential


def choose_friction(*, nonlinear_friction: bool = False) -> bool:
    """Return whether the shape of friction is sought.

    Args:
        nonlinear_friction: Whether to find `epsilon` and `stribeck` of each joint too, and to keep
            them if they predict unseen parts of the logs better.
    """
    return nonlinear_friction


def read_references(
    folder: Path,
    *,
    reference: str | list[str],
    reference_start: float | list[float] = 0.0,
) -> tuple[tuple[Any, ...], tuple[float, ...]]:
    """Return commanded motions, and when they began.

    Args:
        folder: Folder of the experiment file.
        reference: File of the commanded motion, like `"trajectory.json"`; or a list with one for
            each log.
        reference_start: Time stamp at which it began [s]; or a list.
    """
    names = [reference] if isinstance(reference, str) else reference
    starts = reference_start if isinstance(reference_start, list) else [reference_start]
    return tuple(load_trajectory(folder / name) for name in names), tuple(starts)


def choose_pull(
    *, margin: Fraction | None = None, pull: Positive | None = None
) -> tuple[float, float | None]:
    """Return the margin of consistent bodies, and the strength of their pull.

    Args:
        margin: Fraction of a ball that each body contains, like `0.01`.
        pull: Strength of a pull towards the prior, or towards balls, like `1.0`.
    """
    return margin or 0.0, pull


SOLUTION = (choose_solution, read_prior)
KINDS: dict[str, tuple[str, tuple[Callable, ...]]] = {
    "weighted": (
        "weighted least squares",
        (choose_weights, *SOLUTION, choose_parameters, choose_friction),
    ),
    "least_squares": (
        "every newton metre counts the same",
        (*SOLUTION, choose_parameters, choose_friction),
    ),
    "huber": (
        "rows that the model cannot explain count less",
        (choose_weights, *SOLUTION, choose_parameters, Huber),
    ),
    "tukey": (
        "rows that the model cannot explain do not count",
        (choose_weights, *SOLUTION, choose_parameters, Tukey),
    ),
    "correlated": ("for residuals that joints have in common", SOLUTION),
    "instrumental": ("for noisy angles", (choose_weights, read_references)),
    "consistent": (
        "complete bodies that can exist",
        (choose_weights, read_prior, choose_pull, BodyBounds),
    ),
}
"""Purpose of each kind, and functions and classes whose arguments are its keys."""


def build_estimation(
    table: Any, robot: Robot, model: Model, source: RobotSource, folder: Path
) -> Estimation:
    """Return the estimator of an experiment file, and what is assumed.

    Args:
        table: The table `[estimator]`.
        robot: Robot whose parameters are wanted.
        model: Model with the effects.
        source: Source of the robot, for a prior.
        folder: Folder of the experiment file.

    Raises:
        InputError: If keys do not go together, or a file cannot be read.
    """
    kind, rest = pop_kind(table, "estimator", list(KINDS), "weighted")
    functions = (choose_uncertainty, *KINDS[kind][1])
    parts = decode(
        functions, rest, "estimator", complete=kind != "consistent", others=_belongs(kind)
    )
    given = dict(zip(functions, parts, strict=True))
    with within("estimator"):
        _refuse_pairs(given)
        weights, notes = _weights(kind, robot, given.get(choose_weights, {}))
        solution = choose_solution(**given.get(choose_solution, {}))
        plain = (
            LeastSquares(solution)
            if kind == "least_squares"
            else WeightedLeastSquares(weights, solution)
        )
        bodies = read_prior(source, folder, **given.get(read_prior, {}))
        estimator = _estimator(kind, given, robot, folder, plain, bodies)
        if bodies is not None and kind != "consistent":
            if isinstance(solution, Complete):
                raise InputError(
                    "`prior` needs `ridge` or `truncate`: without them the logs decide everything."
                )
            estimator = RelativeTo(_standard_parameters(model, bodies), estimator)
        return Estimation(
            estimator,
            plain,
            choose_uncertainty(**given[choose_uncertainty]),
            given.get(choose_parameters, {}).get("essential"),
            choose_friction(**given.get(choose_friction, {})),
            not isinstance(solution, Complete),
            notes,
        )


def _belongs(kind: str) -> dict[str, str]:
    """Return a sentence for each key that only other kinds know."""
    kinds: dict[str, list[str]] = {}
    for other, (_, functions) in KINDS.items():
        for name in _names(functions):
            kinds.setdefault(name, []).append(other)
    own = _names((choose_uncertainty, *KINDS[kind][1]))
    return {
        name: f"belongs to `kind = {quoted(owners)}`: leave it out, or change `kind`."
        for name, owners in kinds.items()
        if name not in own
    }


def _names(functions: tuple[Callable, ...]) -> set[str]:
    return {name for function in functions for name in keys_of(function)}


def _refuse_pairs(given: dict[Callable, dict[str, Any]]) -> None:
    """Reject keys that do not go together."""
    alone = {
        "nonlinear_friction": ("prior", "uncertainty", "essential"),
        "essential": ("prior", "ridge", "truncate"),
    }
    defaults = {name: key.default for f in given for name, key in keys_of(f).items()}
    values = {name: value for part in given.values() for name, value in part.items()}
    for key, others in alone.items():
        both = [o for o in others if o in values and values[o] != defaults[o]]
        if values.get(key) and both:
            raise InputError(f"`{key}` does not go with `{both[0]}`: choose one.")


def _weights(
    kind: str, robot: Robot, arguments: dict[str, Any]
) -> tuple[AbstractWeights, list[str]]:
    if kind in ("least_squares", "correlated"):
        return ResidualVariances(), []
    return choose_weights(robot, **arguments)


def _estimator(
    kind: str,
    given: dict[Callable, dict[str, Any]],
    robot: Robot,
    folder: Path,
    plain: LeastSquares | WeightedLeastSquares,
    bodies: Bodies,
) -> AbstractEstimator:
    weights = getattr(plain, "weights", ResidualVariances())
    match kind:
        case "huber":
            return IterativelyReweighted(Huber(**given[Huber]), weights, plain.solution)
        case "tukey":
            return IterativelyReweighted(Tukey(**given[Tukey]), weights, plain.solution)
        case "correlated":
            return GeneralisedLeastSquares(plain.solution)
        case "instrumental":
            references, starts = read_references(folder, **given[read_references])
            return InstrumentalVariables(references, weights, starts)
        case "consistent":
            margin, strength = choose_pull(**given[choose_pull])
            pull = None
            if strength is not None or bodies is not None:
                pull = EntropicPull(bodies, 1.0 if strength is None else strength)
            return PhysicallyConsistent(weights, _bounds(robot, given[BodyBounds]), margin, pull)
    return plain


def _bounds(robot: Robot, given: dict[str, Any]) -> BodyBounds | None:
    """Return the bounds from the robot's geometry, with those of the file in their places."""
    if "ellipsoid_centre" in given and "ellipsoid_axes" not in given:
        raise InputError("`ellipsoid_centre` needs `ellipsoid_axes`: the half axes [m].")
    return BodyBounds.from_geometry(robot).replace(**given) if given else None


def _standard_parameters(
    model: Model, bodies: Float[np.ndarray, "bodies 10"]
) -> Float[np.ndarray, " standard"]:
    """Return standard parameters with these bodies, and zero for all else."""
    p = np.zeros(model.size)
    rigid = next(term for term in model.terms if term.body_parameters)
    first = sum(len(t.parameters(model.robot)) for t in model.terms[: model.terms.index(rigid)])
    values = bodies[:, : rigid.body_parameters].ravel()
    p[first : first + len(values)] = values
    return p
