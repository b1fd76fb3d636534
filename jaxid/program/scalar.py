"""Scalar expressions, simplified when they are built.

Equal expressions are the same object: each one is looked up in the table of its `Graph`
before it is made. A graph belongs to one trace and is freed with it.

The rules keep the value of every finite computation up to the rounding of one
operation. They fold `0 x` and `x - x` to 0, so that a NaN or an infinity in x can
disappear from the result: check inputs beforehand.
"""

import enum
from collections.abc import Mapping, Sequence
from typing import Any, overload

import numpy as np

MIN_FACTOR = 1e-300
"""Size above which constant factors are merged: below, digits would be lost."""
MAX_FACTOR = 1e300
"""Size below which constant factors are merged: above, they would be infinite."""


class Operation(enum.StrEnum):
    """A scalar operation, with the name of JAX's elementwise primitive.

    Traits serve simplification and counting: `odd`, `even`, `commutative`, `truth` (the
    result is a truth value), `choice` (a selection), `function` (as expensive as a
    library's function).
    """

    numpy: Any  # function on NumPy arrays; `jax.numpy` has one of the same name
    infix: str  # operator between two operands in Python and C; empty if there is none
    traits: frozenset[str]

    def __new__(  # noqa: D102
        cls, name: str, numpy: Any = None, infix: str = "", traits: str = ""
    ):
        member = str.__new__(cls, name)
        member._value_ = name
        member.numpy = numpy
        member.infix = infix
        member.traits = frozenset(traits.split())
        return member

    INPUT = "input", None
    ADD = "add", np.add, "+"
    SUBTRACT = "sub", np.subtract, "-"
    MULTIPLY = "mul", np.multiply, "*"
    DIVIDE = "div", np.divide, "/"
    NEGATE = "neg", np.negative
    MAXIMUM = "max", np.maximum, "", "choice commutative"
    MINIMUM = "min", np.minimum, "", "choice commutative"
    LESS = "lt", np.less, "<", "truth"
    LESS_EQUAL = "le", np.less_equal, "<=", "truth"
    EQUAL = "eq", np.equal, "==", "truth commutative"
    NOT_EQUAL = "ne", np.not_equal, "!=", "truth commutative"
    AND = "and", np.logical_and, "&", "truth commutative"
    OR = "or", np.logical_or, "|", "truth commutative"
    NOT = "not", np.logical_not, "", "truth"
    SELECT = "select", np.where, "", "choice"
    ABSOLUTE = "abs", np.absolute, "", "choice even"
    SIGN = "sign", np.sign, "", "choice odd"
    POWER = "pow", np.power, "", "function"
    SINE = "sin", np.sin, "", "function odd"
    COSINE = "cos", np.cos, "", "function even"
    TANGENT = "tan", np.tan, "", "function odd"
    ARC_SINE = "asin", np.arcsin, "", "function odd"
    ARC_COSINE = "acos", np.arccos, "", "function"
    ARC_TANGENT = "atan", np.arctan, "", "function odd"
    ARC_TANGENT_2 = "atan2", np.arctan2, "", "function"
    HYPERBOLIC_SINE = "sinh", np.sinh, "", "function odd"
    HYPERBOLIC_COSINE = "cosh", np.cosh, "", "function even"
    HYPERBOLIC_TANGENT = "tanh", np.tanh, "", "function odd"
    SQUARE_ROOT = "sqrt", np.sqrt, "", "function"
    CUBE_ROOT = "cbrt", np.cbrt, "", "function odd"
    EXPONENTIAL = "exp", np.exp, "", "function"
    LOGARITHM = "log", np.log, "", "function"
    EXPONENTIAL_MINUS_ONE = "expm1", np.expm1, "", "function"
    LOGARITHM_OF_ONE_PLUS = "log1p", np.log1p, "", "function"

    def on_constants(self, *operands: float | bool) -> float | bool:
        """Compute the operation on numbers as IEEE 754 does (1/0 is infinite)."""
        with np.errstate(all="ignore"):
            return self.numpy(*operands).item()

    def spell(
        self,
        operands: Sequence[str],
        formats: Mapping["Operation", str],
        suffix: str = "",
    ) -> str:
        """Write the operation as an expression of a programming language."""
        if self.infix:
            return f" {self.infix} ".join(operands)
        if self in formats:
            return formats[self].format(*operands)
        return f"{self.value}{suffix}({', '.join(operands)})"


