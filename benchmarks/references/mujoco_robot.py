"""The experiment of a virtual robot on MuJoCo, independent of the package's physics."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.export.feed_forward import body_parameters
from jaxid.export.mujoco_model import mjcf_text
from jaxid.robot.mjcf import import_mujoco
from jaxid.simulation.virtual import PerSample, VirtualRobot


class MujocoRobot(VirtualRobot):
    """A virtual robot whose bodies, rotors and friction are simulated by MuJoCo.

    Viscous friction is MuJoCo's damping, dry friction its friction loss, which holds a
    joint at rest. There is no torque ripple. Sensors and servo are the virtual robot's.

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
                a joint follows another one, or MuJoCo is not installed.
        """
        mujoco = import_mujoco()
        if self.robot.followers:
            raise InputError(
                f"joint `{self.robot.followers[0].name}` follows another joint, but "
                "MuJoCo couples them only by a soft constraint: simulate with "
                "`jid.VirtualRobot`."
            )
        friction = self.present_friction
        rotors = np.diagonal(self._drive_inertia())
        joints = {
            "armature": rotors,
            "damping": np.asarray(friction.viscous),
            "friction": np.asarray(friction.coulomb),
        }
        bodies = self._bodies_with_tool()
        text = mjcf_text(self.robot, bodies, joints, timestep=step)
        model = mujoco.MjModel.from_xml_string(text)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        # The virtual robot has no end stops either.
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        return MujocoPlant(model, self.robot.joint_names)

    def _drive_inertia(self):
        """Return the inertia of the rotors on the joint side [kg m² or kg]."""
        matrices = [
            term.drive_matrices(self.robot)[0] @ np.asarray(p)
            for term, p in self.bodies.split(self.values)
        ]
        return np.sum(matrices, axis=0)

    def _bodies_with_tool(self):
        """Return ten parameters of each body, with a known tool."""
        robot = self.robot
        for term, p in self.bodies.split(self.values):
            has_rotors = term.drive_matrices(robot)[0].any()
            if not (term.body_parameters or has_rotors) and np.any(p):
                raise InputError(
                    "MuJoCo knows only bodies and rotors: leave out other `terms`."
                )
        bodies = np.array(body_parameters(self.bodies, self.values))
        if robot.tool is not None:
            bodies[robot.tool.body] += np.asarray(robot.tool.parameters)
        return bodies

    def forces(self, motion: Motion) -> PerSample:
        """Return a motion's forces by MuJoCo's inverse dynamics, without dry friction.

        MuJoCo's dry friction depends on the solver of its constraints [N m or N].

        Raises:
            InputError: If MuJoCo is not installed.
        """
        return self.plant(1e-3).inverse(motion)


class MujocoPlant:
    """One simulation of MuJoCo, with joints in the order of the robot."""

    def __init__(self, model: Any, joint_names: Sequence[str]):
        self._mujoco = import_mujoco()
        self._model = model
        self._data = self._mujoco.MjData(model)
        # MuJoCo numbers the joints of a tree branch by branch.
        addresses = [model.joint(name).qposadr[0] for name in joint_names]
        self._addresses = np.array(addresses)

    def start(self, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> None:
        """Put the robot into a motion."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._set(q, qd, qdd)

    def _set(self, q: AnyArray, qd: AnyArray, qdd: AnyArray):
        data = self._data
        data.qpos[self._addresses] = q
        data.qvel[self._addresses] = qd
        data.qacc[self._addresses] = qdd
        data.qacc_warmstart[self._addresses] = qdd

    def step(self, u: Sequence[float]) -> None:
        """Move on by one step with constant torques of the drives [N m or N].

        Raises:
            ArithmeticError: If the simulation becomes unstable.
        """
        self._data.qfrc_applied[self._addresses] = u
        with mujoco_warnings(self._mujoco) as warnings:
            self._mujoco.mj_step(self._model, self._data)
        if warnings:
            raise ArithmeticError(warnings[0])

    def read(self) -> list[float]:
        """Return positions, velocities, accelerations of the joints, in this order."""
        data = self._data
        arrays = (data.qpos, data.qvel, data.qacc)
        return np.concatenate([x[self._addresses] for x in arrays]).tolist()

    def inverse(self, motion: Motion) -> PerSample:
        """Return forces of a motion without dry friction [N m or N]."""
        forces = np.empty(motion.q.shape)
        self._model.dof_frictionloss[:] = 0.0
        arrays = [np.asarray(x) for x in (motion.q, motion.qd, motion.qdd)]
        for k, (q, qd, qdd) in enumerate(zip(*arrays, strict=True)):
            self._set(q, qd, qdd)
            self._mujoco.mj_inverse(self._model, self._data)
            forces[k] = self._data.qfrc_inverse[self._addresses]
        return forces


@contextlib.contextmanager
def mujoco_warnings(mujoco: Any) -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, which it otherwise writes into a file."""
    warnings: list[str] = []
    previous_handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)
    try:
        yield warnings
    finally:
        mujoco.set_mju_user_warning(previous_handler)
