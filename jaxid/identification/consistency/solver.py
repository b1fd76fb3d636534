r"""A primal-dual interior point method for `ConeProgram`, in NumPy or compiled by JAX.

Newton's method solves the perturbed optimality conditions $S Z = \mu I$, $s z = \mu$; a pull
towards a prior's bodies ends with $S Z = \gamma I$ instead. The direction is that of Helmberg,
Kojima and Monteiro with Mehrotra's predictor and corrector. The corrector is computed once more
with the products of its own changes, and the longer step is taken: it saves three iterations of
fourteen for one more solution of a factored system. One step length serves both sides, since in a
quadratic program they are tied together. The variables are feasible from the start.

Certificate: for any feasible $y$ and any $Z, z \succeq 0$ with $r = \nabla f(y) - F^*(Z) - G^T z$,
convexity gives $f(y) - f^* \le \langle S, Z \rangle + s^T z + \sum_i |r_i| d_i$, where $d_i$ bounds
the distance between two feasible values of $y_i$. Nothing in it is estimated.
"""

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxid.arrays import AnyArray, Array, Bool, Float, Int, require_float64
from jaxid.identification.consistency.cone_program import ConeProgram, indicators
from jaxid.identification.consistency.feasible_set import Number
from jaxid.identification.consistency.pseudo_inertia import (
    BASIS,
    Values,
    are_definite,
    inverse,
    log_determinant,
    symmetric_part,
)

TOLERANCE = 2.5e-7
"""Error bound of a certified optimum, relative to objective and scale together."""
MAX_ITERATIONS = 50
STEPS = np.array([1.0, *1.0 - np.geomspace(0.01, 0.64, 13), 0.28, 0.2, 0.13, 0.08, 0.04, 0.01])
"""Steps that are tried, as fractions of the longest that the linear inequalities allow."""
TINY = 1e-14


class Optimum(eqx.Module):
    """Result of the interior point method.

    Attributes:
        y: Feasible variables.
        value: Half the squared residuals.
        error: Bound of the objective's distance to its optimum.
        certified: Whether the bound is within the tolerance.
        iterations: Number of iterations.
        multipliers: Multipliers of the linear inequalities.
    """

    y: Float[AnyArray, "*batch variables"]
    value: Number
    error: Number
    certified: Bool[AnyArray, "*batch"] | np.bool
    iterations: Int[AnyArray, "*batch"] | np.integer
    multipliers: Float[AnyArray, "*batch linear"]


class Point(NamedTuple):
    """Variables, slacks, multipliers, and their distance from the optimum."""

    y: Values
    S: Values
    s: Values
    Z: Values
    z: Values
    residual: Values
    value: Values
    error: Values


class Direction(NamedTuple):
    """Changes of variables, slacks and multipliers."""

    y: Values
    S: Values
    s: Values
    Z: Values
    z: Values


class _State(NamedTuple):
    """State of the iteration; `best` holds the returned parts of the best point."""

    point: Point
    best: tuple[Values, Values, Values, Values]
    iterations: Values
    stalled: Values
    finished: Values


class _Backend(NamedTuple):
    """Arithmetic by NumPy or JAX.

    Attributes:
        xp: NumPy or `jax.numpy`.
        factor: Solver of a positive definite system; it reads the lower triangle.
        block_diagonal: Matrix with given blocks on its diagonal.
        choose: Result of one of two functions without arguments.
    """

    xp: ModuleType
    factor: Callable[[Values], Callable[[Values], Values]]
    block_diagonal: Callable[..., Values]
    choose: Callable[[Values, Callable[[], tuple], Callable[[], tuple]], tuple]


