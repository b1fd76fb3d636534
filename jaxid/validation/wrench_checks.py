"""Wrenches of force sensors: frame, sign, order, units, place, and what drivers do.

Bodies explain the wrench of the sensor that carries them, if it is read rightly: along
the axes of the description, forces first. So each other way to read it is tried, and
one that leaves much less unexplained is named. At the wrist it is gravity that tells
the axes, since its direction in the sensor changes; under the base it is the motion.
"""

from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Matrix3, Vector, Vector3
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import SensorBias, SensorLoad
from jaxid.identification.force_sensor import some_rows, wrench_rows
from jaxid.measurement.force_sensors import sensor_attitudes
from jaxid.measurement.observations import Observations
from jaxid.measurement.sensor_turns import SensorRows, TurnEstimate, half_widths
from jaxid.result_table import Remark, Status, percent, significant
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import skew


class WrenchLimits(NamedTuple):
    """When a wrench is not the one that the description says.

    Set on simulated logs of a Panda, shown on a UR5, a UR10, a Kinova and an xArm.
    """

    right: float = 0.5  # remaining part of the unexplained if another reading is right
    slip: float = 2.0  # slow errors of the sensor, over half of the 95 % interval
    base_angle: float = np.deg2rad(1.5)  # rotation that is not named under the base
    wrist_angle: float = np.deg2rad(10.0)  # smaller ones are estimated with the load
    distance: float = 0.01  # displacement that is not named [m]
    spoilt: float = np.deg2rad(10.0)  # rotation that spoils any result
    absent: float = 0.25  # share of gravity that lacks
    unsure: float = 0.5  # error over an inertial mass that tells nothing
    tared: float = 0.1  # force at the start over gravity of the load
    min_mass: float = 0.02  # of a load [kg]
    stiffness: float = 0.01  # of a cable that is not named [N m/rad]
    shift: float = 5e-4  # of the centre of the load, that is not named [m]
    lever: float = 0.1  # usual one [m]
    max_lever: float = 1.0  # from the sensor to a load, or from its description [m]


LIMITS = WrenchLimits()

EXCHANGED = (
    "forces and moments are exchanged: the bodies behind the sensor explain the last "
    "three columns of `wrench` as forces. Name the three forces first."
)
IN_GROUND = (
    "the wrench is along the axes of the ground, not of the sensor: gravity is the "
    "same at all attitudes. Give `in_ground = true` in `[sensor]`, or record the "
    "wrench in the sensor's frame."
)
OPPOSITE_SIGN = (
    "the wrench has the opposite sign: it is the wrench of the load on the sensor. "
    "Give `sign = -1` in `[sensor]`, or multiply it by -1."
)
MIRRORED = (
    "the wrench has the opposite sign and is turned, or its axes are left-handed (two "
    "columns are exchanged, or one has the wrong sign): check order and signs of "
    "`wrench`, or give `sign = -1` beside the `rotation` that is named."
)
UNITS = (
    "forces and moments do not fit to each other: are the moments in another unit, "
    "such as N mm, or of another sign? Write N and N m into the log."
)


def wrench_remarks(model: Model, observations: Observations) -> list[Remark]:
    """Return what is wrong with the wrench of a force sensor, if any.

    Args:
        model: Model of the robot with the sensor.
        observations: Observations of a log; of a sensor at the end-effector with a load
            behind it.
    """
    robot = model.robot
    if not robot.has_base_sensor:
        model = Model(robot, (SensorLoad(), SensorBias()))
    wrench = wrench_rows(model, observations)
    estimate = wrench.estimate()
    max_share = LIMITS.right * _unexplained_share(wrench, estimate)
    readings = _other_readings(robot, observations, wrench)
    shares = {
        text: _unexplained_share(reading, reading.estimate())
        for text, reading in readings.items()
    }
    text = min(shares, key=shares.__getitem__)
    if shares[text] < max_share:
        return [Remark(text, Status.BAD)]
    if robot.has_base_sensor:
        remarks = _base_remarks(robot, wrench, estimate)
    else:
        remarks = _wrist_remarks(model, observations, wrench, estimate)
    if _mean_inertia(model, estimate.unknowns, observations) < 0.0:
        is_turned = np.linalg.norm(estimate.angles) > LIMITS.spoilt
        text = MIRRORED if is_turned else OPPOSITE_SIGN
        remarks.insert(0, Remark(text, Status.BAD))
    units = [remark for remark in remarks if remark.text == UNITS]
    return units or remarks


