"""The operations of a scalar program: one row each, for NumPy, JAX, Python and C."""

import enum
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


class Operation(enum.StrEnum):
    """A scalar operation; where JAX has the same elementwise primitive, its name is the value.

    Attributes:
        numpy: Function on NumPy arrays; `jax.numpy` has one of the same name.
        infix: Operator between two operands in Python and C; empty if there is none.
        traits: Properties for simplification and counting: `odd`, `even`, `commutative`, `truth`
            (the result is a truth value), `choice` (a selection), `function` (as expensive as a
            call of the mathematical library).
    """

    numpy: Any
    infix: str
    traits: frozenset[str]

    def __new__(cls, name: str, numpy: Any = None, infix: str = "", traits: str = ""):  # noqa: D102
        member = str.__new__(cls, name)
        member._value_ = name
        member.numpy, member.infix, member.traits = numpy, infix, frozenset(traits.split())
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
        """Compute the operation on numbers by the rules of IEEE 754 (1/0 is infinite)."""
        with np.errstate(all="ignore"):
            return self.numpy(*operands).item()

    def spell(
        self, operands: Sequence[str], formats: Mapping["Operation", str], suffix: str = ""
    ) -> str:
        """Write the operation as an expression of a programming language.

        Args:
            operands: Expressions of the operands.
            formats: Format strings of the operations that the language writes in its own way.
            suffix: Suffix of the names of functions, such as `f` for single precision in C.
        """
        if self.infix:
            return f" {self.infix} ".join(operands)
        if self in formats:
            return formats[self].format(*operands)
        return f"{self.value}{suffix}({', '.join(operands)})"
