"""Search for the mistake that explains most of what a model misses."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Texts
from jaxid.dynamics.model import Model
from jaxid.identification.delay import Delay
from jaxid.measurement.observations import Progress
from jaxid.measurement.recording import Recording
from jaxid.result_table import percent

from .commands import are_exchanged
from .common_delay import common_delay
from .contacts import Contact, concentration, find_contact
from .descriptions import MAX_FRICTION_SHARE, DescribedLog
from .filtered_log import FilteredLog
from .gravity_witness import gravity_witness
from .odd_joint import (
    LIMITS as ODD_JOINT,
    OddJoint,
    log_gain,
    missing_force_texts,
    odd_joint,
    odd_joint_text,
    other_cause_text,
)
from .quantity_search import (
    SCREENED_PROMISE,
    Trial,
    best_amount,
    searched_quantities,
)
from .rest import rest_remarks
from .row_fits import RowFit, Rows
from .several_signs import several_signs, signs_text
from .suspects import UNIT_START, Quantity, Suspect, SuspectedMistakes


class Gains(NamedTuple):
    """Falls of the score from which mistakes are said, and limits of the search.

    On 50 simulated clean logs of ten machines no mistake explained more than 0.3, and
    on 140 of ten no contact more than 0.4; on clean logs of four real robots at most
    1.7 and 1.2, because the models lack effects that a mistake imitates.

    Such a mistake removes little of what is missed. On these real logs, and on 85 logs
    of the setting machines with compliance, backlash, ripple, cables, drifts and strong
    friction, those of 1.0 and more that left above 4 % of the forces left at least 0.48
    of what was missed. Right ones left up to 0.40 then, of a real pendulum up to 0.32.
    Right ones of 0.3 left up to 0.89, wrong ones on clean real logs at least 0.93; none
    was possible on 140 simulated clean logs.

    Contacts of 1.3 and more that were none, but cables, drifts or a wrong sign, had a
    concentration of at most 11.0; pushes of 0.7 times the usual forces and more, in
    real logs, at least 12.
    """

    named: float = 1.0
    possible: float = 0.3
    remainder: float = 0.5  # of the error of a joint, on unseen parts, in all cures
    named_rest: float = 0.44  # of what is missed, or less than `MAX_CURED_MISFIT`
    possible_rest: float = 0.9  # of what is missed, and less than `MAX_CURED_MISFIT`
    contact: float = 1.3
    concentration: float = 11.5  # errors inside a contact, over those outside
    equal: float = 0.9  # share of the largest fall, from which mistakes are equal


GAINS = Gains()
MAX_VALIDATED = 8
"""Number of mistakes that are tried on parts that the fit has not seen."""
MAX_EQUAL = 3
"""Number of mistakes of equal effect, above which none of them is known."""
MAX_POWER_DIFFERENCE = 0.05
"""Difference of the power of friction, over RMS force and speed, that is no chance."""
MAX_MISFIT = 0.15
"""Fraction (0 to 1) of the forces that no model misses whose description is right."""
MAX_WITNESS_MISFIT = 0.3
"""The same where gravity is missing, which the inertia of the bodies belies.

Chosen after all ten simulated machines had been seen: up to 0.2 without gravity.
"""
MAX_CURED_MISFIT = 0.04
"""The same with a mistake that leaves much of what the model missed without it.

Real logs without their mistake leave up to 3.9 %. Chosen after a log with two mistakes
had been seen, of which the cure of neither explains the rest.
"""
MIN_POWER = -0.08
"""Power of friction, over RMS force and speed, below which friction drives a joint.

