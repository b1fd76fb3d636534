"""A designed experiment: motion, expected deviations, use of the limits."""

import enum
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float, Texts, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.open_directions import (
    OPEN_SHARES,
    UndeterminedDirection,
    open_directions,
    random_rows,
    status_of,
)
from jaxid.result_table import (
    MISSING,
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    percent,
    significant,
)
from jaxid.robot.limits_and_drives import Limits
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import driven_robot
from jaxid.trajectory.files import save_trajectory
from jaxid.trajectory.motion_on_feet import MotionOnFeet
from jaxid.trajectory.trajectory import LinearTrajectory

from .constraints import Finding
from .criteria import CRITERIA, AbstractCriterion, Information, standard_deviations
from .criteria.information_matrix import (
    RANK_TOLERANCE,
    BaseVector,
    JointVector,
    scale_to_unit_diagonal,
)

INTERVAL = 1.96
"""Half a 95 % interval over the standard deviation."""
USUAL_NOISE = 0.01
"""Noise over the largest forces, where nothing else is known."""
MAX_NAMED = 3
"""Combinations that are left open and named, the weakest ones."""
MAX_RUNS = 10
"""Runs of one motion that a user may repeat; above, another motion is better."""


class DesignStatus(enum.StrEnum):
    """How a design ended; `ExcitationPlan.feasible` says whether it keeps limits."""

    CONVERGED = "the last quarter of its steps hardly improved the motion"
    IMPROVING = "the last quarter of its steps still improved the motion"
    STOPPED = "stopped before its end"
    GIVEN = "found by a solver of your own"


MIN_IMPROVEMENT = 2e-3
"""Relative improvement in the last quarter of the steps of a converged design."""


