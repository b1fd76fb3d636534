"""A virtual robot: possible bodies, friction beyond the model, noisy sensors."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Hashable, Joints, require_float64
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import inertial_parameters
from jaxid.measurement.recording import Recording
from jaxid.program.sample_methods import in_numpy
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot
from jaxid.trajectory.trajectory import AbstractTrajectory

from .friction_and_ripple import (
    AbstractGearFriction,
    FrictionTemperature,
    TorqueRipple,
)
from .mechanics import DriveTrain, Servo, SimulatedPlant, follow

PerSample = Float[AnyArray, "samples joints"]
"""One number for each sample and joint."""
SERVO_FREQUENCY = 8.0
"""Natural frequency of a servo's joints [Hz]."""
SERVO_POSES = 200
"""Random poses of the mean inertia for which a servo is made."""
CLOUD_POINTS = 12
"""Point masses of a random body: enough to fill all directions."""
CLOUD_WIDTH = 0.05
"""Standard deviation of point masses from the line along a link [m]."""


def random_bodies(
    robot: Robot, masses: Joints, random: np.random.Generator
) -> BodyParameters:
    """Draw inertial parameters of bodies that can exist: point masses along the links.

    A cloud reaches from the origin of the body's frame to the next joint, or to the
    end-effector.

    Args:
        robot: Robot with its links.
        masses: Masses of the bodies [kg].
        random: Random number generator.
    """
    bodies = np.empty((robot.bodies, 10))
    for i, mass in enumerate(np.broadcast_to(masses, robot.bodies)):
        children = [c for c, parent in enumerate(robot.parent) if parent == i]
        end = np.asarray(robot.offset[children[0]] if children else robot.tip_offset)
        fractions = random.uniform(0.0, 1.0, (CLOUD_POINTS, 1))
        scatter = random.standard_normal((CLOUD_POINTS, 3))
        r = fractions * end + CLOUD_WIDTH * scatter
        shares = random.dirichlet(np.full(CLOUD_POINTS, 3.0))
        m = shares * mass
        ones = np.ones((CLOUD_POINTS, 1))
        homogeneous = np.append(r, ones, axis=1)
        pseudo_inertia = np.einsum("k,ki,kj->ij", m, homogeneous, homogeneous)
        bodies[i] = inertial_parameters(pseudo_inertia)
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

    def resolution(self, robot: Robot) -> Joints:
        """Return the steps of the encoders on the joint side [rad or m]."""
        turns = np.abs(np.diag(robot.drives.reduction)) if self.motor_side else 1.0
        return np.broadcast_to(self.encoder_step / turns, robot.joints)

    def record(
        self,
        robot: Robot,
        angles: PerSample,
        forces: PerSample,
        *,
        sample_time: float,
        seed: int,
        name: str,
    ) -> Recording:
        """Make a recording of true angles and forces.

        Angles [rad or m] and forces [N m or N] are those of the joint side.
        """
        random = np.random.default_rng(seed)
        angles = np.asarray(angles)
        forces = np.asarray(forces)
        white_part, drive = random.standard_normal((2, *forces.shape))
        initial_states = random.standard_normal((1, forces.shape[1]))
        # Each sample remembers a part of the one before; the variance stays one.
        share = np.exp(-sample_time / self.memory)
        gain = np.sqrt(1.0 - share**2)
        coloured_part, _ = scipy.signal.lfilter(
            [gain], [1.0, -share], drive, axis=0, zi=share * initial_states
        )
        forces = forces + white_part * np.asarray(self.white_noise)
        forces = forces + coloured_part * np.asarray(self.coloured_noise)
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

    time: AnyArray
    desired: Motion
    actual: Motion
    forces: PerSample
    recording: Recording
    saturated: Joints

    @property
    def tracking_error(self) -> PerSample:
        """Desired minus true positions [rad or m]."""
        return np.asarray(self.desired.q) - np.asarray(self.actual.q)


