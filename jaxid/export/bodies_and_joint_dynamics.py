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

QUANTITIES = {"inertia": "armature", "viscous": "damping", "dry": "friction"}
"""Quantities of simulators, by the roles of the parameters that they are made of."""
FAST = 100.0
"""Speed beyond the transition of dry friction [rad/s or m/s]."""

Quantities = Mapping[str, Joints]
"""One number for each joint, by the names of the quantities."""


class JointDynamics(NamedTuple):
    """Inertia and friction at the joints, as far as simulators can describe them.

    Attributes:
        values: The `armature` [kg m² or kg], `damping` [N m s/rad or N s/m] and dry
            `friction` [N m or N] of all joints.
        rotors: Names of the parameters in `armature`.
        omissions: Names of the parameters in none of the three.
        loops: That loops are closed, if the robot has any.
    """

    values: Quantities
    rotors: Texts
    omissions: Texts
    loops: Texts

    @property
    def missing_in_urdf(self) -> Texts:
        """Names of what a URDF file cannot hold."""
        return (*self.loops, *self.rotors, *self.omissions)


def joint_dynamics(fit: Fit) -> JointDynamics:
    """Return inertia and friction at the joints, as far as simulators know them.

    They are parameters with a role in the physics of a drive; friction is the mean of
    both directions.
    """
    model = fit.base.model
    robot = model.robot
    values = {name: np.zeros(robot.joints) for name in QUANTITIES.values()}
    rotors = []
    omissions = [] if model.memory is None else ["the memory of dry friction"]
    for term, p in model.split(fit.standard_parameters):
        if term.body_parameters:
            continue
        names = [name for name, _ in term.parameters(robot)]
        # Friction that is scaled by temperature keeps its role.
        unscaled_term = getattr(term, "term", term)
        roles = np.repeat(
            [x.role or "" for x in unscaled_term.joint_parameters], len(robot.driven)
        )
        # Other parameters, such as those of ripple, have no role.
        roles = np.append(roles, [""] * (len(names) - len(roles)))
        for role, quantity in QUANTITIES.items():
            columns = np.where(roles == role, _unit_forces(term, robot, role), 0.0)
            values[quantity] += columns @ np.asarray(p)
        for name, role in zip(names, roles, strict=True):
            if role == "inertia":
                rotors.append(name)
            if role not in QUANTITIES:
                omissions.append(name)
    loops = ("the closing of its loops",) if robot.loops else ()
    return JointDynamics(values, tuple(rotors), tuple(omissions), loops)


def _unit_forces(term: AbstractTerm, robot: Robot, role: str) -> Matrix:
    """Return the forces of unit parameters for a unit of what their role acts on."""
    standstill = np.zeros(robot.joints)
    motion = np.ones(robot.joints)
    with double_precision():
        if role == "inertia":
            return np.asarray(term.columns(robot, standstill, standstill, motion))
        forward_forces = term.columns(robot, standstill, FAST * motion, standstill)
        backward_forces = term.columns(robot, standstill, -FAST * motion, standstill)
        mean_forces = 0.5 * np.asarray(forward_forces - backward_forces)
    return mean_forces / FAST if role == "viscous" else mean_forces


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
