r"""A primal-dual interior point method for `ConeProgram`, in NumPy or compiled by JAX.

The solver is our own for three reasons: it is compiled and mapped over data sets by
JAX, it proves how far its result is from the optimum, and a fit takes milliseconds
(`benchmarks/consistency.py` compares it with CLARABEL).

Newton's method solves the perturbed optimality conditions $S Z = \mu I$, $s z = \mu$; a
pull towards a prior's bodies ends with $S Z = \gamma I$ instead. The direction is that
of Helmberg, Kojima and Monteiro with Mehrotra's predictor and corrector. The corrector
is computed once more with the products of its own changes, and the longer step is
taken: it saves three iterations of fourteen for one more solution of a factored system.
One step length serves both sides, since in a quadratic program they are tied together.
The variables are feasible from the start.

Certificate: for any feasible $y$ and any $Z, z \succeq 0$ with $r = \nabla f(y) -
F^*(Z) - G^T z$, convexity gives $f(y) - f^* \le \langle S, Z \rangle + s^T z + \sum_i
|r_i| d_i$, where $d_i$ bounds the distance between two feasible values of $y_i$.
Nothing in it is estimated.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Bool, Float, Int, namespace

from .cone_program import ConeProgram, Number
from .pseudo_inertia import Values, inverse, pivots, symmetric_part

TOLERANCE = 2.5e-7
"""Error bound of a certified optimum, relative to objective and scale together."""
MAX_ITERATIONS = 50
MAX_STALLS = 4
"""Iterations without progress after which the search ends."""
MIN_LENGTH = 1e-8
"""Length of a step below which the search ends."""
STEP_FRACTIONS = np.array(
    [1.0, *1.0 - np.geomspace(0.01, 0.64, 13), 0.28, 0.2, 0.13, 0.08, 0.04, 0.01]
)
"""Steps that are tried, as fractions of the longest that the inequalities allow."""
BOUNDARY_FRACTION = 0.99
"""Fraction of the longest step that is taken: slacks stay positive."""
RIDGE = 1e-14
"""Relative increase of diagonals, by less than rounding: factors do not fail."""
TINY = 1e-300
"""Keeps ratios finite."""


class Optimum(eqx.Module):
    """Result of the interior point method: a value, with a bound of its error.

    The value is half the squared residuals; it is certified if the bound is within the
    tolerance. The multipliers are those of the linear inequalities, `matrices` those of
    the semidefinite ones.
    """

    y: Float[AnyArray, "*batch variables"]
    value: Number
    error: Number
    certified: Bool[AnyArray, "*batch"] | np.bool
    iterations: Int[AnyArray, "*batch"] | np.integer
    multipliers: Float[AnyArray, "*batch linear"]
    matrices: Float[AnyArray, "*batch cones 4 4"]


class Point(NamedTuple):
    """Variables, slacks, multipliers, and their distance from the optimum."""

    y: Values
    S: Values  # slacks of the semidefinite inequalities
    s: Values  # slacks of the linear inequalities
    Z: Values  # multipliers of the semidefinite inequalities
    z: Values  # multipliers of the linear inequalities
    residual: Values  # of the optimality conditions
    value: Values
    error: Values


class Direction(NamedTuple):
    """Changes of variables, slacks and multipliers."""

    y: Values
    S: Values
    s: Values
    Z: Values
    z: Values


class Search(NamedTuple):
    """State of the iteration."""

    point: Point
    best: Point
    iterations: Values
    stalls: Values  # iterations since the best point
    has_finished: Values


def solve_in_numpy(program: ConeProgram) -> Optimum:
    """Solve one program in NumPy: some tens of milliseconds, and nothing to compile."""

    def loop(goes_on: Callable, iterate: Callable, search: Search) -> Search:
        while goes_on(search):
            search = iterate(search)
        return search

    with np.errstate(all="ignore"):
        return _solve(program, loop)


@jax.jit
def solve_compiled(program: ConeProgram) -> Optimum:
    """Solve one program; works under `jit` and `vmap`."""
    return _solve(jax.tree.map(jnp.asarray, program), jax.lax.while_loop)


def _solve(p: ConeProgram, loop: Callable) -> Optimum:
    """Iterate until certified, or until some iterations have brought no progress."""
    xp = p.xp
    gram = _gram(p)

    def is_certified(point: Point):
        return point.error <= TOLERANCE * (p.scale + point.value)

    def iterate(search: Search) -> Search:
        point, length = _step(p, gram, search.point)
        is_better = point.error < search.best.error
        best_point = _select(is_better, point, search.best)
        stalls = xp.where(is_better, 0, search.stalls + 1)
        iterations = search.iterations + 1
        has_finished = (
            is_certified(point)
            | ~xp.isfinite(point.error)
            | (length < MIN_LENGTH)
            | (stalls >= MAX_STALLS)
            | (iterations >= MAX_ITERATIONS)
        )
        return Search(point, best_point, iterations, stalls, has_finished)

    start = _start(p)
    zero = xp.zeros((), int)
    search = Search(start, start, zero, zero, zero > 0)
    search = loop(lambda search: ~search.has_finished, iterate, search)
    best_point = search.best
    return Optimum(
        y=best_point.y,
        value=best_point.value,
        error=best_point.error,
        certified=is_certified(best_point),
        iterations=search.iterations,
        multipliers=best_point.z,
        matrices=best_point.Z,
    )


def _gram(p: ConeProgram):
    return (p.A.T @ p.A) * (1.0 + RIDGE * np.eye(p.A.shape[-1]))


def _select(condition, first: Any, second: Any):
    """Return one of two tuples of arrays."""
    xp = namespace(condition)
    pairs = zip(first, second, strict=True)
    return type(first)(*(xp.where(condition, a, b) for a, b in pairs))


def _start(p: ConeProgram) -> Point:
    """Return the program's start with multipliers on its central path.

    They are as large as the gradient of the objective.
    """
    xp = p.xp
    S, s = p.slacks(p.start)
    inverse_S = inverse(S)
    rest = p.A @ p.start - p.b
    gradient = xp.linalg.norm(rest @ p.A)
    unit_force = xp.linalg.norm(p.adjoint(inverse_S, 1.0 / s))
    value = 0.5 * rest @ rest + RIDGE
    max_mu = value / p.complementarity
    mu = xp.clip(gradient / unit_force, 1e-6 * max_mu, max_mu)
    products = xp.maximum(_targets(p), mu)
    return _point(p, p.start, products * inverse_S, mu / s)


def prices(p: ConeProgram, optimum: Optimum) -> Float[np.ndarray, " linear"]:
    """Return how much the objective would fall without each linear bound.

    It is a value to second order, in units of half a squared standard deviation,
    whatever the units of the bounds.
    """
    S, s = p.slacks(optimum.y)
    z = optimum.multipliers
    ratio = z / s
    barriers = _barriers(p, inverse(S), optimum.matrices, ratio)
    solve = _newton_solver(p, _gram(p) + barriers)
    unit_vectors = np.eye(p.A.shape[-1])
    columns = [p.linear(y)[1] for y in unit_vectors]
    bound_rows = np.transpose(columns)
    compliance = np.array([row @ solve(row) for row in bound_rows])
    # Without the bound's own part of the curvature, and then a step of Newton's method.
    remaining_part = 1.0 - ratio * compliance
    curvature = np.maximum(remaining_part, 1e-12)
    step = z * compliance / curvature - s
    return 0.5 * z * np.maximum(step, 0.0)


def _point(p: ConeProgram, y, Z, z) -> Point:
    """Compute slacks, the residual of the optimality conditions, and the bound."""
    xp = p.xp
    S, s = p.slacks(y)
    rest = p.A @ y - p.b
    prior = p.pull * p.prior
    pull = xp.concatenate([prior, xp.zeros_like(p.fillings)])
    gradient = rest @ p.A + p.adjoint(pull, xp.zeros_like(z))
    residual = gradient - p.adjoint(Z, z)
    E = p.equalities
    if len(E):
        # Differences of feasible variables are orthogonal to the equality constraints.
        normal = xp.linalg.solve(E @ E.T, E @ residual)
        residual = residual - E.T @ normal
    gap = _matrix_gap(p, S, Z) + s @ z
    value = 0.5 * rest @ rest
    error = gap + _residual_part(p, residual)
    return Point(y, S, s, Z, z, residual, value, error)


def _residual_part(p: ConeProgram, residual):
    """Return the part of the error bound that comes from the optimality conditions."""
    return p.xp.sum(p.xp.abs(residual) * p.diameters)


def _matrix_gap(p: ConeProgram, S, Z):
    """Return the duality gap of the semidefinite inequalities.

    With a pull, the eigenvalues of S Z / pull are all one at the optimum: the gap is
    their sum less that of ones and of their logarithms.
    """
    xp = p.xp
    products = xp.sum(S * Z, axis=(-2, -1))
    bodies = products[: p.bodies]
    couplings = products[p.bodies :]
    is_pulled = p.pull > 0
    # One where nothing is pulled keeps the logarithm finite.
    pull = xp.where(is_pulled, p.pull, 1.0)
    logarithms = xp.log(pivots(S)) + xp.log(pivots(Z))
    log_det = xp.sum(logarithms[:, : p.bodies], axis=0)
    excess = log_det - 4.0 * xp.log(pull)
    pulled_gap = bodies - 4.0 * p.pull - p.pull * excess
    body_gap = xp.where(is_pulled, pulled_gap, bodies)
    return xp.sum(body_gap) + xp.sum(couplings)


def _targets(p: ConeProgram):
    """Return the products of slacks and multipliers at the optimum.

    They are the strength of the pull.
    """
    xp = p.xp
    bodies = xp.ones(p.bodies) * p.pull
    fillings = xp.zeros(len(p.fillings))
    return xp.concatenate([bodies, fillings])[:, None, None]


class Newton(NamedTuple):
    """Newton's equations at a point, factored."""

    p: ConeProgram
    x: Point
    inverse_S: Values  # noqa: N815
    solve: Callable[[Values], Values]

    def direction(self, rZ: Values, rz: Values, right_side: Values) -> Direction:
        """Return the direction of a right-hand side of the optimality conditions."""
        y = self.solve(right_side)
        S, s = self.p.linear(y)
        Z = rZ - symmetric_part(self.inverse_S @ S @ self.x.Z)
        z = rz - self.x.z / self.x.s * s
        return Direction(y, S, s, Z, z)

    def centre(self, mu: Values, second_Z: Values, second_z: Values) -> Direction:
        """Return the direction to products `target + mu`, less second-order terms."""
        targets = _targets(self.p) + mu
        rZ = targets * self.inverse_S - self.x.Z - second_Z
        rz = mu / self.x.s - self.x.z - second_z
        right_side = self.p.adjoint(rZ, rz) - self.x.residual
        return self.direction(rZ, rz, right_side)

    def correct(self, mu: Values, d: Direction) -> Direction:
        """Return the direction with the products of changes along another direction."""
        second_Z = symmetric_part(self.inverse_S @ d.S @ d.Z)
        return self.centre(mu, second_Z, d.s * d.z / self.x.s)

    def refine(self, d: Direction) -> Direction:
        """Remove what rounding has left of the optimality conditions."""
        adjoint = self.p.adjoint(d.Z, d.z)
        rest = adjoint - self.x.residual - (self.p.A @ d.y) @ self.p.A
        zeros = self.p.xp.zeros_like
        correction = self.direction(zeros(d.Z), zeros(d.z), rest)
        return Direction(*(a + b for a, b in zip(d, correction, strict=True)))


