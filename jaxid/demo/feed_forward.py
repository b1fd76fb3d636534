"""Cost of a feed-forward torque in C, by base parameters and by the full model (Sec. 7)."""

import ctypes
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

import jaxid as jid

_LOOPS = """#include "arm.c"
#define LOOP(form) \\
void loop_##form(long calls, long states, const double *q, const double *qd, const double *qdd, \\
                 double *tau) \\
{ \\
    long k; \\
    for (k = 0; k < calls; ++k) { \\
        const long row = k % states * ARM_JOINTS; \\
        arm_##form(q + row, qd + row, qdd + row, MORE_##form tau + row); \\
    } \\
}
#define MORE_torque
#define MORE_torque_of_masses
#define MORE_torque_of_parameters arm_parameters,
LOOP(torque)
LOOP(torque_of_parameters)
LOOP(torque_of_masses)
"""


class Timing(NamedTuple):
    """Cost of one evaluation [s].

    Attributes:
        where: Compiler and its options.
        literal: Cost of the base regressor times the base parameters, as printed (Eq. 39).
        factored: Cost of the same as a recursion on base parameters.
        full: Cost of mass matrix and bias forces (Eq. 38).
    """

    where: str
    literal: float
    factored: float
    full: float

    @property
    def ratio(self) -> float:
        """Ratio of Eq. 39 as printed to Eq. 38."""
        return self.literal / self.full


def time_feed_forward(
    fit: jid.Fit, trajectory: jid.trajectories.AbstractTrajectory
) -> Timing | str:
    """Return the cost of all forms on states of a motion; a sentence where it cannot be measured.

    Args:
        fit: Model with a complete set of standard parameters.
        trajectory: Trajectory whose torques are computed.
    """
    compiler = os.environ.get("CC", "cc")
    motion = trajectory.motion(np.linspace(0.0, float(trajectory.duration), 256))
    states = [np.ascontiguousarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
    forms = ("torque_of_parameters", "torque", "torque_of_masses")
    with tempfile.TemporaryDirectory(prefix="jaxid-") as folder:
        jid.export_c(fit, folder, name="arm")
        (Path(folder) / "loops.c").write_text(_LOOPS, encoding="ascii")
        words = [compiler, "-O2", "-shared", "-fPIC", "loops.c", "-o", "loops.so", "-lm"]
        try:
            subprocess.run(words, cwd=folder, check=True, capture_output=True)
        except (OSError, subprocess.CalledProcessError) as failure:
            return f"feed-forward torques were not timed: {failure}"
        library = ctypes.CDLL(str(Path(folder) / "loops.so"))
    # All forms in turn, so that other work on the machine disturbs them alike.
    turns = [[_cost(library, form, states) for form in forms] for _ in range(21)]
    medians = (statistics.median(column) for column in zip(*turns, strict=True))
    return Timing(f"C, {compiler} -O2", *medians)


def _cost(library: ctypes.CDLL, form: str, states: list[np.ndarray], calls: int = 4096) -> float:
    """Return the time of one call [s]."""
    loop = getattr(library, f"loop_{form}")
    loop.restype = None
    arrays = (*states, np.empty_like(states[0]))
    places = [ctypes.c_void_p(x.ctypes.data) for x in arrays]
    begin = time.perf_counter()
    loop(ctypes.c_long(calls), ctypes.c_long(len(states[0])), *places)
    return (time.perf_counter() - begin) / calls
