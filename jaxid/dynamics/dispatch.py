"""Dispatch of methods for one sample: NumPy for few samples, fused XLA for many, or plain JAX.

A method of a model for one sample is traced once into a scalar program, if the robot's geometry is
known; the programs of the models that were used last are kept. If JAX is tracing the geometry, the
method runs as it is written.
"""

import functools
import math
import threading
from collections import OrderedDict
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Joints, Numbers, as_array, content, is_traced
from jaxid.errors import InputError
from jaxid.program import Program, evaluate, lower, trace

FEW = 4096
"""Number of samples up to which NumPy is faster than compiling and running XLA."""
KEPT = 64
"""Number of programs that are kept, of the models that were used last."""


_programs: OrderedDict[tuple, Program] = OrderedDict()
_lock = threading.Lock()


def program_of(owner: eqx.Module, definition: Callable, *shapes: tuple[int, ...]) -> Program:
    """Return the scalar program of a method of a model; it is traced when first needed.

    An owner may have a method `derived_program(name, *shapes)`, which returns the program of its
    method of that name if it follows from the program of another model, or None.

    Args:
        owner: Model, whose numbers become constants of the program.
        definition: Method of the model for one sample.
        shapes: Shapes of the method's arguments.
    """
    key = (definition.__name__, shapes, *content(owner))
    program = _programs.get(key)
    if program is None:
        derive = getattr(owner, "derived_program", None)
        program = None if derive is None else derive(definition.__name__, *shapes)
        program = trace(definition, *shapes) if program is None else program
    with _lock:
        _programs[key] = program
        _programs.move_to_end(key)
        while len(_programs) > KEPT:
            _programs.popitem(last=False)
    return program


@functools.lru_cache(maxsize=KEPT)
def _compiled(program: Program) -> Callable:
    lowered = lower(program)
    return jax.jit(lambda *arrays: lowered.dense(*arrays))


def on_samples(
    owner: eqx.Module,
    definition: Callable,
    *samples: AnyArray,
    shared: tuple[Numbers, ...] = (),
) -> Array:
    """Apply a method for one sample to arrays with any leading batch axes.

    Args:
        owner: Model.
        definition: Method, whose arguments are first the shared ones, then those of one sample.
        samples: Arguments with batch axes before their last axis.
        shared: Parameters that all samples have in common.

    Raises:
        InputError: If the arguments do not have the same shape, or parameters are no numbers.
    """
    shared = tuple(as_array("p", x) for x in shared)
    if any(x.shape != samples[0].shape for x in samples):
        shapes = ", ".join(str(x.shape) for x in samples)
        raise InputError(
            f"coordinates, velocities and accelerations must have one shape, but have {shapes}."
        )
    batch = samples[0].shape[:-1]
    count = math.prod(batch)
    flat = [x.reshape((count, x.shape[-1])) for x in samples]
    if is_traced(owner):
        out = jax.vmap(lambda *x: definition(*shared, *x))(*map(jnp.asarray, flat))
        return jnp.reshape(out, (*batch, *out.shape[1:]))
    shapes = (*(x.shape for x in shared), *(x.shape[1:] for x in flat))
    program = program_of(owner, definition, *shapes)
    arguments = (*shared, *(x.T for x in flat))
    if count <= FEW and not is_traced(arguments):
        precision = jnp.result_type(*(x.dtype for x in arguments), float)
        out = jnp.asarray(evaluate(program, *arguments), precision)
    else:
        out = _compiled(program)(*arguments)
    out = jnp.moveaxis(jnp.broadcast_to(out, (*out.shape[:-1], count)), -1, 0)
    return jnp.reshape(out, (*batch, *out.shape[1:]))


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

    Only the lower triangle is read. A program has no loops, and a robot has few joints.

    Args:
        A: Symmetric, positive definite matrix.
        b: Right-hand side.
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