class VirtualRobot(Hashable):
    """A robot whose parameters are known, with the imperfections of every measurement.

    It can follow a motion without error (`measure`), which is fast, or by its servo
    (`track`), where stiction and torque ripple act as in a machine.

    Attributes:
        robot: Known properties of the robot.
        terms: Equations of motion without friction.
        values: Parameters of these terms.
        friction: Friction of the gears.
        sensors: Sensors of its logs.
        ripple: Ripple of the motor torques; none if None.
        heating: Temperature of the gears, and how friction depends on it; None if it
            does not.
    """

    robot: Robot
    terms: tuple[AbstractTerm, ...]
    values: Float[AnyArray, " parameters"]
    friction: AbstractGearFriction
    sensors: Sensors
    ripple: TorqueRipple | None = None
    heating: FrictionTemperature | None = None

    def __check_init__(self):
        size = self.bodies.size
        if self.values.shape != (size,):
            raise InputError(
                f"`values` must hold {size} numbers for `terms`, but has shape "
                f"{self.values.shape}."
            )

    @property
    def bodies(self) -> Model:
        """Equations of motion without friction."""
        return Model(self.robot, self.terms)

    @property
    def model(self) -> Model:
        """Model to identify; the columns of friction follow those of the first term."""
        return Model(self.robot, (self.terms[0], *self.friction.terms, *self.terms[1:]))

    @property
    def parameters(self) -> np.ndarray:
        """True standard parameters of `model`."""
        first_body, *other_bodies = (
            np.asarray(x) for _, x in self.bodies.split(self.values)
        )
        return np.concatenate([first_body, self.friction.parameters, *other_bodies])

    def replace(self, **fields: Any) -> "VirtualRobot":
        """Return a copy with some fields replaced, such as another friction."""
        return dataclasses.replace(self, **fields)

    def at(self, temperature: Joints | float) -> "VirtualRobot":
        """Return the same robot with gears of another temperature.

        Args:
            temperature: Temperature of all gears, or of each [°C].

        Raises:
            InputError: If friction does not depend on temperature.
        """
        if self.heating is None:
            raise InputError(
                "`temperature` changes nothing here: give the robot `heating`."
            )
        viscous_factors, dry_factors = self.heating.factors(temperature)
        return self.replace(
            friction=self.friction.scaled(viscous_factors, dry_factors),
            heating=dataclasses.replace(self.heating, temperature=temperature),
        )

    def resistance(self, q: Joints, qd: Joints) -> Joints:
        """Return friction less ripple of one sample, at constant speeds [N m or N]."""
        friction = self.friction.steady(qd)
        if self.ripple is None:
            return friction
        return friction - self.ripple.forces(self.robot, q)

    def forces(self, motion: Motion) -> PerSample:
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
        """Follow a trajectory without error; record angles and forces as sensors do.

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
        """Return a servo whose gains suit each joint's mean inertia over random poses.

        Each joint by itself has a natural frequency of 8 Hz, and no overshoot.

        Args:
            sample_time: Time between two ticks [s].
        """
        model = self.bodies
        random = np.random.default_rng(0)
        shape = (SERVO_POSES, self.robot.joints)
        angles = random.uniform(-np.pi, np.pi, shape)
        q = angles * np.array(self.robot.revolute)
        M = in_numpy(model, model.inertia, q, shared=(np.asarray(self.values),))
        diagonals = np.diagonal(M, axis1=1, axis2=2)
        inertia = diagonals.mean(axis=0)
        omega = 2.0 * np.pi * SERVO_FREQUENCY
        stiffness = omega**2 * inertia
        damping = 2.0 * omega * inertia
        return Servo(stiffness, damping, sample_time)

    def plant(self, step: float) -> Any:
        """Return a simulation of the robot with a time step [s].

        Its parts are `start`, `step` and `read`.
        """
        friction = self.friction
        drives = DriveTrain(self.bodies, friction, self.ripple, step)
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

        The robot starts in the desired motion. Gears keep their temperature: `at` gives
        them another one.

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
        ticks_per_sample = max(round(sample_time / tick), 1)
        is_multiple = abs(ticks_per_sample * tick - sample_time) < 1e-6 * tick
        if not is_multiple or not duration >= tick:
            raise InputError(
                f"`sample_time` must be a multiple of the servo's ({tick:g} s), and "
                f"`duration` at least that, but they are {sample_time:g} s and "
                f"{duration:g} s."
            )
        time = tick * np.arange(round(duration / tick))
        desired_motion = jax.tree.map(np.asarray, trajectory.motion(time))
        limits = np.asarray(self.robot.known_max_forces)
        run = follow(
            self.plant(tick / substeps),
            servo,
            desired_motion,
            forward_forces(feed_forward, desired_motion),
            limits,
            self.sensors.resolution(self.robot),
            substeps,
        )
        saturated_fractions = (np.abs(run.forces) >= limits).mean(axis=0)

        samples = slice(None, None, ticks_per_sample)
        # Forces are constant between ticks: the mean of before and after a sample.
        previous_forces = np.concatenate([run.forces[:1], run.forces[:-1]])
        forces = (0.5 * (run.forces + previous_forces))[samples]
        actual_motion = run.motion[samples]
        log = self.sensors.record(
            self.robot,
            actual_motion.q,
            forces,
            sample_time=ticks_per_sample * tick,
            seed=seed,
            name=name,
        )
        return Tracking(
            time[samples],
            desired_motion[samples],
            actual_motion,
            forces,
            log,
            saturated_fractions,
        )


def forward_forces(
    feed_forward: Callable[[Motion], AnyArray] | None, desired: Motion
) -> PerSample:
    """Return the forces that are fed forward [N m or N]."""
    if feed_forward is None:
        return np.zeros(desired.q.shape)
    forces = np.asarray(feed_forward(desired), np.float64)
    if forces.shape != desired.q.shape or not np.isfinite(forces).all():
        raise InputError(
            f"`feed_forward` must give finite forces of shape {desired.q.shape}, but "
            f"gives shape {forces.shape}."
        )
    return forces
