"""Uncertainty of estimates: spectral sandwich, block jackknife, residual spectra."""

from .blocks import BlockJackknife as BlockJackknife, bootstrap as bootstrap
from .result import (
    AbstractUncertainty as AbstractUncertainty,
    IndependentRows as IndependentRows,
    ResidualSpectra as ResidualSpectra,
    Uncertainty as Uncertainty,
)
from .spectra_of_rows import row_spectra as row_spectra
from .spectral import (
    SpectralSandwich as SpectralSandwich,
    SpectralTable as SpectralTable,
)

UNCERTAINTIES: dict[str, type[AbstractUncertainty]] = {
    "spectral": SpectralSandwich,
    "jackknife": BlockJackknife,
    "independent": IndependentRows,
}
"""Methods of standard deviations, by the names of experiment files."""
