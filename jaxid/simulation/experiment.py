"""An experiment: a robot, ours or that of another simulator, that follows a motion by its servo."""

from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import require_float64
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.robot import Robot
from jaxid.simulation.sensors import Sensors
from jaxid.simulation.servo import FeedForward, Servo
from jaxid.simulation.tracking import AbstractPlant, Tracking, run_servo
from jaxid.trajectory.trajectory import AbstractTrajectory


class AbstractExperiment(eqx.Module):
    """A robot to experiment on, whatever moves it.

    Attributes:
        robot: What is known of it.
        sensors: What the log will say.
    """

    robot: eqx.AbstractVar[Robot]
    sensors: eqx.AbstractVar[Sensors]

    @abstractmethod
    def plant(self, step: float) -> AbstractPlant:
        """The robot as a machine that moves when its drives push.

        Args:
            step: Of time [s].
        """

    @abstractmethod
    def servo(self, frequency: float = 8.0, damping: float = 1.0) -> Servo:
        """A servo whose gains suit the robot's inertia.

        Args:
            frequency: Of a joint's answer to a disturbance [Hz].
            damping: Of that answer.
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
        """Follows a trajectory by a servo and records what sensors give.

        The robot starts in the desired motion. Gears keep their temperature, since seconds do not
        warm them: `warmed` is for that.

        Args:
            trajectory: What is asked.
            seed: Of the sensors' noise.
            servo: The controller; `self.servo()` if None.
            feed_forward: From the desired motion to forces that are fed forward, such as
                `fit.predict`; none if None.
            duration: Of the recording; that of the trajectory if None [s].
            sample_time: Of the recording, a multiple of the servo's; the servo's if None [s].
            substeps: Steps of the simulation in one tick of the servo.
            name: Of the recording.

        Raises:
            InputError: If the times do not fit together, or the motion grows beyond all bounds.
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
                f"least 1, but are {duration:g} s and {substeps}."
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
        run = run_servo(
            self.plant(tick / substeps),
            servo,
            desired,
            forward,
            most=np.asarray(self.robot.known_max_forces),
            resolution=self.sensors.resolution(self.robot),
            substeps=substeps,
        )
        kept = slice(None, None, every)
        return Tracking(
            time=time[kept],
            desired=Motion(desired.q[kept], desired.qd[kept], desired.qdd[kept]),
            actual=Motion(run.motion.q[kept], run.motion.qd[kept], run.motion.qdd[kept]),
            forces=run.forces[kept],
            recording=self.sensors.record(
                self.robot,
                run.motors[kept],
                run.forces[kept],
                sample_time=every * tick,
                seed=seed,
                name=name,
            ),
            saturated=run.saturated,
        )
