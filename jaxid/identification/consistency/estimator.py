"""Physically consistent estimation: parameters of bodies that can exist."""

import dataclasses
from collections.abc import Iterable

import equinox as eqx
import numpy as np

from jaxid.arrays import (
    AnyArray,
    BaseVector,
    Bool,
    Float,
    Indices,
    Joints,
    Texts,
    Vector,
)
from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

from ..estimators import (
    AbstractEstimator,
    AbstractWeights,
    Complete,
    Estimate,
    MaximumForces,
)
from ..factors import Factors
from ..problem import RegressionProblem
from . import solver
from .bounds_and_priors import WEAK_PULL, BodyBounds, EntropicPull
from .cone_program import ConeProgram, cone_program
from .feasible_set import FeasibleSet, feasible_set, nominal_bodies
from .prior_check import ChosenPull, choose_pull
from .pseudo_inertia import consistency_margin, pseudo_inertia
from .scaled_rows import ScaledRows, scaled_rows

MIN_PRICE = 0.01
"""Active bounds cost more than this, in halves of a squared deviation."""
MAX_FLAT_MARGIN = 1e-4
"""Margin of a body that is as flat as a body can be."""


class Consistency(eqx.Module):
    """Properties of a physically consistent estimate.

    Attributes:
        bodies: Parameters $(m, m r_c, A, B, C, D, E, F)$ of all bodies.
        margins: Distances of the bodies from the boundary of physical consistency (0 to
            1).
        bounds: Bounds of the bodies.
        residual_increase: Relative increase of the norm of the weighted residuals by
            the bounds.
        error_bound: Bound of the objective's relative distance to the optimum.
        certified: Whether the error bound is below its tolerance: a proof of the
            optimum.
        iterations: Number of iterations of the search.
        determined: Standard parameters that the data determine alone, without the
            bounds.
        masses_from_bounds: Bodies (0 is the first) whose masses reflect bounds or
            priors.
        active: Names of the active bounds.
        pull: Pull towards the bodies of a prior, with its strength; None for none.
        shift: Base parameters less those without bounds and prior, which intervals
            include.
    """

    bodies: Float[AnyArray, "bodies 10"]
    margins: Float[AnyArray, " bodies"]
    bounds: BodyBounds
    residual_increase: float
    error_bound: float
    certified: bool = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    determined: Bool[np.ndarray, " standard"]
    masses_from_bounds: Indices = eqx.field(static=True)
    active: Texts = eqx.field(static=True)
    pull: EntropicPull | None
    shift: BaseVector

    def findings(self, robot: Robot) -> Texts:
        """Return sentences about the effect of the bounds on residuals and masses."""
        percent = 100 * self.residual_increase
        sentences = [
            f"the weighted residuals are {percent:.2g} % larger than without bounds."
        ]
        if self.masses_from_bounds:
            numbers = _numbers(robot, self.masses_from_bounds)
            names = ", ".join(f"m{number}" for number in numbers)
            sentences.append(
                f"forces alone do not determine the masses {names}: their values, and "
                "parameters that depend on them, reflect the bounds; base parameters "
                "and forces do not."
            )
        if self.active:
            sentences.append(f"active bounds: {'; '.join(self.active)}.")
        return tuple(sentences)

    def notes(self, robot: Robot) -> Texts:
        """Return all sentences for the user."""
        sentences = [
            f"physically consistent: {self.bounds}.",
            *self.findings(robot),
            "standard deviations are those of the estimate without bounds; intervals "
            "include the distance from it.",
        ]
        if not self.certified:
            sentences.append(
                "the optimum is not proven: the squared residuals may exceed the "
                f"smallest possible ones by a fraction of {self.error_bound:.1e}, but "
                f"{2 * solver.TOLERANCE:.0e} is allowed: widen the bounds."
            )
        return tuple(sentences)


def _numbers(robot: Robot, bodies: Iterable[int]) -> list[int]:
    """Return the numbers of bodies in names of parameters; massless ones have none."""
    return [robot.numbers[robot.solid_bodies[body]] for body in bodies]


