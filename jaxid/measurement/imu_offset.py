"""Rotation, place and biases of an IMU on a floating base, told by its legs.

While all feet stand on level ground, the joints alone tell how the base moves. This is
compared with what the IMU measures: a constant difference is a bias, and a difference
that depends on the motion shows another attitude or place.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix3, Vector3
from jaxid.dynamics.contact_elimination import contact_jacobians, contact_tips
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.result_table import significant
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.virtual_joints import GROUP, on_all_joints

from .filters import AbstractFilter
from .floating_base import base_of, contact_grid, plane_normal
from .recording import Recording
from .samples import joint_side
from .sensor_turns import SensorRows, half_widths

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""


class ImuSettings(NamedTuple):
    """How the offset of an IMU is estimated; set on logs of a Go2."""

    max_step: float = 0.01  # time between two rows, at most [s]
    min_time: float = 2.0  # time in which all feet stand [s]
    block_time: float = 0.5  # errors of different blocks are independent [s]
    tie: float = 1.22  # ratio of the errors of equally good attitudes
    place: float = 0.1  # standard deviation of the place before the log [m]
    noise: tuple[float, float] = (0.02, 0.2)  # errors at first [rad/s, m/s²]


SETTINGS = ImuSettings()


NAMES = (
    "turned about its axes by [rad]",
    "displaced in the base by [m]",
    "bias of the gyroscope [rad/s]",
    "bias of the accelerometer [m/s²]",
)
"""Estimates with their units, each along x, y, z."""


class ImuOffset(NamedTuple):
    """How an IMU differs from its description, and what it explains.

    Attributes:
        attitude: Attitude of the IMU in the base.
        values: The estimates of `NAMES`.
        half_widths: Half of their 95 % intervals.
        errors: RMS of what is unexplained of gyroscope and accelerometer [rad/s, m/s²].
    """

    attitude: Matrix3
    values: Float[np.ndarray, "4 3"]
    half_widths: Float[np.ndarray, "4 3"]
    errors: Float[np.ndarray, "2"]

    def __str__(self):
        """Return the estimates with their intervals."""
        texts = []
        for name, row, widths in zip(NAMES, self.values, self.half_widths, strict=True):
            pairs = zip(row, widths, strict=True)
            numbers = [f"{significant(x, 2)} ± {significant(y, 1)}" for x, y in pairs]
            texts.append(f"{name} {', '.join(numbers)}")
        text = f"the IMU against its description, x, y, z: {'; '.join(texts)}"
        if (self.half_widths[1] > SETTINGS.place).any():
            text += "; its place is hardly determined, since the trunk turns too little"
        return text

    def corrected(
        self, recording: Recording, robot: Robot, filter: AbstractFilter
    ) -> Recording:
        """Return what an IMU without bias would measure as it is described."""
        signals = base_of(recording, robot)
        _, arm, rate_bias, acceleration_bias = self.values
        rates = (np.asarray(signals.rates) - rate_bias) @ self.attitude.T
        accelerations = np.asarray(signals.accelerations) - acceleration_bias
        accelerations = accelerations @ self.attitude.T
        for a, b in recording.segments:
            turning = filter.motion(rates[a:b], None, recording.sample_time)
            accelerations[a:b] -= _acceleration_at(arm, turning.q, turning.qd)
        described = rpy_rotation(robot.imu.rpy)
        signals = dataclasses.replace(
            signals, rates=rates @ described, accelerations=accelerations @ described
        )
        notes = (*recording.notes, str(self))
        return dataclasses.replace(recording, base=signals, notes=notes)


PRIOR = np.repeat([1.0 / SETTINGS.place, 0.0, 0.0], 3)
"""Inverse of the standard deviations of displacement and biases before the log."""


def without_imu_offset(
    recording: Recording, robot: Robot, filter: AbstractFilter
) -> Recording:
    """Return a recording as of an IMU without bias that is where it is described.

    Raises:
        InputError: If the legs do not tell how the base moves.
    """
    offset = identify_imu_offset(recording, robot, filter)
    if offset is None:
        raise InputError(
            f"`imu_offset` needs a part of {SETTINGS.min_time:g} s in which all feet "
            f"stand, three at least, which `{recording.name}` does not have: record "
            "one, or leave `imu_offset` out."
        )
    return offset.corrected(recording, robot, filter)


def identify_imu_offset(
    recording: Recording, robot: Robot, filter: AbstractFilter
) -> ImuOffset | None:
    """Find how the IMU is mounted, and its biases; None where the legs do not tell.

    They tell it while all feet stand on level ground, three at least.
    """
    rows = _imu_rows(recording, robot, filter)
    if rows is None:
        return None
    estimate = rows.estimate(np.array(SETTINGS.noise), SETTINGS.tie)
    turn = estimate.turn
    # All values but the place are along the axes of the IMU.
    axes = scipy.linalg.block_diag(turn, np.eye(3), turn, turn)
    values = np.append(estimate.angles, estimate.unknowns) @ axes
    covariance = axes.T @ estimate.covariance @ axes
    return ImuOffset(
        attitude=rpy_rotation(robot.imu.rpy) @ turn,
        values=values.reshape(4, 3),
        half_widths=half_widths(covariance).reshape(4, 3),
        errors=estimate.errors,
    )


def _acceleration_at(arm: Vector3, rates: AnyArray, changes: AnyArray) -> np.ndarray:
    """Return the acceleration of a point less that of the origin [samples 3]."""
    return np.cross(changes, arm) + np.cross(rates, np.cross(rates, arm))


def _imu_rows(
    recording: Recording, robot: Robot, filter: AbstractFilter
) -> SensorRows | None:
    """Return the rows while all feet stand; None if that is too short."""
    if len(robot.contacts) < 3:
        return None
    signals = base_of(recording, robot)
    forces = np.asarray(recording.forces)
    q, _, _ = joint_side(robot, recording, recording.angles, None, forces)
    measured = np.hstack([signals.rates, signals.accelerations])
    sample_time = recording.sample_time
    edge = filter.edge(sample_time)
    step = max(1, int(SETTINGS.max_step / sample_time))
    row_time = step * sample_time
    parts = []
    blocks = 0
    for a, b in contact_grid(recording, robot).segments:
        rows = slice(edge, b - a - edge, step)
        is_long = (b - a - 2 * edge) * sample_time > SETTINGS.block_time
        if not signals.stands[a].all() or not is_long:
            continue
        joints = filter.motion(q[a:b], None, sample_time)[rows]
        smooth = filter.motion(measured[a:b], None, sample_time).q[rows]
        known, columns = _motion_of_legs(robot, joints, row_time)
        times = np.arange(len(smooth)) * row_time
        numbers = blocks + (times // SETTINGS.block_time).astype(int)
        blocks = numbers[-1] + 1
        parts.append((smooth.reshape(-1, 2, 3), known, columns, numbers))
    if sum(len(part[0]) for part in parts) * row_time < SETTINGS.min_time:
        return None
    measured, known, columns, numbers = map(np.concatenate, zip(*parts, strict=True))
    return SensorRows(measured, known, columns, PRIOR, numbers)


def _motion_of_legs(
    robot: Robot, joints: Motion, row_time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return what an IMU as described measures in rows that are one after the other.

    Columns of its displacement in the base, and of its two biases, are beside it.
    """
    twist, up = _base_twist(robot, joints)
    velocity = twist[:, :3]
    rates = twist[:, 3:]
    change = np.gradient(twist, row_time, axis=0)
    turning = change[:, 3:]
    accelerations = change[:, :3] + np.cross(rates, velocity)
    accelerations = accelerations + STANDARD_GRAVITY * up
    place = np.array(robot.imu.position)
    at_imu = accelerations + _acceleration_at(place, rates, turning)

    axes = rpy_rotation(robot.imu.rpy)
    known = np.stack([rates, at_imu], axis=1) @ axes
    columns = np.zeros((*known.shape, 9))
    for axis, unit in enumerate(np.eye(3)):
        columns[:, 1, :, axis] = _acceleration_at(unit, rates, turning) @ axes
    columns[:, 0, :, 3:6] = np.eye(3)
    columns[:, 1, :, 6:] = np.eye(3)
    return known, columns


def _base_twist(robot: Robot, joints: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Return velocity and angular velocity of the base, and the vertical.

    All are along the axes of the base; the contacts do not move.
    """
    feet = contact_tips(robot, on_all_joints(robot, joints.q))
    positions = np.stack([foot.position for foot in feet], axis=1)
    up = plane_normal(positions)
    jacobians = contact_jacobians(robot, feet, up)
    slopes = np.concatenate(jacobians, axis=2)
    by_driven = slopes[:, list(robot.driven)]
    by_joints = np.einsum("njf,nj->nf", by_driven, joints.qd)
    by_base = np.moveaxis(slopes[:, :GROUP], 1, 2)
    twist = -np.einsum("nif,nf->ni", np.linalg.pinv(by_base), by_joints)
    return twist, up
