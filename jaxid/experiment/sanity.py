"""Is this log sane? Ranges, speeds and forces of a log beside the limits of its robot."""

import dataclasses

import numpy as np

from jaxid.identification.fit import Fit
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.types import Float

SLACK = 0.02
"""How far outside a range, relative to it, a log may reach without a word."""
FAST, STRONG = 1.1, 1.2
"""Parts of the limits above which speeds and forces are doubtful."""
STANDING = 0.01
"""Part of a joint's largest speed below which it stands."""
FRICTION = ("fv", "fc")
"""Parameters that are negative on no robot."""
SURE = 3.0
"""Standard deviations beyond which a sign is certain."""
HARDLY = 0.02
"""A motion in [rad] or [m] that is too small to tell anything."""


@dataclasses.dataclass(frozen=True)
class LogCheck:
    """What a log holds, joint by joint, and what is strange about it.

    Attributes:
        lowest: Smallest coordinate of each joint [rad or m].
        highest: Largest coordinate of each joint [rad or m].
        speed: Largest speed of each joint [rad/s or m/s].
        acceleration: Largest acceleration of each joint [rad/s² or m/s²].
        force: Largest force of each joint [N m or N].
        standing: Share of the samples in which each joint stands, of 1.
        all_standing: Share of the samples in which all joints stand, of 1.
        warnings: What is strange, in sentences.
    """

    lowest: Float[np.ndarray, " joints"]
    highest: Float[np.ndarray, " joints"]
    speed: Float[np.ndarray, " joints"]
    acceleration: Float[np.ndarray, " joints"]
    force: Float[np.ndarray, " joints"]
    standing: Float[np.ndarray, " joints"]
    all_standing: float
    warnings: tuple[str, ...]


def known_forces(robot: Robot) -> Float[np.ndarray, " joints"]:
    """Largest forces of the joints as far as they are known; infinite otherwise [N m or N]."""
    own = np.asarray(robot.limits.force)
    return np.where(np.isfinite(own), own, np.asarray(robot.drives.max_forces))


def check_log(robot: Robot, recording: Recording, observations: Observations) -> LogCheck:
    """Compares a log with what its robot can do: a wrong unit or sign shows here.

    Args:
        robot: Whose log it is.
        recording: As it was read.
        observations: What the filter made of it.
    """
    q = np.asarray(observations.motion.q)
    qd = np.asarray(observations.motion.qd)
    forces = np.asarray(observations.forces)
    speed = np.abs(qd).max(axis=0)
    stands = np.abs(qd) < STANDING * np.maximum(speed, 1e-12)
    check = LogCheck(
        lowest=q.min(axis=0),
        highest=q.max(axis=0),
        speed=speed,
        acceleration=np.abs(np.asarray(observations.motion.qdd)).max(axis=0),
        force=np.abs(forces).max(axis=0),
        standing=stands.mean(axis=0),
        all_standing=float(stands.all(axis=1).mean()),
        warnings=(),
    )
    warnings = [w for j in range(robot.joints) for w in _joint(robot, j, check)]
    warnings += _signs(qd, forces)
    warnings += _jumps(robot, recording)
    warnings += _velocities(robot, recording, observations)
    if check.all_standing > 0.5:
        warnings.append(
            f"the robot stands still for {100 * check.all_standing:.0f} % of the log: crop it with "
            "`recording.start` and `recording.stop`."
        )
    return dataclasses.replace(check, warnings=tuple(warnings))


