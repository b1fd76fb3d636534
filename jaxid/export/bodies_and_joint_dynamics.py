"""Bodies that can exist, and inertia and friction at the joints, for simulators."""

import re
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Joints, Matrix, Texts, double_precision
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.identification.consistency.pseudo_inertia import consistency_margin
from jaxid.identification.fit_result import Fit
from jaxid.result_table import printable
from jaxid.robot.inertia import BodyParameters
from jaxid.robot.robot import Robot

from .feed_forward import body_parameters

PROBES = 6
"""Number of states at which a term is compared with a joint's dynamics."""
PROBE_SPEEDS = (20.0, 80.0)
"""Speeds of these states, beyond the transition of dry friction [rad/s or m/s]."""


Quantities = Mapping[str, Joints]
"""One number for each joint, by the names of the quantities."""


class JointDynamics(NamedTuple):
    """Inertia and friction at the joints, as far as simulators can describe them.

    Attributes:
        values: The `armature` [kg m² or kg], `damping` [N m s/rad or N s/m] and dry
            `friction` [N m or N] of all joints.
        rotors: Names of the parameters in `armature`.
        omissions: Names of the parameters in none of the three.
    """

    values: Quantities
    rotors: Texts
    omissions: Texts


def joint_dynamics(fit: Fit) -> JointDynamics:
    r"""Return inertia and friction at the joints, as far as simulators know them.

    They follow from the columns of the terms: a parameter belongs to a joint if its
    forces, as the mean of both directions, are $a \ddot q_j + b \dot q_j + c\,
    \mathrm{sign}(\dot q_j)$ at all speeds beyond the transition of dry friction.
    """
    model = fit.base.model
    robot = model.robot
    total = np.zeros((3, robot.joints))
    rotors = []
    omissions = [] if model.memory is None else ["the memory of dry friction"]
    for term, p in model.split(fit.standard_parameters):
        if term.body_parameters:
            continue
        coefficients = _joint_coefficients(term, robot)
        total += coefficients @ np.asarray(p)
        for k, (name, _) in enumerate(term.parameters(robot)):
            if coefficients[0, :, k].any():
                rotors.append(name)
            if not coefficients[:, :, k].any():
                omissions.append(name)
    values: Quantities = {
        "armature": total[0],
        "damping": total[1],
        "friction": total[2],
    }
    return JointDynamics(values, tuple(rotors), tuple(omissions))


def _joint_coefficients(term: AbstractTerm, robot: Robot) -> np.ndarray:
    """Return inertia, viscous and dry friction of unit parameters, or zeros.

    The axes are these three, the joints, and the parameters of the term.
    """
    random = np.random.default_rng(0)
    shape = (PROBES, robot.joints)
    q, qdd = random.uniform(-1.0, 1.0, (2, *shape))
    speeds = random.uniform(*PROBE_SPEEDS, shape)
    directions = random.choice([-1.0, 1.0], shape)
    qd = speeds * directions

    columns = _odd_columns(term, robot, q, qd, qdd)
    coefficients = np.zeros((3, *columns.shape[1:]))
    is_used = np.any(columns, axis=0)
    # A simulator knows no parameter that acts on several joints.
    acts_on_one_joint = np.count_nonzero(is_used, axis=0) == 1
    for joint, k in np.argwhere(is_used & acts_on_one_joint):
        acceleration = qdd[:, joint]
        velocity = qd[:, joint]
        direction = directions[:, joint]
        basis = np.stack([acceleration, velocity, direction], axis=1)
        forces = columns[:, joint, k]
        solution = np.linalg.lstsq(basis, forces)[0]
        error = np.abs(basis @ solution - forces)
        if error.max() < 1e-9:
            coefficients[:, joint, k] = solution.round(12)
    return coefficients


def _odd_columns(
    term: AbstractTerm, robot: Robot, q: Matrix, qd: Matrix, qdd: Matrix
) -> np.ndarray:
    """Return the part of a term's columns that changes its sign with the motion.

    Springs and offsets drop out, and friction is the mean of both directions.
    """
    columns = []
    with double_precision():
        for x, v, a in zip(q, qd, qdd, strict=True):
            forward_column = np.asarray(term.columns(robot, x, v, a))
            backward_column = np.asarray(term.columns(robot, x, -v, -a))
            columns.append(0.5 * (forward_column - backward_column))
    return np.array(columns)


def feasible_bodies(fit: Fit, target: str) -> BodyParameters:
    """Return ten parameters of each body; reject bodies and friction that cannot exist.

    Args:
        fit: Identified model.
        target: File that needs them, for the error.

    Raises:
        InputError: If the fit is not physically consistent.
    """
    cure = (
        "identify with `jid.PhysicallyConsistent()` (in the experiment file: "
        '`[estimator]` `kind = "consistent"`)'
    )
    if fit.full_parameters is None:
        raise InputError(
            f"{target} needs all parameters, "
            f"but the fit knows only base parameters: {cure}."
        )
    bodies = body_parameters(fit.base.model, fit.standard_parameters)
    # Rounding may reach slightly below zero.
    robot = fit.base.model.robot
    solid_bodies = bodies[list(robot.solid_bodies)]
    margins = np.asarray(consistency_margin(solid_bodies))
    is_feasible = (margins >= -1e-9) & (solid_bodies[:, 0] > 0)
    if not is_feasible.all():
        body = robot.numbers[robot.solid_bodies[int(np.argmin(is_feasible))]]
        raise InputError(
            f"{target} needs physically possible bodies, but body {body} is not: "
            f"{cure}."
        )
    for quantity, values in joint_dynamics(fit).values.items():
        if (values < 0).any():
            joint = fit.base.model.robot.joint_names[int(np.argmin(values))]
            raise InputError(
                f"{target} needs `{quantity}` >= 0, "
                f"but `{joint}` has {values.min():g}: {cure}."
            )
    return bodies


def origin_comment(fit: Fit, omissions: Texts) -> str:
    """Return a comment on the model, and on what the file lacks."""
    text = f"{fit.date or 'an unknown day'}, {fit.checksum}. "
    if omissions:
        text += f"Not in this file: {', '.join(omissions)}. "
    # Two hyphens would end the comment.
    return re.sub("-(?=-)", "- ", printable(text))