class PhysicallyConsistent(AbstractEstimator):
    r"""Weighted least squares over the standard parameters of bodies that can exist.

    Every body's pseudo-inertia is positive semidefinite, masses and spheres are
    bounded, friction and rotor inertias are nonnegative, and coupled drives have
    semidefinite matrices. The optimum is found with an error bound, and the mass matrix
    is positive definite in every pose. Masses that forces cannot tell apart reflect the
    bounds: `fit.consistency` names them.

    Attributes:
        weights: Weights of the joints; by default the reciprocals of the largest forces
            (Eq. 30).
        bounds: Bounds of the bodies; wide ones from the robot's geometry if None.
        pull: Pull towards the bodies of a prior, along directions that the data do not
            see.
    """

    weights: AbstractWeights = MaximumForces()
    bounds: BodyBounds | None = None
    pull: EntropicPull | None = None

    def __call__(self, rows):
        """Solve a small convex program on the triangular factor of the rows.

        Raises:
            InputError: If weights are not known, or bounds leave no body.
        """
        base = rows.base
        weights = self.weights(rows.robot, rows.factors)
        # Its standard deviations serve the consistent estimate, too.
        unbounded_estimate = Estimate.solve(rows, weights, Complete())
        feasible_set = self.feasible_set(base)
        pull, pull_notes = self._choose_pull(rows, weights, feasible_set)
        estimator = dataclasses.replace(self, pull=pull)
        data, program, optimum = estimator._optimise(rows.factors, weights, base)
        p = feasible_set.standard_parameters(data, optimum.y)
        parameters = base.from_standard(p)
        bodies = p[np.array(feasible_set.bodies)]
        # Bodies with principal axes have seven parameters, no products of inertia.
        bodies = np.pad(bodies, ((0, 0), (0, 10 - bodies.shape[1])))

        R, z = rows.factors.weighted(weights)
        residual = float(np.linalg.norm(R @ parameters - z))
        min_residual = float(np.linalg.norm(R @ unbounded_estimate.parameters - z))
        increase = residual / min_residual - 1.0 if min_residual > 0 else np.inf
        is_determined = np.array(
            [x is Identifiability.ALONE for x in base.identifiability]
        )
        # The mass is the first parameter of a body.
        masses = [columns[0] for columns in feasible_set.bodies]
        consistency = Consistency(
            bodies=bodies,
            margins=consistency_margin(bodies),
            bounds=feasible_set.bounds,
            residual_increase=increase,
            # Noiseless data have an optimum near zero: the scale keeps the ratio
            # sensible.
            error_bound=float(optimum.error / max(optimum.value, program.scale)),
            certified=bool(optimum.certified),
            iterations=int(optimum.iterations),
            determined=is_determined,
            masses_from_bounds=tuple(np.flatnonzero(~is_determined[masses]).tolist()),
            active=_active_bounds(base, feasible_set, program, optimum, bodies),
            pull=pull,
            shift=parameters - unbounded_estimate.parameters,
        )
        return dataclasses.replace(
            unbounded_estimate,
            parameters=parameters,
            standard=p,
            consistency=consistency,
            unbounded=unbounded_estimate.parameters,
            notes=(
                *unbounded_estimate.notes,
                *consistency.notes(rows.robot),
                *pull_notes,
            ),
        )

    def _choose_pull(
        self, rows: RegressionProblem, weights: Joints, feasible: FeasibleSet
    ) -> ChosenPull:
        """Return the pull of the estimate, with a strength."""
        pull = self.pull
        if pull is None or pull.bodies is None or pull.strength is not None:
            return ChosenPull(pull, ())

        def solve(factors: Factors, pull: EntropicPull) -> Vector:
            estimator = dataclasses.replace(self, pull=pull)
            data, _, optimum = estimator._optimise(factors, weights, rows.base)
            return feasible.standard_parameters(data, optimum.y)

        columns = np.array(feasible.bodies)
        _require_count(pull.bodies, feasible)
        return choose_pull(rows, weights, columns, pull.bodies, solve)

    def _optimise(
        self, factors: Factors, weights: Joints, base: BaseParameters
    ) -> tuple[ScaledRows, ConeProgram, solver.Optimum]:
        """Return the scaled rows of some factors, the program and its optimum."""
        R, z = factors.weighted(weights)
        count = int(factors.rows.sum())
        data, program = self.program(base, self.feasible_set(base), R, z, count)
        return data, program, _solve(program)

    def feasible_set(self, base: BaseParameters) -> FeasibleSet:
        """Return the feasible set of a model; bounds of other bodies are rejected."""
        robot = base.model.robot
        bounds = BodyBounds.from_geometry(robot) if self.bounds is None else self.bounds
        return feasible_set(base.model, bounds)

    def program(
        self, base: BaseParameters, feasible: FeasibleSet, R, z, rows
    ) -> tuple[ScaledRows, ConeProgram]:
        """Return the rows in units of the noise, and the program; see `scaled_rows`."""
        data = scaled_rows(base, R, z, rows)
        if self.pull is None:
            return data, cone_program(feasible, data)
        prior = nominal_bodies(feasible.bounds)
        if self.pull.bodies is not None:
            _require_count(self.pull.bodies, feasible)
            prior = pseudo_inertia(self.pull.bodies)
        strength = WEAK_PULL if self.pull.strength is None else self.pull.strength
        return data, cone_program(feasible, data, strength, prior)


