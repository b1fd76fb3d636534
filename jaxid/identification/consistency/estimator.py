"""Physically consistent estimation: parameters of bodies that can exist."""

import dataclasses
import enum
from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.errors import InputError
from jaxid.identification.consistency import solver
from jaxid.identification.consistency.bounds import BodyBounds, EntropicPull, ParameterPrior
from jaxid.identification.consistency.cone_program import ConeProgram, cone_program
from jaxid.identification.consistency.feasible_set import (
    FeasibleSet,
    ScaledRows,
    feasible_set,
    nominal_bodies,
    scaled_rows,
)
from jaxid.identification.consistency.pseudo_inertia import Values, consistency_margin
from jaxid.identification.estimators import (
    AbstractEstimator,
    AbstractWeights,
    Complete,
    Estimate,
    MaximumForces,
)


class Outcome(enum.Enum):
    """Outcomes of the search for the optimum."""

    CERTIFIED = "the optimum was found, with a proof of its error bound."
    STALLED = (
        "rounding kept the error bound from falling below its tolerance: the data are scaled "
        "badly, or bounds nearly contradict each other; widen the bounds, or pass `throw=False` "
        "to accept the estimate with its error bound."
    )
    ITERATIONS = (
        "the iterations did not suffice for the error bound to fall below its tolerance; pass "
        "`throw=False` to accept the estimate with its error bound."
    )


class Consistency(eqx.Module):
    """Properties of a physically consistent estimate.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of all bodies.
        margins: Distances of the bodies from the boundary of physical consistency (0 to 1).
        bounds: Bounds of the bodies.
        residual_increase: Relative increase of the norm of the weighted residuals by the bounds.
        error_bound: Bound of the objective's relative distance to the optimum.
        outcome: Outcome of the search.
        iterations: Number of iterations of the search.
        determined: Standard parameters that the data determine alone, without the bounds.
        active: Names of the active bounds.
    """

    bodies: Float[AnyArray, "bodies 10"]
    margins: Float[AnyArray, " bodies"]
    bounds: BodyBounds
    residual_increase: float
    error_bound: float
    outcome: Outcome = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    determined: Bool[np.ndarray, " standard"]
    active: tuple[str, ...] = eqx.field(static=True)

    @property
    def masses_from_bounds(self) -> tuple[int, ...]:
        """Bodies (0 is the first) whose masses reflect bounds or priors rather than data."""
        width = self.bodies.shape[1]
        return tuple(k for k in range(len(self.bodies)) if not self.determined[k * width])

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences about the effect of the bounds on residuals and parameters."""
        percent = 100 * self.residual_increase
        found = [f"the weighted residuals are {percent:.2g} % larger than without bounds."]
        if self.masses_from_bounds:
            names = ", ".join(f"m{k + 1}" for k in self.masses_from_bounds)
            found.append(
                f"forces do not determine the masses {names} alone: their values, and parameters "
                "that depend on them, reflect the bounds; base parameters and forces do not."
            )
        if self.active:
            found.append(f"active bounds: {'; '.join(self.active)}.")
        return tuple(found)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about the estimate."""
        notes = [
            f"physically consistent: {self.bounds}.",
            *self.findings,
            "standard deviations are those of the estimate without bounds: where bounds are "
            "active, estimates scatter less.",
        ]
        if self.outcome is not Outcome.CERTIFIED:
            notes.append(self.outcome.value)
        return tuple(notes)


