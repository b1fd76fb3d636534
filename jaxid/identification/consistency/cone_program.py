r"""Least squares over a feasible set as a small convex program in scaled variables.

The variables are those of the bodies, equally many for each, then those of the drives. Bodies are
measured in their largest masses and the radii of their spheres, drives in their largest values: all
variables lie between -1 and 1. Distances to an optimum are then bounded, and units do not matter.
"""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Int
from jaxid.errors import InputError
from jaxid.identification.consistency.bounds import BodyBounds
from jaxid.identification.consistency.feasible_set import FeasibleSet, Number, ScaledRows
from jaxid.identification.consistency.pseudo_inertia import (
    BASIS,
    Values,
    ball,
    inertial_parameters,
)


class ConeProgram(eqx.Module):
    r"""$\min \frac12 |A y - b|^2$ over bodies, drives and their couplings.

    Attributes:
        A: Matrix; columns without bounds are projected out of it.
        b: Right-hand side.
        floors: Lower bound of each body's pseudo-inertia.
        rows: Coefficients of each body's linear inequalities.
        offsets: Constants of these inequalities.
        couplings: Contributions of variables to further positive semidefinite matrices.
        members: Variables of these matrices.
        fillings: Constants of these matrices: ones where they are smaller than four.
        equal: Functions of all variables that keep their value at the start.
        pull: Strength of the pull towards the prior's bodies; 0 for none.
        prior: Inverses of the prior's pseudo-inertias.
        diameters: Largest distance between two feasible values of each variable.
        scale: Value of the objective that counts as 1.
        start: Strictly feasible variables.
    """

    A: Float[AnyArray, "*batch height variables"]
    b: Float[AnyArray, "*batch height"]
    floors: Float[AnyArray, "*batch bodies 4 4"]
    rows: Float[AnyArray, "*batch bodies rows width"]
    offsets: Float[AnyArray, "*batch bodies rows"]
    couplings: Float[AnyArray, "*batch couplings members 4 4"]
    members: Int[AnyArray, "*batch couplings members"]
    fillings: Float[AnyArray, "*batch couplings 4 4"]
    equal: Float[AnyArray, "*batch equal variables"]
    pull: Number
    prior: Float[AnyArray, "*batch bodies 4 4"]
    diameters: Float[AnyArray, "*batch variables"]
    scale: Number
    start: Float[AnyArray, "*batch variables"]

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
        matrices = 4 * (self.bodies + self.members.shape[-2])
        return matrices + self.bodies * self.rows.shape[-2] + 2 * self.drives

    def require_interior(self) -> None:
        """Check that the start lies strictly inside all bounds.

        Raises:
            InputError: If it does not.
        """
        S, s = self.slacks(np, np.asarray(self.start))
        if not (np.linalg.eigvalsh(S)[:, 0].min(initial=1.0) > 0 and s.min(initial=1.0) > 0):
            raise InputError(
                "no ball-shaped body lies within all bounds: make `margin` smaller, or widen the "
                "bounds of masses, spheres and centres of mass."
            )

    def slacks(self, xp: ModuleType, y: Values) -> tuple[Values, Values]:
        """Return the semidefinite matrices and the nonnegative functions of variables."""
        S, s = self.linear(xp, y)
        constant = xp.ravel(self.offsets), xp.zeros(self.drives), xp.ones(self.drives)
        return S + xp.concatenate([-self.floors, self.fillings]), s + xp.concatenate(constant)

    def linear(self, xp: ModuleType, y: Values) -> tuple[Values, Values]:
        """Return the linear parts of `slacks`."""
        count = self.bodies * self.width
        bodies, drives = xp.reshape(y[:count], (self.bodies, self.width)), y[count:]
        flat = BASIS[: self.width].reshape(self.width, 16)
        S = xp.reshape(bodies @ flat, (self.bodies, 4, 4))
        if self.members.shape[-2]:
            S = xp.concatenate([S, xp.einsum("ki,kiab->kab", y[self.members], self.couplings)])
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
        if not self.members.shape[-2]:
            return y
        more = xp.einsum("kab,kiab->ki", Z[self.bodies :], self.couplings)
        return y + xp.einsum("ki,kij->j", more, indicators(self.members, y.shape[0]))


def indicators(places: Values, size: int) -> Values:
    """Return unit vectors, with which sums over places become products of matrices."""
    return (places[..., None] == np.arange(size)[None, None]).astype(float)


