"""Regressor of many samples without its zeros: joint by joint, or stacked.

A joint feels only the bodies beyond it, so most entries of a regressor are zero for
every motion.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, as_array, is_traced, namespace
from jaxid.errors import InputError
from jaxid.program import (
    Lowered,
    Program,
    Shape,
    evaluate_rows,
    kernel_options,
    lower,
    on_any_platform,
    packed_entries,
    select_outputs,
)
from jaxid.program.sample_methods import CACHE_SIZE, MAX_SAMPLES_IN_NUMPY, program_of
from jaxid.program.xla_sample_blocks import distinct_rows, packed_columns, row_products

Columns = tuple[int, ...]
"""Positions of columns, in order."""
Places = tuple[tuple[tuple[int, int | float], ...], ...]
"""For each joint its columns, each with the number of an array or a constant."""


@functools.lru_cache(maxsize=CACHE_SIZE)
def _nonzero_columns(program: Program):
    """Return for each joint the columns of a regressor that are not always zero."""
    nonzeros = np.asarray(program.nonzeros)
    return tuple(tuple(np.flatnonzero(row).tolist()) for row in nonzeros)


class JointRegressor(eqx.Module):
    """Regressor joint by joint, in the columns that can act on the joint."""

    program: Program = eqx.field(static=True)  # program of the regressor
    # for each joint the columns that can act on it
    columns: tuple[Columns, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)  # number of columns

    def __init__(self, owner: eqx.Module, definition: Callable, *shapes: Shape):
        self.program = program_of(owner, definition, *shapes)
        self.columns = _nonzero_columns(self.program)
        self.size = self.program.output_shapes[0][1]

    @property
    def entries(self) -> list[np.ndarray]:
        """For each joint the positions of its columns in the packed result."""
        return [
            joint * self.size + np.array(columns, int)
            for joint, columns in enumerate(self.columns)
        ]

    def __call__(self, *arrays: AnyArray, fence: bool = False) -> list[Array]:
        """Return the columns of each joint, from arguments with samples last."""
        shape = jnp.shape(arrays[0])[1:]
        *batch, samples = shape
        dtype = jnp.result_type(*arrays, float)
        if self.program.loops is None:
            distinct_values = lower(self.program, fence).distinct(*arrays)
        else:
            # XLA would take minutes to compile a long program in one piece.
            rows = [jnp.reshape(x, (len(x), -1)).T for x in arrays]
            matrix = distinct_rows(self.program, *rows)
            distinct_values = tuple(matrix.reshape(-1, *shape))
        # Constants come as floats; an array of the batch's shape is made of each.
        values = self.program.pack(distinct_values)

        joints = []
        for entries in self.entries:
            if not len(entries):
                joints.append(jnp.zeros((*batch, 0, samples), dtype))
                continue
            columns = []
            for entry in entries:
                column = jnp.asarray(values[entry], dtype)
                columns.append(jnp.broadcast_to(column, shape))
            joints.append(jnp.stack(columns, axis=-2))
        return joints

    def gram(self, weights: AnyArray, *arrays: AnyArray) -> Array:
        r"""Return $\sum_k \Theta_k^T W^2 \Theta_k$, without storing the columns."""
        groups = tuple(tuple(entries.tolist()) for entries in self.entries)
        products = row_products(self.program, groups, *map(jnp.asarray, arrays))
        total = jnp.zeros((self.size, self.size), arrays[0].dtype)
        for columns, weight, product in zip(
            self.columns, weights, products, strict=True
        ):
            place = np.array(columns, int)
            weighted_product = weight**2 * product
            total = total.at[place[:, None], place].add(weighted_product)
        return total

    def evaluate(self, *arrays: AnyArray) -> list[Any]:
        """Return the columns of each joint [columns, *batch], each entry stored.

        NumPy evaluates arrays of NumPy; XLA evaluates others, in blocks of samples.
        """
        if namespace(*arrays) is not np:
            program = _nonzero_program(self.program)
            packed_values = packed_columns(program, *map(jnp.asarray, arrays))
            ends = np.cumsum([len(entries) for entries in self.entries])
            return jnp.split(packed_values, ends[:-1])
        batch = np.shape(arrays[0])[1:]
        rows = evaluate_rows(self.program, *arrays)
        joints = []
        for entries in self.entries:
            values = packed_entries(self.program, rows, entries)
            joints.append(values.reshape(len(entries), *batch))
        return joints


@functools.lru_cache(maxsize=CACHE_SIZE)
def _nonzero_program(program: Program):
    """Return the program of the entries that are not always zero."""
    return select_outputs(program, np.flatnonzero(program.nonzeros))


@functools.lru_cache(maxsize=CACHE_SIZE)
def _compiled_gram(regressor: JointRegressor):
    return jax.jit(regressor.gram, compiler_options=kernel_options(regressor.program))


def gram(
    owner: eqx.Module, definition: Callable, weights: AnyArray | None, *arrays: AnyArray
) -> Array:
    """Return the Gram matrix of a model's columns over a motion; see `Model.gram`."""
    _check_positions(owner, arrays[0])
    joints = arrays[1].shape[1]
    weights = np.ones(joints) if weights is None else as_array("weights", weights)
    regressor = JointRegressor(owner, definition, *(x.shape[1:] for x in arrays))
    run = regressor.gram if is_traced(arrays, weights) else _compiled_gram(regressor)
    return run(jnp.asarray(weights, arrays[0].dtype), *arrays)


