"""Methods for one sample applied to many: in NumPy for few samples, in compiled blocks for many.

A method of a model is traced once into a scalar program, with numbers of the model that
JAX is tracing, or in which models differ, as inputs; the programs of the models that
were used last are kept. Derivatives take the model's spatial form, which is a short
program on whole arrays.
"""

import functools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Array,
    Float,
    Joints,
    Numbers,
    as_array,
    content,
    is_traced,
)
from jaxid.errors import InputError
from jaxid.program import Program, evaluate, evaluate_rows, packed_entries, trace
from jaxid.program.blocks import BLOCK, on_rows
from jaxid.program.rules import with_derivatives_of


class OpenModel(eqx.Module):
    """A method of a model for one sample, whose first argument are numbers of the model."""

    model: eqx.Module  # model; in the place of these numbers it has any others
    method: str = eqx.field(static=True)  # name of the method
    # leaves of the model that have such numbers, and their positions in each
    places: tuple[tuple[int, tuple[int, ...]], ...] = eqx.field(static=True)

    def call(self, numbers: Float[AnyArray, " numbers"], *arguments: AnyArray) -> Array:
        """Call the method of the model with these numbers."""
        leaves, structure = jax.tree.flatten(self.model)
        begun = 0
        for leaf, positions in self.places:
            fixed = leaves[leaf]
            order = np.arange(fixed.size)
            order[list(positions)] = fixed.size + np.arange(len(positions))
            own = numbers[begun : begun + len(positions)]
            leaves[leaf] = jnp.concatenate([fixed.ravel(), own])[order].reshape(
                fixed.shape
            )
            begun += len(positions)
        return getattr(jax.tree.unflatten(structure, leaves), self.method)(*arguments)


def opened(
    method: str, model: eqx.Module, *others: eqx.Module
) -> tuple[OpenModel, Float[AnyArray, "models numbers"]]:
    """Return a method whose inputs are the numbers that JAX is tracing, or in which models differ.

    All other numbers stay constants of a program. The numbers are those of each model.
    """
    leaves, structure = jax.tree.flatten(model)
    each = [leaves, *map(jax.tree.leaves, others)]
    places, numbers = [], []
    for k, values in enumerate(zip(*each, strict=True)):
        traced = is_traced(values)
        if traced:
            leaves[k] = np.zeros(np.shape(values[0]), values[0].dtype)
            positions = np.arange(leaves[k].size)
        else:
            rows = np.array([np.ravel(x) for x in values])
            positions = np.flatnonzero((rows != rows[0]).any(axis=0))
        if len(positions):
            stack = jnp.stack if traced else np.stack
            numbers.append(stack([x.ravel()[positions] for x in values]))
            places.append((k, tuple(positions.tolist())))
    closed = jax.tree.unflatten(structure, leaves)
    join = jnp.concatenate if is_traced(numbers) else np.concatenate
    together = join([np.zeros((len(each), 0)), *numbers], axis=1)
    return OpenModel(closed, method, tuple(places)), together


FEW = 4096
"""Number of samples up to which NumPy is faster than compiling and running XLA."""
KEPT = 64
"""Number of programs that are kept, of the models that were used last."""
LONG = {"inertia": 16, "acceleration": 16}
"""Joints beyond which the program of a method, which grows with their square, is not compiled."""


def spatial_form(owner: Any) -> Any:
    """Return a model, or what holds one, whose methods for one sample are few array operations."""

    def has(x: Any) -> bool:
        return hasattr(x, "spatial_form")

    return jax.tree.map(lambda x: x.spatial_form if has(x) else x, owner, is_leaf=has)


