"""Inertias of the bodies, and inertia and friction at the joints, as simulators describe them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.export.feed_forward import body_parameters
from jaxid.identification.consistency.pseudo_inertia import consistency_margin
from jaxid.identification.fit import Fit
from jaxid.io import json_text, write_text
from jaxid.robot.inertia import Inertia
from jaxid.robot.robot import Robot


class JointDynamics(NamedTuple):
    """Inertia and friction at the joints, as far as simulators can describe them.

    Attributes:
        armature: Inertia of the rotors [kg m² or kg].
        damping: Viscous friction [N m s/rad or N s/m].
        friction: Dry friction [N m or N]; mean of both directions.
        rotors: Names of the parameters that `armature` contains.
        left_out: Names of the parameters that none of these contains.
    """

    armature: Float[np.ndarray, " joints"]
    damping: Float[np.ndarray, " joints"]
    friction: Float[np.ndarray, " joints"]
    rotors: tuple[str, ...]
    left_out: tuple[str, ...]


def joint_dynamics(fit: Fit) -> JointDynamics:
    r"""Return inertia and friction at the joints of a fit.

    They follow from the columns of the terms: a parameter belongs to a joint if its forces, as the
    mean of both directions, are $a \ddot q_j + b \dot q_j + c\, \mathrm{sign}(\dot q_j)$ at all
    speeds beyond the transition of dry friction.
    """
    model = fit.base.model
    robot, total, rotors, left_out = model.robot, np.zeros((3, model.robot.joints)), [], []
    for term, p in zip(model.terms, model.split(fit.standard_parameters), strict=True):
        if term.body_parameters:
            continue
        held = _joint_coefficients(term, robot)
        total += held @ np.asarray(p)
        names = [name for name, _ in term.parameters(robot)]
        rotors += [name for k, name in enumerate(names) if held[0, :, k].any()]
        left_out += [name for k, name in enumerate(names) if not held[:, :, k].any()]
    armature, damping, friction = total
    return JointDynamics(armature, damping, friction, tuple(rotors), tuple(left_out))


def _joint_coefficients(term: AbstractTerm, robot: Robot) -> Float[np.ndarray, "3 joints columns"]:
    """Return inertia, viscous and dry friction of unit parameters; zeros if they are neither."""
    random = np.random.default_rng(0)
    n, probes = robot.joints, 6
    q, qdd = random.uniform(-1.0, 1.0, (2, probes, n))
    qd = random.uniform(20.0, 80.0, (probes, n)) * random.choice([-1.0, 1.0], (probes, n))
    with double_precision():
        columns = np.array(
            [
                np.asarray(term.columns(robot, x, v, a)) - term.columns(robot, x, -v, -a)
                for x, v, a in zip(q, qd, qdd, strict=True)
            ]
        )
    columns *= 0.5
    held = np.zeros((3, n, columns.shape[2]))
    for j, k in zip(*np.nonzero(columns.any(axis=0)), strict=True):
        basis = np.stack([qdd[:, j], qd[:, j], np.sign(qd[:, j])], axis=1)
        found = np.linalg.lstsq(basis, columns[:, j, k])[0]
        alone = np.count_nonzero(columns[:, :, k].any(axis=0)) == 1
        if alone and np.abs(basis @ found - columns[:, j, k]).max() < 1e-9:
            held[:, j, k] = found.round(12)
    return held


def feasible_bodies(fit: Fit, target: str) -> Float[np.ndarray, "joints 10"]:
    """Return ten parameters of each body of a fit, in the paper's order.

    Args:
        fit: Identified model.
        target: Name of what is written, such as `a URDF file`, for messages.

    Raises:
        InputError: If a body cannot exist, or inertia or friction at a joint is negative.
    """
    cure = (
        "identify with `jid.PhysicallyConsistent()` (in the experiment file: `[estimator]` "
        '`kind = "consistent"`)'
    )
    if fit.full_parameters is None:
        raise InputError(
            f"{target} needs the parameters of all bodies, but this fit knows only base "
            f"parameters: {cure}."
        )
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    # Rounding may reach slightly below zero.
    feasible = (np.asarray(consistency_margin(bodies)) >= -1e-9) & (bodies[:, 0] > 0)
    if not feasible.all():
        body = int(np.argmin(feasible)) + 1
        raise InputError(f"{target} needs bodies that can exist, but body {body} cannot: {cure}.")
    joints, names = joint_dynamics(fit), fit.base.model.robot.joint_names
    for quantity in ("armature", "damping", "friction"):
        values = getattr(joints, quantity)
        if (values < 0).any():
            raise InputError(
                f"{target} needs inertia and friction that are not negative, but `{quantity}` of "
                f"the joint `{names[int(np.argmin(values))]}` is {values.min():g}: {cure}."
            )
    return bodies


def pinocchio_parameters(fit: Fit) -> Float[np.ndarray, "joints 10"]:
    r"""Return the bodies' parameters in Pinocchio's order, about the origins of the joint frames.

    Each row is an argument of `pinocchio.Inertia.FromDynamicParameters` and fits the columns of
    Pinocchio's `computeJointTorqueRegressor`:
    $(m, m r_c, I_{xx}, I_{xy}, I_{yy}, I_{xz}, I_{yz}, I_{zz})$. The rows stand in the order of the
    robot's joints. The forces are those of the fit even if the bodies cannot exist.

    Args:
        fit: Identified model.
    """
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    return np.asarray(Inertia.from_parameters(bodies).pinocchio)


def export_pinocchio(fit: Fit, path: str | Path) -> Path:
    """Write the bodies in Pinocchio's order, and inertia and friction at the joints, as JSON.

    Args:
        fit: Identified model.
        path: Path of the file; an existing file is replaced.
    """
    joints = joint_dynamics(fit)
    rows = zip(
        fit.base.model.robot.joint_names,
        pinocchio_parameters(fit).tolist(),
        *(x.tolist() for x in (joints.armature, joints.damping, joints.friction)),
        strict=True,
    )
    keys = ("name", "parameters", "armature", "damping", "friction")
    content = {
        "model": fit.checksum,
        "date": fit.date,
        "names": ["m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz"],
        "joints": [dict(zip(keys, row, strict=True)) for row in rows],
        "left_out": list(joints.left_out),
    }
    write_text(path, json_text(content))
    return Path(path)
