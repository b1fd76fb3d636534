r"""A primal-dual interior point method for `ConeProgram`, in NumPy at once or compiled by JAX.

Newton's method on the perturbed optimality conditions $S Z = \mu I$, $s z = \mu$: the steps are
those of `newton`. A pull towards bodies of a prior is the same loop with $S Z = \gamma I$ in the
end. The variables are feasible from the start; what remains of the conditions is bounded.

Certificate: for any feasible $y$ and any $Z, z \succeq 0$ with $r = \nabla f(y) - F^*(Z) - G^T z$,
convexity gives $f(y) - f^* \le \langle S, Z \rangle + s^T z + \sum_i |r_i| d_i$, where $d_i$ bounds
how far two feasible values of $y_i$ are apart. Nothing in it is estimated.
"""

import enum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, Int, require_float64
from jaxid.identification.consistency import blocks
from jaxid.identification.consistency.cone_program import (
    ConeProgram,
    Number,
    Values,
)
from jaxid.identification.consistency.newton import (
    COMPILED,
    NUMPY,
    TINY,
    Machine,
    Point,
    information,
    moved,
    point_of,
    targets,
)

TOLERANCE = 2.5e-7
"""Error bound at which an optimum counts as found, as a share of objective and scale together."""
MOST = 50
PATIENCE = 4
"""Iterations without a better bound after which the search ends."""


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


class _Best(NamedTuple):
    """What is handed back of a point."""

    y: Values
    z: Values
    value: Values
    error: Values

    @classmethod
    def of(cls, x: Point) -> "_Best":
        return cls(x.y, x.z, x.value, x.error)


class _State(NamedTuple):
    point: Point
    best: _Best
    iterations: Values
    stalled: Values
    finished: Values


def solve_at_once(program: ConeProgram) -> Optimum:
    """Solves one program in NumPy: some tens of milliseconds, and nothing to compile."""
    with np.errstate(all="ignore"):
        state, gram = _first(NUMPY, program), information(program)
        while not state.finished:
            state = _next(NUMPY, program, gram, state)
        return _optimum(program, state)


@jax.jit
def solve_compiled(program: ConeProgram) -> Optimum:
    """Solves one program; works under `jit` and `vmap`."""
    require_float64("the search for physically consistent parameters")
    program = jax.tree.map(jnp.asarray, program)
    gram = information(program)
    state = jax.lax.while_loop(
        lambda x: ~x.finished,
        lambda x: _next(COMPILED, program, gram, x),
        _first(COMPILED, program),
    )
    return _optimum(program, state)


def _optimum(program: ConeProgram, state: _State) -> Optimum:
    best = state.best
    certified = _proved(program, best)
    return Optimum(best.y, best.value, best.error, certified, state.iterations, best.z)


def _proved(p: ConeProgram, x: Point | _Best) -> Values:
    return x.error <= TOLERANCE * (p.scale + x.value)


def _first(machine: Machine, p: ConeProgram) -> _State:
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
    Z = xp.maximum(targets(xp, p), mu) * inverse
    point = point_of(xp, p, y, Z, mu / s)
    zero = xp.zeros((), int)
    return _State(point, _Best.of(point), zero, zero, zero > 0)


def _next(machine: Machine, p: ConeProgram, gram: Values, state: _State) -> _State:
    """One iteration, and whether it was the last."""
    xp = machine.xp
    point, length = moved(machine, p, gram, state.point)
    better = point.error < state.best.error
    found = _Best.of(point)
    best = _Best(*(xp.where(better, a, b) for a, b in zip(found, state.best, strict=True)))
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