def _check_positions(owner: eqx.Module, q: AnyArray):
    """Require many samples and a robot of known geometry."""
    if q.ndim != 2:
        raise InputError(
            f"`motion` must have the shape [samples, joints], but has {q.shape}."
        )
    if is_traced(owner):
        raise InputError(
            "a packed regressor needs a robot whose geometry is known: use `regressor`."
        )


class PackedRegressor(eqx.Module):
    r"""Stacked regressor $\bar\Theta$ as the entries that are not always zero (Eq. 26).

    It has one array over the samples for each entry that varies, and writes zeros only
    into the `matrix`.

    Attributes:
        values: Distinct entries that vary with the motion, over the samples: arrays,
            or the rows of a matrix for a robot of many joints.
        places: For each joint the pairs of a column and either the number of its array
            in `values` or its constant, a float.
        samples: Number of samples.
        columns: Number of parameters.
    """

    values: Sequence[Float[AnyArray, " samples"]]
    places: Places = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    columns: int = eqx.field(static=True)

    def __init__(self, owner: eqx.Module, definition: Callable, *samples: AnyArray):
        _check_positions(owner, samples[0])
        arrays = [x.T for x in samples]
        shapes = [x.shape[:1] for x in arrays]
        program = program_of(owner, definition, *shapes)
        self.places = _places(program)
        self.samples = len(samples[0])
        self.columns = program.output_shapes[0][1]
        if is_traced(arrays):
            self.values = _distinct_values(program, *arrays)
        elif self.samples > MAX_SAMPLES_IN_NUMPY:
            self.values = _compiled(program)(*arrays)
        else:
            self.values = tuple(evaluate_rows(program, *arrays))

    def matrix(self) -> np.ndarray:
        """Return the whole matrix: all samples of joint 1, of joint 2, etc.

        `packed.matrix().reshape(joints, samples, columns)` is a view by joint and
        sample.
        """
        values = jax.device_get(self.values)
        dtype = np.result_type(np.float32, *{x.dtype for x in values})
        joints = len(self.places)
        shape = (self.columns, joints, self.samples)
        matrix = np.zeros(shape, dtype)
        for joint, places in enumerate(self.places):
            for column, place in places:
                is_constant = isinstance(place, float)
                matrix[column, joint] = place if is_constant else values[place]
        return matrix.reshape(self.columns, -1).T


@functools.lru_cache(maxsize=CACHE_SIZE)
def _places(program: Program):
    """Return the `places` of a packed regressor; what is always zero has none."""
    nodes, _ = program.distinct
    numbers_or_zero = program.pack(range(len(nodes)))
    shape = program.output_shapes[0]
    entries = np.array(numbers_or_zero, object).reshape(shape)
    places = []
    for row in entries:
        # An `int` numbers an array of values, a `float` is a constant.
        is_nonzero = [isinstance(x, int) or x != 0 for x in row]
        columns = np.flatnonzero(is_nonzero).tolist()
        places.append(tuple((column, row[column]) for column in columns))
    return tuple(places)


def _distinct_values(program: Program, *arrays: Any) -> Any:
    """Return the distinct entries of arrays with samples last."""
    if program.loops is not None:
        return distinct_rows(program, *(a.T for a in arrays))
    return on_any_platform(program, Lowered.distinct, *arrays)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _compiled(program: Program):
    function = functools.partial(_distinct_values, program)
    return jax.jit(function, compiler_options=kernel_options(program))
