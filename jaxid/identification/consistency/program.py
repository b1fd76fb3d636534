r"""Least squares over the parameters of bodies that can exist, as a small convex program.

The variables are those of the bodies, equally many for each, then those of the drives.
Bodies are measured in their largest masses and the radii of their spheres, drives in
their largest values: all variables lie between -1 and 1. Distances to an optimum are
then bounded, and units do not matter.
"""

from types import ModuleType
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy.sparse.csgraph import connected_components

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.robot.inertia import AXES

from .bounds_and_priors import BodyBounds
from .pseudo_inertia import BASIS, Values, ball, inertial_parameters

Number = Float[AnyArray, "*batch"] | np.floating
"""One number of a problem, or one for each of a batch."""


class Coupling(NamedTuple):
    """Parameters of coupled drives that form one positive semidefinite matrix.

    `basis` holds the matrices of unit parameters [columns, axes, axes], and `diagonal`
    for each axis the parameter on the matrix's diagonal.
    """

    columns: tuple[int, ...]
    basis: np.ndarray
    diagonal: tuple[int, ...]


class ScaledRows(NamedTuple):
    r"""Rows $|A p - b|^2$ of all standard parameters, in units of the noise.

    `scale` is half the number of rows: about half the squared residuals at the optimum.
    """

    A: Values
    b: Values
    scale: Values


