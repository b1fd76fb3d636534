"""JAX primitives that only move entries of an array, on arrays of scalars.

The common ones are written out for NumPy. The others (gather, scatter, dynamic slices) move the
*positions* of the entries with JAX itself, and then the entries follow.
"""

from collections.abc import Callable

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from jaxid.errors import InputError


def is_symbolic(x: np.ndarray) -> bool:
    """Whether the array holds scalars of a trace."""
    return x.dtype == object


def _broadcast(x: np.ndarray, *_, shape, broadcast_dimensions, **__) -> np.ndarray:
    placed = [1] * len(shape)
    for source, target in enumerate(broadcast_dimensions):
        placed[target] = x.shape[source]
    return np.broadcast_to(x.reshape(placed), shape)


def _slice(x: np.ndarray, *, start_indices, limit_indices, strides) -> np.ndarray:
    steps = strides or (1,) * x.ndim
    return x[tuple(slice(*s) for s in zip(start_indices, limit_indices, steps, strict=True))]


def _split(x: np.ndarray, *, sizes, axis) -> list[np.ndarray]:
    return np.split(x, np.cumsum(sizes)[:-1], axis=axis)


def _pad(x: np.ndarray, filler: np.ndarray, *, padding_config) -> np.ndarray:
    for axis, (low, high, interior) in enumerate(padding_config):
        x = np.moveaxis(x, axis, 0)
        spread = max(len(x) + (len(x) - 1) * interior, 0)
        padded = np.full((max(low, 0) + spread + max(high, 0), *x.shape[1:]), filler, x.dtype)
        padded[max(low, 0) : max(low, 0) + spread : interior + 1] = x
        x = np.moveaxis(padded[max(-low, 0) : len(padded) - max(-high, 0)], 0, axis)
    return x


MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *x, dimension: np.concatenate(x, axis=dimension),
    "copy": lambda x, **_: x,
    "copy_p": lambda x, **_: x,
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, dimensions),
    "pad": _pad,
    "reshape": lambda x, *_, new_sizes, **__: x.reshape(new_sizes),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "slice": _slice,
    "split": _split,
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "stack": lambda *x, axis: np.stack(x, axis=axis),
    "tile": lambda x, *, reps: np.tile(x, reps),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "unstack": lambda x, *, axis: list(np.moveaxis(x, axis, 0)),
}

INDEXED_MOVES = {
    "dynamic_slice": (0,),
    "dynamic_update_slice": (0, 1),
    "gather": (0,),
    "scatter": (0, 2),
}
"""Which operands hold entries; the others hold indices."""


def on_numbers(equation: JaxprEqn, *operands: np.ndarray) -> list[np.ndarray]:
    """Lets JAX do one operation on known numbers, also inside another trace."""
    with jax.ensure_compile_time_eval():
        # A NumPy array would be read in the process's precision; a JAX array keeps its own.
        arrays = [jax.numpy.asarray(x, x.dtype) for x in operands]
        results = equation.primitive.bind(*arrays, **equation.params)
        results = results if equation.primitive.multiple_results else [results]
        return [np.asarray(x) for x in results]


def move_by_index(equation: JaxprEqn, operands: list[np.ndarray]) -> np.ndarray:
    """Moves entries to places that the numbers among the operands say.

    Raises:
        InputError: If an index is not a known number, or lies outside of the array.
    """
    name = equation.primitive.name
    carriers = INDEXED_MOVES[name]
    entries, labels, start = [], list(operands), 0
    for k in carriers:
        entries.append(operands[k].astype(object).ravel())
        positions = np.arange(start, start + operands[k].size, dtype=np.float64)
        labels[k] = positions.reshape(operands[k].shape)
        start += operands[k].size
    if any(is_symbolic(x) for x in labels):
        raise InputError(
            f"`trace` cannot translate `{name}` with an index that depends on the inputs: "
            "index with constant integers."
        )
    (moved,) = on_numbers(equation, *labels)
    if not ((moved >= 0) & (moved < start)).all():
        raise InputError(f"`trace` met an index outside of its array in `{name}`: correct it.")
    return np.concatenate(entries)[moved.astype(int)]


def scatter_add(equation: JaxprEqn, operands: list[np.ndarray]) -> np.ndarray:
    """Adds entries at known places, which is what the transpose of a gather does."""
    target, indices, updates = operands
    if is_symbolic(indices):
        raise InputError(
            "`trace` cannot add at an index that depends on the inputs: "
            "index with constant integers."
        )
    total = target.astype(object).copy()
    for k, update in enumerate(updates.astype(object).ravel()):
        one = np.zeros(updates.size)
        one[k] = 1
        zeros = np.zeros(target.shape)
        (places,) = on_numbers(equation, zeros, indices, one.reshape(updates.shape))
        for place in np.argwhere(places):
            total[tuple(place)] = total[tuple(place)] + update
    return total
