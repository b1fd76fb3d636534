"""Logs of a floating base: motion from its IMU, and rows without contact forces.

The accelerometer measures gravity too, so that attitude, velocity and position of the
base are not needed. Only the lowest point of a ball foot depends on the vertical: the
mean direction of the measured acceleration, since a base does not accelerate forever.
"""

import dataclasses
import itertools

import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Matrix
from jaxid.dynamics.contact_elimination import elimination
from jaxid.dynamics.motion import Motion, floating_motion
from jaxid.errors import InputError
from jaxid.robot.contacts import legs_of
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.virtual_joints import on_all_joints

from .filters import AbstractFilter
from .recording import BaseSignals, Recording
from .samples import SamplesInMemory, joined, joint_side
from .time_grid import Range, TimeGrid

GUARD = 0.1
"""Time around each change of contact that is left out: flags are early or late [s]."""
VERTICAL_TIME = 2.0
"""Time over which the acceleration is averaged to find the vertical [s]."""


def base_of(recording: Recording, robot: Robot) -> BaseSignals:
    """Return the signals of the base of a recording.

    Raises:
        InputError: If the recording has none, or flags of other contacts.
    """
    signals = recording.base
    if signals is None:
        raise InputError(
            f"`{recording.name}` has no signals of an IMU, which a floating base "
            "needs: name the columns `gyro`, `accelerometer` and `contact`."
        )
    if recording.forces is None:
        raise InputError(
            f"`{recording.name}` has no forces, which a floating base needs: name "
            "their columns (`forces`)."
        )
    if signals.contacts.size and not robot.contacts:
        raise InputError(
            f"`{robot.name}` has no contacts with the ground: name the links of its "
            "feet (`robot.contacts`)."
        )
    if signals.contacts.shape[1] != len(robot.contacts):
        names = ", ".join(contact.name for contact in robot.contacts)
        raise InputError(
            f"`contact` of `{recording.name}` has {signals.contacts.shape[1]} columns, "
            f"but `{robot.name}` has {len(robot.contacts)} contacts ({names}): name "
            "one column for each."
        )
    return signals


def contact_grid(recording: Recording, robot: Robot) -> TimeGrid:
    """Return the stretches of a recording without a change of contact, and guards."""
    grid = recording.grid
    stands = base_of(recording, robot).stands
    guard = round(GUARD / grid.sample_time)
    segments = {}
    for (a, b), time in grid.segments.items():
        is_change = (np.diff(stands[a:b].astype(int), axis=0) != 0).any(axis=1)
        changes = (a + 1 + np.flatnonzero(is_change)).tolist()
        for start, stop in itertools.pairwise([a, *changes, b]):
            first = start if start == a else start + guard
            end = stop if stop == b else stop - guard
            if end > first:
                segments[first, end] = time + (first - a) * grid.sample_time
    return grid._replace(segments=segments)


def floating_samples(
    recording: Recording, robot: Robot, filter: AbstractFilter, segments: list[Range]
) -> SamplesInMemory:
    """Return motion and forces, without those of contacts, of some stretches."""
    signals = base_of(recording, robot)
    measured_forces = np.asarray(recording.forces)
    q, qd, forces = joint_side(
        robot, recording, recording.angles, recording.velocities, measured_forces
    )
    parts = []
    for a, b in recording.segments:
        samples = slice(a, b)
        joint_motion = filter.motion(
            q[samples], None if qd is None else qd[samples], recording.sample_time
        )
        signals_of_part = dataclasses.replace(
            signals,
            rates=np.asarray(signals.rates)[samples],
            accelerations=np.asarray(signals.accelerations)[samples],
            contacts=np.asarray(signals.contacts)[samples],
        )
        motion = _with_base(
            robot, joint_motion, signals_of_part, filter, recording.sample_time
        )
        parts.append((motion, all_forces(robot, motion, forces[samples])))
    motion, every_force = joined(parts)
    stretches = [(motion[a:b], every_force[a:b]) for a, b in segments]
    return SamplesInMemory(*joined(stretches))


