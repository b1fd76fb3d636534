"""Uncertainty of estimates: spectral sandwich, block jackknife, residual spectra."""

from .blocks import BlockJackknife as BlockJackknife
from .result import AbstractUncertainty as AbstractUncertainty
from .result import IndependentRows as IndependentRows
from .result import ResidualSpectra as ResidualSpectra
from .result import Uncertainty as Uncertainty
from .spectral import SpectralSandwich as SpectralSandwich
