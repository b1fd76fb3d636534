"""The same experiment on MuJoCo: physics that this package did not write (extra `mujoco`)."""

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.robot.robot import Robot
from jaxid.simulation.experiment import AbstractExperiment
from jaxid.simulation.sensors import Sensors
from jaxid.simulation.servo import Servo
from jaxid.simulation.tracking import AbstractPlant
from jaxid.simulation.virtual import VirtualRobot


class MujocoRobot(AbstractExperiment):
    """A virtual robot whose bodies, rotors and friction are MuJoCo's.

    Viscous friction is MuJoCo's damping, dry friction its friction loss, which holds a joint at
    rest. Gears are rigid, and there are no disturbances. Sensors and servo are the virtual robot's.

    Attributes:
        robot: What is known of it.
        sensors: What the log will say.
        virtual: The robot whose bodies, rotors and friction they are.
    """

    robot: Robot
    sensors: Sensors
    virtual: VirtualRobot

    @classmethod
    def of(cls, virtual: VirtualRobot) -> "MujocoRobot":
        """Takes bodies, rotors and friction at its present temperature from a virtual robot."""
        return cls(virtual.robot, virtual.sensors, virtual)

    def servo(self, frequency: float = 8.0, damping: float = 1.0) -> Servo:
        """That of the virtual robot."""
        return self.virtual.servo(frequency, damping)

    def plant(self, step: float) -> "MujocoPlant":
        """The robot as a machine that moves when its drives push.

        Args:
            step: Of time [s].

        Raises:
            InputError: If the equations of motion hold more than bodies and rotors.
            ModuleNotFoundError: If MuJoCo is not installed.
        """
        library, robot = _mujoco(), self.robot
        spec = library.MjSpec()
        spec.option.timestep, spec.option.gravity = step, np.asarray(robot.gravity)
        spec.option.integrator = library.mjtIntegrator.mjINT_IMPLICITFAST
        kinds = library.mjtJoint.mjJNT_SLIDE, library.mjtJoint.mjJNT_HINGE
        friction, rotors = self.virtual.present_friction, self.virtual.drives(step).rotors
        placed = []
        for i, own in enumerate(self._bodies()):
            parent = placed[robot.parent[i]] if robot.parent[i] >= 0 else spec.worldbody
            turn = np.empty(4)
            library.mju_mat2Quat(turn, np.asarray(robot.rotation[i]).ravel())
            m, centre = own[0], own[1:4] / own[0]
            A, B, C, D, E, F = own[4:] - m * _moments_of_a_point(centre)
            body = parent.add_body(
                name=f"body {i + 1}",
                pos=np.asarray(robot.offset[i]),
                quat=turn,
                mass=m,
                ipos=centre,
                fullinertia=[A, B, C, -F, -E, -D],
                explicitinertial=True,
            )
            body.add_joint(
                name=robot.joint_names[i],
                type=kinds[robot.revolute[i]],
                axis=np.asarray(robot.axis[i]),
                armature=float(rotors[i]),
                damping=float(friction.viscous[i]),
                frictionloss=float(friction.coulomb[i]),
            )
            placed.append(body)
        return MujocoPlant(spec.compile(), robot.joint_names)

    def _bodies(self) -> Float[np.ndarray, "joints 10"]:
        """Ten parameters of each body, a known tool included."""
        virtual, robot = self.virtual, self.robot
        parts = zip(virtual.terms, virtual.bodies.split(virtual.values), strict=True)
        (first, own), *others = [(term, np.asarray(p)) for term, p in parts]
        known = all(term.drive_matrices(robot)[0].any() or not p.any() for term, p in others)
        size = first.body_parameters
        if not (size and known):
            raise InputError(
                "MuJoCo needs `terms` that begin with `RigidBodies`; beside them it knows rotors "
                "only."
            )
        bodies = np.zeros((robot.joints, 10))
        bodies[:, :size] = own.reshape(-1, size)
        if robot.tool is not None:
            bodies[robot.tool.body] += np.asarray(robot.tool.parameters)
        return bodies

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """The forces of a motion by MuJoCo's inverse dynamics, without dry friction [N m or N].

        MuJoCo's dry friction depends on the constraints' solver: it is left out.

        Args:
            motion: Joint motion.

        Raises:
            ModuleNotFoundError: If MuJoCo is not installed.
        """
        return self.plant(1e-3).inverse(motion)


class MujocoPlant(AbstractPlant):
    """One simulation of MuJoCo.

    Args:
        model: Compiled.
        joint_names: In the order of the robot.
    """

    def __init__(self, model: Any, joint_names: Sequence[str]):
        self._library, self._model = _mujoco(), model
        self._data = self._library.MjData(model)
        # MuJoCo numbers the joints of a tree branch by branch.
        self._at = np.array([model.joint(name).qposadr[0] for name in joint_names])

    def start(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        """Puts the robot into a motion."""
        self._library.mj_resetData(self._model, self._data)
        self._set(q, qd, qdd)

    def _set(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        data, at = self._data, self._at
        data.qpos[at], data.qvel[at], data.qacc[at] = q, qd, qdd
        data.qacc_warmstart[at] = qdd

    def step(self, u: Sequence[float]) -> None:
        """Moves on by one step with constant torques of the drives [N m or N]."""
        self._data.qfrc_applied[self._at] = u
        self._library.mj_step(self._model, self._data)

    def read(self) -> tuple[list[float], list[float]]:
        """Angles of the motors; positions, velocities, accelerations of the joints."""
        data, at = self._data, self._at
        q = data.qpos[at].tolist()
        return q, [*q, *data.qvel[at].tolist(), *data.qacc[at].tolist()]

    def inverse(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Forces of a motion without dry friction [N m or N]."""
        found = np.empty(motion.q.shape)
        self._model.dof_frictionloss[:] = 0.0
        arrays = [np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)]
        for k, instant in enumerate(zip(*arrays, strict=True)):
            self._set(*instant)
            self._library.mj_inverse(self._model, self._data)
            found[k] = self._data.qfrc_inverse[self._at]
        return found


def _moments_of_a_point(r: Float[np.ndarray, "3"]) -> Float[np.ndarray, "6"]:
    """$A$ to $F$ of a unit mass at a point [m²]."""
    x, y, z = r
    return np.array([y * y + z * z, x * x + z * z, x * x + y * y, y * z, x * z, x * y])


def _mujoco() -> Any:
    try:
        return importlib.import_module("mujoco")
    except ModuleNotFoundError as missing:
        raise ModuleNotFoundError(
            "MuJoCo is not installed: `pip install 'jaxid-robotics[mujoco]'`."
        ) from missing
