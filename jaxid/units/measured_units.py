"""Units of the columns of a log, with their factors to SI units."""

import dataclasses
import enum

import numpy as np

from jaxid.errors import InputError


class Quantity(enum.Enum):
    """Physical quantity that a unit measures."""

    TIME = "a time"
    COORDINATE = "an angle or a length"
    VELOCITY = "a velocity"
    FORCE = "a torque or a force"
    CURRENT = "a current"
    SHARE = "a share of a rated value"


@dataclasses.dataclass(frozen=True)
class Unit:
    """Unit of a measured quantity.

    Drives often have units of their own, like the counts of an encoder: `Unit("count",
    2 * pi / 4096, Quantity.COORDINATE)`. `Columns` take the number alone, too.

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
                f"`factor` of `{self.symbol}` must be "
                f"finite and not zero, but is {self.factor}."
            )


S = Unit("s", 1.0, Quantity.TIME)
MS = Unit("ms", 1e-3, Quantity.TIME)
US = Unit("us", 1e-6, Quantity.TIME)
NS = Unit("ns", 1e-9, Quantity.TIME)
DAY = Unit("d", 86400.0, Quantity.TIME)
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
PERCENT = Unit("%", 1e-2, Quantity.SHARE)
PERMILLE = Unit("‰", 1e-3, Quantity.SHARE)

UNITS = {
    unit.symbol: unit
    for unit in (
        *(S, MS, US, NS, DAY),
        *(RAD, DEG, REV, M, MM),
        *(RAD_PER_S, DEG_PER_S, RPM, M_PER_S, MM_PER_S),
        *(NM, N, A, MA, PERCENT, PERMILLE),
    )
}
"""All named units, by their symbols."""


def unit(symbol: str) -> Unit:
    """Return the unit with this symbol: `unit("deg")` is `DEG`.

    Raises:
        InputError: If no unit has this symbol.
    """
    if symbol not in UNITS:
        raise InputError(
            f"`{symbol}` is not a known unit: write one of {', '.join(UNITS)}."
        )
    return UNITS[symbol]
