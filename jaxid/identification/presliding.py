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

STEP = 3.0
"""Ratio of the lengths that are tried first."""
HALVINGS = 4
"""How many times this ratio is halved, on a logarithmic scale, around the best length."""


def identify_presliding(
    base: BaseParameters, observations: Observations | Sequence[Observations]
) -> BaseParameters:
    """Find the length of presliding friction of each joint.

    The rows of a joint depend on its own length only, and are fitted alone. So one pass over the
    data tries a length of every joint. Lengths from a third of the range of a joint down to a
    hundred-thousandth of it are tried, then those around the best one.

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
    problem = RegressionProblem(base, observations)
    low, high = np.inf, -np.inf
    for recording in problem.recordings:
        for chunk in recording.chunks():
            q = np.asarray(recording.read(slice(*chunk.samples))[0].q)
            low, high = np.minimum(low, q.min(axis=0)), np.maximum(high, q.max(axis=0))
    # Joints that do not move keep theirs.
    longest = np.where(high > low, (high - low) / STEP, base.model.memory.length)

    def errors(lengths: Float[np.ndarray, " joints"]) -> Float[np.ndarray, " joints"]:
        """Return the norm of what each joint's own columns do not explain."""
        trial, law = problem.with_base(base), base.model.with_memory(length=lengths).memory
        # Only the states depend on the lengths: the compiled columns are the same.
        trial.recordings = tuple(with_memory(o, law) for o in problem.recordings)
        joints = trial.factors.joints
        return np.array([abs(j.R[-1, -1]) if len(j.R) > len(j.columns) else 0.0 for j in joints])

    tried = [longest / STEP**k for k in range(11)]
    found = [errors(x) for x in tried]
    step = STEP
    for _ in range(HALVINGS):
        best = _best(tried, found)
        step = np.sqrt(step)
        for x in (best / step, best * step):
            tried.append(np.minimum(x, longest))
            found.append(errors(tried[-1]))
    model = base.model.with_memory(length=_best(tried, found))
    return eqx.tree_at(lambda b: b.model, base, model)


def _best(tried: list[np.ndarray], found: list[np.ndarray]) -> Float[np.ndarray, " joints"]:
    best = np.argmin(found, axis=0)
    return np.array(tried)[best, np.arange(len(best))]


def presliding_note(base: BaseParameters) -> str:
    """Return the lengths of presliding in words."""
    robot, law = base.model.robot, base.model.memory
    lengths = np.broadcast_to(getattr(law, "length", np.nan), robot.joints)
    named = zip(robot.joint_names, lengths.tolist(), range(robot.joints), strict=True)
    shown = ", ".join(f"{name} {x:.2g} {robot.joint_unit(j)}" for name, x, j in named)
    return f"lengths of presliding, whose uncertainty is not in the intervals: {shown}."
