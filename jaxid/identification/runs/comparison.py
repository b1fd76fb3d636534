"""Which parameters have changed between two runs (Sec. 6)."""

import enum

import equinox as eqx
import numpy as np
from scipy import stats

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.errors import InputError
from jaxid.identification.fit import Fit
from jaxid.identification.runs.estimates import Estimates
from jaxid.table import Column, Status, Table, significant, with_deviations

LEVEL = 0.95
"""Confidence of intervals and tests."""
INDEPENDENT = 1e-12
"""Share of the largest eigenvalue below which a direction of a correlation matrix is rounding."""


class Verdict(enum.Enum):
    """Verdict of a comparison about one parameter."""

    CHANGED = "changed"
    PERHAPS = "perhaps changed"
    UNCHANGED = "no change seen"
    UNKNOWN = "not determined"


class GroupChange(eqx.Module):
    """Whether any parameter of a group has changed.

    Attributes:
        name: Name of the group.
        size: Number of its parameters that both runs determine.
        statistic: Squared length of the differences in their own standard deviations; about `size`
            where nothing has changed.
        p_value: Chance of so large a statistic where nothing has changed, of 1.
        changed: Whether that chance is too small.
    """

    name: str = eqx.field(static=True)
    size: int = eqx.field(static=True)
    statistic: float
    p_value: float
    changed: bool


