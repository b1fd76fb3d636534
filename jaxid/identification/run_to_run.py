r"""Statistics of several runs: odd ones, common factors of kinds, pooled estimates.

Run $s$ has the estimates $p_s = \mu + b_s + e_s$. The covariance of the error $e_s$ is
that of its fit; $b_s$ is the deviation of the run, such as that of a warmer day.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Float, Matrix, Texts, Vector

from .uncertainty import Uncertainty
from .uncertainty.result import rescale_covariance

LEVEL = 0.95
"""Confidence of intervals."""


class AgreementThresholds(NamedTuple):
    """When runs disagree: chances are those of a fleet in which nothing differs."""

    max_chance: float = 0.01  # of calling any run odd, or any kind drifting
    max_excess: float = 1.5  # of squared departures, where intervals explain them
    min_runs_for_odd: int = 3
    min_runs_for_drift: int = 5


THRESHOLDS = AgreementThresholds()


class Run(NamedTuple):
    """Estimates of one run, and how causes would change them."""

    name: str
    names: Texts  # names of the parameters
    units: Texts
    kinds: Texts  # kind of each parameter, such as `viscous friction`
    parameters: Vector
    covariance: Matrix  # infinite variances where nothing is known
    dof: float  # typical degrees of freedom of the variances
    # For each cause the changes of the parameters [parameters, unknowns] by it.
    causes: Mapping[str, Matrix] = {}


Runs = Sequence[Run]


class Departure(NamedTuple):
    """Difference of a run from the mean of others, whose correlations are removed."""

    difference: Vector  # in standard deviations, uncorrelated
    whitening: Matrix  # from parameters to those [parameters, parameters]
    size: int  # number of directions that are determined
    dof: float

    @property
    def mean_square(self) -> float:
        """Mean squared departure; about 1 if intervals explain it."""
        return float(self.difference @ self.difference) / self.size


class Cause(NamedTuple):
    """Explanation of an odd run by few numbers."""

    name: str  # key of the cause; empty if none explains the run
    sizes: Vector  # unknowns of the cause
    half_widths: Vector  # half the widths of their 95 % intervals


class OddRun(NamedTuple):
    """A run that differs from the others by more than chance explains."""

    run: str
    chance: float  # probability of such a difference by chance
    cause: Cause


class Drift(NamedTuple):
    """A kind of parameters that changes steadily from the first run to the last."""

    kind: str
    change: float  # relative to the pooled value
    half_width: float  # half the width of its 95 % interval


class KindFactors(NamedTuple):
    """Common factor of all parameters of a kind in each run, 1 for the pooled ones."""

    kinds: Texts
    factors: Float[np.ndarray, "runs kinds"]
    deviations: Float[np.ndarray, "runs kinds"]  # standard deviations


def departure(run: Run, others: Runs) -> Departure:
    """Return the difference of a run from the mean of others."""
    mean = np.mean([other.parameters for other in others], axis=0)
    covariance = run.covariance.copy()
    for other in others:
        covariance += other.covariance / len(others) ** 2

    variances = np.diag(covariance)
    is_determined = np.isfinite(variances)
    places = np.ix_(is_determined, is_determined)
    deviations = np.sqrt(variances[is_determined])
    correlation = covariance[places] / np.outer(deviations, deviations)
    root, size = inverse_root(correlation)

    whitening = np.zeros(covariance.shape)
    whitening[places] = root / deviations
    difference = whitening @ (run.parameters - mean)
    dof = float(np.median([run.dof, *(other.dof for other in others)]))
    return Departure(difference, whitening, size, dof)


def inverse_root(correlation: Matrix) -> tuple[Matrix, int]:
    """Return the symmetric inverse root of a correlation, and its rank.

    A symmetric root turns nothing: directions of different runs are alike.
    """
    variances, axes = np.linalg.eigh(0.5 * (correlation + correlation.T))
    # Smaller eigenvalues are rounding.
    is_sound = variances > 1e-10 * variances[-1]
    sound_axes = axes[:, is_sound]
    root = (sound_axes / np.sqrt(variances[is_sound])) @ sound_axes.T
    return root, int(is_sound.sum())


def excess(runs: Runs) -> float:
    """Return the typical mean squared departure of runs from each other, at least 1."""
    if len(runs) < 2:
        return 1.0
    squares = [departure(run, without(runs, run)).mean_square for run in runs]
    return max(1.0, np.median(squares))


def without(runs: Runs, run: Run) -> list[Run]:
    """Return all runs but one."""
    return [other for other in runs if other is not run]


def chance_of_departure(run: Run, others: Runs) -> float:
    """Return the probability that a run differs so much from the others by chance.

    Where the others agree within their intervals, these say what chance can do. Where
    they do not, the others themselves are the only measure.
    """
    x = departure(run, others)
    size = float(x.size)
    dof = x.dof
    others_excess = excess(others)
    if others_excess > THRESHOLDS.max_excess:
        size = directions_of_scatter(others)
        dof = size * (len(others) - 1)
    return float(scipy.special.fdtrc(size, dof, x.mean_square / others_excess))


def directions_of_scatter(runs: Runs) -> float:
    """Return in about how many directions runs differ: 1 if always in the same one."""
    differences = [departure(run, without(runs, run)).difference for run in runs]
    variances = np.linalg.svd(np.array(differences), compute_uv=False) ** 2
    return float(variances.sum() ** 2 / np.sum(variances**2))


def odd_runs(runs: Runs) -> list[OddRun]:
    """Return the runs that differ from the others, the least likely ones first.

    The least likely run is taken away as long as it is unlikely, and most runs remain.
    Each is then explained by its difference from those that remain.
    """
    agreeing_runs = list(runs)
    chances = {}
    min_runs = max(2, len(runs) // 2)
    while len(agreeing_runs) >= max(THRESHOLDS.min_runs_for_odd, min_runs + 1):
        probabilities = [
            chance_of_departure(run, without(agreeing_runs, run))
            for run in agreeing_runs
        ]
        least = int(np.argmin(probabilities))
        if probabilities[least] * len(agreeing_runs) > THRESHOLDS.max_chance:
            break
        run = agreeing_runs.pop(least)
        chances[run.name] = probabilities[least]
    odd = []
    for run in runs:
        if run.name in chances:
            cause = explain(run, agreeing_runs)
            odd.append(OddRun(run.name, chances[run.name], cause))
    return sorted(odd, key=lambda x: x.chance)


def explain(run: Run, others: Runs) -> Cause:
    """Return the cause that explains the difference of a run with fewest numbers."""
    x = departure(run, others)
    scale = excess(others)
    total = x.difference @ x.difference / scale
    best = Cause("", np.zeros(0), np.zeros(0))
    # Each unknown must pay for itself, as in the Bayesian information criterion.
    best_score = total
    for name, changes in run.causes.items():
        columns = x.whitening @ changes
        sizes, _, rank, _ = np.linalg.lstsq(columns, x.difference, rcond=1e-9)
        if rank < changes.shape[1]:
            continue
        rest = x.difference - columns @ sizes
        score = rest @ rest / scale + rank * np.log(x.size)
        if score < best_score:
            best_score = score
            covariance = scale * np.linalg.inv(columns.T @ columns)
            quantile = scipy.special.stdtrit(x.dof, 0.5 + 0.5 * LEVEL)
            best = Cause(name, sizes, quantile * np.sqrt(np.diag(covariance)))
    return best


def pooled_estimate(runs: Runs, kinds: Texts) -> tuple[Vector, Uncertainty, Vector]:
    """Return the mean of runs, its uncertainty, and their spread for each parameter.

    The spread is relative to that which the runs' own intervals explain. Few runs
    hardly tell the variance of one parameter: it is shrunk towards that of all
    parameters of its kind, as far as these are alike (G. K. Smyth, "Linear models and
    empirical Bayes methods for assessing differential expression", 2004).
    """
    estimates = np.array([run.parameters for run in runs])
    variances = np.array([np.diag(run.covariance) for run in runs])
    correlation = _mean_correlation(runs)
    size = len(kinds)
    means = np.zeros(size)
    deviations = np.full(size, np.inf)
    dof = np.ones(size)
    spreads = np.full(size, np.nan)
    for kind in dict.fromkeys(kinds):
        members = np.array([x == kind for x in kinds])
        group = np.flatnonzero(members)
        pool = _pool_kind(
            estimates[:, group], variances[:, group], correlation[np.ix_(group, group)]
        )
        means[group], deviations[group], dof[group], spreads[group] = pool
    covariance = rescale_covariance(correlation, deviations)
    return means, Uncertainty(covariance, dof, covariance), spreads


def _pool_kind(estimates: Matrix, variances: Matrix, correlation: Matrix):
    """Return means, standard deviations, degrees of freedom, and spreads of a kind."""
    information = 1.0 / variances
    counts = np.count_nonzero(information, axis=0)
    typical_variances = counts / np.maximum(information.sum(axis=0), 1e-300)
    # What runs deviate beyond their own errors makes their weights more equal.
    _, ratios = _weighted_spread(estimates, information)
    between = 0.0
    if (counts > 1).any():
        between = max(0.0, np.nanmean(ratios) - 1.0)
    weights = 1.0 / (variances + between * typical_variances)
    means, ratios = _weighted_spread(estimates, weights)

    run_dof = np.maximum(counts - 1.0, 0.0)
    shared, shared_dof = _shared_variance(ratios, run_dof, correlation)
    total_dof = run_dof + shared_dof
    own_part = run_dof * np.nan_to_num(ratios)
    spreads = (own_part + shared_dof * shared) / total_dof
    total_weights = np.maximum(weights.sum(axis=0), 1e-300)
    deviations = np.sqrt(spreads / total_weights)
    return means, np.where(counts > 0, deviations, np.inf), total_dof, spreads


def _weighted_spread(estimates: Matrix, weights: Matrix) -> tuple[Vector, Vector]:
    """Return weighted means over runs, and mean squared deviations in their units."""
    totals = np.maximum(weights.sum(axis=0), 1e-300)
    means = np.sum(weights * estimates, axis=0) / totals
    squares = np.sum(weights * (estimates - means) ** 2, axis=0)
    dof = np.count_nonzero(weights, axis=0) - 1.0
    ratios = np.where(dof > 0, squares / np.maximum(dof, 1.0), np.nan)
    return means, ratios


def _shared_variance(
    ratios: Vector, dof: Vector, correlation: Matrix
) -> tuple[float, float]:
    """Return the variance that parameters of a kind share, and its degrees of freedom.

    These say how alike the variances are: none where each differs from the others.
    """
    is_known = dof > 0
    ratios = np.maximum(ratios[is_known], 1e-12)
    if len(ratios) < 2:
        return 1.0, 0.0
    half_dof = 0.5 * dof[is_known]
    logarithms = np.log(ratios) - scipy.special.digamma(half_dof) + np.log(half_dof)
    scatter = np.var(logarithms, ddof=1)
    unexplained_scatter = scatter - np.mean(scipy.special.polygamma(1, half_dof))
    # Correlated estimates tell the variance less often than their number says.
    known_correlation = correlation[np.ix_(is_known, is_known)]
    independent_count = len(ratios) ** 2 / np.sum(known_correlation**2)
    max_dof = np.mean(dof[is_known]) * max(0.0, independent_count - 1.0)
    shared_dof = float(max_dof)
    if unexplained_scatter > 0:
        likeness = 2.0 * _inverse_trigamma(unexplained_scatter)
        shared_dof = min(shared_dof, likeness)
    return float(np.mean(ratios)), shared_dof


def _inverse_trigamma(value: float) -> float:
    """Return the argument at which the trigamma function has a value."""
    return float(
        scipy.optimize.brentq(
            lambda x: scipy.special.polygamma(1, x) - value, 1e-3, 1e6
        )
    )


def _mean_correlation(runs: Runs) -> Matrix:
    """Return the mean correlation of the errors of estimates."""
    correlations = []
    for run in runs:
        deviations = np.sqrt(np.diag(run.covariance))
        is_determined = np.isfinite(deviations) & (deviations > 0)
        scale = np.where(
            is_determined, 1.0 / np.where(is_determined, deviations, 1.0), 0
        )
        finite_part = np.where(np.isfinite(run.covariance), run.covariance, 0.0)
        correlation = finite_part * np.outer(scale, scale)
        np.fill_diagonal(correlation, 1.0)
        correlations.append(correlation)
    return np.mean(correlations, axis=0)


def kind_factors(runs: Runs, pool: Vector, kinds: Texts) -> KindFactors:
    """Return by which factor each run changes all parameters of a kind.

    All factors of a run are estimated together, by the covariance of the run.
    """
    names = tuple(dict.fromkeys(kinds))
    columns = np.array([[x == kind for kind in names] for x in kinds]) * pool[:, None]
    exact = np.zeros((len(pool), len(pool)))
    origin = runs[0]._replace(parameters=0.0 * pool, covariance=exact, dof=np.inf)
    factors = []
    deviations = []
    for run in runs:
        x = departure(run, [origin])
        system = x.whitening @ columns
        values = np.linalg.lstsq(system, x.difference, rcond=1e-9)[0]
        rest = x.difference - system @ values
        scale = max(1.0, rest @ rest / max(1, x.size - len(values)))
        variances = scale * np.diag(np.linalg.pinv(system.T @ system))
        factors.append(values)
        deviations.append(np.sqrt(variances))
    return KindFactors(names, np.array(factors), np.array(deviations))


def drifts(factors: KindFactors) -> list[Drift]:
    """Return the kinds whose factor changes steadily, in the order of the runs."""
    count = len(factors.factors)
    if count < THRESHOLDS.min_runs_for_drift:
        return []
    # From -0.5 at the first run to 0.5 at the last: the slope is the whole change.
    order = np.linspace(-0.5, 0.5, count)
    steady_changes = []
    for k, kind in enumerate(factors.kinds):
        # Runs may not determine the factor of a kind, such as that of values of zero.
        if not np.all(factors.deviations[:, k] > 0):
            continue
        weights = 1.0 / factors.deviations[:, k]
        columns = np.stack([np.ones(count), order], axis=1) * weights[:, None]
        values = factors.factors[:, k] * weights
        solution = np.linalg.lstsq(columns, values, rcond=None)[0]
        rest = values - columns @ solution
        dof = count - 2
        scale = rest @ rest / dof
        covariance = scale * np.linalg.inv(columns.T @ columns)
        deviation = np.sqrt(covariance[1, 1])
        chance = 2.0 * scipy.special.stdtr(dof, -abs(solution[1]) / deviation)
        if chance * len(factors.kinds) <= THRESHOLDS.max_chance:
            quantile = scipy.special.stdtrit(dof, 0.5 + 0.5 * LEVEL)
            half_width = float(quantile * deviation)
            steady_changes.append(Drift(kind, float(solution[1]), half_width))
    return steady_changes
