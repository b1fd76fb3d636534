"""Agreement of several results of one robot: odd runs, and a pooled estimate."""

import contextlib
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.errors import InputError
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    significant,
    with_deviation,
    with_deviations,
)

from .combination import require_same_base, without_bounds
from .fit_result import Fit
from .operating_states import stores_energy
from .payload import body_columns
from .run_to_run import (
    THRESHOLDS,
    Drift,
    KindFactors,
    OddRun,
    Run,
    drifts,
    excess,
    kind_factors,
    odd_runs,
    pooled_estimate,
)
from .uncertainty import Uncertainty

LOAD = "load"
FRICTION = "friction"
GAIN = "gain of "
"""Causes of an odd run; a gain stands before the name of its joint."""
ALL_FORCES = "gain of all joints"


class HasRun(Protocol):
    """Result of one run whose estimates can be compared with those of others."""

    @property
    def run(self) -> Run:
        """The estimates of the run."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class Agreement(Summarised):
    """Several runs of one robot side by side.

    Attributes:
        runs: Estimates of all runs, in the order in which they were given.
        odd: Runs that differ from the others; they are left out of the pooled estimate.
        drifts: Kinds of parameters that change steadily from run to run.
        factors: Common factor of all parameters of a kind in each run.
        parameters: Pooled estimates of the runs that agree.
        uncertainty: Its uncertainty, with the variance between runs.
        spreads: Squared spread between runs of each parameter, relative to that which
            the intervals of the runs explain.
        excess: Typical squared departure of a run from the others, likewise, over all
            parameters and their correlations.
    """

    runs: tuple[Run, ...]
    odd: tuple[OddRun, ...]
    drifts: tuple[Drift, ...]
    factors: KindFactors
    parameters: Vector
    uncertainty: Uncertainty
    spreads: Vector
    excess: float

    @property
    def names(self) -> Texts:
        """Names of the parameters."""
        return self.runs[0].names

    @property
    def units(self) -> Texts:
        """Units of the parameters."""
        return self.runs[0].units

    @property
    def kinds(self) -> Texts:
        """Kind of each parameter, such as `viscous friction`."""
        return self.runs[0].kinds

    @property
    def odd_names(self) -> Texts:
        """Names of the runs that differ from the others."""
        return tuple(x.run for x in self.odd)

    def intervals(self) -> Matrix:
        """Return 95 % intervals of the pooled estimates, variance of runs included."""
        half_widths = self.uncertainty.half_widths()
        ends = (self.parameters - half_widths, self.parameters + half_widths)
        return np.stack(ends, axis=1)

    @property
    def verdict(self) -> Remark:
        """Whether the runs agree, and which estimate to use."""
        count = len(self.runs)
        if self.odd:
            names = ", ".join(f"`{name}`" for name in self.odd_names)
            verb = "differs" if len(self.odd) == 1 else "differ"
            return Remark(
                f"{count - len(self.odd)} of {count} runs agree; {names} {verb}. The "
                "pooled estimate is that of the runs that agree",
                Status.DOUBTFUL,
            )
        if self.excess > THRESHOLDS.max_excess:
            text = "The runs differ by more than their intervals allow: use the pooled"
            return Remark(f"{text} estimate", Status.DOUBTFUL)
        return Remark(f"All {count} runs agree within their intervals", Status.GOOD)

    @property
    def findings(self) -> list[Remark]:
        """Sentences on odd runs, and on what drifts."""
        sentences = [self._sentence(x) for x in self.odd]
        for drift in self.drifts:
            change, half_width = with_deviation(
                100 * drift.change, 100 * drift.half_width
            )
            sentences.append(
                f"{drift.kind.capitalize()} changes steadily, by {change} ± "
                f"{half_width} % from the first run to the last: does the robot warm "
                "up, or was it one day after another?"
            )
        if self.excess > THRESHOLDS.max_excess:
            sentences.append(
                f"Runs differ {significant(np.sqrt(self.excess), 2)} times as much as "
                "their own intervals say: do not rely on the intervals of one run. "
                "Those of the pooled estimate include these differences"
            )
        remarks = [Remark(text, Status.DOUBTFUL) for text in sentences]
        if len(self.runs) < THRESHOLDS.min_runs_for_odd:
            text = "Two runs cannot tell which of them is odd: add a third"
            remarks.append(Remark(text))
        return remarks

    def _sentence(self, odd: OddRun) -> str:
        """Return what makes a run odd."""
        cause = odd.cause
        if not cause.name:
            return (
                f"`{odd.run}` differs from the other runs, and neither a load, nor a "
                "gain, nor friction alone explains it"
            )
        size = cause.sizes[0]
        half_width = cause.half_widths[0]
        if cause.name == LOAD:
            more = "more" if size > 0 else "less"
            mass, width = with_deviation(abs(size), half_width)
            return (
                f"`{odd.run}` carries {mass} ± {width} kg {more} at the end-effector "
                "than the other runs"
            )
        if cause.name == FRICTION:
            return f"Friction of `{odd.run}` differs: {self._friction_words(odd.run)}"
        # The change is relative to the odd run's own forces: 1 - 1 / gain.
        change = 100 * abs(size) / (1 - size)
        change, width = with_deviation(change, 100 * half_width / (1 - size) ** 2)
        larger = "larger" if size > 0 else "smaller"
        joint = cause.name.removeprefix(GAIN)
        return (
            f"The torque of {joint} in `{odd.run}` is {change} ± {width} % {larger} "
            "than in the other runs: was a gain or a torque constant changed?"
        )

    def _friction_words(self, run: str) -> str:
        """Return the changes of the kinds of friction in a run, in percent."""
        number = [x.name for x in self.runs].index(run)
        words = []
        for k, kind in enumerate(self.factors.kinds):
            if kind.endswith("friction"):
                change = 100 * (self.factors.factors[number, k] - 1)
                words.append(f"{kind} by {change:+.0f} %")
        return ", ".join(words) + ": was the robot colder or warmer?"

    def summary(self) -> Table:
        """Return a table of the runs: the common factor of each kind of parameters."""
        factors = self.factors
        columns = []
        for k, kind in enumerate(factors.kinds):
            changes = 100 * (factors.factors[:, k] - 1)
            texts, widths = with_deviations(changes, 100 * factors.deviations[:, k])
            cells = [f"{x} ± {y}" for x, y in zip(texts, widths, strict=True)]
            columns.append(Column(kind.replace(" ", "\n"), cells, "%"))
        names = [run.name for run in self.runs]
        odd_names = self.odd_names
        statuses = [
            Status.DOUBTFUL if name in odd_names else Status.NEUTRAL for name in names
        ]
        return Table(
            "runs, relative to the pooled estimate, ± standard deviation",
            Column("run", names),
            *columns,
            status=statuses,
            remarks=self.findings,
        )

    def parameter_table(self) -> Table:
        """Return a table of the pooled estimates and the spread between runs."""
        half_widths = self.uncertainty.half_widths()
        estimates, widths = with_deviations(self.parameters, half_widths)
        kinds = self.kinds
        return Table(
            "pooled estimates; intervals include the variance between runs",
            Column("parameter", self.names),
            Column("estimate", estimates, kind="number"),
            Column("± (95 %)", widths, kind="number"),
            Column("unit", self.units),
            Column(
                "spread between runs\nover own intervals",
                np.sqrt(self.spreads),
                format=lambda x: significant(x, 2),
            ),
            rules=[k for k in range(1, len(kinds)) if kinds[k] != kinds[k - 1]],
        )

    def overview(self) -> list[Table]:
        """Return the runs, the findings and the verdict."""
        return [self.summary(), Table("", remarks=[self.verdict])]

    def tables(self) -> list[Table]:
        """Return the table of the runs, the pooled estimates, and the verdict."""
        verdict = Table("", remarks=[self.verdict])
        return [self.summary(), self.parameter_table(), verdict]


def agreement(results: Sequence[Fit | HasRun | Run]) -> Agreement:
    """Compare results of several runs of one robot, and pool those that agree.

    A run is odd if it differs from the others by more than their intervals allow, or,
    where the runs differ anyway, by more than they do from each other. A load, the
    friction, the gain of one joint or of all are tried as its cause. Of physically
    consistent fits the least squares behind them are compared.

    Args:
        results: Fits, results of rollouts or calibrations, in the order of the runs,
            with different names.

    Raises:
        InputError: If there are fewer than two results, two have one name, or their
            parameters differ.
    """
    fits = [x for x in results if isinstance(x, Fit)]
    if fits:
        require_same_base(fits)
    runs = [_as_run(result) for result in results]
    names = [run.name for run in runs]
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            "`results` must be two or more runs with different names, but are: "
            f"{', '.join(names)}."
        )
    for run in runs[1:]:
        if run.names != runs[0].names:
            differing_names = sorted({*run.names} ^ {*runs[0].names}) or ["the order"]
            raise InputError(
                f"`{runs[0].name}` and `{run.name}` have different parameters "
                f"({differing_names[0]}): identify them with one model."
            )
    odd = odd_runs(runs)
    odd_names = {x.run for x in odd}
    agreeing_runs = [run for run in runs if run.name not in odd_names]
    kinds = runs[0].kinds
    parameters, uncertainty, spreads = pooled_estimate(agreeing_runs, kinds)
    return Agreement(
        runs=tuple(runs),
        odd=tuple(odd),
        drifts=tuple(drifts(kind_factors(agreeing_runs, parameters, kinds))),
        factors=kind_factors(runs, parameters, kinds),
        parameters=parameters,
        uncertainty=uncertainty,
        spreads=spreads,
        excess=excess(agreeing_runs),
    )


def _as_run(result: Fit | HasRun | Run) -> Run:
    """Return the estimates of a result, and how causes would change them."""
    if isinstance(result, Run):
        return result
    if not isinstance(result, Fit):
        return result.run
    fit = without_bounds(result)
    base = fit.base
    return Run(
        name=fit.name,
        names=base.names,
        units=base.units,
        kinds=base.kinds,
        parameters=fit.parameters,
        covariance=fit.covariance,
        dof=float(np.median(fit.uncertainty.dof)),
        causes=_causes(fit),
    )


def _causes(fit: Fit) -> Mapping[str, Matrix]:
    """Return how a load, friction and gains would change the estimates of a fit."""
    base = fit.base
    unit_vectors = np.eye(base.size)
    causes = {ALL_FORCES: fit.parameters[:, None]}
    has_friction = ~stores_energy(base)
    if has_friction.any():
        causes[FRICTION] = unit_vectors[:, has_friction]
    # A model without the ten parameters of the last body sees no load.
    with contextlib.suppress(InputError):
        changes = body_columns(base, base.model.robot.tip_body)
        causes[LOAD] = changes[:, changes.any(axis=0)]
    for name, change in zip(
        base.model.robot.joint_names, _gain_changes(fit), strict=True
    ):
        causes[f"{GAIN}`{name}`"] = change[:, None]
    return causes


def _gain_changes(fit: Fit) -> list[Vector]:
    """Return the change of the estimates by a gain of each joint's forces."""
    factors = fit.time_blocks.total
    R, _ = factors.weighted(fit.weights)
    inverse = np.linalg.pinv(R.T @ R)
    changes = []
    for joint, weight in zip(factors.joints, fit.weights, strict=True):
        right_side = np.zeros(factors.size)
        rows = weight * joint.R
        right_side[list(joint.columns)] = rows[:, :-1].T @ rows[:, -1]
        changes.append(inverse @ right_side)
    return changes
