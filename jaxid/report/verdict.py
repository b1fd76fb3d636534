"""Whether a model is good, in plain words, with the thresholds that decide."""

from collections.abc import Sequence

import numpy as np

from jaxid.identification.excited import LARGEST_UNCERTAINTY
from jaxid.identification.fit import DOUBTFUL, TRUSTED, Fit, Trust
from jaxid.report.blocks import Remark, Tone
from jaxid.report.numbers import percent, significant
from jaxid.validation import Definiteness, TorqueErrors

ACCURATE, TOLERABLE = 1.0, 3.0
"""Mean errors up to which forces are predicted well, or tolerably [% of the largest forces]."""
ACCURATE_SHARE, TOLERABLE_SHARE = 0.05, 0.15
"""The same for RMS errors where the largest forces are not known, in RMS forces, of 1."""
ALIKE, UNLIKE = 1.5, 3.0
"""Errors on new motions, relative to those of the fit, that are usual, or still tolerable."""
LARGE_CONDITION = 1e3
"""Condition number, with scaled columns, above which parameters are hard to tell apart."""
NEARLY_WHITE = 2.0
"""Departure from white residuals, in what chance allows, that needs no word of warning."""


def verdict(
    fit: Fit,
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    definiteness: Definiteness,
    doubts: Sequence[str] = (),
) -> tuple[Remark, ...]:
    """What to think of a model: one sentence for all, then one for each thing that was looked at.

    Args:
        fit: The model.
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen.
        definiteness: Of the mass matrix.
        doubts: About the logs, in sentences.
    """
    found = [
        _forces(verification or identification, bool(verification)),
        *_new_motions(identification, verification),
        _determined(fit),
        _known(fit),
        _definite(definiteness),
        *_residuals(fit),
        _condition(fit),
        *_bounds(fit),
        *(Remark(Tone.DOUBTFUL, _stopped(doubt)) for doubt in dict.fromkeys(doubts)),
    ]
    tones = [remark.tone for remark in found]
    if Tone.BAD in tones:
        whole = Remark(Tone.BAD, "Do not rely on this model yet: what is marked ✗ comes first.")
    elif Tone.DOUBTFUL in tones:
        whole = Remark(
            Tone.DOUBTFUL, "A usable model; look at what is marked ! before you rely on it."
        )
    else:
        whole = Remark(Tone.GOOD, "A good model: nothing that was looked at speaks against it.")
    return (whole, *found)


def _graded(value: float, good: float, tolerable: float) -> Tone:
    if value <= good:
        return Tone.GOOD
    return Tone.DOUBTFUL if value <= tolerable else Tone.BAD


def _forces(recordings: Sequence[TorqueErrors], unseen: bool) -> Remark:
    on = "logs that the fit has not seen" if unseen else "the logs of the fit"
    average = max(float(np.mean(e.mean_percent)) for e in recordings)
    if np.isfinite(average):
        worst = max(float(np.max(e.mean_percent)) for e in recordings)
        return Remark(
            _graded(average, ACCURATE, TOLERABLE),
            f"On {on}, forces are predicted to {significant(average, 2)} % of the largest forces, "
            f"averaged over the joints; the worst joint to {significant(worst, 2)} %.",
            f"Mean |e| (Eq. 37). Good: up to {ACCURATE:g} %, as in the paper; "
            f"tolerable: up to {TOLERABLE:g} %.",
        )
    shares = [float(np.nanmean(e.rms_relative)) for e in recordings]
    return Remark(
        _graded(max(shares), ACCURATE_SHARE, TOLERABLE_SHARE),
        f"On {on}, the RMS error is {percent(max(shares))} % of the RMS force, averaged over the "
        "joints.",
        f"Good: up to {100 * ACCURATE_SHARE:g} %; tolerable: up to {100 * TOLERABLE_SHARE:g} %. "
        "The largest forces of the joints are not known.",
    )


