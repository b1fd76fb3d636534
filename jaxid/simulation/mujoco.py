"""The same experiment on MuJoCo, which is independent of this package (extra `mujoco`)."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.export.feed_forward import body_parameters
from jaxid.export.mujoco_model import mjcf_text
from jaxid.robot.mjcf import import_mujoco

from .virtual import VirtualRobot


class MujocoRobot(VirtualRobot):
    """A virtual robot whose bodies, rotors and friction are simulated by MuJoCo.

    Viscous friction is MuJoCo's damping, dry friction its friction loss, which holds a
    joint at rest. Gears are rigid, and there are no disturbances. Sensors and servo are
    the virtual robot's.

    Args:
        virtual: Robot whose bodies, rotors and friction (at its present temperature)
            are simulated.
    """

    def __init__(self, virtual: VirtualRobot):
        for field in dataclasses.fields(VirtualRobot):
            setattr(self, field.name, getattr(virtual, field.name))

    def plant(self, step: float) -> "MujocoPlant":
        """Return a simulation of the robot with a time step [s].

        Raises:
            InputError: If the equations of motion contain more than bodies and rotors,
                or MuJoCo is not installed.
        """
        library, friction = import_mujoco(), self.present_friction
        text = mjcf_text(
            self.robot,
            self._bodies_with_tool(),
            {
                "armature": self.rotors,
                "damping": np.asarray(friction.viscous),
                "friction": np.asarray(friction.coulomb),
            },
            timestep=step,
        )
        model = library.MjModel.from_xml_string(text)
        model.opt.integrator = library.mjtIntegrator.mjINT_IMPLICITFAST
        # The virtual robot has no end stops either.
        model.opt.disableflags |= library.mjtDisableBit.mjDSBL_LIMIT
        return MujocoPlant(model, self.robot.joint_names)

    def _bodies_with_tool(self) -> Float[np.ndarray, "joints 10"]:
        """Return ten parameters of each body, with a known tool."""
        robot, model = self.robot, self.bodies
        for term, p in model.split(self.values):
            known = term.body_parameters or term.drive_matrices(robot)[0].any()
            if not known and np.any(p):
                raise InputError(
                    "MuJoCo knows only bodies and rotors: leave out other `terms`."
                )
        bodies = body_parameters(model, self.values)
        if robot.tool is not None:
            bodies[robot.tool.body] += np.asarray(robot.tool.parameters)
        return bodies

    def forces(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Return the forces of a motion by MuJoCo's inverse dynamics, without dry friction.

        MuJoCo's dry friction depends on the solver of its constraints [N m or N].

        Raises:
            InputError: If MuJoCo is not installed.
        """
        return self.plant(1e-3).inverse(motion)


class MujocoPlant:
    """One simulation of MuJoCo, with joints in the order of the robot."""

    def __init__(self, model: Any, joint_names: Sequence[str]):
        self._library, self._model = import_mujoco(), model
        self._data = self._library.MjData(model)
        # MuJoCo numbers the joints of a tree branch by branch.
        self._at = np.array([model.joint(name).qposadr[0] for name in joint_names])

    def start(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        """Put the robot into a motion."""
        self._library.mj_resetData(self._model, self._data)
        self._set(q, qd, qdd)

    def _set(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        data, at = self._data, self._at
        data.qpos[at], data.qvel[at], data.qacc[at] = q, qd, qdd
        data.qacc_warmstart[at] = qdd

    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N]."""
        self._data.qfrc_applied[self._at] = u
        self._library.mj_step(self._model, self._data)

    def read(self) -> tuple[list[float], list[float]]:
        """Return angles of the motors; positions, velocities, accelerations of the joints."""
        data, at = self._data, self._at
        q = data.qpos[at].tolist()
        return q, [*q, *data.qvel[at].tolist(), *data.qacc[at].tolist()]

    def inverse(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Return forces of a motion without dry friction [N m or N]."""
        forces = np.empty(motion.q.shape)
        self._model.dof_frictionloss[:] = 0.0
        arrays = [np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)]
        for k, instant in enumerate(zip(*arrays, strict=True)):
            self._set(*instant)
            self._library.mj_inverse(self._model, self._data)
            forces[k] = self._data.qfrc_inverse[self._at]
        return forces
