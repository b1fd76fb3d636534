r"""Closed forms of base parameters: their coefficients in letters (Eq. 24).

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
from .packed_regressor import Columns
from .rank import (
    characteristic_length,
    column_units,
    random_motion,
    regrouping,
    row_units,
)

POWERS = np.arange(-2, 3)
"""Exponents of a length that are tried."""
SCALES = np.array([0.55, 0.75, 1.3, 1.7])
"""Factors of a length that is varied alone."""
FITS = 40
"""Number of random geometries for fits."""
CHECKS = 8
"""Number of other random geometries, for checks."""
GEOMETRIES_AT_ONCE = 32
"""Number of geometries at which the regressor is evaluated together."""
MAX_ERROR = 1e-9
"""Relative error up to which a closed form fits."""
MAX_ERROR_OF_ROBOT = 1e-6
"""The same at the robot's own geometry, whose lengths may be small."""
MIN_SHARE = 1e-7
"""Relative size below which a power or a factor is nothing but rounding."""
ROUNDING = 1e-12
"""Relative size below which a length, gravity or a column counts as zero."""
MAX_PRODUCTS = 20_000
"""Number of products of powers above which none are tried."""
MAX_CANDIDATES = 24
"""Number of products of the right dimension above which none are fitted."""
MAX_MONOMIALS = 6
"""Number of monomials above which a coefficient has no short form."""


def closed_forms(
    model: Model,
    independent: Columns,
    dependent: Columns,
    kappa: Float[np.ndarray, "base dependent"],
) -> tuple[tuple[Expression, ...], dict[str, float]]:
    r"""Return base parameters in letters, and the values of the letters."""
    names = model.parameter_names
    dimensions = [dimension(unit) for unit in model.parameter_units]
    search = CoefficientSearch(model, independent, dependent)
    expressions = []
    for row, leader in enumerate(independent):
        terms = {leader: Coefficient((Monomial(Fraction(1)),))}
        for column, follower in enumerate(dependent):
            value = float(kappa[row, column])
            quotient = _quotient(dimensions[leader], dimensions[follower])
            coefficient = search.coefficient(row, column, quotient, value)
            if coefficient is not None:
                terms[follower] = coefficient
        in_order = ((names[k], terms[k]) for k in sorted(terms))
        expressions.append(Expression(tuple(in_order)))

    symbols = {symbol for expression in expressions for symbol in expression.symbols}
    lengths = {x.name: x.value for x in search.lengths if x.name in symbols}
    return tuple(expressions), lengths


def _quotient(
    numerator: Dimension | None, denominator: Dimension | None
) -> np.ndarray | None:
    """Return the dimension of a quotient; None if one of them is unknown."""
    if numerator is None or denominator is None:
        return None
    return np.subtract(numerator, denominator)


