"""A robot that follows a desired motion by its servo: what was asked, and what happened."""

from abc import ABC, abstractmethod
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording
from jaxid.simulation.servo import Servo

Samples = Float[np.ndarray, "samples joints"]


class Tracking(eqx.Module):
    """One experiment with a servo.

    Attributes:
        time: Of the samples [s].
        desired: What was asked.
        actual: What the joints truly did.
        forces: Of the drives, on the joints' side, without the sensors' noise [N m or N].
        recording: What the sensors say of it.
        saturated: Share of the servo's ticks at which a drive gave all it has, of 1.
    """

    time: Float[AnyArray, " samples"]
    desired: Motion
    actual: Motion
    forces: Float[AnyArray, "samples joints"]
    recording: Recording
    saturated: Float[AnyArray, " joints"]

    @property
    def tracking_error(self) -> Samples:
        """Desired less true positions [rad or m]."""
        return np.asarray(self.desired.q) - np.asarray(self.actual.q)


class AbstractPlant(ABC):
    """A robot that moves when its drives push; all numbers are on the joints' side."""

    @abstractmethod
    def start(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        """Puts the robot into a motion."""

    @abstractmethod
    def step(self, u: Sequence[float]) -> None:
        """Moves on by one step with constant torques of the drives [N m or N]."""

    @abstractmethod
    def read(self) -> tuple[Sequence[float], Sequence[float]]:
        """Angles of the motors; positions, velocities, accelerations of the joints."""


class Run(eqx.Module):
    """What happened at the ticks of a servo, before any sensor.

    Attributes:
        motion: Of the joints; of the accelerations, which jump, the mean of both sides.
        motors: Angles of the motors [rad or m].
        forces: Of the drives; the mean of before and after the tick [N m or N].
        saturated: Share of the ticks at which a drive gave all it has, of 1.
    """

    motion: Motion
    motors: Float[AnyArray, "samples joints"]
    forces: Float[AnyArray, "samples joints"]
    saturated: Float[AnyArray, " joints"]


def run_servo(
    plant: AbstractPlant,
    servo: Servo,
    desired: Motion,
    fed_forward: Samples,
    *,
    most: Float[AnyArray, " joints"],
    resolution: Float[AnyArray, " joints"],
    substeps: int,
) -> Run:
    """Lets a servo follow a motion, from its start on and without an error there.

    Args:
        plant: What is driven.
        servo: What drives it.
        desired: The motion at the servo's ticks.
        fed_forward: Forces at the ticks [N m or N].
        most: Largest forces of the drives [N m or N].
        resolution: Steps of the encoders [rad or m].
        substeps: Of the plant in one tick.

    Raises:
        InputError: If the motion grows beyond all bounds.
    """
    ticks, n = fed_forward.shape
    asked, forward = np.asarray(desired.q).tolist(), fed_forward.tolist()
    step = np.asarray(resolution, np.float64)
    kp, kd, limit, step = (
        np.asarray(x, np.float64).tolist()
        for x in (servo.proportional, servo.derivative, most, step)
    )
    keep = float(np.exp(-servo.sample_time / servo.smoothing)) if servo.smoothing else 0.0
    gain = (1.0 - keep) / servo.sample_time
    joints = range(n)
    plant.start(*(np.asarray(x)[0] for x in (desired.q, desired.qd, desired.qdd)))
    motors, motion, given = [], [], []
    last, rate = None, [0.0] * n
    try:
        for k in range(ticks):
            (angles, moves), goal, known = plant.read(), asked[k], forward[k]
            error = [goal[i] - step[i] * round(angles[i] / step[i]) for i in joints]
            # The first tick has no error to compare with: a standing one is no motion.
            before = error if last is None else last
            rate = [keep * rate[i] + gain * (error[i] - before[i]) for i in joints]
            u = [known[i] + kp[i] * error[i] + kd[i] * rate[i] for i in joints]
            u = [min(max(u[i], -limit[i]), limit[i]) for i in joints]
            last = error
            motors.append(list(angles))
            motion.append(list(moves))
            given.append(u)
            for _ in range(substeps):
                plant.step(u)
    except (ArithmeticError, ValueError) as failure:
        raise InputError(
            f"the simulated robot ran away after {len(given) * servo.sample_time:g} s: make the "
            "servo softer or the steps shorter, and see whether the bodies could exist."
        ) from failure
    q, qd, qdd = np.split(np.array(motion), 3, axis=1)
    after = np.concatenate([qdd[1:], np.array(plant.read()[1]).reshape(3, n)[2:]])
    u = np.array(given)
    return Run(
        motion=Motion(q, qd, 0.5 * (qdd + after)),
        motors=np.array(motors),
        forces=0.5 * (u + np.concatenate([u[:1], u[:-1]])),
        saturated=np.mean(np.abs(u) >= np.asarray(most), axis=0),
    )
