"""Arrays of NumPy and of JAX side by side: constants, inputs, and what JAX is tracing."""

from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from jaxid.types import AnyArray, Numbers


def as_array(name: str, value: Numbers) -> AnyArray:
    """An array as it is, and everything else as a NumPy array of float64.

    Raises:
        ValueError: If it does not consist of numbers, or its rows are not equally long.
    """
    if isinstance(value, AnyArray):
        return value
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be an array of numbers, but is {value!r:.60}.") from error


def one_or_each(value: Any) -> Any:
    """A converter of fields that hold one number for all joints, or a list of one for each."""
    return as_array("value", value) if isinstance(value, list | tuple) else value


def matching(name: str, value: AnyArray | float, qd: AnyArray) -> AnyArray | float:
    """A number for all joints, or one for each of those that move with `qd`.

    Raises:
        ValueError: If there are more or fewer than joints.
    """
    shape = np.shape(value)
    if shape and shape != qd.shape[-1:]:
        raise ValueError(
            f"`{name}` must be one number for all joints or one for each ({qd.shape[-1]}), but "
            f"has shape {shape}."
        )
    return value


def is_traced(*trees: Any) -> bool:
    """Whether JAX is tracing some number of these, so that nothing can be asked of its value."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def namespace(*arrays: AnyArray) -> ModuleType:
    """`jax.numpy` if one of the arrays is JAX's; else NumPy, whose results stay constants."""
    return jnp if any(isinstance(x, jax.Array) for x in arrays) else np


def content(tree: Any) -> tuple:
    """What a tree of known numbers is, by value: structure, shapes, types and bytes."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(x) for x in leaves]
    return structure, tuple((x.shape, x.dtype.str, x.tobytes()) for x in arrays)


class Hashable(eqx.Module):
    """A module with NumPy arrays in it whose methods `jax.jit` takes as they are.

    JAX looks functions up by their hash, also a bound method such as `model.regressor`, and arrays
    have none. Here the hash is of the numbers.
    """

    def __hash__(self) -> int:
        leaves, structure = jax.tree.flatten(self)
        if is_traced(leaves):
            return hash((structure, tuple(id(x) for x in leaves)))
        return hash(content(self))
