"""A scalar program as plain C for a real-time controller.

Sine, cosine and tanh come with the code: no branches, no tables, the same time for any
number. The functions of C compilers branch on their argument and take several times as
long. Ours work on short arrays of a fixed length, which compilers turn into vector
instructions; since a controller's call waits for them, their chains of operations are
short.
"""

import math
import re
import textwrap
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from jaxid.errors import InputError
from jaxid.io import fill_template

from .jax_sincos import DOUBLE, SINGLE, half_pi
from .program import Program, Reference
from .scalar import Operation

LIBRARY = {
    "sine_cosine": (Operation.SINE, Operation.COSINE),
    "tanh": (Operation.HYPERBOLIC_TANGENT,),
}
"""Operations that each function of the library computes for many numbers at once."""
RESERVED = re.compile(
    "alignas|alignof|and|asm|auto|bool|break|case|catch|char|class|const|constexpr|continue|default|"
    "delete|do|double|else|enum|explicit|export|extern|false|float|for|friend|goto|if|inline|int|"
    "long|mutable|namespace|new|not|operator|or|private|protected|public|register|restrict|return|"
    "short|signed|sizeof|static|struct|switch|template|this|throw|true|try|typedef|typename|union|"
    "unsigned|using|virtual|void|volatile|while|xor|t[a-z]?[0-9]+[ab]?"
)
"""Keywords of C and C++, and the names of the generated variables."""
Names = Sequence[str]
"""Names in C, or expressions, in order."""
_LN2 = Fraction("0.693147180559945309417232121458176568075500134360255254120680009")


