"""The feed-forward as one C99 file and its header."""

import inspect
import json
import math
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.identification.fit_result import Fit
from jaxid.io import atomic_folder, fill_template
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

    @property
    def sizes(self) -> list[int]:
        """Number of entries of each input."""
        return [math.prod(shape) for shape in self.program.input_shapes]


def export_c(
    fit: Fit, folder: str | Path, *, name: str = "arm", double: bool = True
) -> Path:
    """Write the model as one C99 file and its header, for a real-time controller (Eqs. 38, 39).

    The file needs no library, allocates nothing and does not branch on data, so that
    every call takes the same time. It compiles as C++ too. A known tool is not
    included, as in `Fit.predict`.

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
        for suffix, text in c_texts(fit, writer, functions).items():
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
        "torque": (
            "Feed-forward torques on base parameters (Eq. 39, factored)",
            torque,
        ),
        "torque_of_parameters": (
            "The same for given base parameters p, as Theta_B p (Eq. 39)",
            lambda q, qd, qdd, p, s=None: base.columns(q, qd, qdd, s) @ p,
        ),
        "torque_of_masses": (
            "The same as M qdd + h, with M by composite bodies (Eq. 38)",
            lambda q, qd, qdd, s=None: (
                model.inertia(own, q) @ qdd + model.bias(own, q, qd, s)
            ),
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
            lambda q, qd, s=None: (
                others(q, qd, rest, s) - others(q, rest, rest, relaxed)
            ),
        ),
        "regressor": ("Base regressor Theta_B, row by row (Eq. 23)", base.columns),
    }
    if law is not None:
        functions["advance"] = (
            "State of dry friction behind a step of the joints",
            law.advance,
        )
    outputs = {
        "mass_matrix": "m",
        "bias": "h",
        "regressor": "theta",
        "advance": "s_next",
    }
    written = []
    for name, (summary, function) in functions.items():
        inputs = (x for x in inspect.signature(function).parameters if x != "s" or law)
        inputs = tuple(inputs)
        shapes = {"p": (base.size,), "s": model.input_shapes[-1]}
        program = trace(function, *(shapes.get(x, one) for x in inputs))
        written.append(
            CFunction(name, summary, program, inputs, outputs.get(name, "tau"))
        )
    return tuple(written)


def c_texts(
    fit: Fit, writer: CWriter, functions: tuple[CFunction, ...]
) -> dict[str, str]:
    """Return the texts of the header and of the C file, by their suffixes."""
    model = fit.base.model
    random, samples = np.random.default_rng(0), 4
    # The self-test compares all functions with their results in Python.
    used = dict.fromkeys(x for f in functions for x in f.inputs if x != "p")
    states = {
        x: np.round(random.uniform(-2.0, 2.0, (samples, model.robot.joints)), 3)
        for x in used
    }
    given = {
        **states,
        "p": np.tile(np.asarray(fit.parameters, np.float64), (samples, 1)),
    }
    tables = {x: rows.tolist() for x, rows in states.items()}
    for function in functions:
        arrays = [given[x] for x in function.inputs]
        if not writer.double:
            arrays = [x.astype(np.float32).astype(np.float64) for x in arrays]
        result = np.asarray(evaluate(function.program, *(x.T for x in arrays)))
        rows = np.broadcast_to(
            result.reshape(function.size, -1), (function.size, samples)
        ).T
        tables[f"{function.name}_expected"] = rows.tolist()
    values = {
        "fit": fit,
        "robot": model.robot,
        "name": writer.prefix,
        "writer": writer,
        "functions": functions,
        "parameters": np.asarray(fit.parameters).tolist(),
        "terms": ", ".join(type(term).__name__ for term in model.terms),
        "gravity": ", ".join(f"{x:g}" for x in np.asarray(model.robot.gravity)),
        "has_memory": model.memory is not None,
        "tables": tables,
        "samples": samples,
        "tolerance": "1e-10" if writer.double else "0.002",
        "ascii": _ascii,
        "quoted": json.dumps,
    }
    templates = Path(__file__).parent / "templates"
    return {
        x: fill_template(templates / f"arm{x}.jinja", **values) for x in (".h", ".c")
    }


def _ascii(text: str) -> str:
    """Return words that can stand in a comment or a string for any compiler."""
    words = {"²": "^2", "³": "^3", "°": "deg", "\\": "/", "*/": "* /", "/*": "/ *"}
    for symbol, word in words.items():
        text = text.replace(symbol, word)
    text = re.sub(r"\?(?=\?)", "? ", text.encode("ascii", "replace").decode())
    return " ".join(text.split())
