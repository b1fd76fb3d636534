"""Methods for one sample applied to many: in NumPy, or in compiled blocks.

A method of a model is traced once into a scalar program; the programs of the models
that were used last are kept. Derivatives take the model's spatial form, which is a
short program on whole arrays.
"""

import dataclasses
import functools
import itertools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Numbers,
    as_array,
    content,
    is_traced,
)
from jaxid.errors import InputError

from .equal_parts import find_equal_parts
from .jax_transformation_rules import with_derivatives_of
from .numpy_evaluation import evaluate
from .open_model import opened, with_open_numbers
from .program import Program, Shape, select_outputs
from .trace import trace
from .xla import kernel_options
from .xla_sample_blocks import BLOCK, on_rows

MAX_SAMPLES_IN_NUMPY = 4096
"""Number of samples up to which NumPy is faster than compiling and running XLA."""
PART_NUMBERS = 2**17
"""Numbers of a result that are computed together on a CPU, without constant zeros.

Their 1 MB of XLA's memory stays in the cache and is used again for the next part. XLA's
memory for a whole regressor would be new in every call, and its pages cost more than
the arithmetic; NumPy asks for large pages. The compiled function serves every larger
number of samples.
"""
ALIGNMENT = 64
"""Bytes to which memory is aligned that JAX takes without a copy."""
CACHE_SIZE = 64
"""Number of programs that are kept, of the models that were used last."""


class FormLimits(NamedTuple):
    """Limits by which a method is compiled in one piece, in loops, or in spatial form.

    XLA takes some 4 ms for each operation of a program.

    Attributes:
        piece: Operations up to which a program is compiled in one piece.
        rows: Operations and results up to which rows of samples are.
        repetition: Ratio of operations from which loops over equal parts pay: each turn
            moves values to and fro.
        program: Operations above which loops are taken for any repetition, or the
            spatial form if there are none.
    """

    piece: int = 4000
    rows: int = 5000
    repetition: float = 8
    program: int = 6000


LIMITS = FormLimits()


def spatial_form(owner: Any) -> Any:
    """Return a model, or what holds one, with methods of few array operations."""

    def has_spatial_form(part):
        return hasattr(part, "spatial_form")

    def transform(part):
        return part.spatial_form if has_spatial_form(part) else part

    return jax.tree.map(transform, owner, is_leaf=has_spatial_form)


