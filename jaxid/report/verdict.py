"""Verdict on a model in plain words, with the thresholds that decide."""

from collections.abc import Sequence

import numpy as np

from jaxid.identification.estimators.solutions import LARGEST_UNCERTAINTY
from jaxid.identification.fit import DOUBTFUL, TRUSTED, Fit
from jaxid.table import Remark, Status, percent, significant
from jaxid.validation import Definiteness, TorqueErrors

MEAN_ERROR = (1.0, 3.0)
"""Mean errors up to which forces are predicted well, and tolerably [% of the largest forces]."""
RMS_ERROR = (0.05, 0.15)
"""RMS errors that are good, and tolerable, as fractions of the RMS forces."""
UNSEEN_RATIO = (1.5, 3.0)
"""Errors on new motions, relative to those of the fit, that are good, and tolerable."""
LARGE_CONDITION = 1e3
"""Condition number, with scaled columns, above which parameters are hard to tell apart."""


def verdict(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    doubts: Sequence[str] = (),
) -> list[Remark]:
    """Return the verdict on a model: one sentence for everything, then one for each criterion.

    Args:
        fit: Model to judge.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Definiteness of the mass matrix.
        doubts: Doubts about the logs, in sentences.
    """
    found = [
        _judge_forces(verification or identification, bool(verification)),
        *_judge_new_motions(identification, verification),
        _judge_determination(fit),
        _judge_precision(fit),
        definiteness_remark(definiteness),
        *_judge_residuals(fit),
        _judge_condition(fit),
        *_judge_bodies(fit),
        *(
            Remark(doubt[:1].upper() + doubt[1:], Status.DOUBTFUL)
            for doubt in dict.fromkeys(doubts)
        ),
    ]
    statuses = [remark.status for remark in found]
    if Status.BAD in statuses:
        whole = Remark("Do not rely on this model yet: what is marked ✗ comes first.", Status.BAD)
    elif Status.DOUBTFUL in statuses:
        text = "A usable model; look at what is marked ! before you rely on it."
        whole = Remark(text, Status.DOUBTFUL)
    else:
        text = "A good model: all criteria below are met."
        whole = Remark(text, Status.GOOD)
    return [whole, *found]


def _grade(value: float, limits: tuple[float, float]) -> Status:
    good, tolerable = limits
    if value <= good:
        return Status.GOOD
    return Status.DOUBTFUL if value <= tolerable else Status.BAD


def _judge_forces(recordings: Sequence[TorqueErrors], unseen: bool) -> Remark:
    on = "logs that the fit has not seen" if unseen else "the logs of the fit"
    average = max(float(np.mean(e.mean_percent)) for e in recordings)
    if np.isfinite(average):
        worst = max(float(np.max(e.mean_percent)) for e in recordings)
        good, tolerable = MEAN_ERROR
        return Remark(
            f"On {on}, forces are predicted to {significant(average, 2)} % of the largest forces, "
            f"averaged over the joints; the worst joint to {significant(worst, 2)} %.",
            _grade(average, MEAN_ERROR),
            f"Mean |e| (Eq. 37). Good: up to {good:g} %, as in the paper; "
            f"tolerable: up to {tolerable:g} %.",
        )
    worst = max(float(np.nanmean(e.rms_relative)) for e in recordings)
    good, tolerable = (100 * limit for limit in RMS_ERROR)
    return Remark(
        f"On {on}, the RMS error is {percent(worst)} % of the RMS force, averaged over the joints.",
        _grade(worst, RMS_ERROR),
        f"Good: up to {good:g} %; tolerable: up to {tolerable:g} %. The largest forces of the "
        "joints are not known.",
    )


