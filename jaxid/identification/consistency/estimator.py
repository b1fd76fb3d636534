"""Physically consistent estimation: parameters of bodies that can exist, of one or many logs."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Bool,
    Float,
    Hashable,
    Int,
    content,
    in_parts,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters, Identifiability
from jaxid.errors import InputError

from ..estimators import (
    AbstractEstimator,
    AbstractWeights,
    Complete,
    Estimate,
    MaximumForces,
)
from . import solver
from .bounds_and_priors import BodyBounds, EntropicPull, ParameterPrior
from .program import (
    ConeProgram,
    FeasibleSet,
    ScaledRows,
    cone_program,
    feasible_set,
    nominal_bodies,
    scaled_rows,
)
from .pseudo_inertia import consistency_margin, pseudo_inertia

UNPROVED = (
    "the squared residuals may exceed the smallest possible ones by {:.1e} of them; "
    "at most "
    f"{2 * solver.TOLERANCE:.0e} is a proof of the optimum."
)
"""Message where the optimum was not proved."""


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
    """

    bodies: Float[AnyArray, "bodies 10"]
    margins: Float[AnyArray, " bodies"]
    bounds: BodyBounds
    residual_increase: float
    error_bound: float
    certified: bool = eqx.field(static=True)
    iterations: int = eqx.field(static=True)
    determined: Bool[np.ndarray, " standard"]
    masses_from_bounds: tuple[int, ...] = eqx.field(static=True)
    active: tuple[str, ...] = eqx.field(static=True)

    @property
    def findings(self) -> tuple[str, ...]:
        """Sentences about the effect of the bounds on residuals and parameters."""
        percent = 100 * self.residual_increase
        found = [
            f"the weighted residuals are {percent:.2g} % larger than without bounds."
        ]
        if self.masses_from_bounds:
            names = ", ".join(f"m{k + 1}" for k in self.masses_from_bounds)
            found.append(
                f"forces do not determine the masses {names} alone: their values, and "
                "parameters "
                "that depend on them, reflect the bounds; base parameters and forces "
                "do not."
            )
        if self.active:
            found.append(f"active bounds: {'; '.join(self.active)}.")
        return tuple(found)


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
        margin: Fraction (0 to 1) of a nominal ball that every body contains: the mass
            matrix exceeds that fraction of the nominal balls' mass matrix in every
            pose.
        pull: Pull towards the bodies of a prior, along directions that the data do not
            see.
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
        base, weights = rows.base, self.weights(rows.robot, rows.factors)
        free = Estimate.solve(rows, weights, Complete())
        R, z = rows.factors.weighted(weights)
        feasible = self.feasible_set(base)
        data, program = self.program(
            np, base, feasible, R, z, int(rows.factors.rows.sum())
        )
        optimum, error_bound = _solve(program, self.throw)
        p = feasible.standard_parameters(np, data, optimum.y)
        parameters = np.asarray(base.from_standard(p))
        bodies = p[np.array(feasible.bodies)]
        bodies = np.pad(bodies, ((0, 0), (0, 10 - bodies.shape[1])))
        ours = float(np.linalg.norm(R @ parameters - z))
        best = float(np.linalg.norm(R @ free.parameters - z))
        determined = np.array(
            [x is Identifiability.ALONE for x in base.identifiability]
        )
        lost = (k for k, own in enumerate(feasible.bodies) if not determined[own[0]])
        found = Consistency(
            bodies=bodies,
            margins=consistency_margin(bodies),
            bounds=feasible.bounds,
            residual_increase=ours / best - 1.0 if best > 0 else np.inf,
            error_bound=error_bound,
            certified=bool(optimum.certified),
            iterations=int(optimum.iterations),
            determined=determined,
            masses_from_bounds=tuple(lost),
            active=_active_bounds(base, feasible, program, optimum, bodies),
        )
        notes = (
            *free.notes,
            f"physically consistent: {feasible.bounds}.",
            *found.findings,
            "standard deviations are those of the estimate without bounds: where "
            "bounds are "
            "active, estimates scatter less.",
            *([] if optimum.certified else [UNPROVED.format(error_bound)]),
        )
        return dataclasses.replace(
            free,
            parameters=parameters,
            standard=p,
            consistency=found,
            unbounded=free.parameters,
            notes=notes,
        )

    def feasible_set(self, base: BaseParameters) -> FeasibleSet:
        """Return the feasible set of a model; bounds of other bodies are rejected."""
        robot = base.model.robot
        bounds = BodyBounds.from_geometry(robot) if self.bounds is None else self.bounds
        return feasible_set(base.model, bounds, self.margin)

    def program(self, xp, base, feasible, R, z, rows) -> tuple[ScaledRows, ConeProgram]:
        """Return the rows in units of the noise, and the convex program; see `scaled_rows`."""
        data, size = scaled_rows(xp, base, R, z, rows), base.model.size
        if self.prior is not None:
            if len(self.prior.parameters) != size:
                raise InputError(f"`parameters` of a prior must be the model's {size}.")
            inverse = 1.0 / np.asarray(self.prior.deviations, np.float64)
            known = inverse > 0.0
            more = (inverse * np.asarray(self.prior.parameters))[known]
            A = xp.concatenate([data.A, np.diag(inverse)[known]])
            data = data._replace(A=A, b=xp.concatenate([data.b, more]))
        if self.pull is None:
            return data, cone_program(xp, feasible, data)
        bodies, count = self.pull.bodies, len(feasible.bodies)
        if bodies is None:
            prior = nominal_bodies(feasible.bounds)
        elif len(bodies) == count:
            prior = pseudo_inertia(bodies)
        else:
            raise InputError(f"`bodies` of a prior must be the model's {count}.")
        return data, cone_program(xp, feasible, data, self.pull.strength, prior)