On 140 simulated clean logs of ten machines it was above 0.01. On real logs whose model
misses more than `MAX_POWER_MISFIT` of the forces it was down to -0.25, on others above
0.2. A reversed sign that such a model hides is mostly below -0.1. The misfit was chosen
after these real logs had been seen.
"""
MAX_POWER_MISFIT = 0.04
"""Fraction (0 to 1) of the forces that a model may miss to tell the power."""
EXCHANGED_COMMANDS = (
    "the columns of angles and of `recording.commands` seem to be exchanged: those of "
    "`commands` are rougher, as measured angles are, and explain the forces better."
)


class SearchParts(NamedTuple):
    """Fractions of the time of a search at which its parts end, as on the UR10."""

    suspects: float = 0.4
    quantities: float = 0.85


PARTS = SearchParts()


def ignore_progress(fraction: float) -> None:
    """Tell nobody."""


class Mistakes(NamedTuple):
    """Findings of a search, as sentences.

    Attributes:
        explained: Mistakes that explain most of what the model misses.
        unexplained: A contact, or that the model does not fit.
        possible: Mistakes that explain a part of what it misses.
        doubts: What fits, but disagrees with the robot's file, or is late.
        rest: That the model misses most where joints rest.
        delay: Delay of all forces, also one that is no mistake; None if the logs are
            too short.
        are_gains: Whether gains of forces explain what the model misses.
    """

    explained: Texts = ()
    unexplained: Texts = ()
    possible: Texts = ()
    doubts: Texts = ()
    rest: Texts = ()
    delay: Delay | None = None
    are_gains: bool = False

    def with_delay(self, delay: Delay) -> "Mistakes":
        """Return the mistakes with the delay, a doubt if nothing else is wrong.

        A short delay explains little of the forces, but its interval judges it.
        """
        mistakes = self._replace(delay=delay)
        if self.explained or self.unexplained or not delay.is_certain:
            return mistakes
        sentence = (
            f"the forces of the log seem to be {delay} late, which mainly affects the "
            f"friction parameters: `force_delay = {delay.seconds:.3g}` in "
            "`[recording]` removes that."
        )
        return mistakes._replace(doubts=(*self.doubts, sentence), possible=())


class Explanation(NamedTuple):
    """A mistake, and what it explains.

    Attributes:
        gain: Fall of the score, also on parts that the fit has not seen.
        misfit: Fraction (0 to 1) of the forces that the model then misses.
        remainder: Error of the joint that it helps most, over the error without it, on
            parts that the fit has not seen.
        power: Least power of a joint's friction, over RMS force and RMS speed.
        sentence: What seems to be wrong.
        is_gain: Whether it is the gain of a joint's force.
    """

    gain: float
    misfit: float
    remainder: float
    power: float
    sentence: str
    is_gain: bool


def find_mistakes(
    model: Model,
    recordings: Sequence[Recording],
    bodies: np.ndarray | None = None,
    commands: Sequence[Recording] = (),
    progress: Progress = ignore_progress,
) -> Mistakes:
    """Look for the mistake in logs or robot that explains most.

    All logs are searched together; if no mistake of all explains enough, each is
    searched alone.

    Args:
        model: Model of the robot as it is described.
        recordings: Logs, whose columns are taken alike.
        bodies: Inertial parameters of the robot's file [bodies, 10]; or None.
        commands: The same logs with the commanded angles as angles, if they are known.
        progress: Callback, called with the completed fraction (0 to 1) of a search.
    """
    log = FilteredLog(model.robot, recordings)
    if not log.is_long_enough:
        return Mistakes()
    described_log = DescribedLog(model, log)
    if commands and are_exchanged(described_log, recordings, commands):
        return Mistakes(explained=(EXCHANGED_COMMANDS,))
    missing_forces = missing_force_texts(described_log)
    if missing_forces:
        return Mistakes(explained=tuple(missing_forces))
    delay = common_delay(described_log)
    rest = rest_remarks(described_log)
    mistakes = _mistakes_of_all(described_log, recordings, bodies, progress)
    if log.friction_shares.max() > MAX_FRICTION_SHARE and not mistakes.explained:
        # Friction by load may hide mistakes, or stand for effects that are missing.
        described_log = DescribedLog(model, log, is_strict=True)
        strict_mistakes = _mistakes_of_all(described_log, recordings, bodies, progress)
        if strict_mistakes.explained:
            mistakes = strict_mistakes
    if not mistakes.explained and len(recordings) > 1:
        mistakes = _mistakes_by_log(model, recordings, mistakes, progress)
    if not mistakes.explained and bodies is not None:
        mistakes = _with_witness(mistakes, described_log, bodies)
    if not mistakes.explained:
        mistakes = mistakes._replace(rest=rest)
    return mistakes.with_delay(delay)


def _mistakes_of_all(
    described_log: DescribedLog,
    recordings: Sequence[Recording],
    bodies: np.ndarray | None,
    progress: Progress,
) -> Mistakes:
    """Look for the mistake in all logs together."""
    suspected = SuspectedMistakes(described_log, recordings[0], bodies)
    suspects = [*suspected.of_columns(), *suspected.of_robot()]
    is_one_log = len(recordings) == 1
    return _search(described_log, suspected, suspects, is_one_log, progress)


def _mistakes_by_log(
    model: Model,
    recordings: Sequence[Recording],
    mistakes: Mistakes,
    progress: Progress,
) -> Mistakes:
    """Return the mistakes of single logs in place of those of all together."""
    explained = []
    unexplained = []
    are_gains = []
    for recording in recordings:
        log_mistakes = _mistakes_in_columns(model, recording, progress)
        are_gains += [log_mistakes.are_gains for _ in log_mistakes.explained]
        explained += [f"{recording.name}: {x}" for x in log_mistakes.explained]
        unexplained += [f"{recording.name}: {x}" for x in log_mistakes.unexplained]
    return mistakes._replace(
        explained=tuple(explained),
        unexplained=tuple(unexplained) or mistakes.unexplained,
        are_gains=all(are_gains or [False]),
    )


def _with_witness(
    mistakes: Mistakes, described_log: DescribedLog, bodies: np.ndarray
) -> Mistakes:
    """Return mistakes, and what the gravity of the file's bodies tells."""
    fit = described_log.judge.fit(described_log.rows)
    witness = gravity_witness(described_log, fit, bodies)
    # What does not fit at all has no gravity to compare.
    misfit = _misfit(fit, described_log.rows)
    if witness.is_absent and misfit < MAX_WITNESS_MISFIT:
        return mistakes._replace(explained=(witness.sentence,), possible=())
    if witness.is_different and not mistakes.unexplained:
        return mistakes._replace(doubts=(witness.sentence,))
    return mistakes


