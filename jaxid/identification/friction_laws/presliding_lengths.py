"""Lengths of presliding friction, by a search on the rows of each joint alone."""

import equinox as eqx
import numpy as np

from jaxid.arrays import Joints
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import ObservedLogs

from ..problem import RegressionProblem

LENGTHS = 3.0 ** np.arange(-9, 0)
"""Lengths tried for each joint, before those around the best one [rad or m]."""
STEP_RATIOS = 3.0 ** (0.5 ** np.arange(1, 5))
"""Ratios of neighbouring lengths in the rounds around the best one."""


def identify_presliding(
    base: BaseParameters, observations: ObservedLogs
) -> BaseParameters:
    """Find the length of presliding friction of each joint.

    The rows of a joint depend on its own length only, and are fitted alone. So one pass
    over the data tries a length of every joint. The best of `LENGTHS` is improved in
    steps that get smaller.

    Args:
        base: Base parameters of a model whose friction has the transition `Presliding`.
        observations: Observations of one recording, or of several that are fitted
            together.

    Returns:
        The same base parameters, with these lengths in `model.memory`.

    Raises:
        InputError: If the model has no such friction.
    """
    if base.model.memory is None:
        raise InputError(
            "the `model` has no friction with the transition `Presliding`."
        )
    problem = RegressionProblem(base, observations)
    joints = np.arange(base.model.robot.joints)
    lengths = np.outer(LENGTHS, np.ones(len(joints)))
    residuals = np.array([residual_norms(problem, row) for row in lengths])
    best_lengths = lengths[np.argmin(residuals, axis=0), joints]
    for ratio in STEP_RATIOS:
        for neighbour in (best_lengths / ratio, best_lengths * ratio):
            norms = residual_norms(problem, neighbour)
            lengths = np.vstack([lengths, neighbour])
            residuals = np.vstack([residuals, norms])
        best_lengths = lengths[np.argmin(residuals, axis=0), joints]
    model = base.model.with_memory(length=best_lengths)
    return eqx.tree_at(lambda b: b.model, base, model)


def residual_norms(problem: RegressionProblem, lengths: Joints) -> Joints:
    """Return the norms of the forces that the columns of each joint do not explain."""
    law = problem.base.model.with_memory(length=lengths).memory
    # The model keeps its lengths, so that its compiled columns serve all trials: only
    # the states in the observations differ.
    trial = problem.with_base(problem.base)
    trial.recordings = tuple(with_memory(o, law) for o in problem.recordings)
    # The last entry of a triangle is what the other columns leave of the forces.
    return np.array([abs(joint.R[-1, -1]) for joint in trial.factors.joints])


def presliding_note(base: BaseParameters) -> str:
    """Return the lengths of presliding in words."""
    robot = base.model.robot
    length = getattr(base.model.memory, "length", np.nan)
    lengths = np.broadcast_to(length, robot.joints).tolist()
    words = [
        f"{name} {length:.2g} {robot.joint_unit(joint)}"
        for joint, (name, length) in enumerate(
            zip(robot.joint_names, lengths, strict=True)
        )
    ]
    return (
        "lengths of presliding, whose uncertainty "
        f"is not in the intervals: {', '.join(words)}."
    )
