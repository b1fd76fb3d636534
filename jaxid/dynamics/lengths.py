"""The lengths of a robot by name, and its regrouping when they change.

A length is one component of the offset between two neighbouring bodies: `l3z` is the z component,
in the frame of body 3, from its origin to the origin of the body after it. Bodies count from 1, the
ground is 0; a body with several children has `l3_4z`, `l3_7z`. Gravity is `g`.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.dimensions import Dimension
from jaxid.dynamics.model import Model
from jaxid.dynamics.observation import (
    characteristic_length,
    column_units,
    random_motion,
    row_units,
)
from jaxid.dynamics.rank import solve_from_earlier
from jaxid.program import FREE, Program, evaluate, trace
from jaxid.robot.inertia import AXES
from jaxid.robot.robot import Robot

EXPLAINED = 1e-9
_NOTHING = 1e-12
_ROWS_PER_COLUMN = 1.5
_ENTRIES_AT_ONCE = 20_000_000


@dataclass(frozen=True)
class Length:
    """A number of the geometry that can change on its own.

    Attributes:
        name: Such as `l3z`.
        value: Of the robot [m], signed; of `g` [m/s²].
        entries: Which numbers of the geometry it sets, each as a multiple of its value.
        dimension: A length, or an acceleration.
    """

    name: str
    value: float
    entries: tuple[tuple[int, float], ...]
    dimension: Dimension


class Regrouping:
    r"""The matrix $\kappa$ of a fixed choice of columns, as a function of the geometry (Eq. 22).

    It is in the robot's own units (see `column_units`). The geometry is the vector of all offsets
    and of gravity. The regressor is traced once and evaluated at many geometries together.
    """

    def __init__(self, model: Model, independent: tuple[int, ...], dependent: tuple[int, ...]):
        self.independent, self.dependent = np.array(independent, int), np.array(dependent, int)
        robot = model.robot
        self.size = characteristic_length(model)
        self.gravity = float(np.linalg.norm(np.asarray(robot.gravity)))
        offset, gravity = (np.array(x, np.float64) for x in (robot.offset, robot.gravity))
        offset[np.abs(offset) < _NOTHING * self.size] = 0.0
        gravity[np.abs(gravity) < _NOTHING * max(self.gravity, _NOTHING)] = 0.0
        self.geometry = np.concatenate([offset.ravel(), gravity])
        self.units = column_units(model)
        self._rows = row_units(model)
        samples = math.ceil(_ROWS_PER_COLUMN * model.size / robot.joints) + 2
        motion = random_motion(model, samples, seed=1)
        self._motion = [np.asarray(x).T for x in (motion.q, motion.qd, motion.qdd)]
        self._program = _program_of_geometry(model, self.geometry)

    def unit(self, length: Length) -> float:
        """A value of typical size: the robot's size, or gravity."""
        return self.gravity if length.dimension.second else self.size

    def place(
        self, lengths: tuple[Length, ...], values: Float[np.ndarray, "cases lengths"]
    ) -> Float[np.ndarray, "cases geometry"]:
        """Geometries in which some lengths have other values and everything else is the same."""
        geometry = np.repeat(self.geometry[None], len(values), axis=0)
        for column, length in enumerate(lengths):
            for entry, factor in length.entries:
                geometry[:, entry] = factor * values[:, column]
        return geometry

    def __call__(
        self, geometries: Float[np.ndarray, "cases geometry"]
    ) -> tuple[Float[np.ndarray, "cases base dependent"], bool]:
        """The matrix at each geometry, and whether the choice of columns is right at all of them.

        It is if the dependent columns follow from earlier independent ones, and those are
        independent.
        """
        found, right = [], True
        joints, samples = self._motion[0].shape
        columns = len(self.units)
        at_once = max(1, _ENTRIES_AT_ONCE // (joints * samples * columns))
        for start in range(0, len(geometries), at_once):
            block = geometries[start : start + at_once]
            kappa, good = self._solve(self._matrices(block))
            found.append(kappa)
            right = right and good
        return np.concatenate(found), right

    def _matrices(self, geometries):
        cases, samples = len(geometries), self._motion[0].shape[1]
        motion = [np.tile(x, cases) for x in self._motion]
        theta = evaluate(self._program, *motion, np.repeat(geometries.T, samples, axis=1))
        theta = theta * self._rows[:, None, None] * self.units[:, None]
        theta = theta.reshape(*theta.shape[:2], cases, samples)
        return theta.transpose(2, 0, 3, 1).reshape(cases, -1, len(self.units))

    def _solve(self, W):
        norms = np.linalg.norm(W, axis=1)
        live = norms > _NOTHING * norms.max(axis=1, keepdims=True)
        scale = np.where(live, norms, 1.0)
        W = np.where(live[:, None], W / scale[:, None], 0.0)
        W1, W2 = W[..., self.independent], W[..., self.dependent]
        diagonal = np.diagonal(np.linalg.qr(W1, mode="r"), axis1=1, axis2=2)
        if np.abs(diagonal).min(initial=1.0) < EXPLAINED:
            return np.zeros((len(W), len(self.independent), len(self.dependent))), False
        columns = (self.independent, self.dependent)
        kappa = np.array([solve_from_earlier(*x, *columns) for x in zip(W1, W2, strict=True)])
        left = np.linalg.norm(W2 - W1 @ kappa, axis=1).max(initial=0.0)
        kappa = np.where(np.abs(kappa) > EXPLAINED, kappa, 0.0)
        kappa = kappa * scale[:, None, self.dependent] / scale[:, self.independent, None]
        return kappa, bool(left < EXPLAINED)


def _program_of_geometry(model: Model, geometry: np.ndarray) -> Program:
    n = model.robot.joints
    varying = np.zeros(len(geometry), object)
    varying[geometry != 0.0] = FREE

    def columns(q, qd, qdd, x):
        robot = model.robot.replace(offset=x[: 3 * n].reshape(n, 3), gravity=x[3 * n :])
        return Model(robot, model.terms).columns(q, qd, qdd)

    return trace(columns, (n,), (n,), (n,), varying)


def draws(
    regrouping: Regrouping, lengths: tuple[Length, ...], cases: int, rng: np.random.Generator
) -> Float[np.ndarray, "cases lengths"]:
    """Random values of lengths, all of the robot's size: however small one is, it is seen well."""
    units = np.array([math.copysign(regrouping.unit(x), x.value) for x in lengths])
    return rng.uniform(0.5, 1.5, (cases, len(lengths))) * units


def changing_lengths(robot: Robot, regrouping: Regrouping) -> tuple[Length, ...]:
    """The lengths that can change without changing which columns are independent.

    Where single ones cannot, a coincidence of the geometry is at work, such as two equal lengths
    that make axes meet: then those of one offset, equal ones, or all of them change together.
    What can only be as it is gets no name.
    """
    rng = np.random.default_rng(2)
    single = named_lengths(robot, regrouping)

    def possible(lengths: tuple[Length, ...]) -> bool:
        return regrouping(regrouping.place(lengths, draws(regrouping, lengths, 2, rng)))[1]

    if possible(single):
        return single
    free: tuple[Length, ...] = ()
    rigid: list[Length] = []
    for length in single:
        if possible((*free, length)):
            free += (length,)
        elif not length.dimension.second:
            rigid.append(length)
    for tie in (_by_offset, _by_magnitude, _all_of_them):
        for together in tie(rigid):
            if len(together) > 1 and possible((*free, _tied(together, robot))):
                free += (_tied(together, robot),)
                rigid = [x for x in rigid if x not in together]
    return tuple(sorted(free, key=lambda x: x.entries))


def named_lengths(robot: Robot, regrouping: Regrouping) -> tuple[Length, ...]:
    """Every component of an offset that is not zero, and gravity."""
    n = robot.joints
    lengths = []
    for entry in np.flatnonzero(regrouping.geometry[: 3 * n]):
        body, axis = divmod(int(entry), 3)
        value = float(regrouping.geometry[entry])
        name = offset_name(robot, body) + AXES[axis]
        lengths.append(Length(name, value, ((int(entry), 1.0),), Dimension(0, 1, 0)))
    if regrouping.gravity > 0.0:
        direction = regrouping.geometry[3 * n :] / regrouping.gravity
        entries = tuple((3 * n + k, float(x)) for k, x in enumerate(direction) if x)
        lengths.append(Length("g", regrouping.gravity, entries, Dimension(0, 1, -2)))
    return tuple(lengths)


def offset_name(robot: Robot, body: int) -> str:
    """Name of the offset that leads to a body: `l3`, or `l3_5` if body 3 has several children."""
    parent = robot.parent[body]
    alone = robot.parent.count(parent) == 1
    return f"l{parent + 1}" if alone else f"l{parent + 1}_{body + 1}"


def _by_offset(lengths: list[Length]) -> Iterator[tuple[Length, ...]]:
    yield from _groups(lengths, lambda x: x.entries[0][0] // 3)


def _by_magnitude(lengths: list[Length]) -> Iterator[tuple[Length, ...]]:
    yield from _groups(lengths, lambda x: f"{abs(x.value):.9e}")


def _all_of_them(lengths: list[Length]) -> Iterator[tuple[Length, ...]]:
    yield tuple(lengths)


def _groups(lengths: list[Length], key: Callable) -> Iterator[tuple[Length, ...]]:
    for _, members in itertools.groupby(sorted(lengths, key=key), key):
        yield tuple(members)


def _tied(lengths: tuple[Length, ...], robot: Robot) -> Length:
    """Several lengths that change together: a whole offset, or multiples of the first one."""
    values = np.array([x.value for x in lengths])
    bodies = {x.entries[0][0] // 3 for x in lengths}
    whole = len(bodies) == 1
    name = offset_name(robot, bodies.pop()) if whole else lengths[0].name
    if whole and len(lengths) == 2:
        name += "".join(x.name[-1] for x in lengths)
    value = float(np.linalg.norm(values)) if whole else lengths[0].value
    entries = tuple(
        (x.entries[0][0], float(v / value)) for x, v in zip(lengths, values, strict=True)
    )
    return Length(name, value, entries, Dimension(0, 1, 0))
