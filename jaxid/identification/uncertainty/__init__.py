"""Uncertainty of estimates: spectral sandwich, block jackknife, residual spectra."""

from .blocks import BlockJackknife as BlockJackknife, bootstrap as bootstrap
from .result import (
    AbstractUncertainty as AbstractUncertainty,
    IndependentRows as IndependentRows,
    ResidualSpectra as ResidualSpectra,
    Uncertainty as Uncertainty,
)
from .spectral import SpectralSandwich as SpectralSandwich
