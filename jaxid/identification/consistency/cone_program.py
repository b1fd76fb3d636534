r"""Least squares over bodies that could exist, as a small convex program in scaled variables.

The variables are those of the bodies, as many for each, then those of the drives. Every body is
measured in its largest mass and the radius of its sphere, every number of a drive in its largest
value: all lie between -1 and 1, so that distances to an optimum are bounded and units do not matter.
"""

from types import ModuleType

import equinox as eqx

from jaxid.identification.consistency.pseudo_inertia import BASIS
from jaxid.types import AnyArray, Float, Int


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
    pull: Float[AnyArray, "*batch"]
    prior: Float[AnyArray, "*batch bodies 4 4"]
    diameters: Float[AnyArray, "*batch variables"]
    scale: Float[AnyArray, "*batch"]
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

    def of_bodies(self, xp: ModuleType, y: AnyArray) -> AnyArray:
        """The bodies' variables, one row for each."""
        return xp.reshape(y[: self.bodies * self.width], (self.bodies, self.width))

    def matrices(self, xp: ModuleType, y: AnyArray) -> AnyArray:
        """What variables add to the matrices that are positive semidefinite."""
        flat = BASIS[: self.width].reshape(self.width, 16)
        P = xp.reshape(self.of_bodies(xp, y) @ flat, (self.bodies, 4, 4))
        if not self.members.shape[-2]:
            return P
        return xp.concatenate([P, xp.einsum("ki,kiab->kab", y[self.members], self.couplings)])

    def slacks(self, xp: ModuleType, y: AnyArray) -> AnyArray:
        """What variables add to the linear functions that are not negative."""
        linear = xp.einsum("kri,ki->kr", self.rows, self.of_bodies(xp, y))
        drives = y[self.bodies * self.width :]
        return xp.concatenate([xp.ravel(linear), drives, -drives])

    def constant_matrices(self, xp: ModuleType) -> AnyArray:
        """The constant parts of the matrices."""
        return xp.concatenate([-self.floors, self.fillings])

    def constant_slacks(self, xp: ModuleType) -> AnyArray:
        """The constant parts of the linear functions."""
        n = self.drives
        return xp.concatenate([xp.ravel(self.offsets), xp.zeros(n), xp.ones(n)])

    def adjoint(self, xp: ModuleType, Z: AnyArray, z: AnyArray) -> AnyArray:
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
        return added(xp, y, self.members, more)


def added(xp: ModuleType, target: AnyArray, places: AnyArray, values: AnyArray) -> AnyArray:
    """A vector after values were added at places that may come more than once."""
    # NumPy adds in place only what a matrix product adds anywhere: ones at the places.
    ones = (places[..., None] == xp.arange(target.shape[0])) * 1.0
    return target + xp.einsum("ki,kij->j", values, ones)
