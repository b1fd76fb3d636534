r"""Finds the coefficients of base parameters in letters, from how $\kappa$ follows the geometry.

The paper calls the symbolic analysis of base parameters manual and thus time-consuming (Sec. 3).
Here every length is changed on its own first, which tells with which powers it occurs in a
coefficient. The products of such powers that have the right dimension are then fitted at random
geometries, and what fits is checked at other random geometries and at the robot's own.
"""

import itertools
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.dimensions import dimension
from jaxid.dynamics.expressions import ONE, Coefficient, Expression, Monomial
from jaxid.dynamics.lengths import Length, Regrouping, changing_lengths, draws
from jaxid.dynamics.model import Model

MOST_TERMS = 6
LARGEST_DENOMINATOR = 12
_POWERS = np.arange(-2, 3)
_SCALES = np.array([0.55, 0.75, 1.3, 1.7])
_FITTED, _CHECKED = 40, 8
_MOST_CANDIDATES = 24
_FITS = 1e-9
_SMALL = 1e-7


@dataclass(frozen=True)
class ClosedForms:
    """All base parameters in letters.

    Attributes:
        expressions: One for each base parameter.
        lengths: Values of the lengths that occur in them [m]; of `g` [m/s²].
    """

    expressions: tuple[Expression, ...]
    lengths: dict[str, float]


@dataclass(frozen=True)
class _Samples:
    """The matrix at many geometries, with the lengths in their units."""

    lengths: Float[np.ndarray, "cases lengths"]
    kappa: Float[np.ndarray, "cases base dependent"]


def closed_forms(
    model: Model,
    independent: tuple[int, ...],
    dependent: tuple[int, ...],
    kappa: Float[np.ndarray, "base dependent"],
) -> ClosedForms:
    r"""Writes base parameters as combinations of standard parameters with readable coefficients.

    Args:
        model: The model.
        independent: Columns that lead the base parameters.
        dependent: The other columns.
        kappa: Of the robot as it is; what has no short form is taken from here.
    """
    kappa = np.asarray(kappa, np.float64)
    names, units = model.parameter_names, [dimension(u) for u in model.parameter_units]
    finder = _Finder(model, independent, dependent)
    expressions = []
    for row, first in enumerate(independent):
        terms = [(first, ONE)]
        for column, second in enumerate(dependent):
            own, other = units[first], units[second]
            difference = None
            if own is not None and other is not None:
                difference = tuple(a - b for a, b in zip(own, other, strict=True))
            coefficient = finder.coefficient(row, column, difference, kappa[row, column])
            if coefficient is not None:
                terms.append((second, coefficient))
        terms.sort(key=lambda term: term[0])
        expressions.append(Expression(tuple((names[k], c) for k, c in terms)))
    used = {name for e in expressions for name in e.symbols}
    lengths = {x.name: x.value for x in finder.lengths if x.name in used}
    return ClosedForms(tuple(expressions), lengths)