def _with_base(
    robot: Robot,
    joints: Motion,
    signals: BaseSignals,
    filter: AbstractFilter,
    sample_time: float,
) -> Motion:
    """Return the motion of all joints and the base, with what eliminates contacts."""
    attitude = rpy_rotation(robot.imu.rpy)
    turning = filter.motion(signals.rates @ attitude.T, None, sample_time)
    measured = signals.accelerations @ attitude.T
    rates = turning.q
    angular_accelerations = turning.qd
    arm = np.asarray(robot.imu.position)
    accelerations = filter.motion(measured, None, sample_time).q
    accelerations = accelerations - np.cross(angular_accelerations, arm)
    accelerations = accelerations - np.cross(rates, np.cross(rates, arm))
    motion = floating_motion(
        joints.q, joints.qd, joints.qdd, accelerations, rates, angular_accelerations
    )
    if not robot.contacts:
        return motion
    up = vertical(rates, accelerations, sample_time)
    entries = elimination(robot, motion.q, up, signals.stands)
    return dataclasses.replace(motion, contacts=entries)


def vertical(
    rates: AnyArray, accelerations: AnyArray, sample_time: float
) -> Float[np.ndarray, "samples 3"]:
    """Return unit vectors against gravity in the frame of the base.

    The rates tell how the base turns; along axes that do not turn, the mean of the
    measured acceleration is that of gravity.
    """
    rotation = scipy.spatial.transform.Rotation
    steps = rotation.from_rotvec(rates * sample_time).as_matrix()
    # Products of the first 1, 2, 4, ... steps: attitudes relative to the first one.
    attitudes = np.concatenate([np.eye(3)[None], steps[:-1]])
    shift = 1
    while shift < len(attitudes):
        products = attitudes[:-shift] @ attitudes[shift:]
        attitudes = np.concatenate([attitudes[:shift], products])
        shift *= 2
    inertial = np.einsum("nij,nj->ni", attitudes, accelerations)
    width = min(round(VERTICAL_TIME / sample_time), len(inertial))
    mean = inertial
    for _ in range(2):
        mean = scipy.ndimage.uniform_filter1d(mean, width, axis=0, mode="nearest")
    up = np.einsum("nji,nj->ni", attitudes, mean)
    return up / np.linalg.norm(up, axis=1, keepdims=True)


def all_forces(robot: Robot, motion: Motion, forces: Matrix) -> Matrix:
    """Return the forces of all rows: those of the base come from standing legs."""
    every_force = on_all_joints(robot, forces)
    if motion.contacts is not None:
        legs = legs_of(robot)
        X = motion.contacts.reshape(len(forces), len(legs.rows), len(legs.joints))
        leg_forces = every_force[:, list(legs.joints)]
        every_force[:, list(legs.rows)] -= np.einsum("nij,nj->ni", X, leg_forces)
    return every_force


def all_standing(recording: Recording, robot: Robot) -> Recording:
    """Return a recording in which all feet are called standing."""
    signals = base_of(recording, robot)
    contacts = np.ones(signals.contacts.shape)
    signals = dataclasses.replace(signals, contacts=contacts)
    return dataclasses.replace(recording, base=signals)


def measured_gravity(recording: Recording, robot: Robot) -> float:
    """Return the mean acceleration along the vertical [m/s²], as if without gaps."""
    signals = base_of(recording, robot)
    attitude = rpy_rotation(robot.imu.rpy)
    rates = np.asarray(signals.rates) @ attitude.T
    accelerations = np.asarray(signals.accelerations) @ attitude.T
    up = vertical(rates, accelerations, recording.sample_time)
    return float(np.mean(np.sum(up * accelerations, axis=1)))


def plane_normal(feet: Float[np.ndarray, "samples feet 3"]) -> np.ndarray:
    """Return the normal of the plane of the feet, towards the base [samples 3]."""
    deviations = feet - feet.mean(axis=1, keepdims=True)
    normal = np.linalg.svd(deviations)[2][:, 2]
    # The base is above the feet.
    height = np.sum(normal * feet[:, 0], axis=1, keepdims=True)
    return np.where(height > 0.0, -normal, normal)