@dataclass(frozen=True, eq=False)
class SampleMethod:
    """A method for one sample: its program, and the function that is differentiated.

    An owner may have a method `derived_program(name, *shapes)`, which returns the
    program of its method of that name if it follows from the program of another model,
    or None.
    """

    owner: Any  # model, whose numbers become constants of the program
    definition: Callable  # method of the model for one sample
    shapes: tuple[tuple[int, ...], ...]  # shapes of the method's arguments

    @functools.cached_property
    def program(self) -> Program:
        """Program of the method, traced when first needed."""
        derive = getattr(self.owner, "derived_program", None)
        name, shapes = self.definition.__name__, self.shapes
        program = None if derive is None else derive(name, *shapes)
        return trace(self.definition, *shapes) if program is None else program

    @functools.cached_property
    def plain(self) -> Callable:
        """The method in spatial form; a function that is no method of the owner, as it is."""
        if getattr(self.definition, "__self__", None) is not self.owner:
            return self.definition
        return getattr(spatial_form(self.owner), self.definition.__name__)

    @property
    def is_long(self) -> bool:
        """Whether the spatial form takes the place of the program, which would be long."""
        joints = self.shapes[-1][0]
        is_own = self.plain is not self.definition
        name = getattr(self.owner, "method", self.definition.__name__)
        return is_own and joints > LONG.get(name, math.inf)

    @functools.cached_property
    def output_shape(self) -> tuple[int, ...]:
        """Shape of the result for one sample."""
        if not self.is_long:
            return self.program.output_shapes[0]
        samples = [jnp.zeros(x) for x in self.shapes]
        return jax.eval_shape(lambda *x: self.plain(*x), *samples).shape

    @functools.cached_property
    def on_rows(self) -> Callable:
        """The method on rows of samples: [samples, ...] from arrays as in `on_rows`."""
        run = plain = functools.partial(plain_rows, self.plain)
        if not self.is_long:
            run = with_derivatives_of(plain, functools.partial(on_rows, self.program))
        return lambda *arrays: run(*arrays).reshape(-1, *self.output_shape)

    @functools.cached_property
    def compiled(self) -> Callable:
        """`on_rows`, compiled."""
        return jax.jit(self.on_rows)


def plain_rows(plain: Callable, *arrays: Array) -> Float[Array, "samples out"]:
    """Apply a function of one sample to arrays as in `on_rows`, in memory that does not grow."""

    def one(parts: list[Array]) -> Array:
        own = iter(parts)
        return jnp.ravel(plain(*(next(own) if x.ndim == 2 else x for x in arrays)))

    samples = [x for x in arrays if x.ndim == 2]
    if len(samples[0]) == 1:
        return one([x[0] for x in samples])[None]

    def in_blocks(samples: list[Array]) -> Array:
        return jax.lax.map(jax.checkpoint(one), samples, batch_size=BLOCK)

    if len(samples[0]) <= BLOCK:
        return jax.vmap(one)(samples)
    return jax.lax.platform_dependent(samples, cpu=in_blocks, default=jax.vmap(one))


_methods: OrderedDict[tuple, SampleMethod] = OrderedDict()
_lock = threading.Lock()


def method_of(
    owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]
) -> SampleMethod:
    """Return a method of a model of known geometry; those that were used last are kept."""
    key = (definition.__name__, shapes, *content(owner))
    with _lock:
        method = _methods.setdefault(key, SampleMethod(owner, definition, shapes))
        _methods.move_to_end(key)
        while len(_methods) > KEPT:
            _methods.popitem(last=False)
    return method


def program_of(
    owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]
) -> Program:
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
        owner, (numbers,) = opened(definition.__name__, owner)
        definition, shared = owner.call, (numbers, *shared)
    arrays = [*(as_array("p", x) for x in shared), *samples]
    try:
        batch = np.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    except ValueError:
        shapes = ", ".join(str(x.shape) for x in arrays)
        raise InputError(
            "leading axes of parameters and motion must fit each other, but shapes "
            f"are {shapes}."
        ) from None
    shapes = tuple(x.shape[-1:] for x in arrays)
    method = method_of(owner, definition, *shapes)
    in_jax = [x for x in arrays if isinstance(x, jax.Array)]
    known = not is_traced(arrays)
    few = known and not method.is_long and math.prod(batch) <= FEW
    devices = {d for x in in_jax for d in x.devices()} if known else set()
    dtype = jnp.result_type(*(x.dtype for x in arrays), float)
    if few and len(devices) <= 1 and all(d.platform == "cpu" for d in devices):
        out = _in_numpy(method.program, arrays, batch).reshape(
            (*batch, *method.output_shape)
        )
        with jax.default_device(*devices or (None,)):
            return jnp.asarray(out, dtype) if in_jax else out
    run = method.compiled if known else method.on_rows
    out = _over_batches(
        run, batch, [jnp.asarray(x, dtype) for x in arrays], len(shared)
    )
    return np.asarray(out) if known and not in_jax else out