def _unexplained_share(wrench: SensorRows, estimate: TurnEstimate) -> float:
    """Return what bodies do not explain, over forces and moments."""
    return float(np.linalg.norm(estimate.errors / wrench.sizes))


def _other_readings(
    robot: Robot, observations: Observations, wrench: SensorRows
) -> dict[str, SensorRows]:
    """Return the other ways to read a wrench, each with the text that names it."""
    readings = {EXCHANGED: wrench._replace(measured=wrench.measured[:, ::-1])}
    if not robot.has_base_sensor:
        motion = observations.reduced_motion[some_rows(observations)]
        attitudes = sensor_attitudes(robot, np.asarray(motion.q))
        readings[IN_GROUND] = wrench.turned(np.swapaxes(attitudes, 1, 2))
        lever = _lever(wrench)
        if lever > LIMITS.max_lever:
            usual_size = np.array([[1.0], [LIMITS.lever / lever]])
            readings[UNITS] = wrench._replace(measured=usual_size * wrench.measured)
    return readings


def _mean_inertia(
    model: Model, parameters: Vector, observations: Observations
) -> float:
    """Return the mean inertia of the joints: negative for the opposite wrench."""
    motion = observations.reduced_motion[some_rows(observations)]
    M = np.asarray(model.mass_matrix(parameters, motion.q))
    driven = list(model.robot.driven)
    return float(M[:, driven, driven].mean())


def _base_remarks(
    robot: Robot, wrench: SensorRows, estimate: TurnEstimate
) -> list[Remark]:
    """Return that a sensor under the base is turned or displaced.

    One looks a little like the other, so that both are estimated together.
    """
    turned = wrench.turned(estimate.turn)
    columns = np.zeros((*turned.measured.shape, 3))
    columns[:, 1] = np.stack([skew(force) for force in turned.measured[:, 0]])
    displaced = turned.beside(columns)
    last_estimate = displaced.estimate(estimate.errors)
    turn = last_estimate.turn @ estimate.turn
    attitude = np.asarray(robot.rotation)[0]
    remarks = _turn_remarks(
        attitude, last_estimate._replace(turn=turn), LIMITS.base_angle
    )
    displacement = last_estimate.unknowns[-3:]
    widths = half_widths(last_estimate.covariance)[-3:]
    distance = _certain_size(displacement, widths)
    if distance > LIMITS.max_lever:
        return [Remark(UNITS, Status.BAD)]
    if distance > LIMITS.distance:
        origin = np.asarray(robot.offset)[0] + attitude @ displacement
        numbers = ", ".join(f"{x:.3f}" for x in origin)
        length = significant(float(1e3 * np.linalg.norm(displacement)), 2)
        text = (
            f"the sensor is displaced by {length} mm against its description: its "
            f"origin is about [{numbers}] m. Give it as `position` in `[sensor]`."
        )
        remarks.append(Remark(text, Status.DOUBTFUL))
    return remarks


def _certain_size(values: Vector3, widths: Vector3) -> float:
    """Return the norm of what intervals leave of three values."""
    certain_parts = np.maximum(np.abs(values) - LIMITS.slip * widths, 0.0)
    return float(np.linalg.norm(certain_parts))


def _turn_remarks(
    attitude: Matrix3, estimate: TurnEstimate, min_angle: float
) -> list[Remark]:
    """Return that a sensor is turned, and the attitude to write into the file."""
    angles = estimate.angles
    widths = half_widths(estimate.covariance)[:3]
    if _certain_size(angles, widths) < min_angle:
        return []
    angle = np.linalg.norm(angles)
    right = scipy.spatial.transform.Rotation.from_matrix(attitude @ estimate.turn)
    numbers = ", ".join(f"{x:.1f}" for x in right.as_euler("xyz", degrees=True))
    text = (
        f"the wrench is turned by {significant(np.rad2deg(angle), 2)} degrees against "
        f"its description: roll, pitch and yaw of the sensor are about [{numbers}] "
        "degrees. Give them as `rotation` in `[sensor]`, or turn the wrench."
    )
    return [Remark(text, Status.BAD if angle > LIMITS.spoilt else Status.DOUBTFUL)]


