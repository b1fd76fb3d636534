"""Expressions of base parameters in letters, `mx2 + l2x*m3 - l2x*mz4/l3z` (Eq. 24).

An expression is a sum of standard parameters; the coefficient of each is a short sum of
products of lengths, or a number where there is no short form.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

Number = Fraction | float


@dataclass(frozen=True)
class Monomial:
    """A number times powers of lengths, such as `2*l2x/l3z`."""

    number: Number
    # names of the lengths and their exponents, which are not zero
    powers: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class Coefficient:
    """A sum of monomials: the factor of one standard parameter."""

    monomials: tuple[Monomial, ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        return tuple(
            dict.fromkeys(name for m in self.monomials for name, _ in m.powers)
        )

    def factored(self) -> tuple[bool, Monomial, tuple[Monomial, ...]]:
        """Return whether it is negative, its common factor, and the remaining sum."""
        numbers = [m.number for m in self.monomials]
        common = Fraction(1)
        if all(isinstance(x, Fraction) for x in numbers):
            fractions = [Fraction(x) for x in numbers]
            common = Fraction(
                math.gcd(*(x.numerator for x in fractions)),
                math.lcm(*(x.denominator for x in fractions)),
            )
        elif len(numbers) == 1:
            common = abs(numbers[0])
        negative = numbers[0] < 0
        exponents = [dict(m.powers) for m in self.monomials]
        least = {s: min(e.get(s, 0) for e in exponents) for s in self.symbols}
        rest = tuple(
            Monomial(
                (-m.number if negative else m.number) / common,
                tuple(
                    (s, e.get(s, 0) - least[s])
                    for s in least
                    if e.get(s, 0) != least[s]
                ),
            )
            for m, e in zip(self.monomials, exponents, strict=True)
        )
        return (
            negative,
            Monomial(common, tuple((s, e) for s, e in least.items() if e)),
            rest,
        )


@dataclass(frozen=True)
class Expression:
    """A base parameter as a combination of standard parameters; `str` makes it readable."""

    # Standard parameters in the order of their columns, with their coefficients. The
    # first one leads the base parameter and has the coefficient 1
    terms: tuple[tuple[str, Coefficient], ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        return tuple(dict.fromkeys(s for _, c in self.terms for s in c.symbols))

    def __str__(self):
        # Parameters that share a factor are put in one bracket, at the place of the
        # first of them.
        groups: dict[tuple, list[tuple[bool, str]]] = {}
        for name, coefficient in self.terms:
            negative, factor, rest = coefficient.factored()
            alone = coefficient.symbols == () and factor.number == 1
            key = (factor, rest, name if alone else "")
            groups.setdefault(key, []).append((negative, name))
        return _sum([_part(factor, rest, g) for (factor, rest, _), g in groups.items()])


def _part(
    factor: Monomial, rest: tuple[Monomial, ...], members: list[tuple[bool, str]]
) -> tuple[bool, str]:
    """Return whether a group of parameters with one factor is negative, and its text."""
    negative = members[0][0]
    names = _sum([(sign != negative, name) for sign, name in members])
    above, below = _factors(factor)
    if len(rest) > 1:
        inner = (
            (m.number < 0, _factors(Monomial(abs(m.number), m.powers))) for m in rest
        )
        above.append(
            f"({_sum([(sign, _product(*factors)) for sign, factors in inner])})"
        )
    return negative, _product(
        [*above, f"({names})" if len(members) > 1 else names], below
    )


def _factors(monomial: Monomial) -> tuple[list[str], list[str]]:
    """Return numerator and denominator; the number must not be negative."""
    above, below = [], []
    if isinstance(monomial.number, Fraction):
        above += (
            [str(monomial.number.numerator)] if monomial.number.numerator != 1 else []
        )
        below += (
            [str(monomial.number.denominator)]
            if monomial.number.denominator != 1
            else []
        )
    else:
        above.append(f"{monomial.number:.6g}")
    for name, exponent in monomial.powers:
        power = name if abs(exponent) == 1 else f"{name}^{abs(exponent)}"
        (above if exponent > 0 else below).append(power)
    return above, below


def _product(above: list[str], below: list[str]) -> str:
    text = "*".join(above) or "1"
    if not below:
        return text
    return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"


def _sum(parts: list[tuple[bool, str]]) -> str:
    text = ""
    for negative, part in parts:
        sign = ("-" if negative else "") if not text else (" - " if negative else " + ")
        text += sign + part
    return text
