"""How far estimates can be trusted: spectral sandwich, block jackknife, residual spectra."""
