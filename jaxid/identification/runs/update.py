"""A later fit added to an earlier one without the earlier data."""

import dataclasses

import numpy as np

from jaxid.identification.estimators import GivenWeights, WeightedLeastSquares
from jaxid.identification.factors import Blocks
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.runs.estimates import with_covariance
from jaxid.identification.runs.least_squares import (
    least_squares_of,
    require_same_base,
    weighted_like,
)
from jaxid.identification.runs.tied import tied


def update(earlier: Fit, later: Fit, name: str | None = None) -> Fit:
    """Add a later fit to an earlier one, as if both had been identified together.

    The estimates are those of the joint fit to rounding, and only factors are needed: the earlier
    fit may come from a file. If the fits' weights differ, each keeps its own.

    Args:
        earlier: Fit of the earlier recordings.
        later: Fit of later recordings of the robot in the same state.
        name: Name of both together; by default their names in a row.

    Raises:
        InputError: If the fits have different base parameters, or have seen the same data.
    """
    require_same_base((earlier, later))
    earlier, later = least_squares_of(earlier), least_squares_of(later)
    E = np.eye(earlier.base.size)
    joint = tied((earlier, later), (E, E))
    both = (earlier, weighted_like(later, earlier.weights))
    parts = [part for fit in both if fit.blocks is not None for part in fit.blocks.parts]
    names = (*earlier.recordings, *later.recordings)
    problem = RegressionProblem(earlier.base, blocks=Blocks(tuple(parts)), names=names)
    estimator = WeightedLeastSquares(GivenWeights(np.asarray(earlier.weights)))
    fit = fit_problem(problem, estimator)
    fit = with_covariance(fit, joint.parameters, joint.covariance, joint.freedom)
    name = f"{earlier.name}, {later.name}" if name is None else name
    return dataclasses.replace(fit, name=name)
