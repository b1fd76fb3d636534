r"""Closed forms of base parameters: their coefficients in letters, from the geometry (Eq. 24).

The paper calls the symbolic analysis of base parameters manual and thus time-consuming
(Sec. 3). Here every length is varied on its own first, which gives the powers with
which it occurs in a coefficient. The products of such powers that have the right
dimension are then fitted at random geometries, and the result is checked at other
random geometries and at the robot's own.

A length is one component of the offset between two neighbouring bodies: `l3z` is the z
component, in the frame of body 3, from its origin to the origin of the body after it.
Bodies count from 1, the ground is 0; a body with several children has `l3_4z`, `l3_7z`.
Gravity is `g`.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from jaxid.arrays import Float
from jaxid.program import FREE, evaluate, trace
from jaxid.robot.inertia import AXES
from jaxid.robot.robot import Robot
from jaxid.units.dimensions import Dimension, dimension

from .base_parameter_expressions import Coefficient, Expression, Monomial
from .model import Model
from .rank import (
    characteristic_length,
    column_units,
    random_motion,
    regrouping,
    row_units,
)

_POWERS = np.arange(-2, 3)
"""Exponents of a length that are tried."""
_SCALES = np.array([0.55, 0.75, 1.3, 1.7])
"""Factors of a length that is varied alone."""
_FITTED, _CHECKED = 40, 8
"""Numbers of random geometries for fits and for checks."""
_FITS = 1e-9
"""Relative error up to which a closed form fits."""
_SMALL = 1e-7
"""Relative size below which a power or a factor is nothing but rounding."""
_NOTHING = 1e-12
"""Relative size below which a length, gravity or a column counts as zero."""


def closed_forms(
    model: Model,
    independent: tuple[int, ...],
    dependent: tuple[int, ...],
    kappa: Float[np.ndarray, "base dependent"],
) -> tuple[tuple[Expression, ...], dict[str, float]]:
    r"""Return base parameters as combinations of standard ones, and the values of the letters."""
    kappa = np.asarray(kappa, np.float64)
    names, units = model.parameter_names, [dimension(u) for u in model.parameter_units]
    finder = _Finder(model, independent, dependent)
    expressions = []
    for row, first in enumerate(independent):
        terms = [(first, Coefficient((Monomial(Fraction(1)),)))]
        for column, second in enumerate(dependent):
            own, other = units[first], units[second]
            difference = None
            if own is not None and other is not None:
                difference = np.subtract(own, other)
            coefficient = finder.coefficient(
                row, column, difference, kappa[row, column]
            )
            if coefficient is not None:
                terms.append((second, coefficient))
        terms.sort(key=lambda term: term[0])
        expressions.append(Expression(tuple((names[k], c) for k, c in terms)))
    used = {name for e in expressions for name in e.symbols}
    lengths = {x.name: x.value for x in finder.lengths if x.name in used}
    return tuple(expressions), lengths


class _Finder:
    """Values of the matrix at all geometries, from which one coefficient is found at a time."""

    def __init__(
        self, model: Model, independent: tuple[int, ...], dependent: tuple[int, ...]
    ):
        matrix = Regrouping(model, independent, dependent)
        lengths = changing_lengths(model.robot, matrix) if dependent else ()
        rng = np.random.default_rng(3)
        base = draws(matrix, lengths, 1, rng)
        alone = np.repeat(base, len(lengths) * len(_SCALES), axis=0)
        for k in range(len(lengths)):
            alone[k * len(_SCALES) : (k + 1) * len(_SCALES), k] *= _SCALES
        values = np.concatenate(
            [base, alone, draws(matrix, lengths, _FITTED + _CHECKED, rng)]
        )
        found, self.right = matrix(lengths, values)
        found = np.where(np.isfinite(found), found, 0.0)
        self.lengths: tuple[Length, ...] = lengths
        self._units = np.array([matrix.unit(x) for x in lengths])
        self._entry_units = (
            matrix.units[matrix.independent, None] / matrix.units[matrix.dependent]
        )
        self._values = np.array([x.value for x in lengths]) / self._units
        scaled = values / self._units
        fitted, checked = slice(1 + len(alone), -_CHECKED), slice(-_CHECKED, None)
        self._fitted, self._checked = ((scaled[x], found[x]) for x in (fitted, checked))
        # For each length and power its fraction when this length alone varies.
        shares = []
        for k in range(len(lengths)):
            rows = [0, *range(1 + k * len(_SCALES), 1 + (k + 1) * len(_SCALES))]
            powers = scaled[rows, k, None] ** _POWERS
            factors = np.abs(
                np.linalg.solve(powers, found[rows].reshape(len(rows), -1))
            )
            shares.append(
                factors / np.maximum(factors.max(axis=0), np.finfo(float).tiny)
            )
        self._shares = np.array(shares).reshape(
            len(lengths), len(_POWERS), *found.shape[1:]
        )

    def coefficient(
        self, row: int, column: int, difference: np.ndarray | None, value: float
    ) -> Coefficient | None:
        """Return the coefficient of a dependent column in a base parameter; None if it is zero."""
        x, kappa = self._fitted
        y = kappa[:, row, column]
        # A coefficient without a short form is a number.
        whole = (
            Fraction(round(value)) if abs(abs(value) - 1.0) < _FITS else float(value)
        )
        number = Coefficient((Monomial(whole),)) if value else None
        if not self.right or not y.any():
            return number
        powers = self._candidates(row, column, difference)
        if not 0 < len(powers) <= 24:
            return number
        numbers, needed = np.zeros(0), np.zeros(1, bool)
        while not needed.all():
            numbers = np.linalg.lstsq(_products(x, powers), y, rcond=None)[0]
            needed = np.abs(numbers) > _SMALL * np.abs(numbers).max()
            powers = powers[needed]
        if len(powers) > 6:
            return number
        numbers = np.array([float(_simple(factor)) for factor in numbers])
        x, kappa = self._checked
        checks = kappa[:, row, column]
        error = np.abs(_products(x, powers) @ numbers - checks).max()
        unit = self._entry_units[row, column]
        own = float((_products(self._values[None], powers) @ numbers)[0]) * unit
        if error > _FITS * np.abs(checks).max() or abs(own - value) > 1e-6 * max(
            abs(value), unit
        ):
            return number
        return self._written(numbers, powers, unit)

    def _candidates(
        self, row: int, column: int, difference: np.ndarray | None
    ) -> np.ndarray:
        possible = self._shares[:, :, row, column] > _SMALL
        choices = [_POWERS[p] for p in possible]
        if np.prod([len(c) for c in choices], dtype=float) > 20_000:
            return np.zeros((0, len(self.lengths)), int)
        found = list(itertools.product(*choices))
        powers = np.array(found, int).reshape(len(found), len(self.lengths))
        if difference is None:
            return powers
        dimensions = np.array([x.dimension for x in self.lengths], int).reshape(-1, 3)
        return powers[(powers @ dimensions == difference).all(axis=1)]

    def _written(
        self, numbers: np.ndarray, powers: np.ndarray, unit: float
    ) -> Coefficient:
        """Return numbers in the robot's own units in SI units, as simple fractions if they are."""
        monomials = []
        for number, exponents in zip(numbers[::-1], powers[::-1], strict=True):
            symbols = tuple(
                (x.name, int(e))
                for x, e in zip(self.lengths, exponents, strict=True)
                if e
            )
            # With the right dimension the units of lengths and of the entry cancel.
            factor = unit / float(np.prod(self._units ** exponents.astype(float)))
            monomials.append(Monomial(_simple(float(number) * factor), symbols))
        return Coefficient(tuple(monomials))


