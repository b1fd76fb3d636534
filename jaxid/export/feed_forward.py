"""The feed-forward of a controller as a scalar program with few operations (Eq. 39)."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.model import Model
from jaxid.identification.fit_result import Fit
from jaxid.program import Program, trace
from jaxid.robot.inertia import BodyParameters

from .bodies_of_base_parameters import body_forces, carry_inward


def body_parameters(model: Model, p: Float[AnyArray, " standard"]) -> BodyParameters:
    """Return ten parameters of each body; zeros if the model leaves some out."""
    bodies = np.zeros((model.robot.bodies, 10))
    for term, values in model.split(np.asarray(p, np.float64)):
        if term.body_parameters:
            solid_bodies = list(model.robot.solid_bodies)
            rows = np.asarray(values).reshape(len(solid_bodies), -1)
            bodies[solid_bodies, : term.body_parameters] += rows
    return bodies


def other_forces(fit: Fit) -> Callable[..., Any]:
    """Return the function of one sample for the forces of all other terms."""
    model = fit.base.model
    p = np.array(fit.standard_parameters, np.float64)
    for term, values in model.split(p):
        if term.body_parameters:
            values[:] = 0.0
    return functools.partial(model.forces, p)


def torques(fit: Fit) -> Callable[..., Any]:
    """Return the function of one sample for the forces of a fit."""
    model = fit.base.model
    if model.robot.virtual:
        # The forces of virtual joints belong to these bodies and no others.
        return functools.partial(model.forces, fit.standard_parameters)
    bodies = carry_inward(model.robot, body_parameters(model, fit.standard_parameters))
    remaining_forces = other_forces(fit)

    def forces(q, qd, qdd, s=None):
        return body_forces(model.robot, bodies, q, qd, qdd) + remaining_forces(
            q, qd, qdd, s
        )

    return forces


def torque_program(fit: Fit) -> Program:
    """Return the program of the feed-forward on base parameters (Eq. 39).

    Its `counts` are the numbers of operations, which `export_c` writes as C.

    Args:
        fit: Identified model.
    """
    model = fit.base.model
    shapes = [(model.robot.joints,), *model.input_shapes[1:]]
    return trace(torques(fit), *shapes)
