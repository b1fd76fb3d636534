"""A scalar program as plain C for a real-time controller."""

import math
import re
from collections.abc import Callable, Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.program.c_library import KINDS, SINE_COSINE, Library
from jaxid.program.operation import TRUTH_VALUED, Operation
from jaxid.program.program import Program, Reference

_INFIX = {
    Operation.ADD: "+",
    Operation.SUBTRACT: "-",
    Operation.MULTIPLY: "*",
    Operation.DIVIDE: "/",
    Operation.LESS: "<",
    Operation.LESS_EQUAL: "<=",
    Operation.EQUAL: "==",
    Operation.NOT_EQUAL: "!=",
    Operation.AND: "&",
    Operation.OR: "|",
}
# A NaN on either side must come through, which C's fmax and fmin do not do.
_FORMAT: dict[Operation, Callable[..., str]] = {
    Operation.NEGATE: lambda x: f"-{x}",
    Operation.NOT: lambda x: f"!{x}",
    Operation.SELECT: lambda c, x, y: f"{c} ? {x} : {y}",
    Operation.MAXIMUM: lambda x, y: f"(({x} > {y}) | ({x} != {x})) ? {x} : {y}",
    Operation.MINIMUM: lambda x, y: f"(({x} < {y}) | ({x} != {x})) ? {x} : {y}",
}
_OF_LIBRARY = frozenset(kind for kinds in KINDS.values() for kind in kinds)
_NAMES = {Operation.ABSOLUTE: "fabs"}
_KEYWORDS = re.compile(
    "alignas|alignof|and|asm|auto|bool|break|case|catch|char|class|const|constexpr|continue|default|"
    "delete|do|double|else|enum|explicit|export|extern|false|float|for|friend|goto|if|inline|int|"
    "long|mutable|namespace|new|not|operator|or|private|protected|public|register|restrict|return|"
    "short|signed|sizeof|static|struct|switch|template|this|throw|true|try|typedef|typename|union|"
    "unsigned|using|virtual|void|volatile|while|xor"
)


class _Writer:
    """Spells one program's numbers and operations in one precision."""

    def __init__(self, double: bool):
        self.type = "double" if double else "float"
        self.round = np.float64 if double else np.float32
        self.suffix = "" if double else "f"

    def number(self, x: float) -> str:
        rounded = self.round(x)
        if math.isnan(x):
            return "NAN"
        if np.isinf(rounded):
            return "INFINITY" if x > 0 else "(-INFINITY)"
        digits = np.format_float_scientific(rounded, unique=True, trim="0")
        text = digits if "e" not in digits or abs(x) > 1e6 or 0 < abs(x) < 1e-4 else None
        text = text or np.format_float_positional(rounded, unique=True, trim="0")
        return f"({text}{self.suffix})" if text.startswith("-") else text + self.suffix

    def operand(self, x: Reference) -> str:
        return f"t{x}" if isinstance(x, int) else self.number(x)

    def expression(self, operation: Operation, operands: Sequence[Reference]) -> str:
        spelled = [self.operand(x) for x in operands]
        if operation in _INFIX:
            return f" {_INFIX[operation]} ".join(spelled)
        if operation is Operation.SIGN:
            (x,) = spelled
            return f"({x} != {x}) ? {x} : ({self.type})(({x} > 0) - ({x} < 0))"
        if operation in _FORMAT:
            return _FORMAT[operation](*spelled)
        name = _NAMES.get(operation, operation.value)
        return f"{name}{self.suffix}({', '.join(spelled)})"


def to_c(
    program: Program,
    name: str,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    *,
    double: bool = True,
) -> str:
    """Writes a program as one C99 function, which is also valid C++.

    The function allocates nothing and has no loops, and its choices compile to selections: its run
    time does not depend on the data, if the mathematical library's does not. It takes a pointer for
    each input, then one for each output, all to rows of numbers in C order. Every entry of an
    output is written, constants too. All inputs are read before an output is written, so that they
    may be the same memory.

    Args:
        program: Made by `trace`.
        name: Name of the C function.
        inputs: Names of the inputs; by default `input0`, `input1`, ...
        outputs: Names of the outputs; by default `output0`, `output1`, ...
        double: Whether the C code computes in `double`; in `float` otherwise.

    Raises:
        InputError: If a name is no identifier of C, is used twice, or there are not
            as many names as inputs or outputs.
    """
    inputs = _names(inputs, "input", len(program.input_shapes))
    outputs = _names(outputs, "output", len(program.output_shapes))
    head = declaration(name, inputs, outputs, double=double)
    return f"""#include <math.h>

/* Generated code: do not edit.
{_description(program, inputs, outputs)}
   {program.counts}. */
#ifdef __cplusplus
extern "C"
#endif
{head};

{definition(program, name, inputs, outputs, double=double)}"""


def declaration(name: str, inputs: Sequence[str], outputs: Sequence[str], *, double: bool) -> str:
    """The prototype of a program's function, without a semicolon.

    Args:
        name: Name of the C function.
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        double: Whether its numbers are of `double`; of `float` otherwise.

    Raises:
        InputError: If a name is no identifier of C, or is used twice.
    """
    _check_names([name, *inputs, *outputs])
    kind = "double" if double else "float"
    arguments = [f"const {kind} *{x}" for x in inputs] + [f"{kind} *{x}" for x in outputs]
    return f"void {name}({', '.join(arguments) or 'void'})"


