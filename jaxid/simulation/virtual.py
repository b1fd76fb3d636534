"""A virtual robot: bodies that can exist, friction beyond the model, sensors with noise."""

import dataclasses
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float, require_float64
from jaxid.dynamics.dispatch import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import inertial_parameters
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.simulation.experiment import AbstractExperiment, Sensors, Servo
from jaxid.simulation.friction import (
    AbstractDisturbance,
    AbstractGearFriction,
    FrictionTemperature,
    SmoothFriction,
)
from jaxid.simulation.mechanics import AbstractGear, DriveTrain, RigidGear, SimulatedPlant
from jaxid.trajectory.trajectory import AbstractTrajectory


def random_bodies(
    robot: Robot,
    masses: Float[AnyArray, " joints"],
    random: np.random.Generator,
    radius: float = 0.05,
) -> Float[np.ndarray, "joints 10"]:
    """Draw inertial parameters of bodies that can exist: clouds of point masses along the links.

    A cloud reaches from the origin of the body's frame to the next joint, or to the end-effector.

    Args:
        robot: Robot with its links.
        masses: Masses of the bodies [kg].
        random: Random number generator.
        radius: Standard deviation of the points about the link's line [m].
    """
    points = 12  # enough to fill all directions
    bodies = np.empty((robot.joints, 10))
    for i, mass in enumerate(np.asarray(masses)):
        children = [c for c, parent in enumerate(robot.parent) if parent == i]
        end = robot.offset[children[0]] if children else robot.tip_offset
        along = random.uniform(0.0, 1.0, (points, 1))
        r = along * np.asarray(end) + radius * random.standard_normal((points, 3))
        m = random.dirichlet(np.full(points, 3.0)) * mass
        r = np.append(r, np.ones((points, 1)), axis=1)
        bodies[i] = inertial_parameters(np.einsum("k,ki,kj->ij", m, r, r))
    return bodies