def _new_motions(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors]
) -> list[Remark]:
    if not verification:
        text = "The model was tried on no log that it has not seen: use `--verify` or `--split`."
        return [Remark(Tone.DOUBTFUL, text)]
    if not identification:
        return []
    # Joint by joint, so that large joints do not hide small ones.
    fitted, unseen = (
        np.sqrt(np.mean([np.asarray(e.rms) ** 2 for e in group], axis=0))
        for group in (identification, verification)
    )
    ratios = unseen / np.where(fitted > 0, fitted, np.nan)
    ratio = float(np.nanmax(ratios)) if np.isfinite(ratios).any() else 1.0
    return [
        Remark(
            _graded(ratio, ALIKE, UNLIKE),
            f"RMS errors on unseen logs are up to {significant(ratio, 3)} times those of the fit.",
            f"Good: up to {ALIKE:g} times; tolerable: up to {UNLIKE:g} times. More means that the "
            "new motion needs what the fit's logs did not show.",
        )
    ]


def _determined(fit: Fit) -> Remark:
    rule = (
        "A combination counts as undetermined if it leaves more than "
        f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open."
    )
    count = len(fit.undetermined)
    if not count:
        return Remark(Tone.GOOD, f"The logs determine all {fit.base.size} base parameters.", rule)
    text = (
        f"The logs leave {count} combination{'' if count == 1 else 's'} of the "
        f"{fit.base.size} base parameters undetermined; they are listed below."
    )
    return Remark(Tone.BAD, text, rule)


def _known(fit: Fit) -> Remark:
    good, fair, poor = (
        fit.trust.count(level) for level in (Trust.GOOD, Trust.DOUBTFUL, Trust.NONE)
    )
    return Remark(
        Tone.PLAIN,
        f"{good} of {fit.base.size} parameters are known to {100 * TRUSTED:g} %, {fair} more to "
        f"{100 * DOUBTFUL:g} %; {poor} are small, or not excited.",
        "Standard deviation over estimate. A parameter near zero is never known to a few percent, "
        "and that is no fault: look at its interval.",
    )


def _definite(definiteness: Definiteness) -> Remark:
    rule = f"Smallest eigenvalue: {significant(definiteness.smallest)} in SI units (Sec. 5)."
    if definiteness.positive_definite:
        text = f"The mass matrix is positive definite in all {definiteness.poses} random poses."
        return Remark(Tone.GOOD, text, rule)
    return Remark(
        Tone.BAD,
        f"The mass matrix is not positive definite in {percent(definiteness.indefinite)} % of "
        f"{definiteness.poses} random poses: do not simulate or control with this model where "
        "the joints were not moved.",
        rule,
    )


def _residuals(fit: Fit) -> list[Remark]:
    spectra = fit.residual_spectra
    if spectra is None:
        return []
    joints, white = len(spectra.white), sum(spectra.white)
    rule = (
        f"Bartlett's test: white residuals depart from a straight line by less than "
        f"{percent(spectra.limit)} % nineteen times in twenty. Intervals take it into account "
        "that neighbouring errors are alike."
    )
    largest = float(np.max(np.asarray(spectra.departure))) / spectra.limit
    if white == joints:
        return [Remark(Tone.GOOD, "What the model leaves over looks like noise.", rule)]
    if largest <= NEARLY_WHITE:
        text = f"What the model leaves over looks nearly like noise (white: {white} of {joints})."
        return [Remark(Tone.PLAIN, text, rule)]
    text = (
        f"What the model leaves over is no white noise for {joints - white} of {joints} joints: "
        "some effect is not in the model, or the noise itself is coloured."
    )
    return [Remark(Tone.DOUBTFUL, text, rule)]


def _condition(fit: Fit) -> Remark:
    number = fit.condition_numbers.scaled
    easy = number < LARGE_CONDITION
    text = f"The condition number with columns of length one is {significant(number, 3)}"
    return Remark(
        Tone.GOOD if easy else Tone.DOUBTFUL,
        f"{text}." if easy else f"{text}: some parameters are hard to tell apart.",
        f"Good: below {LARGE_CONDITION:g}.",
    )


def _bounds(fit: Fit) -> list[Remark]:
    if fit.consistency is None:
        return []
    active = fit.consistency.active
    if not active:
        return [Remark(Tone.GOOD, "All bodies could exist, and no bound had to decide.")]
    text = f"All bodies could exist; {len(active)} of their bounds decide: {'; '.join(active)}."
    return [Remark(Tone.PLAIN, text)]


def _stopped(sentence: str) -> str:
    upper = sentence[:1].upper() + sentence[1:]
    return upper if upper.endswith((".", "?", "!")) else f"{upper}."
