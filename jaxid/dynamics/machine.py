"""Which machine runs a definition: NumPy for few samples, fused XLA for many, JAX as it stands.

A definition is a method of a model for one sample. For a robot whose geometry is known it is traced
once into a scalar program; programs are kept for the models that were used last. A model whose
geometry JAX is tracing has no program: its definition runs as it is written.
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Numbers, as_array, content, is_traced
from jaxid.errors import InputError
from jaxid.program import Program, evaluate, evaluate_packed, lower, select_outputs, trace

FEW = 4096
"""Samples up to which NumPy is faster than what compiling costs."""
_KEPT = 64


class Machines:
    """A program and its compiled form."""

    def __init__(self, program: Program):
        self.program = program
        lowered = lower(program)
        self.compiled = jax.jit(lambda *arrays: lowered.dense(*arrays))
        varying = [(k, x) for k, x in enumerate(program.outputs) if isinstance(x, int)]
        first = {x: k for k, x in reversed(varying)}
        numbers = {x: k for k, x in enumerate(first)}
        self.entries = tuple(numbers[x] if isinstance(x, int) else x for x in program.outputs)
        self._distinct = [first[x] for x in numbers]
        self._compiled_packed = jax.jit(lambda *arrays: self._chosen(lowered(*arrays)))

    def packed(self, compiled: bool, *arrays: AnyArray) -> "Packed":
        """The entries that vary, each one once, evaluated in NumPy or compiled."""
        if compiled:
            values = self._compiled_packed(*arrays)
        else:
            values = self._chosen(evaluate_packed(self.program, *arrays))
        return Packed(self.program.output_shapes, self.entries, tuple(values))

    def _chosen(self, outputs: list) -> list:
        return [outputs[k] for k in self._distinct]


class Packed(NamedTuple):
    """What a program computes, without its zeros and repetitions.

    Attributes:
        shapes: Of the outputs.
        entries: For each entry of each output, in order, the number of its array, or the constant
            that it always is.
        values: The arrays, batch last.
    """

    shapes: tuple[tuple[int, ...], ...]
    entries: tuple[int | float, ...]
    values: tuple[AnyArray, ...]


_machines: OrderedDict[tuple, Machines] = OrderedDict()
_lock = threading.Lock()


def machines(owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]) -> Machines:
    """The program of a method of a model, traced the first time it is needed.

    Args:
        owner: The model, whose numbers become constants of the program.
        definition: Its method for one sample.
        shapes: Of the method's arguments.
    """
    key = (definition.__name__, shapes, *content(owner))
    with _lock:
        if key in _machines:
            _machines.move_to_end(key)
            return _machines[key]
    made = Machines(_translated(owner, definition, shapes))
    with _lock:
        _machines[key] = made
        while len(_machines) > _KEPT:
            _machines.popitem(last=False)
    return made


def columns_of(source: Callable[[Any], tuple[eqx.Module, Callable, tuple[int, ...]]]) -> Callable:
    """Marks a definition that is some columns of another: its program follows from the other's.

    Args:
        source: From a model to the other one, its definition, and the columns.
    """

    def mark(definition: Callable) -> Callable:
        definition.__dict__["columns_of"] = source
        return definition

    return mark


def _translated(owner: eqx.Module, definition: Callable, shapes: tuple) -> Program:
    source = getattr(getattr(definition, "__func__", None), "columns_of", None)
    if source is None:
        return trace(definition, *shapes)
    other, whole, columns = source(owner)
    program = program_of(other, whole, *shapes)
    (shape,) = program.output_shapes
    entries = np.arange(math.prod(shape)).reshape(shape)
    return select_outputs(program, entries[:, np.array(columns, int)])


def program_of(owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]) -> Program:
    """The scalar program of a method of a model."""
    return machines(owner, definition, *shapes).program


def on_samples(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[Numbers, ...] = (),
) -> Array:
    """Applies a method for one sample to arrays with any leading batch axes.

    Args:
        owner: The model.
        definition: Its method of first the shared arguments, then those of one sample.
        samples: Arguments with batch axes before their last axis.
        shared: Parameters that all samples have in common.

    Raises:
        InputError: If the arguments do not have the same shape, or parameters are no numbers.
    """
    shared = tuple(as_array("p", x) for x in shared)
    if any(x.shape != samples[0].shape for x in samples):
        came = ", ".join(str(x.shape) for x in samples)
        raise InputError(
            f"coordinates, velocities and accelerations must have one shape, but have {came}."
        )
    batch = samples[0].shape[:-1]
    count = math.prod(batch)
    flat = [x.reshape((count, x.shape[-1])) for x in samples]
    if is_traced(owner):
        out = jax.vmap(lambda *x: definition(*shared, *x))(*map(jnp.asarray, flat))
        return jnp.reshape(out, (*batch, *out.shape[1:]))
    shapes = (*(x.shape for x in shared), *(x.shape[1:] for x in flat))
    machine = machines(owner, definition, *shapes)
    arguments = (*shared, *(x.T for x in flat))
    if count <= FEW and not is_traced(arguments):
        out = jnp.asarray(evaluate(machine.program, *arguments), _precision(arguments))
    else:
        out = machine.compiled(*arguments)
    out = jnp.moveaxis(jnp.broadcast_to(out, (*out.shape[:-1], count)), -1, 0)
    return jnp.reshape(out, (*batch, *out.shape[1:]))


def packed_on_samples(owner: eqx.Module, definition: Callable, *samples: AnyArray) -> Packed:
    """Applies a method for one sample to rows of samples; zeros and repetitions are left out.

    Raises:
        InputError: If JAX is tracing the model's own numbers, as a gradient with respect to the
            geometry does: which entries are zero is then unknown.
    """
    if is_traced(owner):
        raise InputError(
            "a packed regressor needs a robot whose geometry is known, but JAX is tracing it: use "
            "`regressor` there."
        )
    machine = machines(owner, definition, *(x.shape[1:] for x in samples))
    arguments = [x.T for x in samples]
    compiled = samples[0].shape[0] > FEW or is_traced(arguments)
    if not compiled:
        arguments = [np.asarray(x, np.float64) for x in arguments]
    return machine.packed(compiled, *arguments)


def in_numpy(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[AnyArray, ...] = (),
) -> np.ndarray:
    """Applies a method for one sample to rows of samples in NumPy: float64, never compiled."""
    arguments = [np.asarray(x, np.float64) for x in shared]
    arguments += [np.asarray(x, np.float64).T for x in samples]
    shapes = (*(x.shape for x in shared), *(x.shape[1:] for x in samples))
    out = evaluate(program_of(owner, definition, *shapes), *arguments)
    return np.moveaxis(np.broadcast_to(out, (*out.shape[:-1], len(samples[0]))), -1, 0)


def _precision(arguments: tuple[AnyArray, ...]) -> Any:
    return jnp.result_type(*(x.dtype for x in arguments), float)
