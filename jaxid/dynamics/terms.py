"""The terms of a model: each contributes columns that are linear in parameters of its own."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, matching, one_or_each
from jaxid.dynamics import projection
from jaxid.dynamics.transitions import AbstractTransition, Shape, Tanh, has_dead_zone
from jaxid.errors import InputError
from jaxid.robot.inertia import INERTIAL_NAMES, INERTIAL_UNITS
from jaxid.robot.robot import Robot

PRINCIPAL = 7


class AbstractTerm(eqx.Module):
    """One effect in the equations of motion that is linear in unknown parameters.

    A new effect is one class with two methods; regressor, inverse dynamics, mass matrix, base
    parameters and the compiled forms follow from them.
    """

    @abstractmethod
    def parameters(self, robot: Robot) -> tuple[tuple[str, str], ...]:
        """Name and unit of each parameter, in the order of the columns."""

    @abstractmethod
    def columns(
        self,
        robot: Robot,
        q: Float[AnyArray, " joints"],
        qd: Float[AnyArray, " joints"],
        qdd: Float[AnyArray, " joints"],
    ) -> Float[AnyArray, "joints columns"]:
        """Generalized forces [N m or N] of unit parameters, for one sample."""

    def forces(
        self,
        robot: Robot,
        p: Float[AnyArray, " columns"],
        q: Float[AnyArray, " joints"],
        qd: Float[AnyArray, " joints"],
        qdd: Float[AnyArray, " joints"],
    ) -> Float[AnyArray, " joints"]:
        """Generalized forces [N m or N] of given parameters, for one sample."""
        return self.columns(robot, q, qd, qdd) @ p

    def mass_matrix(
        self, robot: Robot, p: Float[AnyArray, " columns"], q: Float[AnyArray, " joints"]
    ) -> Float[AnyArray, "joints joints"]:
        """What multiplies the accelerations in these forces (Eq. 38)."""
        rest = jnp.zeros_like(q)
        return jax.jacfwd(lambda qdd: self.forces(robot, p, q, rest, qdd))(rest)

    def potential_columns(
        self, robot: Robot, q: Float[AnyArray, " joints"]
    ) -> Float[AnyArray, " columns"]:
        """Potential energy [J] of unit parameters; none unless the term stores energy."""
        return jnp.zeros(len(self.parameters(robot)), q.dtype)

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """What `identify_nonlinear` can find beside the parameters; nothing for most terms."""
        return ()

    @property
    def body_parameters(self) -> int:
        """How many inertial parameters each body has in this term; none unless it has bodies."""
        return 0

    def lower_bounds(self, robot: Robot) -> Float[np.ndarray, " columns"]:
        """What the parameters cannot fall below: 0, or -inf where both signs are possible."""
        return np.full(len(self.parameters(robot)), -np.inf)

    def drive_matrices(self, robot: Robot) -> Float[np.ndarray, "2 joints joints columns"]:
        """What unit parameters add to the drives' inertia and to their viscous friction.

        Both are symmetric and cannot be negative for any motion.
        """
        n = robot.joints
        return np.zeros((2, n, n, len(self.parameters(robot))))


class RigidBodies(AbstractTerm):
    r"""Inertia and gravity of the bodies by the Projection Equation (Eqs. 1-12).

    Ten parameters for each body: mass $m$ [kg], first moment $m r_c$ [kg m], and the moments
    $A, B, C, D, E, F$ [kg m²] of $J^o$ about the origin of the body's frame (Eq. 9).

    Attributes:
        principal_axes: Leave out $D, E, F$ as the paper does (Eq. 12): seven for each body.
    """

    principal_axes: bool = eqx.field(static=True, default=False)

    @property
    def _kept(self) -> int:
        return PRINCIPAL if self.principal_axes else len(INERTIAL_NAMES)

    def parameters(self, robot: Robot) -> tuple[tuple[str, str], ...]:
        """`m1`, `mx1`, … `F1`, then those of the next body."""
        return tuple(
            (f"{name}{i + 1}", unit)
            for i in range(robot.joints)
            for name, unit in zip(
                INERTIAL_NAMES[: self._kept], INERTIAL_UNITS[: self._kept], strict=True
            )
        )

    def columns(self, robot, q, qd, qdd):
        r"""The columns $[\Theta_1 \dots \Theta_n]$ (Eq. 11)."""
        theta = projection.rigid_body_regressor(robot, q, qd, qdd)
        return theta[:, :, : self._kept].reshape(robot.joints, -1)

    @property
    def body_parameters(self) -> int:
        """Ten, or seven."""
        return self._kept

    def all_ten(self, robot: Robot, p: Float[AnyArray, " columns"]) -> Float[AnyArray, "joints 10"]:
        """The parameters of all bodies, with zeros for products of inertia that are left out."""
        bodies = p.reshape(robot.joints, self._kept)
        if not self.principal_axes:
            return bodies
        zeros = np.zeros((robot.joints, len(INERTIAL_NAMES) - PRINCIPAL))
        return jnp.concatenate([bodies, zeros.astype(bodies.dtype)], axis=1)

    def forces(self, robot, p, q, qd, qdd):
        """The projected wrenches of all bodies; the regressor is not built (Eq. 11)."""
        return projection.rigid_body_forces(robot, self.all_ten(robot, p), q, qd, qdd)

    def mass_matrix(self, robot, p, q):
        """The mass matrix of the bodies (Eq. 38)."""
        return projection.rigid_body_mass_matrix(robot, self.all_ten(robot, p), q)

    def potential_columns(self, robot, q):
        """Potential energy of masses and first moments."""
        return projection.potential_energy_columns(robot, q)[:, : self._kept].ravel()


def each_joint(robot: Robot, name: str, unit_r: str, unit_p: str) -> tuple[tuple[str, str], ...]:
    """One parameter for each joint, with the unit of a revolute or a prismatic one."""
    return tuple((f"{name}{i + 1}", unit_r if r else unit_p) for i, r in enumerate(robot.revolute))


def one_drive_each(robot: Robot, order: int) -> Float[np.ndarray, "2 joints joints joints"]:
    """Drive matrices of a parameter that belongs to one joint.

    Args:
        robot: Whose joints they are.
        order: 0 for inertias, 1 for viscous friction.
    """
    n = robot.joints
    matrices = np.zeros((2, n, n, n))
    matrices[order, range(n), range(n), range(n)] = 1.0
    return matrices


class ViscousFriction(AbstractTerm):
    r"""Friction that grows with speed, $\mathrm{diag}\{\dot q_i\}$ (Eq. 13)."""

    def parameters(self, robot):
        """`fv1`, … [N m s/rad or N s/m]."""
        return each_joint(robot, "fv", "N m s", "N s/m")

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrix of speeds."""
        return jnp.diag(qd)

    def lower_bounds(self, robot):
        """Friction brakes."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """The diagonal of the viscous friction."""
        return one_drive_each(robot, order=1)


class CoulombFriction(AbstractTerm):
    r"""Dry friction, $\mathrm{diag}\{\tanh(\dot q_i / \epsilon_c)\}$ (Eq. 14).

    Attributes:
        transition: From one direction of motion to the other.
    """

    transition: AbstractTransition = Tanh()

    def parameters(self, robot):
        """`fc1`, … [N m or N]."""
        return each_joint(robot, "fc", "N m", "N")

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrix of smooth signs."""
        return jnp.diag(self.transition(qd))

    @property
    def shapes(self):
        """Those of the transition."""
        return tuple(s.below("transition") for s in self.transition.shapes)

    def lower_bounds(self, robot):
        """Friction brakes."""
        return np.zeros(len(self.parameters(robot)))


