"""What residuals look like: their spectra, and whether they are white, joint by joint."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.identification.uncertainty.sandwich import Windows
from jaxid.identification.uncertainty.spectra import Lines

PASSED = 0.5
"""Gain of the filters above which a line counts for whiteness."""
SHOWN = 400
"""Most lines of a spectrum that are kept to be shown."""
KOLMOGOROV = 1.358
"""Departure times the root of the number of lines that white residuals exceed once in twenty."""


class ResidualSpectra(eqx.Module):
    """Spectra of the residuals of each joint, after filters and decimation.

    Whiteness is judged within the filters' band, with the filters' gain and what the fit has taken
    divided out: the periodogram, summed up over frequency, is compared with a straight line
    (Bartlett's test).

    Attributes:
        frequency: Of the lines [Hz].
        density: Smoothed power of each joint [N² m²/Hz or N²/Hz].
        gain: Of filter and decimation at each line, of 1.
        departure: Largest distance of the summed-up periodogram from a straight line, of 1.
        limit: What white residuals stay below nineteen times in twenty, of 1.
        slow: Share of each joint's power below a tenth of the band, of 1; white: 0.1.
        band: End of the band [Hz].
    """

    frequency: Float[AnyArray, " lines"]
    density: Float[AnyArray, "joints lines"]
    gain: Float[AnyArray, " lines"]
    departure: Float[AnyArray, " joints"]
    limit: float
    slow: Float[AnyArray, " joints"]
    band: float

    @property
    def white(self) -> tuple[bool, ...]:
        """For each joint whether its residuals can be told from white ones."""
        return tuple(bool(x <= self.limit) for x in np.asarray(self.departure))


def residual_spectra(lines: Sequence[Lines]) -> ResidualSpectra:
    """Spectra and whiteness from the stretches of a fit; of the longest kind where there are many.

    Args:
        lines: Of every kind of stretch.
    """
    longest = max(lines, key=lambda x: x.length * x.stretches)
    rows = longest.length * np.maximum(np.mean(longest.exposure), 1e-300)
    half = 0.5 * longest.multiplicity
    windows = Windows.of([longest])
    smooth = windows.sums(half * longest.residual) / windows.sums(half)
    # One-sided: the mirror image of a line counts with it.
    scale = 2.0 * longest.row_time * longest.length / rows
    passed = (longest.gain > PASSED) & (longest.frequency > 0)
    if not passed.any():
        passed = longest.gain > 0
    share = np.clip(1.0 - longest.leverage / longest.exposure[:, None], 0.02, None)
    power = (longest.residual / share / longest.gain**2)[:, passed]
    total = power.sum(axis=1, keepdims=True)
    summed = np.cumsum(power, axis=1) / np.where(total > 0, total, 1.0)
    count = int(passed.sum())
    line = np.arange(1, count + 1) / count
    shown = np.unique(np.linspace(0, len(half) - 1, SHOWN).round().astype(int))
    return ResidualSpectra(
        frequency=longest.frequency[shown],
        density=scale * smooth[:, shown],
        gain=longest.gain[shown],
        departure=np.abs(summed - line).max(axis=1),
        limit=float(KOLMOGOROV / np.sqrt(count * np.mean(longest.exposure))),
        slow=summed[:, max(0, round(0.1 * count) - 1)],
        band=float(longest.frequency[passed][-1]),
    )
