"""Length of presliding: how far each joint deforms its contacts before it slides."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations

from .problem import RegressionProblem

LENGTHS = 3.0 ** np.arange(-12, 1)
"""Lengths that are tried for each joint, before those around the best one [rad or m]."""


def identify_presliding(
    base: BaseParameters, observations: Observations | Sequence[Observations]
) -> BaseParameters:
    """Find the length of presliding friction of each joint.

    The rows of a joint depend on its own length only, and are fitted alone. So one pass over the
    data tries a length of every joint. The best of `LENGTHS` is improved in steps that get smaller.

    Args:
        base: Base parameters of a model whose friction has the transition `Presliding`.
        observations: Observations of one recording, or of several that are fitted together.

    Returns:
        The same base parameters, with these lengths in `model.memory`.

    Raises:
        InputError: If the model has no such friction.
    """
    if base.model.memory is None:
        raise InputError("the `model` has no friction with the transition `Presliding`.")
    problem, joints = RegressionProblem(base, observations), base.model.robot.joints
    tried, found = [], []

    def best_after(lengths: Float[np.ndarray, "lengths joints"]) -> Float[np.ndarray, " joints"]:
        """Try lengths; return the best one of all that were tried for each joint."""
        for one in lengths:
            trial, law = problem.with_base(base), base.model.with_memory(length=one).memory
            # Only the states depend on the lengths: the compiled columns are the same.
            trial.recordings = tuple(with_memory(o, law) for o in problem.recordings)
            tried.append(one)
            # What a joint's own columns leave unexplained stands last in its triangle.
            found.append([abs(x.R[-1, -1]) for x in trial.factors.joints])
        return np.array(tried)[np.argmin(found, axis=0), np.arange(joints)]

    best = best_after(np.outer(LENGTHS, np.ones(joints)))
    for step in 3.0**0.5 ** np.arange(1, 5):
        best = best_after(np.array([best / step, best * step]))
    model = base.model.with_memory(length=best)
    return eqx.tree_at(lambda b: b.model, base, model)


def presliding_note(base: BaseParameters) -> str:
    """Return the lengths of presliding in words."""
    robot, law = base.model.robot, base.model.memory
    lengths = np.broadcast_to(getattr(law, "length", np.nan), robot.joints)
    named = zip(robot.joint_names, lengths.tolist(), range(robot.joints), strict=True)
    shown = ", ".join(f"{name} {x:.2g} {robot.joint_unit(j)}" for name, x, j in named)
    return f"lengths of presliding, whose uncertainty is not in the intervals: {shown}."
