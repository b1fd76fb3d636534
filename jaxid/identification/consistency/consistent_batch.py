"""Physically consistent parameters of many data sets, compiled by JAX."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Bool,
    Float,
    Hashable,
    Int,
    content,
    in_parts,
    require_float64,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError

from . import solver
from .estimator import PhysicallyConsistent

CPU_PART = 16
"""Data sets of one compiled call on a processor: each core gets calls of its own."""
ACCELERATOR_BATCH = 256
"""Data sets that an accelerator solves in step."""

Vectors = Float[AnyArray, "*datasets size"]
"""A vector for each data set."""


class ConsistentBatch(eqx.Module):
    """Physically consistent parameters of one or many data sets.

    Attributes:
        standard: Standard parameters: complete bodies, friction, rotors.
        parameters: Base parameters.
        certified: Whether the optima are proved: their error bounds are within the
            tolerance.
        iterations: Numbers of iterations.
    """

    standard: Vectors
    parameters: Vectors
    certified: Bool[AnyArray, "*datasets"]
    iterations: Int[AnyArray, "*datasets"]


class ConsistentSolver(Hashable):
    """Physically consistent estimates of one model: a function for `jit` and `vmap`.

    The factors are those of `Factors.weighted`: their rows are weighted already, so the
    weights of the estimator do not count. Equal solvers share their compiled functions.
    The solver is a loop whose length depends on the data: there are no reverse-mode
    gradients.

    Attributes:
        base: Base parameters of the factors' columns.
        estimator: Bounds and prior; by default wide bounds.
    """

    base: BaseParameters
    estimator: PhysicallyConsistent = PhysicallyConsistent()

    # A class with `__eq__` loses the hash that it inherits.
    __hash__ = Hashable.__hash__

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConsistentSolver) and content(self) == content(other)

    def __call__(self, R: AnyArray, z: AnyArray, rows: AnyArray) -> ConsistentBatch:
        """Return the estimate of one data set.

        Args:
            R: Upper triangle of the weighted rows [height, base].
            z: Weighted forces, of the same decomposition [height].
            rows: Number of rows behind the factor.

        Raises:
            InputError: If the bounds do not fit the model.
        """
        require_float64("a physically consistent estimate")
        R = jnp.asarray(R)
        z = jnp.asarray(z)
        feasible_set = self.estimator.feasible_set(self.base)
        data, program = self.estimator.program(self.base, feasible_set, R, z, rows)
        optimum = solver.solve_compiled(program)
        p = feasible_set.standard_parameters(data, optimum.y)
        return ConsistentBatch(
            standard=p,
            parameters=self.base.from_standard(p),
            certified=jnp.asarray(optimum.certified),
            iterations=jnp.asarray(optimum.iterations),
        )


def consistent_batch(
    base: BaseParameters,
    R: Float[AnyArray, "datasets height base"],
    z: Float[AnyArray, "datasets height"],
    rows: Int[AnyArray, " datasets"],
    estimator: PhysicallyConsistent | None = None,
) -> ConsistentBatch:
    """Estimate physically consistent parameters from the factors of many data sets.

    It is `ConsistentSolver`, compiled once for each model, estimator and shape, and
    spread over the cores of the processor.

    Args:
        base: Base parameters of the factors' columns.
        R: Upper triangles of the weighted rows.
        z: Weighted forces, of the same decompositions.
        rows: Numbers of rows behind the factors.
        estimator: Bounds and prior; wide bounds if None.

    Raises:
        InputError: If shapes do not fit, or bounds leave no body.
        RuntimeError: If JAX's 64-bit mode is off.
    """
    count = len(R)
    has_factors = count > 0 and R.shape[-1] == base.size and z.shape == R.shape[:-1]
    if not has_factors or rows.shape != (count,):
        raise InputError(
            "`R`, `z` and `rows` must have the shapes [datasets, "
            f"height, {base.size}], [datasets, height] and [datasets], "
            f"but have {R.shape}, {z.shape} and {rows.shape}."
        )
    estimator = estimator or PhysicallyConsistent()
    arrays = (np.asarray(R), np.asarray(z), np.asarray(rows))
    # Errors cannot be raised in compiled code: the first data set is checked before.
    feasible_set = estimator.feasible_set(base)
    _, program = estimator.program(base, feasible_set, *(x[0] for x in arrays))
    program.require_interior()
    data_set_solver = ConsistentSolver(base, estimator)
    # A core gains nothing from solving data sets in step: it waits for the slowest.
    if jax.default_backend() == "cpu":
        solve = functools.partial(_solve_many, data_set_solver, None)
        return in_parts(lambda part: solve(*part), arrays, CPU_PART)
    return _solve_many(data_set_solver, ACCELERATOR_BATCH, *arrays)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _solve_many(one: ConsistentSolver, in_step: int | None, *data) -> ConsistentBatch:
    """Solve data sets one after the other, or some of them in step."""
    return jax.lax.map(lambda x: one(*x), data, batch_size=in_step)
