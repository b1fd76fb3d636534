"""The exported C code, compiled on this machine and called from Python: to check and to time it."""

import ctypes
import os
import shutil
import subprocess
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.export.c_code import export_c
from jaxid.identification.fit import Fit

STRICT = ("-std=c99", "-Wall", "-Wextra", "-pedantic")


class CompiledModel:
    """The C functions of an exported model, on rows of samples.

    Args:
        source: The C file that `export_c` has written; its header lies beside it.
        joints: Number of joints.
        size: Number of base parameters.
        double: Whether the file computes in `double`.
        flags: Of the compiler.

    Raises:
        RuntimeError: If there is no C compiler, or it refuses the file.
    """

    def __init__(
        self,
        source: str | Path,
        joints: int,
        size: int,
        *,
        double: bool = True,
        flags: Sequence[str] = ("-O2",),
    ):
        self.joints, self.size, self.name = joints, size, Path(source).stem
        self._dtype = np.float64 if double else np.float32
        folder = Path(tempfile.mkdtemp(prefix="jaxid-"))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        target = folder / f"{self.name}.so"
        self.messages = _compile(Path(source), target, flags)
        self._library = ctypes.CDLL(str(target))

    @classmethod
    def of(
        cls, fit: Fit, *, double: bool = True, flags: Sequence[str] = ("-O2",)
    ) -> "CompiledModel":
        """Exports a model into a temporary folder and compiles it.

        Args:
            fit: The model.
            double: Whether it computes in `double`; in `float` otherwise.
            flags: Of the compiler.

        Raises:
            RuntimeError: If there is no C compiler.
        """
        with tempfile.TemporaryDirectory(prefix="jaxid-") as folder:
            source = export_c(fit, folder, double=double)
            joints, size = fit.base.model.robot.joints, fit.base.size
            return cls(source, joints, size, double=double, flags=flags)

    def torque(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Feed-forward [N m or N] by the recursion on base parameters (Eq. 39)."""
        return self._on_samples("torque", (self.joints,), *_arrays(motion))

    def torque_of_parameters(
        self, motion: Motion, p: Float[AnyArray, " base"]
    ) -> Float[np.ndarray, "samples joints"]:
        r"""Feed-forward [N m or N] as $\Theta_B p$ (Eq. 39)."""
        given = np.broadcast_to(np.asarray(p), (len(motion.q), self.size))
        return self._on_samples("torque_of_parameters", (self.joints,), *_arrays(motion), given)

    def torque_of_masses(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        r"""Feed-forward [N m or N] as $M \ddot q + h$ (Eq. 38)."""
        return self._on_samples("torque_of_masses", (self.joints,), *_arrays(motion))

    def mass_matrix(
        self, q: Float[AnyArray, "samples joints"]
    ) -> Float[np.ndarray, "samples joints joints"]:
        """The mass matrix (Eq. 38)."""
        return self._on_samples("mass_matrix", (self.joints, self.joints), q)

    def bias(
        self, q: Float[AnyArray, "samples joints"], qd: Float[AnyArray, "samples joints"]
    ) -> Float[np.ndarray, "samples joints"]:
        """Forces without accelerations [N m or N] (Eq. 38)."""
        return self._on_samples("bias", (self.joints,), q, qd)

    def gravity(self, q: Float[AnyArray, "samples joints"]) -> Float[np.ndarray, "samples joints"]:
        """Forces at rest [N m or N]."""
        return self._on_samples("gravity", (self.joints,), q)

    def friction(
        self, q: Float[AnyArray, "samples joints"], qd: Float[AnyArray, "samples joints"]
    ) -> Float[np.ndarray, "samples joints"]:
        """What friction adds by moving [N m or N]."""
        return self._on_samples("friction", (self.joints,), q, qd)

    def regressor(self, motion: Motion) -> Float[np.ndarray, "samples joints base"]:
        """The base regressor (Eq. 23)."""
        return self._on_samples("regressor", (self.joints, self.size), *_arrays(motion))

    def _on_samples(self, form: str, shape: tuple[int, ...], *given: AnyArray) -> np.ndarray:
        rows = [np.ascontiguousarray(x, self._dtype) for x in given]
        found = np.empty((len(rows[0]), *shape), self._dtype)
        function = getattr(self._library, f"{self.name}_{form}")
        function.restype = None
        arrays = [*rows, found]
        steps = [x.strides[0] for x in arrays]
        places = [x.ctypes.data for x in arrays]
        for k in range(len(found)):
            function(*(ctypes.c_void_p(p + k * s) for p, s in zip(places, steps, strict=True)))
        return found.astype(np.float64)


def _arrays(motion: Motion) -> list[np.ndarray]:
    return [np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)]


def _compile(source: Path, target: Path, flags: Sequence[str]) -> str:
    compiler = os.environ.get("CC", "cc")
    if shutil.which(compiler) is None:
        raise RuntimeError(
            f"no C compiler `{compiler}` is on this machine: install one (gcc or clang), or name "
            "it in the environment variable CC."
        )
    command = [compiler, *STRICT, *flags, "-shared", "-fPIC", str(source), "-o", str(target), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        first = next((x for x in done.stderr.splitlines() if "error" in x), "no message")
        raise RuntimeError(f"the C compiler `{compiler}` refuses `{source.name}`: {first:.200}.")
    return done.stderr
