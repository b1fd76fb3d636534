"""Feasible parameters: possible bodies, friction that brakes, rotors with inertia."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Indices, Matrix, namespace
from jaxid.dynamics.model import Model
from jaxid.errors import InputError

from .bounds_and_priors import BodyBounds
from .pseudo_inertia import Values, ball
from .scaled_rows import ScaledRows

MAX_COUPLED_AXES = 4
"""Axes that drives may couple: all semidefinite matrices have size four."""
MEDIUM_MASS = 0.05
"""Mass of a body of medium size, within the range of its bounds."""
MAX_DRIVE_RATIO = 10.0
"""Bound of a drive's parameter, relative to the one that alone explains all forces."""


class Coupling(NamedTuple):
    """Parameters of coupled drives that form one positive semidefinite matrix."""

    columns: Indices
    basis: np.ndarray  # matrices of unit parameters [columns, axes, axes]
    diagonal: Indices  # parameter on the matrix's diagonal, for each axis


class LinearBounds(NamedTuple):
    """Linear bounds of the bodies, in scaled variables.

    A bound holds where its row times a body's variables plus its offset is positive.
    """

    names: list[str]
    rows: np.ndarray  # [bodies, bounds, width]
    offsets: np.ndarray  # [bodies, bounds]


class FeasibleSet(NamedTuple):
    """Consistent bodies, dissipative friction and nonnegative rotor inertias."""

    bodies: tuple[Indices, ...]  # columns of each body's parameters
    drives: Indices  # columns that are nonnegative
    unbounded: Indices  # columns without bounds
    bounds: BodyBounds
    couplings: tuple[Coupling, ...]

    @property
    def width(self) -> int:
        """Number of parameters of each body."""
        return len(self.bodies[0])

    @property
    def body_scales(self) -> Matrix:
        """Largest mass of each body, times 1, the radius and the squared radius."""
        mass = self.bounds.mass_max[:, None]
        radius = self.bounds.radius[:, None]
        powers = np.array([0, 1, 1, 1, 2, 2, 2, 2, 2, 2])[: self.width]
        return mass * radius**powers

    @property
    def order(self) -> list[int]:
        """Columns in the order of the scaled variables."""
        return [*sum(self.bodies, ()), *self.drives]

    def drive_places(self, columns: Indices) -> np.ndarray:
        """Return the positions of some columns among those of the drives."""
        return np.array([self.drives.index(k) for k in columns], int)

    def scales(self, data: ScaledRows) -> Values:
        """Return the units of the scaled variables: zero for drives without effect."""
        xp = namespace(data.A)
        columns = data.A[:, np.array(self.drives, int)]
        norms = xp.linalg.norm(columns, axis=0)
        # Shorter columns are rounding: a joint that never moved has no friction.
        has_effect = norms > 1e-9 * xp.max(norms, initial=0.0)
        finite_norms = xp.where(has_effect, norms, 1.0)
        max_force = MAX_DRIVE_RATIO * xp.linalg.norm(data.b)
        max_values = xp.where(has_effect, max_force / finite_norms, 0.0)
        for coupling in self.couplings:
            # A matrix with a zero on its diagonal is never definite: take the others'
            # bound there.
            places = self.drive_places(coupling.columns)
            is_coupled = np.isin(np.arange(len(self.drives)), places)
            substitute = xp.maximum(xp.max(max_values[places]), 1e-12)
            is_zero = is_coupled & (max_values <= 0.0)
            max_values = xp.where(is_zero, substitute, max_values)
        return xp.concatenate([self.body_scales.ravel(), max_values])

    def standard_parameters(self, data: ScaledRows, y: Values) -> Values:
        """Return standard parameters of scaled variables; solve unbounded columns."""
        p = y * self.scales(data)
        if self.unbounded:
            columns, inverse = self.unbounded_columns(data)
            rest = data.b - data.A[:, np.array(self.order)] @ p
            solution = inverse @ (columns.T @ rest)
            p = namespace(data.A).concatenate([p, solution])
        return p[np.argsort([*self.order, *self.unbounded])]

    def unbounded_columns(self, data: ScaledRows) -> tuple[Values, Values]:
        """Return the columns without bounds, and the inverse of their Gram matrix."""
        xp = namespace(data.A)
        columns = data.A[:, np.array(self.unbounded, int)]
        norms = xp.linalg.norm(columns, axis=0)
        scale = 1.0 / xp.where(norms > 0, norms, 1.0)
        gram = (scale[:, None] * (columns.T @ columns)) * scale[None]
        # The ridge is rounding: columns may depend on each other.
        inverse = xp.linalg.inv(gram + 1e-13 * np.eye(len(self.unbounded)))
        return columns, scale[:, None] * inverse * scale[None]

    def linear_bounds(self) -> LinearBounds:
        """Return the linear bounds of the bodies, in scaled variables."""
        bounds = self.bounds
        count = len(self.bodies)
        unit = np.eye(self.width)
        mass = np.tile(unit[0], (count, 1))
        # Half the trace of the inertia is the second moment about the origin.
        second_moment = 0.5 * np.sum(unit[4:7], axis=0)
        names = ["largest mass", "sphere"]
        rows = [-mass, mass - second_moment]
        # Scaled masses are at most one; m L² exceeds the second moment in the sphere.
        offsets = [np.ones(count), np.zeros(count)]
        if np.any(bounds.mass_min):
            names.append("smallest mass")
            rows.append(mass)
            offsets.append(-bounds.mass_min / bounds.mass_max)
        return LinearBounds(names, np.stack(rows, axis=1), np.stack(offsets, axis=1))