class _Finder:
    """Evaluates the matrix where it is needed, then finds one coefficient at a time."""

    def __init__(self, model: Model, independent: tuple[int, ...], dependent: tuple[int, ...]):
        regrouping = Regrouping(model, independent, dependent)
        lengths = changing_lengths(model.robot, regrouping) if dependent else ()
        rng = np.random.default_rng(3)
        base = draws(regrouping, lengths, 1, rng)
        alone = np.repeat(base, len(lengths) * len(_SCALES), axis=0)
        for k in range(len(lengths)):
            alone[k * len(_SCALES) : (k + 1) * len(_SCALES), k] *= _SCALES
        values = np.concatenate([base, alone, draws(regrouping, lengths, _FITTED + _CHECKED, rng)])
        found, self.right = regrouping(regrouping.place(lengths, values))
        found = np.where(np.isfinite(found), found, 0.0)
        self.lengths: tuple[Length, ...] = lengths
        self._units = np.array([regrouping.unit(x) for x in lengths])
        self._entry_units = (
            regrouping.units[regrouping.independent, None] / regrouping.units[regrouping.dependent]
        )
        self._values = np.array([x.value for x in lengths]) / self._units
        samples = _Samples(values / self._units, found)
        parts = (0, 1 + len(alone), 1 + len(alone) + _FITTED, len(values))
        self._swept, self._fitted, self._checked = (
            _Samples(samples.lengths[a:b], samples.kappa[a:b]) for a, b in itertools.pairwise(parts)
        )
        self._exponents = self._exponents_of_all()

    def _exponents_of_all(self) -> Float[np.ndarray, "lengths powers base dependent"]:
        """For each length and power the share of that power when this length alone changes."""
        kappa, shares = self._swept.kappa, []
        for k in range(len(self.lengths)):
            rows = [0, *range(1 + k * len(_SCALES), 1 + (k + 1) * len(_SCALES))]
            t = self._swept.lengths[rows, k]
            factors = np.linalg.solve(t[:, None] ** _POWERS, kappa[rows].reshape(len(rows), -1))
            factors = np.abs(factors).reshape(len(_POWERS), *kappa.shape[1:])
            shares.append(factors / np.maximum(factors.max(axis=0), np.finfo(float).tiny))
        return np.array(shares).reshape(len(self.lengths), len(_POWERS), *kappa.shape[1:])

    def coefficient(
        self, row: int, column: int, difference: tuple[int, ...] | None, value: float
    ) -> Coefficient | None:
        """The coefficient of one dependent column in one base parameter, or None if it is zero.

        Args:
            row: Of the base parameter.
            column: Of the dependent column.
            difference: Dimension of the coefficient, if it is known.
            value: Of the robot as it is.
        """
        y = self._fitted.kappa[:, row, column]
        number = _number(value)
        if not self.right or not y.any():
            return number
        powers = self._candidates(row, column, difference)
        if not 0 < len(powers) <= _MOST_CANDIDATES:
            return number
        found = _fit(self._fitted.lengths, y, powers)
        if found is None:
            return number
        numbers, powers = found
        checks = self._checked.kappa[:, row, column]
        error = np.abs(_products(self._checked.lengths, powers) @ numbers - checks).max()
        unit = self._entry_units[row, column]
        own = float((_products(self._values[None], powers) @ numbers)[0]) * unit
        if error > _FITS * np.abs(checks).max() or abs(own - value) > 1e-6 * max(abs(value), unit):
            return number
        return self._written(numbers, powers, unit)

    def _candidates(self, row: int, column: int, difference: tuple[int, ...] | None) -> np.ndarray:
        possible = self._exponents[:, :, row, column] > _SMALL
        choices = [_POWERS[p] for p in possible]
        if np.prod([len(c) for c in choices], dtype=float) > 20_000:
            return np.zeros((0, len(self.lengths)), int)
        found = []
        for powers in itertools.product(*choices):
            total = np.zeros(3, int)
            for length, exponent in zip(self.lengths, powers, strict=True):
                total += int(exponent) * np.array(length.dimension)
            if difference is None or tuple(total) == tuple(difference):
                found.append(powers)
        return np.array(found, int).reshape(len(found), len(self.lengths))

    def _written(self, numbers: np.ndarray, powers: np.ndarray, unit: float) -> Coefficient:
        """Numbers of the robot's own units in SI units; simple fractions where they are."""
        monomials = []
        for number, exponents in zip(numbers, powers, strict=True):
            symbols = tuple(
                (x.name, int(e)) for x, e in zip(self.lengths, exponents, strict=True) if e
            )
            # With the right dimension the units of lengths and of the entry cancel.
            factor = unit / float(np.prod(self._units ** exponents.astype(float)))
            monomials.append(Monomial(_simple(float(number) * factor), symbols))
        order = sorted(range(len(monomials)), key=lambda k: tuple(-powers[k]))
        return Coefficient(tuple(monomials[k] for k in order))


def _number(value: float) -> Coefficient | None:
    """What stands for a coefficient without a short form."""
    whole = Fraction(round(value)) if abs(abs(value) - 1.0) < _FITS else float(value)
    return Coefficient((Monomial(whole),)) if value else None


def _fit(x: np.ndarray, y: np.ndarray, powers: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Factors of products of powers, without those that are not needed."""
    factors, needed = np.zeros(0), np.zeros(1, bool)
    while not needed.all():
        factors = np.linalg.lstsq(_products(x, powers), y, rcond=None)[0]
        needed = np.abs(factors) > _SMALL * np.abs(factors).max()
        powers = powers[needed]
    if len(powers) > MOST_TERMS:
        return None
    return np.array([float(_simple(f)) for f in factors]), powers


def _products(x: np.ndarray, powers: np.ndarray) -> np.ndarray:
    return np.prod(x[:, None, :] ** powers.astype(float), axis=-1)


def _simple(number: float) -> Fraction | float:
    nearest = Fraction(number).limit_denominator(LARGEST_DENOMINATOR)
    return nearest if nearest and abs(number - float(nearest)) < _FITS else number