class Graph:
    """Expressions of one trace, without repetitions; new ones get its label."""

    __slots__ = ("_table", "label")

    def __init__(self):
        self._table = {}
        self.label = ""

    def node(self, operation: Operation, *operands: object) -> "Scalar":
        """Return the expression, numbered in order when it is first needed."""
        key = (operation, *operands)
        scalar = self._table.get(key)
        if scalar is None:
            scalar = Scalar(self, operation, operands, len(self._table))
            self._table[key] = scalar
        return scalar


class Scalar:
    """A scalar operation in a `Graph`; equal ones are identical."""

    __slots__ = ("graph", "index", "label", "operands", "operation")

    def __init__(self, graph: Graph, operation: Operation, operands: tuple, index: int):
        self.graph = graph
        self.operation = operation
        self.operands = operands
        self.index = index
        self.label = graph.label

    def __repr__(self):
        return f"<{self.operation} {self.index}>"


Operand = Scalar | float | bool


@overload
def _magnitude(x: Scalar) -> tuple[bool, Scalar]: ...
@overload
def _magnitude(x: float | bool) -> tuple[bool, float | bool]: ...
def _magnitude(x: Operand) -> tuple[bool, Operand]:
    """Split x into (is negated, rest)."""
    if isinstance(x, Scalar):
        return (True, x.operands[0]) if x.operation is Operation.NEGATE else (False, x)
    return (True, -x) if x < 0 else (False, x)


def negate(x: Operand) -> Operand:
    """Return -x; two minus signs cancel."""
    if not isinstance(x, Scalar):
        return -x
    if x.operation is Operation.NEGATE:
        return x.operands[0]
    return x.graph.node(Operation.NEGATE, x)


def add(x: Operand, y: Operand) -> Operand:
    """Return x + y, so that x + y, y + x and -(-x - y) are one node."""
    if not isinstance(x, Scalar):
        if not isinstance(y, Scalar):
            return float(x + y)
        x, y = y, x
    if not isinstance(y, Scalar):
        if y == 0:
            return x
        is_negative, x = _magnitude(x)
        constant = -float(y) if is_negative else float(y)
        total = x.graph.node(Operation.ADD, x, constant)
        return negate(total) if is_negative else total
    x_negated, x = _magnitude(x)
    y_negated, y = _magnitude(y)
    if x.index > y.index:
        x, y = y, x
        x_negated, y_negated = y_negated, x_negated
    if x is y:
        if x_negated != y_negated:
            return 0.0
        total = multiply(2.0, x)
    else:
        operation = Operation.ADD if x_negated == y_negated else Operation.SUBTRACT
        total = x.graph.node(operation, x, y)
    return negate(total) if x_negated else total


def multiply(x: Operand, y: Operand) -> Operand:
    """Return x y with the sign in front and constant factors merged into one."""
    if not isinstance(y, Scalar):
        if not isinstance(x, Scalar):
            return float(x * y)
        x, y = y, x
    if not isinstance(x, Scalar) and x == 0:
        return 0.0
    x_negated, x = _magnitude(x)
    y_negated, y = _magnitude(y)
    if not isinstance(x, Scalar):
        product = _scale(float(x), y)
    else:
        if x.index > y.index:
            x, y = y, x
        product = x.graph.node(Operation.MULTIPLY, x, y)
    return product if x_negated == y_negated else negate(product)


def _scale(factor: float, x: Scalar) -> Scalar:
    """Return a positive number times x, merged with a number in x."""
    if factor == 1:
        return x
    if x.operation is Operation.MULTIPLY:
        first_operand, second_operand = x.operands
        if not isinstance(first_operand, Scalar):
            product = factor * first_operand
            if MIN_FACTOR < product < MAX_FACTOR:
                return _scale(product, second_operand)
    return x.graph.node(Operation.MULTIPLY, factor, x)


def divide(x: Operand, y: Operand) -> Operand:
    """Return x / y; a constant divisor becomes a multiplication by its reciprocal."""
    if not isinstance(y, Scalar):
        divisor = float(y)
        if not isinstance(x, Scalar):
            return Operation.DIVIDE.on_constants(float(x), divisor)
        reciprocal = Operation.DIVIDE.on_constants(1.0, divisor)
        if MIN_FACTOR < abs(reciprocal) < MAX_FACTOR:
            return multiply(reciprocal, x)
        return x.graph.node(Operation.DIVIDE, x, divisor)
    if not isinstance(x, Scalar) and x == 0:
        return 0.0
    x_negated, x = _magnitude(x)
    y_negated, y = _magnitude(y)
    numerator = x if isinstance(x, Scalar) else float(x)
    quotient = y.graph.node(Operation.DIVIDE, numerator, y)
    return quotient if x_negated == y_negated else negate(quotient)


