"""A designed experiment: the motion, what it will tell, and what it uses of the limits."""

import functools
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.excitation.constraints.constraint import Finding
from jaxid.excitation.criteria import (
    AbstractCriterion,
    AOptimal,
    ConditionNumber,
    DOptimal,
    EOptimal,
    ScaledConditionNumber,
    WeightedConditionNumber,
)
from jaxid.excitation.information import Information
from jaxid.excitation.limits import JointLimits
from jaxid.trajectory.files import save_trajectory, write_csv
from jaxid.trajectory.trajectory import AbstractTrajectory

CRITERIA = (
    ConditionNumber(),
    WeightedConditionNumber(),
    ScaledConditionNumber(),
    DOptimal(),
    AOptimal(),
    EOptimal(),
)
"""All criteria, as tables show them."""
SINGULAR = 1e-12
"""Share of the largest eigenvalue, columns scaled, below which a direction is not determined."""
TAKES_PART = 1e-3
"""Share of a direction that makes a parameter part of it."""
VAGUE = 0.5
"""Relative standard deviation above which a parameter counts as hardly determined."""


class Comparison(NamedTuple):
    """One criterion before and after the design.

    Attributes:
        name: Of the criterion.
        before: Of a random motion that fills the same limits: the median of the starts.
        after: Of the designed motion.
    """

    name: str
    before: float
    after: float


class ExcitationPlan(eqx.Module):
    """What a design has found.

    Attributes:
        base: Whose parameters the motion shall determine.
        trajectory: The motion.
        criterion: What was made small.
        limits: Of the joints, with what was assumed of them.
        numbers: Of the trajectory in its basis.
        information: Of one run of the motion.
        reference: Of a random motion that fills the same limits.
        noise: Standard deviation of the forces' noise by joint, which is assumed [N m or N].
        samples: Measured samples of one run.
        findings: Of the constraints beside joint limits.
        nominal: Base parameters as far as they are known before, NaN where not; or None.
        interrupted: Whether the design was stopped before its end.
    """

    base: BaseParameters
    trajectory: AbstractTrajectory
    criterion: AbstractCriterion
    limits: JointLimits
    numbers: Float[AnyArray, "joints variables"]
    information: Information
    reference: Information
    noise: Float[AnyArray, " joints"]
    samples: int = eqx.field(static=True)
    findings: tuple[Finding, ...]
    nominal: Float[AnyArray, " base"] | None
    interrupted: bool = eqx.field(static=True)

    @property
    def feasible(self) -> bool:
        """Whether all limits are kept."""
        return not self.diagnosis

    @property
    def diagnosis(self) -> tuple[str, ...]:
        """Which limits are not kept, and by how much; empty where all are."""
        return tuple(str(f) for f in self.findings if f.value > 0)

    @functools.cached_property
    def criteria(self) -> tuple[Comparison, ...]:
        """All criteria, of a random motion and of this one."""
        with double_precision():
            return tuple(
                Comparison(c.name, c.value(self.reference), c.value(self.information))
                for c in CRITERIA
            )

    @property
    def standard_deviations(self) -> Float[np.ndarray, " base"]:
        """What weighted least squares will give for each base parameter, in its unit (Eq. 33).

        Infinite where nothing is known. Noise is independent from sample to sample, with the
        standard deviations of `noise`; nothing else disturbs.
        """
        return deviations(self.information.weighted)

    @property
    def relative_deviations(self) -> Float[np.ndarray, " base"] | None:
        """Standard deviations over the nominal parameters; NaN where those are unknown or zero."""
        if self.nominal is None:
            return None
        size = np.abs(np.asarray(self.nominal))
        return self.standard_deviations / np.where(size > 0, size, np.nan)

    @property
    def gains(self) -> Float[np.ndarray, " base"]:
        """How many times smaller each standard deviation is than that of a random motion."""
        with np.errstate(invalid="ignore"):
            return deviations(self.reference.weighted) / self.standard_deviations

    @property
    def mean_gain(self) -> float:
        """Their geometric mean over the parameters that both motions determine; NaN if none."""
        gains = self.gains
        known = gains[np.isfinite(gains) & (gains > 0)]
        return float(np.exp(np.mean(np.log(known)))) if known.size else np.nan

    @property
    def use(self) -> Float[np.ndarray, "4 joints"]:
        """Share of the limits of position, velocity, acceleration and jerk, for all times."""
        return self.limits.use(self.numbers)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Base parameters that this motion cannot determine, each by the name that leads it.

        They take part in a combination that leaves no trace in the forces.
        """
        return self._named(~np.isfinite(self.standard_deviations))

    @property
    def vague(self) -> tuple[str, ...]:
        """Other base parameters whose deviation is above half of their nominal value."""
        relative = self.relative_deviations
        if relative is None:
            return ()
        return self._named((relative > VAGUE) & np.isfinite(self.standard_deviations))

    def _named(self, chosen: Bool[np.ndarray, " base"]) -> tuple[str, ...]:
        return tuple(name for name, k in zip(self.base.names, chosen, strict=True) if k)

    def to_csv(self, path: str | Path, *, sample_time: float | None = None) -> None:
        """Writes the motion as a table of samples; see `write_csv`.

        Args:
            path: Of the CSV file.
            sample_time: Largest time between two samples [s]; that of the experiment if None.
        """
        start, then = self.limits.basis.times(self.samples)[:2]
        step = float(then - start)
        with double_precision():
            write_csv(
                self.trajectory,
                self.base.model.robot,
                path,
                sample_time=step if sample_time is None else sample_time,
            )

    def save(self, path: str | Path) -> None:
        """Writes the trajectory itself, exact, as a JSON file for `load_trajectory`."""
        with double_precision():
            save_trajectory(jax.tree.map(np.asarray, self.trajectory), path)


def deviations(weighted: Float[AnyArray, "base base"]) -> Float[np.ndarray, " base"]:
    """Standard deviations from an information; infinite for what it does not determine."""
    weighted = np.asarray(weighted, np.float64)
    square = np.diag(weighted)
    scale = 1.0 / np.sqrt(np.where(square > 0, square, 1.0))
    values, U = np.linalg.eigh(scale[:, None] * weighted * scale[None])
    lost = values < SINGULAR * values[-1]
    variances = (U[:, ~lost] ** 2 / values[None, ~lost]).sum(axis=1)
    unknown = (U[:, lost] ** 2 > TAKES_PART**2).any(axis=1)
    return np.where(unknown, np.inf, scale * np.sqrt(variances))