def definition(
    program: Program,
    name: str,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    double: bool,
    library: Library | None = None,
) -> str:
    """A program as the definition of a C function, as `to_c` describes it.

    Args:
        program: Made by `trace`.
        name: Name of the C function.
        inputs: Names of the inputs.
        outputs: Names of the outputs.
        double: Whether the C code computes in `double`; in `float` otherwise.
        library: Functions for many sines, cosines and tanh at once that stand before it in the
            file, made for this program and others; the compiler's own functions if None.

    Raises:
        InputError: If a name is no identifier of C, or is used twice.
    """
    head = declaration(name, inputs, outputs, double=double)
    writer = _Writer(double)
    lines = _statements(program, writer, inputs, library)
    read = {int(node.operands[0]) for node in program.nodes if node.operation is Operation.INPUT}
    lines += [f"(void){x};" for k, x in enumerate(inputs) if k not in read]
    start = 0
    for output, shape in zip(outputs, program.output_shapes, strict=True):
        size = math.prod(shape)
        if not size:
            lines.append(f"(void){output};")
        entries = program.outputs[start : start + size]
        lines += [f"{output}[{k}] = {writer.operand(x)};" for k, x in enumerate(entries)]
        start += size
    body = "\n".join(f"    {line}" for line in lines)
    return f"{head}\n{{\n{body}\n}}\n"


def _statements(
    program: Program, writer: _Writer, inputs: Sequence[str], library: Library | None
) -> list[str]:
    """One line for each node; functions of the library wait until there are many of them."""
    lines: list[str] = []
    stages = _stages(program) if library else [0] * len(program.nodes)
    for stage in range(max(stages, default=0) + 1):
        own = [k for k, s in enumerate(stages) if s == stage]
        if stage and library:
            for call, kinds in KINDS.items():
                nodes = [k for k in own if program.nodes[k].operation in kinds]
                lines += _called(program, writer, library, call, nodes, stage) if nodes else []
            own = [k for k in own if program.nodes[k].operation not in _OF_LIBRARY]
        for k in own:
            operation, operands = program.nodes[k]
            if operation is Operation.INPUT:
                number, entry = operands
                expression = f"{inputs[int(number)]}[{entry}]"
            else:
                expression = writer.expression(operation, operands)
            kind = "int" if operation in TRUTH_VALUED else writer.type
            lines.append(f"const {kind} t{k} = {expression};")
    return lines


def _stages(program: Program) -> list[int]:
    """For each node how many functions of the library stand before it, one after the other."""
    stages: list[int] = []
    for node in program.nodes:
        before = max((stages[k] for k in node.uses), default=0)
        stages.append(before + (node.operation in _OF_LIBRARY))
    return stages


def _called(
    program: Program, writer: _Writer, library: Library, call: str, nodes: Sequence[int], stage: int
) -> list[str]:
    """Some functions of the library at once, and their results as nodes."""
    width = library.width(call)
    arguments = list(dict.fromkeys(program.nodes[k].operands[0] for k in nodes))
    filled = [writer.operand(x) for x in arguments]
    filled += [writer.number(0.0)] * (width - len(arguments))
    label = f"t{call[0]}{stage}"
    results = [f"{label}a"] + ([f"{label}b"] if call == SINE_COSINE else [])
    lines = [
        f"const {writer.type} {label}[{width}] = {{{', '.join(filled)}}};",
        f"{writer.type} {', '.join(f'{x}[{width}]' for x in results)};",
        f"{library.prefix}_{call}({label}, {', '.join(results)});",
    ]
    for k in nodes:
        operation, (x,) = program.nodes[k]
        result = results[operation is Operation.COSINE]
        lines.append(f"const {writer.type} t{k} = {result}[{arguments.index(x)}];")
    return lines


def _description(program: Program, inputs: Sequence[str], outputs: Sequence[str]) -> str:
    shapes = [*program.input_shapes, *program.output_shapes]
    rows = zip([*inputs, *outputs], shapes, strict=True)
    return "\n".join(f"   {name}: {math.prod(s)} numbers, shape {list(s)}." for name, s in rows)


def _names(given: Sequence[str] | None, stem: str, count: int) -> list[str]:
    names = [f"{stem}{k}" for k in range(count)] if given is None else list(given)
    if len(names) != count:
        raise InputError(f"`{stem}s` must name the program's {count} {stem}s, but has {names}.")
    return names


def _check_names(names: list[str]) -> None:
    for name in names:
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or _KEYWORDS.fullmatch(name):
            raise InputError(f"A name in C code must be an identifier of C, but got {name!r}.")
        if re.fullmatch(r"t[a-z]?[0-9]+[ab]?", name):
            raise InputError(f"The name {name!r} is taken by the generated code: choose another.")
    if len(set(names)) < len(names):
        raise InputError(f"Names in C code must differ from each other, but are {names}.")