def progress_status(history: Sequence[float]) -> DesignStatus:
    """Return whether the last quarter of the steps improved the motion."""
    earlier_value = history[len(history) - 1 - len(history) // 4]
    is_improving = history[-1] < (1.0 - MIN_IMPROVEMENT) * earlier_value
    return DesignStatus.IMPROVING if is_improving else DesignStatus.CONVERGED


class DesignProgress(NamedTuple):
    """Progress of a design.

    Attributes:
        fraction: Completed fraction, from 0 to 1.
        task: Present task, in words.
        best: Value of the criterion for the best motion so far that keeps all limits,
            or of the best of all if none does; infinite where none is known yet.
        feasible: Whether it keeps all limits.
        trajectory: That motion.
    """

    fraction: float
    task: str
    best: float
    feasible: bool
    trajectory: LinearTrajectory | MotionOnFeet


class Comparison(NamedTuple):
    """A criterion's name, and its values for a random motion and for the design."""

    name: str
    before: float
    after: float


class ExcitationPlan(Summarised, eqx.Module):
    """Result of a design; `print(plan)` shows its tables.

    Attributes:
        base: Base parameters to be determined.
        trajectory: The motion.
        criterion: Criterion that was minimised.
        limits: Limits of the joints, with those that were assumed.
        assumed: Fields of the limits and joints (from 0) whose numbers were not given.
        use: Used fraction of the limits of position, speed, acceleration and jerk.
        information: Information of one run of the motion.
        reference: Information of a random motion that keeps the same limits, as far as
            any was found: the median of the motions from which the search started; the
            first one of a robot on its feet.
        noise: Assumed standard deviation of the forces' noise by joint [N m or N].
        samples: Number of measured samples of one run.
        findings: Use of the constraints beside the limits of the joints.
        status: How the design ended.
        history: Value of the criterion for the best motion, before the first step and
            after each.
        parameters: Nominal values of the base parameters; None if nothing is known.
    """

    base: BaseParameters
    trajectory: LinearTrajectory | MotionOnFeet
    criterion: AbstractCriterion
    limits: Limits
    assumed: tuple[tuple[str, int], ...] = eqx.field(static=True)
    use: Float[AnyArray, "4 joints"]
    information: Information
    reference: Information
    noise: JointVector
    samples: int = eqx.field(static=True)
    findings: tuple[Finding, ...]
    status: DesignStatus = eqx.field(static=True)
    history: Float[AnyArray, " steps"]
    parameters: BaseVector | None = None

    @property
    def interrupted(self) -> bool:
        """Whether the design was stopped before its end."""
        return self.status is DesignStatus.STOPPED

    @property
    def feasible(self) -> bool:
        """Whether all limits are kept."""
        return not self.diagnosis

    @property
    def diagnosis(self) -> Texts:
        """Sentences about the limits that are not kept; empty if all are."""
        return tuple(str(f) for f in self.findings if f.value > 0)

    @functools.cached_property
    def criteria(self) -> tuple[Comparison, ...]:
        """Values of all criteria for a random motion and for this one."""
        comparisons = []
        with double_precision():
            for criterion in CRITERIA.values():
                reference_value = criterion.value(self.reference)
                value = criterion.value(self.information)
                comparisons.append(Comparison(criterion.name, reference_value, value))
        return tuple(comparisons)

    @property
    def standard_deviations(self) -> BaseVector:
        """Expected deviations of weighted least squares (Eq. 33).

        Infinite for undetermined parameters. The noise is assumed to be independent
        from sample to sample, with the standard deviations `noise`, and to be the only
        disturbance.
        """
        return standard_deviations(self.information.weighted)

    @property
    def gains(self) -> BaseVector:
        """Factors by which standard deviations are below those of a random motion."""
        reference = standard_deviations(self.reference.weighted)
        with np.errstate(invalid="ignore"):
            return reference / self.standard_deviations

    @property
    def mean_gain(self) -> float:
        """Geometric mean of the gains of what both motions determine, or NaN."""
        gains = self.gains
        is_determined = np.isfinite(gains) & (gains > 0)
        if not is_determined.any():
            return np.nan
        return float(np.exp(np.mean(np.log(gains[is_determined]))))

    @property
    def robot(self) -> Robot:
        """Robot of the joints that move: of one on its feet, those that are driven."""
        return driven_robot(self.base.model.robot)

    @functools.cached_property
    def undetermined(self) -> tuple[UndeterminedDirection, ...]:
        """Combinations that one run leaves open, by the rule of `jaxid identify`.

        Its 95 % interval makes more than a tenth of the forces of random motions
        uncertain: of the forces by nominal parameters, or of the largest forces, which
        are 100 times the usual noise, where nothing is known of those.
        """
        matrix, scale = scale_to_unit_diagonal(np.asarray(self.information.weighted))
        squares, directions = np.linalg.eigh(matrix)
        has_information = squares >= RANK_TOLERANCE * squares[-1]
        values = np.sqrt(np.where(has_information, squares, 0.0))
        with np.errstate(divide="ignore"):
            half_widths = INTERVAL / values
        with double_precision():
            largest_forces = np.asarray(self.noise) / USUAL_NOISE
            rows = random_rows(self.base, self.parameters, largest_forces)
        return open_directions(directions.T, 1.0 / scale, values, half_widths, rows)

    @property
    def open_share(self) -> float:
        """Largest share of the forces of random motions that is left open."""
        return max(
            (direction.uncertainty for direction in self.undetermined), default=0
        )

    @property
    def determination(self) -> list[Remark]:
        """Combinations that one run leaves open, by the rule of `jaxid identify`."""
        count = len(self.undetermined)
        if not count:
            return []
        size = self.base.size
        runs = (self.open_share / OPEN_SHARES.doubtful) ** 2
        cure = "some of which it does not move at all"
        if math.isfinite(runs):
            cure = (
                f"which make up to {percent(self.open_share)} % of the forces of "
                f"other motions uncertain: {math.ceil(runs)} runs of this motion "
                f"determine all, or one with {runs**-0.5:.2g} times the assumed noise"
            )
            if runs > MAX_RUNS:
                cure = f"{cure}; a longer search (`--time`) may find a better motion"
        combinations = "1 combination" if count == 1 else f"{count} combinations"
        text = f"One run leaves {combinations} of {size} parameters open, {cure}"
        remarks = [Remark(text, status_of(self.open_share))]
        for direction in self.undetermined[:MAX_NAMED]:
            text = f"left open: {direction.sentence(self.base)}"
            remarks.append(Remark(text, status_of(direction.uncertainty)))
        return remarks

    @property
    def occasion(self) -> str:
        """When the limits of the joints were compared with the motion."""
        if self.base.model.robot.floating:
            return "at the instants that were checked"
        return "at all times"

    def tables(self) -> tuple[Table, ...]:
        """Return the tables of criteria, expected deviations, and use of the limits."""
        tables = (
            self._criteria_table(),
            self._deviations_table(),
            self._limits_table(),
        )
        if not self.findings:
            return tables
        return (*tables, _findings_table(self.findings))

    def _criteria_table(self):
        """Return the table of criteria."""
        names, reference_values, values = zip(*self.criteria, strict=True)
        return Table(
            f"criteria; this motion was designed for: {self.criterion.name}",
            Column("criterion", names),
            Column("random motion", reference_values),
            Column("this motion", values),
        )

    def _deviations_table(self):
        """Return the table of expected deviations."""
        base = self.base
        return Table(
            "expected standard deviations",
            Column("parameter", base.names),
            Column("±", self.standard_deviations),
            Column("unit", base.units),
            Column("better than\nrandom", self.gains, "factor", "{:.2f}".format),
        )

    def _limits_table(self):
        """Return the table of the use of the limits that are finite."""
        columns = [Column("joint", self.robot.joint_names)]
        kinds = ("position", "speed", "acceleration", "jerk")
        for kind, use in zip(kinds, self.use, strict=True):
            if (use > 0).any():
                columns.append(Column(kind, 100 * use, "%", "{:.1f}".format))
        return Table(f"use of the limits, {self.occasion}", *columns)

    @property
    def remarks(self) -> list[Remark]:
        """Gain of the design, limits that are exceeded, undetermined parameters."""
        gain = self.mean_gain
        remark = Remark(
            f"Standard deviations are {gain:.3g} times smaller than a random motion's"
        )
        if gain < 1.0:
            text = (
                f"Standard deviations are {1.0 / gain:.3g} times those of a random "
                "motion within the same limits: search longer (`--resume`)"
            )
            remark = Remark(text, Status.DOUBTFUL)
        remarks = [remark]
        remarks += [Remark(text, Status.BAD) for text in self.diagnosis]
        remarks += self.determination
        if self.interrupted:
            text = "The design was stopped early"
            remarks.append(Remark(text, Status.DOUBTFUL))
        if self.status is DesignStatus.IMPROVING:
            text = (
                "The last steps still improved the motion: "
                "more `generations` may find a better one"
            )
            remarks.append(Remark(text))
        return remarks

    def __str__(self) -> str:
        """Return all tables as text, and what must be known of the design."""
        return "\n\n".join(map(str, (*self.tables(), Table("", remarks=self.remarks))))

    def save(self, path: str | Path) -> None:
        """Write the trajectory itself, exact, as a JSON file for `load_trajectory`."""
        with double_precision():
            save_trajectory(jax.tree.map(np.asarray, self.trajectory), path)


def _findings_table(findings: tuple[Finding, ...]):
    """Return a table of how near a motion comes to the limits of constraints."""
    quantities = []
    values = []
    limits = []
    fractions = []
    for finding in findings:
        sign = "≥" if finding.is_lower_limit else "≤"
        fraction = finding.used
        quantities.append(finding.name.removeprefix("the "))
        values.append(f"{significant(finding.reached, 4)} {finding.unit}")
        limits.append(f"{sign} {finding.limit:.4g} {finding.unit}")
        is_number = math.isfinite(fraction)
        fractions.append(f"{100 * fraction:.1f}" if is_number else MISSING)
    notes = [finding.note for finding in findings]
    note_columns = [Column("made of", notes)] if any(notes) else []
    return Table(
        "use of the other limits, at the instants that were checked",
        Column("quantity", quantities),
        Column("reaches", values),
        Column("limit", limits),
        Column("use", fractions, "%", kind="number"),
        *note_columns,
        status=[Status.BAD if x.value > 0 else Status.GOOD for x in findings],
    )
