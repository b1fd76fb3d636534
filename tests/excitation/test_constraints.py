"""Contract of every constraint: each sample by itself, entries that fit, differentiable."""

import jax.numpy as jnp
import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints import AbstractConstraint, Finding
from jaxid.robot import library


class SlowFirstJoint(AbstractConstraint):
    """The first joint stays below half of its largest speed, in both directions."""

    def __call__(self, robot, motion):
        speed = motion.qd[..., 0] / (0.5 * robot.limits.velocity[0])
        return jnp.stack([speed - 1.0, -speed - 1.0], axis=-1)

    def entries(self, robot):
        half = float(0.5 * robot.limits.velocity[0])
        name = robot.joint_names[0]
        return tuple(Finding(f"speed of `{name}` {way}", half, "rad/s") for way in ("up", "down"))


def test_findings_are_the_peaks_in_physical_units():
    robot = library.panda()
    qd = np.zeros((4, 7))
    qd[:, 0] = [0.0, 1.0, 1.5, -0.5]
    constraint = SlowFirstJoint()
    values = constraint(robot, Motion(np.zeros((4, 7)), qd, np.zeros((4, 7))))
    up, down = constraint.describe(robot, values)
    assert np.isclose(up.excess, 1.5 - 2.175 / 2)
    assert np.isclose(down.excess, 0.5 - 2.175 / 2)
    assert str(up).startswith("speed of `joint1` up exceeds its limit by 0.413 rad/s (37.9 %)")
    assert "with 0.587 rad/s to spare" in str(down)