class FeasibleSet(NamedTuple):
    """Feasible parameters: consistent bodies, dissipative friction, nonnegative rotor inertias."""

    bodies: tuple[tuple[int, ...], ...]  # columns of each body's parameters
    drives: tuple[int, ...]  # columns that are nonnegative
    free: tuple[int, ...]  # columns without bounds
    bounds: BodyBounds
    floors: np.ndarray  # pseudo-inertias that those of the bodies exceed
    couplings: tuple[Coupling, ...]

    @property
    def width(self) -> int:
        """Number of parameters of each body."""
        return len(self.bodies[0])

    @property
    def body_scales(self) -> np.ndarray:
        """Largest mass of each body, and its products with the radius and the squared radius."""
        mass, L = self.bounds.mass_max, self.bounds.radius
        powers = np.array([0, 1, 1, 1, *[2] * 6])[: self.width]
        return mass[:, None] * L[:, None] ** powers

    @property
    def order(self) -> list[int]:
        """Columns in the order of the scaled variables."""
        return [*(k for body in self.bodies for k in body), *self.drives]

    def drive_places(self, columns: tuple[int, ...]) -> np.ndarray:
        """Return the positions of some columns among those of the drives."""
        return np.array([self.drives.index(k) for k in columns], int)

    def scales(self, xp: ModuleType, data: ScaledRows) -> Values:
        """Return the units of the scaled variables: zero for drives without effect."""
        norms = xp.linalg.norm(data.A[:, np.array(self.drives, int)], axis=0)
        has_effect = norms > 1e-9 * xp.max(norms, initial=0.0)
        # Upper bound: ten times the parameter that alone would produce all measured
        # forces.
        largest = 10.0 * xp.linalg.norm(data.b) / xp.where(has_effect, norms, 1.0)
        largest = xp.where(has_effect, largest, 0.0)
        for coupling in self.couplings:
            # A matrix with a zero on its diagonal is never definite: take the others'
            # bound there.
            places = self.drive_places(coupling.columns)
            most = xp.max(largest[places])
            here = np.isin(np.arange(len(self.drives)), places)
            largest = xp.where(
                here & (largest <= 0.0), xp.maximum(most, 1e-12), largest
            )
        return xp.concatenate([self.body_scales.ravel(), largest])

    def standard_parameters(
        self, xp: ModuleType, data: ScaledRows, y: Values
    ) -> Values:
        """Return the standard parameters of scaled variables; columns without bounds are solved."""
        p = y * self.scales(xp, data)
        if self.free:
            F, inverse = self.free_columns(xp, data.A)
            rest = data.b - data.A[:, np.array(self.order)] @ p
            p = xp.concatenate([p, inverse @ (F.T @ rest)])
        return p[np.argsort([*self.order, *self.free])]

    def free_columns(self, xp: ModuleType, A: Values) -> tuple[Values, Values]:
        """Return the columns without bounds, and the inverse of their Gram matrix."""
        F = A[:, np.array(self.free, int)]
        norms = xp.linalg.norm(F, axis=0)
        unit = 1.0 / xp.where(norms > 0, norms, 1.0)
        gram = (unit[:, None] * (F.T @ F)) * unit[None]
        inverse = xp.linalg.inv(gram + 1e-13 * np.eye(len(self.free)))
        return F, unit[:, None] * inverse * unit[None]

    def linear_bounds(self) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return names, coefficients and constants of the bodies' linear bounds, scaled.

        A bound holds where coefficients times a body's scaled variables plus constant
        is positive.
        """
        bounds, w, K = self.bounds, self.width, len(self.bodies)
        mass, L = bounds.mass_max, bounds.radius
        upper, sphere = np.zeros((2, K, w))
        upper[:, 0], sphere[:, 0], sphere[:, 4:7] = -1.0, 1.0, -0.5
        found = [("largest mass", upper, np.ones(K)), ("sphere", sphere, np.zeros(K))]
        if np.any(bounds.mass_min):
            found.append(("smallest mass", -upper, -bounds.mass_min / mass))
        sides = (("lower", 1.0, bounds.centre_min), ("upper", -1.0, bounds.centre_max))
        for side, sign, corner in sides:
            for axis in range(3):
                known = np.isfinite(corner[:, axis])
                if known.any():
                    row = np.zeros((K, w))
                    row[known, 1 + axis] = sign
                    row[known, 0] = -sign * corner[known, axis] / L[known]
                    name = f"{side} {AXES[axis]} of the centre of mass"
                    found.append((name, row, np.where(known, 0.0, 1.0)))
        names, rows, offsets = zip(*found, strict=True)
        return list(names), np.stack(rows, axis=1), np.stack(offsets, axis=1)


def feasible_set(model: Model, bounds: BodyBounds, margin: float = 0.0) -> FeasibleSet:
    """Return the feasible parameters of a model; bodies contain a fraction of nominal balls."""
    robot = model.robot
    sizes = [len(term.parameters(robot)) for term in model.terms]
    starts = np.cumsum([0, *sizes[:-1]])
    widths = [term.body_parameters for term in model.terms]
    if not any(widths):
        raise InputError(
            "the model has no bodies to make consistent: add `RigidBodies()`."
        )
    if len(bounds.radius) != robot.joints:
        raise InputError(
            f"`bounds` must be those of the {robot.joints} bodies of the robot."
        )
    lower = np.concatenate([term.lower_bounds(robot) for term in model.terms])
    first = next(k for k, width in enumerate(widths) if width)
    columns = starts[first] + np.arange(sizes[first]).reshape(
        robot.joints, widths[first]
    )
    others = np.setdiff1d(np.arange(model.size), columns)
    return FeasibleSet(
        bodies=tuple(tuple(row) for row in columns.tolist()),
        drives=tuple(others[lower[others] == 0.0].tolist()),
        free=tuple(others[lower[others] != 0.0].tolist()),
        bounds=bounds,
        floors=margin * nominal_bodies(bounds),
        couplings=_couplings(model),
    )


def nominal_bodies(bounds: BodyBounds) -> np.ndarray:
    """Return the pseudo-inertias of balls of medium size within the bounds."""
    low, high = bounds.mass_min, bounds.mass_max
    mass = np.clip(0.05 * high, low + 0.05 * (high - low), high)
    centre, L = bounds.inner_centres, bounds.radius
    room = np.sqrt(1.0 - np.sum((centre / L[:, None]) ** 2, axis=1))
    return ball(mass, centre, 0.5 * L * room)


def _couplings(model: Model) -> tuple[Coupling, ...]:
    """Return the matrices of inertias, and of viscous friction, of drives that couple axes."""
    robot, found = model.robot, []
    total = np.concatenate(
        [term.drive_matrices(robot) for term in model.terms], axis=-1
    )
    for kind, matrix in zip(("RotorInertia", "ViscousFriction"), total, strict=True):
        count, labels = connected_components((matrix != 0).any(axis=-1), directed=False)
        groups = [np.flatnonzero(labels == k) for k in range(count)]
        for group in (group for group in groups if len(group) > 1):
            if len(group) > 4:
                raise InputError(
                    f"drives may couple 4 axes, but `{robot.name}` has more."
                )
            inside = matrix[np.ix_(group, group)]
            columns = np.flatnonzero(inside.any(axis=(0, 1)))
            alone = [columns[inside[k, k, columns] != 0] for k in range(len(group))]
            if not all(map(len, alone)):
                raise InputError(
                    f"coupled drives need the drives' own columns: add `{kind}()`."
                )
            basis = np.moveaxis(inside[:, :, columns], -1, 0)
            diagonal = tuple(int(own[0]) for own in alone)
            found.append(Coupling(tuple(columns.tolist()), basis, diagonal))
    return tuple(found)


def scaled_rows(xp: ModuleType, base: BaseParameters, R, z, rows) -> ScaledRows:
    """Divide the weighted triangle of so many rows by the standard deviation of its residuals."""
    rest = z[base.size :]
    dof = xp.maximum(xp.asarray(rows - base.size, float), 1.0)
    # Noise below a thousandth of the forces is not credible.
    square = xp.maximum((rest @ rest) / dof, 1e-6 * (z @ z) / (dof + base.size))
    noise = xp.sqrt(xp.where(square > 0, square, 1.0))
    combination = np.zeros((base.size, base.model.size))
    combination[range(base.size), base.indices] = 1.0
    combination[:, list(base.dependent)] = np.asarray(base.kappa)
    return ScaledRows(
        (R @ combination) / noise, z / noise, 0.5 * xp.asarray(rows, float)
    )


class ConeProgram(eqx.Module):
    r"""$\min \frac12 |A y - b|^2$ over bodies, drives and their couplings."""

    A: Float[
        AnyArray, "*batch height variables"
    ]  # columns without bounds are projected out
    b: Float[AnyArray, "*batch height"]
    floors: Float[AnyArray, "*batch bodies 4 4"]  # lower bounds of the pseudo-inertias
    rows: Float[
        AnyArray, "*batch bodies rows width"
    ]  # linear inequalities of each body
    offsets: Float[AnyArray, "*batch bodies rows"]  # and their constants
    # Further positive semidefinite matrices: contributions of the variables that take
    # part in them, unit vectors of these variables, and constants, which are ones where
    # a matrix is smaller than four.
    couplings: Float[AnyArray, "*batch members couplings 4 4"]
    members: Float[AnyArray, "*batch members variables"]
    fillings: Float[AnyArray, "*batch couplings 4 4"]
    equal: Float[
        AnyArray, "*batch equal variables"
    ]  # functions that keep their value at the start
    pull: Number  # strength of the pull towards the prior's bodies; 0 for none
    prior: Float[
        AnyArray, "*batch bodies 4 4"
    ]  # inverses of the prior's pseudo-inertias
    diameters: Float[
        AnyArray, "*batch variables"
    ]  # bounds of distances of feasible values
    scale: Number  # value of the objective that counts as 1
    start: Float[AnyArray, "*batch variables"]  # strictly feasible variables

    @property
    def bodies(self) -> int:
        """Number of bodies."""
        return self.rows.shape[-3]

    @property
    def width(self) -> int:
        """Number of variables of a body."""
        return self.rows.shape[-1]

    @property
    def drives(self) -> int:
        """Number of variables of the drives."""
        return self.A.shape[-1] - self.bodies * self.width

    @property
    def complementarity(self) -> int:
        """Sum of the sizes of all cones."""
        matrices = 4 * (self.bodies + self.fillings.shape[-3])
        return matrices + self.bodies * self.rows.shape[-2] + 2 * self.drives

    def require_interior(self) -> None:
        """Check that the start lies strictly inside all bounds."""
        S, s = self.slacks(np, np.asarray(self.start))
        smallest = np.linalg.eigvalsh(S).min()
        if not (smallest > 0 and s.min() > 0):
            raise InputError(
                "no ball lies within all bounds: widen them, or lower `margin`."
            )

    def slacks(self, xp: ModuleType, y: Values) -> tuple[Values, Values]:
        """Return the semidefinite matrices and the nonnegative functions of variables."""
        S, s = self.linear(xp, y)
        constant = xp.ravel(self.offsets), xp.zeros(self.drives), xp.ones(self.drives)
        return S + xp.concatenate([-self.floors, self.fillings]), s + xp.concatenate(
            constant
        )

    def linear(self, xp: ModuleType, y: Values) -> tuple[Values, Values]:
        """Return the linear parts of `slacks`."""
        count = self.bodies * self.width
        bodies, drives = xp.reshape(y[:count], (self.bodies, self.width)), y[count:]
        flat = BASIS[: self.width].reshape(self.width, 16)
        S = xp.reshape(bodies @ flat, (self.bodies, 4, 4))
        S = xp.concatenate([S, xp.tensordot(self.members @ y, self.couplings, 1)])
        s = xp.einsum("kri,ki->kr", self.rows, bodies)
        return S, xp.concatenate([xp.ravel(s), drives, -drives])

    def adjoint(self, xp: ModuleType, Z: Values, z: Values) -> Values:
        """Apply the transpose of `linear`."""
        flat = BASIS[: self.width].reshape(self.width, 16)
        bodies = xp.reshape(Z[: self.bodies], (self.bodies, 16)) @ flat.T
        count, n = self.bodies * self.rows.shape[-2], self.drives
        linear = xp.reshape(z[:count], (self.bodies, -1))
        bodies = bodies + xp.einsum("kri,kr->ki", self.rows, linear)
        y = xp.concatenate([xp.ravel(bodies), z[count : count + n] - z[count + n :]])
        return y + xp.tensordot(self.couplings, Z[self.bodies :], 3) @ self.members


def cone_program(
    xp, feasible, data: ScaledRows, strength=0.0, prior=None
) -> ConeProgram:
    """Return the convex program of least squares, with a pull towards the bodies of a prior."""
    bounds, units = feasible.bounds, feasible.scales(xp, data)
    K, w, n = len(feasible.bodies), feasible.width, len(feasible.drives)
    _, rows, offsets = feasible.linear_bounds()
    couplings, members, fillings = _coupled(xp, feasible, units[K * w :])
    shrink = np.ones((K, 4))
    shrink[:, :3] = 1.0 / bounds.radius[:, None]
    shrink = shrink[:, :, None] * shrink[:, None, :] / bounds.mass_max[:, None, None]
    A, b = data.A[:, np.array(feasible.order)] * units[None], data.b
    if feasible.free:
        F, inverse = feasible.free_columns(xp, data.A)
        A = A - F @ (inverse @ (F.T @ A))
        b = b - F @ (inverse @ (F.T @ b))
    equal = np.zeros((int(bounds.total_mass is not None), K * w + n))
    if bounds.total_mass is not None:
        equal[0, : K * w : w] = bounds.mass_max / bounds.total_mass
    return ConeProgram(
        A=A,
        b=b,
        floors=feasible.floors * shrink,
        rows=rows,
        offsets=offsets,
        couplings=couplings,
        members=members,
        fillings=fillings,
        equal=equal,
        pull=xp.asarray(float(strength)),
        prior=np.zeros((K, 4, 4)) if prior is None else np.linalg.inv(prior * shrink),
        diameters=np.concatenate(
            [np.tile([1, 2, 2, 2, *[1.0] * 6][:w], K), np.ones(n)]
        ),
        scale=xp.asarray(data.scale) + 4.0 * K * strength,
        start=_start(xp, feasible, A, b, prior),
    )


def _coupled(xp: ModuleType, feasible: FeasibleSet, largest: Values):
    """Return the matrices of ellipsoids and couplings in scaled variables, filled up to size four.

    The units of the drives' variables are `largest`.
    """
    w, bounds, unit_vectors = (
        feasible.width,
        feasible.bounds,
        np.eye(len(feasible.order)),
    )
    # At first no matrix: there may be none.
    matrices, fillings = [np.zeros((len(unit_vectors), 0, 4, 4))], [np.zeros((0, 4, 4))]
    members: set[int] = set()

    def add(places: np.ndarray, basis: Values, filling: np.ndarray) -> None:
        """Add a matrix with the contributions of some variables."""
        matrices.append(xp.tensordot(unit_vectors[:, places], basis, 1)[:, None])
        fillings.append(filling[None])
        members.update(places.tolist())

    for k in np.flatnonzero(bounds.has_ellipsoid):
        # Schur complements whose sum is definite for centres of mass in the ellipsoid.
        L, basis = bounds.radius[k], np.zeros((4, 4, 4))
        basis[0, range(3), range(3)] = (bounds.ellipsoid_axes[k] / L) ** 2
        basis[0, :3, 3] = basis[0, 3, :3] = -bounds.ellipsoid_centre[k] / L
        basis[0, 3, 3] = 1.0
        for axis in range(3):
            basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
        add(k * w + np.arange(4), basis, np.zeros((4, 4)))
    for coupling in feasible.couplings:
        places = feasible.drive_places(coupling.columns)
        size = 1.0 / xp.sqrt(largest[feasible.drive_places(coupling.diagonal)])
        unit = largest[places][:, None, None]
        basis = unit * coupling.basis * size[None, :, None] * size[None, None, :]
        axes = len(coupling.diagonal)
        basis = xp.pad(basis, ((0, 0), (0, 4 - axes), (0, 4 - axes)))
        filling = np.diag([0.0] * axes + [1.0] * (4 - axes))
        add(len(feasible.bodies) * w + places, basis, filling)
    chosen = np.array(sorted(members), int)
    couplings = xp.concatenate(matrices, axis=1)[chosen]
    return couplings, unit_vectors[chosen], np.concatenate(fillings)


def _start(xp: ModuleType, feasible: FeasibleSet, A, b, prior) -> Values:
    """Return balls at inner centres of mass, as heavy as fits the forces, and some friction.

    Where a prior's bodies satisfy all bounds the start lies close to them.
    """
    bounds, w = feasible.bounds, feasible.width
    K, n = len(feasible.bodies), len(feasible.drives)
    most = bounds.mass_max
    centre = bounds.inner_centres / bounds.radius[:, None]
    room = 1.0 - np.sum(centre**2, axis=1)
    unit = ball(np.ones(K), centre, np.sqrt(0.5 * room * 5.0 / 3.0))
    balls = inertial_parameters(unit)[:, :w]
    floor = inertial_parameters(feasible.floors)[:, :w] / feasible.body_scales
    low = np.maximum(bounds.mass_min / most, floor[:, 0])
    if bounds.total_mass is None:
        forces = A @ xp.asarray(np.concatenate([balls.ravel(), np.zeros(n)]))
        fitting = xp.clip((forces @ b) / xp.maximum(forces @ forces, 1e-300), 0.02, 0.5)
    else:
        excess = bounds.total_mass / most.sum() - np.average(low, weights=most)
        fitting = excess / np.average(1.0 - low, weights=most)
    mass = xp.asarray(low) + fitting * xp.asarray(1.0 - low)
    bodies = floor + (mass - floor[:, 0])[:, None] * balls
    if prior is not None and bounds.total_mass is None:
        given = inertial_parameters(prior)[:, :w] / feasible.body_scales
        _, rows, offsets = feasible.linear_bounds()
        inside = (np.einsum("kri,ki->kr", rows, given) + offsets >= 0).all(axis=1)
        inside &= np.linalg.eigvalsh(prior - feasible.floors)[:, 0] >= 0
        share = np.where(inside & ~bounds.has_ellipsoid, 0.98, 0.0)[:, None]
        bodies = (1.0 - share) * bodies + share * given
    drives = np.full(n, 0.02)
    for coupling in feasible.couplings:
        beside = tuple(k for k in coupling.columns if k not in coupling.diagonal)
        drives[feasible.drive_places(beside)] *= 1e-3
    return xp.concatenate([xp.ravel(bodies), xp.asarray(drives)])
