"""The feed-forward as one C99 file and its header."""

from pathlib import Path

import numpy as np

from jaxid.arrays import Float
from jaxid.export.feed_forward import Form, forms
from jaxid.identification.fit import Fit
from jaxid.io import atomic_folder
from jaxid.program import Library, declaration, definition, evaluate

STATES = 4
"""States at which the file can check itself."""
TOLERANCE = {True: 1e-10, False: 2e-3}
"""Largest error of the self-test, relative to the largest number of each result."""


def export_c(fit: Fit, folder: str | Path, *, name: str = "arm", double: bool = True) -> Path:
    """Writes the model as one C99 file and its header, for a real-time controller (Eqs. 38, 39).

    The file needs no library, allocates nothing and does not branch on data, so that every call
    takes the same time. It compiles as C++ too. A known tool is not in it, as it is not in
    `Fit.predict`.

    Args:
        fit: The model.
        folder: Where the files shall be.
        name: Of the files, and before the functions' names.
        double: Whether the code computes in `double`; in `float` otherwise.

    Returns:
        The C file; the header lies beside it.

    Raises:
        InputError: If `name` is no identifier of C.
    """
    source, header = c_code(fit, name, double)
    folder = Path(folder)
    with atomic_folder(folder) as staging:
        (staging / f"{name}.c").write_text(source, encoding="ascii")
        (staging / f"{name}.h").write_text(header, encoding="ascii")
    return folder / f"{name}.c"


def c_code(fit: Fit, name: str, double: bool) -> tuple[str, str]:
    """The texts of the C file and of its header.

    Args:
        fit: The model.
        name: Of the files, and before the functions' names.
        double: Whether the code computes in `double`; in `float` otherwise.

    Raises:
        InputError: If `name` is no identifier of C.
    """
    declaration(name, (), (), double=double)
    found = forms(fit)
    library = Library.of([form.program for form in found], name, double=double)
    return _source(fit, library, found), _header(fit, library, found)


def _full(name: str, form: Form) -> str:
    return f"{name}_{form.name}"


def _header(fit: Fit, library: Library, found: tuple[Form, ...]) -> str:
    robot, base = fit.base.model.robot, fit.base
    name, double = library.prefix, library.double
    joints = "\n".join(
        f"     {j}  {_ascii(robot.joint_names[j])}: {'turns' if turns else 'slides'}, "
        f"q in {robot.joint_unit(j)}, tau in {robot.force_unit(j)}"
        for j, turns in enumerate(robot.revolute)
    )
    gravity = ", ".join(f"{x:g}" for x in np.asarray(robot.gravity))
    terms = ", ".join(type(t).__name__ for t in fit.base.model.terms)
    kind, guard = "double" if double else "float", f"{name.upper()}_H"
    prototypes = "\n\n".join(
        f"/* {_ascii(form.words)}\n   {form.program.counts.total} operations: "
        f"{form.program.counts}.\n   {_sizes(form)} */\n"
        f"{declaration(_full(name, form), form.inputs, (form.output,), double=double)};"
        for form in found
    )
    return f"""/* Identified model of the robot "{_ascii(robot.name)}", for a controller.

   Model of {fit.date or "an unknown day"}, {fit.checksum}
   Recordings: {_ascii(", ".join(fit.recordings) or "unknown")}
   Terms: {terms}
   Gravity in the frame of the ground: {gravity} m/s^2

   Joints, in the order of all arrays:
{joints}

   q, qd, qdd: positions, velocities and accelerations [rad or m, per s, per s^2].
   tau: generalized forces on the side of the joints [N m or N], without a known tool.

   Nothing is allocated, there is no state and no branch on data: every call takes the same time and
   functions can be called from any thread. All inputs are read before an output is written. Numbers
   that are not finite, and angles beyond {library.turns:.0f} turns, give NaN.

   Check the file on its machine: cc -D{name.upper()}_SELF_TEST {name}.c -lm && ./a.out
   Generated code: do not edit. */
#ifndef {guard}
#define {guard}

#define {name.upper()}_JOINTS {robot.joints}
#define {name.upper()}_PARAMETERS {base.size}
#define {name.upper()}_CHECKSUM "{fit.checksum}"
#define {name.upper()}_DATE "{fit.date}"

#ifdef __cplusplus
extern "C" {{
#endif

/* The estimates: see the list in {name}.c. */
extern const {kind} {name}_parameters[{base.size}];

{prototypes}

#ifdef __cplusplus
}}
#endif

#endif
"""