def _newton(p: ConeProgram, gram, x: Point) -> Newton:
    """Factor Newton's equations at a point."""
    inverse_S = inverse(x.S)
    barriers = _barriers(p, inverse_S, x.Z, x.z / x.s)
    return Newton(p, x, inverse_S, _newton_solver(p, gram + barriers))


def _step(p: ConeProgram, gram, x: Point):
    """Take the longer step of two correctors; return the new point and the length."""
    xp = p.xp
    newton = _newton(p, gram, x)
    predictor = newton.centre(0.0, 0.0, 0.0)
    # The second corrector has the second-order terms of the first one's changes.
    mu = _centring(p, x, predictor)
    first_correction = newton.correct(mu, predictor)
    second_correction = newton.correct(mu, first_correction)
    first_length = _length(STEP_FRACTIONS, x, first_correction)
    second_length = _length(STEP_FRACTIONS, x, second_correction)
    d = _select(second_length > first_length, second_correction, first_correction)
    length = xp.maximum(first_length, second_length)

    def refine():
        correction = newton.refine(d)
        return correction, _length(STEP_FRACTIONS, x, correction)

    # Near the boundary rounding leaves a residual that the error bound counts.
    is_near = x.error <= 1e-3 * (p.scale + x.value)
    needs_refinement = is_near & (_residual_part(p, x.residual) > 0.1 * x.error)
    if xp is np:
        d, length = refine() if needs_refinement else (d, length)
    else:
        d, length = jax.lax.cond(needs_refinement, refine, lambda: (d, length))
    length = BOUNDARY_FRACTION * length
    y = x.y + length * d.y
    return _point(p, y, x.Z + length * d.Z, x.z + length * d.z), length