def _factor_in_numpy(H: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return lambda r: np.full_like(r, np.nan)
    return lambda r: scipy.linalg.cho_solve(factor, r, check_finite=False)


def _factor_compiled(H: Array) -> Callable[[Array], Array]:
    L = jax.lax.linalg.cholesky(H, symmetrize_input=False)
    return lambda r: jax.scipy.linalg.cho_solve((L, True), r)


_NUMPY = _Backend(
    np, _factor_in_numpy, scipy.linalg.block_diag, lambda first, a, b: a() if first else b()
)
_JAX = _Backend(jnp, _factor_compiled, jax.scipy.linalg.block_diag, jax.lax.cond)


def solve_in_numpy(program: ConeProgram) -> Optimum:
    """Solve one program in NumPy: some tens of milliseconds, and nothing to compile."""
    with np.errstate(all="ignore"):
        state, gram = _first(_NUMPY, program), _information(program)
        while not state.finished:
            state = _next(_NUMPY, program, gram, state)
        return _optimum(program, state)


@jax.jit
def solve_compiled(program: ConeProgram) -> Optimum:
    """Solve one program; works under `jit` and `vmap`."""
    require_float64("the search for physically consistent parameters")
    program = jax.tree.map(jnp.asarray, program)
    gram = _information(program)
    state = jax.lax.while_loop(
        lambda x: ~x.finished,
        lambda x: _next(_JAX, program, gram, x),
        _first(_JAX, program),
    )
    return _optimum(program, state)


def _information(p: ConeProgram) -> Values:
    """Return the information of the data, its diagonal raised by less than rounding."""
    return (p.A.T @ p.A) * (1.0 + TINY * np.eye(p.A.shape[-1]))


def _optimum(program: ConeProgram, state: _State) -> Optimum:
    y, z, value, error = state.best
    certified = _is_certified(program, value, error)
    return Optimum(y, value, error, certified, state.iterations, z)


def _is_certified(p: ConeProgram, value: Values, error: Values) -> Values:
    return error <= TOLERANCE * (p.scale + value)


def _first(backend: _Backend, p: ConeProgram) -> _State:
    """Return the start, with multipliers on its central path as large as its gradient."""
    xp, y = backend.xp, p.start
    S, s = p.slacks(xp, y)
    inverse_S = inverse(xp, S)
    rest = p.A @ y - p.b
    value = 0.5 * rest @ rest
    force = xp.linalg.norm(p.adjoint(xp, inverse_S, 1.0 / s))
    most = (value + TINY) / p.complementarity
    mu = xp.clip(xp.linalg.norm(rest @ p.A) / force, 1e-6 * most, most)
    Z = xp.maximum(_targets(xp, p), mu) * inverse_S
    point = _point(xp, p, y, Z, mu / s)
    zero = xp.zeros((), int)
    return _State(point, (y, point.z, point.value, point.error), zero, zero, zero > 0)


def _next(backend: _Backend, p: ConeProgram, gram: Values, state: _State) -> _State:
    """Perform one iteration; stop if certified, or after four iterations without progress."""
    xp = backend.xp
    point, length = _step(backend, p, gram, state.point)
    better = point.error < state.best[-1]
    new = point.y, point.z, point.value, point.error
    y, z, value, error = (xp.where(better, a, b) for a, b in zip(new, state.best, strict=True))
    stalled = xp.where(better, 0, state.stalled + 1)
    iterations = state.iterations + 1
    finished = (
        _is_certified(p, point.value, point.error)
        | ~xp.isfinite(point.error)
        | (length < 1e-8)
        | (stalled >= 4)
        | (iterations >= MAX_ITERATIONS)
    )
    return _State(point, (y, z, value, error), iterations, stalled, finished)


def _point(xp: ModuleType, p: ConeProgram, y: Values, Z: Values, z: Values) -> Point:
    """Compute slacks, the residual of the optimality conditions, and the error bound."""
    S, s = p.slacks(xp, y)
    rest = p.A @ y - p.b
    more = xp.zeros((p.members.shape[-2], 4, 4))
    pull = p.adjoint(xp, xp.concatenate([p.pull * p.prior, more]), xp.zeros_like(z))
    residual = rest @ p.A + pull - p.adjoint(xp, Z, z)
    if p.equal.shape[0]:
        # Differences of feasible variables are orthogonal to the equality constraints.
        normal = xp.linalg.solve(p.equal @ p.equal.T, p.equal @ residual)
        residual = residual - p.equal.T @ normal
    value = 0.5 * rest @ rest
    error = _matrix_gap(xp, p, S, Z) + s @ z + xp.sum(xp.abs(residual) * p.diameters)
    return Point(y, S, s, Z, z, residual, value, error)


def _targets(xp: ModuleType, p: ConeProgram) -> Values:
    """Return the products of slacks and multipliers at the optimum: the pull's strength."""
    strengths = [xp.ones(p.bodies) * p.pull, xp.zeros(p.members.shape[-2])]
    return xp.concatenate(strengths)[:, None, None]


def _matrix_gap(xp: ModuleType, p: ConeProgram, S: Values, Z: Values) -> Values:
    r"""Return the duality gap of the matrices: $\gamma \sum (\lambda - 1 - \ln \lambda)$ if pulled.

    There $\lambda$ are the eigenvalues of $S Z / \gamma$, all one at the optimum.
    """
    product = xp.sum(S * Z, axis=(-2, -1))
    bodies, more = product[: p.bodies], product[p.bodies :]
    pulled = p.pull > 0
    strength = xp.where(pulled, p.pull, 1.0)
    logs = log_determinant(xp, S[: p.bodies]) + log_determinant(xp, Z[: p.bodies])
    entropic = bodies - 4.0 * p.pull - p.pull * (logs - 4.0 * xp.log(strength))
    return xp.sum(xp.where(pulled, entropic, bodies)) + xp.sum(more)


class _NewtonSystem:
    """Newton's equations of a program at a point."""

    def __init__(self, backend: _Backend, p: ConeProgram, gram: Values, x: Point):
        self.xp, self.p, self.x = backend.xp, p, x
        self.inverse_S = inverse(self.xp, x.S)
        self.ratio = x.z / x.s
        barriers = _barriers(backend, p, self.inverse_S, x.Z, self.ratio)
        self.solve = _equality_solver(backend, p, gram + barriers)

    def direction(self, rZ: Values, rz: Values, right: Values) -> Direction:
        """Return the direction of a right-hand side of the optimality conditions."""
        xp, dy = self.xp, self.solve(right)
        dS, ds = self.p.linear(xp, dy)
        dZ = rZ - symmetric_part(xp, self.inverse_S @ dS @ self.x.Z)
        return Direction(dy, dS, ds, dZ, rz - self.ratio * ds)

    def toward(self, target: Values, mu: Values, second_Z: Values, second_z: Values) -> Direction:
        """Return the direction towards products `target + mu`, less second-order terms."""
        rZ = (target + mu) * self.inverse_S - self.x.Z - second_Z
        rz = mu / self.x.s - self.x.z - second_z
        return self.direction(rZ, rz, self.p.adjoint(self.xp, rZ, rz) - self.x.residual)

    def correct(self, target: Values, mu: Values, d: Direction) -> Direction:
        """Return the direction with the products of changes along `d`."""
        second = symmetric_part(self.xp, self.inverse_S @ d.S @ d.Z)
        return self.toward(target, mu, second, d.s * d.z / self.x.s)

    def refine(self, d: Direction) -> Direction:
        """Remove what rounding has left of the optimality conditions."""
        xp, p = self.xp, self.p
        rest = p.adjoint(xp, d.Z, d.z) - self.x.residual - (p.A @ d.y) @ p.A
        more = self.direction(xp.zeros_like(d.Z), xp.zeros_like(d.z), rest)
        return Direction(*(a + b for a, b in zip(d, more, strict=True)))


def _step(backend: _Backend, p: ConeProgram, gram: Values, x: Point) -> tuple[Point, Values]:
    """Take the longer step of two correctors; return the new point and the step length."""
    xp = backend.xp
    newton, target = _NewtonSystem(backend, p, gram, x), _targets(xp, p)

    def complementarity(S: Values, Z: Values, s: Values, z: Values) -> Values:
        matrices = xp.sum(S * Z) - 4.0 * p.bodies * p.pull
        return (xp.maximum(matrices, 0.0) + s @ z) / p.complementarity

    mu = complementarity(x.S, x.Z, x.s, x.z) + 1e-300
    predictor = newton.toward(target, 0.0, 0.0, 0.0)
    # The predictor only decides how much to centre: a coarser choice of steps suffices.
    a = _length(xp, STEPS[::3], x, predictor)
    ahead = complementarity(
        x.S + a * predictor.S,
        x.Z + a * predictor.Z,
        x.s + a * predictor.s,
        x.z + a * predictor.z,
    )
    centre = xp.clip((ahead / mu) ** 3, 1e-6, 1.0)
    centre = xp.where(a < 0.1, xp.maximum(centre, 0.5), centre)
    first = newton.correct(target, centre * mu, predictor)
    second = newton.correct(target, centre * mu, first)
    lengths = _length(xp, STEPS, x, first), _length(xp, STEPS, x, second)
    longer = lengths[1] > lengths[0]
    d = Direction(*(xp.where(longer, b, a) for a, b in zip(first, second, strict=True)))
    length = xp.maximum(*lengths)

    def refined() -> tuple[Values, ...]:
        more = newton.refine(d)
        return *more, _length(xp, STEPS, x, more)

    # Near the boundary rounding leaves a residual that the error bound counts.
    near = x.error <= 1e-3 * (p.scale + x.value)
    counts = xp.sum(xp.abs(x.residual) * p.diameters) > 0.1 * x.error
    dy, _, _, dZ, dz, length = backend.choose(near & counts, refined, lambda: (*d, length))
    a = 0.99 * length
    return _point(xp, p, x.y + a * dy, x.Z + a * dZ, x.z + a * dz), a


def _length(xp: ModuleType, steps: np.ndarray, x: Point, d: Direction) -> Values:
    """Return the longest of some steps that leaves everything positive."""
    fastest = xp.maximum(xp.max(-d.s / x.s), xp.max(-d.z / x.z))
    lengths = steps * xp.minimum(1.0, 1.0 / xp.maximum(fastest, 1e-300))
    matrices, changes = xp.concatenate([x.S, x.Z]), xp.concatenate([d.S, d.Z])
    tried = matrices[..., None] + changes[..., None] * lengths[None, None, None]
    good = xp.all(are_definite(tried), axis=0)
    return xp.where(xp.any(good), lengths[xp.argmax(good)], 0.0)


def _barriers(
    backend: _Backend, p: ConeProgram, inverse_S: Values, Z: Values, ratio: Values
) -> Values:
    """Return the contribution of the bounds to the matrix of Newton's equations."""
    xp, K, w, n = backend.xp, p.bodies, p.width, p.drives
    flat = BASIS[:w].reshape(w, 16)
    bodies = flat[None] @ _products(xp, inverse_S[:K], Z[:K]) @ flat.T[None]
    count = K * p.rows.shape[-2]
    linear = xp.reshape(ratio[:count], (K, -1))
    bodies = symmetric_part(xp, bodies) + xp.einsum("kri,kr,krj->kij", p.rows, linear, p.rows)
    bodies = bodies * (1.0 + TINY * np.eye(w))[None]
    drives = xp.diag((1.0 + TINY) * (ratio[count : count + n] + ratio[count + n :]))
    H = backend.block_diagonal(*bodies, drives)
    if p.members.shape[-2]:
        flat = xp.reshape(p.couplings, (*p.members.shape, 16))
        more = flat @ _products(xp, inverse_S[K:], Z[K:]) @ xp.swapaxes(flat, -1, -2)
        ones = indicators(p.members, H.shape[0])
        H = H + xp.einsum("kia,kij,kjb->ab", ones, symmetric_part(xp, more), ones)
    return H


def _products(xp: ModuleType, inverse_S: Values, Z: Values) -> Values:
    r"""Return matrices $M$ with $e^T M g = \mathrm{tr}(E S^{-1} G Z)$ for flattened $E$ and $G$."""
    product = inverse_S[:, None, :, :, None] * Z[:, :, None, None, :]
    return xp.reshape(product, (-1, 16, 16))


def _equality_solver(backend: _Backend, p: ConeProgram, H: Values) -> Callable[[Values], Values]:
    """Return the solver of Newton's equations within the equality constraints."""
    xp, solve = backend.xp, backend.factor(H)
    if not p.equal.shape[0]:
        return solve
    normal = xp.stack([solve(row) for row in p.equal], axis=1)
    square = p.equal @ normal

    def within(r: Values) -> Values:
        unconstrained = solve(r)
        return unconstrained - normal @ xp.linalg.solve(square, p.equal @ unconstrained)

    return within