def _products(x: np.ndarray, powers: np.ndarray) -> np.ndarray:
    return np.prod(x[:, None, :] ** powers.astype(float), axis=-1)


def _simple(number: float) -> Fraction | float:
    nearest = Fraction(number).limit_denominator(12)
    return nearest if nearest and abs(number - float(nearest)) < _FITS else number


@dataclass(frozen=True)
class Length:
    """A number of the geometry that can vary on its own."""

    name: str  # name, such as `l3z`
    value: float  # signed value for the robot [m]; for `g` [m/s²]
    # numbers of the geometry that it sets, each with its multiple of the value
    entries: tuple[tuple[int, float], ...]
    dimension: Dimension  # dimension of a length, or of an acceleration


class Regrouping:
    r"""The matrix $\kappa$ of a fixed choice of columns, as a function of the geometry (Eq. 22).

    It is in the robot's own units (see `column_units`). The geometry is the vector of
    all offsets and of gravity. The regressor is traced once and evaluated at many
    geometries together.
    """

    def __init__(
        self, model: Model, independent: tuple[int, ...], dependent: tuple[int, ...]
    ):
        self.independent, self.dependent = (
            np.array(independent, int),
            np.array(dependent, int),
        )
        robot = model.robot
        self.size = characteristic_length(model)
        self.gravity = float(np.linalg.norm(np.asarray(robot.gravity)))
        offset, gravity = (
            np.array(x, np.float64) for x in (robot.offset, robot.gravity)
        )
        offset[np.abs(offset) < _NOTHING * self.size] = 0.0
        gravity[np.abs(gravity) < _NOTHING * max(self.gravity, _NOTHING)] = 0.0
        self.geometry = np.concatenate([offset.ravel(), gravity])
        self.units = column_units(model)
        self._rows = row_units(model)
        samples = math.ceil(1.5 * model.size / robot.joints) + 2
        motion = random_motion(model, samples, seed=1)
        self._motion = [np.asarray(x).T for x in (motion.q, motion.qd, motion.qdd)]
        varying = np.zeros(len(self.geometry), object)
        varying[self.geometry != 0.0] = FREE
        n = robot.joints

        def columns(q, qd, qdd, x):
            moved = robot.replace(offset=x[: 3 * n].reshape(n, 3), gravity=x[3 * n :])
            return Model(moved, model.terms).columns(q, qd, qdd)

        self._program = trace(columns, (n,), (n,), (n,), varying)

    def unit(self, length: Length) -> float:
        """Return a value of typical size: the robot's size, or gravity."""
        return self.gravity if length.dimension.second else self.size

    def __call__(
        self, lengths: tuple[Length, ...], values: Float[np.ndarray, "cases lengths"]
    ) -> tuple[Float[np.ndarray, "cases base dependent"], bool]:
        """Return the matrix for other lengths, and whether the choice of columns is right at all.

        It is if the dependent columns follow from earlier independent ones, and those
        are independent.
        """
        geometries = np.repeat(self.geometry[None], len(values), axis=0)
        for column, length in enumerate(lengths):
            for entry, factor in length.entries:
                geometries[:, entry] = factor * values[:, column]
        found, right = [], True
        joints, samples = self._motion[0].shape
        for block in np.split(geometries, range(32, len(geometries), 32)):
            motion = [np.tile(x, len(block)) for x in self._motion]
            theta = evaluate(
                self._program, *motion, np.repeat(block.T, samples, axis=1)
            )
            theta = theta * self._rows[:, None, None] * self.units[:, None]
            theta = theta.reshape(joints, -1, len(block), samples).transpose(2, 0, 3, 1)
            for W in theta.reshape(len(block), joints * samples, -1):
                kappa, left, new = regrouping(W, self.independent, self.dependent)
                found.append(kappa)
                right = right and left < _FITS and new.min(initial=1.0) >= _FITS
        return np.array(found), bool(right)


