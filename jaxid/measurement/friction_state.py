"""Observations with the states of friction that has memory."""

import dataclasses

import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import Presliding

from .observations import Observations
from .samples import AbstractSamples, SamplesInMemory, joined
from .time_grid import Ranges

PART_SIZE = 16384
"""Samples after which the state is kept, for reading parts of a log."""


class SamplesWithMemory(AbstractSamples):
    """Samples whose motion has the states of friction with memory."""

    source: AbstractSamples  # the samples
    law: Presliding  # law of the state
    segments: Ranges  # samples without gaps; each starts as in steady motion
    # states at some samples, the first ones of all segments among them
    states: dict[int, np.ndarray]

    @classmethod
    def of(
        cls, source: AbstractSamples, law: Presliding, segments: Ranges
    ) -> "SamplesWithMemory":
        """Find the states at the first samples of the parts of all segments."""
        states = {}
        for a, b in segments:
            first_motion, _ = source.read(slice(a, a + 1))
            state = np.asarray(law.settled(first_motion.qd[0]))
            for start in range(a, b, PART_SIZE):
                states[start] = state
                # Up to the first sample of the next part.
                stop = min(start + PART_SIZE + 1, b)
                motion, _ = source.read(slice(start, stop))
                state = _follow(law, motion, state)[-1]
        return cls(source, law, segments, states)

    def read(self, samples):  # noqa: D102
        start = max(k for k in self.states if k <= samples.start)
        motion, forces = self.source.read(slice(start, samples.stop))
        state = _follow(self.law, motion, self.states[start])
        motion = dataclasses.replace(motion, state=state)
        part = slice(samples.start - start, None, samples.step)
        return motion[part], forces[part]

    def read_all(self):  # noqa: D102
        return joined(self.read(slice(a, b)) for a, b in self.segments)


def _follow(law: Presliding, motion: Motion, state: np.ndarray) -> np.ndarray:
    """Return the states along a motion that begins in a state."""
    return np.asarray(law.states(np.asarray(motion.q, np.float64), state))


def with_memory(observations: Observations, law: Presliding | None) -> Observations:
    """Return the same observations with the states of friction with memory, if any."""
    if law is None:
        return observations
    samples = observations.source
    if isinstance(samples, SamplesWithMemory):
        samples = samples.source
    source = SamplesWithMemory.of(samples, law, observations.segments)
    if isinstance(samples, SamplesInMemory):
        source = SamplesInMemory(*source.read_all())
    return observations.replace(source=source)
