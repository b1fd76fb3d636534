"""Least squares over the possible parameters of a model as a `ConeProgram`."""

from types import ModuleType

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.consistency.cone_program import ConeProgram, Values
from jaxid.identification.consistency.couplings import LARGEST
from jaxid.identification.consistency.possible import PossibleParameters
from jaxid.identification.consistency.pseudo_inertia import ball, inertial_parameters

CLOSE = 0.98
"""Share of a prior's bodies in those of the start."""


def program_of(
    xp: ModuleType,
    possible: PossibleParameters,
    A: Float[AnyArray, "height standard"],
    b: Float[AnyArray, " height"],
    scale: Values,
    pull: float = 0.0,
    prior: Float[np.ndarray, "bodies 4 4"] | None = None,
) -> ConeProgram:
    """Least squares over the possible parameters.

    Args:
        xp: NumPy, or what JAX has in its place.
        possible: The set.
        A: Rows in units of their standard deviations.
        b: Forces, likewise.
        scale: What the objective counts as 1.
        pull: Strength of a pull towards bodies of a prior.
        prior: Their pseudo-inertias.
    """
    units = possible.scales(xp, A, b)
    K, w, n = len(possible.bodies), possible.width, len(possible.drives)
    rows, offsets = possible.linear_bounds()
    couplings, members, fillings = _coupled(xp, possible, units[K * w :])
    L = np.asarray(possible.bounds.radius)
    shrink = np.ones((K, 4))
    shrink[:, :3] = 1.0 / L[:, None]
    shrink = (
        shrink[:, :, None]
        * shrink[:, None, :]
        / np.asarray(possible.bounds.mass_max)[:, None, None]
    )
    inner = np.zeros((K, 4, 4)) if prior is None else np.linalg.inv(prior * shrink)
    own = A[:, np.array(possible.order)] * units[None]
    if possible.free:
        F, inverse = possible.without_bounds(xp, A)
        own = own - F @ (inverse @ (F.T @ own))
        b = b - F @ (inverse @ (F.T @ b))
    equal = np.zeros((0, K * w + n))
    if possible.bounds.total_mass is not None:
        equal = np.zeros((1, K * w + n))
        equal[0, : K * w : w] = np.asarray(possible.bounds.mass_max) / possible.bounds.total_mass
    diameters = np.concatenate([np.tile([1.0, 2.0, 2.0, 2.0, *[1.0] * 6][:w], K), np.ones(n)])
    return ConeProgram(
        A=own,
        b=b,
        floors=possible.floors * shrink,
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
        start=_start(xp, possible, own, b, prior),
    )


def _coupled(
    xp: ModuleType, possible: PossibleParameters, largest: Values
) -> tuple[Values, np.ndarray, np.ndarray]:
    """The further semidefinite matrices in scaled variables, filled up to size four."""
    w = possible.width
    first = len(possible.bodies) * w
    found, members, fillings = [], [], []
    longest = max(
        [
            4 * int(possible.bounds.has_ellipsoid.any()),
            *(len(c.columns) for c in possible.couplings),
        ]
    )
    for k in np.flatnonzero(possible.bounds.has_ellipsoid):
        L = possible.bounds.radius[k]
        basis = np.zeros((longest, 4, 4))
        c = possible.bounds.ellipsoid_centre[k] / L
        basis[0, range(3), range(3)] = (possible.bounds.ellipsoid_axes[k] / L) ** 2
        basis[0, :3, 3] = basis[0, 3, :3] = -c
        basis[0, 3, 3] = 1.0
        for axis in range(3):
            basis[1 + axis, axis, 3] = basis[1 + axis, 3, axis] = 1.0
        found.append(xp.asarray(basis))
        members.append([*range(k * w, k * w + 4), *[0] * (longest - 4)])
        fillings.append(np.zeros((4, 4)))
    for coupling in possible.couplings:
        places = [possible.drives.index(k) for k in coupling.columns]
        axes = len(coupling.diagonal)
        size = 1.0 / xp.sqrt(
            largest[np.array([possible.drives.index(k) for k in coupling.diagonal])]
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


def _start(
    xp: ModuleType, possible: PossibleParameters, A: Values, b: Values, prior: np.ndarray | None
) -> Values:
    """Balls around possible centres of mass, as heavy as fits the forces, and some friction.

    Where a prior's bodies satisfy all bounds the start lies close to them.
    """
    bounds, K, w, n = possible.bounds, len(possible.bodies), possible.width, len(possible.drives)
    L, most = np.asarray(bounds.radius), np.asarray(bounds.mass_max)
    centre = bounds.interior / L[:, None]
    left = 1.0 - np.sum(centre**2, axis=1)
    balls = inertial_parameters(ball(np.ones(K), centre, np.sqrt(0.5 * left * 5.0 / 3.0)))[:, :w]
    floor = inertial_parameters(possible.floors)[:, :w] / possible.body_scales
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
        given = inertial_parameters(prior)[:, :w] / possible.body_scales
        rows, offsets = possible.linear_bounds()
        inside = (np.einsum("kri,ki->kr", rows, given) + offsets >= 0).all(axis=1)
        inside &= np.linalg.eigvalsh(prior - possible.floors)[:, 0] >= 0
        share = np.where(inside & ~bounds.has_ellipsoid, CLOSE, 0.0)[:, None]
        bodies = (1.0 - share) * bodies + share * given
    drives = np.full(n, 0.02)
    start = xp.concatenate([xp.ravel(bodies), xp.asarray(drives)])
    for coupling in possible.couplings:
        beside = [possible.drives.index(k) for k in coupling.columns if k not in coupling.diagonal]
        places = K * w + np.array(beside, int)
        start = xp.where(np.isin(np.arange(K * w + n), places), 1e-3 * start, start)
    return start
