"""The feed-forward as one C99 file and its header."""

import inspect
import json
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.identification.fit_result import Fit
from jaxid.io import atomic_folder
from jaxid.program import Program, evaluate, trace
from jaxid.program.c_writer import CWriter

from .torque_program import other_forces, torques


class CFunction(NamedTuple):
    """One function of the C file; its name is without that of the model."""

    name: str
    summary: str
    program: Program
    inputs: tuple[str, ...]
    output: str

    @property
    def size(self) -> int:
        """Number of entries of the output."""
        return math.prod(self.program.output_shapes[0])


def export_c(fit: Fit, folder: str | Path, *, name: str = "arm", double: bool = True) -> Path:
    """Write the model as one C99 file and its header, for a real-time controller (Eqs. 38, 39).

    The file needs no library, allocates nothing and does not branch on data, so that every call
    takes the same time. It compiles as C++ too. A known tool is not included, as in `Fit.predict`.

    Args:
        fit: Identified model.
        folder: Folder of the files.
        name: Name of the files and prefix of the functions.
        double: Whether the code computes in `double` (otherwise `float`).

    Returns:
        Path of the C file; the header is beside it.

    Raises:
        InputError: If `name` is not an identifier of C.
    """
    CWriter(double).declaration(name, (), ())
    functions = c_functions(fit)
    writer = CWriter(double, name, [x.program for x in functions])
    with atomic_folder(folder) as staging:
        for suffix, write in ((".c", _source), (".h", _header)):
            text = write(fit, writer, functions)
            (staging / f"{name}{suffix}").write_text(text, encoding="ascii")
    return Path(folder) / f"{name}.c"


def c_functions(fit: Fit) -> tuple[CFunction, ...]:
    """Return all functions of a model, with its estimates as constants."""
    model, base = fit.base.model, fit.base
    one, rest = (model.robot.joints,), np.zeros(model.robot.joints)
    torque, others, law = torques(fit), other_forces(fit), model.memory
    relaxed = None if law is None else np.zeros(model.input_shapes[-1])
    # Only the base parameters: composite bodies have fewer operations then.
    own = np.asarray(base.to_standard(np.asarray(fit.parameters, np.float64)))

    functions = {
        "torque": ("Feed-forward torques on base parameters (Eq. 39, factored)", torque),
        "torque_of_parameters": (
            "The same for given base parameters p, as Theta_B p (Eq. 39)",
            lambda q, qd, qdd, p, s=None: base.columns(q, qd, qdd, s) @ p,
        ),
        "torque_of_masses": (
            "The same as M qdd + h, with M by composite bodies (Eq. 38)",
            lambda q, qd, qdd, s=None: model.inertia(own, q) @ qdd + model.bias(own, q, qd, s),
        ),
        "mass_matrix": (
            "Mass matrix M, rotors included, row by row (Eq. 38)",
            lambda q: model.inertia(own, q),
        ),
        "bias": (
            "Forces h without accelerations: Coriolis, gravity, friction (Eq. 38)",
            lambda q, qd, s=None: torque(q, qd, rest, s),
        ),
        "gravity": (
            "Forces at rest: gravity, springs, offsets",
            lambda q: torque(q, rest, rest, relaxed),
        ),
        "friction": (
            "Friction: the forces that motion adds to those at rest",
            lambda q, qd, s=None: others(q, qd, rest, s) - others(q, rest, rest, relaxed),
        ),
        "regressor": ("Base regressor Theta_B, row by row (Eq. 23)", base.columns),
    }
    if law is not None:
        functions["advance"] = "State of dry friction behind a step of the joints", law.advance
    outputs = {"mass_matrix": "m", "bias": "h", "regressor": "theta", "advance": "s_next"}
    written = []
    for name, (summary, function) in functions.items():
        inputs = (x for x in inspect.signature(function).parameters if x != "s" or law)
        inputs = tuple(inputs)
        shapes = {"p": (base.size,), "s": model.input_shapes[-1]}
        program = trace(function, *(shapes.get(x, one) for x in inputs))
        written.append(CFunction(name, summary, program, inputs, outputs.get(name, "tau")))
    return tuple(written)


def _header(fit: Fit, writer: CWriter, functions: tuple[CFunction, ...]) -> str:
    robot, name = fit.base.model.robot, writer.prefix
    joints = "\n".join(
        f"     {j}  {_ascii(robot.joint_names[j])}: {'turns' if turns else 'slides'}, "
        f"q in {robot.joint_unit(j)}, tau in {robot.force_unit(j)}"
        for j, turns in enumerate(robot.revolute)
    )
    gravity = ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))
    memory = ""
    if fit.base.model.memory is not None:
        memory = f"""
   s: state of dry friction, one number between -1 and 1 for each joint, then for each motor if some
   turn several axes, which the caller keeps.
   Begin with zeros, and call {name}_advance(q_before, q, s, s) at every sample, before the others.
"""
    terms = _ascii(", ".join(type(t).__name__ for t in fit.base.model.terms))
    prototypes = []
    for x in functions:
        shapes = zip(x.inputs, x.program.input_shapes, strict=True)
        inputs = ", ".join(f"{key}[{math.prod(shape)}]" for key, shape in shapes)
        prototypes.append(
            f"/* {x.summary}.\n   {x.program.counts.total} operations: {x.program.counts}.\n"
            f"   From {inputs} to {x.output}[{x.size}]. */\n"
            f"{writer.declaration(f'{name}_{x.name}', x.inputs, (x.output,))};"
        )
    listed = "\n\n".join(prototypes)
    return f"""/* Identified model of the robot "{_ascii(robot.name)}", for a controller.

   Model of {_ascii(fit.date) or "an unknown day"}, {fit.checksum}
   Recordings: {_ascii(", ".join(fit.recordings) or "unknown")}
   Terms: {terms}
   Gravity in the frame of the ground: {gravity} m/s^2

   Joints, in the order of all arrays:
{joints}

   q, qd, qdd: positions, velocities and accelerations [rad or m, per s, per s^2].
   tau: generalised forces on the side of the joints [N m or N], without a known tool.
{memory}
   Nothing is allocated, nothing remembered, and no branch on data: every call takes the same time,
   and functions can be called from any thread. All inputs are read before an output is written.
   Numbers that are not finite, and angles beyond {writer.turns:.0f} turns, give NaN.

   Check the file on its machine: cc -D{name.upper()}_SELF_TEST {name}.c -lm && ./a.out
   Generated code: do not edit. */
#ifndef {name.upper()}_H
#define {name.upper()}_H

#define {name.upper()}_JOINTS {robot.joints}
#define {name.upper()}_PARAMETERS {fit.base.size}
#define {name.upper()}_CHECKSUM "{fit.checksum}"
#define {name.upper()}_DATE {json.dumps(_ascii(fit.date))}

#ifdef __cplusplus
extern "C" {{
#endif

/* The estimates: see the list in {name}.c. */
extern const {writer.type} {name}_parameters[{fit.base.size}];

{listed}

#ifdef __cplusplus
}}
#endif

#endif
"""


