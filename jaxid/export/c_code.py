"""The feed-forward as one C99 file and its header."""

import inspect
import itertools
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Texts
from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.io import FilePath, atomic_folder, fill_template
from jaxid.program import Program, evaluate, trace
from jaxid.program.c_writer import CWriter
from jaxid.robot.loop_closing import reachable
from jaxid.robot.robot import Robot

from .feed_forward import other_forces, torques

JOINT_INPUTS = ("q_before", "q", "qd", "qdd")
"""Inputs with one number for each joint."""
TEST_SAMPLES = 4
"""Number of states at which the self-test of a file compares its functions."""


class CFunction(NamedTuple):
    """One function of the C file; its name is without that of the model."""

    name: str
    summary: str
    program: Program
    inputs: Texts
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
    fit: Fit, folder: FilePath, *, name: str = "arm", double: bool = True
) -> Path:
    """Write the model as one C99 file and its header (Eqs. 38, 39).

    They are for a real-time controller. The file needs no library, allocates nothing
    and does not branch on data, so that every call takes the same time. It compiles as
    C++ too. A known tool is not included, as in `Fit.predict`.

    Args:
        fit: Identified model.
        folder: Folder of the files.
        name: Name of the files and prefix of the functions.
        double: Whether the code computes in `double` (otherwise `float`).

    Returns:
        Path of the C file; the header is beside it.

    Raises:
        InputError: If `name` is not an identifier of C, or the base floats.
    """
    robot = fit.base.model.robot
    if robot.floating:
        raise InputError(
            f"C code needs a base that is fixed, but that of `{robot.name}` floats: "
            "export `mjcf` or `urdf`."
        )
    CWriter(double).declaration(name, (), ())
    functions = c_functions(fit)
    writer = CWriter(double, name, [x.program for x in functions])
    with atomic_folder(folder) as staging:
        for suffix, text in c_texts(fit, writer, functions).items():
            (staging / f"{name}{suffix}").write_text(text, encoding="ascii")
    return Path(folder) / f"{name}.c"


def c_functions(fit: Fit) -> list[CFunction]:
    """Return all functions of a model, with its estimates as constants."""
    model = fit.base.model
    joints = (len(model.robot.driven),)
    shapes: dict[str, tuple[int, ...]] = {
        "q_before": joints,
        "q": joints,
        "qd": joints,
        "qdd": joints,
        "p": (fit.base.size,),
    }
    if model.memory is not None:
        shapes["s"] = model.input_shapes[-1]
    functions = []
    for name, (summary, output, function) in _definitions(fit).items():
        arguments = inspect.signature(function).parameters
        inputs = [x for x in arguments if x in shapes]
        if model.robot.rigid:
            function = without_virtual_joints(model.robot, name, inputs, function)
        program = trace(function, *[shapes[x] for x in inputs])
        functions.append(CFunction(name, summary, program, tuple(inputs), output))
    return functions


def without_virtual_joints(
    robot: Robot, name: str, inputs: Sequence[str], function: Callable
) -> Callable:
    """Return a function of driven joints from one of all joints.

    Those of force sensors do not move. The function `wrench` returns their forces, all
    others those of the driven joints.
    """
    driven = np.array(robot.driven)
    rows = np.array(robot.rigid) if name == "wrench" else driven

    def of_driven_joints(*arguments):
        all_arguments = []
        for key, values in zip(inputs, arguments, strict=True):
            if key in JOINT_INPUTS:
                values = jnp.zeros(robot.joints, values.dtype).at[driven].set(values)
            all_arguments.append(values)
        result = function(*all_arguments)[rows]
        return result[:, driven] if name == "mass_matrix" else result

    return of_driven_joints


