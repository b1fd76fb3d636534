"""A designed experiment: the motion, the expected deviations, and the use of the limits."""

import functools
import math
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.excitation.constraints import Finding
from jaxid.excitation.criteria import CRITERIA, AbstractCriterion
from jaxid.excitation.information import Information, standard_deviations
from jaxid.excitation.limits import JointLimits
from jaxid.table import Column, Remark, Status, Table, percent, significant
from jaxid.trajectory.files import save_trajectory, write_csv
from jaxid.trajectory.trajectory import LinearTrajectory

VAGUE = 0.5
"""Relative standard deviation above which a parameter counts as hardly determined."""


class Comparison(NamedTuple):
    """One criterion before and after the design.

    Attributes:
        name: Name of the criterion.
        before: Value for a random motion that fills the same limits: the median of the starts.
        after: Value for the designed motion.
    """

    name: str
    before: float
    after: float


class ExcitationPlan(eqx.Module):
    """Result of a design; `print(plan)` shows its tables.

    Attributes:
        base: Base parameters to be determined.
        trajectory: The motion.
        criterion: Criterion that was minimised.
        limits: Limits of the joints, with those that were assumed.
        information: Information of one run of the motion.
        reference: Information of a random motion that fills the same limits.
        noise: Assumed standard deviation of the forces' noise by joint [N m or N].
        samples: Number of measured samples of one run.
        findings: Use of the constraints beside the limits of the joints.
        nominal: Base parameters as far as they are known before, NaN where not; or None.
        interrupted: Whether the design was stopped before its end.
    """

    base: BaseParameters
    trajectory: LinearTrajectory
    criterion: AbstractCriterion
    limits: JointLimits
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
        """Sentences about the limits that are not kept; empty if all are."""
        return tuple(str(f) for f in self.findings if f.value > 0)

    @functools.cached_property
    def criteria(self) -> tuple[Comparison, ...]:
        """Values of all criteria for a random motion and for this one."""
        with double_precision():
            return tuple(
                Comparison(c.name, c.value(self.reference), c.value(self.information))
                for c in CRITERIA
            )

    @property
    def standard_deviations(self) -> Float[np.ndarray, " base"]:
        """Expected deviations of weighted least squares, in units of the parameters (Eq. 33).

        Infinite for undetermined parameters. The noise is assumed to be independent from sample to
        sample, with the standard deviations `noise`, and to be the only disturbance.
        """
        return standard_deviations(self.information.weighted)

    @property
    def relative_deviations(self) -> Float[np.ndarray, " base"] | None:
        """Standard deviations over the nominal parameters; NaN where those are unknown or zero."""
        if self.nominal is None:
            return None
        size = np.abs(np.asarray(self.nominal))
        return self.standard_deviations / np.where(size > 0, size, np.nan)

    @property
    def gains(self) -> Float[np.ndarray, " base"]:
        """Factor by which each standard deviation is smaller than that of a random motion."""
        with np.errstate(invalid="ignore"):
            return standard_deviations(self.reference.weighted) / self.standard_deviations

    @property
    def mean_gain(self) -> float:
        """Geometric mean of the gains of all parameters that both motions determine, or NaN."""
        gains = self.gains
        known = gains[np.isfinite(gains) & (gains > 0)]
        return float(np.exp(np.mean(np.log(known)))) if known.size else np.nan

    @property
    def use(self) -> Float[np.ndarray, "4 joints"]:
        """Used fraction of the limits of position, velocity, acceleration, jerk, at all times."""
        return self.limits.use(self.trajectory.coefficients)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Names of base parameters that this motion cannot determine.

        They take part in a combination that has no effect on the forces.
        """
        return self._names(~np.isfinite(self.standard_deviations))

    @property
    def vague(self) -> tuple[str, ...]:
        """Names of other base parameters whose deviation is above half of their nominal value."""
        relative = self.relative_deviations
        if relative is None:
            return ()
        return self._names((relative > VAGUE) & np.isfinite(self.standard_deviations))

    def summary(self) -> Table:
        """Return a table of all criteria, with what must be known of the design."""
        names = [row.name for row in self.criteria]
        remarks = [Remark(text, Status.BAD) for text in self.diagnosis]
        if self.undetermined:
            text = f"This motion does not determine: {', '.join(self.undetermined)}"
            remarks.append(Remark(text, Status.BAD))
        if self.interrupted:
            remarks.append(Remark("The design was stopped before its end", Status.DOUBTFUL))
        gain = f"Standard deviations are {self.mean_gain:.3g} times smaller than a random motion's"
        return Table(
            "criteria: smaller is better",
            Column("criterion", names),
            Column("random motion", [row.before for row in self.criteria]),
            Column("this motion", [row.after for row in self.criteria]),
            remarks=[gain, *remarks],
        )

    def tables(self) -> tuple[Table, ...]:
        """Return the tables of criteria, expected deviations, and use of the limits."""
        tables = self.summary(), self._deviation_table(), self._use_table()
        return (*tables, findings_table(self.findings)) if self.findings else tables

    def __str__(self) -> str:
        """Return all tables as text."""
        return "\n\n".join(map(str, self.tables()))

    def _deviation_table(self) -> Table:
        relative, status = self.relative_deviations, []
        columns = [
            Column("parameter", self.base.names),
            Column("±", self.standard_deviations),
            Column("unit", self.base.units),
            Column("better than\nrandom", self.gains, format=lambda gain: f"{gain:.2f}x"),
        ]
        if relative is not None:
            columns.append(Column("±", relative, "%", percent))
            status = [Status.BAD if r > VAGUE else Status.NEUTRAL for r in relative]
        return Table("standard deviations to expect", *columns, status=status)

    def _use_table(self) -> Table:
        kinds, use = ("range", "speed", "acceleration", "jerk"), self.use
        columns = [
            Column(kind, 100 * part, "%", lambda x: f"{x:.1f}")
            for kind, part in zip(kinds, use, strict=True)
            if (part > 0).any()
        ]
        names = Column("joint", self.base.model.robot.joint_names)
        return Table("use of the limits", names, *columns)

    def _names(self, chosen: Bool[np.ndarray, " base"]) -> tuple[str, ...]:
        return tuple(name for name, k in zip(self.base.names, chosen, strict=True) if k)

    def to_csv(self, path: str | Path, *, sample_time: float | None = None) -> None:
        """Write the motion as a table of samples; see `write_csv`.

        Args:
            path: Path of the CSV file.
            sample_time: Largest time between two samples [s]; that of the experiment if None.
        """
        start, then = self.limits.basis.times(self.samples)[:2]
        step = float(then - start) if sample_time is None else sample_time
        with double_precision():
            write_csv(self.trajectory, self.base.model.robot, path, sample_time=step)

    def save(self, path: str | Path) -> None:
        """Write the trajectory itself, exact, as a JSON file for `load_trajectory`."""
        with double_precision():
            save_trajectory(jax.tree.map(np.asarray, self.trajectory), path)


def findings_table(findings: tuple[Finding, ...] | list[Finding]) -> Table:
    """Return a table of how near a motion comes to the limits of constraints.

    Args:
        findings: Findings of the constraints.
    """
    limits = [f"{'≥' if f.least else '≤'} {f.limit:.4g} {f.unit}" for f in findings]
    return Table(
        "use of the other limits",
        Column("quantity", [f.name.removeprefix("the ") for f in findings]),
        Column("reaches", [f"{significant(f.reached, 4)} {f.unit}" for f in findings]),
        Column("limit", limits),
        Column("use", [100 * f.used for f in findings], "%", _use_text),
        Column("origin", [f.note for f in findings]),
        status=[Status.BAD if f.value > 0 else Status.NEUTRAL for f in findings],
    )


def _use_text(value: float) -> str:
    return f"{value:.1f}" if math.isfinite(value) else significant(math.nan)
