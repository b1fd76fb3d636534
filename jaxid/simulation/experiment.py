"""Experiments: a robot follows a motion by its servo, and sensors record it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float, Hashable, require_float64
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory

Samples = Float[np.ndarray, "samples joints"]
FeedForward = Callable[[Motion], Float[AnyArray, "samples joints"]]
"""Function from a desired motion to forces: `fit.predict`, or a model with its parameters."""


class Sensors(eqx.Module):
    """Encoders and torque measurements of a log.

    Attributes:
        encoder_step: Resolution of the logged angles [rad or m].
        white_noise: Standard deviation of the white noise of the forces, on the joint side
            [N m or N].
        coloured_noise: Standard deviation of the coloured noise of the forces [N m or N].
        memory: Time constant of the coloured noise [s].
        motor_side: Whether the log contains angles and torques of the motors.
    """

    encoder_step: float
    white_noise: Float[AnyArray, " joints"]
    coloured_noise: Float[AnyArray, " joints"]
    memory: float = 0.02
    motor_side: bool = eqx.field(static=True, default=False)

    def resolution(self, robot: Robot) -> Float[np.ndarray, " joints"]:
        """Return the steps of the encoders on the joint side [rad or m]."""
        turns = np.abs(np.diag(robot.drives.reduction)) if self.motor_side else 1.0
        return np.broadcast_to(self.encoder_step / turns, robot.joints)

    def record(
        self,
        robot: Robot,
        angles: Float[AnyArray, "samples joints"],
        forces: Float[AnyArray, "samples joints"],
        *,
        sample_time: float,
        seed: int,
        name: str,
    ) -> Recording:
        """Make a recording of true angles and forces.

        Args:
            robot: Robot with its drives.
            angles: Angles of the motors, on the joint side [rad or m].
            forces: Forces of the drives, on the joint side [N m or N].
            sample_time: Time between two samples [s].
            seed: Seed of the noise.
            name: Name of the recording.
        """
        random = np.random.default_rng(seed)
        angles, forces = np.asarray(angles), np.asarray(forces)
        white, drive = random.standard_normal((2, *forces.shape))
        kept = np.exp(-sample_time / self.memory)
        initial = random.standard_normal((1, forces.shape[1]))
        coloured, _ = signal.lfilter(
            [np.sqrt(1.0 - kept**2)], [1.0, -kept], drive, axis=0, zi=kept * initial
        )
        forces = forces + white * np.asarray(self.white_noise)
        forces = forces + coloured * np.asarray(self.coloured_noise)
        if self.motor_side:
            angles = np.asarray(robot.drives.motor_angles(angles))
            forces = np.asarray(robot.drives.motor_torques(forces))
        return Recording.of(
            self.encoder_step * np.round(angles / self.encoder_step),
            forces,
            sample_time=sample_time,
            angles_on_motor_side=self.motor_side,
            forces_on_motor_side=self.motor_side,
            name=name,
        )


class Servo(eqx.Module):
    r"""Controller of every joint by itself, at a fixed rate.

    $u = Q_{m,d} + K_p e + K_d \dot e$ with the error $e$ of the encoder's angle. Its rate is a
    difference behind a first-order low-pass; $u$ is constant until the next tick.

    Attributes:
        proportional: $K_p$ [N m/rad or N/m].
        derivative: $K_d$ [N m s/rad or N s/m].
        sample_time: Time between two ticks [s].
        smoothing: Time constant of the low-pass [s].
    """

    proportional: Float[AnyArray, " joints"]
    derivative: Float[AnyArray, " joints"]
    sample_time: float = 1e-3
    smoothing: float = 2e-3

    def __check_init__(self):
        if not 0 < self.sample_time < np.inf:
            raise InputError(
                f"`sample_time` of the servo must be positive [s], but is {self.sample_time:g}."
            )
        if self.smoothing < 0:
            raise InputError(f"`smoothing` must not be negative [s], but is {self.smoothing:g}.")


class Tracking(eqx.Module):
    """Result of an experiment with a servo.

    Attributes:
        time: Times of the samples [s].
        desired: Desired motion.
        actual: True motion of the joints; accelerations, which jump, are the mean of both sides.
        forces: Forces of the drives on the joint side, without the sensors' noise, as the mean of
            before and after the sample [N m or N].
        recording: Recording of the sensors.
        saturated: Fraction of the servo's ticks at which a drive was at its limit, from 0 to 1.
    """

    time: Float[AnyArray, " samples"]
    desired: Motion
    actual: Motion
    forces: Float[AnyArray, "samples joints"]
    recording: Recording
    saturated: Float[AnyArray, " joints"]

    @property
    def tracking_error(self) -> Samples:
        """Desired minus true positions [rad or m]."""
        return np.asarray(self.desired.q) - np.asarray(self.actual.q)


class AbstractPlant(ABC):
    """Simulated robot that moves when its drives push; all numbers are on the joint side."""

    @abstractmethod
    def start(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        """Put the robot into a motion."""

    @abstractmethod
    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N]."""

    @abstractmethod
    def read(self) -> tuple[Sequence[float], Sequence[float]]:
        """Return angles of the motors; positions, velocities, accelerations of the joints."""