def _judge_new_motions(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors]
) -> list[Remark]:
    if not verification:
        text = "The model was not validated on an unseen log: use `--verify` or `--split`."
        return [Remark(text, Status.DOUBTFUL)]
    if not identification:
        return []
    # Joint by joint, so that large joints do not hide small ones.
    fitted, unseen = (
        np.sqrt(np.mean([np.asarray(e.rms) ** 2 for e in group], axis=0))
        for group in (identification, verification)
    )
    ratios = unseen / np.where(fitted > 0, fitted, np.nan)
    ratio = float(np.nanmax(ratios)) if np.isfinite(ratios).any() else 1.0
    good, tolerable = UNSEEN_RATIO
    return [
        Remark(
            f"RMS errors on unseen logs are up to {significant(ratio, 3)} times those of the fit.",
            _grade(ratio, UNSEEN_RATIO),
            f"Good: up to {good:g} times; tolerable: up to {tolerable:g} times. More means that "
            "the new motion needs what the fit's logs did not show.",
        )
    ]


def _judge_determination(fit: Fit) -> Remark:
    rule = (
        "A combination counts as undetermined if it leaves more than "
        f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open."
    )
    count = len(fit.undetermined)
    if not count:
        text = f"The logs determine all {fit.base.size} base parameters."
        return Remark(text, Status.GOOD, rule)
    text = (
        f"The logs leave {count} combination{'' if count == 1 else 's'} of the "
        f"{fit.base.size} base parameters undetermined; they are listed below."
    )
    return Remark(text, Status.BAD, rule)


def _judge_precision(fit: Fit) -> Remark:
    good, fair, poor = map(fit.trust.count, (Status.GOOD, Status.DOUBTFUL, Status.BAD))
    return Remark(
        f"{good} of {fit.base.size} parameters are known to {100 * TRUSTED:g} %, {fair} more to "
        f"{100 * DOUBTFUL:g} %; {poor} are small, or not excited.",
        Status.NEUTRAL,
        "Standard deviation over estimate. A parameter near zero is never known to a few percent, "
        "and that is no fault: look at its interval.",
    )


def definiteness_remark(definiteness: Definiteness) -> Remark:
    """Return whether the mass matrix is positive definite, as a sentence."""
    rule = f"Smallest eigenvalue: {significant(definiteness.smallest)} in SI units (Sec. 5)."
    if definiteness.positive_definite:
        text = f"The mass matrix is positive definite in all {definiteness.poses} random poses."
        return Remark(text, Status.GOOD, rule)
    text = (
        f"The mass matrix is not positive definite in {percent(definiteness.indefinite)} % of "
        f"{definiteness.poses} random poses: do not simulate or control with this model where "
        "the joints were not moved."
    )
    return Remark(text, Status.BAD, rule)


def _judge_residuals(fit: Fit) -> list[Remark]:
    spectra = fit.residual_spectra
    if spectra is None:
        return []
    joints, white = len(spectra.white), sum(spectra.white)
    rule = (
        f"Bartlett's test: the cumulative spectrum of white residuals departs from a straight "
        f"line by less than {percent(spectra.limit)} % in 95 % of cases. The intervals account "
        "for correlated residuals."
    )
    largest = float(np.max(np.asarray(spectra.departure))) / spectra.limit
    if white == joints:
        return [Remark("The residuals are white noise.", Status.GOOD, rule)]
    if largest <= 2.0:
        text = f"The residuals are nearly white noise (white: {white} of {joints} joints)."
        return [Remark(text, Status.NEUTRAL, rule)]
    text = (
        f"The residuals are not white noise for {joints - white} of {joints} joints: some effect "
        "is not in the model, or the noise itself is coloured."
    )
    return [Remark(text, Status.DOUBTFUL, rule)]


def _judge_condition(fit: Fit) -> Remark:
    number = fit.condition_numbers.scaled
    rule = f"Good: below {LARGE_CONDITION:g}."
    text = f"The condition number with columns of length one is {significant(number, 3)}"
    if number < LARGE_CONDITION:
        return Remark(text, Status.GOOD, rule)
    return Remark(f"{text}: some parameters are hard to tell apart.", Status.DOUBTFUL, rule)


def _judge_bodies(fit: Fit) -> list[Remark]:
    if fit.consistency is None:
        return []
    active = fit.consistency.active
    if not active:
        text = "All bodies are physically consistent, and no bound is active."
        return [Remark(text, Status.GOOD)]
    text = f"All bodies are physically consistent; {len(active)} bounds are active"
    return [Remark(f"{text}: {'; '.join(active)}.")]