class VirtualRobot(AbstractExperiment):
    """A robot whose parameters are known, with the imperfections of every measurement.

    It can follow a motion without error (`measure`), which is fast, or by its servo (`track`),
    where gears, stiction and disturbances act as in a machine.

    Attributes:
        robot: Known properties of the robot.
        terms: Equations of motion without friction.
        values: Parameters of these terms.
        friction: Friction of the gears, at the reference temperature.
        sensors: Sensors of its logs.
        gear: Gears between motors and joints.
        disturbances: Further forces.
        heating: Dependence of friction on temperature; none if None.
        temperature: Temperatures of the gears [°C].
    """

    robot: Robot
    terms: tuple[AbstractTerm, ...]
    values: Float[AnyArray, " parameters"]
    friction: AbstractGearFriction
    sensors: Sensors
    gear: AbstractGear = RigidGear()
    disturbances: tuple[AbstractDisturbance, ...] = ()
    heating: FrictionTemperature | None = None
    temperature: Float[AnyArray, " joints"] | None = None

    def __check_init__(self):
        size, n = self.bodies.size, self.robot.joints
        if self.values.shape != (size,):
            raise InputError(
                f"`values` must hold one number for each parameter of `terms` ({size}), but has "
                f"shape {self.values.shape}."
            )
        if (self.heating is None) != (self.temperature is None):
            raise InputError("`heating` and `temperature` need each other: give both, or neither.")
        if self.temperature is not None and self.temperature.shape != (n,):
            raise InputError(
                f"`temperature` must hold one number for each gear ({n}), but has shape "
                f"{self.temperature.shape}."
            )

    @property
    def bodies(self) -> Model:
        """Equations of motion without friction."""
        return Model(self.robot, self.terms)

    @property
    def rotors(self) -> Float[np.ndarray, " joints"]:
        """Inertia of the rotors on the joint side [kg m² or kg]."""
        parts = zip(self.terms, self.bodies.split(self.values), strict=True)
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
        first, *others = (np.asarray(x) for x in self.bodies.split(self.values))
        return np.concatenate([first, self.present_friction.parameters, *others])

    def replace(self, **fields: Any) -> "VirtualRobot":
        """Return a copy with some fields replaced: such as another gear."""
        return dataclasses.replace(self, **fields)

    def undisturbed(self) -> "VirtualRobot":
        """Return the robot of the model: smooth friction, rigid gears, and sensor noise only."""
        plain = SmoothFriction(self.friction.viscous, self.friction.coulomb)
        return self.replace(friction=plain, gear=RigidGear(), disturbances=())

    def at(self, temperature: Float[AnyArray, " joints"] | float) -> "VirtualRobot":
        """Return the same robot with gears of another temperature.

        Args:
            temperature: Temperature of all gears, or of each [°C].

        Raises:
            InputError: If friction does not depend on temperature.
        """
        self._require_heating()
        return self.replace(temperature=np.full(self.robot.joints, temperature, np.float64))

    def _require_heating(self) -> FrictionTemperature:
        if self.heating is None:
            raise InputError(
                "friction of this robot does not depend on temperature: give it `heating` and a "
                "`temperature`."
            )
        return self.heating

    def warming(
        self, trajectory: AbstractTrajectory, *, duration: float, interval: float = 30.0
    ) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times joints"]]:
        """Return temperatures while a motion is repeated: friction heats the gears (Sec. 6).

        Args:
            trajectory: Repeated motion.
            duration: Duration [s].
            interval: Time between two temperatures, in which friction is constant [s].

        Returns:
            Times from now on [s], and temperatures [°C].

        Raises:
            InputError: If friction does not depend on temperature, or a time is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("warming a virtual robot")
        heating = self._require_heating()
        if not (duration > 0 and interval > 0):
            raise InputError(
                f"`duration` and `interval` must be positive [s], but are {duration:g} and "
                f"{interval:g}."
            )
        # The power of friction is averaged over 2000 instants of the motion.
        _, motion = trajectory.sample(float(trajectory.duration) / 2000)
        steps = max(1, round(duration / interval))
        parts = [
            self.friction.scaled(*x) for x in np.eye(2)[:, :, None] * np.ones(motion.qd[0].shape)
        ]
        powers = [np.mean(in_numpy(x, x.steady, motion.qd) * motion.qd, axis=0) for x in parts]
        temperatures = [np.asarray(self.temperature)]
        for _ in range(steps):
            viscous, dry = heating.factors(temperatures[-1])
            power = viscous * powers[0] + dry * powers[1]
            temperatures.append(heating.warm_up(temperatures[-1], power, duration / steps))
        return np.linspace(0.0, duration, steps + 1), np.array(temperatures)

    def warmed(self, trajectory: AbstractTrajectory, *, duration: float) -> "VirtualRobot":
        """Return the same robot after a motion has been repeated for some time.

        Args:
            trajectory: Repeated motion.
            duration: Duration [s]; the paper's robot is warm after 1800 s.

        Raises:
            InputError: If friction does not depend on temperature, or the time is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        _, temperatures = self.warming(trajectory, duration=duration)
        return self.replace(temperature=temperatures[-1])

    def resistance(
        self, q: Float[AnyArray, " joints"], qd: Float[AnyArray, " joints"]
    ) -> Float[AnyArray, " joints"]:
        """Return friction less disturbances of one sample, at constant speeds [N m or N]."""
        forces = self.present_friction.steady(qd)
        for disturbance in self.disturbances:
            forces = forces - disturbance.forces(self.robot, q, qd)
        return forces

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Return the forces of the drives for a motion, with rigid gears [N m or N]."""
        arrays = [np.asarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
        forces = in_numpy(self.bodies, self.bodies.forces, *arrays, shared=(self.values,))
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

        Raises:
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("a virtual measurement")
        motion = trajectory.motion(sample_time * np.arange(round(duration / sample_time)))
        forces = self.forces(motion)
        return self.sensors.record(
            self.robot, motion.q, forces, sample_time=sample_time, seed=seed, name=name
        )

    def servo(
        self, frequency: float = 8.0, damping: float = 1.0, sample_time: float = 1e-3
    ) -> Servo:
        """Return a servo whose gains suit the mean inertia of each joint over random poses.

        Args:
            frequency: Natural frequency of each joint by itself [Hz].
            damping: Damping ratio; 1 for no overshoot.
            sample_time: Time between two ticks [s].

        Raises:
            InputError: If frequency or damping are not positive.
        """
        if not (frequency > 0 and damping > 0):
            raise InputError(
                "`frequency` and `damping` must be positive, but are "
                f"{frequency:g} Hz and {damping:g}."
            )
        model, turns = self.bodies, np.array(self.robot.revolute)
        q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, self.robot.joints)) * turns
        M = in_numpy(model, model.inertia, q, shared=(np.asarray(self.values),))
        inertia = np.diagonal(M, axis1=1, axis2=2).mean(axis=0)
        w = 2.0 * np.pi * frequency
        return Servo(w**2 * inertia, 2.0 * damping * w * inertia, sample_time)

    def plant(self, step: float) -> SimulatedPlant:
        """Return a simulation of the robot.

        Args:
            step: Time step [s].

        Raises:
            InputError: If an elastic gear has a motor without inertia.
        """
        elastic = np.asarray(self.gear.twist(np.ones(self.robot.joints))) != 0.0
        if (elastic & ~(self.rotors > 0)).any():
            raise InputError(
                "an elastic gear needs a motor with inertia: give `terms` a `RotorInertia` with "
                "positive `values`."
            )
        friction = self.present_friction
        drives = DriveTrain(self.bodies, self.rotors, friction, self.gear, self.disturbances, step)
        return SimulatedPlant(drives, self.values)
