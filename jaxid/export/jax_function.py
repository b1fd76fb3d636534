"""The feed-forward as a function that JAX has exported: it runs where jaxid is not installed."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from jaxid.arrays import Array, Float, double_precision
from jaxid.export.feed_forward import torque_program
from jaxid.identification.fit import Fit
from jaxid.io import write_bytes
from jaxid.program import lower

PLATFORMS = ("cpu", "cuda")


def exported_function(fit: Fit) -> export.Exported:
    """The torques of any number of samples as an exported function of JAX (Eq. 39).

    `exported.call(q, qd, qdd)` takes arrays [samples, joints] of float64 and returns forces of the
    same shape; `exported.serialize()` gives bytes that `jax.export.deserialize` reads elsewhere.

    Args:
        fit: The model.
    """
    lowered = lower(torque_program(fit))
    joints = fit.base.model.robot.joints

    def torques(
        q: Float[Array, "samples joints"],
        qd: Float[Array, "samples joints"],
        qdd: Float[Array, "samples joints"],
    ) -> Float[Array, "samples joints"]:
        # One sample at a time: the number of samples is not known here.
        return jax.vmap(lambda *sample: jnp.asarray(lowered.dense(*sample)))(q, qd, qdd)

    with double_precision():
        (samples,) = export.symbolic_shape("samples")
        shape = jax.ShapeDtypeStruct((samples, joints), np.float64)
        return export.export(jax.jit(torques), platforms=PLATFORMS)(shape, shape, shape)


def export_jax(fit: Fit, path: str | Path) -> Path:
    """Writes the feed-forward as a function of JAX that needs no jaxid (Eq. 39).

    Read it with `jax.export.deserialize(bytearray(Path(path).read_bytes()))` in 64-bit mode.

    Args:
        fit: The model.
        path: Of the file; one that is there already is replaced.

    Raises:
        RuntimeError: If JAX cannot write its functions down here.
    """
    if importlib.util.find_spec("flatbuffers") is None:
        raise RuntimeError(
            "JAX writes exported functions with the package `flatbuffers`, which is not installed: "
            "`pip install flatbuffers`."
        )
    path, content = Path(path), exported_function(fit).serialize()
    write_bytes(path, content)
    return path
