"""Expressions of base parameters as text, `mx3 + 0.0825*(m4 + m5 - mz6)` (Eq. 24).

An expression is the sum of the standard parameters that forces cannot tell apart, each
with the number by which it counts, in SI units.
"""

from collections.abc import Iterable
from typing import NamedTuple

DIGITS = 6
"""Significant digits of a number: lengths of a robot are hardly known to more."""


class Summand(NamedTuple):
    """A standard parameter with its factor."""

    name: str
    factor: float

    @property
    def is_negative(self) -> bool:
        """Whether the parameter is subtracted."""
        return self.factor < 0

    @property
    def size(self) -> str:
        """The factor without its sign, as it is written; empty for 1."""
        text = f"{abs(self.factor):.{DIGITS}g}"
        return "" if text == "1" else text


def write_expression(summands: Iterable[Summand]) -> str:
    """Write a sum; parameters that share a factor follow it in one bracket.

    A bracket is written at the place of the first of its parameters. Those that have
    the factor 1 are written one by one.
    """
    groups: dict[str, list[Summand]] = {}
    for summand in summands:
        key = summand.size or summand.name
        groups.setdefault(key, []).append(summand)
    parts = []
    for members in groups.values():
        parts.append((members[0].is_negative, _write_group(members)))
    return _write_sum(parts)


def _write_group(members: list[Summand]):
    """Write the product of a factor and of a sum whose first sign is a plus."""
    leader = members[0]
    if not leader.size:
        return leader.name
    signs = [x.is_negative != leader.is_negative for x in members]
    names = [x.name for x in members]
    text = _write_sum(zip(signs, names, strict=True))
    return f"{leader.size}*({text})" if len(members) > 1 else f"{leader.size}*{text}"


def _write_sum(parts: Iterable[tuple[bool, str]]):
    """Write a sum of parts, each with whether it is negative."""
    text = "".join(f" {'-' if negative else '+'} {part}" for negative, part in parts)
    # A plus in front is left out, a minus is written without a space.
    return text.removeprefix(" + ") if text.startswith(" + ") else f"-{text[3:]}"
