r"""Variable projection: least squares over shapes, with linear parameters eliminated.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$. What is left,
$r = z - N c = P^\perp z$, is a function of the shapes alone. Its Jacobian is Golub's and Pereyra's
(1973), $-P^\perp \partial N\, c - (N^+)^T \partial N^T r$, exact since friction laws are
differentiated by JAX. Everything is computed from the triangles of the rows, which keep all
products of columns: no vector here is longer than there are columns.
"""

import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
import optimistix as optx

from jaxid.arrays import AnyArray, Float
from jaxid.identification.compiled import on_cpu
from jaxid.identification.factors import Factors
from jaxid.identification.nonlinear.separable import SeparableRows, joined
from jaxid.identification.solutions import Complete, Decomposition

SPREAD = 10.0
"""Factor by which a shape may well differ from where its search began."""
TOLERANCE = 1e-4
"""Of the logarithms of the shapes, and of the sum of squares."""
MOST_STEPS = 60
TINY = 1e-300


class Projected(NamedTuple):
    """The problem at some shapes, linear parameters eliminated.

    Attributes:
        linear: The best linear parameters.
        residual: Weighted, up to a rotation.
        jacobian: Its derivatives with respect to the shapes.
        factors: The factors it was computed from.
    """

    linear: Float[np.ndarray, " base"]
    residual: Float[np.ndarray, " columns"]
    jacobian: Float[np.ndarray, "columns shapes"]
    factors: Factors


def project(
    factors: Factors, rows: SeparableRows, weights: Float[np.ndarray, " joints"]
) -> Projected:
    """Eliminates the linear parameters, and differentiates what is left.

    Args:
        factors: Of all columns at some shapes, of all rows or a part of them.
        rows: Where they come from.
        weights: Of the joints' rows.
    """
    size, shapes = rows.base.size, rows.shapes.size
    R, z = factors.weighted(weights)
    missing = rows.size + 1 - len(R)
    R, z = np.pad(R, ((0, missing), (0, 0))), np.pad(z, (0, missing))
    N, slopes = R[:, :size], R[:, size:]
    decomposition = Decomposition.of(N, z)
    inverse = Complete().inverse(decomposition.values)
    B = decomposition.inverse_information(inverse)
    c = decomposition.solve(inverse)
    residual = z - N @ c
    moved, felt = np.zeros((len(R), shapes)), np.zeros((size, shapes))
    for place, (v, k) in enumerate(rows.pairs):
        column = rows.varying[v]
        moved[:, k] += c[column] * slopes[:, place]
        felt[column, k] += slopes[:, place] @ residual
    beside = moved - N @ (B @ (N.T @ moved))
    return Projected(c, residual, -beside - N @ (B @ felt), factors)


class Found(NamedTuple):
    """Where the search for shapes has ended.

    Attributes:
        x: The shapes.
        linear: The best linear parameters there.
        steps: How many steps it took.
        success: Whether it has converged.
    """

    x: Float[np.ndarray, " shapes"]
    linear: Float[np.ndarray, " base"]
    steps: int
    success: bool


class Search:
    """Levenberg-Marquardt over the logarithms of the shapes.

    Where the rows say nothing of a shape, a weak pull keeps it near its start: as strong as one
    row that says it may differ by a factor of `SPREAD`.

    Args:
        rows: Which depend on shapes.
        weights: Of the joints' rows.
        start: Where the pull leads.
        blocks: Which blocks of time count; all if None.
    """

    def __init__(
        self,
        rows: SeparableRows,
        weights: Float[np.ndarray, " joints"],
        start: Float[np.ndarray, " shapes"],
        blocks: tuple[int, ...] | None = None,
    ):
        self._rows, self._weights, self._start, self._blocks = rows, weights, start, blocks
        self._last: tuple[bytes, Projected] | None = None
        self._scale = 1.0

    def at(self, x: Float[np.ndarray, " shapes"]) -> Projected:
        """The problem at some shapes; the last one is kept."""
        key = np.asarray(x).tobytes()
        if self._last is None or self._last[0] != key:
            blocks = self._rows.blocks(x)
            factors = blocks.total if self._blocks is None else joined(blocks, self._blocks)
            self._last = key, project(factors, self._rows, self._weights)
        return self._last[1]

    def equations(self, u: AnyArray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals in units of their standard deviation, and the pull; with the Jacobian."""
        x = self._start * np.exp(np.asarray(u, np.float64))
        projected = self.at(x)
        pull = np.log(SPREAD)
        residual = np.concatenate([projected.residual / self._scale, np.asarray(u) / pull])
        jacobian = np.vstack([projected.jacobian * x / self._scale, np.eye(len(x)) / pull])
        return residual, jacobian

    def __call__(self, begin: Float[np.ndarray, " shapes"] | None = None) -> Found:
        """Searches, from the start or from somewhere else.

        Twice: how strong the pull is depends on the noise, which is known only at the end.
        """
        first = self._search(self._start if begin is None else begin)
        second = self._search(first.x)
        return second._replace(steps=first.steps + second.steps)

    def _search(self, begin: Float[np.ndarray, " shapes"]) -> Found:
        at = self.at(begin)
        freedom = max(float(at.factors.rows.sum()) - self._rows.base.size, 1.0)
        self._scale = max(float(np.linalg.norm(at.residual)) / np.sqrt(freedom), TINY)
        u = np.log(begin / self._start)
        minimise = _compiled(self._rows.size + 1 + len(u), len(u))
        number = next(_numbers)
        _running[number] = self
        try:
            with on_cpu():
                u, steps, success = (np.asarray(a) for a in minimise(np.asarray(number), u))
        finally:
            del _running[number]
        x = self._start * np.exp(u)
        return Found(x, self.at(x).linear, int(steps), bool(success))


_running: dict[int, Search] = {}
"""Searches under way: compiled code knows them by number, so that it serves all of one size."""
_numbers = itertools.count()


def _ask(number: AnyArray, u: AnyArray) -> tuple[np.ndarray, np.ndarray]:
    return _running[int(number)].equations(np.asarray(u))


@functools.lru_cache(maxsize=16)
def _compiled(height: int, size: int) -> Callable:
    """Levenberg-Marquardt for problems of one size; the equations are asked of a running search."""
    shape = (
        jax.ShapeDtypeStruct((height,), np.float64),
        jax.ShapeDtypeStruct((height, size), np.float64),
    )

    def equations(number, u):
        return jax.pure_callback(_ask, shape, number, u)

    @jax.custom_jvp
    def residual(u, number):
        return equations(number, u)[0]

    @residual.defjvp
    def _(primals, tangents):
        value, jacobian = equations(primals[1], primals[0])
        return value, jacobian @ tangents[0]

    @jax.jit
    def minimise(number, u):
        solution = optx.least_squares(
            residual,
            optx.LevenbergMarquardt(rtol=TOLERANCE, atol=TOLERANCE),
            u,
            args=number,
            max_steps=MOST_STEPS,
            throw=False,
        )
        success = solution.result == optx.RESULTS.successful
        return solution.value, solution.stats["num_steps"], success

    return minimise