def _solve(program: ConeProgram, throw: bool) -> tuple[solver.Optimum, float]:
    """Return the optimum, and a bound of its objective's relative distance to the true one."""
    program.require_interior()
    optimum = solver.solve_in_numpy(program)
    error_bound = float(optimum.error / max(optimum.value, program.scale))
    if throw and not optimum.certified:
        raise RuntimeError(
            "no physically consistent estimate with a proof: "
            f"{UNPROVED.format(error_bound)} "
            "Widen the bounds, or accept it with `throw=False`."
        )
    return optimum, error_bound


def _active_bounds(
    base, feasible, program, optimum: solver.Optimum, bodies
) -> tuple[str, ...]:
    """Name the bounds that keep the estimate from a better one."""

    def numbers(chosen: np.ndarray) -> str:
        return ", ".join(str(k + 1) for k in np.flatnonzero(chosen))

    labels, n = feasible.linear_bounds()[0], program.drives
    # Active bounds cost more than a hundredth of half a squared deviation.
    tight = solver.prices(program, optimum) > 0.01
    linear, drives = np.split(tight, [program.bodies * len(labels)])
    pairs = zip(labels, linear.reshape(program.bodies, -1).T, strict=True)
    found = [
        f"{label} of body {numbers(active)}" for label, active in pairs if active.any()
    ]
    names = base.model.parameter_names
    for label, active in (("0", drives[:n]), ("their largest value", drives[n:])):
        if active.any():
            where = ", ".join(names[feasible.drives[k]] for k in np.flatnonzero(active))
            found.append(f"{where} at {label}")
    flat = consistency_margin(bodies) < 1e-4
    if flat.any():
        found.append(f"body {numbers(flat)} as flat as a body can be")
    return tuple(found)


def consistent_body(
    estimate: Float[AnyArray, "10"],
    covariance: Float[AnyArray, "10 10"],
    bounds: BodyBounds,
    *,
    throw: bool = True,
) -> tuple[Float[np.ndarray, "10"], float, float]:
    """Return the consistent body closest to an estimate, in the metric of its covariance.

    Args:
        estimate: Estimated parameters $(m, m r_c, A, B, C, D, E, F)$.
        covariance: Covariance of their errors; positive definite.
        bounds: Bounds of one body, such as `BodyBounds(mass_max=10.0, radius=0.5)`.
        throw: Whether an optimum without proof is an error.

    Returns:
        Parameters of the body; its distance from the estimate in standard deviations
        (below 4 is not unusual); bound of half the squared distance's distance to the
        optimum.

    Raises:
        InputError: If the covariance is not positive definite.
        RuntimeError: If the optimum was not proved and `throw` is set.
    """
    C = np.asarray(covariance)
    size = np.sqrt(np.abs(np.diag(C)))
    size = np.where(size > 0, size, 1.0)
    try:
        L = np.linalg.cholesky(C / size[:, None] / size)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "`covariance` must be positive definite, but is not."
        ) from error
    A = np.linalg.inv(L) / size
    b = A @ estimate
    feasible = FeasibleSet((tuple(range(10)),), (), (), bounds, np.zeros((1, 4, 4)), ())
    data = ScaledRows(A, b, np.float64(len(b)))
    optimum, _ = _solve(cone_program(np, feasible, data), throw)
    parameters = feasible.standard_parameters(np, data, optimum.y)
    return parameters, float(np.sqrt(2.0 * optimum.value)), float(optimum.error)


