r"""Least squares over bodies that could exist, as a small convex program in scaled variables.

The variables are those of the bodies, as many for each, then those of the drives. Every body is
measured in its largest mass and the radius of its sphere, every number of a drive in its largest
value: all lie between -1 and 1, so that distances to an optimum are bounded and units do not
matter.
"""

from types import ModuleType
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Int
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import BASIS

Values = Any
"""What either machine computes with: arrays of NumPy or JAX, and NumPy's numbers."""
Number = Float[AnyArray, "*batch"] | np.floating
"""One number of a program, or one for each of many."""


class ConeProgram(eqx.Module):
    r"""$\min \frac12 |A y - b|^2$ over bodies, drives and what couples them.

    Attributes:
        A: Matrix; what has no bounds is projected out of it.
        b: Right-hand side.
        floors: What each body's pseudo-inertia exceeds.
        rows: Linear functions of each body that are not negative, with `offsets` added.
        offsets: Their constants.
        couplings: What unit variables add to further matrices that are positive semidefinite.
        members: Which variables these are.
        fillings: Constants of these matrices: ones where they are smaller than four.
        equal: Functions of all variables that keep their value at the start.
        pull: Strength of the pull towards bodies of a prior; 0 for none.
        prior: Inverses of the prior's pseudo-inertias.
        diameters: How far two feasible values of each variable can be apart.
        scale: What the objective counts as 1.
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
        """Variables of a body."""
        return self.rows.shape[-1]

    @property
    def drives(self) -> int:
        """Number of the drives' variables."""
        return self.A.shape[-1] - self.bodies * self.width

    @property
    def complementarity(self) -> int:
        """Sum of the sizes of all cones."""
        matrices = 4 * (self.bodies + self.members.shape[-2])
        return matrices + self.bodies * self.rows.shape[-2] + 2 * self.drives

    def require_interior(self) -> None:
        """Refuses a start on or beyond a bound.

        Raises:
            InputError: If there is none within.
        """
        y = np.asarray(self.start)
        S = self.matrices(np, y) + self.constant_matrices(np)
        s = self.slacks(np, y) + self.constant_slacks(np)
        if not (np.linalg.eigvalsh(S)[:, 0].min(initial=1.0) > 0 and s.min(initial=1.0) > 0):
            raise InputError(
                "no ball-shaped body lies within all bounds: make `margin` smaller, or widen the "
                "bounds of masses, spheres and centres of mass."
            )

    def of_bodies(self, xp: ModuleType, y: Values) -> Values:
        """The bodies' variables, one row for each."""
        return xp.reshape(y[: self.bodies * self.width], (self.bodies, self.width))

    def matrices(self, xp: ModuleType, y: Values) -> Values:
        """What variables add to the matrices that are positive semidefinite."""
        flat = BASIS[: self.width].reshape(self.width, 16)
        P = xp.reshape(self.of_bodies(xp, y) @ flat, (self.bodies, 4, 4))
        if not self.members.shape[-2]:
            return P
        return xp.concatenate([P, xp.einsum("ki,kiab->kab", y[self.members], self.couplings)])

    def slacks(self, xp: ModuleType, y: Values) -> Values:
        """What variables add to the linear functions that are not negative."""
        linear = xp.einsum("kri,ki->kr", self.rows, self.of_bodies(xp, y))
        drives = y[self.bodies * self.width :]
        return xp.concatenate([xp.ravel(linear), drives, -drives])

    def constant_matrices(self, xp: ModuleType) -> Values:
        """The constant parts of the matrices."""
        return xp.concatenate([-self.floors, self.fillings])

    def constant_slacks(self, xp: ModuleType) -> Values:
        """The constant parts of the linear functions."""
        n = self.drives
        return xp.concatenate([xp.ravel(self.offsets), xp.zeros(n), xp.ones(n)])

    def adjoint(self, xp: ModuleType, Z: Values, z: Values) -> Values:
        """The transpose of `matrices` and `slacks`."""
        flat = BASIS[: self.width].reshape(self.width, 16)
        own = xp.reshape(Z[: self.bodies], (self.bodies, 16)) @ flat.T
        count = self.bodies * self.rows.shape[-2]
        linear = xp.reshape(z[:count], (self.bodies, -1))
        own = own + xp.einsum("kri,kr->ki", self.rows, linear)
        n = self.drives
        drives = z[count : count + n] - z[count + n :]
        y = xp.concatenate([xp.ravel(own), drives])
        if not self.members.shape[-2]:
            return y
        more = xp.einsum("kab,kiab->ki", Z[self.bodies :], self.couplings)
        return y + xp.einsum("ki,kij->j", more, indicators(self.members, y.shape[0]))


def indicators(places: Values, size: int) -> Values:
    """For each place a vector with a one there: sums over places become products of matrices."""
    return (places[..., None] == np.arange(size)[None, None]).astype(float)