def draws(
    matrix: Regrouping,
    lengths: tuple[Length, ...],
    cases: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "cases lengths"]:
    """Return random values of lengths, all of the robot's size, so that small ones have effect."""
    units = np.array([math.copysign(matrix.unit(x), x.value) for x in lengths])
    return rng.uniform(0.5, 1.5, (cases, len(lengths))) * units


def changing_lengths(robot: Robot, matrix: Regrouping) -> tuple[Length, ...]:
    """Return the lengths that can vary without changing which columns are independent.

    Where single ones cannot, the geometry has a coincidence, such as two equal lengths
    that make axes meet: then those of one offset, equal ones, or all of them vary
    together. Lengths that cannot vary at all get no name.
    """
    rng = np.random.default_rng(2)
    single = named_lengths(robot, matrix)

    def possible(lengths: tuple[Length, ...]) -> bool:
        return matrix(lengths, draws(matrix, lengths, 2, rng))[1]

    if possible(single):
        return single
    free: tuple[Length, ...] = ()
    rigid: list[Length] = []
    for length in single:
        if possible((*free, length)):
            free += (length,)
        elif not length.dimension.second:
            rigid.append(length)
    same: tuple[Callable[[Length], object], ...] = (
        lambda x: x.entries[0][0] // 3,  # lengths of one offset
        lambda x: f"{abs(x.value):.9e}",  # equal ones
        lambda _: 0,
    )
    for key in same:
        for _, members in itertools.groupby(sorted(rigid, key=key), key):
            together = tuple(members)
            if len(together) > 1 and possible((*free, _tied(together, robot))):
                free += (_tied(together, robot),)
                rigid = [x for x in rigid if x not in together]
    return tuple(sorted(free, key=lambda x: x.entries))


def named_lengths(robot: Robot, matrix: Regrouping) -> tuple[Length, ...]:
    """Return every component of an offset that is not zero, and gravity."""
    n = robot.joints
    lengths = []
    for entry in np.flatnonzero(matrix.geometry[: 3 * n]):
        body, axis = divmod(int(entry), 3)
        value = float(matrix.geometry[entry])
        name = offset_name(robot, body) + AXES[axis]
        lengths.append(Length(name, value, ((int(entry), 1.0),), Dimension(0, 1, 0)))
    if matrix.gravity > 0.0:
        direction = matrix.geometry[3 * n :] / matrix.gravity
        entries = tuple((3 * n + k, float(x)) for k, x in enumerate(direction) if x)
        lengths.append(Length("g", matrix.gravity, entries, Dimension(0, 1, -2)))
    return tuple(lengths)


def offset_name(robot: Robot, body: int) -> str:
    """Return the name of the offset of a body: `l3`, or `l3_5` if body 3 has several children."""
    parent = robot.parent[body]
    alone = robot.parent.count(parent) == 1
    return f"l{parent + 1}" if alone else f"l{parent + 1}_{body + 1}"


def _tied(lengths: tuple[Length, ...], robot: Robot) -> Length:
    """Return several lengths that vary together: a whole offset, or multiples of the first."""
    values = np.array([x.value for x in lengths])
    bodies = {x.entries[0][0] // 3 for x in lengths}
    whole = len(bodies) == 1
    name = offset_name(robot, bodies.pop()) if whole else lengths[0].name
    if whole and len(lengths) == 2:
        name += "".join(x.name[-1] for x in lengths)
    value = float(np.linalg.norm(values)) if whole else lengths[0].value
    entries = tuple(
        (x.entries[0][0], float(v / value))
        for x, v in zip(lengths, values, strict=True)
    )
    return Length(name, value, entries, Dimension(0, 1, 0))
