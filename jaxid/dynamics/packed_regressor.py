"""Regressor of many samples without its zeros: evaluated joint by joint, or stacked and packed.

A joint feels only the bodies beyond it, so most entries of a regressor are zero for
every motion.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, as_array, is_traced
from jaxid.errors import InputError
from jaxid.program import (
    Lowered,
    Program,
    evaluate_rows,
    lower,
    on_any_platform,
    packed_entries,
)
from jaxid.program.blocks import row_products

from .dispatch import FEW, KEPT, program_of


class JointRegressor(eqx.Module):
    """Compiled regressor, evaluated joint by joint in the columns that can act on the joint."""

    program: Program = eqx.field(static=True)  # program of the regressor
    # for each joint the columns that can act on it
    columns: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)  # number of columns

    def __init__(
        self, owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]
    ):
        self.program = program_of(owner, definition, *shapes)
        rows = np.asarray(self.program.nonzeros)
        self.columns = tuple(tuple(np.flatnonzero(row).tolist()) for row in rows)
        self.size = rows.shape[1]

    def __call__(
        self, *arrays: AnyArray, fence: bool | None = None
    ) -> list[Float[Array, "*batch columns samples"]]:
        """Return the columns of each joint, from arguments whose batch and samples stand last."""
        packed = lower(self.program, fence)(*arrays)
        like = jnp.zeros(jnp.shape(arrays[0])[1:], jnp.result_type(*arrays, float))

        def row(x: Array | float) -> Array:
            return jnp.broadcast_to(jnp.asarray(x, like.dtype), like.shape)

        none = jnp.zeros((*like.shape[:-1], 0, *like.shape[-1:]), like.dtype)
        rows = [
            [row(packed[joint * self.size + k]) for k in own]
            for joint, own in enumerate(self.columns)
        ]
        return [jnp.stack(own, axis=-2) if own else none for own in rows]

    def gram(
        self, weights: AnyArray, *arrays: AnyArray
    ) -> Float[Array, "columns columns"]:
        r"""Return $\sum_k \Theta_k^T W^2 \Theta_k$ over samples, without storing the columns."""
        groups = tuple(
            tuple(j * self.size + k for k in own) for j, own in enumerate(self.columns)
        )
        whole = jnp.zeros((self.size, self.size), arrays[0].dtype)
        sums = row_products(self.program, groups, *map(jnp.asarray, arrays))
        for own, w, products in zip(self.columns, weights, sums, strict=True):
            k = np.array(own, int)
            whole = whole.at[k[:, None], k].add(w**2 * products)
        return whole

    def in_numpy(self, *arrays: AnyArray) -> list[Float[np.ndarray, "columns samples"]]:
        """Return the columns of each joint, evaluated in NumPy."""
        batch, program, found = np.shape(arrays[0])[1:], self.program, []
        rows = evaluate_rows(program, *arrays)
        for joint, own in enumerate(self.columns):
            entries = joint * self.size + np.array(own, int)
            found.append(
                packed_entries(program, rows, entries).reshape(len(own), *batch)
            )
        return found


@functools.lru_cache(maxsize=KEPT)
def _compiled_gram(regressor: JointRegressor) -> Callable:
    return jax.jit(regressor.gram)


def gram(
    owner: eqx.Module, definition: Callable, weights: AnyArray | None, *arrays: AnyArray
) -> Float[Array, "columns columns"]:
    """Return the Gram matrix of a model's columns over a motion; see `Model.gram`."""
    n = _require_rows(owner, arrays[0])
    weights = np.ones(n) if weights is None else as_array("weights", weights)
    regressor = JointRegressor(owner, definition, *((n,) for _ in arrays))
    run = regressor.gram if is_traced(arrays, weights) else _compiled_gram(regressor)
    return run(jnp.asarray(weights, arrays[0].dtype), *arrays)


def _require_rows(owner: eqx.Module, q: AnyArray) -> int:
    if q.ndim != 2:
        raise InputError(
            f"`motion` must have the shape [samples, joints], but has {q.shape}."
        )
    if is_traced(owner):
        raise InputError(
            "a packed regressor needs a robot whose geometry is known: use `regressor`."
        )
    return q.shape[1]


class PackedRegressor(eqx.Module):
    r"""Stacked regressor $\bar\Theta$ as the entries that are not always zero (Eq. 26).

    It has one array over the samples for each entry that varies, and writes zeros only
    into the `matrix`.

    Attributes:
        values: Distinct entries that vary with the motion, over the samples.
        places: For each joint the pairs of a column and either the number of its array
            in `values` or its constant, a float.
        samples: Number of samples.
        columns: Number of parameters.
    """

    values: tuple[Float[AnyArray, " samples"], ...]
    places: tuple[tuple[tuple[int, int | float], ...], ...] = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def __init__(self, owner: eqx.Module, definition: Callable, *samples: AnyArray):
        _require_rows(owner, samples[0])
        arrays = [x.T for x in samples]
        program = program_of(owner, definition, *(x.shape[:1] for x in arrays))
        self.places = _places(program)
        self.samples, self.columns = len(samples[0]), program.output_shapes[0][1]
        many = self.samples > FEW or is_traced(arrays)
        self.values = tuple(
            _compiled(program)(*arrays) if many else evaluate_rows(program, *arrays)
        )

    def matrix(self) -> Float[np.ndarray, "rows columns"]:
        """Return the whole matrix in Fortran's order: all samples of joint 1, of joint 2, etc.

        `packed.matrix().reshape(joints, samples, columns)` is a view by joint and
        sample.
        """
        dtype = np.result_type(*(x.dtype for x in self.values), np.float32)
        out = np.zeros((self.columns, len(self.places), self.samples), dtype)
        values = jax.device_get(self.values)
        for joint, places in enumerate(self.places):
            for k, x in places:
                out[k, joint] = values[x] if isinstance(x, int) else x
        return out.reshape(self.columns, -1).T


@functools.lru_cache(maxsize=KEPT)
def _places(program: Program) -> tuple[tuple[tuple[int, int | float], ...], ...]:
    """Return the `places` of a packed regressor; what is always zero has none."""
    entries = program.pack(range(len(program.distinct[0])))
    rows = np.array(entries, object).reshape(program.output_shapes[0])
    return tuple(
        tuple((k, x) for k, x in enumerate(row) if isinstance(x, int) or x != 0)
        for row in rows
    )


@functools.lru_cache(maxsize=KEPT)
def _compiled(program: Program) -> Callable:
    return jax.jit(functools.partial(on_any_platform, program, Lowered.distinct))
