"""Shape vocabulary of annotations, and arrays of NumPy and JAX side by side.

Axes: `joints` (those with a coordinate), `bodies`, `standard` (columns of the full
regressor), `base` (columns of the base regressor), `samples` (rows of a log), `rows`
(rows left after filtering), `batch`.
"""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import (
    Array as Array,
    Bool as Bool,
    Float as Float,
    Int as Int,
    PRNGKeyArray as PRNGKeyArray,
)

from jaxid.errors import InputError

AnyArray = jax.Array | np.ndarray
"""A JAX array, or a NumPy array: NumPy's values stay constants when JAX traces."""

Vector = Float[np.ndarray, " _"]
"""NumPy array of one axis."""

Matrix = Float[np.ndarray, "_ _"]
"""NumPy array of two axes."""

Matrices = list[np.ndarray]
"""One matrix for each joint, with columns of its own."""

BaseVector = Float[np.ndarray, " base"]
"""One number for each base parameter."""

BaseMatrix = Float[np.ndarray, "base base"]
"""One number for each pair of base parameters, like a covariance."""

Indices = tuple[int, ...]
"""Places in a list, like those of some base parameters."""

Texts = tuple[str, ...]
"""Names or sentences."""

Joints = Float[AnyArray, " joints"]
"""One number for each joint."""

JointSamples = Float[AnyArray, "samples joints"]
"""One number for each sample and joint."""

ManyJoints = Float[AnyArray, "*batch joints"]
"""One number for each joint, at any number of samples."""

JointMatrix = Float[AnyArray, "joints joints"]
"""A mass matrix, or another matrix with a row and a column for each joint."""

Bodies = Float[AnyArray, "bodies 10"]
"""Ten inertial parameters of each body."""

Vector3 = Float[AnyArray, "3"]
"""A point or a direction in space."""

Matrix3 = Float[AnyArray, "3 3"]
"""A rotation, or an inertia tensor."""

# NumPy's own `ArrayLike` turns tuples away when types are checked at run time.
Numbers = AnyArray | Sequence[Any] | float | int
"""Array argument of a user: an array, nested lists or tuples, or one number."""


def require_float64(what: str) -> None:
    """Raise an error if JAX runs in float32, which the task `what` cannot use."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise RuntimeError(
            f"{what} needs float64, but JAX runs in float32: call "
            '`jax.config.update("jax_enable_x64", True)` at the start of the program, '
            "or set the environment variable JAX_ENABLE_X64=1."
        )


def double_precision() -> AbstractContextManager:
    """Return a context in which JAX computes in float64, whatever its setting is."""
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(True)
    from jax.experimental import enable_x64  # pyright: ignore[reportAttributeAccessIssue]

    return enable_x64(True)


def as_array(name: str, value: Numbers) -> AnyArray:
    """Return an array as it is, and other numbers as an array of NumPy's float64."""
    if isinstance(value, AnyArray):
        return value
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"`{name}` must be an array of numbers, but is {value!r:.60}."
        ) from error


def as_finite_array(name: str, value: Numbers, shape: tuple[int, ...]) -> AnyArray:
    """Return an array of finite numbers; that of JAX may have leading axes."""
    array = as_array(name, value)
    if not isinstance(array, jax.Array):
        array = np.array(array, np.float64)
    trailing_shape = array.shape[array.ndim - len(shape) :]
    if trailing_shape != shape:
        raise InputError(f"{name} must have the shape {shape}, but has {array.shape}.")
    if isinstance(array, np.ndarray) and not np.isfinite(array).all():
        raise InputError(f"{name} must hold finite numbers.")
    return array


def given(value: Any) -> Any:
    """Return an argument as it is.

    Converter of a field that is checked together with others.
    """
    return value


def optional(value: float | int | None) -> float | None:
    """Convert a number, unless it is None."""
    return None if value is None else float(value)


def one_or_each(value: Any) -> Any:
    """Convert a field that holds one number for all joints, or one for each."""
    return as_array("value", value) if isinstance(value, list | tuple) else value


def matching(name: str, value: AnyArray | float, qd: AnyArray) -> AnyArray | float:
    """Check one number for all joints, or one for each of those that move with `qd`."""
    shape = np.shape(value)
    if shape and shape != qd.shape[-1:]:
        raise InputError(
            f"`{name}` must be one number, or one for each of {qd.shape[-1]} joints, "
            f"but has shape {shape}."
        )
    return value


def is_traced(*trees: Any) -> bool:
    """Return whether JAX traces a leaf of these trees, so that its value is unknown."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def namespace(*arrays: AnyArray) -> ModuleType:
    """Return `jax.numpy` if an array is JAX's, otherwise NumPy.

    NumPy's results stay constants when JAX traces.
    """
    return jnp if any(isinstance(x, jax.Array) for x in arrays) else np


def relative_norm(errors: Iterable[AnyArray], forces: Iterable[AnyArray]) -> float:
    """Return the norm of errors over that of forces; entries of NaN do not count.

    NaN without any force.
    """
    squares = sum(np.nansum(np.asarray(x) ** 2) for x in errors)
    force_squares = sum(np.nansum(np.asarray(x) ** 2) for x in forces)
    return float(np.sqrt(squares / (force_squares or np.nan)))


def on_cores(
    function: Callable[[Any], Any],
    items: Iterable,
    cores: int | None = None,
    ahead: int | None = None,
) -> Iterator[Any]:
    """Yield a function's results for some items in their order, computed on all cores.

    The calling thread makes the items, and at most `ahead` of them before it takes a
    result: by default one for each core.
    """
    cores = cores or os.cpu_count() or 1
    ahead = ahead or cores
    pending_results: deque[Future] = deque()
    with ThreadPoolExecutor(cores) as pool:
        for item in items:
            if len(pending_results) >= ahead:
                yield pending_results.popleft().result()
            pending_results.append(pool.submit(function, item))
        while pending_results:
            yield pending_results.popleft().result()


def in_parts(solve: Callable[[Any], Any], data: Any, size: int = 16) -> Any:
    """Return the results of a compiled function, called for `size` entries at a time.

    XLA leaves small operations to one core, so each core gets entries of its own. Parts
    of equal size also mean that another number of entries compiles nothing anew. An
    accelerator takes all entries at once; what lies there already is not moved.
    """
    if jax.default_backend() != "cpu":
        return solve(jax.device_put(data))
    data = jax.tree.map(np.asarray, data)
    count = len(jax.tree.leaves(data)[0])
    size = min(count, size)

    def part(start: int) -> Any:
        indices = np.arange(start, start + size) % count
        entries = jax.tree.map(lambda x: x[indices], data)
        return jax.block_until_ready(solve(entries))

    results = on_cores(part, range(0, count, size))
    return jax.tree.map(lambda *x: jnp.concatenate(x)[:count], *results)


def content(tree: Any) -> tuple:
    """Return a hashable key of a concrete PyTree: structure, shapes, types, bytes."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [np.asarray(x) for x in leaves]
    return structure, tuple((x.shape, x.dtype.str, x.tobytes()) for x in arrays)


class Hashable(eqx.Module):
    """Module with NumPy arrays whose methods `jax.jit` takes as they are.

    JAX looks a bound method such as `model.regressor` up by the hash of the module, and
    arrays have none. Here the hash is of the numbers.
    """

    def __hash__(self) -> int:
        leaves, structure = jax.tree.flatten(self)
        if is_traced(leaves):
            return hash((structure, tuple(id(x) for x in leaves)))
        return hash(content(self))
