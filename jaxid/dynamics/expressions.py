"""Base parameters in letters: `mx2 + l2x*m3 - l2x*mz4/l3z` (Eq. 24).

An expression is a sum of standard parameters; the coefficient of each is a short sum of products of
lengths. What has no short form is a number.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

Number = Fraction | float
Powers = tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Monomial:
    """A number times powers of lengths, such as `2*l2x/l3z`."""

    number: Number
    powers: Powers = ()
    """Names of the lengths and their exponents, which are not zero."""

    def evaluate(self, lengths: Mapping[str, float]) -> float:
        """The value for given lengths [m]."""
        return float(self.number) * math.prod(lengths[name] ** e for name, e in self.powers)


@dataclass(frozen=True)
class Coefficient:
    """A sum of monomials: what one standard parameter is multiplied with."""

    monomials: tuple[Monomial, ...]

    def evaluate(self, lengths: Mapping[str, float]) -> float:
        """The value for given lengths [m]."""
        return sum(m.evaluate(lengths) for m in self.monomials)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        return tuple(dict.fromkeys(name for m in self.monomials for name, _ in m.powers))

    def factored(self) -> tuple[bool, Monomial, tuple[Monomial, ...]]:
        """Whether it is negative, its common factor, and the sum that is left (one monomial: 1)."""
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
                tuple((s, e.get(s, 0) - least[s]) for s in least if e.get(s, 0) != least[s]),
            )
            for m, e in zip(self.monomials, exponents, strict=True)
        )
        return negative, Monomial(common, tuple((s, e) for s, e in least.items() if e)), rest


ONE = Coefficient((Monomial(Fraction(1)),))


@dataclass(frozen=True)
class Expression:
    """A base parameter as a combination of standard parameters; `str` makes it readable.

    Attributes:
        terms: Standard parameters, in the order of their columns, and their coefficients. The
            first one leads the base parameter and has the coefficient 1.
    """

    terms: tuple[tuple[str, Coefficient], ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Names of the lengths that occur."""
        return tuple(dict.fromkeys(s for _, c in self.terms for s in c.symbols))

    def evaluate(self, lengths: Mapping[str, float]) -> dict[str, float]:
        """The coefficient of each standard parameter for given lengths [m]."""
        return {name: c.evaluate(lengths) for name, c in self.terms}

    def __str__(self):
        return _written(self, _Plain())

    def latex(self) -> str:
        r"""The expression for a formula, such as `m_{1} - \frac{1}{l_{3z}}\, mz_{4}`."""
        return _written(self, _Latex())


class _Plain:
    """How the pieces are put down in plain text."""

    def name(self, name: str) -> str:
        return name

    def power(self, base: str, exponent: int) -> str:
        return base if exponent == 1 else f"{base}^{exponent}"

    def product(self, above: list[str], below: list[str], last: str) -> str:
        above = [x for x in (*above, last) if x]
        text = "*".join(above) if above else "1"
        if not below:
            return text
        return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"

    def bracket(self, text: str) -> str:
        return f"({text})"

    def number(self, x: float) -> str:
        return f"{x:.6g}"


class _Latex(_Plain):
    """How the pieces are put down in LaTeX."""

    def name(self, name: str) -> str:
        moment = re.fullmatch(r"m([xyz])(\d+)", name)
        if moment:
            return rf"m_{{{moment[2]}}} r_{{c,{moment[2]}{moment[1]}}}"
        parts = re.fullmatch(r"([A-Za-z])([A-Za-z]*)(\d[\w]*)?", name)
        if not parts:
            return rf"\mathrm{{{name}}}".replace("_", r"\_")
        below = (parts[2] + (parts[3] or "")).replace("_", ",")
        return f"{parts[1]}_{{{below}}}" if below else parts[1]

    def power(self, base: str, exponent: int) -> str:
        return base if exponent == 1 else f"{base}^{{{exponent}}}"

    def product(self, above: list[str], below: list[str], last: str) -> str:
        text = " ".join(above)
        if below:
            text = rf"\frac{{{text or '1'}}}{{{' '.join(below)}}}"
        return r"\, ".join(x for x in (text, last) if x) or "1"

    def bracket(self, text: str) -> str:
        return rf"\left({text}\right)"

    def number(self, x: float) -> str:
        mantissa, _, exponent = f"{x:.6g}".partition("e")
        return rf"{mantissa} \cdot 10^{{{int(exponent)}}}" if exponent else mantissa


def _factors(monomial: Monomial, style: _Plain) -> tuple[list[str], list[str]]:
    """What stands above and below the fraction bar; the number must not be negative."""
    above, below = [], []
    if isinstance(monomial.number, Fraction):
        above += [str(monomial.number.numerator)] if monomial.number.numerator != 1 else []
        below += [str(monomial.number.denominator)] if monomial.number.denominator != 1 else []
    else:
        above.append(style.number(monomial.number))
    for name, exponent in monomial.powers:
        side = above if exponent > 0 else below
        side.append(style.power(style.name(name), abs(exponent)))
    return above, below


def _sum(parts: list[tuple[bool, str]]) -> str:
    text = ""
    for negative, part in parts:
        sign = ("-" if negative else "") if not text else (" - " if negative else " + ")
        text += sign + part
    return text


def _written(expression: Expression, style: _Plain) -> str:
    # Parameters that share a factor stand in one bracket, where the first of them would stand.
    groups: dict[tuple, tuple[Monomial, tuple[Monomial, ...], list[tuple[bool, str]]]] = {}
    for name, coefficient in expression.terms:
        negative, factor, rest = coefficient.factored()
        alone = coefficient.symbols == () and factor.number == 1
        key = (name,) if alone else (factor, rest)
        groups.setdefault(key, (factor, rest, []))[2].append((negative, style.name(name)))
    return _sum([_part(*group, style) for group in groups.values()])


def _part(
    factor: Monomial, rest: tuple[Monomial, ...], members: list[tuple[bool, str]], style: _Plain
) -> tuple[bool, str]:
    """Whether a group of parameters with one factor stands with a minus, and its text."""
    negative = members[0][0]
    names = _sum([(sign != negative, name) for sign, name in members])
    above, below = _factors(factor, style)
    if len(rest) > 1:
        inner = [(m.number < 0, Monomial(abs(m.number), m.powers)) for m in rest]
        text = _sum([(sign, style.product(*_factors(m, style), "")) for sign, m in inner])
        above.append(style.bracket(text))
    return negative, style.product(
        above, below, style.bracket(names) if len(members) > 1 else names
    )
