"""How often the 95 % intervals of this package hold, one log at a time.

Simulated robots: the truth lies in the interval. Measured robots with several logs: the
estimates of two logs differ by no more than both intervals allow; and the estimate of a
log lies in the interval that `jid.agreement` of the other logs predicts for it, which
contains what differs from log to log. Beside each, naive intervals of independent rows.
"""

import dataclasses
import itertools

import numpy as np

NORMAL = 1.96
"""Half-width of a 95 % interval in standard deviations."""


def logs_of(arm):
    """Return all logs of a robot; one that is divided in time is one log."""
    return list(dict.fromkeys([*arm.logs, *arm.unseen_logs]))


def fits_of(arm):
    """Return a fit of each log alone, named after it."""
    import jaxid as jid

    setup = arm.experiment().setup
    columns = arm.experiment().columns
    fits = []
    for log in logs_of(arm):
        fit = jid.identify_logs(setup, [log], columns).fit
        fits.append(dataclasses.replace(fit, name=log.stem))
    return fits


def half_widths(fit):
    """Return the half-widths of the intervals, and of naive ones."""
    lower, upper = np.asarray(fit.intervals()).T
    naive = NORMAL * np.asarray(fit.naive_standard_deviations)
    return np.stack([0.5 * (upper - lower), naive])


def shares_of_truth(fits, truth):
    """Return the shares of intervals, and of naive ones, that hold the truth."""
    inside = []
    for fit in fits:
        errors = np.abs(np.asarray(fit.parameters) - truth)
        inside.append(errors <= half_widths(fit))
    return np.mean(inside, axis=(0, 2)).tolist()


def shares_of_pairs(fits):
    """Return the shares of differences between logs that both intervals allow."""
    inside = []
    for first, second in itertools.combinations(fits, 2):
        differences = np.asarray(first.parameters) - np.asarray(second.parameters)
        allowed = np.hypot(half_widths(first), half_widths(second))
        inside.append(np.abs(differences) <= allowed)
    return np.mean(inside, axis=(0, 2)).tolist()


def share_of_predictions(fits):
    """Return the share of estimates within what the other logs predict for them."""
    from scipy.stats import t

    import jaxid as jid

    inside = []
    for fit in fits:
        pool = jid.agreement([x for x in fits if x is not fit])
        pooled_variances = np.diag(pool.uncertainty.covariance)
        own_variances = np.asarray(fit.standard_deviations) ** 2
        deviations = np.sqrt(pooled_variances + pool.spreads * own_variances)
        quantiles = t.ppf(0.975, np.maximum(pool.uncertainty.dof, 1.0))
        errors = np.abs(np.asarray(fit.parameters) - pool.parameters)
        inside.append(errors <= quantiles * deviations)
    return float(np.mean(inside))


def figures(arm):
    """Return the shares by name; none for a robot with one log and no truth."""
    if len(logs_of(arm)) < 2 and arm.machine is None:
        return {"logs": 1}
    fits = fits_of(arm)
    row = {"logs": len(fits), "parameters": int(fits[0].base.size)}
    if arm.machine is not None:
        from transients import truth

        values = truth(fits[0].base, arm.machine, arm.folder)
        row["truth"] = shares_of_truth(fits, values)
    if len(fits) >= 2:
        row["pairs"] = shares_of_pairs(fits)
    if len(fits) >= 3:
        row["predicted"] = share_of_predictions(fits)
    return row