class AbstractExperiment(Hashable):
    """Robot to experiment on, whatever simulates it.

    Attributes:
        robot: Known properties of the robot.
        sensors: Sensors of its logs.
    """

    robot: eqx.AbstractVar[Robot]
    sensors: eqx.AbstractVar[Sensors]

    @abstractmethod
    def plant(self, step: float) -> AbstractPlant:
        """Return a simulation of the robot.

        Args:
            step: Time step [s].
        """

    @abstractmethod
    def servo(
        self, frequency: float = 8.0, damping: float = 1.0, sample_time: float = 1e-3
    ) -> Servo:
        """Return a servo whose gains suit the robot's inertia.

        Args:
            frequency: Natural frequency of each joint by itself [Hz].
            damping: Damping ratio; 1 for no overshoot.
            sample_time: Time between two ticks [s].
        """

    def track(
        self,
        trajectory: AbstractTrajectory,
        *,
        seed: int,
        servo: Servo | None = None,
        feed_forward: FeedForward | None = None,
        duration: float | None = None,
        sample_time: float | None = None,
        substeps: int = 1,
        name: str = "virtual",
    ) -> Tracking:
        """Follow a trajectory by a servo and record what the sensors measure.

        The robot starts in the desired motion. Gears keep their temperature, since seconds do not
        warm them: use `warmed` for that.

        Args:
            trajectory: Desired motion.
            seed: Seed of the sensors' noise.
            servo: Controller; `self.servo()` if None.
            feed_forward: Function from the desired motion to forces that are fed forward, such as
                `fit.predict`; no feed-forward if None.
            duration: Duration of the recording [s]; that of the trajectory if None.
            sample_time: Sample time of the recording [s], a multiple of the servo's; that of the
                servo if None.
            substeps: Steps of the simulation in one tick of the servo.
            name: Name of the recording.

        Raises:
            InputError: If the times do not fit together, or the motion diverges.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("a virtual experiment")
        servo = self.servo() if servo is None else servo
        tick = servo.sample_time
        duration = float(trajectory.duration) if duration is None else duration
        sample_time = tick if sample_time is None else sample_time
        every = max(round(sample_time / tick), 1)
        if not abs(every * tick - sample_time) < 1e-6 * tick:
            raise InputError(
                f"`sample_time` must be a multiple of the servo's ({tick:g} s), but is "
                f"{sample_time:g} s."
            )
        if substeps < 1 or not duration >= tick:
            raise InputError(
                f"`duration` must be at least one tick of the servo ({tick:g} s) and `substeps` at "
                f"least 1, but they are {duration:g} s and {substeps}."
            )
        time = tick * np.arange(round(duration / tick))
        motion = trajectory.motion(time)
        desired = Motion(*(np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)))
        forward = np.zeros(desired.q.shape)
        if feed_forward is not None:
            forward = np.asarray(feed_forward(desired), np.float64)
            if forward.shape != desired.q.shape or not np.isfinite(forward).all():
                raise InputError(
                    "`feed_forward` must give one finite force for each sample and joint "
                    f"{desired.q.shape}, but gives shape {forward.shape}."
                )
        actual, motors, forces = follow(
            self.plant(tick / substeps),
            servo,
            desired,
            forward,
            limits=np.asarray(self.robot.known_max_forces),
            resolution=self.sensors.resolution(self.robot),
            substeps=substeps,
        )
        at_limit = np.abs(forces) >= np.asarray(self.robot.known_max_forces)
        mean_forces = 0.5 * (forces + np.concatenate([forces[:1], forces[:-1]]))
        kept = slice(None, None, every)
        return Tracking(
            time=time[kept],
            desired=Motion(desired.q[kept], desired.qd[kept], desired.qdd[kept]),
            actual=Motion(actual.q[kept], actual.qd[kept], actual.qdd[kept]),
            forces=mean_forces[kept],
            recording=self.sensors.record(
                self.robot,
                motors[kept],
                mean_forces[kept],
                sample_time=every * tick,
                seed=seed,
                name=name,
            ),
            saturated=at_limit.mean(axis=0),
        )


def follow(
    plant: AbstractPlant,
    servo: Servo,
    desired: Motion,
    forward: Samples,
    *,
    limits: Float[AnyArray, " joints"],
    resolution: Float[AnyArray, " joints"],
    substeps: int,
) -> tuple[Motion, Samples, Samples]:
    """Let a servo follow a motion, from its start and without an initial error.

    Args:
        plant: Simulated robot.
        servo: Controller.
        desired: Desired motion at the servo's ticks.
        forward: Forces that are fed forward [N m or N].
        limits: Largest forces of the drives [N m or N].
        resolution: Steps of the encoders [rad or m].
        substeps: Steps of the plant in one tick.

    Returns:
        True motion of the joints, angles of the motors [rad or m], and forces of the drives after
        each tick [N m or N].

    Raises:
        InputError: If the motion diverges.
    """
    ticks, n = forward.shape
    goals, known = np.asarray(desired.q).tolist(), forward.tolist()
    kp, kd, limit, step = (
        np.asarray(x, np.float64).tolist()
        for x in (servo.proportional, servo.derivative, limits, resolution)
    )
    keep = float(np.exp(-servo.sample_time / servo.smoothing)) if servo.smoothing else 0.0
    gain = (1.0 - keep) / servo.sample_time
    joints = range(n)
    plant.start(*(np.asarray(x)[0] for x in (desired.q, desired.qd, desired.qdd)))
    motors, motion, forces = [], [], []
    last, rate = None, [0.0] * n
    try:
        for k in range(ticks):
            (angles, state), goal = plant.read(), goals[k]
            error = [goal[i] - step[i] * round(angles[i] / step[i]) for i in joints]
            # The first tick has no error to compare with, and a constant error no rate.
            before = error if last is None else last
            rate = [keep * rate[i] + gain * (error[i] - before[i]) for i in joints]
            u = [known[k][i] + kp[i] * error[i] + kd[i] * rate[i] for i in joints]
            u = [min(max(u[i], -limit[i]), limit[i]) for i in joints]
            last = error
            motors.append(list(angles))
            motion.append(list(state))
            forces.append(u)
            for _ in range(substeps):
                plant.step(u)
    except (ArithmeticError, ValueError) as failure:
        raise InputError(
            f"the simulated robot diverged after {len(forces) * servo.sample_time:g} s: make the "
            "`servo` softer or `substeps` larger, and check that the bodies can exist."
        ) from failure
    q, qd, qdd = np.split(np.array(motion), 3, axis=1)
    after = np.concatenate([qdd[1:], np.array(plant.read()[1]).reshape(3, n)[2:]])
    return Motion(q, qd, 0.5 * (qdd + after)), np.array(motors), np.array(forces)