def _in_numpy(program: Program, arrays: list, batch: tuple[int, ...]) -> np.ndarray:
    """Return the packed results [samples, results] in NumPy, in the precision of the arrays."""
    dtype = np.result_type(*(x.dtype for x in arrays), np.float32)
    given = [np.moveaxis(np.asarray(x, np.float64), -1, 0) for x in arrays]
    rank = len(batch) + 1
    given = [x.reshape(len(x), *(1,) * (rank - x.ndim), *x.shape[1:]) for x in given]
    rows, entries = evaluate_rows(program, *given), np.arange(len(program.outputs))
    out = np.empty((rows.shape[1], len(entries)), dtype)
    for start in range(0, len(out), BLOCK):
        part = slice(start, start + BLOCK)
        out[part] = packed_entries(program, rows[:, part], entries).T
    return out


def _over_batches(
    run: Callable, batch: tuple[int, ...], arrays: list[Array], shared: int
) -> Array:
    """Apply a function of rows of samples, by `vmap` over the leading axes of parameters."""
    ranks = [x.ndim - 1 for x in arrays[:shared]]
    if not any(ranks):
        rows = [jnp.broadcast_to(x, (*batch, x.shape[-1])) for x in arrays[shared:]]
        rows = [x.reshape(math.prod(batch), x.shape[-1]) for x in rows]
        out = run(*arrays[:shared], *rows)
        return out if len(batch) == 1 else out.reshape((*batch, *out.shape[1:]))
    rank = len(batch)
    full = [x.reshape(*(1,) * (rank + 1 - x.ndim), *x.shape) for x in arrays]
    axes = [0 if x.shape[0] > 1 else None for x in full]
    inner = [x if a == 0 else x[0] for x, a in zip(full, axes, strict=True)]
    if all(a is None for a in axes):
        return _over_batches(run, batch[1:], inner, shared)[None]

    def one(*parts: Array) -> Array:
        given = [
            x.reshape(x.shape[-1:]) if math.prod(x.shape[:-1]) == 1 else x
            for x in parts
        ]
        return _over_batches(run, batch[1:], given, shared)

    return jax.vmap(one, axes)(*inner)


def in_numpy(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[AnyArray, ...] = (),
) -> np.ndarray:
    """Apply a method for one sample to rows of samples in NumPy: float64, never compiled."""
    arguments = [np.asarray(x, np.float64) for x in shared]
    arguments += [np.asarray(x, np.float64).T for x in samples]
    shapes = (*(x.shape for x in shared), *(x.shape[1:] for x in samples))
    out = evaluate(program_of(owner, definition, *shapes), *arguments)
    return np.moveaxis(np.broadcast_to(out, (*out.shape[:-1], len(samples[0]))), -1, 0)


def solve_symmetric(A: Float[AnyArray, "joints joints"], b: Joints) -> Joints:
    r"""Solve $A x = b$ by $A = L D L^T$, without square roots or pivoting, entry by entry.

    Only the lower triangle of A, which is definite, is read. A program has no loops.
    """
    n = b.shape[0]
    scaled = [[A[i, j] for j in range(i + 1)] for i in range(n)]
    lower_rows = [[A[i, j] for j in range(i)] for i in range(n)]
    for j in range(n):
        for i in range(j, n):
            for k in range(j):
                scaled[i][j] = scaled[i][j] - scaled[i][k] * lower_rows[j][k]
            if i > j:
                lower_rows[i][j] = scaled[i][j] / scaled[j][j]
    x = [b[i] for i in range(n)]
    for i in range(n):
        for k in range(i):
            x[i] = x[i] - lower_rows[i][k] * x[k]
    x = [x[i] / scaled[i][i] for i in range(n)]
    for i in reversed(range(n)):
        for k in range(i + 1, n):
            x[i] = x[i] - lower_rows[k][i] * x[k]
    return jnp.stack(x)
