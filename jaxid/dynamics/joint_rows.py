"""The base regressor joint by joint in JAX: only the columns that can act on a joint."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.machine import program_of
from jaxid.program import Lowered, Reversible, evaluate_packed, lower


class JointRows(eqx.Module):
    """A regressor that is evaluated joint by joint: only columns that can act on the joint.

    Attributes:
        lowered: The program of the base regressor.
        columns: For each joint the base parameters that can act on it.
        size: Number of base parameters.
    """

    lowered: Lowered | Reversible
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)

    @classmethod
    def of(cls, owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]) -> "JointRows":
        """The rows of a definition of the base regressor for one sample."""
        program = program_of(owner, definition, *shapes)
        nonzero = np.asarray(program.nonzeros)
        columns = tuple(tuple(int(k) for k in np.flatnonzero(row)) for row in nonzero)
        return cls(lower(program), columns, nonzero.shape[1])

    @classmethod
    def of_base(cls, base: BaseParameters) -> "JointRows":
        """The rows of the base regressor of a robot whose geometry is known."""
        n = (base.model.robot.joints,)
        return cls.of(base, base.columns, n, n, n)

    @property
    def for_gradients(self) -> "JointRows":
        """The same rows for `grad` and `vjp`, which JAX then traces faster; not for `jvp`."""
        if isinstance(self.lowered, Reversible):
            return self
        return JointRows(Reversible(self.lowered), self.columns, self.size)

    def __call__(self, *arrays: AnyArray) -> list[Float[Array, "*batch columns samples"]]:
        """The columns of each joint.

        Args:
            arrays: The definition's arguments, batch and samples last.
        """
        if isinstance(self.lowered, Reversible):
            groups = [[j * self.size + k for k in own] for j, own in enumerate(self.columns)]
            return self.lowered.stacked(tuple(map(tuple, groups)), *arrays)
        batch = jnp.shape(arrays[0])[1:]
        packed = self.lowered(*arrays)
        dtype = jnp.result_type(*arrays)
        found = []
        for joint, own in enumerate(self.columns):
            entries = [jnp.asarray(packed[joint * self.size + k], dtype) for k in own]
            full = [jnp.broadcast_to(x, batch) for x in entries]
            empty = (*batch[:-1], 0, batch[-1])
            found.append(jnp.stack(full, axis=-2) if full else jnp.zeros(empty, dtype))
        return found

    def in_numpy(self, *arrays: AnyArray) -> list[Float[np.ndarray, "columns samples"]]:
        """The same for each joint, evaluated in NumPy."""
        batch = np.shape(arrays[0])[1:]
        packed = evaluate_packed(self.lowered.program, *arrays)
        found = []
        for joint, own in enumerate(self.columns):
            rows = np.empty((len(own), *batch))
            for row, k in zip(rows, own, strict=True):
                row[:] = packed[joint * self.size + k]
            found.append(rows)
        return found
