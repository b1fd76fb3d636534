"""The identified model in the order of Pinocchio."""

from pathlib import Path

import numpy as np

from jaxid.identification.fit_result import Fit
from jaxid.io import FilePath, json_text, write_text
from jaxid.robot.inertia import BodyParameters, Inertia

from .bodies_and_joint_dynamics import joint_dynamics
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


def export_pinocchio(fit: Fit, path: FilePath) -> Path:
    """Write the bodies in Pinocchio's order, and the joints' dynamics, as JSON.

    Args:
        fit: Identified model.
        path: Path of the file; an existing file is replaced.
    """
    dynamics = joint_dynamics(fit)
    rows = pinocchio_parameters(fit).tolist()
    joints = []
    robot = fit.base.model.robot
    # Friction of followers is part of their leaders'.
    zeros = np.zeros(len(robot.followers))
    for i, name in enumerate(robot.body_names):
        joint_values = {
            key: float(np.append(values, zeros)[i])
            for key, values in dynamics.values.items()
        }
        joints.append({"name": name, "parameters": rows[i], **joint_values})
    content = {
        "model": fit.checksum,
        "date": fit.date,
        "names": ["m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"],
        "joints": joints,
        "left_out": list(dynamics.omissions),
    }
    write_text(path, json_text(content))
    return Path(path)
