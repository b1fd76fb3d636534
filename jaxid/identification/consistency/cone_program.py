r"""Least squares over parameters of possible bodies, as a small convex program.

The variables are those of the bodies, equally many for each, then those of the drives.
Bodies are measured in their largest masses and the radii of their spheres, drives in
their largest values: all variables lie between -1 and 1. Distances to an optimum are
then bounded, and units do not matter.
"""

from types import ModuleType

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Matrix, namespace
from jaxid.errors import InputError

from .bounds_and_priors import BodyBounds
from .feasible_set import FeasibleSet
from .pseudo_inertia import BASIS, Values, ball, inertial_parameters
from .scaled_rows import ScaledRows

Number = Float[AnyArray, "*batch"] | np.floating
"""One number of a problem, or one for each of a batch."""

START_DRIVE = 0.02
"""Parameters of the drives at the start, in their largest values."""
START_COUPLING = 1e-3
"""Initial entries beside the diagonal of coupled drives, relative to the others."""
PRIOR_SHARE = 0.98
"""How near the start lies to bodies of a prior that satisfy all bounds."""


class ConeProgram(eqx.Module):
    r"""$\min \frac12 |A y - b|^2$ over bodies, drives and their couplings."""

    A: Float[AnyArray, "*batch height variables"]  # without the unbounded columns
    b: Float[AnyArray, "*batch height"]
    # linear inequalities of each body, and their constants
    rows: Float[AnyArray, "*batch bodies rows width"]
    offsets: Float[AnyArray, "*batch bodies rows"]
    # Further positive semidefinite matrices: what drives contribute to them, and
    # constants, which are ones where a matrix is smaller than four.
    couplings: Float[AnyArray, "*batch drives couplings 4 4"]
    fillings: Float[AnyArray, "*batch couplings 4 4"]
    # functions that keep their value at the start
    equalities: Float[AnyArray, "*batch equal variables"]
    pull: Number  # strength of the pull towards the prior's bodies; 0 for none
    prior: Float[AnyArray, "*batch bodies 4 4"]  # inverses of its pseudo-inertias
    diameters: Float[AnyArray, "*batch variables"]  # of the sets of feasible values
    scale: Number  # value of the objective that counts as 1
    start: Float[AnyArray, "*batch variables"]  # strictly feasible variables

    @property
    def xp(self) -> ModuleType:
        """NumPy, or JAX's: that of the arrays."""
        return namespace(self.A)

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
    def basis(self) -> Matrix:
        """Flattened pseudo-inertias of a body's unit variables."""
        return BASIS[: self.width].reshape(self.width, 16)

    @property
    def complementarity(self) -> int:
        """Sum of the sizes of all cones."""
        matrices = 4 * (self.bodies + self.fillings.shape[-3])
        return matrices + self.bodies * self.rows.shape[-2] + 2 * self.drives

    def require_interior(self) -> None:
        """Check that the start lies strictly inside all bounds."""
        S, s = self.slacks(self.start)
        min_eigenvalue = np.linalg.eigvalsh(S).min()
        if not (min_eigenvalue > 0 and s.min() > 0):
            raise InputError("no ball lies within all bounds: widen them.")

    def slacks(self, y: Values) -> tuple[Values, Values]:
        """Return semidefinite matrices and nonnegative functions of variables."""
        xp = self.xp
        S, s = self.linear(y)
        constants = xp.concatenate([xp.zeros((self.bodies, 4, 4)), self.fillings])
        drives = [xp.zeros(self.drives), xp.ones(self.drives)]
        return S + constants, s + xp.concatenate([xp.ravel(self.offsets), *drives])

    def linear(self, y: Values) -> tuple[Values, Values]:
        """Return the linear parts of `slacks`."""
        xp = self.xp
        count = self.bodies * self.width
        bodies = xp.reshape(y[:count], (self.bodies, self.width))
        drives = y[count:]
        S = xp.reshape(bodies @ self.basis, (self.bodies, 4, 4))
        coupling_matrices = xp.tensordot(drives, self.couplings, 1)
        s = xp.einsum("kri,ki->kr", self.rows, bodies)
        return (
            xp.concatenate([S, coupling_matrices]),
            xp.concatenate([xp.ravel(s), drives, -drives]),
        )

    def adjoint(self, Z: Values, z: Values) -> Values:
        """Apply the transpose of `linear`."""
        xp = self.xp
        z_bodies, z_lower, z_upper = self.split_linear(z)
        body_matrices = Z[: self.bodies]
        coupling_matrices = Z[self.bodies :]
        flat_matrices = xp.reshape(body_matrices, (self.bodies, 16))
        linear_part = xp.einsum("kri,kr->ki", self.rows, z_bodies)
        bodies = flat_matrices @ self.basis.T + linear_part
        coupling_products = xp.tensordot(self.couplings, coupling_matrices, 3)
        drives = z_lower - z_upper + coupling_products
        return xp.concatenate([xp.ravel(bodies), drives])

    def split_linear(self, z: Values) -> tuple[Values, Values, Values]:
        """Return numbers of inequalities: of bodies, and of both limits of drives."""
        count = self.bodies * self.rows.shape[-2]
        upper_start = count + self.drives
        bodies = self.xp.reshape(z[:count], (self.bodies, -1))
        return bodies, z[count:upper_start], z[upper_start:]


