"""Delays between the channels of a log: forces that were stamped later than the angles."""

import dataclasses
import math

import numpy as np
from scipy.interpolate import CubicSpline

from jaxid.arrays import Float
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import FEWEST, Recording


def remove_delay(recording: Recording, seconds: float) -> Recording:
    """Brings angles and forces to the same time, for any part of a sample.

    Forces stay as they are, on their clock; angles, which are smooth, are interpolated by cubic
    splines to the instants at which the forces really acted. Samples at the ends of segments for
    which there are no angles are dropped.

    Args:
        recording: Whose forces stand too late in the log.
        seconds: By how much they are late [s]; negative if they are early.

    Raises:
        InputError: If the delay is longer than a segment allows.
    """
    _refuse_endless(seconds)
    lost = math.ceil(abs(seconds) / recording.sample_time - 1e-9)
    early, late = (lost, 0) if seconds > 0 else (0, lost)
    kept, segments = [], []
    for a, b in recording.segments:
        if b - a - lost >= FEWEST:
            start = sum(len(part) for part in kept)
            kept.append(np.arange(a + early, b - late))
            segments.append((start, start + len(kept[-1])))
    if not kept:
        raise InputError(
            f"the delay is {seconds:g} s, but the longest segment of `{recording.name}` lasts "
            f"{max(b - a for a, b in recording.segments) * recording.sample_time:g} s."
        )
    chosen = np.concatenate(kept)
    time = np.asarray(recording.time)

    def moved(values):
        if values is None:
            return None
        out = np.empty((len(chosen), recording.joints))
        whole = [(a, b) for a, b in recording.segments if b - a - lost >= FEWEST]
        for (a, b), (c, d) in zip(whole, segments, strict=True):
            out[c:d] = CubicSpline(time[a:b], np.asarray(values)[a:b])(time[chosen[c:d]] - seconds)
        return out

    return dataclasses.replace(
        recording,
        time=time[chosen],
        angles=moved(recording.angles),
        forces=np.asarray(recording.forces)[chosen],
        velocities=moved(recording.velocities),
        segments=tuple(segments),
        notes=(*recording.notes, f"a delay of the forces of {1e3 * seconds:.4g} ms was removed"),
    )


def without_delay(observations: Observations, seconds: float) -> Observations:
    """The same for observations: their motion is interpolated, and rows near the ends left out.

    Args:
        observations: Whose forces are late.
        seconds: By how much [s]; negative if they are early.

    Raises:
        InputError: If no rows are left.
    """
    _refuse_endless(seconds)
    time, dt = np.asarray(observations.time), observations.sample_time
    lost = math.ceil(abs(seconds) / dt - 1e-9)
    edge = observations.filter.edge(dt)
    mask, instants = np.array(observations.mask), observations.instants
    parts: list[list[Float[np.ndarray, "samples joints"]]] = [[], [], []]
    for (a, b), (r0, r1) in zip(observations.segments, observations.row_segments, strict=True):
        # Where there is no motion the nearest stands in, and what sees it does not count.
        at = np.clip(time[a:b] - seconds, time[a], time[b - 1])
        for values, x in zip(parts, _arrays(observations.motion), strict=True):
            values.append(CubicSpline(time[a:b], x[a:b])(at))
        rows = instants[r0:r1]
        first, last = (a + edge + lost, b) if seconds > 0 else (a, b - edge - lost)
        mask[r0:r1] &= ((rows >= first) & (rows < last))[:, None]
    if not mask.any(axis=0).all():
        raise InputError(
            f"the delay is {seconds:g} s, but `{observations.name}` lasts "
            f"{time[-1] - time[0]:g} s: no rows of some joint are left."
        )
    motion = Motion(*(np.concatenate(values) for values in parts))
    return observations.replace(motion=motion, mask=mask)


def _refuse_endless(seconds: float) -> None:
    if not math.isfinite(seconds):
        raise InputError(f"the delay must be a finite time [s], but is {seconds:g}.")


def _arrays(motion: Motion) -> list[np.ndarray]:
    return [np.asarray(x, np.float64) for x in (motion.q, motion.qd, motion.qdd)]
