"""The table `[estimator]` becomes an estimator."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.experiment.consistency_tables import BOUNDS, build_consistent
from jaxid.experiment.tables import EstimatorTable, RobotTable
from jaxid.identification.correlated import GeneralisedLeastSquares
from jaxid.identification.estimators import (
    AbstractEstimator,
    LeastSquares,
    WeightedLeastSquares,
)
from jaxid.identification.instruments import InstrumentalVariables
from jaxid.identification.prior import RelativeTo
from jaxid.identification.robust import Huber, IterativelyReweighted, Tukey
from jaxid.identification.solutions import (
    AbstractSolution,
    Complete,
    CrossValidated,
    Ridge,
    Truncated,
)
from jaxid.identification.uncertainty.methods import (
    AbstractUncertainty,
    BlockJackknife,
    IndependentRows,
    SpectralSandwich,
)
from jaxid.identification.weights import AbstractWeights, MaximumForces, ResidualVariances
from jaxid.robot.plausibility import SNAP_TOLERANCE
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import urdf_parameters
from jaxid.trajectory.files import load_trajectory

SOLVED = ("weighted", "least_squares", "huber", "tukey", "correlated")
BELONGS = {
    "weights": ("weighted", "huber", "tukey", "instrumental", "consistent", "stepwise"),
    "ridge": SOLVED,
    "truncate": SOLVED,
    "prior": (*SOLVED, "consistent"),
    "single_axes": ("stepwise",),
    "limit": ("huber", "tukey"),
    "reference": ("instrumental",),
    "reference_start": ("instrumental",),
    "margin": ("consistent",),
    "pull": ("consistent",),
    **dict.fromkeys(BOUNDS, ("consistent",)),
    "essential": ("weighted", "least_squares", "huber", "tukey"),
}
"""The kinds of estimators that know a key; the others refuse it."""


class Chosen(NamedTuple):
    """What the table asks for.

    Attributes:
        estimator: How rows become parameters.
        plain: Least squares with the same weights and solution.
        uncertainty: How standard deviations are found.
        notes: What was assumed, in sentences.
    """

    estimator: AbstractEstimator
    plain: LeastSquares | WeightedLeastSquares
    uncertainty: AbstractUncertainty
    notes: list[str]


def build_estimator(
    table: EstimatorTable, robot: Robot, model: Model, origin: RobotTable, path: Path
) -> Chosen:
    """The estimator, and what is assumed.

    Args:
        table: `[estimator]`.
        robot: Whose parameters are wanted.
        model: The effects.
        origin: `[robot]`: a prior is read from its URDF file.
        path: Of the experiment file: other paths are relative to its folder.

    Raises:
        InputError: If keys do not go together, weights need forces that are not known, or a file
            cannot be read.
    """
    _refuse_foreign_keys(table)
    solution = _solution(table)
    weights, notes = _weights(table, robot)
    plain = (
        LeastSquares(solution)
        if table.kind == "least_squares"
        else WeightedLeastSquares(weights, solution)
    )
    bodies = None
    if table.prior is not None:
        bodies = _prior(table, origin, path)
    match table.kind:
        case "weighted" | "least_squares" | "stepwise":
            estimator = plain
        case "huber":
            loss = Huber() if table.limit is None else Huber(table.limit)
            estimator = IterativelyReweighted(loss, weights, solution)
        case "tukey":
            loss = Tukey() if table.limit is None else Tukey(table.limit)
            estimator = IterativelyReweighted(loss, weights, solution)
        case "correlated":
            estimator = GeneralisedLeastSquares(solution)
        case "instrumental":
            estimator = _instrumental(table, weights, path)
        case "consistent":
            return Chosen(
                build_consistent(table, robot, weights, bodies), plain, _uncertainty(table), notes
            )
    if bodies is not None:
        if table.ridge is None and table.truncate is None:
            raise InputError(
                "`prior` needs `ridge` or `truncate`: without them the logs decide everything."
            )
        estimator = RelativeTo(_standard(model, bodies), estimator)
    return Chosen(estimator, plain, _uncertainty(table), notes)


def _refuse_foreign_keys(table: EstimatorTable) -> None:
    for key, kinds in BELONGS.items():
        if getattr(table, key) is not None and table.kind not in kinds:
            known = " or ".join(f'"{kind}"' for kind in kinds)
            raise InputError(
                f"`{key}` belongs to `kind = {known}`: leave it out, or change `kind`."
            )
    if table.nonlinear_friction:
        if table.kind not in ("weighted", "least_squares"):
            raise InputError(
                f'`nonlinear_friction` does not go with `kind = "{table.kind}"`: choose one.'
            )
        if table.prior is not None or table.uncertainty != "spectral":
            raise InputError(
                "`nonlinear_friction` goes with neither `prior` nor `uncertainty`: leave them out."
            )
    if table.essential is not None:
        others = ("nonlinear_friction", "prior", "ridge", "truncate")
        both = next((key for key in others if getattr(table, key)), None)
        if both is not None:
            raise InputError(f"`essential` does not go with `{both}`: choose one.")


def build_single_axes(table: EstimatorTable, path: Path) -> tuple[Path, ...] | None:
    """Logs of single axes, for identification axis by axis; None where it is at once."""
    if table.kind != "stepwise":
        return None
    return tuple(path.parent / log for log in table.single_axes or ())


def _solution(table: EstimatorTable) -> AbstractSolution:
    if table.truncate is not None and table.ridge is not None:
        raise InputError("give `truncate` or `ridge`, but not both.")
    if table.truncate is not None:
        return Truncated(table.truncate)
    if table.ridge is None:
        return Complete()
    return CrossValidated() if isinstance(table.ridge, str) else Ridge(table.ridge)


def _weights(table: EstimatorTable, robot: Robot) -> tuple[AbstractWeights, list[str]]:
    if table.weights == "residual_variances" or table.kind in ("least_squares", "correlated"):
        return ResidualVariances(), []
    try:
        _ = robot.max_forces
    except ValueError as error:
        if table.weights == "maximum_forces":
            raise InputError(f'`weights = "maximum_forces"`: {error}') from error
        said = (
            "the largest forces of the joints are not known: joints are weighted by the residuals' "
            "variances."
        )
        return ResidualVariances(), [said]
    return MaximumForces(), []


def _uncertainty(table: EstimatorTable) -> AbstractUncertainty:
    match table.uncertainty:
        case "spectral":
            return SpectralSandwich()
        case "jackknife":
            return BlockJackknife()
        case "independent":
            return IndependentRows()


def _prior(table: EstimatorTable, origin: RobotTable, path: Path) -> Float[np.ndarray, "bodies 10"]:
    """What the URDF file claims of the bodies."""
    if origin.urdf is None:
        raise InputError(
            f'`prior = "{table.prior}"` takes the inertias of the robot\'s URDF file, but '
            "`[robot]` names none."
        )
    tolerance = SNAP_TOLERANCE if origin.snap_tolerance is None else origin.snap_tolerance
    found = urdf_parameters(
        path.parent / origin.urdf, tip=origin.tip, base=origin.base, snap_tolerance=tolerance
    )
    return np.asarray(found).reshape(-1, 10)


def _standard(
    model: Model, bodies: Float[np.ndarray, "bodies 10"]
) -> Float[np.ndarray, " standard"]:
    """Standard parameters with these bodies, and zero for all else."""
    p = np.zeros(model.size)
    rigid = next(term for term in model.terms if term.body_parameters)
    first = sum(len(t.parameters(model.robot)) for t in model.terms[: model.terms.index(rigid)])
    own = bodies[:, : rigid.body_parameters].ravel()
    p[first : first + len(own)] = own
    return p


def _instrumental(
    table: EstimatorTable, weights: AbstractWeights, path: Path
) -> InstrumentalVariables:
    if table.reference is None:
        raise InputError(
            '`kind = "instrumental"` needs `reference`: the file of the trajectory that was '
            "commanded, or a list with one for each log."
        )
    names = [table.reference] if isinstance(table.reference, str) else table.reference
    starts = 0.0 if table.reference_start is None else table.reference_start
    return InstrumentalVariables(
        tuple(load_trajectory(path.parent / name) for name in names),
        weights,
        tuple(float(x) for x in (starts if isinstance(starts, list) else [starts])),
    )