class CoefficientSearch:
    """Search of closed forms, one coefficient at a time, from many geometries."""

    def __init__(self, model: Model, independent: Columns, dependent: Columns):
        matrix = Regrouping(model, independent, dependent)
        lengths = changing_lengths(model.robot, matrix) if dependent else ()
        generator = np.random.default_rng(3)
        start = draws(matrix, lengths, 1, generator)
        variations = _vary_each(start)
        geometries = draws(matrix, lengths, FITS + CHECKS, generator)

        values = np.concatenate([start, variations, geometries])
        kappa, self._is_valid = matrix(lengths, values)
        # Where the columns are wrong, the matrix can be singular.
        kappa = np.where(np.isfinite(kappa), kappa, 0.0)

        self.lengths: tuple[Length, ...] = lengths
        # All lengths are of size one in the robot's own units.
        self._units = np.array([matrix.unit(x) for x in lengths])
        self._robot_lengths = np.array([x.value for x in lengths]) / self._units
        row_unit = matrix.units[matrix.independent]
        self._entry_units = row_unit[:, None] / matrix.units[matrix.dependent]

        relative_values = values / self._units
        fits = slice(1 + len(variations), -CHECKS)
        self._fit_lengths = relative_values[fits]
        self._fit_kappa = kappa[fits]
        self._check_lengths = relative_values[-CHECKS:]
        self._check_kappa = kappa[-CHECKS:]
        self._shares = _shares_of_powers(relative_values, kappa)

    def coefficient(
        self, row: int, column: int, quotient: np.ndarray | None, value: float
    ) -> Coefficient | None:
        """Return the coefficient of a dependent column; None if it is zero.

        Args:
            row: Number of the base parameter.
            column: Number of the dependent column.
            quotient: Dimension of the coefficient; None if it is unknown.
            value: Value for the robot itself.
        """
        if self._is_valid and self._fit_kappa[:, row, column].any():
            powers = self._possible_powers(row, column, quotient)
            if 0 < len(powers) <= MAX_CANDIDATES:
                powers, factors = self._fit(row, column, powers)
                if len(powers) <= MAX_MONOMIALS and self._is_right(
                    row, column, powers, factors, value
                ):
                    return self._in_si_units(
                        powers, factors, self._entry_units[row, column]
                    )
        # A coefficient without a short form is a number.
        if value == 0.0:
            return None
        is_sign = abs(abs(value) - 1.0) < MAX_ERROR
        return Coefficient((Monomial(Fraction(round(value)) if is_sign else value),))

    def _possible_powers(
        self, row: int, column: int, quotient: np.ndarray | None
    ) -> np.ndarray:
        """Return the exponents [products, lengths] of the products that can occur."""
        occurs = self._shares[:, :, row, column] > MIN_SHARE
        exponents = [POWERS[x] for x in occurs]
        count = len(self.lengths)
        if math.prod(len(x) for x in exponents) > MAX_PRODUCTS:
            return np.zeros((0, count), int)
        powers = np.array(list(itertools.product(*exponents)), int).reshape(-1, count)
        if quotient is None:
            return powers
        dimensions = np.array([x.dimension for x in self.lengths], int).reshape(-1, 3)
        fits = (powers @ dimensions == quotient).all(axis=1)
        return powers[fits]

    def _fit(
        self, row: int, column: int, powers: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the products that are needed, and their factors."""
        values = self._fit_kappa[:, row, column]
        # Products that are not needed blur the factors of others: fit again.
        while True:
            products = _products(self._fit_lengths, powers)
            factors = np.linalg.lstsq(products, values, rcond=None)[0]
            counts = np.abs(factors) > MIN_SHARE * np.abs(factors).max()
            powers = powers[counts]
            if counts.all():
                return powers, np.array([float(_simple(x)) for x in factors])

    def _is_right(
        self,
        row: int,
        column: int,
        powers: np.ndarray,
        factors: np.ndarray,
        value: float,
    ) -> bool:
        """Return whether a form holds at other geometries and for the robot."""
        checks = self._check_kappa[:, row, column]
        predictions = _products(self._check_lengths, powers) @ factors
        max_error = np.abs(predictions - checks).max()
        if max_error > MAX_ERROR * np.abs(checks).max():
            return False

        unit = self._entry_units[row, column]
        (prediction,) = _products(self._robot_lengths[None], powers) @ factors
        error = abs(prediction * unit - value)
        return bool(error <= MAX_ERROR_OF_ROBOT * max(abs(value), unit))

    def _in_si_units(
        self, powers: np.ndarray, factors: np.ndarray, unit: float
    ) -> Coefficient:
        """Convert a coefficient from the robot's own units to SI units."""
        monomials = []
        for exponents, factor in zip(powers[::-1], factors[::-1], strict=True):
            symbols = []
            for length, exponent in zip(self.lengths, exponents, strict=True):
                if exponent:
                    symbols.append((length.name, int(exponent)))
            # With the right dimension the units of lengths and of the entry cancel.
            unit_of_lengths = float(np.prod(self._units ** exponents.astype(float)))
            number = _simple(float(factor) * unit / unit_of_lengths)
            monomials.append(Monomial(number, tuple(symbols)))
        return Coefficient(tuple(monomials))


def _vary_each(
    start: Float[np.ndarray, "1 lengths"],
) -> Float[np.ndarray, "cases lengths"]:
    """Return geometries in which one length at a time has other values."""
    count = start.shape[1]
    values = np.repeat(start, count * len(SCALES), axis=0)
    for k in range(count):
        rows = slice(k * len(SCALES), (k + 1) * len(SCALES))
        values[rows, k] *= SCALES
    return values


def _shares_of_powers(
    relative_values: Float[np.ndarray, "cases lengths"],
    kappa: Float[np.ndarray, "cases base dependent"],
) -> Float[np.ndarray, "lengths powers base dependent"]:
    """Return the share of each power of a length that varies alone."""
    count = relative_values.shape[1]
    shares = np.zeros((count, len(POWERS), *kappa.shape[1:]))
    for k in range(count):
        start = 1 + k * len(SCALES)
        rows = [0, *range(start, start + len(SCALES))]
        powers = relative_values[rows, k, None] ** POWERS
        # As many powers as values: they are solved for exactly.
        factors = np.linalg.solve(powers, kappa[rows].reshape(len(rows), -1))
        sizes = np.abs(factors)
        max_size = np.maximum(sizes.max(axis=0), np.finfo(float).tiny)
        shares[k] = (sizes / max_size).reshape(shares.shape[1:])
    return shares


def _products(x: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """Return products of powers of lengths [cases, products]."""
    return np.prod(x[:, None, :] ** powers.astype(float), axis=-1)


def _simple(number: float) -> Fraction | float:
    """Return the fraction with a small denominator that a number is, or the number."""
    fraction = Fraction(number).limit_denominator(12)
    is_fraction = fraction != 0 and abs(number - float(fraction)) < MAX_ERROR
    return fraction if is_fraction else number


@dataclass(frozen=True)
class Length:
    """A number of the geometry that can vary on its own."""

    name: str  # name, such as `l3z`
    value: float  # signed value for the robot [m]; for `g` [m/s²]
    # numbers of the geometry that it sets, each with its multiple of the value
    entries: tuple[tuple[int, float], ...]
    dimension: Dimension  # dimension of a length, or of an acceleration

    @property
    def offset(self) -> int:
        """Number of the body whose offset has the length as a component."""
        return self.entries[0][0] // 3


class Regrouping:
    r"""The matrix $\kappa$ of chosen columns, as a function of the geometry (Eq. 22).

    It is in the robot's own units (see `column_units`). The geometry is the vector of
    all offsets and of gravity. The regressor is traced once and evaluated at many
    geometries together.
    """

    def __init__(self, model: Model, independent: Columns, dependent: Columns):
        robot = model.robot
        self.independent = np.array(independent, int)
        self.dependent = np.array(dependent, int)
        self.size = characteristic_length(model)
        self.gravity = float(np.linalg.norm(np.asarray(robot.gravity)))
        self.units = column_units(model)
        self._rows = row_units(model)

        offset = np.array(robot.offset, np.float64).ravel()
        offset[np.abs(offset) < ROUNDING * self.size] = 0.0
        gravity = np.array(robot.gravity, np.float64)
        gravity[np.abs(gravity) < ROUNDING * max(self.gravity, ROUNDING)] = 0.0
        self.geometry = np.concatenate([offset, gravity])

        samples = math.ceil(1.5 * model.size / robot.joints) + 2
        motion = random_motion(model, samples, seed=1)
        self._motion = [np.asarray(x).T for x in (motion.q, motion.qd, motion.qdd)]
        self._program = self._trace(model)

    def _trace(self, model: Model):
        """Return the regressor's program, with the geometry as an input."""
        n = model.robot.joints
        # What is zero stays zero.
        variables = np.zeros(len(self.geometry), object)
        variables[self.geometry != 0.0] = FREE

        def columns(q, qd, qdd, geometry):
            offset = geometry[: 3 * n].reshape(n, 3)
            robot = model.robot.replace(offset=offset, gravity=geometry[3 * n :])
            return Model(robot, model.terms).columns(q, qd, qdd)

        return trace(columns, (n,), (n,), (n,), variables)

    def unit(self, length: Length) -> float:
        """Return a value of typical size: the robot's size, or gravity."""
        return self.gravity if length.dimension.second else self.size

    def __call__(
        self, lengths: tuple[Length, ...], values: Float[np.ndarray, "cases lengths"]
    ) -> tuple[Float[np.ndarray, "cases base dependent"], bool]:
        """Return the matrix for other lengths, and whether the columns are right.

        It is if the dependent columns follow from earlier independent ones, and those
        are independent.
        """
        geometries = np.repeat(self.geometry[None], len(values), axis=0)
        for column, length in enumerate(lengths):
            for entry, factor in length.entries:
                geometries[:, entry] = factor * values[:, column]

        matrices = []
        is_right = True
        ends = range(GEOMETRIES_AT_ONCE, len(geometries), GEOMETRIES_AT_ONCE)
        for block in np.split(geometries, ends):
            for W in self._regressors(block):
                kappa, unexplained, shares = regrouping(
                    W, self.independent, self.dependent
                )
                matrices.append(kappa)
                is_right &= unexplained < MAX_ERROR
                is_right &= shares.min(initial=1.0) >= MAX_ERROR
        return np.array(matrices), bool(is_right)

    def _regressors(
        self, geometries: Float[np.ndarray, "cases numbers"]
    ) -> Float[np.ndarray, "cases rows standard"]:
        """Return the stacked regressors of several geometries, free of units."""
        cases = len(geometries)
        joints, samples = self._motion[0].shape
        motions = [np.tile(x, cases) for x in self._motion]
        numbers = np.repeat(geometries.T, samples, axis=1)
        theta = evaluate(self._program, *motions, numbers)
        units = self._rows[:, None] * self.units
        theta = theta * units[:, :, None]
        # [joints, columns, cases, samples] -> [cases, joints and samples, columns]
        theta = theta.reshape(joints, -1, cases, samples)
        theta = theta.transpose(2, 0, 3, 1)
        return theta.reshape(cases, joints * samples, -1)


def draws(
    matrix: Regrouping,
    lengths: tuple[Length, ...],
    cases: int,
    generator: np.random.Generator,
) -> Float[np.ndarray, "cases lengths"]:
    """Return random values of lengths, all of the robot's size."""
    units = np.array([math.copysign(matrix.unit(x), x.value) for x in lengths])
    return generator.uniform(0.5, 1.5, (cases, len(lengths))) * units


def changing_lengths(robot: Robot, matrix: Regrouping) -> tuple[Length, ...]:
    """Return the lengths that can vary without changing which columns are independent.

    Some geometries have a coincidence, such as two equal lengths that make axes meet,
    which is lost if one of them varies. Lengths of one offset, equal lengths, or all
    of them then vary together. Lengths that cannot vary at all get no name.
    """
    generator = np.random.default_rng(2)

    def can_vary(lengths: tuple[Length, ...]) -> bool:
        _, is_right = matrix(lengths, draws(matrix, lengths, 2, generator))
        return is_right

    # Usually all components can vary at once; single ones are tried otherwise.
    components = named_lengths(robot, matrix)
    if can_vary(components):
        return components

    variables: tuple[Length, ...] = ()
    constants: list[Length] = []
    for length in components:
        if can_vary((*variables, length)):
            variables += (length,)
        elif not length.dimension.second:
            constants.append(length)

    ties: tuple[Callable[[Length], object], ...] = (
        lambda x: x.offset,
        lambda x: f"{abs(x.value):.9e}",  # equal lengths
        lambda _: 0,  # all of them
    )
    for tie in ties:
        for _, group in itertools.groupby(sorted(constants, key=tie), tie):
            members = tuple(group)
            if len(members) == 1:
                continue
            length = _tied(members, robot)
            if can_vary((*variables, length)):
                variables += (length,)
                constants = [x for x in constants if x not in members]
    return tuple(sorted(variables, key=lambda x: x.entries))


def named_lengths(robot: Robot, matrix: Regrouping) -> tuple[Length, ...]:
    """Return every component of an offset that is not zero, and gravity."""
    offset, gravity = np.split(matrix.geometry, [3 * robot.joints])
    lengths = []
    for entry in np.flatnonzero(offset).tolist():
        body, axis = divmod(entry, 3)
        name = offset_name(robot, body) + AXES[axis]
        value = float(offset[entry])
        lengths.append(Length(name, value, ((entry, 1.0),), Dimension(0, 1, 0)))
    if matrix.gravity > 0.0:
        direction = gravity / matrix.gravity
        axes = np.flatnonzero(direction).tolist()
        entries = tuple((len(offset) + k, float(direction[k])) for k in axes)
        lengths.append(Length("g", matrix.gravity, entries, Dimension(0, 1, -2)))
    return tuple(lengths)


def offset_name(robot: Robot, body: int) -> str:
    """Return the name of a body's offset, such as `l3`, or `l3_5` with siblings."""
    parent = robot.parent[body]
    is_only_child = robot.parent.count(parent) == 1
    return f"l{parent + 1}" if is_only_child else f"l{parent + 1}_{body + 1}"


def _tied(lengths: tuple[Length, ...], robot: Robot) -> Length:
    """Return several lengths as one that varies: an offset, or a multiple."""
    name = lengths[0].name
    value = lengths[0].value
    offsets = {x.offset for x in lengths}
    if len(offsets) == 1:
        name = offset_name(robot, offsets.pop())
        value = math.hypot(*(x.value for x in lengths))
        if len(lengths) == 2:
            name += "".join(x.name[-1] for x in lengths)
    entries = []
    for length in lengths:
        (entry, _), *_ = length.entries
        entries.append((entry, length.value / value))
    return Length(name, value, tuple(entries), Dimension(0, 1, 0))