class ConsistentBatch(eqx.Module):
    """Physically consistent parameters of one or many data sets.

    Attributes:
        standard: Standard parameters: complete bodies, friction, rotors.
        parameters: Base parameters.
        residual_increases: Relative increases of the norms of the residuals by the
            bounds.
        error_bounds: Bounds of the objectives' relative distances to their optima.
        certified: Whether the bounds are within the tolerance.
        iterations: Numbers of iterations.
    """

    standard: Float[AnyArray, "*datasets standard"]
    parameters: Float[AnyArray, "*datasets base"]
    residual_increases: Float[AnyArray, "*datasets"]
    error_bounds: Float[AnyArray, "*datasets"]
    certified: Bool[AnyArray, "*datasets"]
    iterations: Int[AnyArray, "*datasets"]


class ConsistentSolver(Hashable):
    """Physically consistent estimates of one model: a function of arrays for `jit` and `vmap`.

    The factors are those of `Factors.weighted`: their rows are weighted already, so the
    weights of the estimator do not count. Equal solvers share their compiled functions.
    The solver is a loop whose length depends on the data: there are no reverse-mode
    gradients.

    Attributes:
        base: Base parameters of the factors' columns.
        estimator: Bounds, margin and priors; by default wide bounds.
    """

    base: BaseParameters
    estimator: PhysicallyConsistent = PhysicallyConsistent()

    __hash__ = Hashable.__hash__

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConsistentSolver) and content(self) == content(other)

    def __call__(
        self,
        R: Float[AnyArray, "height base"],
        z: Float[AnyArray, " height"],
        rows: Int[AnyArray, ""] | int,
    ) -> ConsistentBatch:
        """Return the estimate of one data set.

        Args:
            R: Upper triangle of the weighted rows.
            z: Weighted forces, of the same decomposition.
            rows: Number of rows behind the factor.

        Raises:
            InputError: If the bounds do not fit the model.
        """
        require_float64("a physically consistent estimate")
        R, z = jnp.asarray(R), jnp.asarray(z)
        feasible = self.estimator.feasible_set(self.base)
        data, program = self.estimator.program(jnp, self.base, feasible, R, z, rows)
        optimum = solver.solve_compiled(program)
        p = feasible.standard_parameters(jnp, data, optimum.y)
        # The rows of a prior come behind.
        rest = (data.b - data.A @ p)[: len(z)]
        free = data.b[self.base.size : len(z)]
        return ConsistentBatch(
            p,
            self.base.from_standard(p),
            jnp.sqrt(rest @ rest / jnp.maximum(free @ free, 1e-300)) - 1.0,
            optimum.error / jnp.maximum(optimum.value, program.scale),
            jnp.asarray(optimum.certified),
            jnp.asarray(optimum.iterations),
        )


def consistent_batch(
    base: BaseParameters,
    R: Float[AnyArray, "datasets height base"],
    z: Float[AnyArray, "datasets height"],
    rows: Int[AnyArray, " datasets"],
    estimator: PhysicallyConsistent | None = None,
) -> ConsistentBatch:
    """Estimate physically consistent parameters from the triangular factors of many data sets.

    It is `ConsistentSolver`, compiled once for each model, estimator and shape, and
    spread over the cores of the processor.

    Args:
        base: Base parameters of the factors' columns.
        R: Upper triangles of the weighted rows.
        z: Weighted forces, of the same decompositions.
        rows: Numbers of rows behind the factors.
        estimator: Bounds, margin and priors; wide bounds if None.

    Raises:
        InputError: If shapes do not fit, or bounds leave no body.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    count = len(R)
    if (
        not count
        or R.shape[-1] != base.size
        or z.shape != R.shape[:-1]
        or rows.shape != (count,)
    ):
        raise InputError(
            "`R`, `z` and `rows` must have the shapes [datasets, height, "
            f"{base.size}], [datasets, "
            f"height] and [datasets], but have {R.shape}, {z.shape} and {rows.shape}."
        )
    arrays = np.asarray(R), np.asarray(z), np.asarray(rows)
    estimator = estimator or PhysicallyConsistent()
    first = (x[0] for x in arrays)
    feasible = estimator.feasible_set(base)
    estimator.program(np, base, feasible, *first)[1].require_interior()
    one = ConsistentSolver(base, estimator)
    # An accelerator takes all data sets at once.
    size = 16 if jax.default_backend() == "cpu" else count
    return in_parts(lambda part: _solve_many(one, *part), arrays, size)


@functools.partial(jax.jit, static_argnums=0)
def _solve_many(
    one: ConsistentSolver, R: Array, z: Array, rows: Array
) -> ConsistentBatch:
    def solve(together: int | None, *data: Array) -> ConsistentBatch:
        return jax.lax.map(lambda x: one(*x), data, batch_size=together)

    # A core gains nothing from solving data sets in step: it waits for the slowest.
    alone, in_step = functools.partial(solve, None), functools.partial(solve, 256)
    return jax.lax.platform_dependent(R, z, rows, cpu=alone, default=in_step)
