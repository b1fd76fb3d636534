"""Sine, cosine and tanh in C: no branches, no tables, no library, the same time for any number.

The C compilers' own functions branch on their argument and take several times as long. These work
on short arrays of a fixed length, which compilers turn into vector instructions. A call of a
controller waits for them before it can begin, so that their chains of operations are kept short.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from jaxid.program.operation import Operation
from jaxid.program.program import Program
from jaxid.program.sincos import DOUBLE, SINGLE, Precision

_LN2 = Fraction("0.693147180559945309417232121458176568075500134360255254120680009")
LARGEST_TANH = 22.0
"""Where tanh is 1 to the last bit of a double."""
# Fewer and longer pieces of pi/2 than in JAX, for a shorter chain; angles may be less large.
_PRECISION = {True: Precision(33, 2, 20, DOUBLE.sine, DOUBLE.cosine), False: SINGLE}
SINE_COSINE, TANH = "sine_cosine", "tanh"
KINDS = {
    SINE_COSINE: (Operation.SINE, Operation.COSINE),
    TANH: (Operation.HYPERBOLIC_TANGENT,),
}
"""What each function computes for many numbers at once, by the end of its name."""


@dataclass(frozen=True)
class Library:
    """C functions for many sines, cosines and tanh at once, for some programs."""

    prefix: str
    """Of the functions' names."""
    double: bool
    """Whether numbers are of `double`; of `float` otherwise."""
    widths: tuple[tuple[str, int], ...]
    """Length of the arrays of each function that the programs call."""

    @classmethod
    def of(cls, programs: Sequence[Program], prefix: str, *, double: bool) -> "Library":
        """The functions that programs need, for as many numbers as the largest of them has.

        An odd number is rounded up: compilers make vector instructions of even ones. No more than
        that, since what is computed in vain costs time.

        Args:
            programs: That shall call the functions.
            prefix: Of the functions' names.
            double: Whether numbers are of `double`; of `float` otherwise.
        """
        found = []
        for name, kinds in KINDS.items():
            counts = [
                len({node.operands for node in program.nodes if node.operation in kinds})
                for program in programs
            ]
            largest = max(counts, default=0)
            if largest:
                found.append((name, largest + largest % 2))
        return cls(prefix, double, tuple(found))

    @property
    def turns(self) -> float:
        """Angles of more turns than this give NaN."""
        return _PRECISION[self.double].limit / 4

    def width(self, name: str) -> int:
        """Length of the arrays of one of the functions."""
        return dict(self.widths)[name]

    def text(self) -> str:
        """The functions `{prefix}_sine_cosine` and `{prefix}_tanh`, as far as they are needed."""
        write = {SINE_COSINE: _sine_cosine, TANH: _tanh}
        bodies = [write[name](self.prefix, width, self.double) for name, width in self.widths]
        return "\n".join([_head(self.prefix), *bodies]) if bodies else ""


class _Kind:
    """How numbers of one precision are spelled, and what their bits are."""

    def __init__(self, double: bool):
        self.double = double
        self.name = "double" if double else "float"
        self.bits, self.mantissa, self.bias = (64, 52, 1023) if double else (32, 23, 127)
        self.word = f"uint{self.bits}_t"
        # Adding it rounds to a whole number, in the last bits.
        self.magic = self.number(1.5 * 2.0**self.mantissa)

    def number(self, x: float) -> str:
        text = repr(float(x)) if self.double else f"{float(x):.9g}"
        text = text if any(c in text for c in ".en") else f"{text}.0"
        return text if self.double else f"{text}f"

    def polynomial(self, coefficients: tuple[float, ...], powers: Sequence[str]) -> str:
        """By Estrin's scheme, whose chain grows with the logarithm of the degree.

        Args:
            coefficients: Lowest power first.
            powers: Names of x, x^2, x^4, ...
        """
        terms = [self.number(c) for c in coefficients]
        for power in powers:
            pairs = [terms[k : k + 2] for k in range(0, len(terms), 2)]
            terms = [f"({p[0]} + {power} * {p[1]})" if len(p) == 2 else p[0] for p in pairs]
        (whole,) = terms
        return whole


def _head(prefix: str) -> str:
    return f"""/* Numbers that may not be re-ordered, and no excess of precision: see below. */
#if defined __FAST_MATH__ || (defined FLT_EVAL_METHOD && FLT_EVAL_METHOD == 2) \\
    || (defined __FINITE_MATH_ONLY__ && __FINITE_MATH_ONLY__)
#error "compile without -ffast-math, and for x86 with -msse2 -mfpmath=sse"
#endif
#if defined __GNUC__ || defined _MSC_VER
#define {prefix.upper()}_RESTRICT __restrict
#else
#define {prefix.upper()}_RESTRICT
#endif
"""


