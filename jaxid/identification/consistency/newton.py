"""Newton's equations of a `ConeProgram`, and how far one may go along their solutions.

The direction is that of Helmberg, Kojima and Monteiro: predictor and corrector as of Mehrotra, and
the corrector once more, with the products of its own changes in place of the predictor's. The
longer step is taken: it saves three iterations of fourteen for one more solution of a factored
system. One length serves both sides, since in a quadratic program they are tied together.
"""

from collections.abc import Callable
from types import ModuleType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from jaxid.arrays import Array
from jaxid.identification.consistency import blocks
from jaxid.identification.consistency.cone_program import ConeProgram, Values, indicators
from jaxid.identification.consistency.pseudo_inertia import BASIS

SHARES = np.array([1.0, *1.0 - np.geomspace(0.01, 0.64, 13), 0.28, 0.2, 0.13, 0.08, 0.04, 0.01])
"""Steps that are tried, as shares of what the linear functions allow."""
COARSE = SHARES[::3]
"""Those for the predictor: it only decides how much to centre."""
NEAR = 1e-3
"""Error bound, as a share of objective and scale together, from which rounding matters."""
COUNTS = 0.1
"""Share of the error bound from which what remains of the optimality conditions counts."""
SHORT = 0.99
"""Share of the way to the boundary that is gone."""
TINY = 1e-14


class Point(NamedTuple):
    """Variables, slacks and multipliers, and how far they are from the optimum."""

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


class Machine(NamedTuple):
    """What does the arithmetic.

    Attributes:
        xp: NumPy, or what JAX has in its place.
        factor: Solver of a positive definite system; it reads the lower triangle.
        block_diagonal: The matrix with some blocks on its diagonal.
        choose: One of two functions without arguments, and what it returns.
    """

    xp: ModuleType
    factor: Callable[[Values], Callable[[Values], Values]]
    block_diagonal: Callable[..., Values]
    choose: Callable[[Values, Callable[[], tuple], Callable[[], tuple]], tuple]


def point_of(xp: ModuleType, p: ConeProgram, y: Values, Z: Values, z: Values) -> Point:
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
    return Point(y, S, s, Z, z, residual, value, error)


def targets(xp: ModuleType, p: ConeProgram) -> Values:
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


def information(p: ConeProgram) -> Values:
    """The data's part of Newton's equations, its diagonal lifted by less than rounding."""
    return (p.A.T @ p.A) * (1.0 + TINY * np.eye(p.A.shape[-1]))


