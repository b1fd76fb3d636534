"""From motors to joints and back: gears, coupled axes, and the duality of power."""

import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, Numbers, namespace
from jaxid.errors import InputError
from jaxid.robot.limits import per_joint


class Drives(Hashable):
    r"""The motors of a robot: $q_M = A (q - q_0)$ and, by equal power, $Q = A^T M$ (Eq. 19).

    For independent axes $A$ is the diagonal matrix of gear ratios; a wrist whose motors turn more
    than one axis has entries beside the diagonal.

    Attributes:
        reduction: $A$, motor angle for joint angle; [1] for a revolute joint, [rad/m] for a rail.
        zero: Joint angle $q_0$ at which the motor angles are zero [rad or m].
        max_torques: Largest torque of each motor, on the motor's side [N m]; infinite if unknown.
        rotor_inertia: Inertia of each motor, on the motor's side [kg m²]; NaN if unknown.
            It is shown, not used: what the joints feel of it is identified.
    """

    reduction: Float[AnyArray, "joints joints"]
    zero: Float[AnyArray, " joints"]
    max_torques: Float[AnyArray, " joints"]
    rotor_inertia: Float[AnyArray, " joints"]

    @classmethod
    def of(
        cls,
        joints: int,
        *,
        reduction: Numbers | None = None,
        zero: Numbers | None = None,
        max_torques: Numbers | None = None,
        rotor_inertia: Numbers | None = None,
    ) -> "Drives":
        """Builds drives from gear ratios (one for each joint) or a full matrix; direct if None.

        Raises:
            InputError: If a length is wrong, the matrix cannot be inverted, or a number cannot be.
        """
        matrix = np.eye(joints) if reduction is None else np.array(reduction, dtype=np.float64)
        if matrix.shape == (joints,):
            matrix = np.diag(matrix)
        if matrix.shape != (joints, joints) or not np.isfinite(matrix).all():
            raise InputError(
                f"`reduction` must be {joints} gear ratios or a {joints} x {joints} matrix of "
                f"finite numbers, but has shape {matrix.shape}."
            )
        largest = np.abs(matrix).max(axis=1)
        if not largest.all() or np.linalg.cond(matrix / largest[:, None]) > 1e8:
            raise InputError(
                "`reduction` must be invertible, but some joint is moved by no motor of its own: "
                "is a gear ratio zero?"
            )
        found = {
            "zero": per_joint("zero", zero, joints, 0.0),
            "max_torques": per_joint("max_torques", max_torques, joints, np.inf),
            "rotor_inertia": per_joint("rotor_inertia", rotor_inertia, joints, np.nan),
        }
        for key, wrong, rule in (
            ("zero", ~np.isfinite(found["zero"]), "finite"),
            ("max_torques", found["max_torques"] <= 0.0, "positive"),
            ("rotor_inertia", found["rotor_inertia"] < 0.0, "zero or more"),
        ):
            if wrong.any():
                j = int(np.flatnonzero(wrong)[0])
                raise InputError(
                    f"`{key}` must be {rule}, but that of joint {j + 1} is {found[key][j]:g}."
                )
        return cls(matrix, **found)

    @property
    def is_direct(self) -> bool:
        """Whether motor and joint are the same thing: unit gears and no offset."""
        eye = np.eye(len(self.zero))
        return np.array_equal(self.reduction, eye) and not np.any(self.zero)

    @property
    def _inverse(self) -> Float[AnyArray, "joints joints"]:
        return namespace(self.reduction).linalg.inv(self.reduction)

    def _zeros(self, like: AnyArray) -> AnyArray:
        return namespace(like, self.zero).broadcast_to(self.zero, like.shape)

    def joint_angles(
        self, motor_angles: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Joint angles [rad or m] of motor angles [rad]."""
        return self.joint_velocities(motor_angles) + self._zeros(motor_angles)

    def joint_velocities(
        self, motor_velocities: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Joint velocities [rad/s or m/s] of motor velocities [rad/s]; accelerations likewise."""
        return motor_velocities @ self._inverse.T

    def joint_forces(
        self, motor_torques: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Generalized forces [N m or N] of motor torques [N m] (Eq. 19)."""
        return motor_torques @ self.reduction

    def motor_angles(
        self, angles: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Motor angles [rad] of joint angles [rad or m]."""
        return self.motor_velocities(angles - self._zeros(angles))

    def motor_velocities(
        self, velocities: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Motor velocities [rad/s] of joint velocities [rad/s or m/s]."""
        return velocities @ self.reduction.T

    def motor_torques(
        self, forces: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Motor torques [N m] of generalized forces [N m or N]."""
        return forces @ self._inverse

    @property
    def max_forces(self) -> Float[AnyArray, " joints"]:
        r"""Largest generalized forces of the motors, $|A|^T M_{max}$ [N m or N] (Eq. 30)."""
        weights = np.abs(self.reduction)
        used = np.where(weights > 0, self.max_torques[:, None], 0.0)
        return (weights * used).sum(axis=0)