def cone_program(
    feasible: FeasibleSet, data: ScaledRows, strength: float = 0.0, prior=None
) -> ConeProgram:
    """Return the convex program of least squares, with a pull towards prior bodies."""
    xp = namespace(data.A)
    bounds = feasible.bounds
    count = len(feasible.bodies)
    scales = feasible.scales(data)
    A, b = _scale_rows(feasible, data, scales)
    lengths = np.ones((count, 4))
    lengths[:, :3] = bounds.radius[:, None]
    products = lengths[:, :, None] * lengths[:, None, :]
    pseudo_scales = products * bounds.mass_max[:, None, None]
    inverse_prior = np.zeros((count, 4, 4))
    if prior is not None:
        inverse_prior = np.linalg.inv(prior / pseudo_scales)

    _, rows, offsets = feasible.linear_bounds()
    drive_scales = scales[count * feasible.width :]
    couplings, fillings = _drive_matrices(feasible, drive_scales)
    body_diameters = [1, 2, 2, 2, 1, 1, 1, 1, 1, 1][: feasible.width]
    return ConeProgram(
        A=A,
        b=b,
        rows=rows,
        offsets=offsets,
        couplings=couplings,
        fillings=fillings,
        equalities=_total_mass(feasible),
        pull=xp.asarray(float(strength)),
        prior=inverse_prior,
        diameters=np.array([*body_diameters * count, *[1.0] * len(feasible.drives)]),
        scale=xp.asarray(data.scale) + 4.0 * count * strength,
        start=_start(feasible, A, b, prior),
    )


def _scale_rows(feasible: FeasibleSet, data: ScaledRows, scales):
    """Return the rows of scaled variables; unbounded columns are projected out."""
    A = data.A[:, np.array(feasible.order)] * scales[None]
    if not feasible.unbounded:
        return A, data.b
    columns, inverse = feasible.unbounded_columns(data)
    A = A - columns @ (inverse @ (columns.T @ A))
    b = data.b - columns @ (inverse @ (columns.T @ data.b))
    return A, b


def _total_mass(feasible: FeasibleSet) -> Matrix:
    """Return the row of the total mass [rows, variables], or none if it is unknown.

    The row times the scaled variables is the sum of all masses over the total mass.
    """
    bounds = feasible.bounds
    if bounds.total_mass is None:
        return np.zeros((0, len(feasible.order)))
    row = np.zeros((1, len(feasible.order)))
    end = len(feasible.bodies) * feasible.width
    # The mass is the first variable of each body.
    row[0, : end : feasible.width] = bounds.mass_max / bounds.total_mass
    return row


