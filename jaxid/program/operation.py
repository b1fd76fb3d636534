"""The operations of a scalar program, and what each one means on NumPy arrays."""

import enum
from collections.abc import Callable

import numpy as np


class Operation(enum.StrEnum):
    """One scalar operation; where JAX has the same elementwise primitive, the value is its name."""

    INPUT = "input"
    ADD = "add"
    SUBTRACT = "sub"
    MULTIPLY = "mul"
    DIVIDE = "div"
    NEGATE = "neg"
    POWER = "pow"
    ARC_TANGENT_2 = "atan2"
    MAXIMUM = "max"
    MINIMUM = "min"
    LESS = "lt"
    LESS_EQUAL = "le"
    EQUAL = "eq"
    NOT_EQUAL = "ne"
    AND = "and"
    OR = "or"
    NOT = "not"
    SELECT = "select"
    ABSOLUTE = "abs"
    SIGN = "sign"
    SINE = "sin"
    COSINE = "cos"
    TANGENT = "tan"
    ARC_SINE = "asin"
    ARC_COSINE = "acos"
    ARC_TANGENT = "atan"
    HYPERBOLIC_SINE = "sinh"
    HYPERBOLIC_COSINE = "cosh"
    HYPERBOLIC_TANGENT = "tanh"
    SQUARE_ROOT = "sqrt"
    CUBE_ROOT = "cbrt"
    EXPONENTIAL = "exp"
    LOGARITHM = "log"
    EXPONENTIAL_MINUS_ONE = "expm1"
    LOGARITHM_OF_ONE_PLUS = "log1p"


COMPARISONS = frozenset(
    {Operation.LESS, Operation.LESS_EQUAL, Operation.EQUAL, Operation.NOT_EQUAL}
)
LOGIC = frozenset({Operation.AND, Operation.OR, Operation.NOT})
TRUTH_VALUED = COMPARISONS | LOGIC
"""Operations whose result is a truth value, not a number."""

COMMUTATIVE = frozenset(
    {
        Operation.MAXIMUM,
        Operation.MINIMUM,
        Operation.EQUAL,
        Operation.NOT_EQUAL,
        Operation.AND,
        Operation.OR,
    }
)
ODD = frozenset(
    {
        Operation.SIGN,
        Operation.SINE,
        Operation.TANGENT,
        Operation.ARC_SINE,
        Operation.ARC_TANGENT,
        Operation.HYPERBOLIC_SINE,
        Operation.HYPERBOLIC_TANGENT,
        Operation.CUBE_ROOT,
    }
)
EVEN = frozenset({Operation.ABSOLUTE, Operation.COSINE, Operation.HYPERBOLIC_COSINE})

FUNCTIONS = frozenset(
    {
        Operation.POWER,
        Operation.ARC_TANGENT_2,
        Operation.SINE,
        Operation.COSINE,
        Operation.TANGENT,
        Operation.ARC_SINE,
        Operation.ARC_COSINE,
        Operation.ARC_TANGENT,
        Operation.HYPERBOLIC_SINE,
        Operation.HYPERBOLIC_COSINE,
        Operation.HYPERBOLIC_TANGENT,
        Operation.SQUARE_ROOT,
        Operation.CUBE_ROOT,
        Operation.EXPONENTIAL,
        Operation.LOGARITHM,
        Operation.EXPONENTIAL_MINUS_ONE,
        Operation.LOGARITHM_OF_ONE_PLUS,
    }
)
"""Operations that cost like a call of the mathematical library."""

NUMPY: dict[Operation, Callable] = {
    Operation.ADD: np.add,
    Operation.SUBTRACT: np.subtract,
    Operation.MULTIPLY: np.multiply,
    Operation.DIVIDE: np.divide,
    Operation.NEGATE: np.negative,
    Operation.POWER: np.power,
    Operation.ARC_TANGENT_2: np.arctan2,
    Operation.MAXIMUM: np.maximum,
    Operation.MINIMUM: np.minimum,
    Operation.LESS: np.less,
    Operation.LESS_EQUAL: np.less_equal,
    Operation.EQUAL: np.equal,
    Operation.NOT_EQUAL: np.not_equal,
    Operation.AND: np.logical_and,
    Operation.OR: np.logical_or,
    Operation.NOT: np.logical_not,
    Operation.SELECT: np.where,
    Operation.ABSOLUTE: np.abs,
    Operation.SIGN: np.sign,
    Operation.SINE: np.sin,
    Operation.COSINE: np.cos,
    Operation.TANGENT: np.tan,
    Operation.ARC_SINE: np.arcsin,
    Operation.ARC_COSINE: np.arccos,
    Operation.ARC_TANGENT: np.arctan,
    Operation.HYPERBOLIC_SINE: np.sinh,
    Operation.HYPERBOLIC_COSINE: np.cosh,
    Operation.HYPERBOLIC_TANGENT: np.tanh,
    Operation.SQUARE_ROOT: np.sqrt,
    Operation.CUBE_ROOT: np.cbrt,
    Operation.EXPONENTIAL: np.exp,
    Operation.LOGARITHM: np.log,
    Operation.EXPONENTIAL_MINUS_ONE: np.expm1,
    Operation.LOGARITHM_OF_ONE_PLUS: np.log1p,
}


def on_constants(operation: Operation, *operands: float | bool) -> float | bool:
    """Computes one operation on numbers, by the rules of IEEE 754 (1/0 is infinite)."""
    with np.errstate(all="ignore"):
        return NUMPY[operation](*operands).item()
