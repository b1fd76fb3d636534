"""What a feed-forward torque costs in C, by base parameters and by the full model (Sec. 7)."""

import ctypes
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.export.c_code import export_c
from jaxid.identification.fit import Fit
from jaxid.trajectory.trajectory import AbstractTrajectory

STATES, CALLS, TURNS = 256, 4096, 21
"""States in turn, calls for each timing, and timings, of which the median counts."""
FLAGS = ("-O2",)
NAME = "arm"
_LOOPS = f"""#include "{NAME}.c"
#define LOOP(form) \\
void loop_##form(long calls, long states, const double *q, const double *qd, const double *qdd, \\
                 double *tau) \\
{{ \\
    long k; \\
    for (k = 0; k < calls; ++k) {{ \\
        const long row = k % states * {NAME.upper()}_JOINTS; \\
        CALL(form)(q + row, qd + row, qdd + row, MORE(form) tau + row); \\
    }} \\
}}
#define CALL(form) {NAME}_##form
#define MORE(form) MORE_##form
#define MORE_torque
#define MORE_torque_of_masses
#define MORE_torque_of_parameters {NAME}_parameters,
LOOP(torque)
LOOP(torque_of_parameters)
LOOP(torque_of_masses)
"""


class Timing(NamedTuple):
    """Cost of one evaluation [s], and where.

    Attributes:
        where: What computes.
        literal: The base regressor times the base parameters, as printed (Eq. 39).
        factored: The same as a recursion on base parameters.
        full: Mass matrix and bias forces (Eq. 38).
    """

    where: str
    literal: float
    factored: float
    full: float

    @property
    def ratio(self) -> float:
        """Of Eq. 39 as printed to Eq. 38."""
        return self.literal / self.full


def _compile(fit: Fit, folder: Path) -> ctypes.CDLL:
    """Compile the exported model with loops around its functions.

    Raises:
        OSError: If there is no C compiler.
        subprocess.CalledProcessError: If the compiler fails.
    """
    export_c(fit, folder, name=NAME)
    source, target = folder / "loops.c", folder / "loops.so"
    source.write_text(_LOOPS, encoding="ascii")
    command = [os.environ.get("CC", "cc"), "-std=c99", *FLAGS, "-shared", "-fPIC", str(source)]
    subprocess.run([*command, "-o", str(target), "-lm"], check=True, capture_output=True)
    return ctypes.CDLL(str(target))


def _cost(library: ctypes.CDLL, form: str, states: tuple[np.ndarray, ...]) -> float:
    """Return the time of one call [s]; a call from Python would cost more than the function."""
    loop = getattr(library, f"loop_{form}")
    loop.restype = None
    arrays = (*states, np.empty_like(states[0]))
    places = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    begin = time.perf_counter()
    loop(ctypes.c_long(CALLS), ctypes.c_long(len(states[0])), *places)
    return (time.perf_counter() - begin) / CALLS


def timing(fit: Fit, trajectory: AbstractTrajectory) -> Timing | str:
    """Times all forms in turn on states of a motion; a sentence where that cannot be done.

    Args:
        fit: With a complete set of standard parameters.
        trajectory: Whose torques are computed.
    """
    motion = trajectory.motion(np.linspace(0.0, float(trajectory.duration), STATES))
    states = tuple(np.ascontiguousarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd))
    forms = ("torque_of_parameters", "torque", "torque_of_masses")
    with tempfile.TemporaryDirectory(prefix="jaxid-") as folder:
        try:
            library = _compile(fit, Path(folder))
        except (OSError, subprocess.CalledProcessError) as failure:
            return f"feed-forward torques were not timed: {failure}"
        turns = [[_cost(library, form, states) for form in forms] for _ in range(TURNS)]
    where = f"C, {os.environ.get('CC', 'cc')} {' '.join(FLAGS)}"
    return Timing(where, *(statistics.median(column) for column in zip(*turns, strict=True)))
