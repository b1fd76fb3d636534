"""Dimensions of units as they stand beside parameters: `kg m²`, `N m s`, `N/m`."""

from typing import NamedTuple

import numpy as np


class Dimension(NamedTuple):
    """Exponents of kilogram, metre and second."""

    kilogram: int
    metre: int
    second: int


_KNOWN = {
    "1": Dimension(0, 0, 0),
    "rad": Dimension(0, 0, 0),
    "kg": Dimension(1, 0, 0),
    "m": Dimension(0, 1, 0),
    "s": Dimension(0, 0, 1),
    "N": Dimension(1, 1, -2),
    "J": Dimension(1, 2, -2),
    "W": Dimension(1, 2, -3),
}
_POWERS = {"²": 2, "³": 3, "⁴": 4}


def dimension(unit: str) -> Dimension | None:
    """The dimension of a unit such as `N m s/rad`, or None if some part of it is not known."""
    total = np.zeros(3, int)
    for position, part in enumerate(unit.split("/")):
        for factor in part.replace("(", " ").replace(")", " ").split():
            power = _POWERS.get(factor[-1], 1)
            name = factor[:-1] if factor[-1] in _POWERS else factor
            if name not in _KNOWN:
                return None
            total += (power if position == 0 else -power) * np.array(_KNOWN[name])
    return Dimension(*(int(x) for x in total))


def length_power(unit: str) -> int:
    """How many lengths are in a unit: 2 in kg m² and in N m; 0 if the unit is not known."""
    found = dimension(unit)
    return 0 if found is None else found.metre
