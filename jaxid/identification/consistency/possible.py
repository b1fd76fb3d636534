"""The set of possible parameters of a model, and least squares over it as a `ConeProgram`."""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.dynamics.model import Model
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.cone_program import ConeProgram, Values
from jaxid.identification.consistency.pseudo_inertia import ball, inertial_parameters
from jaxid.robot.robot import AXES
from jaxid.types import AnyArray, Float

WIDE = 10.0
"""Largest friction and rotor inertia, in units of what all measured forces together would give."""
FELT = 1e-9
"""Columns shorter than this share of the longest of their kind count as zero."""
NOISE = 1e-3
"""Smallest noise that is believed, as a share of the forces."""
NOMINAL_MASS, NOMINAL_RADIUS = 0.05, 0.5
"""Mass and radius of a nominal ball, as shares of the largest ones."""
LARGEST = 4
"""Axes whose drives can be coupled."""
CLOSE = 0.98
"""Share of a prior's bodies in those of the start."""


class Coupling(eqx.Module):
    """Numbers of drives that together are a semidefinite matrix.

    Attributes:
        columns: The standard parameters.
        basis: What a unit of each adds to the matrix.
        diagonal: For each axis the parameter on the matrix's diagonal.
    """

    columns: tuple[int, ...] = eqx.field(static=True)
    basis: Float[np.ndarray, "members axes axes"]
    diagonal: tuple[int, ...] = eqx.field(static=True)


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
            ValueError: If the model has no bodies, coupled drives lack the diagonal terms, or the
                margin leaves no body.
        """
        robot = model.robot
        sizes = [len(term.parameters(robot)) for term in model.terms]
        starts = np.cumsum([0, *sizes[:-1]])
        widths = [term.body_parameters for term in model.terms]
        if not any(widths):
            raise ValueError(
                "physical consistency is about bodies, but the model has none: add `RigidBodies()`."
            )
        lower = np.concatenate([term.lower_bounds(robot) for term in model.terms])
        first = next(k for k, width in enumerate(widths) if width)
        columns = starts[first] + np.arange(sizes[first]).reshape(robot.joints, widths[first])
        others = np.setdiff1d(np.arange(model.size), columns)
        if len(bounds.radius) != robot.joints:
            raise ValueError(
                f"`bounds` must be those of the {robot.joints} bodies of `{robot.name}`, but are "
                f"of {len(bounds.radius)}."
            )
        return cls(
            bodies=tuple(tuple(int(k) for k in row) for row in columns),
            drives=tuple(int(k) for k in others if lower[k] == 0.0),
            free=tuple(int(k) for k in others if lower[k] != 0.0),
            bounds=bounds,
            floors=margin * nominal_bodies(bounds),
            couplings=_couplings(model),
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

    def program(
        self,
        xp: ModuleType,
        A: Float[AnyArray, "height standard"],
        b: Float[AnyArray, " height"],
        scale: Values,
        pull: float = 0.0,
        prior: Float[np.ndarray, "bodies 4 4"] | None = None,
    ) -> ConeProgram:
        """Least squares over the possible parameters.

        Args:
            xp: NumPy, or what JAX has in its place.
            A: Rows in units of their standard deviations.
            b: Forces, likewise.
            scale: What the objective counts as 1.
            pull: Strength of a pull towards bodies of a prior.
            prior: Their pseudo-inertias.
        """
        units = self.scales(xp, A, b)
        K, w, n = len(self.bodies), self.width, len(self.drives)
        rows, offsets = self._rows()
        couplings, members, fillings = self._coupled(xp, units[K * w :])
        L = np.asarray(self.bounds.radius)
        shrink = np.ones((K, 4))
        shrink[:, :3] = 1.0 / L[:, None]
        shrink = (
            shrink[:, :, None]
            * shrink[:, None, :]
            / np.asarray(self.bounds.mass_max)[:, None, None]
        )
        inner = np.zeros((K, 4, 4)) if prior is None else np.linalg.inv(prior * shrink)
        own = A[:, np.array(self.order)] * units[None]
        if self.free:
            F, inverse = self._free(xp, A)
            own = own - F @ (inverse @ (F.T @ own))
            b = b - F @ (inverse @ (F.T @ b))
        equal = np.zeros((0, K * w + n))
        if self.bounds.total_mass is not None:
            equal = np.zeros((1, K * w + n))
            equal[0, : K * w : w] = np.asarray(self.bounds.mass_max) / self.bounds.total_mass
        diameters = np.concatenate([np.tile([1.0, 2.0, 2.0, 2.0, *[1.0] * 6][:w], K), np.ones(n)])
        return ConeProgram(
            A=own,
            b=b,
            floors=self.floors * shrink,
            rows=rows,
            offsets=offsets,
            couplings=couplings,
            members=members,
            fillings=fillings,
            equal=equal,
            pull=xp.asarray(float(pull)),
            prior=inner,
            diameters=diameters,
            scale=xp.asarray(scale) + 4.0 * K * pull,
            start=self._start(xp, own, b, prior),
        )

    def standard(self, xp: ModuleType, A: Values, b: Values, y: Values) -> Values:
        """The standard parameters of the program's variables, those without bounds included."""
        order = np.array([*self.order, *self.free])
        p = y * self.scales(xp, A, b)
        if self.free:
            F, inverse = self._free(xp, A)
            left = b - A[:, np.array(self.order)] @ p
            p = xp.concatenate([p, inverse @ (F.T @ left)])
        return p[np.argsort(order)]

    def _free(self, xp: ModuleType, A: Values) -> tuple[Values, Values]:
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

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
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

    def _coupled(self, xp: ModuleType, largest: Values) -> tuple[Values, np.ndarray, np.ndarray]:
        """The further semidefinite matrices in scaled variables, filled up to size four."""
        w = self.width
        first = len(self.bodies) * w
        found, members, fillings = [], [], []
        longest = max(
            [4 * int(self.bounds.has_ellipsoid.any()), *(len(c.columns) for c in self.couplings)]
        )
        for k in np.flatnonzero(self.bounds.has_ellipsoid):
            L = self.bounds.radius[k]
            basis = np.zeros((longest, 4, 4))
            c = self.bounds.ellipsoid_centre[k] / L
            basis[0, range(3), range(3)] = (self.bounds.ellipsoid_axes[k] / L) ** 2
            basis[0, :3, 3] = basis[0, 3, :3] = -c
            basis[0, 3, 3] = 1.0
            for axis in range(3):
                basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
            found.append(xp.asarray(basis))
            members.append([*range(k * w, k * w + 4), *[0] * (longest - 4)])
            fillings.append(np.zeros((4, 4)))
        for coupling in self.couplings:
            places = [self.drives.index(k) for k in coupling.columns]
            axes = len(coupling.diagonal)
            size = 1.0 / xp.sqrt(
                largest[np.array([self.drives.index(k) for k in coupling.diagonal])]
            )
            unit = largest[np.array(places)]
            basis = unit[:, None, None] * coupling.basis * size[None, :, None] * size[None, None, :]
            more = LARGEST - axes
            basis = xp.pad(basis, ((0, longest - len(places)), (0, more), (0, more)))
            found.append(basis)
            members.append([*(first + k for k in places), *[0] * (longest - len(places))])
            fillings.append(np.diag([0.0] * axes + [1.0] * more))
        if not found:
            return np.zeros((0, 0, 4, 4)), np.zeros((0, 0), int), np.zeros((0, 4, 4))
        return xp.stack(found), np.array(members), np.array(fillings)

    def _start(self, xp: ModuleType, A: Values, b: Values, prior: np.ndarray | None) -> Values:
        """Balls around possible centres of mass, as heavy as fits the forces, and some friction.

        Where a prior's bodies satisfy all bounds the start lies close to them.
        """
        bounds, K, w, n = self.bounds, len(self.bodies), self.width, len(self.drives)
        L, most = np.asarray(bounds.radius), np.asarray(bounds.mass_max)
        centre = bounds.interior / L[:, None]
        left = 1.0 - np.sum(centre**2, axis=1)
        balls = inertial_parameters(ball(np.ones(K), centre, np.sqrt(0.5 * left * 5.0 / 3.0)))[
            :, :w
        ]
        floor = inertial_parameters(self.floors)[:, :w] / self.body_scales
        low = np.maximum(np.asarray(bounds.mass_min) / most, floor[:, 0])
        if bounds.total_mass is None:
            unit = xp.asarray(np.concatenate([balls.ravel(), np.zeros(n)]))
            felt = A @ unit
            fitting = xp.clip((felt @ b) / xp.maximum(felt @ felt, 1e-300), 0.02, 0.5)
        else:
            fitting = (bounds.total_mass / most.sum() - np.average(low, weights=most)) / np.average(
                1.0 - low, weights=most
            )
        mass = xp.asarray(low) + fitting * xp.asarray(1.0 - low)
        bodies = floor + (mass - floor[:, 0])[:, None] * balls
        if prior is not None and bounds.total_mass is None:
            given = inertial_parameters(prior)[:, :w] / self.body_scales
            rows, offsets = self._rows()
            inside = (np.einsum("kri,ki->kr", rows, given) + offsets >= 0).all(axis=1)
            inside &= np.linalg.eigvalsh(prior - self.floors)[:, 0] >= 0
            share = np.where(inside & ~bounds.has_ellipsoid, CLOSE, 0.0)[:, None]
            bodies = (1.0 - share) * bodies + share * given
        drives = np.full(n, 0.02)
        start = xp.concatenate([xp.ravel(bodies), xp.asarray(drives)])
        for coupling in self.couplings:
            beside = [self.drives.index(k) for k in coupling.columns if k not in coupling.diagonal]
            places = K * w + np.array(beside, int)
            start = xp.where(np.isin(np.arange(K * w + n), places), 1e-3 * start, start)
        return start