def _centring(p: ConeProgram, x: Point, predictor: Direction):
    """Return the product of slacks and multipliers to aim at, by Mehrotra's rule."""
    xp = p.xp
    mu = _complementarity(p, x.S, x.s, x.Z, x.z) + TINY
    # The predictor only decides how much to centre: a coarser choice of steps suffices.
    length = _length(STEP_FRACTIONS[::3], x, predictor)
    mu_ahead = _complementarity(
        p,
        x.S + length * predictor.S,
        x.s + length * predictor.s,
        x.Z + length * predictor.Z,
        x.z + length * predictor.z,
    )
    # The farther the predictor gets, the less has to be centred.
    fraction = xp.clip((mu_ahead / mu) ** 3, 1e-6, 1.0)
    fraction = xp.where(length < 0.1, xp.maximum(fraction, 0.5), fraction)
    return fraction * mu


def _complementarity(p: ConeProgram, S, s, Z, z):
    """Return the mean product of slacks and multipliers, beyond that of the pull."""
    xp = p.xp
    # Each pulled body ends with S Z = pull, whose trace is four times the pull.
    matrices = xp.sum(S * Z) - 4.0 * p.bodies * p.pull
    return (xp.maximum(matrices, 0.0) + s @ z) / p.complementarity


def _length(fractions, x: Point, d: Direction):
    """Return the longest of some steps that leaves everything positive."""
    xp = namespace(x.y)
    # The linear inequalities hold up to the reciprocal of the largest speed.
    speeds = xp.concatenate([-d.s / x.s, -d.z / x.z])
    max_speed = xp.maximum(xp.max(speeds), 1.0)
    lengths = fractions / max_speed
    matrices = xp.concatenate([x.S, x.Z])
    changes = xp.concatenate([d.S, d.Z])
    # All lengths at once, on the last axis.
    steps = changes[..., None] * lengths[None, None, None]
    ends = matrices[..., None] + steps
    end_pivots = pivots(ends)
    is_positive = xp.all(end_pivots > 0, axis=(0, 1))
    # The fractions fall: the first that is good is the longest.
    max_length = lengths[xp.argmax(is_positive)]
    return xp.where(xp.any(is_positive), max_length, 0.0)