def integer_power(x: Operand, exponent: int) -> Operand:
    """Return a whole power of x by repeated squaring."""
    if exponent < 0:
        return divide(1.0, integer_power(x, -exponent))
    power: Operand = 1.0
    square = x
    while exponent:
        if exponent & 1:
            power = multiply(power, square)
        exponent >>= 1
        if exponent:
            square = multiply(square, square)
    return power


def power(x: Operand, y: Operand) -> Operand:
    """Return x^y; small whole exponents and 1/2 need no call of `pow`."""
    if not isinstance(y, Scalar) and isinstance(x, Scalar):
        if float(y).is_integer() and abs(y) <= 16:
            return integer_power(x, int(y))
        if y == 0.5:
            return apply(Operation.SQUARE_ROOT, x)
    return apply(Operation.POWER, x, y)


def select(condition: Operand, if_true: Operand, if_false: Operand) -> Operand:
    """Return `if_true` where the condition holds, else `if_false`."""
    if not isinstance(condition, Scalar):
        return if_true if condition else if_false
    if if_true == if_false:
        return if_true
    if is_truth(if_true):
        true_part = logic(Operation.AND, condition, if_true)
        false_part = logic(Operation.AND, logic(Operation.NOT, condition), if_false)
        return logic(Operation.OR, true_part, false_part)
    return condition.graph.node(Operation.SELECT, condition, if_true, if_false)


def logic(operation: Operation, *operands: Operand) -> Operand:
    """Combine truth values by `AND`, `OR` or `NOT`."""
    if operation is Operation.NOT:
        return apply(operation, *operands)
    # A true constant decides OR, a false one AND; any other constant has no effect.
    decision = operation is Operation.OR
    constants = [bool(x) for x in operands if not isinstance(x, Scalar)]
    if decision in constants:
        return decision
    scalars = [x for x in operands if isinstance(x, Scalar)]
    if len(scalars) == 2 and scalars[0] is not scalars[1]:
        return apply(operation, *scalars)
    return scalars[0] if scalars else not decision


def apply(operation: Operation, *operands: Operand) -> Operand:
    """Apply any other operation; signs leave odd and even functions."""
    constants = [x for x in operands if not isinstance(x, Scalar)]
    if len(constants) == len(operands):
        return operation.on_constants(*constants)
    graph = next(x.graph for x in operands if isinstance(x, Scalar))
    traits = operation.traits
    if traits & {"odd", "even"}:
        is_negative, x = _magnitude(operands[0])
        result = graph.node(operation, x)
        return negate(result) if is_negative and "odd" in traits else result
    if "commutative" in traits:
        operands = tuple(sorted(operands, key=_index))
        is_extremum = operation in (Operation.MAXIMUM, Operation.MINIMUM)
        if is_extremum and operands[0] is operands[1]:
            return operands[0]
    return graph.node(operation, *operands)


def _index(x: Operand) -> int:
    """Return a key that sorts constants first, then expressions by age."""
    return x.index if isinstance(x, Scalar) else -1


def is_truth(x: Operand) -> bool:
    """Return whether x is a truth value, not a number."""
    if not isinstance(x, Scalar):
        return isinstance(x, bool)
    return "truth" in x.operation.traits


def as_number(x: Operand) -> Operand:
    """Return a truth value as 1 or 0, and a number as it is."""
    if not isinstance(x, Scalar):
        return float(x)
    return select(x, 1.0, 0.0) if is_truth(x) else x


def as_truth(x: Operand) -> Operand:
    """Return a number as the truth value `x != 0`, and a truth value as it is."""
    if not isinstance(x, Scalar):
        return bool(x)
    return x if is_truth(x) else apply(Operation.NOT_EQUAL, x, 0.0)


def live_scalars(outputs: Sequence[Operand]) -> list[Scalar]:
    """Return the scalars that the outputs need, each one after its operands."""
    scalars: dict[int, Scalar] = {}
    stack = [x for x in outputs if isinstance(x, Scalar)]
    while stack:
        scalar = stack.pop()
        if scalar.index not in scalars:
            scalars[scalar.index] = scalar
            stack += [x for x in scalar.operands if isinstance(x, Scalar)]
    # Operands are older than what they are used for.
    return [scalars[index] for index in sorted(scalars)]
