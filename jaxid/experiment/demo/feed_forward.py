"""What a feed-forward torque costs in C, by base parameters and by the full model (Sec. 7)."""

import ctypes
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.export.c_code import export_c
from jaxid.export.compiled_model import CompiledModel
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


class _Loops(CompiledModel):
    """The exported model with loops around its functions: a call from Python costs more than one.

    Args:
        fit: The model.
    """

    def __init__(self, fit: Fit):
        with tempfile.TemporaryDirectory(prefix="jaxid-") as folder:
            export_c(fit, folder, name=NAME)
            source = Path(folder) / "loops.c"
            source.write_text(_LOOPS, encoding="ascii")
            super().__init__(source, fit.base.model.robot.joints, fit.base.size, flags=FLAGS)

    def cost(self, form: str, states: tuple[np.ndarray, ...]) -> float:
        """Time of one call [s], less what reaching the library takes."""
        loop = getattr(self._library, f"loop_{form}")
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
    try:
        loops = _Loops(fit)
    except RuntimeError as failure:
        return f"feed-forward torques were not timed: {failure}"
    motion = trajectory.motion(np.linspace(0.0, float(trajectory.duration), STATES))
    states = tuple(np.ascontiguousarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd))
    forms = ("torque_of_parameters", "torque", "torque_of_masses")
    turns = [[loops.cost(form, states) for form in forms] for _ in range(TURNS)]
    where = f"C, {os.environ.get('CC', 'cc')} {' '.join(FLAGS)}"
    return Timing(where, *(statistics.median(column) for column in zip(*turns, strict=True)))