def _barriers(p: ConeProgram, inverse_S, Z, ratio):
    """Return the contribution of the bounds to the matrix of Newton's equations.

    The ratio is that of multipliers to slacks of the linear inequalities.
    """
    xp = p.xp
    products = _products(inverse_S, Z)
    body_products = products[: p.bodies]
    coupling_products = products[p.bodies :]
    body_ratio, lower_ratio, upper_ratio = p.split_linear(ratio)

    half_products = body_products @ p.basis.T[None]
    semidefinite_part = p.basis[None] @ half_products
    linear_part = xp.einsum("kri,kr,krj->kij", p.rows, body_ratio, p.rows)
    bodies = symmetric_part(semidefinite_part) + linear_part
    ridge = 1.0 + RIDGE * np.eye(p.width)
    bodies = bodies * ridge[None]

    couplings = xp.reshape(p.couplings, (*p.couplings.shape[:2], 16))
    weighted_couplings = xp.einsum("ikx,kxy->iky", couplings, coupling_products)
    coupled_part = xp.tensordot(weighted_couplings, couplings, ((1, 2), (1, 2)))
    drive_ratio = (1.0 + RIDGE) * (lower_ratio + upper_ratio)
    drives = xp.diag(drive_ratio) + symmetric_part(coupled_part)
    return _linalg(p).block_diag(*bodies, drives)


def _linalg(p: ConeProgram) -> ModuleType:
    """Return SciPy's linear algebra, or JAX's."""
    return scipy.linalg if p.xp is np else jax.scipy.linalg


def _products(inverse_S, Z):
    r"""Return matrices $M$ with $e^T M g = \mathrm{tr}(E S^{-1} G Z)$.

    $e$ and $g$ are $E$ and $G$, flattened.
    """
    xp = namespace(Z)
    product = inverse_S[:, None, :, :, None] * Z[:, :, None, None, :]
    return xp.reshape(product, (-1, 16, 16))


def _newton_solver(p: ConeProgram, H):
    """Return the solver of Newton's equations within the equality constraints."""
    xp = p.xp
    linalg = _linalg(p)
    try:
        factor = linalg.cho_factor(H, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        # NaN ends the search, as it does in JAX, whose factors are NaN.
        return lambda right_side: np.full_like(right_side, np.nan)

    def solve(right_side):
        return linalg.cho_solve(factor, right_side, check_finite=False)

    if not p.equalities.shape[0]:
        return solve
    normal_steps = xp.stack([solve(row) for row in p.equalities], axis=1)
    schur_complement = p.equalities @ normal_steps

    def solve_within(right_side):
        free_step = solve(right_side)
        violation = p.equalities @ free_step
        return free_step - normal_steps @ xp.linalg.solve(schur_complement, violation)

    return solve_within
