"""A virtual robot: bodies that could exist, friction beyond the model, sensors with noise."""

import dataclasses
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float, require_float64
from jaxid.dynamics.machine import in_numpy
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.simulation.disturbances import AbstractDisturbance
from jaxid.simulation.experiment import AbstractExperiment
from jaxid.simulation.gear_friction import AbstractGearFriction, SmoothFriction
from jaxid.simulation.gears import AbstractGear, RigidGear
from jaxid.simulation.lubricant import Lubricant
from jaxid.simulation.mechanics import DriveTrain, SimulatedPlant
from jaxid.simulation.sensors import Sensors
from jaxid.simulation.servo import Servo
from jaxid.trajectory.trajectory import AbstractTrajectory

GRAINS = 12
"""Point masses of a random body: enough to fill all directions."""
SPEEDS = 2000
"""Of a motion, over which the power of friction is averaged."""


def random_bodies(
    robot: Robot,
    masses: Float[AnyArray, " joints"],
    random: np.random.Generator,
    radius: float = 0.05,
) -> Float[np.ndarray, "joints 10"]:
    """Draws inertial parameters that belong to bodies: clouds of points along the links.

    A cloud reaches from the origin of the body's frame to the next joint, or to the end-effector.
    What is made of masses at points has a possible inertia, whatever the points are.

    Args:
        robot: Whose links they are.
        masses: Of the bodies [kg].
        random: Source of the points.
        radius: Standard deviation of the points about the link's line [m].
    """
    bodies = np.empty((robot.joints, 10))
    for i, mass in enumerate(np.asarray(masses)):
        children = [c for c, parent in enumerate(robot.parent) if parent == i]
        end = robot.offset[children[0]] if children else robot.tip_offset
        along = random.uniform(0.0, 1.0, (GRAINS, 1))
        r = along * np.asarray(end) + radius * random.standard_normal((GRAINS, 3))
        m = random.dirichlet(np.full(GRAINS, 3.0)) * mass
        J = np.einsum("k,kij->ij", m, np.einsum("kl,kl->k", r, r)[:, None, None] * np.eye(3))
        J -= np.einsum("k,ki,kj->ij", m, r, r)
        bodies[i] = [mass, *(m @ r), *np.diag(J), -J[1, 2], -J[0, 2], -J[0, 1]]
    return bodies