def _source(fit: Fit, writer: CWriter, functions: tuple[CFunction, ...]) -> str:
    base, name = fit.base, writer.prefix
    labels = [f"{x} [{unit}]" for x, unit in zip(base.names, base.units, strict=True)]
    estimates = zip(np.asarray(fit.parameters).tolist(), labels, strict=True)
    parameters = "\n".join(
        f"    {writer.number(x)}{',' if k + 1 < base.size else ' '} /* {_ascii(label)} */"
        for k, (x, label) in enumerate(estimates)
    )
    definitions = "\n".join(
        writer.definition(x.program, f"{name}_{x.name}", x.inputs, (x.output,)) for x in functions
    )
    return f"""/* Identified model of the robot "{_ascii(base.model.robot.name)}": see {name}.h.
   Generated code: do not edit. */
#include "{name}.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

const {writer.type} {name}_parameters[{base.size}] = {{
{parameters}
}};

{writer.library()}
{definitions}
{_self_test(fit, writer, functions)}"""


def _self_test(fit: Fit, writer: CWriter, functions: tuple[CFunction, ...]) -> str:
    """Return a C program that compares all functions with their results in Python."""
    name, kind, n, samples = writer.prefix, writer.type, fit.base.model.robot.joints, 4
    random = np.random.default_rng(0)
    used = dict.fromkeys(x for f in functions for x in f.inputs if x != "p")
    states = {x: np.round(random.uniform(-2.0, 2.0, (samples, n)), 3) for x in used}
    given = {**states, "p": np.tile(np.asarray(fit.parameters, np.float64), (samples, 1))}
    tables, calls = [_table(f"{name}_{x}", writer, rows) for x, rows in states.items()], []
    for function in functions:
        arrays = [given[x] for x in function.inputs]
        if not writer.double:
            arrays = [x.astype(np.float32).astype(np.float64) for x in arrays]
        result = np.asarray(evaluate(function.program, *(x.T for x in arrays)))
        rows = np.broadcast_to(result.reshape(function.size, -1), (function.size, samples)).T
        tables.append(_table(f"{name}_{function.name}_expected", writer, rows))
        inputs = [f"{name}_parameters" if x == "p" else f"{name}_{x}[k]" for x in function.inputs]
        calls.append(
            f"        {name}_{function.name}({', '.join(inputs)}, result);\n"
            f'        wrong |= {name}_differs("{function.name}", result, '
            f"{name}_{function.name}_expected[k], {function.size});"
        )
    body, tolerance = "\n".join(calls), 1e-10 if writer.double else 2e-3
    return f"""#ifdef {name.upper()}_SELF_TEST
#include <stdio.h>

{"".join(tables)}
static int {name}_differs(const char *what, const {kind} *got, const {kind} *wanted, int size)
{{
    double largest = 0.0, error = 0.0;
    int i;
    for (i = 0; i < size; ++i) {{
        largest = fabs((double)wanted[i]) > largest ? fabs((double)wanted[i]) : largest;
        error = fabs((double)got[i] - (double)wanted[i]) <= error
            ? error : fabs((double)got[i] - (double)wanted[i]);
    }}
    printf("%-24s largest error %.1e of %.1e\\n", what, error, largest);
    return !(error <= {tolerance:g} * largest + {tolerance:g});
}}

int main(void)
{{
    {kind} result[{max(x.size for x in functions)}];
    int wrong = 0, k;
    for (k = 0; k < {samples}; ++k) {{
{body}
    }}
    puts(wrong ? "this build is WRONG" : "this build is right");
    return wrong;
}}
#endif
"""


def _table(name: str, writer: CWriter, rows: Float[np.ndarray, "states entries"]) -> str:
    listed = ",\n".join("    {" + ", ".join(map(writer.number, row)) + "}" for row in rows.tolist())
    shape = f"[{rows.shape[0]}][{rows.shape[1]}]"
    return f"static const {writer.type} {name}{shape} = {{\n{listed}\n}};\n"


def _ascii(text: str) -> str:
    """Return words that can stand in a comment or a string for any compiler."""
    words = {"²": "^2", "³": "^3", "°": "deg", "\\": "/", "*/": "* /", "/*": "/ *"}
    for symbol, word in words.items():
        text = text.replace(symbol, word)
    text = re.sub(r"\?(?=\?)", "? ", text.encode("ascii", "replace").decode())
    return " ".join(text.split())
