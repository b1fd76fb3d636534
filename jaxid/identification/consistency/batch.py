"""Physically consistent estimates as a function of arrays, and of many data sets at once."""

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
from jaxid.identification.consistency.data import whitened
from jaxid.identification.consistency.estimator import PhysicallyConsistent
from jaxid.identification.consistency.interior_point import solve_compiled

ALONE = 8
"""Data sets for which another thread does not pay."""
TOGETHER = 256
"""Data sets that an accelerator solves in step."""


class ConsistentBatch(eqx.Module):
    """Physically consistent parameters of many data sets, or of one.

    Attributes:
        standard: Standard parameters: complete bodies, friction, rotors.
        parameters: Base parameters.
        prices: By how much residuals exceed those without bounds, of 1.
        error_bounds: Bounds of the objectives' distances to their optima, as shares of them.
        certified: Where the bound is within the tolerance.
        iterations: How many it took.
    """

    standard: Float[AnyArray, "*datasets standard"]
    parameters: Float[AnyArray, "*datasets base"]
    prices: Float[AnyArray, "*datasets"]
    error_bounds: Float[AnyArray, "*datasets"]
    certified: Bool[AnyArray, "*datasets"]
    iterations: Int[AnyArray, "*datasets"]


class ConsistentSolver:
    """Physically consistent estimates of one model: a function of arrays for `jit` and `vmap`.

    The factors are those of `Factors.weighted`: their rows are weighted already, so the weights of
    the estimator do not count. Equal solvers share what was compiled for them. It goes through a
    loop whose length depends on the data: there are no reverse-mode gradients.
    """

    def __init__(self, base: BaseParameters, estimator: PhysicallyConsistent | None = None):
        """Prepares the bounds.

        Args:
            base: Whose columns the factors have.
            estimator: Bounds, margin and priors; wide bounds if None.

        Raises:
            InputError: If the bounds do not fit the model.
        """
        self.base = base
        self.estimator = PhysicallyConsistent() if estimator is None else estimator
        self._possible = self.estimator.possible(base)
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
        """The estimate of one data set.

        Args:
            R: Upper triangle of the weighted rows.
            z: Weighted forces, of the same decomposition.
            rows: How many rows it stands for.
        """
        require_float64("a physically consistent estimate")
        R, z = jnp.asarray(R), jnp.asarray(z)
        plain = whitened(jnp, self.base, R, z, rows)
        data = self.estimator.with_prior(jnp, plain)
        program = self.estimator.program(jnp, self._possible, data)
        optimum = solve_compiled(program)
        p = self._possible.standard(jnp, data.A, data.b, optimum.y)
        left = z[self.base.size :] / plain.noise
        away = plain.A @ p - plain.b
        free = jnp.maximum(left @ left, 1e-300)
        return ConsistentBatch(
            p,
            self.base.from_standard(p),
            jnp.sqrt(away @ away / free) - 1.0,
            optimum.error / jnp.maximum(optimum.value, program.scale),
            jnp.asarray(optimum.certified),
            jnp.asarray(optimum.iterations),
        )

    def check(
        self, R: Float[np.ndarray, "height base"], z: Float[np.ndarray, " height"], rows: int
    ) -> None:
        """Refuses bounds that leave no body.

        Args:
            R: Upper triangle of some data set.
            z: Its weighted forces.
            rows: How many rows it stands for.

        Raises:
            InputError: If bounds and margin leave no body.
        """
        data = self.estimator.with_prior(np, whitened(np, self.base, R, z, rows))
        self.estimator.program(np, self._possible, data).require_interior()


def consistent_batch(
    base: BaseParameters,
    R: Float[AnyArray, "datasets height base"],
    z: Float[AnyArray, "datasets height"],
    rows: Int[AnyArray, " datasets"],
    estimator: PhysicallyConsistent | None = None,
) -> ConsistentBatch:
    """Physically consistent estimates from the triangular factors of many data sets.

    It is `ConsistentSolver`, compiled once for each model, estimator and shape, and shared among
    the processor's cores.

    Args:
        base: Whose columns they are.
        R: Upper triangles of the weighted rows.
        z: Weighted forces, of the same decompositions.
        rows: How many rows each stands for.
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
    parts = min(_threads(), -(-count // ALONE))
    size = -(-count // parts)
    solve = _compiled(solver, (size, *R.shape[1:]))
    arrays = np.asarray(R, np.float64), np.asarray(z, np.float64), np.asarray(rows, np.int64)

    def part(k: int) -> ConsistentBatch:
        chosen = np.arange(k * size, (k + 1) * size) % count
        return jax.block_until_ready(solve(*(x[chosen] for x in arrays)))

    with ThreadPoolExecutor(parts) as pool:
        found = list(pool.map(part, range(parts)))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *found)


def _threads() -> int:
    """Cores that this process may use; an accelerator takes everything at once."""
    if jax.default_backend() != "cpu":
        return 1
    allowed = getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count() or 1))
    return max(1, len(allowed(0)))


@functools.lru_cache(maxsize=16)
def _compiled(solver: ConsistentSolver, shape: tuple[int, int, int]):
    """The program for so many data sets; compiled ahead, so that threads do not wait in turn."""
    # A core gains nothing from solving in step, and waits for the slowest; an accelerator does.
    together = None if jax.default_backend() == "cpu" else TOGETHER

    def many(R: Array, z: Array, rows: Array) -> ConsistentBatch:
        return jax.lax.map(lambda x: solver(*x), (R, z, rows), batch_size=together)

    shapes = (shape, shape[:2], shape[:1])
    kinds = (np.float64, np.float64, np.int64)
    arguments = (jax.ShapeDtypeStruct(s, k) for s, k in zip(shapes, kinds, strict=True))
    return jax.jit(many).lower(*arguments).compile()
