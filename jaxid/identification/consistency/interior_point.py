r"""A primal-dual interior point method for `ConeProgram`, in NumPy at once or compiled by JAX.

Newton's method on the perturbed optimality conditions $S Z = \mu I$, $s z = \mu$ with the direction
of Helmberg, Kojima and Monteiro, predictor and corrector as of Mehrotra, and one step length for
both sides. A pull towards bodies of a prior is the same loop with $S Z = \gamma I$ in the end. The
variables are feasible from the start; what remains of the optimality conditions is bounded.

Certificate: for any feasible $y$ and any $Z, z \succeq 0$ with $r = \nabla f(y) - F^*(Z) - G^T z$,
convexity gives $f(y) - f^* \le \langle S, Z \rangle + s^T z + \sum_i |r_i| d_i$, where $d_i$ bounds
how far two feasible values of $y_i$ are apart. Nothing in it is estimated.
"""

import enum
from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxid.identification.consistency import blocks
from jaxid.identification.consistency.cone_program import (
    ConeProgram,
    Number,
    Values,
    indicators,
)
from jaxid.identification.consistency.pseudo_inertia import BASIS
from jaxid.types import AnyArray, Array, Bool, Float, Int, require_float64

STEPS = np.array([1.0, *1.0 - np.geomspace(0.01, 0.64, 13), 0.28, 0.2, 0.13, 0.08, 0.04, 0.01])
TOLERANCE = 2.5e-7
"""Error bound at which an optimum counts as found, as a share of objective and scale together."""
NEAR = 1e-3
"""Error bound, likewise, from which rounding matters."""
MOST = 50
PATIENCE = 4
"""Iterations without a better bound after which the search ends."""
TINY = 1e-14


class Outcome(enum.Enum):
    """How the search for the optimum ended."""

    CERTIFIED = "the optimum was found, with a proof of its error bound."
    STALLED = (
        "rounding kept the error bound from falling below its tolerance: the data are scaled "
        "badly, or bounds nearly contradict each other; widen the bounds, or pass `throw=False` "
        "to take the estimate with the bound that it has."
    )
    ITERATIONS = (
        "the iterations did not suffice for the error bound to fall below its tolerance; pass "
        "`throw=False` to take the estimate with the bound that it has."
    )


class Optimum(eqx.Module):
    """Where an interior point method has ended.

    Attributes:
        y: Feasible variables.
        value: Half the squares that they leave.
        error: Bound of the objective's distance to its optimum.
        certified: Whether the bound is within the tolerance.
        iterations: How many it took.
        multipliers: Of the linear functions.
    """

    y: Float[AnyArray, "*batch variables"]
    value: Number
    error: Number
    certified: Bool[AnyArray, "*batch"] | np.bool
    iterations: Int[AnyArray, "*batch"] | np.integer
    multipliers: Float[AnyArray, "*batch linear"]


class _Point(NamedTuple):
    """Variables, slacks and multipliers, and how far they are from the optimum."""

    y: Values
    S: Values
    s: Values
    Z: Values
    z: Values
    residual: Values
    value: Values
    error: Values


class _State(NamedTuple):
    point: _Point
    best: _Point
    iterations: Values
    stalled: Values
    finished: Values


class _Machine(NamedTuple):
    """What does the arithmetic.

    Attributes:
        xp: NumPy, or what JAX has in its place.
        factor: Solver of a positive definite system.
        choose: One of two functions without arguments, and what it returns.
    """

    xp: ModuleType
    factor: Callable[[Values], Callable[[Values], Values]]
    choose: Callable[[Values, Callable[[], tuple], Callable[[], tuple]], tuple]


def solve_at_once(program: ConeProgram) -> Optimum:
    """Solves one program in NumPy: some tens of milliseconds, and nothing to compile."""
    with np.errstate(all="ignore"):
        state, gram = _first(_NUMPY, program), program.A.T @ program.A
        while not state.finished:
            state = _next(_NUMPY, program, gram, state)
        return _optimum(program, state)


@jax.jit
def solve_compiled(program: ConeProgram) -> Optimum:
    """Solves one program; works under `jit` and `vmap`."""
    require_float64("the search for physically consistent parameters")
    program = jax.tree.map(jnp.asarray, program)
    gram = program.A.T @ program.A
    state = jax.lax.while_loop(
        lambda x: ~x.finished,
        lambda x: _next(_JAX, program, gram, x),
        _first(_JAX, program),
    )
    return _optimum(program, state)


def _optimum(program: ConeProgram, state: _State) -> Optimum:
    best = state.best
    certified = _proved(program, best)
    return Optimum(best.y, best.value, best.error, certified, state.iterations, best.z)


def _proved(p: ConeProgram, x: _Point) -> Values:
    return x.error <= TOLERANCE * (p.scale + x.value)