def _mistakes_in_columns(
    model: Model, recording: Recording, progress: Progress
) -> Mistakes:
    """Look for the mistake in the columns of one of several logs."""
    log = FilteredLog(model.robot, [recording])
    if not log.is_long_enough:
        return Mistakes()
    described_log = DescribedLog(model, log)
    suspected = SuspectedMistakes(described_log, recording)
    suspects = [*suspected.of_columns()]
    return _search(described_log, suspected, suspects, True, progress)


def _search(
    described_log: DescribedLog,
    suspected: SuspectedMistakes,
    suspects: Sequence[Suspect],
    is_one_log: bool,
    progress: Progress,
) -> Mistakes:
    """Return what explains most: a mistake, in one log also a contact, or nothing."""
    judge = described_log.judge
    fit = judge.fit(described_log.rows)
    misfit = _misfit(fit, described_log.rows)
    odd = odd_joint(described_log) if misfit > MAX_CURED_MISFIT else None
    large_gains = _large_gains(described_log, suspected, odd)
    results = explanations(
        described_log, [*suspects, *large_gains], suspected.quantities(), progress
    )
    gain = results[0].gain if results else 0.0
    if is_one_log:
        contact = find_contact(described_log, fit)
        is_largest = contact.gain >= max(GAINS.contact, gain)
        if is_largest and concentration(described_log, contact) > GAINS.concentration:
            return Mistakes(unexplained=(_contact_text(described_log, contact),))

    equal_results = _equal(results)
    texts = ", or ".join(x.sentence for x in equal_results)
    is_single = 0 < len(equal_results) <= MAX_EQUAL
    if is_single and _is_cure(equal_results[0], misfit, odd):
        effect = _effect_text(misfit, equal_results[0].misfit)
        if odd is not None:
            effect += other_cause_text(described_log, odd, texts)
        are_gains = all(x.is_gain for x in equal_results)
        return Mistakes(explained=(f"{texts}: {effect}",), are_gains=are_gains)
    if misfit > MAX_CURED_MISFIT:
        signs_sentence = _signs_sentence(described_log, suspected, misfit)
        if signs_sentence:
            return Mistakes(explained=(signs_sentence,))
    if misfit > MAX_MISFIT:
        text = _misfit_text(described_log, fit)
        if odd is not None:
            text = odd_joint_text(described_log, odd, misfit)
        return Mistakes(unexplained=(text,))
    powers = described_log.friction_powers(described_log.rows, fit)
    if powers.min() < MIN_POWER and misfit < MAX_POWER_MISFIT:
        return Mistakes(explained=(_driving_text(described_log, powers),))
    if is_single and _is_possible(equal_results[0], misfit):
        return Mistakes(possible=(f"possible, but not sure: {texts}.",))
    return Mistakes()


