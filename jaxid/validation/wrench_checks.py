"""Wrenches of force sensors: frame, sign, order, compensation and taring.

Gravity of a load turns with a sensor at the wrist. Its forces at many attitudes tell
along which axes the wrench is written, and whether gravity is in it at all. A sensor
under the base does not turn. There the motion of the arm tells the axes: moving bodies
explain the wrench along the right axes only.
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
from jaxid.measurement.sensor_turns import TurnedVectors
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
        remarks.append(Remark(OPPOSITE_SIGN, Status.BAD))
    rotation = sign * turn.T
    if _angle(rotation) > LIMITS.max_angle:
        text = _turn_text(np.asarray(robot.tip_rotation).T, rotation, "gravity")
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


class BaseWrenchLimits(NamedTuple):
    """When the wrench of a sensor under the base is not the one that is described.

    Set on simulated logs of a Panda, shown on a UR5 and an iiwa.
    """

    rows: int = 300  # rows of the log that are looked at
    tie: float = 1.1  # ratio of what turns leave unexplained that are equally good
    certain: float = 0.5  # remaining part of the unexplained if another way is right
    doubtful: float = 0.98  # remaining part if the sensor may be turned a little
    max_angle: float = np.deg2rad(1.5)  # of a rotation that is not named


BASE_LIMITS = BaseWrenchLimits()


def base_wrench_remarks(model: Model, observations: Observations) -> list[Remark]:
    """Return what is wrong with the wrench of a sensor under the base, if any.

    Args:
        model: Model of the robot with the sensor.
        observations: Observations of a log.
    """
    rows = slice(None, None, -(-observations.rows // BASE_LIMITS.rows))
    motion = observations.reduced_motion[rows]
    columns = np.asarray(model.regressor(motion))[:, :GROUP]
    columns = columns.reshape(-1, 2, 3, model.size)
    known = np.asarray(model.tool_forces(motion))[:, :GROUP].reshape(-1, 2, 3)
    measured = observations.reduced_forces[rows, :GROUP].reshape(-1, 2, 3)
    # Forces and moments count alike, whichever are larger.
    sizes = np.sqrt(np.mean(np.var(measured, axis=0), axis=1))
    sizes = np.maximum(sizes, 1e-300)
    wrench = TurnedVectors.of(measured, known, columns, sizes)
    exchanged = TurnedVectors.of(measured[:, ::-1], known, columns, sizes[::-1])
    turn = wrench.least_turn(BASE_LIMITS.tie)
    error_if_exchanged = exchanged.error(exchanged.least_turn(BASE_LIMITS.tie))
    if error_if_exchanged < BASE_LIMITS.certain * wrench.error(turn):
        text = (
            "forces and moments are exchanged: the bodies of the robot explain the "
            "last three columns of `wrench` as forces. Name the three forces first."
        )
        return [Remark(text, Status.BAD)]
    remarks = _base_turn_remarks(model.robot, wrench, turn)
    p = wrench.unknowns(turn)
    M = np.asarray(model.mass_matrix(p, motion.q))[:, GROUP:, GROUP:]
    # Bodies of negative mass explain a wrench of the other sign as well.
    if np.trace(M, axis1=1, axis2=2).mean() < 0.0:
        remarks.insert(0, Remark(OPPOSITE_SIGN, Status.BAD))
    return remarks


def _base_turn_remarks(
    robot: Robot, wrench: TurnedVectors, turn: Matrix3
) -> list[Remark]:
    """Return that a sensor under the base is turned, if that explains more."""
    unexplained_part = wrench.error(turn) / wrench.error(np.eye(3))
    is_small = _angle(turn) <= BASE_LIMITS.max_angle
    if is_small or unexplained_part >= BASE_LIMITS.doubtful:
        return []
    text = _turn_text(np.asarray(robot.rotation)[0], turn, "the motion")
    is_certain = unexplained_part < BASE_LIMITS.certain
    return [Remark(text, Status.BAD if is_certain else Status.DOUBTFUL)]


OPPOSITE_SIGN = (
    "the wrench has the opposite sign: it is the wrench of the load on the sensor. "
    "Give `sign = -1` in `[sensor]`, or multiply it by -1."
)


def _angle(turn: Matrix3) -> float:
    """Return the angle of a rotation [rad]."""
    return float(scipy.spatial.transform.Rotation.from_matrix(turn).magnitude())


def _turn_text(described: Matrix3, turn: Matrix3, witness: str) -> str:
    """Return that the sensor is turned, and the attitude to write into the file."""
    attitude = scipy.spatial.transform.Rotation.from_matrix(described @ turn)
    numbers = ", ".join(f"{x:.1f}" for x in attitude.as_euler("xyz", degrees=True))
    return (
        f"the wrench is turned by {significant(np.rad2deg(_angle(turn)), 2)} "
        f"degrees against its description: {witness} says that roll, pitch and yaw of "
        f"the sensor are about [{numbers}] degrees. Give them as `rotation` in "
        "`[sensor]`, or turn the wrench."
    )