def _first(machine: _Machine, p: ConeProgram) -> _State:
    """Multipliers on the central path of the start, as large as its gradient."""
    xp = machine.xp
    y = p.start
    S = p.matrices(xp, y) + p.constant_matrices(xp)
    s = p.slacks(xp, y) + p.constant_slacks(xp)
    inverse = blocks.inverse(xp, S)
    away = p.A @ y - p.b
    value = 0.5 * away @ away
    force = xp.linalg.norm(p.adjoint(xp, inverse, 1.0 / s))
    most = (value + TINY) / p.complementarity
    mu = xp.clip(xp.linalg.norm(away @ p.A) / force, 1e-6 * most, most)
    Z = xp.maximum(_targets(xp, p), mu) * inverse
    point = _point(xp, p, y, Z, mu / s)
    zero = xp.zeros((), int)
    return _State(point, point, zero, zero, zero > 0)


def _point(xp: ModuleType, p: ConeProgram, y: Values, Z: Values, z: Values) -> _Point:
    """Slacks, residual of the optimality conditions, and the error bound."""
    S = p.matrices(xp, y) + p.constant_matrices(xp)
    s = p.slacks(xp, y) + p.constant_slacks(xp)
    away = p.A @ y - p.b
    nothing = xp.zeros_like(z)
    more = xp.zeros((p.members.shape[-2], 4, 4))
    toward = p.adjoint(xp, xp.concatenate([p.pull * p.prior, more]), nothing)
    residual = away @ p.A + toward - p.adjoint(xp, Z, z)
    if p.equal.shape[0]:
        # Differences of feasible variables are orthogonal to what is kept equal.
        normal = xp.linalg.solve(p.equal @ p.equal.T, p.equal @ residual)
        residual = residual - p.equal.T @ normal
    value = 0.5 * away @ away
    error = _gap(xp, p, S, Z) + s @ z + xp.sum(xp.abs(residual) * p.diameters)
    return _Point(y, S, s, Z, z, residual, value, error)


def _targets(xp: ModuleType, p: ConeProgram) -> Values:
    """The products of slacks and multipliers in the end: the pull's strength for bodies."""
    strengths = [xp.ones(p.bodies) * p.pull, xp.zeros(p.members.shape[-2])]
    return xp.concatenate(strengths)[:, None, None]


def _gap(xp: ModuleType, p: ConeProgram, S: Values, Z: Values) -> Values:
    r"""The duality gap of the matrices: $\gamma \sum (\lambda - 1 - \ln \lambda)$ with a pull.

    There $\lambda$ are the eigenvalues of $S Z / \gamma$, all one in the optimum.
    """
    product = xp.sum(S * Z, axis=(-2, -1))
    own, more = product[: p.bodies], product[p.bodies :]
    pulled = p.pull > 0
    strength = xp.where(pulled, p.pull, 1.0)
    logs = blocks.log_determinant(xp, S[: p.bodies]) + blocks.log_determinant(xp, Z[: p.bodies])
    bodies = own - 4.0 * p.pull - p.pull * (logs - 4.0 * xp.log(strength))
    return xp.sum(xp.where(pulled, bodies, own)) + xp.sum(more)


def _next(machine: _Machine, p: ConeProgram, gram: Values, state: _State) -> _State:
    """One iteration, and whether it was the last."""
    xp = machine.xp
    point, length = _moved(machine, p, gram, state.point)
    better = point.error < state.best.error
    best = _Point(*(xp.where(better, a, b) for a, b in zip(point, state.best, strict=True)))
    stalled = xp.where(better, 0, state.stalled + 1)
    iterations = state.iterations + 1
    finished = (
        _proved(p, point)
        | ~xp.isfinite(point.error)
        | (length < 1e-8)
        | (stalled >= PATIENCE)
        | (iterations >= MOST)
    )
    return _State(point, best, iterations, stalled, finished)


def _moved(machine: _Machine, p: ConeProgram, gram: Values, x: _Point) -> tuple[_Point, Values]:
    """Predictor, corrector, and the step between them and the boundary."""
    xp = machine.xp
    inverse = blocks.inverse(xp, x.S)
    ratio = x.z / x.s
    solve = _directions(machine, p, gram + _barriers(xp, p, inverse, x.Z, ratio))
    target = _targets(xp, p)

    def direction(rZ: Values, rz: Values, toward: Values) -> tuple[Values, ...]:
        dy = solve(toward)
        dS, ds = p.matrices(xp, dy), p.slacks(xp, dy)
        return dy, dS, ds, rZ - blocks.symmetric(xp, inverse @ dS @ x.Z), rz - ratio * ds

    def plain(rZ: Values, rz: Values) -> tuple[Values, ...]:
        return direction(rZ, rz, p.adjoint(xp, rZ, rz) - x.residual)

    def refined(rZ: Values, rz: Values) -> tuple[Values, ...]:
        # Near the boundary rounding leaves a residual that the error bound would count.
        found = plain(rZ, rz)
        dy, _, _, dZ, dz = found
        left = p.adjoint(xp, dZ, dz) - x.residual - (p.A @ dy) @ p.A
        more = direction(xp.zeros_like(rZ), xp.zeros_like(rz), left)
        return tuple(a + b for a, b in zip(found, more, strict=True))

    def complementarity(S: Values, Z: Values, s: Values, z: Values) -> Values:
        matrices = xp.sum(S * Z) - 4.0 * p.bodies * p.pull
        return (xp.maximum(matrices, 0.0) + s @ z) / p.complementarity

    mu = complementarity(x.S, x.Z, x.s, x.z) + 1e-300
    _, dS, ds, dZ, dz = plain(target * inverse - x.Z, -x.z)
    a = _length(xp, x, dS, ds, dZ, dz)
    ahead = complementarity(x.S + a * dS, x.Z + a * dZ, x.s + a * ds, x.z + a * dz)
    centre = xp.clip((ahead / mu) ** 3, 1e-6, 1.0)
    centre = xp.where(a < 0.1, xp.maximum(centre, 0.5), centre)
    second = blocks.symmetric(xp, inverse @ dS @ dZ)
    rZ = (target + centre * mu) * inverse - x.Z - second
    rz = centre * mu / x.s - x.z - ds * dz / x.s
    near = x.error <= NEAR * (p.scale + x.value)
    dy, dS, ds, dZ, dz = machine.choose(near, lambda: refined(rZ, rz), lambda: plain(rZ, rz))
    a = 0.99 * _length(xp, x, dS, ds, dZ, dz)
    return _point(xp, p, x.y + a * dy, x.Z + a * dZ, x.z + a * dz), a