def _wrist_remarks(
    model: Model,
    observations: Observations,
    wrench: SensorRows,
    estimate: TurnEstimate,
) -> list[Remark]:
    """Return what is wrong with units, gravity, rotation and taring at the wrist."""
    gravity_text = _missing_gravity(model, observations, wrench)
    if gravity_text:
        return [Remark(gravity_text, Status.BAD)]
    attitude = np.asarray(model.robot.tip_rotation).T
    remarks = _turn_remarks(attitude, estimate, LIMITS.wrist_angle)
    mass = abs(estimate.unknowns[0])
    if mass < LIMITS.min_mass:
        text = (
            f"gravity says that the load has only {significant(1e3 * mass, 2)} g: is "
            "there none, or are the forces in another unit, such as kN? Write N and "
            "N m into the log."
        )
        remarks.append(Remark(text, Status.BAD))
    weight = 9.81 * mass
    start = np.linalg.norm(wrench.measured[0, 0])
    bias = np.linalg.norm(estimate.unknowns[10:13])
    if start < LIMITS.tared * weight and bias > weight / 2:
        text = (
            "the force is zero at the start of the log: the driver was tared there "
            "with the load on. The bias takes it into account; the mass is not "
            "affected."
        )
        remarks.append(Remark(text))
    return [*remarks, *_cable_remarks(model.robot, observations, wrench, estimate)]


def _cable_remarks(
    robot: Robot,
    observations: Observations,
    wrench: SensorRows,
    estimate: TurnEstimate,
) -> list[Remark]:
    """Return that moments follow the last joint, as those of a cable at the load."""
    motion = observations.reduced_motion[some_rows(observations)]
    joint = robot.driven[-1]
    angle = np.asarray(motion.q)[:, joint]
    columns = np.zeros((*wrench.measured.shape, 3))
    columns[:, 1] = np.multiply.outer(angle - angle.mean(), np.eye(3))
    with_cable = wrench.turned(estimate.turn).beside(columns).estimate()
    stiffness = with_cable.unknowns[-3:]
    widths = half_widths(with_cable.covariance)[-3:]
    centres = [x.unknowns[1:4] / x.unknowns[0] for x in (estimate, with_cable)]
    shift = float(np.linalg.norm(centres[1] - centres[0]))
    is_certain = _certain_size(stiffness, widths) > LIMITS.stiffness
    if not is_certain or shift < LIMITS.shift:
        return []
    size = significant(float(np.linalg.norm(stiffness)), 2)
    name = robot.joint_names[joint]
    length = significant(1e3 * shift, 2)
    unit = robot.joint_unit(joint)
    text = (
        f"the moments follow `{name}` by {size} N m for each {unit}, "
        "like those of a cable that pulls at the load: they shift its centre by "
        f"{length} mm. Lead the cable away from the sensor, or keep this joint still."
    )
    return [Remark(text, Status.DOUBTFUL)]


def _lever(wrench: SensorRows) -> float:
    """Return how far from the sensor its force acts [m]."""
    centred = wrench.measured - wrench.measured.mean(axis=0)
    forces = np.concatenate([skew(force) for force in centred[:, 0]])
    arm, *_ = np.linalg.lstsq(-forces, centred[:, 1].ravel(), rcond=None)
    return float(np.linalg.norm(arm))


def _missing_gravity(
    model: Model, observations: Observations, wrench: SensorRows
) -> str:
    """Return that gravity in the wrench is less than that of the load; else nothing.

    Poses at rest have no inertial mass to compare it with.
    """
    weightless = Model(model.robot.replace(gravity=np.zeros(3)), model.terms)
    inertial = wrench_rows(weightless, observations)
    # Mass and first moments.
    gravity = (wrench.columns - inertial.columns)[..., :4]
    estimate = inertial.beside(gravity).estimate()
    widths = half_widths(estimate.covariance)[3:]
    mass = estimate.unknowns[0]
    mass_error, gravity_error = LIMITS.slip * widths[[0, model.size]] / abs(mass)
    share = 1.0 - estimate.unknowns[model.size] / mass
    is_missing = share - mass_error - gravity_error > LIMITS.absent
    if mass_error > LIMITS.unsure or not is_missing:
        return ""
    return (
        f"{percent(share)} % of the gravity of the load is missing in the wrench: the "
        "controller or the driver takes it out. Set the load to zero there, and record "
        "again."
    )
