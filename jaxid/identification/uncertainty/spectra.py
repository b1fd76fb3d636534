"""Spectra of what moves an estimate, and of the residuals: line by line, channel by channel."""

import itertools
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.uncertainty.stretches import (
    FAINT,
    filled,
    gathered,
    passes,
    stretches,
)
from jaxid.measurement.observations import Observations

BINS = np.concatenate([np.arange(0.0, 1.0, 0.05), 1.15 ** np.arange(0, 80)])
"""Edges [Hz] between which spectra are taken as one for correlations between parameters."""


class Lines(NamedTuple):
    r"""Spectra of all stretches of one length, added up.

    Attributes:
        length: Rows of a stretch; what is shorter is filled up with rows that do not count.
        row_time: Between two rows [s].
        frequency: Of the lines [Hz].
        multiplicity: 2, or 1 for the lines without a mirror image.
        gain: Of the filters.
        energy: $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, channels, lines].
        bins: Of each line.
        leverage: Part of a channel's line that the fit has taken [channels, lines].
        power: Periodogram of the disturbances [channels, lines].
        residual: Periodogram of the residuals [joints, lines], in [N² m²] or [N²].
        exposure: Number of stretches, as many as rows of each channel count.
        stretches: Number of stretches.
    """

    length: int
    row_time: float
    frequency: np.ndarray
    multiplicity: np.ndarray
    gain: np.ndarray
    energy: np.ndarray
    bins: np.ndarray
    leverage: np.ndarray
    power: np.ndarray
    residual: np.ndarray
    exposure: np.ndarray
    stretches: int

    def added(self, other: "Lines") -> "Lines":
        """Both together, of stretches with the same lines."""
        names = ("energy", "leverage", "power", "residual", "exposure", "stretches")
        sums = {name: getattr(self, name) + getattr(other, name) for name in names}
        return self._replace(**sums)


class Seen(NamedTuple):
    """What a pass over the rows has seen.

    Attributes:
        lines: Of every kind of stretch.
        correlated: As `energy`, for pairs of parameters, summed over the lines of each bin
            [bins, channels, base, base].
        whole: Whether it has seen all rows.
    """

    lines: list[Lines]
    correlated: np.ndarray
    whole: bool


def lines_of(
    rows: RegressionProblem,
    influence: AbstractInfluence,
    inverse: Float[AnyArray, "base base"],
    p: Float[AnyArray, " base"],
) -> Seen:
    """Goes through the rows once and transforms every stretch.

    Args:
        rows: Of the estimate.
        influence: How they move it.
        inverse: What takes the place of the inverse of the information.
        p: The estimate.
    """
    wanted, whole = stretches(rows)
    lengths = filled(wanted)
    found: dict[tuple, Lines] = {}
    B = np.asarray(inverse)
    correlated = np.zeros((0, 0, *B.shape))
    for stretch, parts in gathered(rows, wanted, np.asarray(p)):
        o = rows.recordings[stretch.recording]
        pieces = [influence.channels(chunk, residuals) for chunk, residuals in parts]
        if not len(correlated):
            correlated = np.zeros((len(BINS) + 1, len(pieces[0]), *B.shape))
        r = np.concatenate([np.where(chunk.mask, r, 0.0) for chunk, r in parts])
        n = lengths[stretch.length, stretch.row_time]
        lines = _transformed(n, stretch.row_time, pieces, r, B, o, correlated)
        key = (n, stretch.row_time, len(lines.frequency))
        found[key] = found[key].added(lines) if key in found else lines
    return Seen(list(found.values()), correlated, whole)


def _transformed(
    n: int,
    row_time: float,
    pieces: list[list[Channel]],
    residuals: np.ndarray,
    inverse: np.ndarray,
    observations: Observations,
    correlated: np.ndarray,
) -> Lines:
    """The lines of one stretch; adds to what is correlated."""
    frequency = np.fft.rfftfreq(n, row_time)
    gain = passes(observations, frequency)
    last = int(np.flatnonzero(gain > FAINT)[-1]) + 1
    frequency, gain = frequency[:last], gain[:last]
    multiplicity = np.full(last, 2.0)
    multiplicity[0] = 1.0
    if n % 2 == 0 and last == n // 2 + 1:
        multiplicity[-1] = 1.0
    bins = np.searchsorted(BINS, frequency, side="right")
    there, starts = np.unique(bins, return_index=True)
    size, channels = len(inverse), len(pieces[0])
    energy = np.empty((size, channels, last))
    leverage, power = np.empty((channels, last)), np.empty((channels, last))
    exposure = np.empty(channels)
    for c in range(channels):
        own, Z, theta, u, counted = _joined([piece[c] for piece in pieces])
        Zf = np.fft.rfft(Z, n, axis=0)[:last]
        P = Zf @ inverse[:, own].T
        energy[:, c] = (np.abs(P) ** 2 * multiplicity[:, None]).T / n
        weighted = P * np.sqrt(multiplicity / n)[:, None]
        for k, (a, b) in zip(there, itertools.pairwise([*starts, last]), strict=True):
            both = np.concatenate([weighted[a:b].real, weighted[a:b].imag])
            correlated[k, c] += both.T @ both
        Tf = Zf if theta is Z else np.fft.rfft(theta, n, axis=0)[:last]
        leverage[c] = np.real(np.sum(P[:, own].conj() * Tf, axis=1)) / n
        power[c] = np.abs(np.fft.rfft(u, n)[:last]) ** 2 / n
        exposure[c] = counted / n
    residual = np.abs(np.fft.rfft(residuals, n, axis=0)[:last].T) ** 2 / n
    return Lines(
        n,
        row_time,
        frequency,
        multiplicity,
        gain,
        energy,
        bins,
        leverage,
        power,
        residual,
        exposure,
        1,
    )


def _joined(pieces: list[Channel]) -> tuple[list[int], np.ndarray, np.ndarray, np.ndarray, int]:
    """The rows of one channel: its columns, instruments, equations, disturbances, and how many."""
    first = pieces[0]
    Z = np.concatenate([x.instruments for x in pieces])
    same = all(x.equations is x.instruments for x in pieces)
    theta = Z if same else np.concatenate([x.equations for x in pieces])
    u = np.concatenate([x.disturbance for x in pieces])
    return list(first.columns), Z, theta, u, sum(x.counted for x in pieces)