def _length(xp: ModuleType, x: _Point, dS: Values, ds: Values, dZ: Values, dz: Values) -> Values:
    """The longest of some steps that leaves everything positive; exact for the linear functions."""
    fastest = xp.maximum(xp.max(-ds / x.s), xp.max(-dz / x.z))
    steps = STEPS * xp.minimum(1.0, 1.0 / xp.maximum(fastest, 1e-300))
    matrices, changes = xp.stack([x.S, x.Z])[None], xp.stack([dS, dZ])[None]
    good = blocks.definite(xp, matrices + steps[:, None, None, None, None] * changes)
    good = xp.all(good, axis=(1, 2))
    return xp.where(xp.any(good), steps[xp.argmax(good)], 0.0)


def _barriers(xp: ModuleType, p: ConeProgram, inverse: Values, Z: Values, ratio: Values) -> Values:
    """What the bounds add to the matrix of Newton's equations, beside the data's information."""
    K, w, n = p.bodies, p.width, p.drives
    flat = BASIS[:w].reshape(w, 16)
    own = flat[None] @ _sandwich(xp, inverse[:K], Z[:K]) @ flat.T[None]
    count = K * p.rows.shape[-2]
    linear = xp.reshape(ratio[:count], (K, -1))
    own = blocks.symmetric(xp, own) + xp.einsum("kri,kr,krj->kij", p.rows, linear, p.rows)
    diagonal = np.eye(K)[:, None, :, None]
    bodies = xp.reshape(own[:, :, None, :] * diagonal, (K * w, K * w))
    drives = xp.diag(ratio[count : count + n] + ratio[count + n :])
    corner = xp.zeros((K * w, n))
    H = xp.concatenate(
        [
            xp.concatenate([bodies, corner], axis=1),
            xp.concatenate([corner.T, drives], axis=1),
        ]
    )
    if p.members.shape[-2]:
        flat = xp.reshape(p.couplings, (*p.members.shape, 16))
        more = flat @ _sandwich(xp, inverse[K:], Z[K:]) @ xp.swapaxes(flat, -1, -2)
        ones = indicators(p.members, H.shape[0])
        H = H + xp.einsum("kia,kij,kjb->ab", ones, blocks.symmetric(xp, more), ones)
    return H


def _sandwich(xp: ModuleType, inverse: Values, Z: Values) -> Values:
    r"""The matrices $M$ with $e^T M g = \mathrm{tr}(E S^{-1} G Z)$ for flattened $E$ and $G$."""
    product = inverse[:, None, :, :, None] * Z[:, :, None, None, :]
    return xp.reshape(product, (-1, 16, 16))


def _directions(machine: _Machine, p: ConeProgram, H: Values) -> Callable[[Values], Values]:
    """Solves Newton's equations, along what may change."""
    xp = machine.xp
    solve = machine.factor(H + TINY * xp.diag(xp.diag(H)))
    if not p.equal.shape[0]:
        return solve
    bent = xp.stack([solve(row) for row in p.equal], axis=1)
    square = p.equal @ bent

    def along(r: Values) -> Values:
        free = solve(r)
        return free - bent @ xp.linalg.solve(square, p.equal @ free)

    return along


def _factor_at_once(H: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    try:
        factor = scipy.linalg.cho_factor(H, lower=True, check_finite=False)
    except np.linalg.LinAlgError:
        return lambda r: np.full_like(r, np.nan)
    return lambda r: scipy.linalg.cho_solve(factor, r, check_finite=False)


def _factor_compiled(H: Array) -> Callable[[Array], Array]:
    L = jnp.linalg.cholesky(H)
    return lambda r: jax.scipy.linalg.cho_solve((L, True), r)


_NUMPY = _Machine(np, _factor_at_once, lambda first, a, b: a() if first else b())
_JAX = _Machine(jnp, _factor_compiled, jax.lax.cond)