def _sizes(form: Form) -> str:
    sizes = [
        f"{x}[{int(np.prod(s))}]"
        for x, s in zip(form.inputs, form.program.input_shapes, strict=True)
    ]
    return (
        f"From {', '.join(sizes)} to {form.output}[{int(np.prod(form.program.output_shapes[0]))}]."
    )


def _source(fit: Fit, library: Library, found: tuple[Form, ...]) -> str:
    base = fit.base
    name, double = library.prefix, library.double
    kind = "double" if double else "float"
    values = np.asarray(fit.parameters, np.float64)
    parameters = "\n".join(
        f"    {_number(x, double)}{',' if k + 1 < base.size else ' '} "
        f"/* {base.names[k]} [{_ascii(base.units[k])}] */"
        for k, x in enumerate(values)
    )
    functions = "\n".join(
        definition(
            form.program,
            _full(name, form),
            form.inputs,
            (form.output,),
            double=double,
            library=library,
        )
        for form in found
    )
    return f"""/* Identified model of the robot "{_ascii(base.model.robot.name)}": see {name}.h.
   Generated code: do not edit. */
#include "{name}.h"

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

const {kind} {name}_parameters[{base.size}] = {{
{parameters}
}};

{library.text()}
{functions}
{_self_test(fit, name, double, found)}"""


def _self_test(fit: Fit, name: str, double: bool, found: tuple[Form, ...]) -> str:
    kind, n = "double" if double else "float", fit.base.model.robot.joints
    random = np.random.default_rng(0)
    states = {x: np.round(random.uniform(-2.0, 2.0, (STATES, n)), 3) for x in ("q", "qd", "qdd")}
    given = {**states, "p": np.tile(np.asarray(fit.parameters, np.float64), (STATES, 1))}
    tables = [_table(f"{name}_{x}", kind, values, double) for x, values in states.items()]
    calls = []
    for form in found:
        arrays = [given[x] for x in form.inputs]
        if not double:
            arrays = [x.astype(np.float32).astype(np.float64) for x in arrays]
        result = evaluate(form.program, *(x.T for x in arrays))
        size = int(np.prod(form.program.output_shapes[0]))
        rows = np.broadcast_to(result.reshape(size, -1), (size, STATES)).T
        tables.append(_table(f"{name}_{form.name}_expected", kind, rows, double))
        arguments = [f"{name}_parameters" if x == "p" else f"{name}_{x}[k]" for x in form.inputs]
        calls.append(
            f"        {_full(name, form)}({', '.join(arguments)}, result);\n"
            f'        wrong |= {name}_differs("{form.name}", result, '
            f"{name}_{form.name}_expected[k], {size});"
        )
    largest = max(int(np.prod(form.program.output_shapes[0])) for form in found)
    body = "\n".join(calls)
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
    return !(error <= {TOLERANCE[double]:g} * largest + {TOLERANCE[double]:g});
}}

int main(void)
{{
    {kind} result[{largest}];
    int wrong = 0, k;
    for (k = 0; k < {STATES}; ++k) {{
{body}
    }}
    puts(wrong ? "this build is WRONG" : "this build is right");
    return wrong;
}}
#endif
"""


def _table(name: str, kind: str, rows: Float[np.ndarray, "states entries"], double: bool) -> str:
    listed = ",\n".join(
        "    {" + ", ".join(_number(x, double) for x in row) + "}" for row in np.atleast_2d(rows)
    )
    return f"static const {kind} {name}[{rows.shape[0]}][{rows.shape[1]}] = {{\n{listed}\n}};\n"


def _number(x: float, double: bool) -> str:
    text = repr(float(x)) if double else f"{float(np.float32(x)):.9g}"
    text = text if any(c in text for c in ".en") else f"{text}.0"
    return text if double else f"{text}f"


def _ascii(text: str) -> str:
    """Words that can stand in a comment of any compiler."""
    for symbol, word in (("²", "^2"), ("³", "^3"), ("°", "deg"), ("\\", "/"), ("*/", "* /")):
        text = text.replace(symbol, word)
    return " ".join(text.encode("ascii", "replace").decode().split())