@dataclass(frozen=True, eq=False)
class SampleMethod:
    """A method for one sample: its program, and the function that is differentiated.

    An owner may have a method `derived_program(name, *shapes)`, which returns the
    program of its method of that name if it follows from the program of another model,
    or None.
    """

    owner: Any  # model, whose numbers become constants of the program
    definition: Callable  # method of the model for one sample
    shapes: tuple[Shape, ...]  # shapes of the method's arguments

    @functools.cached_property
    def program(self) -> Program:
        """Program of the method, traced when first needed."""
        derive = getattr(self.owner, "derived_program", None)
        if derive is not None:
            program = derive(self.definition.__name__, *self.shapes)
            if program is not None:
                return program
        program = trace(self.definition, *self.shapes)
        is_short = program.counts.total <= LIMITS.piece
        return program if is_short else self._in_loops(program)

    def _in_loops(self, program: Program) -> Program:
        """Return a long program with the loops over its equal parts."""
        if getattr(self.definition, "__self__", None) is not self.owner:
            return program
        model, numbers = with_open_numbers(self.owner, self.definition.__name__)
        open_program = trace(model.call, numbers.shape, *self.shapes)
        loops = find_equal_parts(open_program, numbers)
        is_short = program.counts.total <= LIMITS.program
        if loops is None or (is_short and loops.repetition < LIMITS.repetition):
            return program
        return dataclasses.replace(program, loops=loops)

    @functools.cached_property
    def _rows(self) -> Program:
        """Program of rows of samples, in loops if it has many results.

        Memory for many results takes longer than the loops.
        """
        size = self.program.counts.total + len(self.program.outputs)
        if self.program.loops is not None or size <= LIMITS.rows:
            return self.program
        return self._in_loops(self.program)

    @functools.cached_property
    def spatial_definition(self) -> Callable:
        """The method in spatial form, or a function that has no such form."""
        if getattr(self.definition, "__self__", None) is not self.owner:
            return self.definition
        return getattr(spatial_form(self.owner), self.definition.__name__)

    @property
    def is_long(self) -> bool:
        """Whether the program is too long for XLA, and the spatial form is used."""
        if self.spatial_definition is self.definition:
            return False
        is_in_loops = self.program.loops is not None
        return self.program.counts.total > LIMITS.program and not is_in_loops

    @functools.cached_property
    def nonzeros(self) -> np.ndarray:
        """Positions of the entries that are computed: zeros stay out of a program."""
        is_nonzero = np.ravel(self.program.nonzeros)
        return np.flatnonzero(is_nonzero | self.is_long)

    @functools.cached_property
    def nonzero_runs(self) -> list[tuple[slice, slice]]:
        """Places of neighbouring nonzeros in the result, and among the nonzeros."""
        breaks = 1 + np.flatnonzero(np.diff(self.nonzeros) > 1)
        runs = []
        start = 0
        for positions in np.split(self.nonzeros, breaks):
            if len(positions):
                stop = start + len(positions)
                place = slice(positions[0], positions[-1] + 1)
                runs.append((place, slice(start, stop)))
                start = stop
        return runs

    @functools.cached_property
    def nonzero_program(self) -> Program:
        """Program of these entries."""
        program = self._rows
        if len(self.nonzeros) == len(program.outputs):
            return program
        return select_outputs(program, self.nonzeros)

    @property
    def output_shape(self) -> Shape:
        """Shape of the result for one sample."""
        return self.program.output_shapes[0]

    @functools.cached_property
    def over_rows(self) -> Callable:
        """The method over many samples: [samples, ...] from rows of each argument."""
        method = functools.partial(definition_on_rows, self.spatial_definition)
        if not self.is_long:
            # The program is the fastest; its derivatives are those of the spatial form.
            method = with_derivatives_of(method, functools.partial(on_rows, self._rows))
        return lambda *arrays: method(*arrays).reshape(-1, *self.output_shape)

    @functools.cached_property
    def compiled(self) -> Callable:
        """`over_rows`, compiled."""
        options = None if self.is_long else kernel_options(self.program)
        return jax.jit(self.over_rows, compiler_options=options)

    @property
    def part_size(self) -> int:
        """Number of samples that are computed together on a CPU."""
        numbers = BLOCK * len(self.nonzeros)
        return BLOCK * max(1, PART_NUMBERS // max(1, numbers))

    @functools.cached_property
    def compiled_nonzeros(self) -> Callable:
        """Entries that are not always zero, compiled: [samples, ...]."""
        if self.nonzero_program is self._rows:
            return self.compiled
        run = functools.partial(on_rows, self.nonzero_program)
        return jax.jit(run, compiler_options=kernel_options(self.program))

    def in_numpy(self, *arrays: AnyArray) -> np.ndarray:
        """Compute entries that are not always zero in NumPy: [samples, ...]."""
        results = evaluate(self.nonzero_program, *map(_entries_first, arrays))
        return results.reshape(-1, results.shape[-1]).T


def definition_on_rows(definition: Callable, *arrays: Array) -> Array:
    """Apply a function of one sample to arrays as in `on_rows`, block by block."""

    def on_one_sample(rows):
        remaining_rows = iter(rows)
        arguments = [next(remaining_rows) if x.ndim == 2 else x for x in arrays]
        return jnp.ravel(definition(*arguments))

    def in_blocks(samples):
        # Without checkpoints a gradient would store the intermediates of all blocks.
        block_function = jax.checkpoint(on_one_sample)
        return jax.lax.map(block_function, samples, batch_size=BLOCK)

    samples = [x for x in arrays if x.ndim == 2]
    count = len(samples[0])
    if count == 1:
        return on_one_sample([x[0] for x in samples])[None]
    vectorised_method = jax.vmap(on_one_sample)
    if count <= BLOCK:
        return vectorised_method(samples)
    return jax.lax.platform_dependent(samples, cpu=in_blocks, default=vectorised_method)


_methods: OrderedDict[tuple, SampleMethod] = OrderedDict()
_lock = threading.Lock()


def method_of(owner: eqx.Module, definition: Callable, *shapes: Shape) -> SampleMethod:
    """Return a method of a model; those that were used last are kept."""
    # By content: equal models that were made one after the other share their programs.
    key = (definition.__name__, shapes, *content(owner))
    with _lock:
        method = _methods.setdefault(key, SampleMethod(owner, definition, shapes))
        _methods.move_to_end(key)
        while len(_methods) > CACHE_SIZE:
            _methods.popitem(last=False)
    return method


def program_of(owner: eqx.Module, definition: Callable, *shapes: Shape) -> Program:
    """Return the scalar program of a method of a model; see `method_of`."""
    return method_of(owner, definition, *shapes).program


def on_samples(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[Numbers, ...] = (),
) -> AnyArray:
    """Apply a method for one sample to arrays with any leading batch axes.

    NumPy arrays give a NumPy array; arrays of JAX one on their device. The method takes
    first the `shared` parameters, which all samples have in common or which have batch
    axes too.
    """
    if is_traced(owner):
        model, (numbers,) = opened(definition.__name__, owner)
        return on_samples(model, model.call, *samples, shared=(numbers, *shared))

    # Lists become NumPy arrays; only arrays of JAX make the result one.
    parameters = [as_array("p", x) for x in shared]
    arrays = [*parameters, *samples]
    batch = _batch_shape(arrays)
    shapes = [x.shape[-1:] for x in arrays]
    method = method_of(owner, definition, *shapes)
    dtype = jnp.result_type(*(x.dtype for x in arrays), float)
    jax_arrays = [x for x in arrays if isinstance(x, jax.Array)]
    # Inside `jit` and the like the method becomes a part of what is compiled.
    if is_traced(arrays):
        inputs = [jnp.asarray(x, dtype) for x in arrays]
        return _over_batches(method.over_rows, batch, inputs, len(shared))

    # A few samples are done before XLA has compiled; arrays elsewhere stay there.
    devices = set().union(*(x.devices() for x in jax_arrays))
    platforms = {device.platform for device in devices} or {jax.default_backend()}
    is_on_one_cpu = len(devices) <= 1 and platforms == {"cpu"}
    is_small = math.prod(batch) <= MAX_SAMPLES_IN_NUMPY and not method.is_long
    if is_small and not jax_arrays:
        columns = [_entries_first(x) for x in arrays]
        results = evaluate(method.program, *columns)
        return _samples_first(results, len(batch)).astype(dtype, copy=False)

    has_common_parameters = all(x.ndim == 1 for x in parameters)
    if is_on_one_cpu and (is_small or has_common_parameters):
        # What NumPy computes is in parts already.
        run = method.in_numpy if is_small else method.compiled_nonzeros
        size = MAX_SAMPLES_IN_NUMPY if is_small else method.part_size
        device = next(iter(devices), None)
        with jax.default_device(device):
            results = _in_parts(method, run, size, batch, parameters, samples, dtype)
            if not jax_arrays:
                return results
            is_committed = any(x.committed for x in jax_arrays)
            place = device if is_committed else None
            return jax.device_put(results, place, may_alias=True)
    inputs = [jnp.asarray(x, dtype) for x in arrays]
    results = _over_batches(method.compiled, batch, inputs, len(shared))
    return results if jax_arrays else np.asarray(results)


def _in_parts(
    method: SampleMethod,
    run: Callable,
    size: int,
    batch: Shape,
    parameters: Sequence[AnyArray],
    samples: Sequence[AnyArray],
    dtype: np.dtype,
) -> np.ndarray:
    """Apply a method to many samples on a CPU, part by part."""
    count = math.prod(batch)
    arrays = []
    for k, x in enumerate((*parameters, *samples)):
        rows = np.asarray(x, dtype)
        is_common = k < len(parameters) and x.ndim == 1
        if not is_common:
            entries = x.shape[-1]
            rows = np.broadcast_to(rows, (*batch, entries)).reshape(count, entries)
        arrays.append(rows)
    results = _aligned_zeros((count, math.prod(method.output_shape)), dtype)

    def computed_parts():
        for k in range(0, count, size):
            # The last part begins earlier, so that it is as long as the others.
            start = max(0, min(k, count - size))
            part = slice(start, min(start + size, count))
            yield part, run(*(x if x.ndim == 1 else x[part] for x in arrays))
        yield slice(0), results

    # While a part is computed, the one before is copied.
    for (part, values), _ in itertools.pairwise(computed_parts()):
        matrix = np.asarray(values).reshape(len(values), -1)
        for place, entries in method.nonzero_runs:
            results[part, place] = matrix[:, entries]
    return results.reshape(*batch, *method.output_shape)


def _aligned_zeros(shape: Shape, dtype: np.dtype):
    """Return zeros in memory that JAX takes without a copy."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = np.zeros(size + ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % ALIGNMENT
    return memory[start : start + size].view(dtype).reshape(shape)


def _batch_shape(arrays: list[AnyArray]):
    """Return the shape to which the leading axes of arrays are broadcast."""
    try:
        return np.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    except ValueError:
        shapes = ", ".join(str(x.shape) for x in arrays)
        raise InputError(
            "leading axes of parameters and motion must "
            f"fit each other, but shapes are {shapes}."
        ) from None


def _entries_first(x: AnyArray):
    """Return an array [*batch, entries] as [entries, *batch], in float64."""
    return np.moveaxis(np.asarray(x, np.float64), -1, 0)


def _samples_first(results: np.ndarray, batch_axes: int):
    """Return results [*shape, *batch] as [*batch, *shape], without a copy."""
    axes = range(results.ndim)
    sample_axis = results.ndim - batch_axes
    return results.transpose(*axes[sample_axis:], *axes[:sample_axis])


def _over_batches(run: Callable, batch: Shape, arrays: list[Array], shared: int):
    """Apply a function of rows to arrays whose leading axes are broadcast.

    The first arrays, of this number, are parameters; the others are samples.
    """
    if all(x.ndim == 1 for x in arrays[:shared]):
        count = math.prod(batch)
        rows = [_broadcast_rows(x, batch, (count,)) for x in arrays[shared:]]
        results = run(*arrays[:shared], *rows)
    else:
        # Blocks of samples have their parameters in common where these have an axis
        # of length one for the samples.
        samples = batch[-1]
        inputs = []
        for k, x in enumerate(arrays):
            is_common = k < shared and (x.ndim == 1 or x.shape[-2] == 1)
            if not is_common:
                inputs.append(_broadcast_rows(x, batch, (-1, samples)))
                continue
            vector = x if x.ndim == 1 else x[..., 0, :]
            inputs.append(_broadcast_rows(vector, batch[:-1], (-1,)))
        results = jax.vmap(run)(*inputs)
        results = results.reshape(-1, *results.shape[2:])
    return results.reshape(*batch, *results.shape[1:])


def _broadcast_rows(x: Array, batch: Shape, axes: Shape):
    """Repeat an array along a batch, whose axes are given another shape then."""
    entries = x.shape[-1]
    return jnp.broadcast_to(x, (*batch, entries)).reshape(*axes, entries)


def in_numpy(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[AnyArray, ...] = (),
) -> np.ndarray:
    """Apply a method for one sample to rows of samples in NumPy, in float64."""
    parameters = [np.asarray(x, np.float64) for x in shared]
    columns = [_entries_first(x) for x in samples]
    shapes = [x.shape for x in parameters] + [x.shape[:1] for x in columns]
    results = evaluate(program_of(owner, definition, *shapes), *parameters, *columns)
    return _samples_first(results, 1)


def evaluate_samples(owner: eqx.Module, method: Callable, *samples: AnyArray) -> Any:
    """Apply a method for one sample; rows of samples in NumPy need no compiler."""
    first_samples = samples[0]
    is_rows = isinstance(first_samples, np.ndarray) and first_samples.ndim == 2
    evaluate = in_numpy if is_rows else on_samples
    return evaluate(owner, method, *samples)
