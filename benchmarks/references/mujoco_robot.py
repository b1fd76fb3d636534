"""The experiment of a virtual robot on MuJoCo, independent of the package's physics."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy

import jaxid as jid


class MujocoRobot(jid.VirtualRobot):
    """A virtual robot whose bodies, rotors and friction are simulated by MuJoCo.

    Viscous friction is MuJoCo's damping, dry friction its friction loss, which holds a
    joint at rest. There is no torque ripple. Sensors and servo are the virtual robot's.

    Args:
        virtual: Robot whose bodies, rotors and friction (at its present temperature)
            are simulated.
    """

    def __init__(self, virtual: jid.VirtualRobot):
        for field in dataclasses.fields(jid.VirtualRobot):
            setattr(self, field.name, getattr(virtual, field.name))

    def plant(self, step: float) -> "MujocoPlant":
        """Return a simulation of the robot with a time step [s].

        Raises:
            InputError: If the equations of motion contain more than bodies and rotors,
                or a joint follows another one.
        """
        import mujoco

        if self.robot.followers:
            raise jid.InputError(
                f"joint `{self.robot.followers[0].name}` follows another joint, but "
                "MuJoCo couples them only by a soft constraint: simulate with "
                "`jid.VirtualRobot`."
            )
        specification = self._specification()
        specification.option.timestep = step
        specification.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model = specification.compile()
        for name, damping in zip(
            self.robot.joint_names, self.friction.viscous, strict=True
        ):
            model.dof_damping[model.joint(name).dofadr[0]] = damping
        return MujocoPlant(model, self.robot.joint_names)

    def _specification(self):
        """Return bodies and joints for MuJoCo; like the virtual robot without stops."""
        import mujoco

        robot = self.robot
        dry_friction = np.asarray(self.friction.coulomb)
        rotors = np.diagonal(self._drive_inertia())
        kinds = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
        specification = mujoco.MjSpec()
        specification.option.gravity = np.asarray(robot.gravity)
        bodies = {-1: specification.worldbody}
        masses = self._bodies_with_tool()
        for i in robot.order:
            body = bodies[robot.parent[i]].add_body(
                name=f"{robot.joint_names[i]}_body",
                pos=np.asarray(robot.offset[i]),
                quat=quaternion(robot.rotation[i]),
            )
            set_inertia(body, masses[i])
            joint = body.add_joint(
                name=robot.joint_names[i],
                type=kinds[robot.revolute[i]],
                axis=np.asarray(robot.axis[i]),
            )
            joint.armature = rotors[i]
            joint.frictionloss = dry_friction[i]
            bodies[i] = body
        return specification

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
                raise jid.InputError(
                    "MuJoCo knows only bodies and rotors: leave out other `terms`."
                )
        bodies = np.zeros((robot.bodies, 10))
        for term, p in self.bodies.split(self.values):
            if term.body_parameters:
                rows = np.reshape(p, (robot.bodies, -1))
                bodies[:, : rows.shape[1]] += rows
        if robot.tool is not None:
            bodies[robot.tool.body] += np.asarray(robot.tool.parameters)
        return bodies

    def forces(self, motion: jid.Motion) -> np.ndarray:
        """Return a motion's forces by MuJoCo's inverse dynamics, without dry friction.

        MuJoCo's dry friction depends on the solver of its constraints [N m or N].
        """
        return self.plant(1e-3).inverse(motion)


def quaternion(rotation: Any) -> np.ndarray:
    """Return a rotation matrix as a quaternion, its real part first."""
    rotation = scipy.spatial.transform.Rotation.from_matrix(np.asarray(rotation))
    return np.roll(rotation.as_quat(), 1)


def set_inertia(body: Any, parameters: np.ndarray) -> None:
    """Give a body its ten inertial parameters."""
    pseudo_inertia = np.asarray(jid.consistency.pseudo_inertia(parameters))
    mass = pseudo_inertia[3, 3]
    centre = pseudo_inertia[:3, 3] / mass
    second_moments = pseudo_inertia[:3, :3] - mass * np.outer(centre, centre)
    tensor = np.trace(second_moments) * np.eye(3) - second_moments
    body.explicitinertial = True
    body.mass = mass
    body.ipos = centre
    body.fullinertia = tensor[(0, 1, 2, 0, 0, 1), (0, 1, 2, 1, 2, 2)]


class MujocoPlant:
    """One simulation of MuJoCo, with joints in the order of the robot."""

    def __init__(self, model: Any, joint_names: Sequence[str]):
        import mujoco

        self._mujoco = mujoco
        self._model = model
        self._data = self._mujoco.MjData(model)
        # MuJoCo numbers the joints of a tree branch by branch.
        addresses = [model.joint(name).qposadr[0] for name in joint_names]
        self._addresses = np.array(addresses)

    def start(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray) -> None:
        """Put the robot into a motion."""
        self._mujoco.mj_resetData(self._model, self._data)
        self._set(q, qd, qdd)

    def _set(self, q: np.ndarray, qd: np.ndarray, qdd: np.ndarray):
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

    def inverse(self, motion: jid.Motion) -> np.ndarray:
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
