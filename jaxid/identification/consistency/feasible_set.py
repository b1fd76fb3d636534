"""The feasible set: standard parameters of bodies that can exist and of drives that dissipate."""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.pseudo_inertia import Values, ball
from jaxid.robot.inertia import AXES
from jaxid.robot.robot import Robot

Number = Float[AnyArray, "*batch"] | np.floating
"""One number of a problem, or one for each of a batch."""


class Coupling(eqx.Module):
    """Parameters of coupled drives that form one positive semidefinite matrix.

    Attributes:
        columns: Standard parameters of the matrix.
        basis: Matrices of unit parameters.
        diagonal: For each axis the parameter on the matrix's diagonal.
    """

    columns: tuple[int, ...] = eqx.field(static=True)
    basis: Float[np.ndarray, "members axes axes"]
    diagonal: tuple[int, ...] = eqx.field(static=True)


class FeasibleSet(eqx.Module):
    """Feasible parameters: consistent bodies, dissipative friction, nonnegative rotor inertias.

    Attributes:
        bodies: For each body the columns of its parameters.
        drives: Columns that are nonnegative.
        free: Columns without bounds.
        bounds: Bounds of the bodies.
        floors: Pseudo-inertias that those of the bodies exceed.
        couplings: Matrices of coupled drives.
    """

    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    drives: tuple[int, ...] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    bounds: BodyBounds
    floors: Float[np.ndarray, "bodies 4 4"]
    couplings: tuple[Coupling, ...]

    @property
    def width(self) -> int:
        """Number of parameters of each body."""
        return len(self.bodies[0])

    @property
    def body_scales(self) -> Float[np.ndarray, "bodies width"]:
        """Largest mass of each body, and its products with the radius and the squared radius."""
        mass, L = np.asarray(self.bounds.mass_max), np.asarray(self.bounds.radius)
        powers = np.array([0, 1, 1, 1, *[2] * 6])[: self.width]
        return mass[:, None] * L[:, None] ** powers

    @property
    def order(self) -> list[int]:
        """Columns in the order of the scaled variables."""
        return [*(k for body in self.bodies for k in body), *self.drives]

    def scales(self, xp: ModuleType, A: Values, b: Values) -> Values:
        """Return the units of the scaled variables: zero for drives without effect."""
        norms = xp.linalg.norm(A[:, np.array(self.drives, int)], axis=0)
        has_effect = norms > 1e-9 * xp.max(norms, initial=0.0)
        # Upper bound: ten times the parameter that alone would produce all measured forces.
        largest = 10.0 * xp.linalg.norm(b) / xp.where(has_effect, norms, 1.0)
        largest = xp.where(has_effect, largest, 0.0)
        for coupling in self.couplings:
            # A matrix with a zero on its diagonal is never definite: take the others' bound there.
            places = np.array([self.drives.index(k) for k in coupling.columns])
            most = xp.max(largest[places])
            here = np.isin(np.arange(len(self.drives)), places)
            largest = xp.where(here & (largest <= 0.0), xp.maximum(most, 1e-12), largest)
        return xp.concatenate([self.body_scales.ravel(), largest])

    def standard_parameters(self, xp: ModuleType, A: Values, b: Values, y: Values) -> Values:
        """Return the standard parameters of scaled variables; columns without bounds are solved."""
        order = np.array([*self.order, *self.free])
        p = y * self.scales(xp, A, b)
        if self.free:
            F, inverse = self.free_columns(xp, A)
            rest = b - A[:, np.array(self.order)] @ p
            p = xp.concatenate([p, inverse @ (F.T @ rest)])
        return p[np.argsort(order)]

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

        A bound holds where coefficients times a body's scaled variables plus constant is positive.
        """
        bounds, w, K = self.bounds, self.width, len(self.bodies)
        mass, L = np.asarray(bounds.mass_max), np.asarray(bounds.radius)
        upper, sphere = np.zeros((K, w)), np.zeros((K, w))
        upper[:, 0], sphere[:, 0], sphere[:, 4:7] = -1.0, 1.0, -0.5
        names, rows = ["largest mass", "sphere"], [upper, sphere]
        offsets = [np.ones(K), np.zeros(K)]
        if np.any(bounds.mass_min):
            lower = np.zeros((K, w))
            lower[:, 0] = 1.0
            names.append("smallest mass")
            rows.append(lower)
            offsets.append(-np.asarray(bounds.mass_min) / mass)
        sides = (("lower", 1.0, bounds.centre_min), ("upper", -1.0, bounds.centre_max))
        for side, sign, corner in sides:
            for axis in range(3):
                known = np.isfinite(corner[:, axis])
                if known.any():
                    row = np.zeros((K, w))
                    row[known, 1 + axis] = sign
                    row[known, 0] = -sign * corner[known, axis] / L[known]
                    names.append(f"{side} {AXES[axis]} of the centre of mass")
                    rows.append(row)
                    offsets.append(np.where(known, 0.0, 1.0))
        return names, np.stack(rows, axis=1), np.stack(offsets, axis=1)


def feasible_set(model: Model, bounds: BodyBounds, margin: float = 0.0) -> FeasibleSet:
    """Return the feasible standard parameters of a model.

    Args:
        model: Model with bodies.
        bounds: Bounds of its bodies.
        margin: Fraction (0 to 1) of a nominal ball that every body contains.

    Raises:
        InputError: If the model has no bodies, the bounds are those of another robot, or coupled
            drives lack the diagonal terms.
    """
    robot = model.robot
    sizes = [len(term.parameters(robot)) for term in model.terms]
    starts = np.cumsum([0, *sizes[:-1]])
    widths = [term.body_parameters for term in model.terms]
    if not any(widths):
        raise InputError("the model has no bodies to make consistent: add `RigidBodies()`.")
    if len(bounds.radius) != robot.joints:
        raise InputError(
            f"`bounds` must be those of the {robot.joints} bodies of `{robot.name}`, but are "
            f"of {len(bounds.radius)}."
        )
    lower = np.concatenate([term.lower_bounds(robot) for term in model.terms])
    first = next(k for k, width in enumerate(widths) if width)
    columns = starts[first] + np.arange(sizes[first]).reshape(robot.joints, widths[first])
    others = np.setdiff1d(np.arange(model.size), columns)
    return FeasibleSet(
        bodies=tuple(tuple(int(k) for k in row) for row in columns),
        drives=tuple(int(k) for k in others if lower[k] == 0.0),
        free=tuple(int(k) for k in others if lower[k] != 0.0),
        bounds=bounds,
        floors=margin * nominal_bodies(bounds),
        couplings=_couplings(model),
    )


def nominal_bodies(bounds: BodyBounds) -> Float[np.ndarray, "bodies 4 4"]:
    """Return the pseudo-inertias of balls of medium size within the bounds."""
    low, high = np.asarray(bounds.mass_min), np.asarray(bounds.mass_max)
    mass = np.clip(0.05 * high, low + 0.05 * (high - low), high)
    centre, L = bounds.inner_centres, np.asarray(bounds.radius)
    room = np.sqrt(1.0 - np.sum((centre / L[:, None]) ** 2, axis=1))
    return ball(mass, centre, 0.5 * L * room)


def _couplings(model: Model) -> tuple[Coupling, ...]:
    """Return the matrices of inertias, and of viscous friction, of drives that couple axes."""
    robot = model.robot
    total = np.concatenate([term.drive_matrices(robot) for term in model.terms], axis=-1)
    return tuple(
        _coupling(robot, matrix, group, kind)
        for kind, matrix in zip(("RotorInertia", "ViscousFriction"), total, strict=True)
        for group in _connected_axes((matrix != 0).any(axis=-1))
    )


def _coupling(robot: Robot, matrix: np.ndarray, group: list[int], kind: str) -> Coupling:
    inside = matrix[np.ix_(group, group)]
    columns = np.flatnonzero(inside.any(axis=(0, 1)))
    if len(group) > 4:
        raise InputError(
            f"drives that couple more than 4 axes have no consistent estimate yet: "
            f"`{robot.name}` couples {len(group)}."
        )
    diagonal = []
    for axis in range(len(group)):
        alone = [int(k) for k in columns if inside[axis, axis, k] != 0]
        if not alone:
            raise InputError(
                "coupled drives are consistent only together with the drives' own columns: add "
                f"`{kind}()`."
            )
        diagonal.append(alone[0])
    basis = np.moveaxis(inside[:, :, columns], -1, 0)
    return Coupling(tuple(int(k) for k in columns), basis, tuple(diagonal))


def _connected_axes(joined: np.ndarray) -> list[list[int]]:
    """Return the connected groups of more than one axis."""
    n, seen, groups = len(joined), set(), []
    for start in range(n):
        group, front = [], [start]
        while front:
            k = front.pop()
            if k not in seen:
                seen.add(k)
                group.append(k)
                front += [int(j) for j in np.flatnonzero(joined[k] | joined[:, k])]
        if len(group) > 1:
            groups.append(sorted(group))
    return groups


class ScaledRows(eqx.Module):
    r"""Rows $|A p - b|^2$ of all standard parameters, in units of the noise.

    Attributes:
        A: Matrix.
        b: Right-hand side.
        noise: Standard deviation of a weighted row.
        scale: Half the number of rows: about half the squared residuals at the optimum.
    """

    A: Float[AnyArray, "*batch height standard"]
    b: Float[AnyArray, "*batch height"]
    noise: Number
    scale: Number


def scaled_rows(
    xp: ModuleType,
    base: BaseParameters,
    R: Float[AnyArray, "height base"],
    z: Float[AnyArray, " height"],
    rows: Values | int,
) -> ScaledRows:
    """Divide a weighted triangular factor by the standard deviation of its residuals.

    Args:
        xp: NumPy or `jax.numpy`.
        base: Base parameters of the factor's columns.
        R: Upper triangle of the weighted rows.
        z: Weighted forces, of the same decomposition.
        rows: Number of rows behind the factor.
    """
    rest = z[base.size :]
    dof = xp.maximum(xp.asarray(rows - base.size, float), 1.0)
    # Noise below a thousandth of the forces is not credible.
    square = xp.maximum((rest @ rest) / dof, 1e-6 * (z @ z) / (dof + base.size))
    noise = xp.sqrt(xp.where(square > 0, square, 1.0))
    combination = np.zeros((base.size, base.model.size))
    combination[range(base.size), base.indices] = 1.0
    combination[:, list(base.dependent)] = np.asarray(base.kappa)
    return ScaledRows((R @ combination) / noise, z / noise, noise, 0.5 * xp.asarray(rows, float))