class VirtualRobot(AbstractExperiment):
    """A robot whose parameters are known, with what no measurement is free of.

    It can follow a motion without error (`measure`), which is fast, or by its servo (`track`),
    where gears, stiction and disturbances act as they do in a machine.

    Attributes:
        robot: What is known of it.
        terms: Its equations of motion without friction.
        values: Parameters of these terms.
        friction: Of the gears, at the lubricant's reference temperature.
        sensors: What the log will say.
        gear: Between motors and joints.
        disturbances: What else pushes.
        lubricant: How friction depends on temperature; it does not if None.
        temperature: Of the gears [°C].
    """

    robot: Robot
    terms: tuple[AbstractTerm, ...]
    values: Float[AnyArray, " parameters"]
    friction: AbstractGearFriction
    sensors: Sensors
    gear: AbstractGear = RigidGear()
    disturbances: tuple[AbstractDisturbance, ...] = ()
    lubricant: Lubricant | None = None
    temperature: Float[AnyArray, " joints"] | None = None

    def __check_init__(self):
        size, n = self.bodies.size, self.robot.joints
        if self.values.shape != (size,):
            raise InputError(
                f"`values` must hold one number for each parameter of `terms` ({size}), but has "
                f"shape {self.values.shape}."
            )
        if (self.lubricant is None) != (self.temperature is None):
            raise InputError(
                "`lubricant` and `temperature` belong together: give both, or neither."
            )
        if self.temperature is not None and self.temperature.shape != (n,):
            raise InputError(
                f"`temperature` must be one for each gear ({n}), but has shape "
                f"{self.temperature.shape}."
            )

    @property
    def bodies(self) -> Model:
        """The equations of motion without friction."""
        return Model(self.robot, self.terms)

    @property
    def present_friction(self) -> AbstractGearFriction:
        """Friction of the gears at their temperature."""
        if self.lubricant is None or self.temperature is None:
            return self.friction
        return self.friction.scaled(*self.lubricant.factors(self.temperature))

    @property
    def model(self) -> Model:
        """The model to identify: friction's columns stand behind those of the first term."""
        return Model(self.robot, (self.terms[0], *self.friction.terms, *self.terms[1:]))

    @property
    def parameters(self) -> Float[np.ndarray, " standard"]:
        """The truth: standard parameters of `model` at the present temperature."""
        first, *others = (np.asarray(x) for x in self.bodies.split(self.values))
        return np.concatenate([first, self.present_friction.parameters, *others])

    def replace(self, **fields: Any) -> "VirtualRobot":
        """A copy with some fields replaced: another gear, further disturbances, other sensors."""
        return dataclasses.replace(self, **fields)

    def undisturbed(self) -> "VirtualRobot":
        """The same robot as its model has it: smooth friction, rigid gears, nothing else.

        Sensors keep their noise.
        """
        plain = SmoothFriction(self.friction.viscous, self.friction.coulomb)
        return self.replace(friction=plain, gear=RigidGear(), disturbances=())

    def at(self, temperature: Float[AnyArray, " joints"] | float) -> "VirtualRobot":
        """The same robot with gears of another temperature.

        Args:
            temperature: Of all gears, or of each [°C].

        Raises:
            InputError: If the robot has no lubricant.
        """
        self._require_lubricant()
        return self.replace(temperature=np.full(self.robot.joints, temperature, np.float64))

    def _require_lubricant(self) -> Lubricant:
        if self.lubricant is None:
            raise InputError(
                "friction of this robot does not depend on temperature: give it a `lubricant` and "
                "a `temperature`."
            )
        return self.lubricant

    def warming(
        self, trajectory: AbstractTrajectory, *, duration: float, interval: float = 30.0
    ) -> tuple[Float[np.ndarray, " times"], Float[np.ndarray, "times joints"]]:
        """Temperatures while a motion is repeated: friction heats the gears (Sec. 6).

        Args:
            trajectory: The motion.
            duration: How long it is repeated [s].
            interval: Time between two temperatures; friction is constant in between [s].

        Returns:
            Times [s] and temperatures [°C], from now on.

        Raises:
            InputError: If the robot has no lubricant, or a time is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("warming a virtual robot")
        lubricant = self._require_lubricant()
        if not (duration > 0 and interval > 0):
            raise InputError(
                f"`duration` and `interval` must be positive [s], but are {duration:g} and "
                f"{interval:g}."
            )
        _, motion = trajectory.sample(float(trajectory.duration) / SPEEDS)
        steps = max(1, round(duration / interval))
        n = self.robot.joints
        parts = (self.friction.scaled(*x) for x in np.eye(2)[:, :, None] * np.ones(n))
        powers = [np.mean(in_numpy(x, x.steady, motion.qd) * motion.qd, axis=0) for x in parts]
        temperatures = [np.asarray(self.temperature)]
        for _ in range(steps):
            viscous, dry = lubricant.factors(temperatures[-1])
            power = viscous * powers[0] + dry * powers[1]
            temperatures.append(lubricant.warmer(temperatures[-1], power, duration / steps))
        return np.linspace(0.0, duration, steps + 1), np.array(temperatures)

    def warmed(self, trajectory: AbstractTrajectory, *, duration: float) -> "VirtualRobot":
        """The same robot after a motion has been repeated for some time.

        Args:
            trajectory: The motion.
            duration: How long it is repeated [s]; the paper's robot is warm after 1800 s.

        Raises:
            InputError: If the robot has no lubricant, or the time is not positive.
            RuntimeError: If JAX runs in single precision.
        """
        _, temperatures = self.warming(trajectory, duration=duration)
        return self.replace(temperature=temperatures[-1])

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """The forces that the drives need for a motion; gears count as rigid [N m or N]."""
        arrays = [np.asarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
        forces = in_numpy(self.bodies, self.bodies.forces, *arrays, shared=(self.values,))
        if self.robot.tool is not None:
            forces = forces + in_numpy(self.bodies, self.bodies.known_forces, *arrays)
        drives = self.drives(1.0)
        return forces + in_numpy(drives, drives.resistance, *arrays[:2])

    def measure(
        self,
        trajectory: AbstractTrajectory,
        *,
        duration: float,
        sample_time: float,
        seed: int,
        name: str = "virtual",
    ) -> Recording:
        """Moves along a trajectory and records angles and forces as sensors give them.

        Args:
            trajectory: What is followed, without error.
            duration: Of the recording [s].
            sample_time: Time between two samples [s].
            seed: Of the noise.
            name: Of the recording.

        Raises:
            RuntimeError: If JAX runs in single precision.
        """
        require_float64("a virtual measurement")
        motion = trajectory.motion(sample_time * np.arange(round(duration / sample_time)))
        forces = self.forces(motion)
        return self.sensors.record(
            self.robot, motion.q, forces, sample_time=sample_time, seed=seed, name=name
        )

    def servo(self, frequency: float = 8.0, damping: float = 1.0) -> Servo:
        """A servo whose gains suit the robot's inertia.

        Args:
            frequency: Of a joint's answer to a disturbance [Hz].
            damping: Of that answer.
        """
        return Servo.tuned(self.bodies, self.values, frequency=frequency, damping=damping)

    def drives(self, step: float) -> DriveTrain:
        """Motors, gears and friction as they are now.

        Args:
            step: Of time in which they move [s].
        """
        parts = zip(self.terms, self.bodies.split(self.values), strict=True)
        inertia = sum(t.drive_matrices(self.robot)[0] @ np.asarray(x) for t, x in parts)
        friction, rotors = self.present_friction, np.diagonal(inertia)
        return DriveTrain(self.robot, rotors, friction, self.gear, self.disturbances, step)

    def plant(self, step: float) -> SimulatedPlant:
        """The robot as a machine that moves when its drives push.

        Args:
            step: Of time [s].

        Raises:
            InputError: If an elastic gear has a motor without inertia.
        """
        drives = self.drives(step)
        elastic = np.asarray(self.gear.twist(np.ones(self.robot.joints))) != 0.0
        if (elastic & ~(np.asarray(drives.rotors) > 0)).any():
            raise InputError(
                "an elastic gear needs a motor with inertia: give `terms` a `RotorInertia` with "
                "positive `values`."
            )
        return SimulatedPlant(self.bodies, np.asarray(self.values, np.float64), drives)