class Comparison(eqx.Module):
    r"""Two sets of estimates, their differences, and what is more than chance (Sec. 6).

    A parameter has changed if its difference is larger than its own uncertainty allows:
    $|b_1 - b_2| > t \sqrt{s_1^2 + s_2^2}$. That one lies outside the other's interval says less:
    two estimates of the same thing do so in one of six cases.

    Many parameters are tested, and each test errs now and then. `CHANGED` are those that stay
    significant with Holm's correction: if nothing has changed, the chance that *any* parameter is
    called so is at most `1 - level`. `PERHAPS` are those whose own interval leaves zero out, as one
    in twenty does without any change.

    Attributes:
        first: Estimates of one run.
        second: Estimates of the other.
        difference: The second's parameters less the first's.
        covariance: Covariance of the differences.
        freedom: Degrees of freedom of their standard deviations.
        level: Confidence of intervals and tests, a fraction from 0 to 1.
    """

    first: Estimates
    second: Estimates
    difference: Float[AnyArray, " parameters"]
    covariance: Float[AnyArray, "parameters parameters"]
    freedom: Float[AnyArray, " parameters"]
    level: float = eqx.field(static=True)

    @classmethod
    def of(
        cls,
        first: Estimates,
        second: Estimates,
        level: float = LEVEL,
        cross: Float[AnyArray, "parameters parameters"] | None = None,
    ) -> "Comparison":
        """Compares estimates of the same parameters.

        Args:
            first: Estimates of one run.
            second: Estimates of another run.
            level: Confidence of intervals and tests, a fraction from 0 to 1.
            cross: Covariance of the first with the second estimates; None if they come from
                different data.

        Raises:
            InputError: If the parameters are not the same, or `level` is no share.
        """
        if not 0 < level < 1:
            raise InputError(f"`level` must lie between 0 and 1, like 0.95, but is {level:g}.")
        _require_same(first, second)
        a, b = np.asarray(first.covariance), np.asarray(second.covariance)
        with np.errstate(invalid="ignore"):
            covariance = a + b
            if cross is not None:
                covariance = covariance - np.asarray(cross) - np.asarray(cross).T
        return cls(
            first=first,
            second=second,
            difference=np.asarray(second.parameters) - np.asarray(first.parameters),
            covariance=covariance,
            freedom=_pooled(first, second),
            level=level,
        )

    @property
    def determined(self) -> Bool[np.ndarray, " parameters"]:
        """Which differences have a standard deviation."""
        variances = np.diag(self.covariance)
        return np.isfinite(variances) & (variances > 0)

    @property
    def standard_deviations(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of the differences; infinite where nothing is known."""
        variances = np.diag(self.covariance)
        return np.where(self.determined, np.sqrt(np.where(self.determined, variances, 1.0)), np.inf)

    @property
    def half_widths(self) -> Float[np.ndarray, " parameters"]:
        """Half the widths of the differences' intervals, each for itself."""
        quantile = stats.t.ppf(0.5 + 0.5 * self.level, np.asarray(self.freedom))
        return quantile * self.standard_deviations

    @property
    def p_values(self) -> Float[np.ndarray, " parameters"]:
        """Chance of so large a difference without any change, of 1, each for itself."""
        size = np.abs(np.asarray(self.difference)) / self.standard_deviations
        return 2.0 * stats.t.sf(size, np.asarray(self.freedom))

    @property
    def adjusted_p_values(self) -> Float[np.ndarray, " parameters"]:
        """The same with Holm's correction for the number of parameters that are tested."""
        p, tested = self.p_values, np.flatnonzero(self.determined)
        order = tested[np.argsort(p[tested], kind="stable")]
        adjusted = np.ones_like(p)
        steps = p[order] * np.arange(len(order), 0, -1)
        adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
        return adjusted

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Verdict about each parameter."""
        largest = 1.0 - self.level
        rows = zip(self.determined, self.p_values, self.adjusted_p_values, strict=True)
        return tuple(
            Verdict.UNKNOWN
            if not known
            else Verdict.CHANGED
            if adjusted <= largest
            else Verdict.PERHAPS
            if alone <= largest
            else Verdict.UNCHANGED
            for known, alone, adjusted in rows
        )

    @property
    def groups(self) -> tuple[GroupChange, ...]:
        """A joint test for each kind of parameter, with Holm's correction for their number."""
        names = tuple(dict.fromkeys(self.first.groups))
        members = [
            np.flatnonzero(self.determined & (np.array(self.first.groups) == name))
            for name in names
        ]
        found = [self.jointly(own) for own in members]
        order = np.argsort([p for _, p in found], kind="stable")
        changed, left = np.zeros(len(names), bool), len(names)
        for k in order:
            if not found[k][1] * left <= 1.0 - self.level:
                break
            changed[k], left = True, left - 1
        rows = zip(names, members, found, changed, strict=True)
        return tuple(GroupChange(n, len(m), s, p, bool(c)) for n, m, (s, p), c in rows)

    def jointly(self, chosen: np.ndarray) -> tuple[float, float]:
        """Tests some parameters at once: statistic and chance, of 1.

        Args:
            chosen: Indices of the parameters.
        """
        if not len(chosen):
            return 0.0, 1.0
        return joint_test(
            np.asarray(self.difference)[chosen],
            np.asarray(self.covariance)[np.ix_(chosen, chosen)],
            float(np.min(np.asarray(self.freedom)[chosen])),
        )

    def summary(self) -> Table:
        """Return a table of both estimates, their differences with intervals, and verdicts."""
        first, second, verdicts = self.first, self.second, self.verdicts
        half = self.half_widths
        a, _ = with_deviations(first.parameters, half)
        b, _ = with_deviations(second.parameters, half)
        change, _ = with_deviations(self.difference, half)
        _, width = with_deviations(np.zeros(len(half)), half)
        groups, level = first.groups, self.level
        tested = len(verdicts) - verdicts.count(Verdict.UNKNOWN)
        return Table(
            f"{first.label} and {second.label}: {len(first.names)} base parameters",
            Column("#", list(range(1, len(half) + 1))),
            Column("parameter", first.names),
            Column("unit", first.units),
            Column(first.label, a, kind="number"),
            Column(second.label, b, kind="number"),
            Column(
                "difference", [x if x.startswith("-") else f"+{x}" for x in change], kind="number"
            ),
            Column(f"± ({100 * level:g} %)", width, kind="number"),
            Column("verdict", [verdict.value for verdict in verdicts]),
            status=[Status.DOUBTFUL if v is Verdict.CHANGED else Status.NEUTRAL for v in verdicts],
            rules=[k for k in range(1, len(groups)) if groups[k] != groups[k - 1]],
            remarks=[
                f"{verdicts.count(Verdict.CHANGED)} of {tested} parameters have changed: if none "
                "had, the chance to call any of them so would be "
                f"{100 * (1 - level):.3g} % at most (Holm)",
                f"{verdicts.count(Verdict.PERHAPS)} more have perhaps changed: zero lies outside "
                f"the {100 * level:g} % interval of their difference; of {tested} parameters that "
                f"never change, about {(1 - level) * tested:.2g} look so",
            ],
        )

    def group_summary(self) -> Table:
        """Return a table of the joint test of each kind of parameter."""
        groups = self.groups
        verdicts = [Verdict.CHANGED if g.changed else Verdict.UNCHANGED for g in groups]
        chances = ["< 1e-6" if g.p_value < 1e-6 else significant(g.p_value, 2) for g in groups]
        return Table(
            "all parameters of a kind at once",
            Column("kind", [g.name for g in groups]),
            Column("parameters", [g.size for g in groups]),
            Column("statistic", [float(g.statistic) for g in groups]),
            Column("chance\nwithout a change", chances, kind="number"),
            Column("verdict", [v.value for v in verdicts]),
            status=[Status.DOUBTFUL if g.changed else Status.NEUTRAL for g in groups],
        )

    def __str__(self) -> str:
        return f"{self.summary()}\n\n{self.group_summary()}"


def joint_test(
    difference: Float[AnyArray, " tested"],
    covariance: Float[AnyArray, "tested tested"],
    freedom: float,
) -> tuple[float, float]:
    r"""Tests by $d^T C^{-1} d$ if differences are more than chance: statistic, and chance, of 1.

    It is chi-squared where the covariance is exact, else Hotelling's $T^2$.

    Args:
        difference: Differences of estimates.
        covariance: Covariance of the differences, with finite variances above zero.
        freedom: Degrees of freedom of the covariance.
    """
    d, C = np.asarray(difference), np.asarray(covariance)
    deviations = np.sqrt(np.diag(C))
    correlation = C / deviations / deviations[:, None]
    values, directions = np.linalg.eigh(0.5 * (correlation + correlation.T))
    kept = values > INDEPENDENT * values[-1]
    along = directions.T @ (d / deviations)
    statistic = float(np.sum(along[kept] ** 2 / values[kept]))
    size = int(np.count_nonzero(kept))
    if not np.isfinite(freedom):
        return statistic, float(stats.chi2.sf(statistic, size))
    rest = freedom - size + 1.0
    if rest <= 0:
        return statistic, 1.0
    return statistic, float(stats.f.sf(statistic * rest / (freedom * size), size, rest))


def compare(first: Fit, second: Fit, level: float = LEVEL) -> Comparison:
    """Decides which base parameters have changed between two fits of one robot (Sec. 6).

    Args:
        first: Fit of one run, such as that of the cold robot.
        second: Fit of another run, such as that of the warm robot; of other recordings.
        level: Confidence of intervals and tests, a fraction from 0 to 1.

    Raises:
        InputError: If the fits are not of the same base parameters, or `level` is no share.
    """
    a, b = np.asarray(first.base.kappa), np.asarray(second.base.kappa)
    if first.base.indices == second.base.indices and not (
        a.shape == b.shape and np.allclose(a, b, rtol=1e-6, atol=1e-9)
    ):
        raise InputError(
            "both fits must be of the same base parameters, but the lengths in them differ: use "
            "one geometry for both."
        )
    return Comparison.of(Estimates.of(first), Estimates.of(second), level)


def _require_same(first: Estimates, second: Estimates) -> None:
    if len(first.names) != len(second.names):
        raise InputError(
            f"both runs must have the same base parameters, but `{first.label}` has "
            f"{len(first.names)} and `{second.label}` has {len(second.names)}: identify both with "
            "one robot and the same terms."
        )
    columns = (
        (first.names, second.names),
        (first.expressions, second.expressions),
        (first.units, second.units),
    )
    for one, other in columns:
        for a, b in zip(one, other, strict=True):
            if a != b:
                raise InputError(
                    f"both runs must have the same base parameters, but `{first.label}` has `{a}` "
                    f"where `{second.label}` has `{b}`: identify both with one robot and the same "
                    "terms."
                )


def _pooled(first: Estimates, second: Estimates) -> Float[np.ndarray, " parameters"]:
    """Degrees of freedom of the sums of two variances (Welch, Satterthwaite)."""
    parts = [(np.diag(e.covariance), np.asarray(e.freedom)) for e in (first, second)]
    with np.errstate(invalid="ignore", divide="ignore"):
        whole = sum(v for v, _ in parts)
        freedom = whole**2 / sum(v**2 / n for v, n in parts)
    return np.where(np.isnan(freedom), np.inf, freedom)
