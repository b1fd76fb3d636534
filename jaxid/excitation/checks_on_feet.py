"""Checks of a robot that moves on its feet: falling, slipping, torques, collisions."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.dynamics.motion import Motion
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.virtual_joints import GROUP, with_moving_base

from .constraints import AbstractConstraint, Finding
from .ground_forces import GroundForces
from .motions_on_feet import MotionsOnFeet, Phase

MIN_JOINT_HEIGHT = 0.02
"""Height of the joints of legs above the ground, but for those of a sole [m]."""


class CheckedMotion(NamedTuple):
    """Use of limits by a motion.

    Attributes:
        use: Used fraction of the ranges, speeds, accelerations, jerks [4 joints].
        findings: Other limited quantities.
        joint_use: Largest use of a range, speed, acceleration or force [joints].
    """

    use: np.ndarray
    findings: list[Finding]
    joint_use: np.ndarray

    @property
    def violation(self) -> float:
        """Largest relative excess over a limit."""
        excess = [finding.value for finding in self.findings]
        return max(float(self.use.max()) - 1.0, *excess)


class ChecksOnFeet(NamedTuple):
    """All that a motion on feet must keep.

    Attributes:
        motions: Family of the motion.
        limits: Limits of the driven joints.
        constraints: Other constraints, on the robot with its base on the ground.
    """

    motions: MotionsOnFeet
    limits: Limits
    constraints: tuple[AbstractConstraint, ...]

    def __call__(self, phase: Phase, times: AnyArray) -> CheckedMotion:
        """Return how far a phase uses the limits at times from its start [s]."""
        motion = phase.motion(times)
        loads = self.motions.loads(phase.number, times)
        forces = self.motions.forces(motion, loads)
        findings = [
            self._balance(forces, loads > 0.0),
            self._friction(forces),
            self._height(motion),
            *self._forces(forces),
        ]
        robot = with_moving_base(self.motions.robot)
        for constraint in self.constraints:
            excess = np.asarray(constraint(robot, motion)).max(axis=0)
            findings += constraint.describe(robot, excess)
        use = self._use(motion)
        joint_use = np.maximum(use.max(axis=0), self._force_use(forces)[GROUP:])
        return CheckedMotion(use, findings, joint_use)

    def _use(self, motion: Motion) -> np.ndarray:
        """Return the used fractions of the limits of the joints."""
        limits = self.limits
        middle = 0.5 * (limits.position_min + limits.position_max)
        half_range = 0.5 * (limits.position_max - limits.position_min)
        q, qd, qdd = (x[:, GROUP:] for x in (motion.q, motion.qd, motion.qdd))
        uses = [
            (q - middle) / half_range,
            qd / limits.velocity,
            qdd / limits.acceleration,
        ]
        largest_use = [np.abs(x).max(axis=0) for x in uses]
        return np.stack([*largest_use, np.zeros_like(largest_use[0])])

    def _balance(self, forces: GroundForces, stands: np.ndarray) -> Finding:
        """Return how near the zero-moment point comes to the border of the feet."""
        motions = self.motions
        rooms = []
        for flags in np.unique(stands, axis=0):
            points = forces.zero_moment_point[(stands == flags).all(axis=1)]
            rooms.append(motions.support(points, flags).min())
        margin = motions.standing.margin
        return Finding(
            "the distance of the zero-moment point from the border of the feet",
            100.0,
            "% of that of their middle",
            100.0 * margin,
            is_lower_limit=True,
            value=margin - min(rooms),
        )

    def _friction(self, forces: GroundForces) -> Finding:
        """Return how near the feet come to slipping."""
        friction = self.motions.standing.friction
        return Finding(
            "the force along the ground",
            friction,
            "of that against it",
            friction,
            value=forces.friction.max() / friction - 1.0,
        )

    def _force_use(self, forces: GroundForces) -> np.ndarray:
        """Return the used fractions of the joints' forces; 0 without a limit."""
        share = 1.0 - self.motions.standing.force_margin
        max_forces = np.asarray(self.motions.robot.known_max_forces)
        peaks = np.abs(forces.joint_forces).max(axis=0)
        return np.where(np.isfinite(max_forces), peaks / (share * max_forces), 0.0)

    def _forces(self, forces: GroundForces) -> list[Finding]:
        """Return the forces of the joints whose limits are known."""
        robot = self.motions.robot
        share = 1.0 - self.motions.standing.force_margin
        max_forces = np.asarray(robot.known_max_forces)
        force_use = self._force_use(forces)
        findings = []
        for joint in np.flatnonzero(np.isfinite(max_forces)).tolist():
            limit = share * max_forces[joint]
            note = f"{max_forces[joint]:.4g} less a margin of {100 * (1 - share):.4g} %"
            findings.append(
                Finding(
                    f"the force of joint `{robot.joint_names[joint]}`",
                    limit,
                    robot.force_unit(joint),
                    limit,
                    note=note if share < 1.0 else "",
                    value=force_use[joint] - 1.0,
                )
            )
        return findings

    def _height(self, motion: Motion) -> Finding:
        """Return the height of the legs' joints, without those near a sole."""
        heights = []
        for leg in self.motions.legs:
            upper_joints = leg.joints[: (len(leg.joints) + 3) // 2]
            tip = tip_jacobian(leg.foot, np.asarray(motion.q))
            heights.append(tip.origins[:, upper_joints, 2].min())
        return Finding(
            "the height of the legs' joints above the ground",
            1.0,
            "m",
            MIN_JOINT_HEIGHT,
            is_lower_limit=True,
            value=MIN_JOINT_HEIGHT - min(heights),
        )