def _sine_cosine(prefix: str, width: int, double: bool) -> str:
    precision, kind = _PRECISION[double], _Kind(double)
    number, alone = kind.number, f"{prefix.upper()}_RESTRICT "
    *leading, middle, last = precision.pieces
    reduce = "\n".join(f"        r = r - k * {number(p)};" for p in leading)
    largest = sys.float_info.max if double else float(np.finfo(np.float32).max)
    powers = ("z", "z2", "z4")[: 3 if double else 2]
    fourth = f"\n        const {kind.name} z4 = z2 * z2;" if double else ""
    return f"""/* Cosine and sine of each number, by Cody-Waite reduction and polynomials. The
   additions of {kind.magic} round to whole numbers. Beyond {precision.limit:.0f} quarter
   turns the product with the huge number overflows, and infinity times zero is NaN. */
static void {prefix}_sine_cosine(const {kind.name} *{alone}x, {kind.name} *{alone}s,
    {kind.name} *{alone}c)
{{
    int i;
    for (i = 0; i < {width}; ++i) {{
        const {kind.word} top = ({kind.word})1 << {kind.bits - 1};
        const {kind.name} t = x[i] * {number(2 / math.pi)} + {kind.magic};
        const {kind.name} k = t - {kind.magic};
        const {kind.name} far = (k * {number(largest / precision.limit)}) * {number(0.0)};
        {kind.name} r = x[i];
        {kind.word} bits, a, b, swap;
{reduce}
        r = r - (k * {number(middle)} + (k * {number(last)} + far));
        {{
        const {kind.name} z = r * r;
        const {kind.name} z2 = z * z;{fourth}
        const {kind.name} sine = r + (r * z)
            * {kind.polynomial(precision.sine, powers)};
        const {kind.name} cosine = ({number(1.0)} - {number(0.5)} * z) + z2
            * {kind.polynomial(precision.cosine, powers)};
        memcpy(&bits, &t, sizeof bits);
        memcpy(&a, &sine, sizeof a);
        memcpy(&b, &cosine, sizeof b);
        }}
        swap = (a ^ b) & (0u - (bits & 1u));
        a = a ^ swap ^ ((bits << {kind.bits - 2}) & top);
        b = b ^ swap ^ (((bits + 1u) << {kind.bits - 2}) & top);
        memcpy(&s[i], &a, sizeof a);
        memcpy(&c[i], &b, sizeof b);
    }}
}}
"""


def _tanh(prefix: str, width: int, double: bool) -> str:
    kind, alone = _Kind(double), f"{prefix.upper()}_RESTRICT "
    number, one = kind.number, 2 ** (32 if double else 15)
    ln2_high = Fraction(int(_LN2 * one), one)
    ln2_low = _LN2 - ln2_high
    terms = 14 if double else 7
    exponential = tuple(1 / math.factorial(n) for n in range(2, terms + 1))
    powers = ("r", "r2", "r4", "r8")[: 4 if double else 3]
    largest = int(np.array(LARGEST_TANH, np.float64 if double else np.float32).view(kind.word[:-2]))
    eighth = f"\n        const {kind.name} r8 = r4 * r4;" if double else ""
    return f"""/* Hyperbolic tangent of each number: e / (e + 2) with e = exp(2 |x|) - 1.
   The smaller of |x| and {LARGEST_TANH:g} is taken by the sign of their difference: compilers
   make a branch of a choice. */
static void {prefix}_tanh(const {kind.name} *{alone}x, {kind.name} *{alone}y)
{{
    int i;
    for (i = 0; i < {width}; ++i) {{
        const {kind.word} top = ({kind.word})1 << {kind.bits - 1};
        {kind.name} size, rest, v, t, k, p, scale, e;
        {kind.word} bits, sign, far;
        memcpy(&bits, &x[i], sizeof bits);
        sign = bits & top;
        bits = bits & ~top;
        memcpy(&size, &bits, sizeof size);
        rest = {number(LARGEST_TANH)} - size;
        memcpy(&far, &rest, sizeof far);
        far = 0u - (far >> {kind.bits - 1});
        bits = (bits & ~far) | (({kind.word}){largest:#x}u & far);
        memcpy(&size, &bits, sizeof size);
        v = size + size;
        t = v * {number(1 / math.log(2))} + {kind.magic};
        k = t - {kind.magic};
        {{
        const {kind.name} r = (v - k * {number(float(ln2_high))}) - k * {number(float(ln2_low))};
        const {kind.name} r2 = r * r;
        const {kind.name} r4 = r2 * r2;{eighth}
        p = r + r2 * {kind.polynomial(exponential, powers)};
        }}
        memcpy(&bits, &t, sizeof bits);
        bits = (bits + {kind.bias}u) << {kind.mantissa};
        memcpy(&scale, &bits, sizeof scale);
        e = scale * p + (scale - 1);
        e = e / (e + 2);
        memcpy(&bits, &e, sizeof bits);
        bits = bits | sign;
        memcpy(&y[i], &bits, sizeof bits);
    }}
}}
"""
