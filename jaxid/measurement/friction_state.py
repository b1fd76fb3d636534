"""Observations with the states of friction that has memory."""

import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import Presliding

from .observations import AbstractSamples, Observations, SamplesInMemory, joined

PART = 16384
"""Samples after which the state is kept, for reading parts of a log."""


class SamplesWithMemory(AbstractSamples):
    """Samples whose motion has the states of friction with memory."""

    source: AbstractSamples  # the samples
    law: Presliding  # law of the state
    # half-open ranges of samples without gaps; each starts as in steady motion
    segments: tuple[tuple[int, int], ...]
    # states at some samples, the first ones of all segments among them
    starts: dict[int, np.ndarray]

    def __init__(self, source, law, segments):
        self.source, self.law, self.segments, self.starts = source, law, segments, {}
        for a, b in segments:
            self.starts[a] = np.asarray(
                law.settled(source.read(slice(a, a + 1))[0].qd[0])
            )
            for k in range(a, b, PART):
                motion, _ = self.read(slice(k, min(k + PART + 1, b)))
                self.starts[min(k + PART, b)] = np.asarray(motion.state)[-1]

    def read(self, samples):  # noqa: D102
        begin = max(k for k in self.starts if k <= samples.start)
        motion, forces = self.source.read(slice(begin, samples.stop))
        state = self.law.states(np.asarray(motion.q, np.float64), self.starts[begin])
        kept = slice(samples.start - begin, None, samples.step)
        return Motion(motion.q, motion.qd, motion.qdd, state)[kept], forces[kept]

    def read_all(self):  # noqa: D102
        return joined(self.read(slice(a, b)) for a, b in self.segments)


def with_memory(observations: Observations, law: Presliding | None) -> Observations:
    """Return the same observations with the states of friction with memory, if there is any."""
    if law is None:
        return observations
    plain = observations.source
    plain = plain.source if isinstance(plain, SamplesWithMemory) else plain
    source = SamplesWithMemory(plain, law, observations.segments)
    if isinstance(plain, SamplesInMemory):
        source = SamplesInMemory(*source.read_all())
    return observations.replace(source=source)
