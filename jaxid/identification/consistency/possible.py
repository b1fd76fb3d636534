"""The set of possible parameters of a model."""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.cone_program import Values
from jaxid.identification.consistency.couplings import Coupling, couplings_of
from jaxid.identification.consistency.pseudo_inertia import ball
from jaxid.robot.robot import AXES

WIDE = 10.0
"""Largest friction and rotor inertia, in units of what all measured forces together would give."""
NOMINAL_MASS, NOMINAL_RADIUS = 0.05, 0.5
"""Mass and radius of a nominal ball, as shares of the largest ones."""
FELT = 1e-9
"""Columns shorter than this share of the longest of their kind count as zero."""


class PossibleParameters(eqx.Module):
    """Bodies that could exist, friction that brakes, rotors that are not lighter than nothing.

    Attributes:
        bodies: For each body the columns of its parameters.
        drives: Columns that are not negative.
        free: Columns without bounds.
        bounds: Of the bodies.
        floors: Pseudo-inertias that those of the bodies exceed.
        couplings: Of drives.
        size: Number of standard parameters.
    """

    bodies: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    drives: tuple[int, ...] = eqx.field(static=True)
    free: tuple[int, ...] = eqx.field(static=True)
    bounds: BodyBounds
    floors: Float[np.ndarray, "bodies 4 4"]
    couplings: tuple[Coupling, ...]
    size: int = eqx.field(static=True)

    @classmethod
    def of(cls, model: Model, bounds: BodyBounds, margin: float = 0.0) -> "PossibleParameters":
        """The possible parameters of a model.

        Args:
            model: The model.
            bounds: Of its bodies.
            margin: Share of a nominal ball that every body contains, of 1.

        Raises:
            InputError: If the model has no bodies, coupled drives lack the diagonal terms, or the
                margin leaves no body.
        """
        robot = model.robot
        sizes = [len(term.parameters(robot)) for term in model.terms]
        starts = np.cumsum([0, *sizes[:-1]])
        widths = [term.body_parameters for term in model.terms]
        if not any(widths):
            raise InputError(
                "physical consistency is about bodies, but the model has none: add `RigidBodies()`."
            )
        lower = np.concatenate([term.lower_bounds(robot) for term in model.terms])
        first = next(k for k, width in enumerate(widths) if width)
        columns = starts[first] + np.arange(sizes[first]).reshape(robot.joints, widths[first])
        others = np.setdiff1d(np.arange(model.size), columns)
        if len(bounds.radius) != robot.joints:
            raise InputError(
                f"`bounds` must be those of the {robot.joints} bodies of `{robot.name}`, but are "
                f"of {len(bounds.radius)}."
            )
        return cls(
            bodies=tuple(tuple(int(k) for k in row) for row in columns),
            drives=tuple(int(k) for k in others if lower[k] == 0.0),
            free=tuple(int(k) for k in others if lower[k] != 0.0),
            bounds=bounds,
            floors=margin * nominal_bodies(bounds),
            couplings=couplings_of(model),
            size=model.size,
        )

    @property
    def width(self) -> int:
        """Number of parameters of each body."""
        return len(self.bodies[0])

    @property
    def body_scales(self) -> Float[np.ndarray, "bodies width"]:
        """Largest mass, and its products with the radius and its square."""
        mass, L = np.asarray(self.bounds.mass_max), np.asarray(self.bounds.radius)
        powers = np.array([0, 1, 1, 1, *[2] * 6])[: self.width]
        return mass[:, None] * L[:, None] ** powers

    @property
    def order(self) -> list[int]:
        """Columns in the order of the program's variables."""
        return [*(k for body in self.bodies for k in body), *self.drives]

    def scales(self, xp: ModuleType, A: Values, b: Values) -> Values:
        """Units of the program's variables: zero for drives that are not felt."""
        norms = xp.linalg.norm(A[:, np.array(self.drives, int)], axis=0)
        felt = norms > FELT * xp.max(norms, initial=0.0)
        largest = WIDE * xp.linalg.norm(b) / xp.where(felt, norms, 1.0)
        largest = xp.where(felt, largest, 0.0)
        for coupling in self.couplings:
            # A matrix with a zero on its diagonal is never definite: such an axis has the others'.
            places = np.array([self.drives.index(k) for k in coupling.columns])
            most = xp.max(largest[places])
            here = np.isin(np.arange(len(self.drives)), places)
            largest = xp.where(here & (largest <= 0.0), xp.maximum(most, 1e-12), largest)
        return xp.concatenate([self.body_scales.ravel(), largest])

    def standard(self, xp: ModuleType, A: Values, b: Values, y: Values) -> Values:
        """The standard parameters of the program's variables, those without bounds included."""
        order = np.array([*self.order, *self.free])
        p = y * self.scales(xp, A, b)
        if self.free:
            F, inverse = self.without_bounds(xp, A)
            left = b - A[:, np.array(self.order)] @ p
            p = xp.concatenate([p, inverse @ (F.T @ left)])
        return p[np.argsort(order)]

    def without_bounds(self, xp: ModuleType, A: Values) -> tuple[Values, Values]:
        """Columns without bounds, and the inverse of their products."""
        F = A[:, np.array(self.free, int)]
        norms = xp.linalg.norm(F, axis=0)
        unit = 1.0 / xp.where(norms > 0, norms, 1.0)
        gram = (unit[:, None] * (F.T @ F)) * unit[None]
        inverse = xp.linalg.inv(gram + 1e-13 * np.eye(len(self.free)))
        return F, unit[:, None] * inverse * unit[None]

    @property
    def bound_names(self) -> tuple[str, ...]:
        """What the bodies' linear bounds are, in the order of the program's rows."""
        bounds = self.bounds
        names = ["largest mass", "sphere"]
        if np.any(bounds.mass_min):
            names.append("smallest mass")
        for side, corner in (("lower", bounds.centre_min), ("upper", bounds.centre_max)):
            names += [
                f"{side} {AXES[axis]} of the centre of mass"
                for axis in range(3)
                if np.isfinite(corner[:, axis]).any()
            ]
        return tuple(names)

    def linear_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """The bodies' linear bounds in scaled variables."""
        bounds, w, K = self.bounds, self.width, len(self.bodies)
        mass, L = np.asarray(bounds.mass_max), np.asarray(bounds.radius)
        upper, sphere = np.zeros((K, w)), np.zeros((K, w))
        upper[:, 0], sphere[:, 0], sphere[:, 4:7] = -1.0, 1.0, -0.5
        rows, offsets = [upper, sphere], [np.ones(K), np.zeros(K)]
        if np.any(bounds.mass_min):
            lower = np.zeros((K, w))
            lower[:, 0] = 1.0
            rows.append(lower)
            offsets.append(-np.asarray(bounds.mass_min) / mass)
        for sign, corner in ((1.0, bounds.centre_min), (-1.0, bounds.centre_max)):
            for axis in range(3):
                known = np.isfinite(corner[:, axis])
                if known.any():
                    row = np.zeros((K, w))
                    row[known, 1 + axis] = sign
                    row[known, 0] = -sign * corner[known, axis] / L[known]
                    rows.append(row)
                    offsets.append(np.where(known, 0.0, 1.0))
        return np.stack(rows, axis=1), np.stack(offsets, axis=1)


def nominal_bodies(bounds: BodyBounds) -> Float[np.ndarray, "bodies 4 4"]:
    """Pseudo-inertias of balls of middling size within the bounds: where nothing else is known."""
    mass = NOMINAL_MASS * np.asarray(bounds.mass_max)
    low, high = np.asarray(bounds.mass_min), np.asarray(bounds.mass_max)
    mass = np.clip(mass, low + 0.05 * (high - low), high)
    centre, L = bounds.interior, np.asarray(bounds.radius)
    left = np.sqrt(1.0 - np.sum((centre / L[:, None]) ** 2, axis=1))
    return ball(mass, centre, NOMINAL_RADIUS * L * left)