class PhysicallyConsistent(AbstractEstimator):
    r"""Weighted least squares over the standard parameters of bodies that can exist.

    Every body's pseudo-inertia is positive semidefinite, masses and spheres are bounded, friction
    and rotor inertias are nonnegative, and coupled drives have semidefinite matrices. The optimum
    is found with an error bound, and the mass matrix is positive definite in every pose. Masses
    that forces cannot tell apart reflect the bounds: `fit.consistency` names them.

    Attributes:
        weights: Weights of the joints; by default the reciprocals of the largest forces (Eq. 30).
        bounds: Bounds of the bodies; wide ones from the robot's geometry if None.
        margin: Fraction (0 to 1) of a nominal ball that every body contains: the mass matrix
            exceeds that fraction of the nominal balls' mass matrix in every pose.
        pull: Pull towards the bodies of a prior, along directions that the data do not see.
        prior: Standard parameters that are known roughly.
        throw: Whether an optimum without proof is an error; otherwise it is a note.
    """

    weights: AbstractWeights = MaximumForces()
    bounds: BodyBounds | None = None
    margin: float = 0.0
    pull: EntropicPull | None = None
    prior: ParameterPrior | None = None
    throw: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not 0.0 <= self.margin < 1.0:
            raise InputError(f"`margin` must be between 0 and 1, but is {self.margin}.")

    def __call__(self, rows):
        """Solve a small convex program on the triangular factor of the rows.

        Raises:
            InputError: If weights are not known, or bounds and margin leave no body.
            RuntimeError: If the optimum was not proved and `throw` is set.
        """
        weights = self.weights(rows.robot, rows.factors)
        free = Estimate.solve(rows, weights, Complete())
        R, z = rows.factors.weighted(weights)
        feasible = self.feasible_set(rows.base)
        count = int(rows.factors.rows.sum())
        data, program = self.program(np, rows.base, feasible, R, z, count)
        program.require_interior()
        optimum = solver.solve_in_numpy(program)
        outcome = _outcome(optimum)
        error_bound = float(optimum.error / max(optimum.value, program.scale))
        if self.throw and outcome is not Outcome.CERTIFIED:
            raise RuntimeError(
                f"no physically consistent estimate with a proof: {outcome.value} The bound is "
                f"{error_bound:.1e} of the objective."
            )
        p = feasible.standard_parameters(np, data.A, data.b, optimum.y)
        estimate = np.asarray(rows.base.from_standard(p))
        bodies = p[np.array(feasible.bodies)]
        bodies = np.pad(bodies, ((0, 0), (0, 10 - bodies.shape[1])))
        squares = [float(np.sum((R @ x - z) ** 2)) for x in (estimate, np.asarray(free.parameters))]
        identifiability = rows.base.identifiability
        found = Consistency(
            bodies=bodies,
            margins=consistency_margin(bodies),
            bounds=feasible.bounds,
            residual_increase=float(np.sqrt(squares[0] / squares[1]) - 1.0)
            if squares[1] > 0
            else np.inf,
            error_bound=error_bound,
            outcome=outcome,
            iterations=int(optimum.iterations),
            determined=np.array([x is Identifiability.ALONE for x in identifiability]),
            active=_active_bounds(rows.base, feasible, program, optimum, bodies),
        )
        notes = (*free.notes, *found.notes)
        return dataclasses.replace(
            free, parameters=estimate, standard=p, consistency=found, notes=notes
        )

    def feasible_set(self, base: BaseParameters) -> FeasibleSet:
        """Return the feasible set of a model.

        Args:
            base: Base parameters of the model.

        Raises:
            InputError: If the bounds do not fit the model.
        """
        robot = base.model.robot
        bounds = BodyBounds.from_geometry(robot) if self.bounds is None else self.bounds
        return feasible_set(base.model, bounds, self.margin)

    def program(
        self,
        xp: ModuleType,
        base: BaseParameters,
        feasible: FeasibleSet,
        R: Float[AnyArray, "height base"],
        z: Float[AnyArray, " height"],
        rows: Values | int,
    ) -> tuple[ScaledRows, ConeProgram]:
        """Return the rows in units of the noise, and the convex program.

        Args:
            xp: NumPy or `jax.numpy`.
            base: Base parameters of the factor's columns.
            feasible: Feasible set of the model.
            R: Upper triangle of the weighted rows.
            z: Weighted forces, of the same decomposition.
            rows: Number of rows behind the factor.
        """
        data = scaled_rows(xp, base, R, z, rows)
        if self.prior is not None:
            A, b = self.prior.rows(data.A.shape[1])
            A, b = xp.concatenate([data.A, A]), xp.concatenate([data.b, b])
            data = ScaledRows(A, b, data.noise, data.scale)
        if self.pull is None:
            return data, cone_program(xp, feasible, data)
        bodies = self.pull.pseudo_inertias(nominal_bodies(feasible.bounds))
        return data, cone_program(xp, feasible, data, self.pull.strength, bodies)


def _outcome(optimum: solver.Optimum) -> Outcome:
    if bool(optimum.certified):
        return Outcome.CERTIFIED
    most = solver.MAX_ITERATIONS
    return Outcome.ITERATIONS if int(optimum.iterations) >= most else Outcome.STALLED


def _active_bounds(
    base: BaseParameters,
    feasible: FeasibleSet,
    program: ConeProgram,
    optimum: solver.Optimum,
    bodies: Float[AnyArray, "bodies 10"],
) -> tuple[str, ...]:
    """Name the bounds whose multipliers exceed their slacks (strict complementarity)."""
    _, slacks = program.slacks(np, optimum.y)
    tight = np.asarray(optimum.multipliers) > slacks
    K, n = program.bodies, program.drives
    linear = tight[: K * program.rows.shape[1]].reshape(K, -1)
    found = []
    for label, active in zip(feasible.linear_bounds()[0], linear.T, strict=True):
        if active.any():
            found.append(f"{label} of body {_numbers(active)}")
    names = base.model.parameter_names
    drives = tight[K * program.rows.shape[1] :]
    for label, active in (("0", drives[:n]), ("their largest value", drives[n:])):
        if active.any():
            where = ", ".join(names[feasible.drives[k]] for k in np.flatnonzero(active))
            found.append(f"{where} at {label}")
    flat = consistency_margin(bodies) < 1e-4
    if flat.any():
        found.append(f"body {_numbers(flat)} as flat as a body can be")
    return tuple(found)


def _numbers(chosen: Bool[np.ndarray, " bodies"]) -> str:
    return ", ".join(str(k + 1) for k in np.flatnonzero(chosen))


class ConsistentBody(eqx.Module):
    """A physically consistent body.

    Attributes:
        parameters: Parameters $(m, m r_c, A, B, C, D, E, F)$ about the body's origin.
        distance: Distance from the estimate in standard deviations: below 4 is not unusual.
        error_bound: Bound of half the squared distance's distance to the optimum.
        outcome: Outcome of the search.
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
    """Return the consistent body closest to an estimate, in the metric of its covariance.

    Args:
        estimate: Estimated parameters $(m, m r_c, A, B, C, D, E, F)$.
        covariance: Covariance of their errors; positive definite.
        bounds: Bounds of one body, such as `BodyBounds(mass_max=10.0, radius=0.5)`.
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
    one = np.float64(1.0)
    feasible = FeasibleSet((tuple(range(10)),), (), (), bounds, np.zeros((1, 4, 4)), ())
    program = cone_program(np, feasible, ScaledRows(A, b, one, len(b) * one))
    program.require_interior()
    optimum = solver.solve_in_numpy(program)
    outcome = _outcome(optimum)
    if throw and outcome is not Outcome.CERTIFIED:
        raise RuntimeError(f"no consistent body with a proof: {outcome.value}")
    parameters = feasible.standard_parameters(np, A, b, optimum.y)
    distance = float(np.sqrt(2.0 * optimum.value))
    return ConsistentBody(parameters, distance, float(optimum.error), outcome)
