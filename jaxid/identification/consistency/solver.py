r"""A primal-dual interior point method for `ConeProgram`, in NumPy or compiled by JAX.

Newton's method solves the perturbed optimality conditions $S Z = \mu I$, $s z = \mu$; a
pull towards a prior's bodies ends with $S Z = \gamma I$ instead. The direction is that
of Helmberg, Kojima and Monteiro with Mehrotra's predictor and corrector. The corrector
is computed once more with the products of its own changes, and the longer step is
taken: it saves three iterations of fourteen for one more solution of a factored system.
    One step length serves both sides, since in a
quadratic program they are tied together. The variables are feasible from the start.

Certificate: for any feasible $y$ and any $Z, z \succeq 0$ with $r = \nabla f(y) -
    F^*(Z) - G^T z$,
convexity gives $f(y) - f^* \le \langle S, Z \rangle + s^T z + \sum_i |r_i| d_i$, where
$d_i$ bounds the distance between two feasible values of $y_i$. Nothing in it is
estimated.
"""

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxid.arrays import AnyArray, Bool, Float, Int

from .program import ConeProgram, Number
from .pseudo_inertia import BASIS, Values, inverse, pivots, symmetric_part

TOLERANCE = 2.5e-7
"""Error bound of a certified optimum, relative to objective and scale together."""
MAX_ITERATIONS = 50
STEPS = np.array(
    [1.0, *1.0 - np.geomspace(0.01, 0.64, 13), 0.28, 0.2, 0.13, 0.08, 0.04, 0.01]
)
"""Steps that are tried, as fractions of the longest that the linear inequalities allow."""
TINY = 1e-14


class Optimum(eqx.Module):
    """Result of the interior point method: half the squared residuals, with a bound of the error.

    It is certified if the bound is within the tolerance. The multipliers are those of
    the linear inequalities, `matrices` those of the semidefinite ones.
    """

    y: Float[AnyArray, "*batch variables"]
    value: Number
    error: Number
    certified: Bool[AnyArray, "*batch"] | np.bool
    iterations: Int[AnyArray, "*batch"] | np.integer
    multipliers: Float[AnyArray, "*batch linear"]
    matrices: Float[AnyArray, "*batch cones 4 4"]


class _Point(NamedTuple):
    """Variables, slacks, multipliers, and their distance from the optimum."""

    y: Values
    S: Values
    s: Values
    Z: Values
    z: Values
    residual: Values
    value: Values
    error: Values


_Direction = tuple[Values, ...]
"""Changes of `y`, `S`, `s`, `Z` and `z`."""


def solve_in_numpy(program: ConeProgram) -> Optimum:
    """Solve one program in NumPy: some tens of milliseconds, and nothing to compile."""

    def loop(goes_on: Callable, iterate: Callable, state: tuple) -> tuple:
        while goes_on(state):
            state = iterate(state)
        return state

    with np.errstate(all="ignore"):
        return _solve(np, program, loop)


@jax.jit
def solve_compiled(program: ConeProgram) -> Optimum:
    """Solve one program; works under `jit` and `vmap`."""
    return _solve(jnp, jax.tree.map(jnp.asarray, program), jax.lax.while_loop)


def _solve(xp: ModuleType, p: ConeProgram, loop: Callable) -> Optimum:
    """Iterate until certified, or until four iterations have brought no progress."""
    # The diagonal is raised by less than rounding.
    gram = (p.A.T @ p.A) * (1.0 + TINY * np.eye(p.A.shape[-1]))

    def is_certified(value: Values, error: Values) -> Values:
        return error <= TOLERANCE * (p.scale + value)

    def iterate(state: tuple) -> tuple:
        point, best, iterations, stalled, _ = state
        point, length = _step(xp, p, gram, point)
        better = point.error < best[-1]
        new = point.y, point.z, point.Z, point.value, point.error
        best = tuple(xp.where(better, a, b) for a, b in zip(new, best, strict=True))
        stalled, iterations = xp.where(better, 0, stalled + 1), iterations + 1
        finished = (
            is_certified(point.value, point.error)
            | ~xp.isfinite(point.error)
            | (length < 1e-8)
            | (stalled >= 4)
            | (iterations >= MAX_ITERATIONS)
        )
        return point, best, iterations, stalled, finished

    S, s = p.slacks(xp, p.start)
    inverse_S, rest = inverse(xp, S), p.A @ p.start - p.b
    # Multipliers on the start's central path, as large as its gradient.
    force = xp.linalg.norm(p.adjoint(xp, inverse_S, 1.0 / s))
    most = (0.5 * rest @ rest + TINY) / p.complementarity
    mu = xp.clip(xp.linalg.norm(rest @ p.A) / force, 1e-6 * most, most)
    Z = xp.maximum(_targets(xp, p), mu) * inverse_S
    first, zero = _point(xp, p, p.start, Z, mu / s), xp.zeros((), int)
    best = first.y, first.z, first.Z, first.value, first.error
    final = loop(lambda state: ~state[-1], iterate, (first, best, zero, zero, zero > 0))
    _, (y, z, Z, value, error), iterations, _, _ = final
    return Optimum(y, value, error, is_certified(value, error), iterations, z, Z)


