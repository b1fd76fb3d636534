"""Whether the forces of a log stand later in it than the angles that belong to them."""

import numpy as np
from scipy import stats

from jaxid.dynamics.base import BaseParameters
from jaxid.identification.estimators import GivenWeights
from jaxid.identification.fit import Fit
from jaxid.identification.runs.delay import estimate_delay
from jaxid.measurement.observations import Observations

EXPLAINED = 0.3
"""Share of the forces that the model must not leave unexplained, of 1: else it sees no delay."""
LEAST = 0.1
"""Delay that is worth a word, in sample times."""
ALIKE = 0.001
"""Chance of joints that differ so much, of 1, below which one delay does not explain them."""


def delay_doubts(base: BaseParameters, observations: Observations, fit: Fit) -> tuple[str, ...]:
    """A sentence about a delay that the model sees, or nothing.

    Args:
        base: What is identified.
        observations: Of one log, or of a part of it.
        fit: Of this log.
    """
    if not fit.residual < EXPLAINED:
        return ()
    try:
        found = estimate_delay(base, observations, GivenWeights(np.asarray(fit.weights)))
    except ValueError:
        return ()
    half = found.standard_deviation * float(stats.t.ppf(0.975, found.freedom))
    # What differs from joint to joint by as much is no delay of a bus, but what the model lacks.
    unlike = float(np.std(found.of_joints))
    if abs(found.seconds) < max(half, unlike, LEAST * observations.sample_time):
        return ()
    said = (
        f"the forces seem to stand {1e3 * abs(found.seconds):.3g} ± {1e3 * half:.2g} ms "
        f"{'later' if found.seconds > 0 else 'earlier'} in the log than the angles: "
    )
    if found.alike > ALIKE:
        cure = f"`force_delay = {found.seconds:.3g}` in `[recording]` removes that"
        return (f"{said}{cure}, unless the model lacks an effect instead.",)
    low, high = (1e3 * float(x) for x in (np.min(found.of_joints), np.max(found.of_joints)))
    return (
        f"{said}from {low:.3g} to {high:.3g} ms joint by joint, so that some effect which the "
        "model lacks is as likely (`force_delay` in `[recording]`).",
    )
