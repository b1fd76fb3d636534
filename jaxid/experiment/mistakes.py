"""Which single slip in an experiment file would explain a log that its model does not fit.

Every slip is undone in turn, and the model is fitted anew to some instants of the log, with
friction that takes energy from the robot, as all friction does. Without that a wrong sign would
only turn signs of parameters where a joint hardly feels the others.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics import compiled
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.measurement.observations import Observations
from jaxid.robot.robot import Robot

BAD = 0.03
"""Share of the forces that a model leaves unexplained, from which a slip is looked for, of 1."""
BETTER = 0.9
"""Part of it that may be left where a slip is undone."""
ALIKE = 1.05
"""How much more other slips may leave than the best one to be as likely."""
MOST = 3
"""Slips between which a sentence may leave the choice: with more of them nothing is known."""
ROWS = 300
"""Instants that are looked at."""
MOST_JOINTS = 12
"""Joints up to which pairs are tried: their number grows with the square."""
FRICTION = ("fv", "fc")
"""Parameters that are negative on no robot."""


class Slip(NamedTuple):
    """What a log would be if one slip were undone.

    Attributes:
        said: The slip, as a clause.
        motion: Filtered, joint side.
        forces: Joint side, reduced.
    """

    said: str
    motion: Motion
    forces: Float[np.ndarray, "rows joints"]


def likely_mistake(
    base: BaseParameters,
    observations: Observations,
    angles_on_motor_side: bool = False,
    forces_on_motor_side: bool = False,
) -> tuple[str, ...]:
    """Finds the sign, exchange, unit or side that makes a model fit a log, if there is one.

    Args:
        base: What is identified.
        observations: Of one log, or of a part of it.
        angles_on_motor_side: Whether the columns of the log are taken for the motors' angles.
        forces_on_motor_side: Whether they are taken for the motors' torques.

    Returns:
        A sentence, or nothing where the model fits or no single slip explains why it does not.
    """
    step = -(-observations.rows // ROWS)
    forces = observations.reduced_forces[::step]
    motion = observations.motion[observations.instants[::step]]
    left = _unexplained(base, motion, forces)
    if left < BAD:
        return ()
    gears = _Gears(base.model.robot, angles_on_motor_side, forces_on_motor_side)
    undone = (*_scaled(gears, motion, forces), *_columns(gears, motion, forces))
    tried = [(_unexplained(base, s.motion, s.forces), s.said) for s in undone]
    best = min(tried)[0]
    alike = [said for share, said in sorted(tried) if share <= ALIKE * best]
    if best > BETTER * left or len(alike) > MOST:
        return ()
    return (
        f"{', or '.join(alike)}: the model then misses {100 * best:.2g} % of the forces instead of "
        f"{100 * left:.2g} %.",
    )


class _Gears:
    """From joints to the columns of a log, which may be the motors', and back."""

    def __init__(self, robot: Robot, angles: bool, forces: bool):
        drives, unit = robot.drives, np.eye(robot.joints)
        self.robot, self.drives = robot, drives
        still = np.asarray(drives.joint_angles(np.zeros(robot.joints)))
        self.to_joint = np.asarray(drives.joint_angles(unit)) - still
        self.to_motor = np.linalg.inv(self.to_joint)
        self._rates = (self.to_motor, self.to_joint) if angles else (unit, unit)
        self._angles = angles
        self._forces = (self.to_joint.T, self.to_motor.T) if forces else (unit, unit)

    def turned(self, motion: Motion, change: Float[np.ndarray, "joints joints"]) -> Motion:
        """A motion whose columns in the log are combined anew."""
        there, back = self._rates
        by = there @ change @ back
        if not self._angles:
            return Motion(motion.q @ by, motion.qd @ by, motion.qdd @ by)
        q = self.drives.joint_angles(np.asarray(self.drives.motor_angles(motion.q)) @ change)
        return Motion(np.asarray(q), motion.qd @ by, motion.qdd @ by)

    def felt(
        self,
        forces: Float[np.ndarray, "rows joints"],
        change: Float[np.ndarray, "joints joints"],
    ) -> Float[np.ndarray, "rows joints"]:
        """Forces whose columns in the log are combined anew."""
        there, back = self._forces
        return forces @ (there @ change @ back)


