"""Regressor of many samples without its zeros: evaluated joint by joint, or stacked and packed.

A joint feels only the bodies beyond it, so most entries of a regressor are zero for every motion.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, is_traced, namespace
from jaxid.dynamics.dispatch import FEW, compiled_method
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.program import Lowered, Program, Reversible, evaluate_packed


class JointRegressor(eqx.Module):
    """Compiled regressor, evaluated joint by joint in the columns that can act on the joint.

    Args:
        owner: Model whose geometry is known.
        definition: Method of the model that returns the regressor of one sample.
        shapes: Shapes of the method's arguments; coordinates, velocities and accelerations if
            there are none.

    Attributes:
        lowered: Program of the regressor.
        columns: For each joint the columns that can act on it.
        size: Number of columns.
    """

    lowered: Lowered | Reversible
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)

    def __init__(self, owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]):
        method = compiled_method(owner, definition, *shapes)
        self.lowered = method.lowered
        self.columns = method.acting
        self.size = method.program.output_shapes[0][1]

    @property
    def for_gradients(self) -> "JointRegressor":
        """The same regressor for `grad` and `vjp`, which JAX then traces faster; not for `jvp`."""
        if isinstance(self.lowered, Reversible):
            return self
        return eqx.tree_at(lambda x: x.lowered, self, Reversible(self.lowered))

    def __call__(self, *arrays: AnyArray) -> list[Float[Array, "*batch columns samples"]]:
        """Return the columns of each joint.

        Args:
            arrays: Arguments of the definition, batch and samples last.
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
        """Return the columns of each joint, evaluated in NumPy."""
        return rows_in_numpy(self.lowered.program, self.columns, *arrays)


def rows_in_numpy(
    program: Program, columns: tuple[tuple[int, ...], ...], *arrays: AnyArray
) -> list[Float[np.ndarray, "columns samples"]]:
    """Return for each joint some columns of a regressor, evaluated in NumPy.

    Args:
        program: Program of the regressor.
        columns: Columns of each joint.
        arrays: Arguments of the program, samples last.
    """
    batch, size = np.shape(arrays[0])[1:], program.output_shapes[0][1]
    packed = evaluate_packed(program, *arrays)
    found = []
    for joint, own in enumerate(columns):
        rows = np.empty((len(own), *batch))
        for row, k in zip(rows, own, strict=True):
            row[:] = packed[joint * size + k]
        found.append(rows)
    return found


class PackedRegressor(eqx.Module):
    r"""Stacked regressor $\bar\Theta$ as the entries that are not always zero (Eq. 26).

    It has one array over the samples for each entry that varies, computes with these, and writes
    zeros only into the `matrix`.

    Args:
        owner: Model.
        definition: Method of the model that returns the regressor of one sample.
        motion: Joint motion [samples, joints].

    Attributes:
        values: Distinct entries that vary with the motion, over the samples.
        places: For each joint the pairs of a column and either the number of its array in `values`
            or its constant, a float.
        samples: Number of samples.
        columns: Number of parameters.

    Raises:
        InputError: If the motion does not have one axis of samples, or JAX is tracing the model's
            own numbers, as a gradient with respect to the geometry does.
    """

    values: tuple[Float[AnyArray, " samples"], ...]
    places: tuple[tuple[tuple[int, int | float], ...], ...] = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def __init__(self, owner: eqx.Module, definition: Callable, motion: Motion):
        arrays = [x.T for x in (motion.q, motion.qd, motion.qdd)]
        if motion.q.ndim != 2:
            raise InputError(
                f"`motion` must have the shape [samples, joints], but has {motion.q.shape}."
            )
        if is_traced(owner):
            raise InputError(
                "a packed regressor needs a robot whose geometry is known, but JAX is tracing it: "
                "use `regressor` there."
            )
        self.samples = motion.q.shape[0]
        method = compiled_method(owner, definition, *(x.shape[:1] for x in arrays))
        compiled = self.samples > FEW or is_traced(arrays)
        if not compiled:
            arrays = [np.asarray(x, np.float64) for x in arrays]
        self.values = method.packed(compiled, *arrays)
        ((joints, self.columns),) = method.program.output_shapes
        rows = (method.entries[j * self.columns : (j + 1) * self.columns] for j in range(joints))
        self.places = tuple(
            tuple((k, x) for k, x in enumerate(row) if isinstance(x, int) or x != 0) for row in rows
        )

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.places)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the matrix: rows, joint after joint, and columns."""
        return self.joints * self.samples, self.columns

    def acting(self, joint: int) -> np.ndarray:
        """Return the columns that can act on a joint."""
        return np.array([k for k, _ in self.places[joint]], int)

    def rows(self, joint: int) -> Float[AnyArray, "acting samples"]:
        """Return the entries of a joint in the columns that can act on it, columns first."""
        xp = namespace(*self.values)
        entries = [self.values[x] if isinstance(x, int) else x for _, x in self.places[joint]]
        full = [xp.broadcast_to(xp.asarray(x, float), (self.samples,)) for x in entries]
        return xp.stack(full) if full else xp.zeros((0, self.samples))

    @eqx.filter_jit
    def gram(
        self, weights: Float[AnyArray, " joints"] | None = None
    ) -> Float[AnyArray, "columns columns"]:
        r"""Return the information matrix $\bar\Theta^T W^2 \bar\Theta$ (Eq. 33).

        Args:
            weights: Diagonal of $W$ for each joint; ones if None.
        """
        w = jnp.ones(self.joints) if weights is None else jnp.asarray(weights)
        total = jnp.zeros((self.columns, self.columns))
        for j in range(self.joints):
            rows, own = self.rows(j), self.acting(j)
            total = total.at[own[:, None], own].add(w[j] ** 2 * (rows @ rows.T))
        return total

    def factor(
        self, weights: Float[AnyArray, " joints"] | None = None
    ) -> Float[np.ndarray, "columns columns"]:
        r"""Return the triangular factor $R$ of $W \bar\Theta = Q R$ without forming the matrix.

        Each joint's rows are decomposed by themselves, in float64, then the factors of all joints.

        Args:
            weights: Diagonal of $W$ for each joint; ones if None.
        """
        w = np.ones(self.joints) if weights is None else np.asarray(weights, np.float64)
        stacked = [np.zeros((self.columns, self.columns))]
        for j in range(self.joints):
            R = np.linalg.qr(np.asarray(self.rows(j), np.float64).T, mode="r")
            placed = np.zeros((len(R), self.columns))
            placed[:, self.acting(j)] = w[j] * R
            stacked.append(placed)
        return np.asarray(np.linalg.qr(np.concatenate(stacked), mode="r"))

    def matrix(self) -> Float[np.ndarray, "rows columns"]:
        """Return the whole matrix in Fortran's order: all samples of joint 1, of joint 2, etc.

        `packed.matrix().reshape(joints, samples, columns)` is a view by joint and sample.
        """
        dtype = np.result_type(*(x.dtype for x in self.values), np.float32)
        out = np.zeros((self.columns, self.joints, self.samples), dtype)
        values = jax.device_get(self.values)
        for joint, places in enumerate(self.places):
            for k, x in places:
                out[k, joint] = values[x] if isinstance(x, int) else x
        return out.reshape(self.columns, -1).T