def _require_count(bodies: AnyArray, feasible: FeasibleSet) -> None:
    """Check that a prior has as many bodies as the model."""
    count = len(feasible.bodies)
    if len(bodies) != count:
        raise InputError(f"`bodies` of a prior must describe {count} bodies.")


def _solve(program: ConeProgram) -> solver.Optimum:
    """Return the optimum of a program whose bounds leave some bodies."""
    program.require_interior()
    return solver.solve_in_numpy(program)


def _active_bounds(
    base: BaseParameters,
    feasible: FeasibleSet,
    program: ConeProgram,
    optimum: solver.Optimum,
    bodies,
):
    """Name the bounds that keep the estimate from a better one."""

    def numbers(is_active) -> str:
        return ", ".join(
            map(str, _numbers(base.model.robot, np.flatnonzero(is_active)))
        )

    is_tight = solver.prices(program, optimum) > MIN_PRICE
    names = feasible.linear_bounds().names
    end = program.bodies * len(names)
    body_flags = is_tight[:end].reshape(program.bodies, len(names))
    sentences = []
    for name, is_active in zip(names, body_flags.T, strict=True):
        if is_active.any():
            sentences.append(f"{name} of body {numbers(is_active)}")

    # Lower bounds of all drives come first, then upper ones.
    drive_flags = is_tight[end:].reshape(2, program.drives)
    drive_names = [base.model.parameter_names[k] for k in feasible.drives]
    for limit, is_active in zip(("0", "their largest value"), drive_flags, strict=True):
        if is_active.any():
            active_names = [drive_names[k] for k in np.flatnonzero(is_active)]
            sentences.append(f"{', '.join(active_names)} at {limit}")

    is_flat = consistency_margin(bodies) < MAX_FLAT_MARGIN
    if is_flat.any():
        sentences.append(f"body {numbers(is_flat)} as flat as a physical body can be")
    return tuple(sentences)


def consistent_body(
    estimate: Float[AnyArray, "10"],
    covariance: Float[AnyArray, "10 10"],
    bounds: BodyBounds,
) -> tuple[Float[np.ndarray, "10"], float, float]:
    """Return the consistent body closest to an estimate, in its covariance's metric.

    Args:
        estimate: Estimated parameters $(m, m r_c, A, B, C, D, E, F)$.
        covariance: Covariance of their errors; positive definite.
        bounds: Bounds of one body, such as `BodyBounds(mass_max=10.0, radius=0.5)`.

    Returns:
        Parameters of the body; its distance from the estimate in standard deviations
        (below 4 is not unusual); bound of half the squared distance's distance to the
        optimum.

    Raises:
        InputError: If the covariance is not positive definite.
    """
    covariance = np.asarray(covariance)
    deviations = np.sqrt(np.abs(np.diag(covariance)))
    scale = np.where(deviations > 0, deviations, 1.0)
    try:
        L = np.linalg.cholesky(covariance / scale[:, None] / scale)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "`covariance` must be positive definite, but is not."
        ) from error
    # Rows whose squared residuals are the squared distance in the covariance's metric.
    A = np.linalg.inv(L) / scale
    b = A @ estimate
    data = ScaledRows(A, b, np.float64(len(b)))
    feasible_set = FeasibleSet(
        bodies=(tuple(range(10)),),
        drives=(),
        unbounded=(),
        bounds=bounds,
        couplings=(),
    )
    optimum = _solve(cone_program(feasible_set, data))
    parameters = feasible_set.standard_parameters(data, optimum.y)
    return parameters, float(np.sqrt(2.0 * optimum.value)), float(optimum.error)
