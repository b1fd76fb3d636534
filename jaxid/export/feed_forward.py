"""What a controller asks a model for, as scalar programs with the estimates folded in."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.machine import program_of
from jaxid.dynamics.model import Model
from jaxid.export.recursion import Description, simplest
from jaxid.identification.fit import Fit
from jaxid.program import Program, applied, program_of_scalars, trace

Q, QD, QDD = "q", "qd", "qdd"
ALL_TEN = 10


class Form(NamedTuple):
    """One function of the feed-forward.

    Attributes:
        name: Behind the model's name.
        words: What it computes.
        program: How.
        inputs: Names of its inputs.
        output: Name of its output.
    """

    name: str
    words: str
    program: Program
    inputs: tuple[str, ...]
    output: str


def bodies_of(model: Model, p: Float[AnyArray, " standard"]) -> Float[np.ndarray, "joints 10"]:
    """Ten parameters for each body; zeros for what the model leaves out."""
    n = model.robot.joints
    bodies = np.zeros((n, ALL_TEN))
    for term, own in zip(model.terms, model.split(np.asarray(p, np.float64)), strict=True):
        if term.body_parameters:
            bodies[:, : term.body_parameters] += np.asarray(own).reshape(n, -1)
    return bodies


def torque_program(fit: Fit) -> Program:
    """The feed-forward by the recursion on base parameters (Eq. 39).

    Args:
        fit: The model.
    """
    return _torque(fit.base.model, _description(fit), _beside(fit))


def _torque(model: Model, description: Description, beside: Callable) -> Program:
    def torque(q, qd, qdd):
        return description.torques(q, qd, qdd) + applied(beside, q, qd, qdd)

    one = (model.robot.joints,)
    return program_of_scalars(torque, one, one, one)


def _description(fit: Fit) -> Description:
    model = fit.base.model
    return simplest(Description.of(model.robot, bodies_of(model, fit.standard_parameters)))


def forms(fit: Fit) -> tuple[Form, ...]:
    """All functions of a model, with its estimates as constants.

    Args:
        fit: The model.
    """
    model, base = fit.base.model, fit.base
    one, still = (model.robot.joints,), np.zeros(model.robot.joints)
    beside, description = _beside(fit), _description(fit)

    def bias(q, qd):
        rest = still.astype(object)
        return description.torques(q, qd, rest) + applied(lambda x, v: beside(x, v, still), q, qd)

    def gravity(q):
        rest = still.astype(object)
        return description.torques(q, rest, rest) + applied(lambda x: beside(x, still, still), q)

    def friction(q, qd):
        return beside(q, qd, still) - beside(q, still, still)

    # Only what the base parameters hold: composite bodies are lighter for it.
    own = np.asarray(base.to_standard(np.asarray(fit.parameters, np.float64)))

    def of_masses(q, qd, qdd):
        return model.inertia(own, q) @ qdd + model.bias(own, q, qd)

    regressor = program_of(base, base.columns, one, one, one)
    return (
        Form(
            "torque",
            "Feed-forward torques by the recursion on base parameters (Eq. 39, factored).",
            _torque(model, description, beside),
            (Q, QD, QDD),
            "tau",
        ),
        Form(
            "torque_of_parameters",
            "The same for base parameters p that are given, as Theta_B p (Eq. 39).",
            trace(lambda q, v, a, x: base.columns(q, v, a) @ x, one, one, one, (base.size,)),
            (Q, QD, QDD, "p"),
            "tau",
        ),
        Form(
            "torque_of_masses",
            "The same as M qdd + h, with M by composite bodies (Eq. 38).",
            trace(of_masses, one, one, one),
            (Q, QD, QDD),
            "tau",
        ),
        Form(
            "mass_matrix",
            "Mass matrix M, rotors included, row by row (Eq. 38).",
            trace(lambda q: model.inertia(own, q), one),
            (Q,),
            "m",
        ),
        Form(
            "bias",
            "Forces h without accelerations: Coriolis, gravity, friction (Eq. 38).",
            program_of_scalars(bias, one, one),
            (Q, QD),
            "h",
        ),
        Form(
            "gravity",
            "Forces at rest: gravity, springs, offsets.",
            program_of_scalars(gravity, one),
            (Q,),
            "tau",
        ),
        Form(
            "friction",
            "What friction adds to them by moving.",
            trace(friction, one, one),
            (Q, QD),
            "tau",
        ),
        Form(
            "regressor",
            "Base regressor Theta_B, row by row (Eq. 23).",
            regressor,
            (Q, QD, QDD),
            "theta",
        ),
    )


def _beside(fit: Fit) -> Callable:
    """The forces of all terms but the bodies."""
    model = fit.base.model
    parts = [
        (term, own)
        for term, own in zip(model.terms, model.split(fit.standard_parameters), strict=True)
        if not term.body_parameters
    ]

    def forces(q, qd, qdd):
        total = jnp.zeros_like(q)
        for term, own in parts:
            total = total + term.forces(model.robot, own, q, qd, qdd)
        return total

    return forces
