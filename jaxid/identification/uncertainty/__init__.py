"""Uncertainty of estimates: spectral sandwich, block jackknife, residual spectra."""

from jaxid.identification.uncertainty.blocks import BlockJackknife as BlockJackknife
from jaxid.identification.uncertainty.result import AbstractUncertainty as AbstractUncertainty
from jaxid.identification.uncertainty.result import IndependentRows as IndependentRows
from jaxid.identification.uncertainty.result import ResidualSpectra as ResidualSpectra
from jaxid.identification.uncertainty.result import Uncertainty as Uncertainty
from jaxid.identification.uncertainty.spectral import SpectralSandwich as SpectralSandwich
