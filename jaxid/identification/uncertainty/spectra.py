"""Spectra of what moves an estimate, and of the residuals: line by line, channel by channel."""

import itertools
from typing import NamedTuple

import numpy as np

from jaxid.identification.influence import AbstractInfluence, Channel
from jaxid.identification.rows import RowChunk, Rows
from jaxid.identification.streaming_log import source
from jaxid.identification.uncertainty.stretches import (
    FAINT,
    Stretch,
    gathered,
    passes,
    stretches,
)
from jaxid.types import AnyArray, Float

BINS = np.concatenate([np.arange(0.0, 1.0, 0.05), 1.15 ** np.arange(0, 80)])
"""Edges [Hz] between which spectra are taken as one for correlations between parameters."""


class Lines(NamedTuple):
    r"""Spectra of all stretches of one length, added up.

    Attributes:
        length: Rows of a stretch.
        row_time: Between two rows [s].
        frequency: Of the lines [Hz].
        multiplicity: 2, or 1 for the lines without a mirror image.
        gain: Of the filters.
        energy: $|\sum_t (B z_t)_i e^{-i \omega t}|^2 m / N$ [base, channels, lines].
        bins: Of each line, counted among those that hold one.
        correlated: The same for pairs of parameters, summed over the lines of each bin
            [bins, channels, base, base].
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
    correlated: np.ndarray
    leverage: np.ndarray
    power: np.ndarray
    residual: np.ndarray
    exposure: np.ndarray
    stretches: int

    def added(self, other: "Lines") -> "Lines":
        """Both together, of stretches with the same lines."""
        sums = {
            name: getattr(self, name) + getattr(other, name)
            for name in (
                "energy", "correlated", "leverage", "power", "residual", "exposure", "stretches",
            )
        }  # fmt: skip
        return self._replace(**sums)


def lines_of(
    rows: Rows,
    influence: AbstractInfluence,
    inverse: Float[AnyArray, "base base"],
    p: Float[AnyArray, " base"],
) -> tuple[list[Lines], bool]:
    """Goes through the rows once and transforms every stretch.

    Args:
        rows: Of the estimate.
        influence: How they move it.
        inverse: What takes the place of the inverse of the information.
        p: The estimate.

    Returns:
        The lines of every kind of stretch, and whether they are of all rows.
    """
    wanted, whole = stretches(rows)
    found: dict[tuple, Lines] = {}
    for stretch, parts in gathered(rows, wanted, np.asarray(p)):
        o, _ = source(rows.recordings[stretch.recording])
        lines = _transformed(stretch, parts, influence, np.asarray(inverse), o)
        key = (stretch.length, stretch.row_time, len(lines.frequency))
        found[key] = found[key].added(lines) if key in found else lines
    return list(found.values()), whole


def _transformed(
    stretch: Stretch,
    parts: list[tuple[RowChunk, np.ndarray]],
    influence: AbstractInfluence,
    inverse: np.ndarray,
    observations,
) -> Lines:
    n = stretch.length
    frequency = np.fft.rfftfreq(n, stretch.row_time)
    gain = passes(observations, frequency)
    last = int(np.flatnonzero(gain > FAINT)[-1]) + 1
    frequency, gain = frequency[:last], gain[:last]
    multiplicity = np.full(last, 2.0)
    multiplicity[0] = 1.0
    if n % 2 == 0 and last == n // 2 + 1:
        multiplicity[-1] = 1.0
    places = np.searchsorted(BINS, frequency, side="right")
    _, starts, bins = np.unique(places, return_index=True, return_inverse=True)
    pieces = [influence.channels(chunk, residuals) for chunk, residuals in parts]
    size, channels = len(inverse), len(pieces[0])
    energy = np.empty((size, channels, last))
    correlated = np.empty((len(starts), channels, size, size))
    leverage, power = np.empty((channels, last)), np.empty((channels, last))
    exposure = np.empty(channels)
    for c in range(channels):
        own, Z, theta, u, counted = _joined([piece[c] for piece in pieces])
        Zf = np.fft.rfft(Z, axis=0)[:last]
        P = Zf @ inverse[:, own].T
        energy[:, c] = (np.abs(P) ** 2 * multiplicity[:, None]).T / n
        weighted = P * np.sqrt(multiplicity / n)[:, None]
        for k, (a, b) in enumerate(itertools.pairwise([*starts, last])):
            both = np.concatenate([weighted[a:b].real, weighted[a:b].imag])
            correlated[k, c] = both.T @ both
        Tf = Zf if theta is Z else np.fft.rfft(theta, axis=0)[:last]
        leverage[c] = np.real(np.sum(P[:, own].conj() * Tf, axis=1)) / n
        power[c] = np.abs(np.fft.rfft(u)[:last]) ** 2 / n
        exposure[c] = counted / n
    residuals = np.concatenate([np.where(chunk.counted, r, 0.0) for chunk, r in parts])
    residual = np.abs(np.fft.rfft(residuals, axis=0)[:last].T) ** 2 / n
    return Lines(
        n,
        stretch.row_time,
        frequency,
        multiplicity,
        gain,
        energy,
        bins,
        correlated,
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