def _columns(
    gears: _Gears, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> Iterator[Slip]:
    """Signs and exchanges."""
    names = gears.robot.joint_names
    n = len(names)
    for j, name in enumerate(names):
        change = np.diag(np.where(np.arange(n) == j, -1.0, 1.0))
        key = f"of joint `{name}` seems to be wrong (`recording."
        yield Slip(f"the sign of the force {key}force_signs`)", motion, gears.felt(forces, change))
        moved = gears.turned(motion, change)
        yield Slip(f"the sign of the angle {key}angle_signs`)", moved, forces)
    if n > MOST_JOINTS:
        return
    for i, j in itertools.combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        change = np.eye(n)[order]
        key = f"of joints `{names[i]}` and `{names[j]}` seem to be exchanged (`recording."
        yield Slip(f"the forces {key}forces`)", motion, gears.felt(forces, change))
        yield Slip(f"the angles {key}angles`)", gears.turned(motion, change), forces)


def _scaled(
    gears: _Gears, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> Iterator[Slip]:
    """Units of all angles, and sides of the gears."""
    robot, drives = gears.robot, gears.drives
    turns = np.array(robot.revolute)
    for unit, factor in (("deg", np.pi / 180), ("rev", 2 * np.pi)):
        said = f"the angles of the log seem to be in {unit} (`recording.angle_unit`)"
        yield Slip(said, _times(motion, np.where(turns, factor, 1.0)), forces)
        said = f"the angles of the log seem to be in rad, not in {unit} (`recording.angle_unit`)"
        yield Slip(said, _times(motion, np.where(turns, 1 / factor, 1.0)), forces)
    if drives.is_direct:
        return
    for side, owner, by, turned, felt in (
        ("motor", "motors'", gears.to_joint, drives.joint_angles, forces @ gears.to_motor.T),
        ("joint", "joints'", gears.to_motor, drives.motor_angles, forces @ gears.to_joint.T),
    ):
        moved = Motion(np.asarray(turned(motion.q)), motion.qd @ by, motion.qdd @ by)
        said = f"of the log seem to be the {owner} (`recording."
        yield Slip(f'the angles and forces {said}side = "{side}"`)', moved, felt)
        yield Slip(f'the forces {said}forces_side = "{side}"`)', motion, felt)
        yield Slip(f"the angles {said}side`, with `forces_side` as it is)", moved, forces)


def _times(motion: Motion, factors: Float[np.ndarray, " joints"]) -> Motion:
    return Motion(motion.q * factors, motion.qd * factors, motion.qdd * factors)


def _unexplained(
    base: BaseParameters, motion: Motion, forces: Float[np.ndarray, "rows joints"]
) -> float:
    """What least squares leave of the forces where every joint counts alike, of 1.

    Friction that would give energy to the robot is left out.
    """
    wanted = forces - compiled.tool_forces(base, motion)
    size = np.sqrt(np.mean(wanted**2, axis=0))
    scale = 1.0 / np.where(size > 0, size, np.inf)
    rows = compiled.regressor_rows(base, motion)
    joints = len(scale)
    theta = np.zeros((joints, len(forces), base.size + 1))
    for joint, columns in enumerate(compiled.acting_columns(base)):
        theta[joint][:, columns] = rows[joint] * scale[joint]
    theta[..., -1] = (wanted * scale).T
    theta = theta.reshape(-1, base.size + 1)
    if not np.isfinite(theta).all():
        return np.inf
    R = np.asarray(np.linalg.qr(theta, mode="r"))
    length = np.linalg.norm(R, axis=0)
    R, target = R[:, :-1] / np.where(length[:-1] > 0, length[:-1], 1.0), R[:, -1]
    named = {f"{kind}{j + 1}" for kind in FRICTION for j in range(joints)}
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
