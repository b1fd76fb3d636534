"""Dimensions of the units of parameters: exponents of kilogram, metre and second."""

from typing import NamedTuple


class Dimension(NamedTuple):
    """Exponents of kilogram, metre and second in a unit."""

    kilogram: int
    metre: int
    second: int


_DIMENSIONS = {
    "1": Dimension(0, 0, 0),
    "rad": Dimension(0, 0, 0),
    "kg": Dimension(1, 0, 0),
    "m": Dimension(0, 1, 0),
    "s": Dimension(0, 0, 1),
    "N": Dimension(1, 1, -2),
    "J": Dimension(1, 2, -2),
    "W": Dimension(1, 2, -3),
}
_EXPONENTS = {"²": 2, "³": 3, "⁴": 4}


def dimension(unit: str) -> Dimension | None:
    """Return the dimension of a unit such as `N m s/rad`; None if it is not known."""
    exponents = [0, 0, 0]
    numerator, *denominators = unit.split("/")
    for part, sign in ((numerator, 1), *((part, -1) for part in denominators)):
        for factor in part.replace("(", " ").replace(")", " ").split():
            symbol = factor.rstrip("".join(_EXPONENTS))
            if symbol not in _DIMENSIONS:
                return None
            power = sign * _EXPONENTS.get(factor[len(symbol) :], 1)
            for k, exponent in enumerate(_DIMENSIONS[symbol]):
                exponents[k] += power * exponent
    return Dimension(*exponents)


def length_power(unit: str) -> int:
    """Return the power of length in a unit: 2 in kg m² and N m; 0 if unknown."""
    unit_dimension = dimension(unit)
    return 0 if unit_dimension is None else unit_dimension.metre
