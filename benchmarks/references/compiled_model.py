"""The exported C code, compiled on this machine and called from Python."""

import ctypes
import os
import subprocess
import tempfile
import weakref
from pathlib import Path

import numpy as np

import jaxid as jid

STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic")


class CompiledModel:
    """The C functions of an exported model, on rows of samples.

    `compiled.torque(q, qd, qdd)` calls the function of that name for each row.

    Args:
        fit: Identified model.
        double: Whether the code computes in `double` (otherwise `float`).
        flags: Flags of the compiler, which the environment variable `CC` names.
    """

    def __init__(self, fit, *, double=True, flags=("-O2",)):
        n, size = fit.base.model.robot.joints, fit.base.size
        self.shapes = {"mass_matrix": (n, n), "regressor": (n, size)}
        self.joints, self.dtype = (n,), np.float64 if double else np.float32
        folder = tempfile.TemporaryDirectory(prefix="jaxid-")
        weakref.finalize(self, folder.cleanup)
        source = jid.export_c(fit, folder.name, double=double)
        target = Path(folder.name) / "arm.so"
        words = [
            os.environ.get("CC", "cc"),
            *STRICT,
            *flags,
            "-shared",
            "-fPIC",
            source,
            "-lm",
        ]
        done = subprocess.run(
            [*words, "-o", target], capture_output=True, text=True, check=True
        )
        self.messages = done.stderr
        self.library = ctypes.CDLL(str(target))

    def __getattr__(self, name):
        function = getattr(self.library, f"arm_{name}")
        function.restype = None

        def on_rows(*inputs):
            rows = [np.ascontiguousarray(x, self.dtype) for x in inputs]
            result = np.empty(
                (len(rows[0]), *self.shapes.get(name, self.joints)), self.dtype
            )
            for sample in zip(*rows, result, strict=True):
                function(*(ctypes.c_void_p(x.ctypes.data) for x in sample))
            return result.astype(np.float64)

        return on_rows
