"""Wrenches of force sensors against gravity: frame, sign, compensation and taring.

Gravity of a load turns with the sensor. Its forces at many attitudes tell along which
axes the wrench is written, and whether gravity is in it at all.
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Float, Matrix3
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import SensorLoad
from jaxid.measurement.force_sensors import sensor_attitudes
from jaxid.measurement.observations import Observations
from jaxid.result_table import Remark, Status, significant
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import GROUP

Forces = Float[np.ndarray, "rows 3"]


class WrenchLimits(NamedTuple):
    """When a wrench is not the one that the description says.

    Shares are those of the RMS of the forces without their mean. Set on simulated logs
    of a Panda with 1.35 kg, shown on a UR5 with 0.62 kg.
    """

    min_spread: float = 0.3  # least over largest gain: attitudes vary enough
    max_unexplained: float = 0.5  # share that the right axes leave at most
    improvement: float = 0.5  # remaining part of it along other axes
    max_angle: float = np.deg2rad(10.0)  # of a mounting that is not described
    absent: float = 0.25  # gravity over inertia below which it is taken out
    tared: float = 0.1  # force at the start over gravity of the load
    min_mass: float = 0.02  # of a load that gravity tells clearly [kg]


LIMITS = WrenchLimits()


class _Gravity(NamedTuple):
    """Forces as a linear function of the load's acceleration less gravity.

    Attributes:
        gain: Matrix of the function: the mass times a rotation, if all is right [kg].
        bias: Force without any acceleration [N].
        unexplained: RMS of what the function misses, as a share of the forces.
    """

    gain: Matrix3
    bias: np.ndarray
    unexplained: float


def wrench_remarks(robot: Robot, observations: Observations) -> list[Remark]:
    """Return what is wrong with the wrench of the sensor at the end-effector, if any.

    Args:
        robot: Robot with the sensor.
        observations: Observations of a log with a load behind it.
    """
    rows = list(robot.rigid[-GROUP:][:3])
    if rows[:1] in ([], [0]):
        return []
    motion = observations.reduced_motion
    forces = observations.reduced_forces[:, rows]
    model = Model(robot, (SensorLoad(),))
    rest = np.zeros_like(motion.q)
    accelerations, at_rest = (
        np.asarray(model.regressor(x))[:, rows, 0]
        for x in (motion, Motion(motion.q, rest, rest))
    )
    as_described = _gravity(forces, accelerations)
    moments = observations.reduced_forces[:, list(robot.rigid[-GROUP:][3:])]
    if _are_forces(moments, accelerations) and not _are_forces(forces, accelerations):
        text = (
            "forces and moments are exchanged: gravity acts on the last three columns "
            "of `wrench` as on forces. Name the three forces first."
        )
        return [Remark(text, Status.BAD)]
    if _lacks_gravity(forces, at_rest, accelerations - at_rest):
        text = (
            "the wrench lacks the gravity of the load, which the controller or the "
            "driver takes out: set the load to zero there, and record again."
        )
        return [Remark(text, Status.BAD)]
    attitudes = sensor_attitudes(robot, np.asarray(motion.q))
    along_sensor = np.einsum("nji,nj->ni", attitudes, forces)
    in_ground = _gravity(along_sensor, accelerations)
    if in_ground.unexplained < LIMITS.improvement * as_described.unexplained:
        text = (
            "the wrench is along the axes of the ground, not of the sensor: gravity is "
            "the same at all attitudes. Give `in_ground = true` in `[sensor]`, or "
            "record the wrench in the sensor's frame."
        )
        return [Remark(text, Status.BAD)]
    return [*_axes_remarks(robot, as_described), *_taring(forces, as_described)]


def _gravity(forces: Forces, accelerations: Forces) -> _Gravity:
    """Return the best linear function from accelerations to forces."""
    ones = np.ones((len(forces), 1))
    columns = np.hstack([accelerations, ones])
    solution, *_ = np.linalg.lstsq(columns, forces, rcond=None)
    errors = forces - columns @ solution
    spread = max(float(np.std(forces, axis=0) @ np.std(forces, axis=0)), 1e-300)
    unexplained = np.sqrt(np.mean(np.sum(errors**2, axis=1)) / spread)
    return _Gravity(solution[:3].T, solution[3], float(unexplained))


def _are_forces(values: Forces, accelerations: Forces) -> bool:
    """Return whether gravity acts alike along all axes, which it does on no moment."""
    gravity = _gravity(values, accelerations)
    gains = np.linalg.svd(gravity.gain, compute_uv=False)
    is_explained = gravity.unexplained < LIMITS.max_unexplained
    return bool(is_explained and gains[-1] > LIMITS.min_spread * gains[0])


def _lacks_gravity(forces: Forces, gravity: Forces, inertia: Forces) -> bool:
    """Return whether the forces of accelerations are there, and gravity is not."""
    # Both are forces of the same mass; the mean holds the bias.
    sides = [(x - x.mean(axis=0)).ravel() for x in (gravity, inertia)]
    centred = (forces - forces.mean(axis=0)).ravel()
    columns = np.column_stack(sides)
    masses, *_ = np.linalg.lstsq(columns, centred, rcond=None)
    by_inertia = np.linalg.norm(masses[1] * sides[1])
    is_seen = by_inertia > LIMITS.max_unexplained * np.linalg.norm(centred)
    return bool(is_seen and abs(masses[0]) < LIMITS.absent * masses[1])


def _axes_remarks(robot: Robot, gravity: _Gravity) -> list[Remark]:
    """Return that the wrench has another unit or sign, or is along other axes."""
    U, gains, Vt = np.linalg.svd(gravity.gain)
    is_clear = gains[-1] > LIMITS.min_spread * gains[0]
    if not is_clear or gravity.unexplained > LIMITS.max_unexplained:
        return []
    turn = U @ Vt
    sign = float(np.sign(np.linalg.det(turn)))
    remarks = []
    mass = float(np.mean(gains))
    if mass < LIMITS.min_mass:
        text = (
            f"gravity says that the load has only {significant(1e3 * mass, 2)} g: are "
            "the forces in another unit, such as kN? Write N and N m into the log."
        )
        remarks.append(Remark(text, Status.BAD))
    if sign < 0:
        text = (
            "the wrench has the opposite sign: it is the wrench of the load on the "
            "sensor. Give `sign = -1` in `[sensor]`, or multiply it by -1."
        )
        remarks.append(Remark(text, Status.BAD))
    rotation = scipy.spatial.transform.Rotation.from_matrix(sign * turn.T)
    angle = rotation.magnitude()
    if angle > LIMITS.max_angle:
        described = scipy.spatial.transform.Rotation.from_matrix(robot.tip_rotation.T)
        angles = (described * rotation).as_euler("xyz", degrees=True)
        numbers = ", ".join(f"{x:.0f}" for x in angles)
        text = (
            f"the wrench is turned by {significant(np.rad2deg(angle), 2)} degrees "
            "against its description: gravity says that roll, pitch and yaw of the "
            f"sensor are about [{numbers}] degrees. Give them as `rotation` in "
            "`[sensor]`, or turn the wrench."
        )
        remarks.append(Remark(text, Status.BAD))
    return remarks


def _taring(forces: Forces, gravity: _Gravity) -> list[Remark]:
    """Return that the driver has set the wrench to zero at the start of the log."""
    weight = 9.81 * np.linalg.norm(gravity.gain, 2)
    is_zero = np.linalg.norm(forces[0]) < LIMITS.tared * weight
    if not is_zero or np.linalg.norm(gravity.bias) < weight / 2:
        return []
    text = (
        "the force is zero at the start of the log: the driver was tared there with "
        "the load on. The bias takes it into account; the mass is not affected."
    )
    return [Remark(text)]
