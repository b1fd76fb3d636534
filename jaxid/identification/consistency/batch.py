"""Physically consistent estimates as a function of arrays, for `jit`, `vmap` and many data sets."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Bool, Float, Int, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.consistency.estimator import PhysicallyConsistent
from jaxid.identification.consistency.solver import solve_compiled


class ConsistentBatch(eqx.Module):
    """Physically consistent parameters of one or many data sets.

    Attributes:
        standard: Standard parameters: complete bodies, friction, rotors.
        parameters: Base parameters.
        residual_increases: Relative increases of the norms of the residuals by the bounds.
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


class ConsistentSolver:
    """Physically consistent estimates of one model: a function of arrays for `jit` and `vmap`.

    The factors are those of `Factors.weighted`: their rows are weighted already, so the weights of
    the estimator do not count. Equal solvers share their compiled functions. The solver is a loop
    whose length depends on the data: there are no reverse-mode gradients.

    Args:
        base: Base parameters of the factors' columns.
        estimator: Bounds, margin and priors; wide bounds if None.

    Raises:
        InputError: If the bounds do not fit the model.
    """

    def __init__(self, base: BaseParameters, estimator: PhysicallyConsistent | None = None):
        self.base = base
        self.estimator = PhysicallyConsistent() if estimator is None else estimator
        self._feasible = self.estimator.feasible_set(base)
        leaves, structure = jax.tree.flatten((base, self.estimator))
        arrays = [np.asarray(x) for x in leaves]
        self._key = structure, tuple((x.shape, x.dtype.str, x.tobytes()) for x in arrays)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return type(other) is ConsistentSolver and self._key == other._key

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
        """
        require_float64("a physically consistent estimate")
        R, z = jnp.asarray(R), jnp.asarray(z)
        data, program = self.estimator.program(jnp, self.base, self._feasible, R, z, rows)
        optimum = solve_compiled(program)
        p = self._feasible.standard_parameters(jnp, data.A, data.b, optimum.y)
        parameters = self.base.from_standard(p)
        free, bounded = z[self.base.size :], R @ parameters - z
        squares = jnp.maximum(free @ free, 1e-300 * data.noise**2)
        return ConsistentBatch(
            p,
            parameters,
            jnp.sqrt(bounded @ bounded / squares) - 1.0,
            optimum.error / jnp.maximum(optimum.value, program.scale),
            jnp.asarray(optimum.certified),
            jnp.asarray(optimum.iterations),
        )

    def check(
        self, R: Float[np.ndarray, "height base"], z: Float[np.ndarray, " height"], rows: int
    ) -> None:
        """Check that the bounds leave room for bodies.

        Args:
            R: Upper triangle of some data set.
            z: Weighted forces of that data set.
            rows: Number of rows behind the factor.

        Raises:
            InputError: If bounds and margin leave no body.
        """
        _, program = self.estimator.program(np, self.base, self._feasible, R, z, rows)
        program.require_interior()


def consistent_batch(
    base: BaseParameters,
    R: Float[AnyArray, "datasets height base"],
    z: Float[AnyArray, "datasets height"],
    rows: Int[AnyArray, " datasets"],
    estimator: PhysicallyConsistent | None = None,
) -> ConsistentBatch:
    """Estimate physically consistent parameters from the triangular factors of many data sets.

    It is `ConsistentSolver`, compiled once for each model, estimator and shape, and spread over the
    cores of the processor.

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
    require_float64("a batch of physically consistent estimates")
    count = len(R)
    if not count or R.shape[-1] != base.size or z.shape != R.shape[:-1] or rows.shape != (count,):
        raise InputError(
            f"`R`, `z` and `rows` must have the shapes [datasets, height, {base.size}], [datasets, "
            f"height] and [datasets], but have {R.shape}, {z.shape} and {rows.shape}."
        )
    solver = ConsistentSolver(base, estimator)
    solver.check(np.asarray(R[0]), np.asarray(z[0]), int(rows[0]))
    # Below eight data sets another thread does not pay.
    parts = min(_threads(), -(-count // 8))
    size = -(-count // parts)
    solve = _compiled(solver, (size, *R.shape[1:]))
    arrays = np.asarray(R, np.float64), np.asarray(z, np.float64), np.asarray(rows, np.int64)

    def part(k: int) -> ConsistentBatch:
        chosen = np.arange(k * size, (k + 1) * size) % count
        return jax.block_until_ready(solve(*(x[chosen] for x in arrays)))

    with ThreadPoolExecutor(parts) as pool:
        results = list(pool.map(part, range(parts)))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *results)


def _threads() -> int:
    """Return the number of usable cores; an accelerator takes all data sets at once."""
    if jax.default_backend() != "cpu":
        return 1
    allowed = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))
    return max(1, len(allowed(0)))


@functools.lru_cache(maxsize=16)
def _compiled(solver: ConsistentSolver, shape: tuple[int, int, int]):
    """Compile the solver for a number of data sets, ahead of time so that threads do not wait."""
    # A core gains nothing from solving data sets in step: it waits for the slowest.
    together = None if jax.default_backend() == "cpu" else 256

    def many(R: Array, z: Array, rows: Array) -> ConsistentBatch:
        return jax.lax.map(lambda x: solver(*x), (R, z, rows), batch_size=together)

    shapes = (shape, shape[:2], shape[:1])
    kinds = (np.float64, np.float64, np.int64)
    arguments = (jax.ShapeDtypeStruct(s, k) for s, k in zip(shapes, kinds, strict=True))
    return jax.jit(many).lower(*arguments).compile()
