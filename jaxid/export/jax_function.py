"""The feed-forward as a function of JAX that runs without jaxid."""

import functools
import importlib.util
from pathlib import Path

import jax
import numpy as np
from jax import export

from jaxid.arrays import double_precision
from jaxid.identification.fit_result import Fit
from jaxid.io import FilePath, write_bytes
from jaxid.program import Lowered, on_any_platform

from .feed_forward import torque_program


def exported_function(fit: Fit) -> export.Exported:
    """Return the forces of samples as an exported function of JAX (Eq. 39).

    `exported.call(q, qd, qdd)` takes arrays [samples, joints] of float64 and returns
    forces of the same shape (with friction that has memory also its states, as
    `Presliding.states` gives them); `exported.serialize()` gives bytes that
    `jax.export.deserialize` reads elsewhere.

    Args:
        fit: Identified model.
    """
    program = torque_program(fit)
    # One sample at a time, since the number of samples is not known here.
    sample_function = functools.partial(on_any_platform, program, Lowered.dense)
    vectorised_function = jax.jit(jax.vmap(sample_function))
    with double_precision():
        (samples,) = export.symbolic_shape("samples")
        shapes = [
            jax.ShapeDtypeStruct((samples, *shape), np.float64)
            for shape in program.input_shapes
        ]
        return export.export(vectorised_function, platforms=("cpu", "cuda"))(*shapes)


def export_jax(fit: Fit, path: FilePath) -> Path:
    """Write the feed-forward as a function of JAX that runs without jaxid (Eq. 39).

    Read it with `jax.export.deserialize(bytearray(Path(path).read_bytes()))` in 64-bit
    mode.

    Args:
        fit: Identified model.
        path: Path of the file; an existing file is replaced.

    Raises:
        RuntimeError: If the package `flatbuffers` is not installed.
    """
    if importlib.util.find_spec("flatbuffers") is None:
        raise RuntimeError(
            "JAX needs `flatbuffers` to export: `pip install flatbuffers`."
        )
    write_bytes(path, bytes(exported_function(fit).serialize()))
    return Path(path)
