"""The bodies in Pinocchio's order, and with what stands at the joints as a file."""

from pathlib import Path

import numpy as np

from jaxid.arrays import Float
from jaxid.export.feed_forward import bodies_of
from jaxid.export.physical import Joints
from jaxid.identification.fit import Fit
from jaxid.io import json_text, write_text

NAMES = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
PLACES = (0, 1, 2, 3, 4, 9, 5, 8, 7, 6)
"""Where Pinocchio's (m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz) stand in (m, ..., A, ..., F)."""
SIGNS = np.array([1, 1, 1, 1, 1, -1, 1, -1, -1, 1.0])


def pinocchio_parameters(fit: Fit) -> Float[np.ndarray, "joints 10"]:
    r"""The bodies' parameters in Pinocchio's order, about the origins of the joints' frames.

    Each row is what `pinocchio.Inertia.FromDynamicParameters` takes, and what belongs to the
    columns of Pinocchio's `computeJointTorqueRegressor`:
    $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$. The rows stand in the order of the
    robot's joints. Forces are those of the fit also where the bodies could not exist.

    Args:
        fit: The model.
    """
    bodies = bodies_of(fit.base.model, fit.standard_parameters)
    return bodies[:, PLACES] * SIGNS


def export_pinocchio(fit: Fit, path: str | Path) -> Path:
    """Writes the bodies in Pinocchio's order, and rotors and friction of the joints, as JSON.

    Args:
        fit: The model.
        path: Of the file; one that is there already is replaced.
    """
    path, robot, joints = Path(path), fit.base.model.robot, Joints.of(fit)
    content = {
        "model": fit.checksum,
        "date": fit.date,
        "names": list(NAMES),
        "joints": [
            {
                "name": name,
                "parameters": row.tolist(),
                "armature": float(joints.armature[j]),
                "damping": float(joints.damping[j]),
                "friction": float(joints.friction[j]),
            }
            for j, (name, row) in enumerate(
                zip(robot.joint_names, pinocchio_parameters(fit), strict=True)
            )
        ],
        "left_out": list(joints.left),
    }
    write_text(path, json_text(content))
    return path
