"""Expressions of base parameters in letters, `mx2 + l2x*m3 - l2x*mz4/l3z` (Eq. 24).

An expression is a sum of standard parameters; the coefficient of each is a short sum of
products of lengths, or a number where there is no short form.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

Number = Fraction | float


@dataclass(frozen=True)
class Monomial:
    """A number times powers of lengths, such as `2*l2x/l3z`."""

    number: Number
    # names of the lengths and their exponents, which are not zero
    powers: tuple[tuple[str, int], ...] = ()

    def divided_by(self, factor: "Monomial") -> "Monomial":
        """Return the quotient of two monomials."""
        exponents = dict(self.powers)
        for name, exponent in factor.powers:
            exponents[name] = exponents.get(name, 0) - exponent
        powers = tuple((name, e) for name, e in exponents.items() if e)
        return Monomial(self.number / factor.number, powers)

    def quotient(self) -> tuple[list[str], list[str]]:
        """Return the factors of numerator and denominator of a positive monomial."""
        numerator, denominator = [], []
        if isinstance(self.number, float):
            numerator.append(f"{self.number:.6g}")
        else:
            # Factors of one are not written.
            if self.number.numerator != 1:
                numerator.append(str(self.number.numerator))
            if self.number.denominator != 1:
                denominator.append(str(self.number.denominator))
        for name, exponent in self.powers:
            size = abs(exponent)
            power = name if size == 1 else f"{name}^{size}"
            side = numerator if exponent > 0 else denominator
            side.append(power)
        return numerator, denominator


@dataclass(frozen=True)
class Coefficient:
    """A sum of monomials: the factor of one standard parameter."""

    monomials: tuple[Monomial, ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        names = (name for m in self.monomials for name, _ in m.powers)
        return tuple(dict.fromkeys(names))

    @property
    def is_negative(self) -> bool:
        """Whether the first monomial is negative."""
        return self.monomials[0].number < 0

    def common_factor(self) -> Monomial:
        """Return the positive factor that all monomials have in common."""
        exponents = [dict(m.powers) for m in self.monomials]
        min_exponents = {s: min(e.get(s, 0) for e in exponents) for s in self.symbols}
        powers = tuple((name, e) for name, e in min_exponents.items() if e)
        return Monomial(_common_number([m.number for m in self.monomials]), powers)

    def factored(self) -> tuple[Monomial, tuple[Monomial, ...]]:
        """Return the common factor, and the remaining sum, which begins with a plus."""
        factor = self.common_factor()
        sign = -1 if self.is_negative else 1
        divisor = Monomial(sign * factor.number, factor.powers)
        return factor, tuple(m.divided_by(divisor) for m in self.monomials)


def _common_number(numbers: Sequence[Number]) -> Number:
    """Return the largest common divisor of fractions; 1 for several floats."""
    fractions = [x for x in numbers if isinstance(x, Fraction)]
    if len(fractions) == len(numbers):
        numerator = math.gcd(*(x.numerator for x in fractions))
        return Fraction(numerator, math.lcm(*(x.denominator for x in fractions)))
    return abs(numbers[0]) if len(numbers) == 1 else Fraction(1)


@dataclass(frozen=True)
class Expression:
    """A base parameter as a combination of standard parameters."""

    # Standard parameters in the order of their columns, with their coefficients. The
    # first one leads the base parameter and has the coefficient 1
    terms: tuple[tuple[str, Coefficient], ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        return tuple(dict.fromkeys(s for _, c in self.terms for s in c.symbols))

    def __str__(self):
        # Parameters that share a factor are put in one bracket, at the place of the
        # first of them. A parameter without a factor stands alone.
        groups: dict[tuple, list[tuple[bool, str]]] = {}
        for name, coefficient in self.terms:
            factor, remainder = coefficient.factored()
            is_one = not coefficient.symbols and factor.number == 1
            key = (factor, remainder, name if is_one else "")
            groups.setdefault(key, []).append((coefficient.is_negative, name))

        parts = []
        for (factor, remainder, _), members in groups.items():
            is_negative = members[0][0]
            signs = [(sign != is_negative, name) for sign, name in members]
            parts.append((is_negative, _write_product(factor, remainder, signs)))
        return _write_sum(parts)


def _write_product(
    factor: Monomial, remainder: Sequence[Monomial], members: list[tuple[bool, str]]
) -> str:
    """Write a factor times a sum of monomials times a sum of parameters."""
    numerator, denominator = factor.quotient()
    if len(remainder) > 1:
        monomials = []
        for m in remainder:
            size = Monomial(abs(m.number), m.powers)
            monomials.append((m.number < 0, _write_quotient(*size.quotient())))
        numerator.append(f"({_write_sum(monomials)})")
    names = _write_sum(members)
    numerator.append(f"({names})" if len(members) > 1 else names)
    return _write_quotient(numerator, denominator)


def _write_quotient(numerator: list[str], denominator: list[str]) -> str:
    """Write the quotient of two products of factors."""
    text = "*".join(numerator) or "1"
    if not denominator:
        return text
    divisor = "*".join(denominator)
    return f"{text}/({divisor})" if len(denominator) > 1 else f"{text}/{divisor}"


def _write_sum(parts: list[tuple[bool, str]]) -> str:
    """Write a sum of parts, each of them with whether it is negative."""
    text = "".join(f" {'-' if negative else '+'} {part}" for negative, part in parts)
    # A minus in front stands without a space, a plus is left out.
    return text.removeprefix(" + ") if text.startswith(" + ") else f"-{text[3:]}"