def feasible_set(model: Model, bounds: BodyBounds) -> FeasibleSet:
    """Return a model's feasible parameters."""
    robot = model.robot
    widths = [term.body_parameters for term in model.terms]
    if not any(widths):
        raise InputError(
            "the model has no bodies to make consistent: add `RigidBodies()`."
        )
    bodies = len(robot.solid_bodies)
    if len(bounds.radius) != bodies:
        raise InputError(f"`bounds` must be those of the {bodies} bodies of the robot.")
    number = next(k for k, width in enumerate(widths) if width)
    sizes = [len(term.parameters(robot)) for term in model.terms]
    start = sum(sizes[:number])
    columns = np.arange(start, start + sizes[number]).reshape(bodies, -1)

    other_columns = np.setdiff1d(np.arange(model.size), columns)
    # Terms tell that parameters cannot be negative by a lower bound of zero.
    lower_bounds = np.concatenate([term.lower_bounds(robot) for term in model.terms])
    is_drive = lower_bounds[other_columns] == 0.0
    return FeasibleSet(
        bodies=tuple(tuple(row) for row in columns.tolist()),
        drives=tuple(other_columns[is_drive].tolist()),
        unbounded=tuple(other_columns[~is_drive].tolist()),
        bounds=bounds,
        couplings=tuple(_couplings(model)),
    )


def nominal_bodies(bounds: BodyBounds) -> np.ndarray:
    """Return the pseudo-inertias of balls of medium size within the bounds."""
    min_mass = bounds.mass_min
    max_mass = bounds.mass_max
    medium_mass = min_mass + MEDIUM_MASS * (max_mass - min_mass)
    mass = np.clip(MEDIUM_MASS * max_mass, medium_mass, max_mass)
    return ball(mass, 0.5 * bounds.radius)


def _couplings(model: Model) -> Iterator[Coupling]:
    """Yield matrices of inertias, and of viscous friction, of coupled drives."""
    robot = model.robot
    matrices = [term.drive_matrices(robot) for term in model.terms]
    inertia, friction = np.concatenate(matrices, axis=-1)
    for kind, matrix in (("RotorInertia", inertia), ("ViscousFriction", friction)):
        count, labels = scipy.sparse.csgraph.connected_components(
            (matrix != 0).any(axis=-1), directed=False
        )
        for label in range(count):
            axes = np.flatnonzero(labels == label)
            if len(axes) > MAX_COUPLED_AXES:
                raise InputError(
                    f"drives may couple at most 4 axes, but `{robot.name}` has more."
                )
            if len(axes) > 1:
                yield _coupling(kind, matrix[np.ix_(axes, axes)])


def _coupling(kind: str, matrix) -> Coupling:
    """Return the coupling of some axes from their matrix [axes, axes, parameters]."""
    columns = np.flatnonzero(matrix.any(axis=(0, 1)))
    diagonal = []
    for axis in range(len(matrix)):
        own_columns = np.flatnonzero(matrix[axis, axis])
        if not len(own_columns):
            raise InputError(
                f"coupled drives need the drives' own columns: add `{kind}()`."
            )
        diagonal.append(int(own_columns[0]))
    basis = np.moveaxis(matrix[:, :, columns], -1, 0)
    return Coupling(tuple(columns.tolist()), basis, tuple(diagonal))
