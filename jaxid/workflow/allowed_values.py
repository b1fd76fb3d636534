"""Values that settings may have; experiment files are checked against them.

The annotation of a setting says which numbers it takes: `Positive`, or
`Annotated[float, Bounds(above=0.0)]`.
"""

import dataclasses
import json
import math
from collections.abc import Collection, Iterable
from operator import ge, gt, le, lt
from typing import Annotated, Any, NamedTuple

from jaxid.errors import InputError


class Bounds(NamedTuple):
    """Range of a number in `Annotated[float, Bounds(above=0.0)]`; None for no bound."""

    above: float | None = None  # exclusive lower bound
    minimum: float | None = None  # inclusive lower bound
    maximum: float | None = None  # inclusive upper bound
    below: float | None = None  # exclusive upper bound

    def check(self, value: float | int, place: str) -> None:
        """Reject a number out of the range, NaN and infinity.

        Args:
            value: The number.
            place: Name of the setting, for the message.
        """
        if not math.isfinite(value):
            raise InputError(f"`{place}` must be finite, but is {value}.")
        rules = (("above", gt), ("at least", ge), ("at most", le), ("below", lt))
        for bound, (words, holds) in zip(self, rules, strict=True):
            if bound is not None and not holds(value, bound):
                raise InputError(
                    f"`{place}` must be {words} {bound:.10g}, but is {value}."
                )


@dataclasses.dataclass(frozen=True, eq=False)
class OneOf:
    """Names that a text may have, given as `Annotated[str, OneOf(CRITERIA)]`."""

    names: Collection[str]

    def check(self, value: str, place: str) -> None:
        """Reject a text that is none of the names."""
        if value not in self.names:
            text = json.dumps(value, ensure_ascii=False)
            raise InputError(f"`{place}` must be {quoted(self.names)}, but is {text}.")


Positive = Annotated[float, Bounds(above=0.0)]
Magnitude = Annotated[float, Bounds(minimum=0.0)]
Fraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Finite = Annotated[float, Bounds()]
Count = Annotated[int, Bounds(minimum=1, maximum=10_000)]
Vector = tuple[Finite, Finite, Finite]
PerJoint = list[float]


def quoted(values: Iterable[Any]) -> str:
    """Return values as a sentence lists them: `"a", "b" or "c"`."""
    words = [f'"{v}"' if isinstance(v, str) else str(v) for v in values]
    return " or ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
