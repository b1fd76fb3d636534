"""Observations with the states of friction that has memory."""

import dataclasses

import numpy as np

from jaxid.dynamics.terms import Presliding

from .observations import Observations
from .samples import SamplesInMemory


def with_memory(observations: Observations, law: Presliding | None) -> Observations:
    """Return the same observations with the states of friction with memory, if any.

    Each segment starts as in steady motion. A log on disk is read as a whole, since
    each state follows from the one before it.
    """
    if law is None:
        return observations
    motion, forces = observations.source.read_all()
    states = []
    for a, b in observations.segments:
        q = np.asarray(motion.q[a:b], np.float64)
        first_state = np.asarray(law.settled(np.asarray(motion.qd[a])))
        states.append(np.asarray(law.states(q, first_state)))
    motion = dataclasses.replace(motion, state=np.concatenate(states))
    return observations.replace(source=SamplesInMemory(motion, forces))
