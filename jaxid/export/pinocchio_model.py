"""The identified model for Pinocchio: its own `Model`, or parameters of bodies."""

from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.io import import_extra
from jaxid.robot.inertia import BodyParameters, Inertia
from jaxid.robot.robot import Robot

from .bodies_and_joint_dynamics import feasible_bodies, joint_dynamics
from .feed_forward import body_parameters


def pinocchio_parameters(fit: Fit) -> BodyParameters:
    r"""Return the parameters of bodies in Pinocchio's order, about joint frames.

    Each row is an argument of `pinocchio.Inertia.FromDynamicParameters` and fits the
    columns of Pinocchio's `computeJointTorqueRegressor`:
    $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$. The rows are in the
    order of the robot's bodies. The forces are those of the fit even if the bodies
    cannot exist.

    Args:
        fit: Identified model.
    """
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    return np.asarray(Inertia.from_parameters(bodies).pinocchio)


def as_pinocchio(fit: Fit) -> Any:
    """Return the identified robot as a `pinocchio.Model`.

    Joints have the names and limits of the fit's robot, and are in depth-first order,
    which Pinocchio's algorithms need: find them by name where the robot has branches.
    Rotor inertias are `armature`, viscous friction is `damping`, dry friction is the
    limits of dry friction; `rnea` uses the first only. Frame `tip` is the end of the
    robot. A known tool, offsets and springs are not included.

    Args:
        fit: Physically consistent fit.

    Raises:
        InputError: If the bodies of the fit cannot exist, joints follow others, or
            Pinocchio is not installed.
    """
    pin = import_extra("pinocchio", "pinocchio", "`as_pinocchio` needs")
    robot = fit.base.model.robot
    if robot.followers:
        raise InputError(
            "`as_pinocchio` needs a robot whose joints all move alone, but "
            f"`{robot.followers[0].name}` follows another one: load the file of "
            "`jid.export_urdf` in Pinocchio."
        )
    bodies = Inertia.from_parameters(feasible_bodies(fit, "a model of Pinocchio"))
    rows = np.asarray(bodies.pinocchio)

    model = pin.Model()
    model.name = robot.name
    model.gravity.linear = np.asarray(robot.gravity)
    ids = {-1: 0}
    order = _depth_first_order(robot)
    for i in order:
        kind = "Revolute" if robot.turns[i] else "Prismatic"
        joint = getattr(pin, f"JointModel{kind}Unaligned")(np.asarray(robot.axis[i]))
        placement = pin.SE3(np.asarray(robot.rotation[i]), np.asarray(robot.offset[i]))
        name = robot.joint_names[i]
        ids[i] = model.addJoint(ids[robot.parent[i]], joint, placement, name)
        inertia = pin.Inertia.FromDynamicParameters(rows[i])
        model.appendBodyToJoint(ids[i], inertia, pin.SE3.Identity())

    limits = robot.limits
    dynamics = joint_dynamics(fit).values
    model.lowerPositionLimit = np.asarray(limits.position_min)[order]
    model.upperPositionLimit = np.asarray(limits.position_max)[order]
    model.armature = dynamics["armature"][order]
    model.damping = dynamics["damping"][order]
    model.upperDryFrictionLimit = dynamics["friction"][order]
    model.lowerDryFrictionLimit = -dynamics["friction"][order]
    tip = pin.SE3(np.asarray(robot.tip_rotation), np.asarray(robot.tip_offset))
    model.addFrame(pin.Frame("tip", ids[robot.tip_body], tip, pin.FrameType.OP_FRAME))
    return model


def _depth_first_order(robot: Robot) -> list[int]:
    """Return the joints such that each branch is finished before the next begins."""
    order = []
    waiting_joints = [i for i in robot.order if robot.parent[i] < 0][::-1]
    while waiting_joints:
        joint = waiting_joints.pop()
        order.append(joint)
        children = [i for i in robot.order if robot.parent[i] == joint]
        waiting_joints += children[::-1]
    return order
