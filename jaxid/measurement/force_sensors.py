"""Wrenches of force sensors as rows of virtual joints, and torques that are missing."""

import dataclasses

import numpy as np

from jaxid.arrays import AnyArray, Numbers
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import per_joint
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import GROUP, on_all_joints

from .recording import Recording
from .samples import MotionAndForces, joint_side


def refuse_missing_wrench(recording: Recording, robot: Robot) -> None:
    """Refuse a recording whose wrenches are not those of the robot's sensors."""
    wrench = recording.wrench
    columns = 0 if wrench is None else wrench.shape[1]
    if columns != len(robot.rigid):
        raise InputError(
            f"`wrench` of `{recording.name}` must have {len(robot.rigid)} columns, six "
            f"for each force sensor of `{robot.name}`, but has {columns}: name the "
            "columns, or describe the sensor by `robot.with_sensor()`; of the commands "
            "only `jaxid payload` uses `[sensor]`, and with `under_base = true` only "
            "`jaxid identify` and `jaxid inspect`."
        )
    if wrench is not None and columns and not np.ptp(wrench, axis=0).any():
        raise InputError(
            f"all columns of `wrench` of `{recording.name}` are constant: the driver "
            "measures nothing; switch the sensor on, or name other columns."
        )


def with_wrench(
    robot: Robot, motion: Motion, forces: AnyArray, wrench: AnyArray
) -> MotionAndForces:
    """Return motion and forces of all joints, from those of the driven ones.

    Virtual joints do not move; their forces are the wrenches of the sensors.
    """
    q, qd, qdd = (on_all_joints(robot, x) for x in (motion.q, motion.qd, motion.qdd))
    all_forces = on_all_joints(robot, forces)
    all_forces[:, list(robot.rigid)] = wrench
    return Motion(q, qd, qdd), all_forces


def along_sensor_axes(recording: Recording, robot: Robot) -> Recording:
    """Return a recording whose wrench was along the ground's axes, along the sensor's.

    Args:
        recording: Recording, whose moments are about the sensor's origin.
        robot: Robot with the sensor at its end-effector.
    """
    angles, _, _ = joint_side(
        robot, recording, recording.angles, None, np.zeros(recording.angles.shape)
    )
    attitudes = sensor_attitudes(robot, on_all_joints(robot, angles))
    on_ground = np.asarray(recording.wrench).reshape(-1, 2, 3)
    wrench = np.einsum("nji,nkj->nki", attitudes, on_ground)
    return dataclasses.replace(recording, wrench=wrench.reshape(-1, GROUP))


def sensor_attitudes(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Return the attitudes of the sensor at the end-effector on the ground."""
    sensor = robot.replace(tip_body=robot.rigid[-1], tip_rotation=np.eye(3))
    return tip_jacobian(sensor, q).rotation


def measured_joints(robot: Robot, recording: Recording) -> np.ndarray:
    """Return for each joint whether its force is measured."""
    is_measured = np.ones(robot.joints, bool)
    is_measured[list(robot.driven)] = recording.forces is not None
    return is_measured


def speeds_of_all_joints(robot: Robot, min_speed: Numbers | None) -> Numbers | None:
    """Return smallest speeds of rows that count; virtual joints have none."""
    if min_speed is None or not robot.virtual:
        return min_speed
    speeds = per_joint("min_speed", min_speed, len(robot.driven), 0.0)
    return on_all_joints(robot, speeds)