def _joint(robot: Robot, j: int, check: LogCheck) -> list[str]:
    name, unit, limits = robot.joint_names[j], robot.joint_unit(j), robot.limits
    low, high = float(limits.position_min[j]), float(limits.position_max[j])
    slack = SLACK * (high - low) if np.isfinite(high - low) else 0.0
    said = []
    if check.lowest[j] < low - slack or check.highest[j] > high + slack:
        said.append(
            f"joint `{name}` moves from {check.lowest[j]:.3g} to {check.highest[j]:.3g} {unit}, "
            f"outside its range from {low:.3g} to {high:.3g} {unit}: check `recording.angle_unit`, "
            "`side`, `angle_signs` and `angle_offsets`."
        )
    if check.speed[j] > FAST * limits.velocity[j]:
        said.append(
            f"joint `{name}` reaches {check.speed[j]:.3g} {unit}/s, but its limit is "
            f"{float(limits.velocity[j]):.3g} {unit}/s: check the units of angles and time, or "
            "lower the filter's cut-off."
        )
    known = float(known_forces(robot)[j])
    if check.force[j] > STRONG * known:
        said.append(
            f"joint `{name}` needs {check.force[j]:.3g} {robot.force_unit(j)}, but its limit is "
            f"{known:.3g} {robot.force_unit(j)}: check `recording.force_unit` and `forces_side`."
        )
    if check.highest[j] - check.lowest[j] < HARDLY:
        said.append(
            f"joint `{name}` moves by {check.highest[j] - check.lowest[j]:.2g} {unit} only: its "
            "parameters cannot be told from this log; is it the right column and unit?"
        )
    if check.force[j] == 0.0:
        said.append(f"the forces of joint `{name}` are zero throughout: is it the right column?")
    return said


def _signs(qd: np.ndarray, forces: np.ndarray) -> list[str]:
    """Over a whole log, friction makes a robot consume energy."""
    power = float(np.mean(np.sum(forces * qd, axis=1)))
    size = float(np.sqrt(np.mean(np.sum(forces**2, axis=1)) * np.mean(np.sum(qd**2, axis=1))))
    if power >= -0.05 * size:
        return []
    return [
        "the robot gives off energy over the whole log: check the signs of its angles and forces "
        "(`recording.angle_signs`, `force_signs`)."
    ]


def _jumps(robot: Robot, recording: Recording) -> list[str]:
    """A joint does not turn by half a turn or more from one sample to the next."""
    if recording.angles_on_motor_side:
        return []
    angles = np.asarray(recording.angles)
    steps = [np.abs(np.diff(angles[a:b], axis=0)) for a, b in recording.segments if b > a + 1]
    largest = np.max([s.max(axis=0) for s in steps], axis=0)
    return [
        f"the angle of joint `{name}` jumps by {largest[j]:.3g} rad from one sample to the next: "
        "undo the wrapping at a full turn before the log is filtered."
        for j, (name, turns) in enumerate(zip(robot.joint_names, robot.revolute, strict=True))
        if turns and largest[j] > np.pi
    ]


def negative_friction(fit: Fit) -> tuple[str, ...]:
    """Joints whose friction comes out negative beyond doubt: a sign is wrong, or the model is."""
    robot, names = fit.base.model.robot, fit.base.names
    certain = np.asarray(fit.parameters) < -SURE * np.asarray(fit.standard_deviations)
    wrong = {name for name, negative in zip(names, certain, strict=True) if negative}
    return tuple(
        f"friction of joint `{label}` comes out negative ({' and '.join(found)}): check the signs "
        "of its angles and forces (`recording.angle_signs`, `force_signs`)."
        for j, label in enumerate(robot.joint_names)
        if (found := [f"{kind}{j + 1}" for kind in FRICTION if f"{kind}{j + 1}" in wrong])
    )


def _velocities(robot: Robot, recording: Recording, observations: Observations) -> list[str]:
    """Measured velocities must be the derivatives of the angles."""
    if recording.velocities is None:
        return []
    q = np.asarray(observations.motion.q)
    qd = np.asarray(observations.motion.qd)
    rate = np.concatenate(
        [np.gradient(q[a:b], observations.sample_time, axis=0) for a, b in observations.segments]
    )
    squares = np.sum(rate**2, axis=0)
    ratio = np.sum(rate * qd, axis=0) / np.where(squares > 0, squares, 1.0)
    return [
        f"the measured velocities of joint `{robot.joint_names[j]}` are {ratio[j]:.3g} times the "
        "derivatives of its angles: check `recording.velocity_unit` and the order of the columns."
        for j in np.flatnonzero((squares > 0) & (np.abs(ratio - 1.0) > 0.2))
    ]
