"""Checks of a robot that moves on its feet: falling, slipping, torques, collisions."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.dynamics.motion import Motion
from jaxid.robot.forward_kinematics import tip_jacobian
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.virtual_joints import GROUP, with_moving_base

from .constraints import AbstractConstraint, Finding
from .ground_forces import ground_forces, measured_motion
from .motions_on_feet import MotionsOnFeet

LENGTH = 0.1
"""Length that counts as an excess of one [m]."""
MIN_JOINT_HEIGHT = 0.02
"""Height of the joints of legs above the ground, but for those of a sole [m]."""


class CheckedMotion(NamedTuple):
    """Use of limits by a motion.

    Attributes:
        use: Used fraction of the ranges, speeds, accelerations, jerks [4 joints].
        findings: Other limited quantities.
    """

    use: np.ndarray
    findings: list[Finding]

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

    def __call__(self, motion: Motion, stands: AnyArray) -> CheckedMotion:
        """Return how far a motion uses the limits.

        Args:
            motion: Motion of trunk and joints on the ground.
            stands: Whether each foot stands [samples feet].
        """
        findings = self._falling(motion, stands)
        robot = with_moving_base(self.motions.robot)
        for constraint in self.constraints:
            excess = np.asarray(constraint(robot, motion)).max(axis=0)
            findings += constraint.describe(robot, excess)
        return CheckedMotion(self._use(motion), findings)

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

    def _falling(self, motion: Motion, stands: AnyArray) -> list[Finding]:
        """Return balance and friction of the feet, and heights and forces of joints."""
        motions = self.motions
        standing = motions.standing
        trunk = measured_motion(motions.robot, motion)
        ground = ground_forces(motions.base, standing.parameters, trunk, stands)
        room = np.inf
        for flags in np.unique(stands, axis=0):
            points = ground.zero_moment_point[(stands == flags).all(axis=1)]
            room = min(room, motions.support(points, flags).min())
        friction = standing.friction
        findings = [
            Finding(
                "the distance of the zero-moment point from the border of the feet",
                1.0,
                "of that of their middle",
                standing.margin,
                is_lower_limit=True,
                value=standing.margin - room,
            ),
            Finding(
                "the force along the ground",
                friction,
                "of that against it",
                friction,
                value=ground.friction.max() / friction - 1.0,
            ),
            self._height(np.asarray(motion.q)),
        ]
        max_forces = np.asarray(motions.robot.known_max_forces)
        peaks = np.abs(ground.joint_forces).max(axis=0)
        margin = standing.force_margin
        for joint in np.flatnonzero(np.isfinite(max_forces)).tolist():
            limit = (1.0 - margin) * max_forces[joint]
            note = f"{max_forces[joint]:.4g} less a margin of {100 * margin:.4g} %"
            findings.append(
                Finding(
                    f"the force of joint `{motions.robot.joint_names[joint]}`",
                    limit,
                    motions.robot.force_unit(joint),
                    limit,
                    note=note if margin else "",
                    value=peaks[joint] / limit - 1.0,
                )
            )
        return findings

    def _height(self, q: np.ndarray) -> Finding:
        """Return the height of the legs' joints, without those near a sole."""
        heights = []
        for leg in self.motions.legs:
            upper_joints = leg.joints[: (len(leg.joints) + 3) // 2]
            tip = tip_jacobian(leg.foot, q)
            heights.append(tip.origins[:, upper_joints, 2].min())
        return Finding(
            "the height of the legs' joints above the ground",
            LENGTH,
            "m",
            MIN_JOINT_HEIGHT,
            is_lower_limit=True,
            value=(MIN_JOINT_HEIGHT - min(heights)) / LENGTH,
        )
