"""Values that settings may have, as annotations of the settings.

Experiment files are checked against them: the annotation of a setting says which
numbers or names it takes, as `Positive` or `Annotated[str, OneOf(CRITERIA)]`.
"""

import dataclasses
from collections.abc import Collection
from typing import Annotated, NamedTuple


class Bounds(NamedTuple):
    """Range of a number in `Annotated[float, Bounds(above=0.0)]`; None for no bound."""

    above: float | None = None  # exclusive lower bound
    minimum: float | None = None  # inclusive lower bound
    maximum: float | None = None  # inclusive upper bound
    below: float | None = None  # exclusive upper bound


@dataclasses.dataclass(frozen=True, eq=False)
class OneOf:
    """Names that a text may have, given as `Annotated[str, OneOf(CRITERIA)]`."""

    names: Collection[str]


Positive = Annotated[float, Bounds(above=0.0)]
Magnitude = Annotated[float, Bounds(minimum=0.0)]
Fraction = Annotated[float, Bounds(above=0.0, below=1.0)]
Finite = Annotated[float, Bounds()]
Count = Annotated[int, Bounds(minimum=1, maximum=10_000)]
Vector = tuple[Finite, Finite, Finite]
PerJoint = list[float]
