"""A scalar program as a function of Python's own floats: for one sample at a time.

A loop in which every sample needs the one before, such as a simulation, cannot be batched. NumPy
then pays its overhead for every operation, and XLA takes seconds to compile; Python runs a
program of a thousand operations in some thirty microseconds, at once.
"""

import math
from collections.abc import Callable, Sequence

from jaxid.program.operation import Operation
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
_FORMAT = {
    Operation.NEGATE: "-{0}",
    Operation.NOT: "not {0}",
    Operation.SELECT: "{1} if {0} else {2}",
    Operation.MAXIMUM: "{0} if {0} > {1} or {0} != {0} else {1}",
    Operation.MINIMUM: "{0} if {0} < {1} or {0} != {0} else {1}",
    Operation.SIGN: "1.0 if {0} > 0.0 else -1.0 if {0} < 0.0 else {0}",
    Operation.POWER: "{0} ** {1}",
}
_NAMES = {Operation.ABSOLUTE: "abs"}
_REPEATED = (Operation.MAXIMUM, Operation.MINIMUM, Operation.SIGN)
_LONGEST = 200
"""Characters up to which an expression is written where it is used."""


def to_python(program: Program) -> Callable[..., tuple[float, ...]]:
    """Makes a function of lists of floats.

    It takes for each input its entries in C order, and returns the entries of all outputs, one
    after the other. Division by zero, and functions outside of their domain, raise Python's own
    errors, where NumPy gives infinities and NaN.

    Args:
        program: Made by `trace`.
    """
    uses = [0] * len(program.nodes)
    for node in program.nodes:
        for k in node.uses:
            uses[k] += 1 + (node.operation in _REPEATED)
    lines = [
        f"({''.join(f'x{k}_{entry}, ' for entry in range(math.prod(shape)))}) = x{k}"
        for k, shape in enumerate(program.input_shapes)
        if math.prod(shape)
    ]
    spelled: list[str] = []
    for position, node in enumerate(program.nodes):
        if node.operation is Operation.INPUT:
            number, entry = node.place
            spelled.append(f"x{number}_{entry}")
            continue
        text = _expression(node.operation, [_operand(x, spelled) for x in node.operands])
        if uses[position] == 1 and len(text) <= _LONGEST:
            spelled.append(f"({text})")
        else:
            lines.append(f"t{position} = {text}")
            spelled.append(f"t{position}")
    results = "".join(f"{_operand(x, spelled)}, " for x in program.outputs)
    names = ", ".join(f"x{k}" for k in range(len(program.input_shapes)))
    body = "".join(f"    {line}\n" for line in lines)
    scope = {name: getattr(math, name) for name in dir(math) if not name.startswith("_")}
    exec(f"def run({names}):\n{body}    return ({results})\n", scope)
    return scope["run"]


def _operand(x: Reference, spelled: Sequence[str]) -> str:
    if isinstance(x, int):
        return spelled[x]
    # In words, since Python has no literals for infinities and NaN.
    return f"({x!r})" if math.isfinite(x) else f"({'-' if x < 0 else ''}{abs(x)!s})"


def _expression(operation: Operation, operands: Sequence[str]) -> str:
    if operation in _INFIX:
        return f" {_INFIX[operation]} ".join(operands)
    if operation in _FORMAT:
        return _FORMAT[operation].format(*operands)
    return f"{_NAMES.get(operation, operation.value)}({', '.join(operands)})"