class CWriter:
    """Writer of C99 code, which is also valid C++, in one precision.

    Args:
        double: Whether numbers are `double` (otherwise `float`).
        prefix: Prefix of the names of the library's functions.
        programs: Programs that call the library, which is made for the largest number
            of angles in one of them; the C compiler's own functions are called if there
            are none.
    """

    def __init__(
        self, double: bool, prefix: str = "", programs: Sequence[Program] = ()
    ):
        self.double = double
        self.prefix = prefix
        self.type = "double" if double else "float"
        self._suffix = "" if double else "f"
        self._dtype = np.float64 if double else np.float32
        # Fewer and longer pieces of pi/2 than in JAX, for a shorter chain and smaller
        # angles.
        double_precision = DOUBLE._replace(pieces=half_pi(33, 2), limit=2.0**20)
        self._precision = double_precision if double else SINGLE
        self.turns = self._precision.limit / 4
        self.widths: dict[str, int] = {}
        for name, operations in LIBRARY.items():
            calls = max((_count_calls(x, operations) for x in programs), default=0)
            if calls:
                # Compilers make vector instructions of an even number.
                self.widths[name] = calls + calls % 2

    def number(self, x: float) -> str:
        """Write a number with as many digits as its precision needs."""
        value = self._dtype(x)
        if math.isnan(x):
            return "NAN"
        if np.isinf(value):
            return "INFINITY" if x > 0 else "(-INFINITY)"
        write = np.format_float_positional
        if abs(x) > 1e6 or 0 < abs(x) < 1e-4:
            write = np.format_float_scientific
        text = write(value, unique=True, trim="0") + self._suffix
        return f"({text})" if text.startswith("-") else text

    def declaration(self, name: str, inputs: Names, outputs: Names) -> str:
        """Write the prototype of a program's function, without a semicolon."""
        _check_names([name, *inputs, *outputs])
        arguments = [f"const {self.type} *{x}" for x in inputs]
        arguments += [f"{self.type} *{x}" for x in outputs]
        return f"void {name}({', '.join(arguments) or 'void'})"

    def definition(
        self, program: Program, name: str, inputs: Names, outputs: Names
    ) -> str:
        """Write a program as the definition of a C function.

        The function allocates nothing and has no loops, and its choices compile to
        selections: its run time does not depend on the data, if that of the
        mathematical library does not. It takes a pointer for each input, then one for
        each output, all to numbers in C order. Every entry of an output is written,
        constants too. All inputs are read before an output is written, so that they may
        share memory.
        """
        lines = self._statements(program, inputs)
        input_nodes = [x for x in program.nodes if x.operation is Operation.INPUT]
        numbers = {node.place[0] for node in input_nodes}
        # Compilers warn of arguments that nothing reads.
        for number, name_of_input in enumerate(inputs):
            if number not in numbers:
                lines.append(f"(void){name_of_input};")
        entries_of_outputs = program.split(program.outputs)
        for output, entries in zip(outputs, entries_of_outputs, strict=True):
            if not entries:
                lines.append(f"(void){output};")
            for k, x in enumerate(entries):
                operand = self._operand(x)
                lines.append(f"{output}[{k}] = {operand};")
        declaration = self.declaration(name, inputs, outputs)
        body = textwrap.indent("\n".join(lines), "    ")
        return f"{declaration}\n{{\n{body}\n}}\n"

    def _operand(self, x: Reference):
        """Write the variable of a node, or a constant."""
        return f"t{x}" if isinstance(x, int) else self.number(x)

    def _statements(self, program: Program, inputs: Names):
        """Write one line for each node, and calls of the library."""
        # By stages: a call of the library computes many numbers, but waits for all.
        stages = self._stages(program)
        lines: list[str] = []
        for stage in range(max(stages, default=0) + 1):
            nodes = [k for k, number in enumerate(stages) if number == stage]
            functions = {k: self._function(program, k) for k in nodes}
            for name in self.widths:
                calls = [k for k in nodes if functions[k] == name]
                if calls:
                    lines += self._call(program, name, calls, stage)
            for k in nodes:
                if functions[k] is None:
                    lines.append(self._statement(program, k, inputs))
        return lines

    def _function(self, program: Program, k: int):
        """Return the library's function that computes a node, else None."""
        operation = program.nodes[k].operation
        return next((x for x in self.widths if operation in LIBRARY[x]), None)

    def _stages(self, program: Program):
        """Return the number of library functions on the longest chain up to each node.

        Functions of the same stage do not need each other and are called together.
        """
        stages: list[int] = []
        for k, node in enumerate(program.nodes):
            earlier_stage = max((stages[i] for i in node.uses), default=0)
            stages.append(earlier_stage + (self._function(program, k) is not None))
        return stages

    def _statement(self, program: Program, k: int, inputs: Names):
        """Write the line of a node that the library does not compute."""
        node = program.nodes[k]
        if node.operation is Operation.INPUT:
            number, entry = node.place
            text = f"{inputs[number]}[{entry}]"
        else:
            operands = [self._operand(x) for x in node.operands]
            text = node.operation.spell(operands, self._formats, self._suffix)
        is_truth = "truth" in node.operation.traits
        kind = "int" if is_truth else self.type
        return f"const {kind} t{k} = {text};"

    @property
    def _formats(self):
        """Operations that C writes in its own way."""
        sign = f"({self.type})(({{0}} > 0) - ({{0}} < 0))"
        return {
            Operation.NEGATE: "-{0}",
            Operation.NOT: "!{0}",
            Operation.SELECT: "{0} ? {1} : {2}",
            # A NaN on either side must be kept, unlike in C's fmax and fmin.
            Operation.MAXIMUM: "(({0} > {1}) | ({0} != {0})) ? {0} : {1}",
            Operation.MINIMUM: "(({0} < {1}) | ({0} != {0})) ? {0} : {1}",
            Operation.SIGN: f"({{0}} != {{0}}) ? {{0}} : {sign}",
            Operation.ABSOLUTE: f"fabs{self._suffix}({{0}})",
        }

    def _call(self, program: Program, name: str, nodes: Sequence[int], stage: int):
        """Write a call of the library for several nodes."""
        width = self.widths[name]
        angles = [program.nodes[k].operands[0] for k in nodes]
        operands = list(dict.fromkeys(angles))
        arguments = [self._operand(x) for x in operands]
        # The library always computes as many numbers.
        padding = width - len(operands)
        arguments += [self.number(0.0)] * padding
        label = f"t{name[0]}{stage}"
        results = [f"{label}a"]
        if len(LIBRARY[name]) > 1:
            results.append(f"{label}b")
        arrays = [f"{x}[{width}]" for x in results]
        argument_list = ", ".join(arguments)
        array_list = ", ".join(arrays)
        result_list = ", ".join(results)
        lines = [
            f"const {self.type} {label}[{width}] = {{{argument_list}}};",
            f"{self.type} {array_list};",
            f"{self.prefix}_{name}({label}, {result_list});",
        ]
        for k in nodes:
            operation, (x,) = program.nodes[k]
            result = results[operation is Operation.COSINE]
            position = operands.index(x)
            lines.append(f"const {self.type} t{k} = {result}[{position}];")
        return lines

    def library(self) -> str:
        """Write the functions `sine_cosine` and `tanh`, if they are needed."""
        if not self.widths:
            return ""
        bits, mantissa, bias = (64, 52, 1023) if self.double else (32, 23, 127)
        one = 2 ** (32 if self.double else 15)
        high = Fraction(int(_LN2 * one), one)
        terms = 14 if self.double else 7
        return fill_template(
            Path(__file__).with_name("vector_functions.c.jinja"),
            prefix=self.prefix,
            widths=self.widths,
            type=self.type,
            double=self.double,
            number=self.number,
            polynomial=self._polynomial,
            precision=self._precision,
            bits=bits,
            mantissa=mantissa,
            bias=bias,
            # Adding it rounds to a whole number, in the last bits of the sum.
            rounder=self.number(1.5 * 2.0**mantissa),
            largest=float(np.finfo(self._dtype).max),
            pattern_of_22=hex(int(np.array(22.0, self._dtype).view(f"uint{bits}"))),
            pi=math.pi,
            ln2=math.log(2),
            ln2_pieces=(float(high), float(_LN2 - high)),
            exponential=[1 / math.factorial(n) for n in range(2, terms + 1)],
        )

    def _polynomial(self, coefficients: Sequence[float], powers: Names):
        """Write a polynomial in Estrin's scheme, whose chain is short.

        Coefficients begin with the lowest power; the `powers` are the names of x, x^2,
        x^4, ...
        """
        terms = [self.number(c) for c in coefficients]
        for power in powers:
            pairs = zip(terms[::2], terms[1::2], strict=False)
            sums = [f"({low} + {power} * {high})" for low, high in pairs]
            terms = sums + terms[2 * len(sums) :]
        return terms[0]


def _count_calls(program: Program, operations: Sequence[Operation]):
    """Return the number of different arguments of some operations in a program."""
    return len({x.operands for x in program.nodes if x.operation in operations})


def _check_names(names: list[str]):
    """Reject names that C does not allow, or that occur twice."""
    for name in names:
        is_identifier = re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name)
        if not is_identifier or RESERVED.fullmatch(name):
            raise InputError(
                "names in C code must be identifiers of C and not reserved, "
                f"but one is {name!r}."
            )
    if len(set(names)) < len(names):
        raise InputError(
            f"names in C code must differ from each other, but are {names}."
        )
