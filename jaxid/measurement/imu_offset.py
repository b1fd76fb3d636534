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
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.result_table import significant
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.virtual_joints import GROUP

from .filters import AbstractFilter
from .floating_base import base_of, contact_grid, plane_normal
from .recording import Recording
from .samples import joint_side
from .sensor_turns import TurnedVectors

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""


class ImuSettings(NamedTuple):
    """How the offset of an IMU is estimated; set on logs of a Go2."""

    max_step: float = 0.01  # time between two rows, at most [s]
    min_time: float = 2.0  # time in which all feet stand [s]
    block_time: float = 0.5  # errors of different blocks are independent [s]
    student: float = 2.2  # 95 % interval over the deviation, of some ten blocks
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
"""Inverse of the standard deviations of place and biases before the log."""


class _ImuRows(NamedTuple):
    """Rows of an IMU while all feet stand, as it measures them and as the legs tell.

    Each row is an angular velocity and an acceleration less gravity [rad/s, m/s²].

    Attributes:
        measured: Measured rows, with their biases.
        known: Rows of an IMU as it is described, as the legs tell them.
        columns: Columns of its displacement in the base, and of the two biases along
            the described axes.
        blocks: Number of the block of time of each row.
    """

    measured: Float[np.ndarray, "rows 2 3"]
    known: Float[np.ndarray, "rows 2 3"]
    columns: Float[np.ndarray, "rows 2 3 9"]
    blocks: AnyArray

    def vectors(self, noise: np.ndarray) -> TurnedVectors:
        """Return the rows with the standard deviations of their errors."""
        return TurnedVectors.of(self.measured, self.known, self.columns, noise, PRIOR)

    def errors(self, turn: Matrix3, unknowns: np.ndarray) -> np.ndarray:
        """Return what is unexplained of turned rows."""
        return self.measured @ turn.T - self.known - self.columns @ unknowns

    def sizes(self, turn: Matrix3, unknowns: np.ndarray) -> np.ndarray:
        """Return the RMS of the errors of angular velocities and accelerations."""
        return np.sqrt(np.mean(self.errors(turn, unknowns) ** 2, axis=(0, 2)))

    def slopes(self, unknowns: np.ndarray) -> Float[np.ndarray, "rows 2 3 12"]:
        """Return the columns of a small turn, and of the unknowns."""
        displacement = self.columns[..., :3] @ unknowns[:3]
        motion = self.known + displacement
        turn_columns = [np.cross(motion, axis)[..., None] for axis in np.eye(3)]
        return np.concatenate([*turn_columns, self.columns], axis=3)

    def half_widths(
        self, turn: Matrix3, unknowns: np.ndarray, noise: np.ndarray
    ) -> Float[np.ndarray, "4 3"]:
        """Return half of the 95 % intervals of the estimates.

        Errors in blocks of time tell how uncertain the unknowns are.
        """
        slopes = self.slopes(unknowns) / noise[:, None, None]
        errors = self.errors(turn, unknowns) / noise[:, None]
        gradients = np.einsum("nbai,nba->ni", slopes, errors)
        sums = np.zeros((self.blocks.max() + 1, 12))
        np.add.at(sums, self.blocks, gradients)

        prior = np.zeros((12, 12))
        prior[3:, 3:] = np.diag(PRIOR**2)
        products = np.einsum("nbai,nbaj->ij", slopes, slopes)
        information = products + prior
        inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
        variation = sums.T @ sums + prior
        covariance = inverse @ variation @ inverse
        # All estimates but the place are along the axes of the IMU.
        axes = scipy.linalg.block_diag(turn, np.eye(3), turn, turn)
        variances = np.diag(axes.T @ covariance @ axes)
        half_widths = SETTINGS.student * np.sqrt(variances)
        return half_widths.reshape(4, 3)


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
    noise = np.array(SETTINGS.noise)
    vectors = rows.vectors(noise)
    turn = vectors.least_turn(SETTINGS.tie)
    # The final estimate uses the errors that are found.
    noise = rows.sizes(turn, vectors.unknowns(turn))
    vectors = rows.vectors(noise)
    turn = vectors.turn_near(turn)

    unknowns = vectors.unknowns(turn)
    angles = scipy.spatial.transform.Rotation.from_matrix(turn).as_rotvec()
    values = np.append(angles, unknowns).reshape(4, 3)
    values[2:] = values[2:] @ turn
    return ImuOffset(
        attitude=rpy_rotation(robot.imu.rpy) @ turn,
        values=values,
        half_widths=rows.half_widths(turn, unknowns, noise),
        errors=rows.sizes(turn, unknowns),
    )


def _acceleration_at(arm: Vector3, rates: AnyArray, changes: AnyArray) -> np.ndarray:
    """Return the acceleration of a point less that of the origin [samples 3]."""
    return np.cross(changes, arm) + np.cross(rates, np.cross(rates, arm))


def _imu_rows(
    recording: Recording, robot: Robot, filter: AbstractFilter
) -> _ImuRows | None:
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
    for a, b in contact_grid(recording, robot).segments:
        rows = slice(edge, b - a - edge, step)
        is_long = (b - a - 2 * edge) * sample_time > SETTINGS.block_time
        if not signals.stands[a].all() or not is_long:
            continue
        joints = filter.motion(q[a:b], None, sample_time)[rows]
        smooth = filter.motion(measured[a:b], None, sample_time).q[rows]
        known, columns = _motion_of_legs(robot, joints, row_time)
        numbers = np.arange(len(smooth)) * row_time // SETTINGS.block_time
        parts.append((smooth.reshape(-1, 2, 3), known, columns, numbers))
    if sum(len(part[0]) for part in parts) * row_time < SETTINGS.min_time:
        return None
    measured, known, columns, numbers = map(np.concatenate, zip(*parts, strict=True))
    blocks = np.cumsum(np.diff(numbers, prepend=0.0) != 0)
    return _ImuRows(measured, known, columns, blocks)


def _motion_of_legs(
    robot: Robot, joints: Motion, row_time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return `known` and `columns` of rows that are one after the other."""
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
    angles = np.zeros((len(joints.q), robot.joints))
    angles[:, list(robot.driven)] = joints.q
    order = np.argsort(robot.order)
    feet = [
        tip_jacobian(robot.replace(tip_body=x.body, tip_offset=x.position), angles)
        for x in robot.contacts
    ]
    up = plane_normal(np.stack([foot.position for foot in feet], axis=1))
    slopes = [
        contact.shape.jacobian(foot.velocity[:, order], foot.turn[:, order], up)
        for contact, foot in zip(robot.contacts, feet, strict=True)
    ]
    slopes = np.concatenate(slopes, axis=2)
    by_joints = np.einsum("njf,nj->nf", slopes[:, list(robot.driven)], joints.qd)
    by_base = np.moveaxis(slopes[:, :GROUP], 1, 2)
    twist = -np.einsum("nif,nf->ni", np.linalg.pinv(by_base), by_joints)
    return twist, up