def nominal_bodies(bounds: BodyBounds) -> Float[np.ndarray, "bodies 4 4"]:
    """Pseudo-inertias of balls of middling size within the bounds: where nothing else is known."""
    mass = NOMINAL_MASS * np.asarray(bounds.mass_max)
    low, high = np.asarray(bounds.mass_min), np.asarray(bounds.mass_max)
    mass = np.clip(mass, low + 0.05 * (high - low), high)
    centre, L = bounds.interior, np.asarray(bounds.radius)
    left = np.sqrt(1.0 - np.sum((centre / L[:, None]) ** 2, axis=1))
    return ball(mass, centre, NOMINAL_RADIUS * L * left)


def _couplings(model: Model) -> tuple[Coupling, ...]:
    """Groups of axes whose drives' inertias, or viscous frictions, are one matrix each."""
    robot = model.robot
    total = np.concatenate([term.drive_matrices(robot) for term in model.terms], axis=-1)
    found = []
    for kind, matrix in zip(("RotorInertia", "ViscousFriction"), total, strict=True):
        joined = (matrix != 0).any(axis=-1)
        for group in _groups(joined):
            inside = matrix[np.ix_(group, group)]
            columns = np.flatnonzero(inside.any(axis=(0, 1)))
            diagonal = []
            for place in range(len(group)):
                own = [k for k in columns if inside[place, place, k] != 0]
                if not own:
                    raise ValueError(
                        f"coupled drives are consistent only together with the drives' own "
                        f"columns: add `{kind}()`."
                    )
                diagonal.append(int(own[0]))
            if len(group) > LARGEST:
                raise ValueError(
                    f"drives that couple more than {LARGEST} axes have no consistent estimate yet: "
                    f"`{robot.name}` couples {len(group)}."
                )
            basis = np.moveaxis(inside[:, :, columns], -1, 0)
            found.append(Coupling(tuple(int(k) for k in columns), basis, tuple(diagonal)))
    return tuple(found)


def _groups(joined: np.ndarray) -> list[list[int]]:
    """Connected groups of more than one axis."""
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