def _large_gains(
    described_log: DescribedLog, suspected: SuspectedMistakes, odd: OddJoint | None
) -> list[Suspect]:
    """Return the gain of the odd joint's force, if it has one."""
    center = log_gain(odd)
    if odd is None or center is None:
        return []
    quantity = suspected.gain(odd.joint, center)
    amount = best_amount(described_log, quantity)
    return [
        Suspect(quantity.sentence(amount), lambda: quantity.rows(amount), is_gain=True)
    ]


def _signs_sentence(
    described_log: DescribedLog, suspected: SuspectedMistakes, misfit: float
) -> str:
    """Return a sentence about several signs, if they are wrong."""
    for signs in several_signs(described_log, suspected):
        rows = suspected.rows_of_signs(*signs)
        fit = described_log.judge.fit(rows)
        remaining_misfit = _misfit(fit, rows)
        power = described_log.friction_powers(rows, fit).min()
        if remaining_misfit < MAX_CURED_MISFIT and power > MIN_POWER:
            text = signs_text(described_log, signs)
            return f"{text}: {_effect_text(misfit, remaining_misfit)}"
    return ""


def _effect_text(misfit: float, remaining_misfit: float) -> str:
    """Return how much less of the forces a model misses without a mistake."""
    return (
        f"the torque error is then {percent(remaining_misfit)} % instead of "
        f"{percent(misfit)} %."
    )


def _contact_text(described_log: DescribedLog, contact: Contact) -> str:
    """Return a sentence about a contact and its time."""
    start, stop = described_log.log.times_of(contact.start, contact.stop)
    return (
        f"something seems to push the robot from {start:.4g} to {stop:.4g} s, a "
        "contact or a person: leave that part out (`recording.start`, "
        "`recording.stop`)."
    )


def _equal(results: Sequence[Explanation]) -> list[Explanation]:
    """Return the mistakes of nearly the largest gain, without those that drive joints.

    Of two signs that explain the forces alike, the wrong one makes friction negative.
    """
    if not results or results[0].gain <= 0.0:
        return []
    # Factors of units lie side by side: only the best one counts.
    if results[0].sentence.startswith(UNIT_START):
        return [results[0]]
    equal_results = [x for x in results if x.gain >= GAINS.equal * results[0].gain]
    max_power = max(x.power for x in equal_results)
    by_sentence: dict[str, Explanation] = {}
    for explanation in equal_results:
        if explanation.power > max_power - MAX_POWER_DIFFERENCE:
            by_sentence.setdefault(explanation.sentence, explanation)
    return list(by_sentence.values())


