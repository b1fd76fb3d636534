"""Limits of closed loops: reach, singular poses, and the joints that loops move."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Joints
from jaxid.program.sample_methods import evaluate_samples
from jaxid.robot.joint_coordinates import all_rates, loop_closure
from jaxid.robot.loop_closing import MIN_SAFE_SHARE, closed_samples
from jaxid.robot.robot import Robot

from .clearance import SIZE
from .constraint import AbstractConstraint, Finding


class LoopLimits(AbstractConstraint):
    """Limits of a robot's loops, which every design of a motion keeps.

    The loops close, stay away from poses in which they are singular, and the joints
    that they move keep their ranges and speeds.

    Attributes:
        min_share: Least determinant of the slopes of the loops by the joints that they
            move, relative to that of the robot's `loop_pose`; zero at singular poses.
    """

    min_share: float = MIN_SAFE_SHARE

    def __call__(self, robot, motion):
        """Return the open distance, then the shares, ranges and speeds."""
        coordinates, _ = closed_samples(robot, motion.q)
        excess = eqx.Partial(self.excess, robot)
        return evaluate_samples(excess, excess.__call__, coordinates, motion.qd)

    def excess(self, robot: Robot, coordinates: Joints, qd: Joints) -> AnyArray:
        """Return the relative excess over each limit, of one sample of all joints."""
        square, share = loop_closure(robot, coordinates)
        rates = all_rates(robot, coordinates, qd)
        values = [square / SIZE**2 - SIZE**2, 1.0 - share / self.min_share]
        for body, joint in _moved_joints(robot):
            coordinate = coordinates[body]
            half_range = _half_range(joint)
            if np.isfinite(joint.position_min):
                values.append((joint.position_min - coordinate) / half_range)
            if np.isfinite(joint.position_max):
                values.append((coordinate - joint.position_max) / half_range)
            if np.isfinite(joint.velocity):
                values.append(jnp.abs(rates[body]) / joint.velocity - 1.0)
        return jnp.stack(values)

    def entries(self, robot):
        """Return the quantities that have a limit, in the same order."""
        entries = [
            Finding(
                "the square of the distance of the loops from closing",
                SIZE**2,
                "m²",
                SIZE**4,
            ),
            Finding(
                "the determinant of the loops",
                self.min_share,
                "of that in the description",
                self.min_share,
                is_lower_limit=True,
            ),
        ]
        for _, joint in _moved_joints(robot):
            name = f"joint `{joint.name}`, which loops move,"
            unit = "rad" if joint.revolute else "m"
            half_range = _half_range(joint)
            ends = ((joint.position_min, True), (joint.position_max, False))
            for end, is_low in ends:
                if np.isfinite(end):
                    entry = Finding(name, half_range, unit, end, is_low, has_use=False)
                    entries.append(entry)
            speed = joint.velocity
            if np.isfinite(speed):
                entries.append(
                    Finding(f"the speed of {name}", speed, f"{unit}/s", speed)
                )
        return tuple(entries)


def _moved_joints(robot: Robot):
    """Return the joints that loops move, each with the number of its body."""
    bodies = range(robot.joints, robot.bodies)
    pairs = zip(bodies, robot.followers, strict=True)
    return [(body, joint) for body, joint in pairs if joint.leader is None]


def _half_range(joint):
    """Return half of a joint's range; 1 where it is open."""
    half_range = 0.5 * (joint.position_max - joint.position_min)
    return half_range if np.isfinite(half_range) else 1.0
