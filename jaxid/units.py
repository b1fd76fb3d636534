"""Units of the columns of a log, with their factors to SI units; dimensions of parameters."""

import dataclasses
import enum
from typing import NamedTuple

import numpy as np

from jaxid.errors import InputError


class Quantity(enum.Enum):
    """Physical quantity that a unit measures."""

    TIME = "a time"
    COORDINATE = "an angle or a length"
    VELOCITY = "a velocity"
    FORCE = "a torque or a force"
    CURRENT = "a current"


@dataclasses.dataclass(frozen=True)
class Unit:
    """Unit of a measured quantity.

    Define a unit for drive-specific counts: `Unit("count", 2 * pi / 4096,
    Quantity.COORDINATE)` for an encoder, `Unit("permille", 1e-3 * rated,
    Quantity.FORCE)` for thousandths of rated torque.

    Attributes:
        symbol: Symbol, such as `deg`.
        factor: Size in rad, m, rad/s, m/s, N m, N, A or s.
        quantity: Quantity that is measured.
    """

    symbol: str
    factor: float
    quantity: Quantity

    def __post_init__(self) -> None:
        """Refuse factors that cannot be inverted."""
        if not np.isfinite(self.factor) or self.factor == 0:
            raise InputError(
                f"`factor` of `{self.symbol}` must be finite and not zero, but is "
                f"{self.factor}."
            )


S = Unit("s", 1.0, Quantity.TIME)
MS = Unit("ms", 1e-3, Quantity.TIME)
US = Unit("us", 1e-6, Quantity.TIME)
NS = Unit("ns", 1e-9, Quantity.TIME)
RAD = Unit("rad", 1.0, Quantity.COORDINATE)
DEG = Unit("deg", np.pi / 180, Quantity.COORDINATE)
REV = Unit("rev", 2 * np.pi, Quantity.COORDINATE)
M = Unit("m", 1.0, Quantity.COORDINATE)
MM = Unit("mm", 1e-3, Quantity.COORDINATE)
RAD_PER_S = Unit("rad/s", 1.0, Quantity.VELOCITY)
DEG_PER_S = Unit("deg/s", np.pi / 180, Quantity.VELOCITY)
RPM = Unit("rpm", np.pi / 30, Quantity.VELOCITY)
M_PER_S = Unit("m/s", 1.0, Quantity.VELOCITY)
MM_PER_S = Unit("mm/s", 1e-3, Quantity.VELOCITY)
NM = Unit("N m", 1.0, Quantity.FORCE)
N = Unit("N", 1.0, Quantity.FORCE)
A = Unit("A", 1.0, Quantity.CURRENT)
MA = Unit("mA", 1e-3, Quantity.CURRENT)

ALL = tuple(known for known in vars().values() if isinstance(known, Unit))
"""All named units."""


def unit(symbol: str) -> Unit:
    """Return the unit with this symbol: `unit("deg")` is `DEG`.

    Raises:
        InputError: If no unit has this symbol.
    """
    units = {known.symbol: known for known in ALL}
    if symbol not in units:
        raise InputError(
            f"`{symbol}` is no known unit: write one of {', '.join(units)}."
        )
    return units[symbol]


class Dimension(NamedTuple):
    """Exponents of kilogram, metre and second in a unit."""

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
_SUPERSCRIPTS = {"²": 2, "³": 3, "⁴": 4}


def dimension(unit: str) -> Dimension | None:
    """Return the dimension of a unit such as `N m s/rad`, or None if it is not known."""
    total = np.zeros(3, int)
    for position, part in enumerate(unit.split("/")):
        for factor in part.replace("(", " ").replace(")", " ").split():
            power = _SUPERSCRIPTS.get(factor[-1], 1)
            name = factor[:-1] if factor[-1] in _SUPERSCRIPTS else factor
            if name not in _KNOWN:
                return None
            total += (power if position == 0 else -power) * np.array(_KNOWN[name])
    return Dimension(*(int(x) for x in total))


def length_power(unit: str) -> int:
    """Return the power of length in a unit: 2 in kg m² and in N m; 0 if it is not known."""
    found = dimension(unit)
    return 0 if found is None else found.metre
