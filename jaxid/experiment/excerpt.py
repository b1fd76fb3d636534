"""Stretches of a log that stays on the disk, to be examined like a short one."""

import itertools

import numpy as np

from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording

EXAMINED = 2**17
"""Samples of a long log that are examined at most."""
STRETCHES = 4
"""Parts of a log from which they are taken, evenly far apart."""
EDGES = 20
"""Length of a stretch over what filters lose at one end, at least."""


def excerpt(log: Observations) -> Recording:
    """Some stretches of a log, as they were recorded: at its beginning, at its end and between.

    Args:
        log: That stays on the disk.

    Raises:
        InputError: If a column holds what is no number.
    """
    stretches = _stretches(log)
    angles, velocities, forces = zip(
        *(log.source.read_recorded(slice(a, b)) for a, b in stretches), strict=True
    )
    ends = np.cumsum([0, *(b - a for a, b in stretches)])
    times = []
    for a, b in stretches:
        k = next(k for k, (_, end) in enumerate(log.segments) if end > a)
        times.append(log.start_times[k] + log.sample_time * (np.arange(a, b) - log.segments[k][0]))
    return Recording(
        time=np.concatenate(times),
        angles=np.concatenate(angles),
        forces=np.concatenate(forces),
        velocities=None if velocities[0] is None else np.concatenate(velocities),
        angles_on_motor_side=log.source.columns.angles_on_motor_side,
        forces_on_motor_side=log.source.columns.forces_on_motor_side,
        segments=tuple((int(a), int(b)) for a, b in itertools.pairwise(ends)),
        sample_time=log.sample_time,
        name=log.name,
    )


def _stretches(log: Observations) -> list[tuple[int, int]]:
    """Half-open ranges of samples, none of which goes over a gap."""
    if log.samples <= EXAMINED:
        return list(log.segments)
    length = EXAMINED // STRETCHES
    least = EDGES * log.filter.edge(log.sample_time)
    found = []
    for start in np.linspace(0, log.samples - length, STRETCHES).astype(int):
        a = max(int(start), found[-1][1] if found else 0)
        b = min(a + length, next(end for _, end in log.segments if end > a))
        found.append((a, b))
    if min(b - a for a, b in found) >= least:
        return found
    # Gaps or a slow filter: one long stretch tells more than several short ones.
    a, b = max(log.segments, key=lambda ends: ends[1] - ends[0])
    return [(a, min(b, a + EXAMINED))]
