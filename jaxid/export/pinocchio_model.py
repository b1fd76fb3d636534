"""The identified model for Pinocchio: its own `Model`, or parameters of bodies."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.io import import_extra
from jaxid.robot.inertia import BodyParameters, Inertia

from .feed_forward import body_parameters
from .mujoco_model import export_mjcf


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

    It is what Pinocchio reads from the file of `export_mjcf`. Joints have the names and
    limits of the fit's robot, and are in depth-first order: find them by name where the
    robot has branches. Rotor inertias are `armature`, viscous friction is `damping`,
    dry friction is the limits of dry friction; `rnea` uses the first only. Frame `tip`
    is the end of the robot. A known tool, offsets and springs are not included.

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
    with tempfile.TemporaryDirectory() as folder:
        path = export_mjcf(fit, Path(folder) / "arm.xml")
        model = pin.buildModelFromMJCF(str(path))
    # Pinocchio does not read the option.
    model.gravity.linear = np.asarray(robot.gravity)
    return model
