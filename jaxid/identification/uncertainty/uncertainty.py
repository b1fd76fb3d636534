"""Uncertainties of estimates: what is known of their errors, and how it was found."""

import equinox as eqx
import numpy as np
from scipy import special

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError

MANY = 1e6
"""Degrees of freedom that are as good as infinitely many."""


class Uncertainty(eqx.Module):
    """What is known of the errors of estimates.

    Attributes:
        covariance: Of the estimates; infinite variances where nothing is known.
        freedom: Degrees of freedom behind each variance: few of them make intervals wider.
        naive_covariance: What it would be if the rows were independent, as textbooks take them.
        jackknife: Standard deviations from leaving out blocks of time, as a cross-check; None where
            there are not enough blocks.
        notes: What the user should know, in sentences.
    """

    covariance: Float[AnyArray, "base base"]
    freedom: Float[AnyArray, " base"]
    naive_covariance: Float[AnyArray, "base base"]
    jackknife: Float[AnyArray, " base"] | None = None
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    @classmethod
    def given(cls, covariance: Float[AnyArray, "base base"]) -> "Uncertainty":
        """A covariance that is known from elsewhere."""
        return cls(covariance, np.full(len(covariance), np.inf), covariance)

    def of_first(self, count: int) -> "Uncertainty":
        """Of the first parameters only."""
        return Uncertainty(
            np.asarray(self.covariance)[:count, :count],
            np.asarray(self.freedom)[:count],
            np.asarray(self.naive_covariance)[:count, :count],
            None if self.jackknife is None else np.asarray(self.jackknife)[:count],
            self.notes,
        )

    @property
    def standard_deviations(self) -> Float[np.ndarray, " base"]:
        """Of the estimates; infinite where nothing is known."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def naive_standard_deviations(self) -> Float[np.ndarray, " base"]:
        """What they would be if the rows were independent."""
        return np.sqrt(np.diag(self.naive_covariance))

    @property
    def ratios(self) -> Float[np.ndarray, " base"]:
        """Standard deviations over the naive ones; NaN where nothing is known."""
        naive = self.naive_standard_deviations
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(naive > 0, self.standard_deviations / naive, np.nan)

    def half_widths(self, level: float = 0.95) -> Float[np.ndarray, " base"]:
        """Half of the intervals' widths, by the t distribution.

        Args:
            level: Share of cases in which an interval holds the truth, of 1.

        Raises:
            InputError: If `level` is not between 0 and 1.
        """
        if not 0 < level < 1:
            raise InputError(f"`level` must lie between 0 and 1, like 0.95, but is {level:g}.")
        freedom = np.clip(np.asarray(self.freedom), 1.0, MANY)
        quantile = special.stdtrit(freedom, 0.5 + 0.5 * level)
        return self.standard_deviations * quantile
