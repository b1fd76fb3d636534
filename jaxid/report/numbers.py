"""Numbers as people read them: as many digits as mean something, points below points."""

import math
from collections.abc import Sequence

MISSING = "–"  # noqa: RUF001
MOST_DECIMALS = 8


def significant(value: float, digits: int = 3) -> str:
    """A number with so many significant digits; a dash for what is not a number."""
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else "-∞")
    value = float(f"{value:.{digits - 1}e}")
    if value == 0:
        return "0"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    if not -3 <= decimals <= MOST_DECIMALS:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(decimals, 0)}f}"


def with_deviation(value: float, deviation: float) -> tuple[str, str]:
    """An estimate and its standard deviation, both to the deviation's second digit."""
    if not (math.isfinite(deviation) and deviation > 0 and math.isfinite(value)):
        return significant(value, 4), significant(deviation, 2)
    decimals = 1 - math.floor(math.log10(float(f"{deviation:.1e}")))
    if decimals > MOST_DECIMALS or decimals < -3:
        return significant(value, 5), significant(deviation, 2)
    decimals = max(decimals, 0)
    return f"{value:.{decimals}f}", f"{deviation:.{decimals}f}"


def percent(share: float, digits: int = 2) -> str:
    """A share of 1 in percent, without the sign; whole numbers above 100."""
    value = 100.0 * share
    if math.isfinite(value) and abs(value) >= 100:
        return f"{value:.0f}" if abs(value) < 1e4 else f"{value:.0e}"
    return significant(value, digits)


def aligned(numbers: Sequence[str]) -> list[str]:
    """The same numbers with blanks behind them, so that right-aligned points stand in a column."""
    tails = [len(s) - s.index(".") if "." in s else 0 for s in numbers]
    widest = max(tails, default=0)
    return [s + " " * (widest - tail) for s, tail in zip(numbers, tails, strict=True)]


def shortened(name: str, longest: int) -> str:
    """A name whose middle is left out if it is too long for its place."""
    if len(name) <= longest:
        return name
    head = (longest - 1) * 2 // 3
    return f"{name[:head]}…{name[head + 1 - longest :]}"
