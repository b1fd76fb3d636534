"""One body that could exist, from ten numbers and what is known of their errors: a payload."""

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.interior_point import Outcome, solve_at_once
from jaxid.identification.consistency.possible import PossibleParameters
from jaxid.identification.consistency.program import program_of


class ConsistentBody(eqx.Module):
    """A body that could exist.

    Attributes:
        parameters: The parameters $(m, m r_c, A, B, C, D, E, F)$ about the body's origin.
        distance: From the estimate, in units of its standard deviations: below 4 nothing unusual.
        error_bound: Bound of half the squared distance to the optimum's.
        outcome: How the search ended.
    """

    parameters: Float[np.ndarray, "10"]
    distance: float
    error_bound: float
    outcome: Outcome = eqx.field(static=True)


def consistent_body(
    estimate: Float[AnyArray, "10"],
    covariance: Float[AnyArray, "10 10"],
    bounds: BodyBounds,
    *,
    throw: bool = True,
) -> ConsistentBody:
    """The body that could exist which is closest to an estimate, in the metric of its covariance.

    Args:
        estimate: Parameters $(m, m r_c, A, B, C, D, E, F)$ as they were found.
        covariance: Of their errors; positive definite.
        bounds: Of one body: `BodyBounds.of(1, mass_max=..., radius=...)`.
        throw: Whether an optimum without proof is an error.

    Raises:
        InputError: If the covariance is not positive definite, or the bounds are not of one body.
        RuntimeError: If the optimum was not proved and `throw` is set.
    """
    if len(bounds.radius) != 1:
        raise InputError(f"`bounds` must be those of one body, but are of {len(bounds.radius)}.")
    C = np.asarray(covariance, np.float64)
    size = np.sqrt(np.abs(np.diag(C)))
    size = np.where(size > 0, size, 1.0)
    try:
        L = np.linalg.cholesky(C / size[:, None] / size)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "`covariance` must be positive definite, but is not: is some parameter not determined?"
        ) from error
    A = np.linalg.inv(L) / size
    b = A @ np.asarray(estimate, np.float64)
    possible = PossibleParameters(
        bodies=(tuple(range(10)),),
        drives=(),
        free=(),
        bounds=bounds,
        floors=np.zeros((1, 4, 4)),
        couplings=(),
        size=10,
    )
    program = program_of(np, possible, A, b, np.float64(len(b)))
    program.require_interior()
    optimum = solve_at_once(program)
    outcome = Outcome.CERTIFIED if bool(optimum.certified) else Outcome.STALLED
    if throw and outcome is not Outcome.CERTIFIED:
        raise RuntimeError(f"no consistent body with a proof: {outcome.value}")
    return ConsistentBody(
        possible.standard(np, A, b, optimum.y),
        float(np.sqrt(2.0 * optimum.value)),
        float(optimum.error),
        outcome,
    )