def prices(p: ConeProgram, optimum: Optimum) -> Float[np.ndarray, " linear"]:
    """Return by how much the objective would fall without each linear bound, to second order.

    It is in units of half a squared standard deviation, whatever the units of the
    bounds.
    """
    S, s = p.slacks(np, np.asarray(optimum.y))
    z, Z = np.asarray(optimum.multipliers), np.asarray(optimum.matrices)
    curvature = p.A.T @ p.A * (1.0 + TINY * np.eye(p.A.shape[-1]))
    solve = _newton_solver(
        np, p, curvature + _barriers(np, p, inverse(np, S), Z, z / s)
    )
    rows = np.stack([p.linear(np, y)[1] for y in np.eye(p.A.shape[-1])], axis=1)
    compliance = np.array([row @ solve(row) for row in rows])
    # Without the bound's own part of the curvature, and then a step of Newton's method.
    compliance = compliance / np.maximum(1.0 - z / s * compliance, 1e-12)
    return 0.5 * z * np.maximum(z * compliance - s, 0.0)


def _point(xp: ModuleType, p: ConeProgram, y: Values, Z: Values, z: Values) -> _Point:
    """Compute slacks, the residual of the optimality conditions, and the error bound."""
    S, s = p.slacks(xp, y)
    rest = p.A @ y - p.b
    more = xp.zeros_like(p.fillings)
    pull = p.adjoint(xp, xp.concatenate([p.pull * p.prior, more]), xp.zeros_like(z))
    residual = rest @ p.A + pull - p.adjoint(xp, Z, z)
    if p.equal.shape[0]:
        # Differences of feasible variables are orthogonal to the equality constraints.
        normal = xp.linalg.solve(p.equal @ p.equal.T, p.equal @ residual)
        residual = residual - p.equal.T @ normal
    value = 0.5 * rest @ rest
    # The duality gap of the matrices; if pulled, with the eigenvalues of S Z / pull,
    # all one at the optimum: their sum less that of one and of their logarithms.
    product = xp.sum(S * Z, axis=(-2, -1))
    gap, pulled = product[: p.bodies], p.pull > 0
    logs = sum(xp.sum(xp.log(pivots(xp, M[: p.bodies])), axis=0) for M in (S, Z))
    strength = 4.0 * xp.log(xp.where(pulled, p.pull, 1.0))
    gap = xp.where(pulled, gap - 4.0 * p.pull - p.pull * (logs - strength), gap)
    gap = xp.sum(gap) + xp.sum(product[p.bodies :])
    error = gap + s @ z + xp.sum(xp.abs(residual) * p.diameters)
    return _Point(y, S, s, Z, z, residual, value, error)


def _targets(xp: ModuleType, p: ConeProgram) -> Values:
    """Return the products of slacks and multipliers at the optimum: the pull's strength."""
    strengths = [xp.ones(p.bodies) * p.pull, xp.zeros(len(p.fillings))]
    return xp.concatenate(strengths)[:, None, None]


def _step(
    xp: ModuleType, p: ConeProgram, gram: Values, x: _Point
) -> tuple[_Point, Values]:
    """Take the longer step of two correctors; return the new point and the step length."""
    inverse_S, ratio, target = inverse(xp, x.S), x.z / x.s, _targets(xp, p)
    solve = _newton_solver(xp, p, gram + _barriers(xp, p, inverse_S, x.Z, ratio))

    def direction(rZ: Values, rz: Values, right: Values) -> _Direction:
        """Return the direction of a right-hand side of the optimality conditions."""
        dy = solve(right)
        dS, ds = p.linear(xp, dy)
        dZ = rZ - symmetric_part(xp, inverse_S @ dS @ x.Z)
        return dy, dS, ds, dZ, rz - ratio * ds

    def toward(mu: Values, second_Z: Values, second_z: Values) -> _Direction:
        """Return the direction towards products `target + mu`, less second-order terms."""
        rZ = (target + mu) * inverse_S - x.Z - second_Z
        rz = mu / x.s - x.z - second_z
        return direction(rZ, rz, p.adjoint(xp, rZ, rz) - x.residual)

    def correct(mu: Values, d: _Direction) -> _Direction:
        """Return the direction with the products of changes along `d`."""
        _, dS, ds, dZ, dz = d
        return toward(mu, symmetric_part(xp, inverse_S @ dS @ dZ), ds * dz / x.s)

    def complementarity(S: Values, s: Values, Z: Values, z: Values) -> Values:
        matrices = xp.sum(S * Z) - 4.0 * p.bodies * p.pull
        return (xp.maximum(matrices, 0.0) + s @ z) / p.complementarity

    mu = complementarity(*x[1:5]) + 1e-300
    predictor = toward(0.0, 0.0, 0.0)
    # The predictor only decides how much to centre: a coarser choice of steps suffices.
    a = _length(xp, STEPS[::3], x, predictor)
    moved = [u + a * v for u, v in zip(x[1:5], predictor[1:], strict=True)]
    ahead = complementarity(*moved)
    centre = xp.clip((ahead / mu) ** 3, 1e-6, 1.0)
    centre = xp.where(a < 0.1, xp.maximum(centre, 0.5), centre)
    first = correct(centre * mu, predictor)
    second = correct(centre * mu, first)
    lengths = _length(xp, STEPS, x, first), _length(xp, STEPS, x, second)
    longer = lengths[1] > lengths[0]
    d = tuple(xp.where(longer, b, a) for a, b in zip(first, second, strict=True))
    length = xp.maximum(*lengths)

    def refined() -> tuple[Values, ...]:
        """Remove what rounding has left of the optimality conditions."""
        dy, _, _, dZ, dz = d
        rest = p.adjoint(xp, dZ, dz) - x.residual - (p.A @ dy) @ p.A
        more = direction(xp.zeros_like(dZ), xp.zeros_like(dz), rest)
        total = tuple(a + b for a, b in zip(d, more, strict=True))
        return *total, _length(xp, STEPS, x, total)

    # Near the boundary rounding leaves a residual that the error bound counts.
    wanted = (x.error <= 1e-3 * (p.scale + x.value)) & (
        xp.sum(xp.abs(x.residual) * p.diameters) > 0.1 * x.error
    )
    if xp is np:
        dy, _, _, dZ, dz, length = refined() if wanted else (*d, length)
    else:
        dy, _, _, dZ, dz, length = jax.lax.cond(wanted, refined, lambda: (*d, length))
    a = 0.99 * length
    return _point(xp, p, x.y + a * dy, x.Z + a * dZ, x.z + a * dz), a


