"""Drives: gears between motors and joints, coupled axes, and the duality of power."""

import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, Numbers, namespace
from jaxid.errors import InputError
from jaxid.robot.limits import count_joints, per_joint, require


class Drives(Hashable):
    r"""The motors of a robot: $q_M = A (q - q_0)$ and, by equal power, $Q = A^T M$ (Eq. 19).

    For independent axes $A$ is the diagonal matrix of gear ratios; a wrist whose motors turn more
    than one axis has entries beside the diagonal. Drives without arguments are direct.

    Args:
        joints: Number of joints; that of the given values if None.
        reduction: $A$, motor angle for joint angle: one gear ratio for each joint, or a matrix; [1]
            for a revolute joint, [rad/m] for a rail.
        zero: Joint angle $q_0$ at which the motor angles are zero [rad or m].
        max_torques: Largest torque of each motor, on the motor's side [N m]; infinite if unknown.
        rotor_inertia: Inertia of each motor, on the motor's side [kg m²]; NaN if unknown. It is
            displayed only: the inertia that the joints feel is identified.

    Raises:
        InputError: If a length is wrong, the matrix is not invertible, or a number is out of range.
    """

    reduction: Float[AnyArray, "joints joints"]
    zero: Float[AnyArray, " joints"]
    max_torques: Float[AnyArray, " joints"]
    rotor_inertia: Float[AnyArray, " joints"]

    def __init__(
        self,
        joints: int | None = None,
        *,
        reduction: Numbers | None = None,
        zero: Numbers | None = None,
        max_torques: Numbers | None = None,
        rotor_inertia: Numbers | None = None,
    ):
        n = count_joints(joints, reduction, zero, max_torques, rotor_inertia)
        self.reduction = _reduction(reduction, n)
        self.zero = per_joint("zero", zero, n, 0.0)
        self.max_torques = per_joint("max_torques", max_torques, n, np.inf)
        self.rotor_inertia = per_joint("rotor_inertia", rotor_inertia, n, np.nan)
        require("zero", self.zero, np.isfinite, "finite")
        require("max_torques", self.max_torques, lambda x: x > 0, "positive")
        require("rotor_inertia", self.rotor_inertia, lambda x: ~(x < 0), "zero or more")

    @property
    def is_direct(self) -> bool:
        """Whether motors and joints coincide: unit gears and no offset."""
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
        """Return joint angles [rad or m] of motor angles [rad]."""
        return self.joint_velocities(motor_angles) + self._zeros(motor_angles)

    def joint_velocities(
        self, motor_velocities: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Return joint velocities [rad/s or m/s] of motor velocities [rad/s], or accelerations."""
        return motor_velocities @ self._inverse.T

    def joint_forces(
        self, motor_torques: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Return generalised forces [N m or N] of motor torques [N m] (Eq. 19)."""
        return motor_torques @ self.reduction

    def motor_angles(
        self, angles: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Return motor angles [rad] of joint angles [rad or m]."""
        return self.motor_velocities(angles - self._zeros(angles))

    def motor_velocities(
        self, velocities: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Return motor velocities [rad/s] of joint velocities [rad/s or m/s]."""
        return velocities @ self.reduction.T

    def motor_torques(
        self, forces: Float[AnyArray, "*batch joints"]
    ) -> Float[AnyArray, "*batch joints"]:
        """Return motor torques [N m] of generalised forces [N m or N]."""
        return forces @ self._inverse

    @property
    def max_forces(self) -> Float[AnyArray, " joints"]:
        r"""Largest generalised forces of the motors, $|A|^T M_{max}$ [N m or N] (Eq. 30)."""
        weights = np.abs(self.reduction)
        used = np.where(weights > 0, self.max_torques[:, None], 0.0)
        return (weights * used).sum(axis=0)


def _reduction(value: Numbers | None, joints: int) -> AnyArray:
    """Return the reduction as a checked matrix; a JAX matrix is taken as it is."""
    if isinstance(value, jax.Array) and value.ndim == 2:
        return value
    matrix = np.eye(joints) if value is None else np.array(value, dtype=np.float64)
    if matrix.shape == (joints,):
        matrix = np.diag(matrix)
    if matrix.shape != (joints, joints) or not np.isfinite(matrix).all():
        raise InputError(
            f"`reduction` must be {joints} gear ratios or a {joints} x {joints} matrix of finite "
            f"numbers, but has shape {matrix.shape}."
        )
    largest = np.abs(matrix).max(axis=1)
    if not largest.all() or np.linalg.cond(matrix / largest[:, None]) > 1e8:
        raise InputError(
            "`reduction` must be invertible, but some joint is moved by no motor of its own: is a "
            "gear ratio zero?"
        )
    return matrix
