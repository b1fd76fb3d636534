"""Ways to find the uncertainty of an estimate."""

import dataclasses
from abc import abstractmethod

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.identification.estimators import Estimate
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.uncertainty.jackknife import jackknife
from jaxid.identification.uncertainty.residuals import ResidualSpectra, residual_spectra
from jaxid.identification.uncertainty.sandwich import sandwich
from jaxid.identification.uncertainty.spectra import lines_of
from jaxid.identification.uncertainty.uncertainty import Uncertainty


class AbstractUncertainty(eqx.Module):
    """A way to find the uncertainty of an estimate."""

    @abstractmethod
    def __call__(
        self, rows: RegressionProblem, estimate: Estimate, naive: Float[np.ndarray, "base base"]
    ) -> tuple[Uncertainty, ResidualSpectra | None]:
        """The uncertainty, and spectra of the residuals where it has looked at the rows.

        Args:
            rows: Of the estimate.
            estimate: The estimate.
            naive: Covariance if the rows were independent.
        """


class SpectralSandwich(AbstractUncertainty):
    """From the spectrum of the residuals: right where errors are alike from row to row (default).

    The rows are gone through once more. Errors are taken to be stationary and independent between
    joints, recordings, and parts that a gap divides. Logs of more than a million samples are looked
    at in some stretches, evenly spread: these give the ratio to the naive values. Where only the
    factors of the rows are known, the block jackknife takes its place.
    """

    def __call__(self, rows, estimate, naive):
        """The sandwich, with the jackknife beside it."""
        if not rows.has_samples:
            found, _ = BlockJackknife()(rows, estimate, naive)
            said = (
                "standard deviations come from blocks of time that were left out in turn: only "
                "factors of the rows were at hand, and no spectrum of the residuals."
            )
            return dataclasses.replace(found, notes=found.notes or (said,)), None
        seen = lines_of(rows, estimate.influence, estimate.inverse, estimate.parameters)
        variances = sandwich(seen)
        covariance = variances.covariance
        if not seen.whole:
            exact = np.diag(naive)
            there = (variances.white > 0) & np.isfinite(exact)
            share = np.where(there, exact, 1.0) / np.where(there, variances.white, 1.0)
            share = np.sqrt(np.where(there, share, 1.0))
            covariance = covariance * share * share[:, None]
        found = Uncertainty(
            _unknown(covariance, naive),
            variances.freedom,
            naive,
            _left_out(estimate),
        )
        return found, residual_spectra(seen.lines)


class BlockJackknife(AbstractUncertainty):
    """From blocks of time that are left out in turn.

    It needs the factors of blocks only, and takes errors to be correlated within blocks in any way,
    and joints with each other. Ten blocks give rough values. Correlations between parameters are
    those of the naive covariance.
    """

    def __call__(self, rows, estimate, naive):
        """The jackknife; where there is one block only, the naive values."""
        deviations = _left_out(estimate)
        if deviations is None:
            said = (
                "standard deviations take the rows for independent, and are too small where errors "
                "are alike from row to row: there is only one block of time."
            )
            freedom = np.full(len(naive), np.inf)
            return Uncertainty(naive, freedom, naive, None, (said,)), None
        own = np.sqrt(np.diag(naive))
        known = np.isfinite(own) & (own > 0)
        share = np.where(known, deviations, 0.0) / np.where(known, own, 1.0)
        covariance = np.where(np.isfinite(naive), naive, 0.0) * share * share[:, None]
        freedom = np.full(len(naive), float(len(estimate.blocks.parts) - 1))
        return Uncertainty(_unknown(covariance, naive), freedom, naive, deviations), None


class IndependentRows(AbstractUncertainty):
    """As textbooks have it, for independent errors of the rows: far too small on filtered logs.

    It costs nothing: no pass over the rows, and no cross-check.
    """

    def __call__(self, rows, estimate, naive):
        """The naive values."""
        freedom = float(rows.factors.rows.sum()) - len(naive)
        return Uncertainty(naive, np.full(len(naive), freedom), naive), None


def _left_out(estimate: Estimate) -> np.ndarray | None:
    """The jackknife's standard deviations, where there are blocks to leave out."""
    if len(estimate.blocks.parts) < 2:
        return None
    return jackknife(estimate.blocks, estimate.weights, estimate.inverse, estimate.parameters)


def _unknown(covariance: np.ndarray, naive: np.ndarray) -> np.ndarray:
    """Infinite variances where the naive ones are."""
    covariance = covariance.copy()
    unknown = np.isinf(np.diag(naive))
    covariance[unknown, unknown] = np.inf
    return covariance
