"""A path of the end-effector as a motion of the joints."""

import math

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from jaxid.arrays import AnyArray, Array, Float, Numbers
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.robot import Robot
from jaxid.trajectory.tip_path import TipPath
from jaxid.trajectory.trajectory import AbstractTrajectory, each_time

DEGREE = 5
LEAST = 12
"""Polynomials of a piece of the path."""
TOLERANCE = 1e-3
"""Share by which speeds and accelerations between instants may exceed their limits."""


class JointPath(AbstractTrajectory):
    """Polynomials one after the other: a path of the end-effector as the joints move it.

    Before its start and after its end the robot stands still. `joint_path` makes it.

    Attributes:
        times: At which polynomials begin, and the end [s].
        coefficients: Of the powers of the time since a polynomial began, the highest first.
    """

    times: Float[AnyArray, " knots"]
    coefficients: Float[AnyArray, "powers pieces joints"]

    @property
    def duration(self) -> Float[AnyArray, ""] | float:
        """From standstill to standstill [s]."""
        return self.times[-1]

    def motion(self, t: Float[AnyArray, "*batch"] | float | int) -> Motion:
        """The motion at one time or at many [s]: standstill before the start and after the end."""
        return each_time(self._at, t)

    def _at(self, time: Float[Array, ""]) -> Motion:
        times, coefficients = jnp.asarray(self.times), jnp.asarray(self.coefficients)
        # Written with `where`, for the derivative of a clip is half of it at the ends.
        now = jnp.where(time < 0.0, 0.0, jnp.where(time > times[-1], times[-1], time))
        piece = jnp.clip(jnp.searchsorted(times, now, side="right") - 1, 0, len(times) - 2)
        x = now - times[piece]
        c = coefficients[:, piece]
        q, qd, qdd = c[0], jnp.zeros_like(c[0]), jnp.zeros_like(c[0])
        for coefficient in c[1:]:
            qdd = qdd * x + 2 * qd
            qd = qd * x + q
            q = q * x + coefficient
        moves = (time > 0.0) & (time < times[-1])
        return Motion(q, jnp.where(moves, qd, 0.0), jnp.where(moves, qdd, 0.0))


def joint_path(
    robot: Robot,
    path: TipPath,
    *,
    posture: Numbers | None = None,
    spacing: float = 0.01,
    starts: int = 32,
    seed: int = 0,
) -> JointPath:
    """The motion of the joints that takes the end-effector along a path.

    Inverse kinematics at close instants, between them splines of the fifth degree that stand still
    where pieces of the path meet.

    Args:
        robot: Whose end-effector moves.
        path: Of the end-effector.
        posture: Preferred coordinates [rad or m]; the middle of the ranges if None.
        spacing: Largest time between two instants [s].
        starts: Random coordinates to start from.
        seed: Of the starts.

    Raises:
        InputError: If a part of the path is out of reach, a joint would have to move faster than it
            can, or `spacing` is not positive.
    """
    if not 0 < spacing < np.inf:
        raise InputError(f"`spacing` must be positive [s], but is {spacing:g}.")
    counts = [max(LEAST, int(np.ceil(time / spacing))) for time in path.durations]
    ends = np.concatenate([[0.0], np.cumsum(path.durations)])
    instants = [
        np.linspace(a, b, count + 1)
        for a, b, count in zip(ends[:-1], ends[1:], counts, strict=True)
    ]
    times = np.concatenate([*(t[:-1] for t in instants), ends[-1:]])
    q = inverse_kinematics_along(
        robot, path.positions(times), path.rotation, posture=posture, starts=starts, seed=seed
    )
    still = [(k, np.zeros(robot.joints)) for k in (1, 2)]
    knots, polynomials, begin = [], [], 0
    for t, count in zip(instants, counts, strict=True):
        nodes = t - t[0]
        spline = make_interp_spline(
            nodes, q[begin : begin + count + 1], DEGREE, bc_type=(still, still)
        )
        inner = spline.t[DEGREE:-DEGREE]
        knots.append(t[0] + inner[:-1])
        polynomials.append(_powers(spline, inner))
        begin += count
    coefficients = np.concatenate(polynomials, axis=1)
    _refuse_haste(robot, path, coefficients[-2], 2 * coefficients[-3])
    return JointPath(np.concatenate([*knots, ends[-1:]]), coefficients)


def _refuse_haste(robot: Robot, path: TipPath, qd: np.ndarray, qdd: np.ndarray) -> None:
    speed = np.abs(qd).max(axis=0) / np.asarray(robot.limits.velocity)
    acceleration = np.abs(qdd).max(axis=0) / np.asarray(robot.limits.acceleration)
    # A path that is run f times slower needs a fraction 1/f of speeds and 1/f² of accelerations.
    slower = np.maximum(speed, np.sqrt(acceleration))
    j = int(slower.argmax())
    if slower[j] > 1.0 + TOLERANCE:
        what = "speed" if speed[j] == slower[j] else "acceleration"
        f = 1.01 * slower[j]
        raise InputError(
            f"joint `{robot.joint_names[j]}` would need {max(speed[j], acceleration[j]):.2f} times "
            f"its largest {what}: give the path a `speed` of {path.speed / f:.3g} m/s and an "
            f"`acceleration` of {path.acceleration / f**2:.3g} m/s², or choose another posture."
        )


def _powers(spline: BSpline, knots: np.ndarray) -> np.ndarray:
    """Coefficients of the powers of the time since each knot, the highest first."""
    begin = knots[:-1]
    lower = [spline(begin)]
    lower += [spline.derivative(k)(begin) / math.factorial(k) for k in range(1, DEGREE)]
    # The highest derivative jumps at the knots, where rounding would decide which piece is meant.
    middle = (begin + knots[1:]) / 2
    highest = spline.derivative(DEGREE)(middle) / math.factorial(DEGREE)
    return np.stack([highest, *lower[::-1]])