def cone_program(
    xp: ModuleType,
    feasible: FeasibleSet,
    data: ScaledRows,
    strength: float = 0.0,
    prior: Float[np.ndarray, "bodies 4 4"] | None = None,
) -> ConeProgram:
    """Return the convex program of least squares over a feasible set.

    Args:
        xp: NumPy or `jax.numpy`.
        feasible: Feasible set.
        data: Rows in units of the noise.
        strength: Strength of a pull towards a prior's bodies.
        prior: Pseudo-inertias of these bodies.
    """
    A, b, bounds = data.A, data.b, feasible.bounds
    units = feasible.scales(xp, A, b)
    K, w, n = len(feasible.bodies), feasible.width, len(feasible.drives)
    _, rows, offsets = feasible.linear_bounds()
    couplings, members, fillings = _coupled(xp, feasible, units[K * w :])
    shrink = np.ones((K, 4))
    shrink[:, :3] = 1.0 / np.asarray(bounds.radius)[:, None]
    shrink = shrink[:, :, None] * shrink[:, None, :] / np.asarray(bounds.mass_max)[:, None, None]
    scaled = A[:, np.array(feasible.order)] * units[None]
    if feasible.free:
        F, inverse = feasible.free_columns(xp, A)
        scaled = scaled - F @ (inverse @ (F.T @ scaled))
        b = b - F @ (inverse @ (F.T @ b))
    equal = np.zeros((0, K * w + n))
    if bounds.total_mass is not None:
        equal = np.zeros((1, K * w + n))
        equal[0, : K * w : w] = np.asarray(bounds.mass_max) / bounds.total_mass
    return ConeProgram(
        A=scaled,
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
        diameters=np.concatenate([np.tile([1, 2, 2, 2, *[1.0] * 6][:w], K), np.ones(n)]),
        scale=xp.asarray(data.scale) + 4.0 * K * strength,
        start=_start(xp, feasible, scaled, b, prior),
    )


def _coupled(
    xp: ModuleType, feasible: FeasibleSet, largest: Values
) -> tuple[Values, np.ndarray, np.ndarray]:
    """Return the matrices of ellipsoids and couplings in scaled variables, filled up to size four.

    Args:
        xp: NumPy or `jax.numpy`.
        feasible: Feasible set.
        largest: Units of the drives' variables.
    """
    w, bounds = feasible.width, feasible.bounds
    ellipsoids = np.flatnonzero(bounds.has_ellipsoid).tolist()
    if not ellipsoids and not feasible.couplings:
        return np.zeros((0, 0, 4, 4)), np.zeros((0, 0), int), np.zeros((0, 4, 4))
    matrices, members, fillings = [], [], []
    for k in ellipsoids:
        matrices.append(xp.asarray(_ellipsoid(bounds, k)))
        members.append([*range(k * w, k * w + 4)])
        fillings.append(np.zeros((4, 4)))
    for coupling in feasible.couplings:
        places = [feasible.drives.index(k) for k in coupling.columns]
        diagonal = np.array([feasible.drives.index(k) for k in coupling.diagonal])
        size, unit = 1.0 / xp.sqrt(largest[diagonal]), largest[np.array(places)]
        basis = unit[:, None, None] * coupling.basis * size[None, :, None] * size[None, None, :]
        axes = len(diagonal)
        matrices.append(xp.pad(basis, ((0, 0), (0, 4 - axes), (0, 4 - axes))))
        members.append([len(feasible.bodies) * w + k for k in places])
        fillings.append(np.diag([0.0] * axes + [1.0] * (4 - axes)))
    longest = max(len(m) for m in members)
    matrices = [xp.pad(x, ((0, longest - len(x)), (0, 0), (0, 0))) for x in matrices]
    members = [[*m, *[0] * (longest - len(m))] for m in members]
    return xp.stack(matrices), np.array(members), np.array(fillings)


def _ellipsoid(bounds: BodyBounds, k: int) -> np.ndarray:
    """Return the Schur complements whose sum is definite for centres of mass in an ellipsoid."""
    L = bounds.radius[k]
    basis = np.zeros((4, 4, 4))
    basis[0, range(3), range(3)] = (bounds.ellipsoid_axes[k] / L) ** 2
    basis[0, :3, 3] = basis[0, 3, :3] = -bounds.ellipsoid_centre[k] / L
    basis[0, 3, 3] = 1.0
    for axis in range(3):
        basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
    return basis


def _start(
    xp: ModuleType, feasible: FeasibleSet, A: Values, b: Values, prior: np.ndarray | None
) -> Values:
    """Return balls at inner centres of mass, as heavy as fits the forces, and some friction.

    Where a prior's bodies satisfy all bounds the start lies close to them.
    """
    bounds, K, w, n = feasible.bounds, len(feasible.bodies), feasible.width, len(feasible.drives)
    most = np.asarray(bounds.mass_max)
    centre = bounds.inner_centres / np.asarray(bounds.radius)[:, None]
    room = 1.0 - np.sum(centre**2, axis=1)
    balls = inertial_parameters(ball(np.ones(K), centre, np.sqrt(0.5 * room * 5.0 / 3.0)))[:, :w]
    floor = inertial_parameters(feasible.floors)[:, :w] / feasible.body_scales
    low = np.maximum(np.asarray(bounds.mass_min) / most, floor[:, 0])
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
    start = xp.concatenate([xp.ravel(bodies), xp.asarray(np.full(n, 0.02))])
    for coupling in feasible.couplings:
        beside = [feasible.drives.index(k) for k in coupling.columns if k not in coupling.diagonal]
        places = K * w + np.array(beside, int)
        start = xp.where(np.isin(np.arange(K * w + n), places), 1e-3 * start, start)
    return start
