"""Stribeck speeds of dry friction, by a search on the rows of each joint alone."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.terms import StribeckFriction
from jaxid.errors import InputError
from jaxid.measurement.observations import ObservedLogs

from ..problem import RegressionProblem
from .transition_speeds import (
    as_logs,
    best_speeds,
    identify_transition_speeds,
    top_speeds,
)

SPEED_SHARES = np.geomspace(0.01, 0.3, 6)
"""Stribeck speeds that are tried, relative to a joint's top speed."""


def identify_stribeck_speeds(
    base: BaseParameters, observations: ObservedLogs
) -> BaseParameters:
    """Find the speed around which dry friction of each joint falls.

    The rows of a joint depend on its own speed only, and are fitted alone. For each
    trial the speeds of the transitions are found anew.

    Args:
        base: Base parameters of a model with `StribeckFriction`.
        observations: Observations of one recording, or of several that are fitted
            together.

    Returns:
        The same base parameters, with a Stribeck speed of each joint.

    Raises:
        InputError: If the model has no such friction.
    """
    if not any(isinstance(term, StribeckFriction) for term in base.model.terms):
        raise InputError("the `model` has no `StribeckFriction`: add it to its terms.")
    logs = as_logs(observations)
    max_speeds = top_speeds(logs)
    squares = []
    for share in SPEED_SHARES:
        trial_base = _with_speeds(base, share * max_speeds)
        trial_base = identify_transition_speeds(trial_base, logs)
        factors = RegressionProblem(trial_base, logs).factors
        # The last entry of a triangle is what the columns leave of the forces.
        squares.append([joint.R[-1, -1] ** 2 for joint in factors.joints])
    speeds = best_speeds(list(np.transpose(squares)), SPEED_SHARES, max_speeds)
    return _with_speeds(base, speeds)


def _with_speeds(base: BaseParameters, speeds) -> BaseParameters:
    """Return base parameters of a model with other Stribeck speeds."""
    terms = []
    for term in base.model.terms:
        if isinstance(term, StribeckFriction):
            term = dataclasses.replace(term, speed=speeds)
        terms.append(term)
    model = dataclasses.replace(base.model, terms=tuple(terms))
    return eqx.tree_at(lambda b: b.model, base, model)
