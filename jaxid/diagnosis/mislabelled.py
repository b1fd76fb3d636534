"""Mislabelled channels: a wrong sign, order, unit or side, and delays, told by the model.

Every possible mistake is corrected in turn, and the model is fitted anew to some instants of the
log, with friction that takes energy from the robot, as all friction does. Without that condition a
wrong sign would only change signs of parameters where joints are hardly coupled.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.identification.delay import estimate_delay
from jaxid.identification.estimators import GivenWeights
from jaxid.identification.fit import Fit
from jaxid.measurement.observations import Observations
from jaxid.robot.robot import Robot

BAD = 0.03
"""Fraction (0 to 1) of the forces left unexplained from which mistakes are looked for."""
SURE = 3.0
"""Standard deviations beyond which a sign is certain."""


class Hypothesis(NamedTuple):
    """Possible mistake, and the log as it would be without it.

    Attributes:
        text: Description of the mistake, as a clause.
        motion: Corrected motion, filtered, joint side.
        forces: Corrected forces, reduced, joint side.
    """

    text: str
    motion: Motion
    forces: Float[np.ndarray, "rows joints"]


def likely_mistakes(
    base: BaseParameters,
    observations: Observations,
    angles_on_motor_side: bool = False,
    forces_on_motor_side: bool = False,
) -> tuple[str, ...]:
    """Look for a single sign, exchange, unit or side whose correction makes the model fit the log.

    Args:
        base: Base parameters of the model.
        observations: Observations of one log, or of a part of it.
        angles_on_motor_side: Whether the angles of the log are taken for the motors'.
        forces_on_motor_side: Whether the forces of the log are taken for the motors'.

    Returns:
        A sentence; nothing if the model fits, or no single mistake explains why it does not.
    """
    step = -(-observations.rows // 300)
    forces = observations.reduced_forces[::step]
    motion = observations.motion[observations.instants[::step]]
    left = _unexplained(base, motion, forces)
    if left < BAD:
        return ()
    gears = _Gears(base.model.robot, angles_on_motor_side, forces_on_motor_side)
    hypotheses = (*_scaled(gears, motion, forces), *_columns(gears, motion, forces))
    tried = [(_unexplained(base, h.motion, h.forces), h.text) for h in hypotheses]
    best = min(tried)[0]
    likely = [text for rest, text in sorted(tried) if rest <= 1.05 * best]
    # With more than three candidates nothing is known.
    if best > 0.9 * left or len(likely) > 3:
        return ()
    return (
        f"{', or '.join(likely)}: the model then misses {100 * best:.2g} % of the forces instead "
        f"of {100 * left:.2g} %.",
    )


class _Gears:
    """Conversion from joints to the columns of a log, which may be the motors', and back."""

    def __init__(self, robot: Robot, angles: bool, forces: bool):
        drives, unit = robot.drives, np.eye(robot.joints)
        self.robot, self.drives = robot, drives
        still = np.asarray(drives.joint_angles(np.zeros(robot.joints)))
        self.to_joint = np.asarray(drives.joint_angles(unit)) - still
        self.to_motor = np.linalg.inv(self.to_joint)
        self._rates = (self.to_motor, self.to_joint) if angles else (unit, unit)
        self._angles = angles
        self._forces = (self.to_joint.T, self.to_motor.T) if forces else (unit, unit)

    def change_motion(self, motion: Motion, change: Float[np.ndarray, "joints joints"]) -> Motion:
        """Return the motion with other combinations of the log's columns."""
        there, back = self._rates
        by = there @ change @ back
        if not self._angles:
            return Motion(motion.q @ by, motion.qd @ by, motion.qdd @ by)
        q = self.drives.joint_angles(np.asarray(self.drives.motor_angles(motion.q)) @ change)
        return Motion(np.asarray(q), motion.qd @ by, motion.qdd @ by)

    def change_forces(
        self,
        forces: Float[np.ndarray, "rows joints"],
        change: Float[np.ndarray, "joints joints"],
    ) -> Float[np.ndarray, "rows joints"]:
        """Return the forces with other combinations of the log's columns."""
        there, back = self._forces
        return forces @ (there @ change @ back)


