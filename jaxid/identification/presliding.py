"""Length of presliding: how far each joint deforms its contacts before it slides."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations

from .factors import Blocks
from .problem import RegressionProblem

LENGTHS = 3.0 ** np.arange(-9, 0)
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
            tried.append(one)
            found.append(blocks_with(problem, one))
        return np.array(tried)[best_of(found), np.arange(joints)]

    best = best_after(np.outer(LENGTHS, np.ones(joints)))
    for step in 3.0**0.5 ** np.arange(1, 5):
        best = best_after(np.array([best / step, best * step]))
    model = base.model.with_memory(length=best)
    return eqx.tree_at(lambda b: b.model, base, model)


def blocks_with(problem: RegressionProblem, length: np.ndarray | float) -> Blocks:
    """Return the factors with another length: compiled columns stay, only states differ."""
    base = problem.base
    law, trial = base.model.with_memory(length=length).memory, problem.with_base(base)
    trial.recordings = tuple(with_memory(o, law) for o in problem.recordings)
    return trial.blocks


def best_of(blocks: Sequence[Blocks]) -> list[int]:
    """Return for each joint which of several factors its own columns explain best."""
    # What they leave unexplained stands last in the triangle.
    left = [[abs(joint.R[-1, -1]) for joint in x.total.joints] for x in blocks]
    return np.argmin(left, axis=0).tolist()


def presliding_note(base: BaseParameters) -> str:
    """Return the lengths of presliding in words."""
    robot, law = base.model.robot, base.model.memory
    lengths = np.broadcast_to(getattr(law, "length", np.nan), robot.joints)
    named = enumerate(zip(robot.joint_names, lengths.tolist(), strict=True))
    shown = ", ".join(f"{name} {x:.2g} {robot.joint_unit(j)}" for j, (name, x) in named)
    return f"lengths of presliding, whose uncertainty is not in the intervals: {shown}."
