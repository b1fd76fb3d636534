"""Observations with the states of friction that has memory."""

import numpy as np

from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import Presliding

from .observations import Observations
from .samples import AbstractSamples, SamplesInMemory, joined

PART_SIZE = 16384
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
        self.source = source
        self.law = law
        self.segments = segments
        self.starts = {}
        for a, b in segments:
            motion, _ = source.read(slice(a, a + 1))
            self.starts[a] = np.asarray(law.settled(motion.qd[0]))
            for start in range(a, b, PART_SIZE):
                stop = min(start + PART_SIZE, b)
                motion, _ = self.read(slice(start, min(stop + 1, b)))
                self.starts[stop] = np.asarray(motion.state)[-1]

    def read(self, samples):  # noqa: D102
        start = max(k for k in self.starts if k <= samples.start)
        motion, forces = self.source.read(slice(start, samples.stop))
        q = np.asarray(motion.q, np.float64)
        state = self.law.states(q, self.starts[start])
        motion = Motion(motion.q, motion.qd, motion.qdd, state)
        part = slice(samples.start - start, None, samples.step)
        return motion[part], forces[part]

    def read_all(self):  # noqa: D102
        return joined(self.read(slice(a, b)) for a, b in self.segments)


def with_memory(observations: Observations, law: Presliding | None) -> Observations:
    """Return the same observations with the states of friction with memory, if any."""
    if law is None:
        return observations
    samples = observations.source
    if isinstance(samples, SamplesWithMemory):
        samples = samples.source
    source = SamplesWithMemory(samples, law, observations.segments)
    if isinstance(samples, SamplesInMemory):
        source = SamplesInMemory(*source.read_all())
    return observations.replace(source=source)