def moved(machine: Machine, p: ConeProgram, gram: Values, x: Point) -> tuple[Point, Values]:
    """Predictor, two correctors, and the step between the better one and the boundary."""
    xp = machine.xp
    inverse = blocks.inverse(xp, x.S)
    ratio = x.z / x.s
    solve = _directions(machine, p, gram + _barriers(machine, p, inverse, x.Z, ratio))
    target = targets(xp, p)

    def direction(rZ: Values, rz: Values, toward: Values) -> Direction:
        dy = solve(toward)
        dS, ds = p.matrices(xp, dy), p.slacks(xp, dy)
        return Direction(dy, dS, ds, rZ - blocks.symmetric(xp, inverse @ dS @ x.Z), rz - ratio * ds)

    def toward(rZ: Values, rz: Values) -> Direction:
        return direction(rZ, rz, p.adjoint(xp, rZ, rz) - x.residual)

    def refined(d: Direction) -> Direction:
        left = p.adjoint(xp, d.Z, d.z) - x.residual - (p.A @ d.y) @ p.A
        more = direction(xp.zeros_like(d.Z), xp.zeros_like(d.z), left)
        return Direction(*(a + b for a, b in zip(d, more, strict=True)))

    def complementarity(S: Values, Z: Values, s: Values, z: Values) -> Values:
        matrices = xp.sum(S * Z) - 4.0 * p.bodies * p.pull
        return (xp.maximum(matrices, 0.0) + s @ z) / p.complementarity

    mu = complementarity(x.S, x.Z, x.s, x.z) + 1e-300
    straight = toward(target * inverse - x.Z, -x.z)
    a = _length(xp, COARSE, x, straight)
    ahead = complementarity(
        x.S + a * straight.S,
        x.Z + a * straight.Z,
        x.s + a * straight.s,
        x.z + a * straight.z,
    )
    centre = xp.clip((ahead / mu) ** 3, 1e-6, 1.0)
    centre = xp.where(a < 0.1, xp.maximum(centre, 0.5), centre)

    def corrected(d: Direction) -> Direction:
        """What the products of changes add, as they are along `d`."""
        second = blocks.symmetric(xp, inverse @ d.S @ d.Z)
        return toward(
            (target + centre * mu) * inverse - x.Z - second,
            centre * mu / x.s - x.z - d.s * d.z / x.s,
        )

    once = corrected(straight)
    twice = corrected(once)
    lengths = _length(xp, SHARES, x, once), _length(xp, SHARES, x, twice)
    longer = lengths[1] > lengths[0]
    d = Direction(*(xp.where(longer, b, a) for a, b in zip(once, twice, strict=True)))
    length = xp.maximum(*lengths)

    def mended() -> tuple[Values, ...]:
        more = refined(d)
        return *more, _length(xp, SHARES, x, more)

    # Near the boundary rounding leaves a residual that the error bound counts.
    near = x.error <= NEAR * (p.scale + x.value)
    counts = xp.sum(xp.abs(x.residual) * p.diameters) > COUNTS * x.error
    dy, _, _, dZ, dz, length = machine.choose(near & counts, mended, lambda: (*d, length))
    a = SHORT * length
    return point_of(xp, p, x.y + a * dy, x.Z + a * dZ, x.z + a * dz), a


def _length(xp: ModuleType, shares: np.ndarray, x: Point, d: Direction) -> Values:
    """The longest of some steps that leaves everything positive; exact for the linear functions."""
    fastest = xp.maximum(xp.max(-d.s / x.s), xp.max(-d.z / x.z))
    steps = shares * xp.minimum(1.0, 1.0 / xp.maximum(fastest, 1e-300))
    matrices, changes = xp.concatenate([x.S, x.Z]), xp.concatenate([d.S, d.Z])
    tried = matrices[..., None] + changes[..., None] * steps[None, None, None]
    good = xp.all(blocks.definite(xp, tried), axis=0)
    return xp.where(xp.any(good), steps[xp.argmax(good)], 0.0)


def _barriers(
    machine: Machine, p: ConeProgram, inverse: Values, Z: Values, ratio: Values
) -> Values:
    """What the bounds add to the matrix of Newton's equations, beside the data's information."""
    xp, K, w, n = machine.xp, p.bodies, p.width, p.drives
    flat = BASIS[:w].reshape(w, 16)
    own = flat[None] @ _sandwich(xp, inverse[:K], Z[:K]) @ flat.T[None]
    count = K * p.rows.shape[-2]
    linear = xp.reshape(ratio[:count], (K, -1))
    own = blocks.symmetric(xp, own) + xp.einsum("kri,kr,krj->kij", p.rows, linear, p.rows)
    own = own * (1.0 + TINY * np.eye(w))[None]
    drives = xp.diag((1.0 + TINY) * (ratio[count : count + n] + ratio[count + n :]))
    H = machine.block_diagonal(*own, drives)
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


def _directions(machine: Machine, p: ConeProgram, H: Values) -> Callable[[Values], Values]:
    """Solves Newton's equations, along what may change."""
    xp = machine.xp
    solve = machine.factor(H)
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


def _chosen_at_once(
    first: Values, one: Callable[[], tuple], other: Callable[[], tuple]
) -> tuple[Values, ...]:
    return one() if first else other()


def _factor_compiled(H: Array) -> Callable[[Array], Array]:
    L = jax.lax.linalg.cholesky(H, symmetrize_input=False)
    return lambda r: jax.scipy.linalg.cho_solve((L, True), r)


NUMPY = Machine(np, _factor_at_once, scipy.linalg.block_diag, _chosen_at_once)
COMPILED = Machine(jnp, _factor_compiled, jax.scipy.linalg.block_diag, jax.lax.cond)