class AsymmetricCoulombFriction(AbstractTerm):
    """Dry friction with one level for each direction of motion.

    It takes the place of `CoulombFriction` together with `ConstantOffset`, whose columns its own
    ones span.

    Attributes:
        transition: From one direction of motion to the other.
    """

    transition: AbstractTransition = Tanh()

    def parameters(self, robot):
        """`fcp1`, … for positive, then `fcn1`, … for negative speeds [N m or N]."""
        return (*each_joint(robot, "fcp", "N m", "N"), *each_joint(robot, "fcn", "N m", "N"))

    def columns(self, robot, q, qd, qdd):
        """The shares of the two directions."""
        s = self.transition(qd)
        # Within a dead zone both shares vanish, as the force does.
        moving = jnp.where(s == 0.0, s, jnp.ones_like(s)) if has_dead_zone(self.transition) else 1.0
        return jnp.concatenate([jnp.diag(0.5 * (moving + s)), jnp.diag(0.5 * (s - moving))], axis=1)

    @property
    def shapes(self):
        """Those of the transition."""
        return tuple(s.below("transition") for s in self.transition.shapes)

    def lower_bounds(self, robot):
        """Friction brakes in both directions."""
        return np.zeros(len(self.parameters(robot)))


class ConstantOffset(AbstractTerm):
    """A constant force at each joint: a torque sensor's or current's offset, or uneven friction."""

    def parameters(self, robot):
        """`fo1`, … [N m or N]."""
        return each_joint(robot, "fo", "N m", "N")

    def columns(self, robot, q, qd, qdd):
        """The identity."""
        return jnp.eye(robot.joints, dtype=q.dtype)


