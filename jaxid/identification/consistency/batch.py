"""Physically consistent estimates of many data sets: one compiled program for all of them."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.consistency.data import whitened
from jaxid.identification.consistency.estimator import PhysicallyConsistent
from jaxid.identification.consistency.interior_point import TOGETHER, solve_compiled
from jaxid.types import AnyArray, Array, Bool, Float, Int, require_float64


class ConsistentBatch(eqx.Module):
    """Physically consistent parameters of many data sets.

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


def consistent_batch(
    base: BaseParameters,
    R: Float[AnyArray, "datasets height base"],
    z: Float[AnyArray, "datasets height"],
    rows: Int[AnyArray, " datasets"],
    estimator: PhysicallyConsistent | None = None,
) -> ConsistentBatch:
    """Physically consistent estimates from the triangular factors of many data sets.

    The factors are those of `Factors.weighted`: their rows are weighted already, so the weights of
    the estimator do not count. Compiles once for each model, estimator and shape.

    Args:
        base: Whose columns they are.
        R: Upper triangles of the weighted rows.
        z: Weighted forces, of the same decompositions.
        rows: How many rows each stands for.
        estimator: Bounds, margin and priors; wide bounds if None.

    Raises:
        ValueError: If shapes do not fit, or bounds leave no body.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    require_float64("a batch of physically consistent estimates")
    if R.shape[-1] != base.size or z.shape != R.shape[:-1] or rows.shape != R.shape[:1]:
        raise ValueError(
            f"`R`, `z` and `rows` must have the shapes [datasets, height, {base.size}], [datasets, "
            f"height] and [datasets], but have {R.shape}, {z.shape} and {rows.shape}."
        )
    recipe = _Recipe(base, PhysicallyConsistent() if estimator is None else estimator)
    recipe.check(np.asarray(R[0]), np.asarray(z[0]), int(rows[0]))
    count, cores = len(R), max(1, os.cpu_count() or 1)
    parts = min(cores, -(-count // TOGETHER))
    size = -(-count // parts)
    arrays = (np.asarray(R), np.asarray(z), np.asarray(rows, np.float64))

    def part(k: int) -> ConsistentBatch:
        chosen = np.arange(k * size, (k + 1) * size) % count
        return jax.block_until_ready(_solve(recipe, *(x[chosen] for x in arrays)))

    first = part(0)
    with ThreadPoolExecutor(parts) as pool:
        found = [first, *pool.map(part, range(1, parts))]
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *found)


class _Recipe:
    """What is the same for all data sets; equal recipes share what was compiled for them."""

    def __init__(self, base: BaseParameters, estimator: PhysicallyConsistent):
        self.base, self.estimator = base, estimator
        self.possible = estimator.possible(base)
        leaves, structure = jax.tree.flatten((base, estimator))
        arrays = [np.asarray(x) for x in leaves]
        self._key = structure, tuple((x.shape, x.dtype.str, x.tobytes()) for x in arrays)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return type(other) is _Recipe and self._key == other._key

    def check(self, R: np.ndarray, z: np.ndarray, rows: int) -> None:
        """Refuses bounds that leave no body."""
        data = self.estimator.with_prior(np, whitened(np, self.base, R, z, rows))
        self.estimator.program(np, self.possible, data).require_interior()

    def __call__(self, R: Array, z: Array, rows: Array) -> ConsistentBatch:
        """The estimate of one data set."""
        plain = whitened(jnp, self.base, R, z, rows)
        data = self.estimator.with_prior(jnp, plain)
        program = self.estimator.program(jnp, self.possible, data)
        optimum = solve_compiled(program)
        p = self.possible.standard(jnp, data.A, data.b, optimum.y)
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


@functools.partial(jax.jit, static_argnums=0)
def _solve(recipe: _Recipe, R: Array, z: Array, rows: Array) -> ConsistentBatch:
    return jax.lax.map(lambda x: recipe(*x), (R, z, rows), batch_size=TOGETHER)