def _definitions(fit: Fit) -> dict[str, tuple[str, str, Callable]]:
    """Return summary, output and definition of each function, by name."""
    base = fit.base
    model = base.model
    torque = torques(fit)
    remaining_forces = other_forces(fit)
    rest = np.zeros(model.robot.joints)
    relaxed_state = None if model.memory is None else np.zeros(model.input_shapes[-1])
    # Only the base parameters: composite bodies have fewer operations then.
    parameters = np.asarray(base.to_standard(np.asarray(fit.parameters, np.float64)))

    def torque_of_parameters(q, qd, qdd, p, s=None):
        return base.columns(q, qd, qdd, s) @ p

    def mass_matrix(q):
        return model.inertia(parameters, q)

    def bias(q, qd, s=None):
        return torque(q, qd, rest, s)

    def gravity(q):
        return torque(q, rest, rest, relaxed_state)

    def friction(q, qd, s=None):
        forces_at_rest = remaining_forces(q, rest, rest, relaxed_state)
        return remaining_forces(q, qd, rest, s) - forces_at_rest

    functions = {
        "torque": (
            "Feed-forward torques on base parameters (Eq. 39, factored)",
            "tau",
            torque,
        ),
        "torque_of_parameters": (
            "The same for given base parameters p, as Theta_B p (Eq. 39)",
            "tau",
            torque_of_parameters,
        ),
        "mass_matrix": (
            "Mass matrix M, rotors included, row by row (Eq. 38)",
            "m",
            mass_matrix,
        ),
        "bias": (
            "Forces h without accelerations: Coriolis, gravity, friction (Eq. 38)",
            "h",
            bias,
        ),
        "gravity": ("Forces at rest: gravity, springs, offsets", "tau", gravity),
        "friction": (
            "Friction: the forces that motion adds to those at rest",
            "tau",
            friction,
        ),
        "regressor": (
            "Base regressor Theta_B, row by row (Eq. 23)",
            "theta",
            base.columns,
        ),
    }
    if model.robot.rigid:
        summary = (
            "Wrench of the force sensors: what is behind them, at any motion, and bias"
        )
        functions["wrench"] = (summary, "w", torque)
    if model.memory is not None:
        summary = "State of dry friction after a step of the joints"
        functions["advance"] = (summary, "s_next", model.memory.advance)
    return functions


def c_texts(
    fit: Fit, writer: CWriter, functions: Sequence[CFunction]
) -> dict[str, str]:
    """Return the texts of the header and of the C file, by their suffixes."""
    model = fit.base.model
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
        "tables": _test_tables(fit, functions),
        "samples": TEST_SAMPLES,
        "tolerance": "1e-10" if writer.double else "0.002",
        "ascii": _ascii,
        "quoted": json.dumps,
    }
    templates = Path(__file__).parent / "templates"
    return {
        suffix: fill_template(templates / f"arm{suffix}.jinja", **values)
        for suffix in (".h", ".c")
    }


def _test_tables(fit: Fit, functions: Sequence[CFunction]) -> dict[str, list]:
    """Return random states and the results of all functions, for the self-test."""
    random = np.random.default_rng(0)
    shape = (TEST_SAMPLES, len(fit.base.model.robot.driven))
    parameters = np.asarray(fit.parameters, np.float64)
    arrays = {"p": np.tile(parameters, (TEST_SAMPLES, 1))}
    tables = {}
    for name in itertools.chain(*(function.inputs for function in functions)):
        if name not in arrays:
            values = random.uniform(-2.0, 2.0, shape)
            if name.startswith("q_") or name == "q":
                values = reachable(fit.base.model.robot, values)
            arrays[name] = np.round(values, 3)
            tables[name] = arrays[name].tolist()
    for function in functions:
        arguments = [arrays[name].T for name in function.inputs]
        result = np.asarray(evaluate(function.program, *arguments))
        # A constant result has one sample only.
        columns = result.reshape(function.size, -1).T
        rows = np.broadcast_to(columns, (TEST_SAMPLES, function.size))
        tables[f"{function.name}_expected"] = rows.tolist()
    return tables


def _ascii(text: str) -> str:
    """Return words that can stand in a comment or a string for any compiler."""
    words = {"²": "^2", "³": "^3", "°": "deg", "\\": "/", "*/": "* /", "/*": "/ *"}
    for symbol, word in words.items():
        text = text.replace(symbol, word)
    text = re.sub(r"\?(?=\?)", "? ", text.encode("ascii", "replace").decode())
    return " ".join(text.split())