def _length(xp: ModuleType, steps: np.ndarray, x: _Point, d: _Direction) -> Values:
    """Return the longest of some steps that leaves everything positive."""
    _, dS, ds, dZ, dz = d
    fastest = xp.maximum(xp.max(-ds / x.s), xp.max(-dz / x.z))
    lengths = steps * xp.minimum(1.0, 1.0 / xp.maximum(fastest, 1e-300))
    matrices, changes = xp.concatenate([x.S, x.Z]), xp.concatenate([dS, dZ])
    tried = matrices[..., None] + changes[..., None] * lengths[None, None, None]
    good = xp.all(pivots(xp, tried) > 0, axis=(0, 1))
    return xp.where(xp.any(good), lengths[xp.argmax(good)], 0.0)


def _barriers(xp: ModuleType, p: ConeProgram, inverse_S, Z, ratio) -> Values:
    """Return the contribution of the bounds to the matrix of Newton's equations."""
    K, w, n = p.bodies, p.width, p.drives
    flat = BASIS[:w].reshape(w, 16)
    bodies = flat[None] @ _products(xp, inverse_S[:K], Z[:K]) @ flat.T[None]
    count = K * p.rows.shape[-2]
    linear = xp.reshape(ratio[:count], (K, -1))
    bodies = symmetric_part(xp, bodies) + xp.einsum(
        "kri,kr,krj->kij", p.rows, linear, p.rows
    )
    bodies = bodies * (1.0 + TINY * np.eye(w))[None]
    drives = xp.diag((1.0 + TINY) * (ratio[count : count + n] + ratio[count + n :]))
    block_diagonal = (
        scipy.linalg.block_diag if xp is np else jax.scipy.linalg.block_diag
    )
    flat = xp.reshape(p.couplings, (*p.couplings.shape[:2], 16))
    mixed = xp.einsum("ikx,kxy->iky", flat, _products(xp, inverse_S[K:], Z[K:]))
    more = symmetric_part(xp, xp.tensordot(mixed, flat, ((1, 2), (1, 2))))
    return block_diagonal(*bodies, drives) + p.members.T @ more @ p.members


def _products(xp: ModuleType, inverse_S: Values, Z: Values) -> Values:
    r"""Return matrices $M$ with $e^T M g = \mathrm{tr}(E S^{-1} G Z)$ for flattened $E$ and $G$."""
    product = inverse_S[:, None, :, :, None] * Z[:, :, None, None, :]
    return xp.reshape(product, (-1, 16, 16))


def _newton_solver(
    xp: ModuleType, p: ConeProgram, H: Values
) -> Callable[[Values], Values]:
    """Return the solver of Newton's equations within the equality constraints."""
    linalg = scipy.linalg if xp is np else jax.scipy.linalg
    try:
        factor = linalg.cho_factor(H, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return lambda r: np.full_like(r, np.nan)

    def solve(r: Values) -> Values:
        return linalg.cho_solve(factor, r, check_finite=False)

    if not p.equal.shape[0]:
        return solve
    normal = xp.stack([solve(row) for row in p.equal], axis=1)
    square = p.equal @ normal

    def within(r: Values) -> Values:
        unconstrained = solve(r)
        return unconstrained - normal @ xp.linalg.solve(square, p.equal @ unconstrained)

    return within