def _columns(
    gears: _Gears, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> Iterator[Hypothesis]:
    """Yield wrong signs and exchanged columns."""
    names = gears.robot.joint_names
    n = len(names)
    for j, name in enumerate(names):
        change = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        key = f"of joint `{name}` seems to be wrong (`recording."
        changed = gears.change_forces(forces, change)
        yield Hypothesis(f"the sign of the force {key}force_signs`)", motion, changed)
        moved = gears.change_motion(motion, change)
        yield Hypothesis(f"the sign of the angle {key}angle_signs`)", moved, forces)
    if n > 12:  # the number of pairs grows with the square
        return
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        change = np.eye(n)[order]
        key = f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        yield Hypothesis(f"the forces {key}forces`)", motion, gears.change_forces(forces, change))
        yield Hypothesis(f"the angles {key}angles`)", gears.change_motion(motion, change), forces)


def _scaled(
    gears: _Gears, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> Iterator[Hypothesis]:
    """Yield wrong units of all angles, and wrong sides of the gears."""
    robot, drives = gears.robot, gears.drives
    turns = np.array(robot.revolute)
    for unit, factor in (("deg", np.pi / 180), ("rev", 2 * np.pi)):
        text = f"the angles of the log seem to be in {unit} (`recording.angle_unit`)"
        yield Hypothesis(text, _scale(motion, np.where(turns, factor, 1.0)), forces)
        text = f"the angles of the log seem to be in rad, not in {unit} (`recording.angle_unit`)"
        yield Hypothesis(text, _scale(motion, np.where(turns, 1 / factor, 1.0)), forces)
    if drives.is_direct:
        return
    for side, owner, by, angles, changed in (
        ("motor", "motors'", gears.to_joint, drives.joint_angles, forces @ gears.to_motor.T),
        ("joint", "joints'", gears.to_motor, drives.motor_angles, forces @ gears.to_joint.T),
    ):
        moved = Motion(np.asarray(angles(motion.q)), motion.qd @ by, motion.qdd @ by)
        text = f"of the log seem to be the {owner} (`recording."
        yield Hypothesis(f'the angles and forces {text}side = "{side}"`)', moved, changed)
        yield Hypothesis(f'the forces {text}forces_side = "{side}"`)', motion, changed)
        yield Hypothesis(f"the angles {text}side`, with `forces_side` as it is)", moved, forces)


def _scale(motion: Motion, factors: Float[np.ndarray, " joints"]) -> Motion:
    return Motion(motion.q * factors, motion.qd * factors, motion.qdd * factors)


def _unexplained(
    base: BaseParameters, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> float:
    """Return the fraction (0 to 1) of the forces that least squares leave unexplained.

    All joints count equally. Friction terms that would come out negative are left out.
    """
    wanted = forces - base.tool_forces(motion)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    scale = 1.0 / np.where(size > 0, size, np.inf)
    rows = base.regressor_rows(motion)
    joints = len(scale)
    theta = np.zeros((joints, len(forces), base.size + 1))
    for joint, columns in enumerate(base.acting_columns):
        theta[joint][:, columns] = rows[joint] * scale[joint]
    theta[..., -1] = (wanted * scale).T
    theta = theta.reshape(-1, base.size + 1)
    if not np.isfinite(theta).all():
        return np.inf
    R = np.asarray(np.linalg.qr(theta, mode="r"))
    length = np.linalg.norm(R, axis=0)
    R, target = R[:, :-1] / np.where(length[:-1] > 0, length[:-1], 1.0), R[:, -1]
    named = {f"{kind}{j + 1}" for kind in ("fv", "fc") for j in range(joints)}
    used = np.ones(base.size, bool)
    braking = np.array([name in named for name in base.names])
    while True:
        found = np.zeros(base.size)
        found[used] = np.linalg.lstsq(R[:, used], target, rcond=1e-9)[0]
        pushing = braking & (found < 0)
        if not pushing.any():
            break
        used &= ~pushing
    return float(np.linalg.norm(R @ found - target) / max(length[-1], 1e-300))


def negative_friction(fit: Fit) -> tuple[str, ...]:
    """Report joints whose friction is negative beyond doubt: a sign or the model is wrong."""
    robot, names = fit.base.model.robot, fit.base.names
    certain = np.asarray(fit.parameters) < -SURE * np.asarray(fit.standard_deviations)
    wrong = {name for name, negative in zip(names, certain, strict=True) if negative}
    return tuple(
        f"friction of joint `{label}` comes out negative ({' and '.join(found)}): check the signs "
        "of its angles and forces (`recording.angle_signs`, `force_signs`)."
        for j, label in enumerate(robot.joint_names)
        if (found := [f"{kind}{j + 1}" for kind in ("fv", "fc") if f"{kind}{j + 1}" in wrong])
    )


def delay_finding(base: BaseParameters, observations: Observations, fit: Fit) -> tuple[str, ...]:
    """Return a sentence about a delay of the forces that the model sees, or nothing.

    Args:
        base: Base parameters of the model.
        observations: Observations of one log, or of a part of it.
        fit: Fit to this log.
    """
    # A model that explains too little sees no delay.
    if not fit.residual < 0.3:
        return ()
    try:
        delay = estimate_delay(base, observations, GivenWeights(np.asarray(fit.weights)))
    except ValueError:
        return ()
    half = delay.interval()[1] - delay.seconds
    # A delay of a bus is that of all joints; other effects differ from joint to joint.
    scatter = float(np.std(delay.of_joints))
    if abs(delay.seconds) < max(half, scatter, 0.1 * observations.sample_time):
        return ()
    text = (
        f"the forces seem to stand {1e3 * abs(delay.seconds):.3g} ± {1e3 * half:.2g} ms "
        f"{'later' if delay.seconds > 0 else 'earlier'} in the log than the angles: "
    )
    if delay.p_value > 0.001:
        cure = f"`force_delay = {delay.seconds:.3g}` in `[recording]` removes that"
        return (f"{text}{cure}, unless the model lacks an effect instead.",)
    low, high = (1e3 * float(x) for x in (np.min(delay.of_joints), np.max(delay.of_joints)))
    return (
        f"{text}from {low:.3g} to {high:.3g} ms joint by joint, so that some effect which the "
        "model lacks is as likely (`force_delay` in `[recording]`).",
    )