def _is_cure(explanation: Explanation, misfit: float, odd: OddJoint | None) -> bool:
    """Return whether a mistake explains more than effects that the model lacks.

    If one joint's force is odd, it must leave about as little as the model without it.
    """
    max_misfit = max(MAX_CURED_MISFIT, GAINS.named_rest * misfit)
    if odd is not None:
        max_misfit = min(max_misfit, ODD_JOINT.cure * odd.misfit)
    is_large = explanation.gain >= GAINS.named and explanation.misfit < max_misfit
    is_braked = explanation.power > MIN_POWER
    return is_large and is_braked and explanation.remainder < GAINS.remainder


def _is_possible(explanation: Explanation, misfit: float) -> bool:
    """Return whether a mistake is worth a look: it may be one among several."""
    max_misfit = min(MAX_CURED_MISFIT, GAINS.possible_rest * misfit)
    return explanation.gain >= GAINS.possible and explanation.misfit < max_misfit


def _driving_text(described_log: DescribedLog, powers: np.ndarray) -> str:
    """Return a sentence about the joint that its friction would drive most."""
    name = described_log.robot.joint_names[int(np.argmin(powers))]
    return (
        f"the sign of the force or angle of joint `{name}` seems to be wrong "
        "(`recording.force_signs`, `angle_signs`): with this sign, friction would "
        "drive the joint."
    )


def _misfit(fit: RowFit, rows: Rows) -> float:
    """Return the fraction (0 to 1) of the forces that is missed; joints count alike."""
    return float(np.sqrt(np.mean(rows.relative_errors(fit.squares) ** 2)))


def _misfit_text(described_log: DescribedLog, fit: RowFit) -> str:
    """Return a sentence about where a model does not fit."""
    rows = described_log.rows
    joint = int(np.argmax(rows.relative_errors(fit.squares)))
    share = percent(_misfit(fit, rows))
    return (
        f"the model does not fit: its torque error is {share} %, mainly at joint "
        f"`{described_log.robot.joint_names[joint]}`, and no single mistake in signs, "
        "order, units, offsets, axes or gravity explains it."
    )


def explanations(
    described_log: DescribedLog,
    suspects: Sequence[Suspect],
    quantities: Iterable[Quantity],
    progress: Progress,
) -> list[Explanation]:
    """Return the mistakes that explain something, the best first."""
    judge = described_log.judge
    rows = described_log.rows
    score = judge.fit(rows).score
    trials = []
    for number, suspect in enumerate(suspects):
        progress(PARTS.suspects * number / len(suspects))
        suspect_rows = suspect.rows()
        gain = score - judge.fit(suspect_rows).score
        is_gain = suspect.is_gain
        trials.append(Trial(gain, suspect.sentence, suspect_rows, is_gain))
    progress_of_search = partial(_in_part, progress, PARTS.suspects, PARTS.quantities)
    trials += searched_quantities(described_log, list(quantities), progress_of_search)
    trials.sort(key=lambda trial: -trial.gain)

    unseen_squares = judge.unseen_squares(rows)
    results = []
    for number, trial in enumerate(trials[:MAX_VALIDATED]):
        _in_part(progress, PARTS.quantities, 1.0, number / MAX_VALIDATED)
        if trial.gain > SCREENED_PROMISE:
            trial_squares = judge.unseen_squares(trial.rows)
            unseen_gain = judge.score(unseen_squares) - judge.score(trial_squares)
            remainders = np.sqrt(trial_squares / unseen_squares)[judge.is_judged]
            fit = judge.fit(trial.rows)
            explanation = Explanation(
                gain=min(trial.gain, unseen_gain),
                misfit=_misfit(fit, trial.rows),
                remainder=float(remainders.min()),
                power=float(described_log.friction_powers(trial.rows, fit).min()),
                sentence=trial.sentence,
                is_gain=trial.is_gain,
            )
            results.append(explanation)
    return sorted(results, key=lambda result: -result.gain)


def _in_part(progress: Progress, start: float, stop: float, fraction: float) -> None:
    """Tell the fraction of a part of the search."""
    progress(start + (stop - start) * fraction)
