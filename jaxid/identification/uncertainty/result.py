"""Uncertainty of estimates: results, and the family of methods that compute them."""

from abc import abstractmethod

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, BaseMatrix, BaseVector, Float, Joints, Texts
from jaxid.errors import InputError

from ..estimators.estimate import Estimate
from ..problem import RegressionProblem


class Uncertainty(eqx.Module):
    """Uncertainty of estimates.

    Attributes:
        covariance: Covariance of the estimates; infinite variances where nothing is
            known.
        dof: Degrees of freedom of each variance: few of them make intervals wider.
        naive_covariance: Covariance if the rows were independent, as in textbooks.
        jackknife: Standard deviations by the block jackknife, as a cross-check; None
            where there are not enough blocks.
        notes: Sentences for the user.
    """

    covariance: BaseMatrix
    dof: BaseVector
    naive_covariance: BaseMatrix
    jackknife: BaseVector | None = None
    notes: Texts = eqx.field(static=True, default=())

    @property
    def standard_deviations(self) -> BaseVector:
        """Standard deviations of the estimates; infinite where nothing is known."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def naive_standard_deviations(self) -> BaseVector:
        """Standard deviations if the rows were independent."""
        return np.sqrt(np.diag(self.naive_covariance))

    @property
    def ratios(self) -> BaseVector:
        """Standard deviations relative to naive ones; NaN where nothing is known."""
        naive_deviations = self.naive_standard_deviations
        has_scale = np.isfinite(naive_deviations) & (naive_deviations > 0)
        ratios = np.full_like(naive_deviations, np.nan)
        ratios[has_scale] = (
            self.standard_deviations[has_scale] / naive_deviations[has_scale]
        )
        return ratios

    def half_widths(self, level: float = 0.95) -> BaseVector:
        """Return half the widths of confidence intervals, by the t distribution.

        Args:
            level: Probability (0 to 1) that an interval contains the truth.

        Raises:
            InputError: If `level` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise InputError(
                f"`level` must lie between 0 and 1, like 0.95, but is {level:g}."
            )
        dof = np.clip(self.dof, 1.0, 1e6)
        return self.standard_deviations * scipy.special.stdtrit(dof, 0.5 + 0.5 * level)

    def random_errors(self, count: int, seed: int) -> Float[AnyArray, "draws base"]:
        """Return errors with these correlations, and t distributed each.

        Raises:
            InputError: If a variance is infinite.
        """
        deviations = self.standard_deviations
        if not np.isfinite(deviations).all():
            number = int(np.argmax(~np.isfinite(deviations))) + 1
            raise InputError(
                "draws need parameters that the logs determine, but parameter "
                f"{number} is not determined."
            )
        correlation = self.covariance / np.outer(deviations, deviations)
        variances, axes = np.linalg.eigh(correlation)
        root = axes * np.sqrt(np.clip(variances, 0.0, None))
        normals = np.random.default_rng(seed).normal(size=(count, len(deviations)))
        # The t distribution of a parameter has its own degrees of freedom.
        probabilities = scipy.special.ndtr(normals @ root.T)
        dof = np.clip(self.dof, 1.0, 1e6)
        return deviations * scipy.special.stdtrit(dof, probabilities)


def dof_of_sum(a, b, dof_a, dof_b) -> BaseVector:
    """Return the degrees of freedom of sums of two variances (Welch, Satterthwaite)."""
    dof = (a + b) ** 2 / (a**2 / dof_a + b**2 / dof_b)
    return np.where(np.isnan(dof), np.inf, dof)


def rescale_covariance(covariance: BaseMatrix, deviations: BaseVector) -> BaseMatrix:
    """Return the covariance with the same correlations and other standard deviations.

    Infinite variances, of parameters that are undetermined, stay infinite.
    """
    original_deviations = np.sqrt(np.diag(covariance))
    is_undetermined = np.isinf(original_deviations)
    has_scale = (original_deviations > 0) & ~is_undetermined

    scale = np.zeros_like(original_deviations)
    scale[has_scale] = deviations[has_scale] / original_deviations[has_scale]

    finite_part = np.where(np.isfinite(covariance), covariance, 0.0)
    rescaled_covariance = np.outer(scale, scale) * finite_part
    rescaled_covariance[is_undetermined, is_undetermined] = np.inf
    return rescaled_covariance


class ResidualSpectra(eqx.Module):
    """Spectra of the residuals of each joint, after the filter.

    Whiteness is judged within the band of the filters, with their gain and the leverage
    of the fit divided out: the cumulative periodogram is compared with a straight line
    (Bartlett's test).

    Attributes:
        frequency: Frequencies of the lines [Hz].
        density: Smoothed power of each joint [N² m²/Hz or N²/Hz].
        gain: Gain (0 to 1) of the filter at each line.
        departure: Largest distance (0 to 1) of the cumulative periodogram from a
            straight line.
        limit: Departure that white residuals exceed once in twenty.
        low_frequency: Fraction (0 to 1) of each joint's power below a tenth of the
            band; 0.1 if white.
        band: End of the band [Hz].
    """

    frequency: Float[AnyArray, " lines"]
    density: Float[AnyArray, "joints lines"]
    gain: Float[AnyArray, " lines"]
    departure: Joints
    limit: float
    low_frequency: Joints
    band: float

    @property
    def white(self) -> tuple[bool, ...]:
        """Whether the residuals of each joint cannot be told from white noise."""
        return tuple(bool(x <= self.limit) for x in self.departure)


class AbstractUncertainty(eqx.Module):
    """A method that computes the uncertainty of an estimate."""

    @abstractmethod
    def __call__(
        self,
        problem: RegressionProblem,
        estimate: Estimate,
        naive: BaseMatrix,
    ) -> tuple[Uncertainty, ResidualSpectra | None]:
        """Return the uncertainty, and spectra of residuals if they are computed.

        Args:
            problem: Rows of the estimate.
            estimate: Estimate.
            naive: Covariance if the rows were independent.
        """


class IndependentRows(AbstractUncertainty):
    """Textbook covariance for independent errors: far too small on filtered logs.

    It costs nothing: no pass over the rows, and no cross-check.
    """

    def __call__(self, problem, estimate, naive):
        """Return the naive covariance."""
        dof = float(problem.factors.rows.sum()) - len(naive)
        return Uncertainty(naive, np.full(len(naive), dof), naive), None
