"""Rotation, place and biases of an IMU on a floating base, told by its legs.

While all feet stand on level ground, the joints alone tell how the base moves, and so
what an IMU would measure at any place. The mean of what it does measure gives its
biases, and how it follows the motion its attitude and its place.
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

STANDARD_GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""


class ImuSettings(NamedTuple):
    """How the offset of an IMU is estimated; set on logs of a Go2."""

    max_step: float = 0.01  # time between two rows, at most [s]
    min_time: float = 2.0  # time in which all feet stand [s]
    block_time: float = 0.5  # errors of different blocks are independent [s]
    student: float = 2.2  # 95 % interval over the deviation, of some ten blocks
    steps: int = 8  # of Gauss and Newton, from each start
    tie: float = 1.5  # ratio of costs of equally good attitudes
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


class _Stance(NamedTuple):
    """Motion of the base as legs and IMU tell it, while all feet stand.

    Attributes:
        rates: Angular velocity of the base [rad/s].
        angular_accelerations: Its derivative [rad/s²].
        accelerations: Acceleration at the described place of the IMU, less gravity
            [m/s²].
        measured: What gyroscope and accelerometer measure, with their biases.
        blocks: Number of the block of time of each row.
    """

    rates: AnyArray
    angular_accelerations: AnyArray
    accelerations: AnyArray
    measured: AnyArray
    blocks: AnyArray


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
    stance = _stance(recording, robot, filter)
    if stance is None:
        return None
    described = rpy_rotation(robot.imu.rpy)
    quarter_turns = scipy.spatial.transform.Rotation.create_group("O").as_matrix()
    noise = np.array(SETTINGS.noise)
    fits = [_fit(stance, described @ turn, noise) for turn in quarter_turns]
    costs = [np.sum((fit.errors / noise) ** 2) for fit in fits]
    equals = [
        fit
        for fit, cost in zip(fits, costs, strict=True)
        if cost <= SETTINGS.tie * min(costs)
    ]
    # The trace of a turn falls with its angle.
    best = max(equals, key=lambda fit: np.trace(described.T @ fit.attitude))
    best = _fit(stance, best.attitude, best.errors)
    turn = scipy.spatial.transform.Rotation.from_matrix(described.T @ best.attitude)
    values = np.vstack([turn.as_rotvec(), best.values[1:]])
    return best._replace(values=values)


def _fit(stance: _Stance, attitude: Matrix3, noise: np.ndarray) -> ImuOffset:
    """Fit all unknowns to what the IMU measures, from an attitude on.

    The rotation among the values of the result is the last step, which is nothing.
    """
    prior = np.zeros((12, 12))
    prior[3:6, 3:6] = np.eye(3) / SETTINGS.place**2
    unknowns = np.zeros(12)
    scale = np.repeat(noise, 3)
    errors, slopes = _errors(stance, attitude, unknowns, scale)
    for _ in range(SETTINGS.steps):
        information = np.einsum("nki,nkj->ij", slopes, slopes)
        gradient = np.einsum("nki,nk->i", slopes, errors) - prior @ unknowns
        # An attitude of which nothing is known stays as it is.
        step = np.linalg.lstsq(information + prior, gradient, rcond=1e-12)[0]
        turn = scipy.spatial.transform.Rotation.from_rotvec(step[:3])
        attitude = attitude @ turn.as_matrix()
        unknowns = unknowns + step * (np.arange(12) > 2)
        errors, slopes = _errors(stance, attitude, unknowns, scale)
    information = np.einsum("nki,nkj->ij", slopes, slopes)
    # Errors in blocks of time tell how uncertain the unknowns are.
    sums = np.zeros((stance.blocks.max() + 1, 12))
    np.add.at(sums, stance.blocks, np.einsum("nki,nk->ni", slopes, errors))
    inverse = np.linalg.pinv(information + prior, rcond=1e-12, hermitian=True)
    covariance = inverse @ (sums.T @ sums + prior) @ inverse
    half_widths = SETTINGS.student * np.sqrt(np.diag(covariance))
    sizes = np.sqrt(np.mean(errors.reshape(-1, 2, 3) ** 2, axis=(0, 2)))
    return ImuOffset(
        attitude, unknowns.reshape(4, 3), half_widths.reshape(4, 3), sizes * noise
    )


def _errors(
    stance: _Stance, attitude: Matrix3, unknowns: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what is unexplained of the IMU [rows 6], and the slopes [rows 6 12].

    The slopes are those of what is explained; both are relative to a scale.
    """
    arm = unknowns[3:6]
    biases = unknowns[6:]
    motion = (stance.rates, stance.angular_accelerations)
    rates = stance.rates @ attitude
    accelerations = stance.accelerations + _acceleration_at(arm, *motion)
    accelerations = accelerations @ attitude
    slopes = np.zeros((len(rates), 6, 12))
    for axis, unit in enumerate(np.eye(3)):
        slopes[:, :3, axis] = np.cross(rates, unit)
        slopes[:, 3:, axis] = np.cross(accelerations, unit)
        acceleration = _acceleration_at(unit, *motion)
        slopes[:, 3:, 3 + axis] = acceleration @ attitude
    slopes[:, :, 6:] = np.eye(6)

    predicted = np.hstack([rates, accelerations])
    predicted = predicted + biases
    errors = np.asarray(stance.measured) - predicted
    return errors / scale, slopes / scale[:, None]


def _acceleration_at(arm: Vector3, rates: AnyArray, changes: AnyArray) -> np.ndarray:
    """Return the acceleration of a point less that of the origin [samples 3]."""
    return np.cross(changes, arm) + np.cross(rates, np.cross(rates, arm))


def _stance(
    recording: Recording, robot: Robot, filter: AbstractFilter
) -> _Stance | None:
    """Return the motion while all feet stand; None if that is too short."""
    if len(robot.contacts) < 3:
        return None
    signals = base_of(recording, robot)
    forces = np.asarray(recording.forces)
    q, _, _ = joint_side(robot, recording, recording.angles, None, forces)
    sample_time = recording.sample_time
    edge = filter.edge(sample_time)
    step = max(1, int(SETTINGS.max_step / sample_time))
    measured = np.hstack([signals.rates, signals.accelerations])
    parts = []
    for a, b in contact_grid(recording, robot).segments:
        rows = slice(edge, b - a - edge, step)
        is_long = (b - a - 2 * edge) * sample_time > SETTINGS.block_time
        if not signals.stands[a].all() or not is_long:
            continue
        joints = filter.motion(q[a:b], None, sample_time)[rows]
        smooth = filter.motion(measured[a:b], None, sample_time).q[rows]
        motion = _base_motion(robot, joints, step * sample_time)
        parts.append((*motion, smooth, np.arange(len(smooth)) * step * sample_time))
    if not parts:
        return None
    rates, turning, accelerations, smooth, times = map(
        np.concatenate, zip(*parts, strict=True)
    )
    if len(times) * step * sample_time < SETTINGS.min_time:
        return None
    blocks = np.cumsum(np.diff(times // SETTINGS.block_time, prepend=0.0) != 0)
    return _Stance(rates, turning, accelerations, smooth, blocks)


def _base_motion(
    robot: Robot, joints: Motion, row_time: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the first three fields of `_Stance`; the contacts do not move."""
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
    velocity = twist[:, :3]
    rates = twist[:, 3:]
    change = np.gradient(twist, row_time, axis=0)
    turning = change[:, 3:]
    accelerations = change[:, :3] + np.cross(rates, velocity) + STANDARD_GRAVITY * up
    place = np.array(robot.imu.position)
    return rates, turning, accelerations + _acceleration_at(place, rates, turning)