def _drive_matrices(feasible: FeasibleSet, drive_scales):
    """Return what drives contribute to matrices of coupled ones, and their constants.

    The diagonals of these matrices are scaled to one.
    """
    xp = namespace(drive_scales)
    count = len(feasible.drives)
    # At first no matrix: there may be none.
    contributions = [np.zeros((count, 0, 4, 4))]
    fillings = np.zeros((len(feasible.couplings), 4, 4))
    for coupling, filling in zip(feasible.couplings, fillings, strict=True):
        axes = len(coupling.diagonal)
        places = feasible.drive_places(coupling.columns)
        basis = np.zeros((count, 4, 4))
        basis[places, :axes, :axes] = coupling.basis
        diagonal_places = feasible.drive_places(coupling.diagonal)
        diagonal = drive_scales[diagonal_places]
        rest = np.ones(4 - axes)
        size = xp.concatenate([1.0 / xp.sqrt(diagonal), rest])
        products = size[:, None] * size[None]
        matrices = drive_scales[:, None, None] * basis * products[None]
        contributions.append(matrices[:, None])
        filling[axes:, axes:] = np.diag(rest)
    return xp.concatenate(contributions, axis=1), fillings


def _start(feasible: FeasibleSet, A, b, prior):
    """Return the start of the iteration, a point that satisfies all bounds.

    All bodies are balls, as heavy as fits the forces or the total mass; or they lie
    close to the bodies of a prior that satisfy all bounds. Friction and other drives
    are small and positive.
    """
    xp = namespace(A)
    bounds = feasible.bounds
    balls = _unit_balls(bounds)[:, : feasible.width]
    # Masses lie between a minimum and one: find the common fraction of the way.
    min_masses = bounds.mass_min / bounds.mass_max
    if bounds.total_mass is None:
        # Least squares for one factor of all balls, held away from the bounds.
        forces = A[:, : balls.size] @ xp.asarray(balls.ravel())
        mass_fraction = (forces @ b) / xp.maximum(forces @ forces, 1e-300)
        mass_fraction = xp.clip(mass_fraction, 0.02, 0.5)
    else:
        share = bounds.total_mass / bounds.mass_max.sum()
        min_share = np.average(min_masses, weights=bounds.mass_max)
        mass_fraction = (share - min_share) / (1.0 - min_share)
    masses = xp.asarray(min_masses) + mass_fraction * xp.asarray(1.0 - min_masses)
    bodies = masses[:, None] * balls
    if prior is not None and bounds.total_mass is None:
        bodies = _move_to_prior(feasible, bodies, prior)

    drives = np.full(len(feasible.drives), START_DRIVE)
    for coupling in feasible.couplings:
        # Small entries beside the diagonal keep the matrix of coupled drives definite.
        off_diagonal = tuple(k for k in coupling.columns if k not in coupling.diagonal)
        drives[feasible.drive_places(off_diagonal)] *= START_COUPLING
    return xp.concatenate([xp.ravel(bodies), xp.asarray(drives)])


def _unit_balls(bounds: BodyBounds) -> AnyArray:
    """Return the parameters of a ball of mass one in a unit sphere for each body."""
    bodies = len(bounds.radius)
    # Half of the second moment that the sphere allows; that of a ball is 3/5 m r².
    radius = np.full(bodies, np.sqrt(0.5 * 5.0 / 3.0))
    return inertial_parameters(ball(np.ones(bodies), radius))


def _move_to_prior(feasible: FeasibleSet, bodies, prior):
    """Move bodies towards those of a prior where these satisfy all bounds."""
    pseudo_parameters = inertial_parameters(prior)[:, : feasible.width]
    parameters = pseudo_parameters / feasible.body_scales
    _, rows, offsets = feasible.linear_bounds()
    slacks = np.einsum("kri,ki->kr", rows, parameters) + offsets
    is_inside = (slacks >= 0).all(axis=1)
    share = np.where(is_inside, PRIOR_SHARE, 0.0)[:, None]
    return (1.0 - share) * bodies + share * parameters