class RotorInertia(AbstractTerm):
    r"""Inertia of the motors' rotors, felt through the gear: $i_{Gk}^2 C_{M,k}$ (Eq. 17)."""

    def parameters(self, robot):
        """`Ia1`, … [kg m² or kg]."""
        return each_joint(robot, "Ia", "kg m²", "kg")

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrix of accelerations."""
        return jnp.diag(qdd)

    def lower_bounds(self, robot):
        """Rotors are not lighter than nothing."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """The diagonal of the inertia."""
        return one_drive_each(robot, order=0)


class LinearSpring(AbstractTerm):
    """A spring at each joint that pulls it to a rest position, such as a counterbalance.

    Attributes:
        rest: Position without force [rad or m]; an unknown one shows up as a `ConstantOffset`.
    """

    rest: float | Float[AnyArray, " joints"] = eqx.field(converter=one_or_each, default=0.0)

    def parameters(self, robot):
        """`ks1`, … [N m/rad or N/m]."""
        return each_joint(robot, "ks", "N m/rad", "N/m")

    def columns(self, robot, q, qd, qdd):
        """The diagonal matrix of deflections."""
        return jnp.diag(q - matching("rest", self.rest, q))

    def potential_columns(self, robot, q):
        """Half the squares of the deflections."""
        return 0.5 * (q - self.rest) ** 2


class CoupledDrives(AbstractTerm):
    r"""What motors that turn more than one axis add to the drives' own columns.

    A motor whose row of the reduction has further entries beside that of its own joint feels
    its rotor inertia and friction on all of these axes. The diagonal parts belong to
    `RotorInertia`, `ViscousFriction` and `CoulombFriction` of the axes; here are the parts beside
    the diagonal, and the Coulomb friction of the motor's own motion.

    Attributes:
        transition: Of the Coulomb friction, at speeds measured on the side of the motor's own
            joint [rad/s or m/s].
    """

    transition: AbstractTransition = Tanh()

    def couplings(self, robot: Robot) -> tuple[tuple[int, np.ndarray], ...]:
        """The motors that turn several axes, with their ratios relative to their own joint."""
        A = np.asarray(robot.drives.reduction)
        scale = np.abs(A).max()
        if not np.diag(A).all():
            motor = int(np.flatnonzero(np.diag(A) == 0)[0]) + 1
            raise InputError(
                f"`drives.reduction` of `{robot.name}` must name the motors in the order of their "
                f"joints, but motor {motor} does not turn joint {motor}: reorder its rows."
            )
        return tuple(
            (i, A[i] / A[i, i])
            for i in range(robot.joints)
            if A[i, i] != 0 and (np.abs(np.delete(A[i], i)) > 1e-12 * scale).any()
        )

    def parameters(self, robot):
        """`Iam6`, `fvm6`, `fcm6` for a coupled motor 6."""
        found = [i for i, _ in self.couplings(robot)]
        if not found:
            raise InputError(
                f"the drives of `{robot.name}` are not coupled: leave `CoupledDrives` out, or give "
                "`drives.reduction` as a matrix with entries beside its diagonal."
            )
        units = [
            ("kg m²", "N m s", "N m") if robot.revolute[i] else ("kg", "N s/m", "N") for i in found
        ]
        return tuple(
            (f"{name}{i + 1}", unit[k])
            for k, name in enumerate(("Iam", "fvm", "fcm"))
            for i, unit in zip(found, units, strict=True)
        )

    def columns(self, robot, q, qd, qdd):
        """Inertia and viscous parts beside the diagonal; Coulomb friction of the motor's motion."""
        inertia, viscous, dry = [], [], []
        for i, ratios in self.couplings(robot):
            beside = np.outer(ratios, ratios)
            np.fill_diagonal(beside, 0.0)
            inertia.append(beside.astype(qdd.dtype) @ qdd)
            viscous.append(beside.astype(qd.dtype) @ qd)
            r = ratios.astype(qd.dtype)
            # In the place of its own joint, whose width of the transition is the motor's.
            speeds = jnp.stack([jnp.dot(r, qd) if j == i else qd[j] for j in range(len(r))])
            dry.append(r * self.transition(speeds)[i])
        return jnp.stack([*inertia, *viscous, *dry], axis=1)

    def lower_bounds(self, robot):
        """Rotors and friction of the motors."""
        return np.zeros(len(self.parameters(robot)))

    def drive_matrices(self, robot):
        """What the coupled motors add beside the diagonals."""
        couplings = self.couplings(robot)
        n, found = robot.joints, len(couplings)
        matrices = np.zeros((2, n, n, 3 * found))
        for place, (_, ratios) in enumerate(couplings):
            beside = np.outer(ratios, ratios)
            np.fill_diagonal(beside, 0.0)
            matrices[0, :, :, place] = matrices[1, :, :, found + place] = beside
        return matrices
