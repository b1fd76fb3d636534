"""Comparison of two fits: which parameters have changed (Sec. 6)."""

import enum
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Indices, Matrix, Texts, Vector
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    significant,
    with_deviations,
)

from .combination import require_same_base, without_bounds
from .fit_result import Fit
from .run_to_run import inverse_root
from .uncertainty import Uncertainty
from .uncertainty.result import dof_of_sum

LEVEL = 0.95
"""Confidence of intervals and tests."""


class Verdict(enum.Enum):
    """Verdict of a comparison about one parameter."""

    CHANGED = "changed"
    PERHAPS = "perhaps changed"
    UNCHANGED = "no change seen"
    UNKNOWN = "not determined"


class Comparison(Summarised, eqx.Module):
    r"""Differences of the base parameters of two fits, and their significance (Sec. 6).

    A parameter has changed if its difference is larger than its own uncertainty allows:
    $|b_1 - b_2| > t \sqrt{s_1^2 + s_2^2}$. That one lies outside the other's interval
    says less: two estimates of the same thing do so in one of six cases.

    Many parameters are tested, and each test errs now and then. `CHANGED` are those
    that stay significant with Holm's correction: if nothing has changed, the chance
    that *any* parameter is called so is at most 5 %. `PERHAPS` are those whose
    own interval excludes zero, as one in twenty does without any change.

    Attributes:
        first: Fit of one state.
        second: Fit of the other state.
        indices: Base parameters that are compared.
        difference: Parameters of the second fit less those of the first.
        uncertainty: Uncertainty of the differences.
    """

    first: Fit
    second: Fit
    indices: Indices = eqx.field(static=True)
    difference: Float[AnyArray, " compared"]
    uncertainty: Uncertainty

    @property
    def names(self) -> Texts:
        """Names of the parameters."""
        return self._select(self.first.base.names)

    @property
    def units(self) -> Texts:
        """Units of the parameters."""
        return self._select(self.first.base.units)

    @property
    def kinds(self) -> Texts:
        """Kind of each parameter, such as `viscous friction`."""
        return self._select(self.first.base.kinds)

    def _select(self, words: Sequence[str]) -> Texts:
        return tuple(words[k] for k in self.indices)

    @property
    def determined(self) -> Vector:
        """Which differences have a standard deviation."""
        return np.isfinite(self.standard_deviations)

    @property
    def standard_deviations(self) -> Vector:
        """Standard deviations of the differences; infinite where nothing is known."""
        return self.uncertainty.standard_deviations

    @property
    def half_widths(self) -> Vector:
        """Half the widths of the differences' intervals, each for itself."""
        return self.uncertainty.half_widths(LEVEL)

    @property
    def p_values(self) -> Vector:
        """Probability of so large a difference without any change, each for itself."""
        size = np.abs(self.difference) / self.standard_deviations
        return 2.0 * scipy.special.stdtr(self.uncertainty.dof, -size)

    @property
    def adjusted_p_values(self) -> Vector:
        """The same, with Holm's correction for the number of tested parameters."""
        p_values = np.ones(len(self.indices))
        p_values[self.determined] = _holm(self.p_values[self.determined])
        return p_values

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Verdict about each parameter."""
        chance = 1.0 - LEVEL
        verdicts = np.full(len(self.indices), Verdict.UNCHANGED)
        verdicts[self.p_values <= chance] = Verdict.PERHAPS
        verdicts[self.adjusted_p_values <= chance] = Verdict.CHANGED
        # The order matters: later verdicts replace earlier ones.
        verdicts[~self.determined] = Verdict.UNKNOWN
        return tuple(verdicts)

    @property
    def groups(self) -> list[dict[str, Any]]:
        """A joint test for each kind of parameter, with Holm's correction.

        Each has `name`, the number of determined `parameters`, the `statistic` (about
        that number where nothing has changed), its `p_value`, and whether the group has
        `changed`.
        """
        kinds = np.array(self.kinds)
        groups = []
        for name in dict.fromkeys(kinds.tolist()):
            members = np.flatnonzero(self.determined & (kinds == name))
            statistic, p_value = joint_test(
                self.difference[members],
                self.uncertainty.covariance[np.ix_(members, members)],
                float(np.min(self.uncertainty.dof[members], initial=np.inf)),
            )
            groups.append(
                {
                    "name": name,
                    "parameters": len(members),
                    "statistic": statistic,
                    "p_value": p_value,
                }
            )
        p_values = _holm(np.array([group["p_value"] for group in groups]))
        for group, p_value in zip(groups, p_values.tolist(), strict=True):
            group["changed"] = p_value <= 1.0 - LEVEL
        return groups

    def summary(self) -> Table:
        """Return a table of estimates, differences with intervals, and verdicts."""
        kinds = self.kinds
        verdicts = self.verdicts
        half_widths = self.half_widths
        differences, digits = with_deviations(self.difference, half_widths)
        estimates = []
        for fit in (self.first, self.second):
            values = fit.parameters[list(self.indices)]
            estimates.append(with_deviations(values, half_widths)[0])
        percent = f"{100 * LEVEL:g} %"
        return Table(
            f"{self.first.name} and {self.second.name}: {len(kinds)} base parameters",
            Column("parameter", self.names),
            Column("unit", self.units),
            Column(self.first.name, estimates[0], kind="number"),
            Column(self.second.name, estimates[1], kind="number"),
            Column("difference", _with_sign(differences), kind="number"),
            Column(f"± ({percent})", digits, kind="number"),
            Column("verdict", [verdict.value for verdict in verdicts]),
            status=[_status(verdict is Verdict.CHANGED) for verdict in verdicts],
            rules=[k for k in range(1, len(kinds)) if kinds[k] != kinds[k - 1]],
            remarks=self._remarks(),
        )

    def _remarks(self):
        """Return the numbers of changes, and those to expect by chance."""
        verdicts = self.verdicts
        tests = len(verdicts) - verdicts.count(Verdict.UNKNOWN)
        chance = 1.0 - LEVEL
        return [
            f"{verdicts.count(Verdict.CHANGED)} of {tests} parameters have changed. If "
            "none had, the probability of calling any of them changed would be "
            f"{100 * chance:.3g} % at most (Holm)",
            f"{verdicts.count(Verdict.PERHAPS)} more have perhaps changed: zero lies "
            f"outside the {100 * LEVEL:g} % interval of their difference. This happens "
            f"by chance to about {chance * tests:.2g} of {tests} parameters that do "
            "not change",
        ]

    def group_summary(self) -> Table:
        """Return a table of the joint test of each kind of parameter."""
        groups = self.groups
        chances = []
        verdicts = []
        for group in groups:
            p_value = group["p_value"]
            chances.append("< 1e-6" if p_value < 1e-6 else significant(p_value, 2))
            verdict = Verdict.CHANGED if group["changed"] else Verdict.UNCHANGED
            verdicts.append(verdict.value)
        return Table(
            "all parameters of a kind at once",
            Column("kind", [group["name"] for group in groups]),
            Column("parameters", [group["parameters"] for group in groups]),
            Column("probability\nby chance", chances, kind="number"),
            Column("verdict", verdicts),
            status=[_status(group["changed"]) for group in groups],
        )

    def overview(self) -> list[Table]:
        """Return the verdict, the parameters that have changed, and the kinds."""
        pairs = zip(self.names, self.verdicts, strict=True)
        names = [name for name, verdict in pairs if verdict is Verdict.CHANGED]
        kinds = self.group_summary()
        if names:
            kinds.remarks = (Remark(f"Changed: {', '.join(names)}"),)
        return [Table("", remarks=[self.verdict]), kinds]

    def tables(self) -> list[Table]:
        """Return the tables of the parameters, and of their kinds."""
        return [self.summary(), self.group_summary()]


def compare(first: Fit, second: Fit) -> Comparison:
    """Decide which base parameters have changed between two fits of one robot (Sec. 6).

    Of physically consistent fits the least squares behind them are compared.

    Args:
        first: Fit of one state, such as the cold robot.
        second: Fit of another state, such as the warm robot, with other recordings.

    Raises:
        InputError: If the fits are not of the same base parameters.
    """
    require_same_base((first, second))
    size = first.base.size
    # Errors of different recordings are independent: no cross-covariance.
    return compare_some(
        without_bounds(first),
        without_bounds(second),
        range(size),
        np.zeros((size, size)),
    )


def compare_some(
    first: Fit, second: Fit, indices: Sequence[int], cross: Matrix
) -> Comparison:
    """Compare base parameters of two fits whose estimates have a cross-covariance."""
    k = list(indices)
    first_covariance = first.covariance[np.ix_(k, k)]
    second_covariance = second.covariance[np.ix_(k, k)]
    # Infinite variances make numbers that are none.
    with np.errstate(invalid="ignore", divide="ignore"):
        covariance = first_covariance + second_covariance - cross - cross.T
        has_variance = np.diag(covariance) > 0
        np.fill_diagonal(
            covariance, np.where(has_variance, np.diag(covariance), np.inf)
        )
        dof = dof_of_sum(
            np.diag(first_covariance),
            np.diag(second_covariance),
            first.uncertainty.dof[k],
            second.uncertainty.dof[k],
        )
    return Comparison(
        first=first,
        second=second,
        indices=tuple(k),
        difference=second.parameters[k] - first.parameters[k],
        uncertainty=Uncertainty(covariance, dof, covariance),
    )


def _with_sign(numbers: Sequence[str]):
    """Return numbers with their signs, except those that are rounded to zero."""
    return [f"+{x}" if x[0] != "-" and float(x) else x for x in numbers]


def _status(has_changed: bool) -> Status:
    return Status.DOUBTFUL if has_changed else Status.NEUTRAL


def _holm(p: Vector) -> Vector:
    """Return p-values that are corrected for the number of tests."""
    # The smallest p-value counts for all tests, the next one for all others.
    order = np.argsort(p, kind="stable")
    products = p[order] * np.arange(len(p), 0, -1)
    p_values = np.ones_like(p)
    p_values[order] = np.minimum(np.maximum.accumulate(products), 1.0)
    return p_values


def joint_test(
    difference: AnyArray, covariance: AnyArray, dof: float
) -> tuple[float, float]:
    r"""Test if differences are more than chance: statistic and p-value.

    The statistic is $d^T C^{-1} d$.

    It is chi-squared where the covariance is exact, else Hotelling's $T^2$. All
    variances must be finite and above zero; without differences nothing has changed.
    """
    if not len(difference):
        return 0.0, 1.0
    deviations = np.sqrt(np.diag(covariance))
    # Units may differ by orders of magnitude: correlations do not.
    correlation = covariance / np.outer(deviations, deviations)
    root, size = inverse_root(np.asarray(correlation))
    statistic = float(np.sum((root @ (difference / deviations)) ** 2))
    if not np.isfinite(dof):
        return statistic, float(scipy.special.chdtrc(size, statistic))
    f_dof = dof - size + 1.0
    # With fewer degrees of freedom than differences nothing can be said.
    if f_dof <= 0:
        return statistic, 1.0
    f_ratio = statistic * f_dof / (dof * size)
    return statistic, float(scipy.special.fdtrc(size, f_dof, f_ratio))


def equality_test(
    estimates: Matrix, covariance: Matrix, dof: float
) -> tuple[float, float]:
    """Test if several estimates of the same parameters differ: statistic and p-value.

    Args:
        estimates: Estimates of the parameters [estimates, parameters].
        covariance: Covariance of all estimates, one after the other.
        dof: Degrees of freedom of the covariance.
    """
    count, size = estimates.shape
    # Differences to the first estimate are zero if all are equal.
    differences = np.eye(count)[1:] - np.eye(count)[:1]
    contrast = np.kron(differences, np.eye(size))
    return joint_test(
        contrast @ estimates.ravel(), contrast @ covariance @ contrast.T, dof
    )
