"""A virtual robot: bodies that can exist, friction beyond the model, sensors with noise."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from scipy import signal

from jaxid.arrays import AnyArray, Float, Hashable, Joints, require_float64
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import inertial_parameters
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory

from .friction_and_disturbances import (
    AbstractDisturbance,
    AbstractGearFriction,
    FrictionTemperature,
    SmoothFriction,
)
from .mechanics import DriveTrain, RigidGear, Servo, SimulatedPlant, follow


def random_bodies(
    robot: Robot, masses: Joints, random: np.random.Generator
) -> Float[np.ndarray, "joints 10"]:
    """Draw inertial parameters of bodies that can exist: clouds of point masses along the links.

    A cloud reaches from the origin of the body's frame to the next joint, or to the
    end-effector.

    Args:
        robot: Robot with its links.
        masses: Masses of the bodies [kg].
        random: Random number generator.
    """
    points = 12  # enough to fill all directions
    bodies = np.empty((robot.joints, 10))
    for i, mass in enumerate(np.asarray(masses)):
        children = [c for c, parent in enumerate(robot.parent) if parent == i]
        end = robot.offset[children[0]] if children else robot.tip_offset
        along = random.uniform(0.0, 1.0, (points, 1))
        r = along * np.asarray(end) + 0.05 * random.standard_normal((points, 3))
        m = random.dirichlet(np.full(points, 3.0)) * mass
        r = np.append(r, np.ones((points, 1)), axis=1)
        bodies[i] = inertial_parameters(np.einsum("k,ki,kj->ij", m, r, r))
    return bodies


class Sensors(eqx.Module):
    """Encoders and torque measurements of a log.

    Attributes:
        encoder_step: Resolution of the logged angles [rad or m].
        white_noise: Standard deviation of the white noise of the forces, on the joint
            side [N m or N].
        coloured_noise: Standard deviation of the coloured noise of the forces [N m or
            N].
        memory: Time constant of the coloured noise [s].
        motor_side: Whether the log contains angles and torques of the motors.
    """

    encoder_step: float
    white_noise: Joints
    coloured_noise: Joints
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
        """Make a recording of true angles [rad or m] and forces [N m or N] of the joint side."""
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


class Tracking(eqx.Module):
    """Result of an experiment with a servo.

    Attributes:
        time: Times of the samples [s].
        desired: Desired motion.
        actual: True motion of the joints; accelerations, which jump, are the mean of
            both sides.
        forces: Forces of the drives on the joint side, without the sensors' noise, as
            the mean of before and after the sample [N m or N].
        recording: Recording of the sensors.
        saturated: Fraction of the servo's ticks at which a drive was at its limit, from
            0 to 1.
    """

    time: Float[AnyArray, " samples"]
    desired: Motion
    actual: Motion
    forces: Float[AnyArray, "samples joints"]
    recording: Recording
    saturated: Joints

    @property
    def tracking_error(self) -> Float[np.ndarray, "samples joints"]:
        """Desired minus true positions [rad or m]."""
        return np.asarray(self.desired.q) - np.asarray(self.actual.q)


class VirtualRobot(Hashable):
    """A robot whose parameters are known, with the imperfections of every measurement.

    It can follow a motion without error (`measure`), which is fast, or by its servo
    (`track`), where gears, stiction and disturbances act as in a machine.

    Attributes:
        robot: Known properties of the robot.
        terms: Equations of motion without friction.
        values: Parameters of these terms.
        friction: Friction of the gears, at the reference temperature.
        sensors: Sensors of its logs.
        gear: Gears between motors and joints.
        disturbances: Further forces.
        heating: Dependence of friction on temperature; none if None.
        temperature: Temperatures of the gears [°C]; None without `heating`.
    """

    robot: Robot
    terms: tuple[AbstractTerm, ...]
    values: Float[AnyArray, " parameters"]
    friction: AbstractGearFriction
    sensors: Sensors
    gear: RigidGear = RigidGear()
    disturbances: tuple[AbstractDisturbance, ...] = ()
    heating: FrictionTemperature | None = None
    temperature: Joints | None = None

    def __check_init__(self):
        size, shape = (
            self.bodies.size,
            None if self.heating is None else (self.robot.joints,),
        )
        if self.values.shape != (size,):
            raise InputError(
                f"`values` must hold {size} numbers for `terms`, but has shape "
                f"{self.values.shape}."
            )
        if (None if self.temperature is None else self.temperature.shape) != shape:
            raise InputError(
                "`temperature` must hold one number for each gear with `heating`, "
                "else None."
            )

    @property
    def bodies(self) -> Model:
        """Equations of motion without friction."""
        return Model(self.robot, self.terms)

    @property
    def rotors(self) -> Float[np.ndarray, " joints"]:
        """Inertia of the rotors on the joint side [kg m² or kg]."""
        parts = self.bodies.split(self.values)
        inertia = sum(t.drive_matrices(self.robot)[0] @ np.asarray(x) for t, x in parts)
        return np.diagonal(np.asarray(inertia))

    @property
    def present_friction(self) -> AbstractGearFriction:
        """Friction of the gears at their temperature."""
        if self.heating is None or self.temperature is None:
            return self.friction
        return self.friction.scaled(*self.heating.factors(self.temperature))

    @property
    def model(self) -> Model:
        """Model to identify: the columns of friction stand behind those of the first term."""
        return Model(self.robot, (self.terms[0], *self.friction.terms, *self.terms[1:]))

    @property
    def parameters(self) -> Float[np.ndarray, " standard"]:
        """True standard parameters of `model` at the present temperature."""
        first, *others = (np.asarray(x) for _, x in self.bodies.split(self.values))
        return np.concatenate([first, self.present_friction.parameters, *others])

    def replace(self, **fields: Any) -> "VirtualRobot":
        """Return a copy with some fields replaced: such as another gear."""
        return dataclasses.replace(self, **fields)

    def undisturbed(self) -> "VirtualRobot":
        """Return the robot of the model: smooth friction, rigid gears, and sensor noise only."""
        plain = SmoothFriction(self.friction.viscous, self.friction.coulomb)
        return self.replace(friction=plain, gear=RigidGear(), disturbances=())

    def at(self, temperature: Joints | float) -> "VirtualRobot":
        """Return the same robot with gears of another temperature.

        Args:
            temperature: Temperature of all gears, or of each [°C].

        Raises:
            InputError: If friction does not depend on temperature.
        """
        return self.replace(
            temperature=np.full(self.robot.joints, temperature, np.float64)
        )

    def warming(
        self, trajectory: AbstractTrajectory, *, duration: float
    ) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times joints"]]:
        """Return temperatures while a motion is repeated: friction heats the gears (Sec. 6).

        Args:
            trajectory: Repeated motion.
            duration: Duration [s].

        Returns:
            Times from now on [s], about every 30 s, and temperatures [°C].

        Raises:
            InputError: If friction does not depend on temperature.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("warming a virtual robot")
        heating = self.heating
        if heating is None:
            raise InputError(
                "friction does not depend on temperature: give the robot `heating`."
            )
        # The power of friction is averaged over 2000 instants of the motion.
        _, motion = trajectory.sample(float(trajectory.duration) / 2000)
        steps = max(1, round(duration / 30.0))
        parts = [
            self.friction.scaled(*x)
            for x in np.eye(2)[:, :, None] * np.ones(motion.qd[0].shape)
        ]
        powers = [
            np.mean(in_numpy(x, x.steady, motion.qd) * motion.qd, axis=0) for x in parts
        ]
        temperatures = [np.asarray(self.temperature)]
        for _ in range(steps):
            viscous, dry = heating.factors(temperatures[-1])
            power = viscous * powers[0] + dry * powers[1]
            temperatures.append(
                heating.warm_up(temperatures[-1], power, duration / steps)
            )
        return np.linspace(0.0, duration, steps + 1), np.array(temperatures)

    def warmed(
        self, trajectory: AbstractTrajectory, *, duration: float
    ) -> "VirtualRobot":
        """Return the same robot after a motion has been repeated for some time; see `warming`.

        Args:
            trajectory: Repeated motion.
            duration: Duration [s]; the paper's robot is warm after 1800 s.
        """
        return self.replace(
            temperature=self.warming(trajectory, duration=duration)[1][-1]
        )

    def resistance(self, q: Joints, qd: Joints) -> Joints:
        """Return friction less disturbances of one sample, at constant speeds [N m or N]."""
        forces = self.present_friction.steady(qd)
        for disturbance in self.disturbances:
            forces = forces - disturbance.forces(self.robot, q, qd)
        return forces

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Return the forces of the drives for a motion, with rigid gears [N m or N]."""
        arrays = [np.asarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
        forces = in_numpy(
            self.bodies, self.bodies.forces, *arrays, shared=(self.values,)
        )
        if self.robot.tool is not None:
            forces = forces + in_numpy(self.bodies, self.bodies.known_forces, *arrays)
        return forces + in_numpy(self, self.resistance, *arrays[:2])

    def measure(
        self,
        trajectory: AbstractTrajectory,
        *,
        duration: float,
        sample_time: float,
        seed: int,
        name: str = "virtual",
    ) -> Recording:
        """Follow a trajectory without error and record angles and forces as sensors measure them.

        Args:
            trajectory: Motion.
            duration: Duration of the recording [s].
            sample_time: Time between two samples [s].
            seed: Seed of the noise.
            name: Name of the recording.
        """
        require_float64("a virtual measurement")
        motion = trajectory.motion(
            sample_time * np.arange(round(duration / sample_time))
        )
        forces = self.forces(motion)
        return self.sensors.record(
            self.robot, motion.q, forces, sample_time=sample_time, seed=seed, name=name
        )

    def servo(self, sample_time: float = 1e-3) -> Servo:
        """Return a servo whose gains suit the mean inertia of each joint over random poses.

        Each joint by itself has a natural frequency of 8 Hz, and no overshoot.

        Args:
            sample_time: Time between two ticks [s].
        """
        model, turns = self.bodies, np.array(self.robot.revolute)
        q = (
            np.random.default_rng(0).uniform(-np.pi, np.pi, (200, self.robot.joints))
            * turns
        )
        M = in_numpy(model, model.inertia, q, shared=(np.asarray(self.values),))
        inertia = np.diagonal(M, axis1=1, axis2=2).mean(axis=0)
        w = 2.0 * np.pi * 8.0
        return Servo(w**2 * inertia, 2.0 * w * inertia, sample_time)

    def plant(self, step: float) -> Any:
        """Return a simulation of the robot with a time step [s]: `start`, `step`, `read`.

        Raises:
            InputError: If an elastic gear has a motor without inertia.
        """
        elastic = np.asarray(self.gear.twist(np.ones(self.robot.joints))) != 0.0
        if (elastic & ~(self.rotors > 0)).any():
            raise InputError(
                "an elastic gear needs a motor with inertia: give `terms` a "
                "`RotorInertia`."
            )
        friction = self.present_friction
        drives = DriveTrain(
            self.bodies, self.rotors, friction, self.gear, self.disturbances, step
        )
        return SimulatedPlant(drives, self.values)

    def track(
        self,
        trajectory: AbstractTrajectory,
        *,
        seed: int,
        servo: Servo | None = None,
        feed_forward: Callable[[Motion], AnyArray] | None = None,
        duration: float | None = None,
        sample_time: float | None = None,
        substeps: int = 1,
        name: str = "virtual",
    ) -> Tracking:
        """Follow a trajectory by a servo and record what the sensors measure.

        The robot starts in the desired motion. Gears keep their temperature, since
        seconds do not warm them: use `warmed` for that.

        Args:
            trajectory: Desired motion.
            seed: Seed of the sensors' noise.
            servo: Controller; `self.servo()` if None.
            feed_forward: Function from the desired motion to forces that are fed
                forward, such as `fit.predict`; no feed-forward if None.
            duration: Duration of the recording [s]; that of the trajectory if None.
            sample_time: Sample time of the recording [s], a multiple of the servo's;
                that of the servo if None.
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
        if not abs(every * tick - sample_time) < 1e-6 * tick or not duration >= tick:
            raise InputError(
                f"`sample_time` must be a multiple of the servo's ({tick:g} s), and "
                "`duration` at "
                f"least that, but they are {sample_time:g} s and {duration:g} s."
            )
        time = tick * np.arange(round(duration / tick))
        desired = jax.tree.map(np.asarray, trajectory.motion(time))
        forward = np.zeros(desired.q.shape)
        if feed_forward is not None:
            forward = np.asarray(feed_forward(desired), np.float64)
            if forward.shape != desired.q.shape or not np.isfinite(forward).all():
                raise InputError(
                    "`feed_forward` must give finite forces of shape "
                    f"{desired.q.shape}, but gives "
                    f"shape {forward.shape}."
                )
        limits = np.asarray(self.robot.known_max_forces)
        resolution = self.sensors.resolution(self.robot)
        plant = self.plant(tick / substeps)
        actual, motors, forces = follow(
            plant, servo, desired, forward, limits, resolution, substeps
        )
        saturated = (np.abs(forces) >= limits).mean(axis=0)
        kept = slice(None, None, every)
        forces = 0.5 * (forces + np.concatenate([forces[:1], forces[:-1]]))[kept]
        log = self.sensors.record(
            self.robot,
            motors[kept],
            forces,
            sample_time=every * tick,
            seed=seed,
            name=name,
        )
        return Tracking(time[kept], desired[kept], actual[kept], forces, log, saturated)
