"""The one judgement of a model: findings with a severity each, then the verdict."""

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from jaxid.arrays import Texts
from jaxid.dynamics.terms import ConstantOffset
from jaxid.identification.fit_result import Fit
from jaxid.result_table import Remark, Status, percent, significant, sort_remarks
from jaxid.robot.collision_geometry import BodyShape
from jaxid.robot.contacts import legs_of
from jaxid.robot.robot import Robot

from .contact_flags import standing_feet_findings
from .torque_errors import (
    Definiteness,
    TorqueErrors,
    Validation,
    error_words,
    joint_errors,
    relative_error,
    relative_joint_errors,
    unexplained_error,
)


class ErrorLimits(NamedTuple):
    """Torque errors, RMS over RMS, that are good, doubtful and bad.

    Between good and doubtful the number speaks for itself. Attributes ending in `joint`
    are for the worst joint, the others for all joints together. Of clean logs of twelve
    kinds, of five machines that MuJoCo simulates (palletiser, gantry, two arms, oblique
    and lightweight arm of `benchmarks/judgement`), the errors on new motion were at
    most 9 %, of a joint 14 %.
    """

    good: float = 0.1
    doubtful: float = 0.25
    bad: float = 0.6
    doubtful_joint: float = 0.4
    bad_joint: float = 0.8


class GrowthLimits(NamedTuple):
    """Errors on new motions over those of the same model fitted to these motions.

    On the logs of `ErrorLimits` the ratio was at most 3.7, and 1.9 where errors matter.
    """

    ratio: float = 3.0
    error: float = 0.1  # smaller errors do not matter


class PriceLimits(NamedTuple):
    """Increase of the residuals by bounds of bodies that is doubtful, and bad.

    On the logs of `ErrorLimits` it was at most 9 %.
    """

    doubtful: float = 0.2
    bad: float = 1.0


class LegLimits(NamedTuple):
    """When the drives of legs that are built alike differ.

    Simulated quadrupeds whose legs are equal were never said to differ.
    """

    chance: float = 0.01  # probability of a false alarm in a report
    share: float = 0.25  # smaller differences, relative to the other legs, are usual


ERRORS = ErrorLimits()
GROWTH = GrowthLimits()
PRICES = PriceLimits()
LEGS = LegLimits()
MAX_CONDITION_NUMBER = 1e3
"""Condition number (scaled columns) above which parameters are hard to tell apart."""
MAX_OFFSET_SHARE = 0.3
"""Constant force to be explained, relative to the largest force of its joint."""
MAX_CLAIM_RATIO = 4.0
"""Forces of the file's bodies, over those of the logs, that wrong masses explain."""

MAX_FINDINGS = 8
"""Number of findings in a short form of the judgement."""


@dataclasses.dataclass(frozen=True, eq=False)
class Report:
    """Content of the report of an identification."""

    fit: Fit  # identified parameters
    identification: Sequence[TorqueErrors]  # errors on the logs of the fit
    verification: Sequence[TorqueErrors]  # errors on logs that the fit has not seen
    definiteness: Definiteness  # of the mass matrix
    settings: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # origin of the result
    notes: Sequence[str] = ()  # notes on the logs, as sentences
    doubts: Sequence[
        str
    ] = ()  # findings on the logs that deserve attention, as sentences
    # likely mistakes in the description of the logs or the robot, as sentences
    mistakes: Sequence[str] = ()
    # errors on all logs of the parameters that the robot's file claims; empty without
    claimed: Sequence[TorqueErrors] = ()
    # the same on the first log, without the friction that it claims
    claimed_loads: Sequence[TorqueErrors] = ()
    # base parameters that it claims, NaN where it claims none; None without
    claimed_parameters: np.ndarray | None = None
    # inertial parameters of the bodies that it claims [bodies, 10]; None without
    claimed_bodies: np.ndarray | None = None

    @property
    def shapes(self) -> list[BodyShape]:
        """Shapes of the robot's bodies, for pictures; none without its file."""
        return []

    @property
    def validation(self) -> Validation:
        """Torque errors on all logs."""
        robot = self.fit.base.model.robot
        units = tuple(robot.force_unit(joint) for joint in range(robot.joints))
        return Validation(self.every_error, self.definiteness, robot.joint_names, units)

    @property
    def every_error(self) -> tuple[TorqueErrors, ...]:
        """Errors on all logs."""
        return (*self.identification, *self.verification)

    @property
    def every_note(self) -> Texts:
        """Notes on the robot, the fit and the logs, each once."""
        fit = self.fit
        return tuple(
            dict.fromkeys((*fit.base.model.robot.notes, *fit.notes, *self.notes))
        )


class Judgement(NamedTuple):
    """Whether a model may be used.

    Attributes:
        findings: One sentence for each check, the most severe first: ✗ will hurt who
            uses the model, ! needs a look before, ✓ was checked, · is a remark.
        verdict: The sentence that sums them up.
    """

    findings: tuple[Remark, ...]
    verdict: Remark

    @property
    def faults(self) -> tuple[Remark, ...]:
        """Findings with ✗ or !."""
        severities = (Status.BAD, Status.DOUBTFUL)
        return tuple(x for x in self.findings if x.status in severities)

    def overview(self) -> list[Remark]:
        """Return the verdict and the most severe findings, without details."""
        checks = [x for x in self.findings if x.status is not Status.NEUTRAL]
        findings = checks[:MAX_FINDINGS]
        if len(checks) > MAX_FINDINGS:
            count = len(checks) - MAX_FINDINGS
            findings.append(Remark(f"{count} more findings are on the page"))
        return [self.verdict, *(dataclasses.replace(x, detail="") for x in findings)]


def judge(report: Report) -> Judgement:
    """Judge an identified model by all that is known of it and of its logs."""
    fit = report.fit
    # One finding sums up what bounds do.
    bound_notes = ()
    if fit.consistency is not None:
        bound_notes = fit.consistency.findings(fit.base.model.robot)
    findings_on_fit = [
        *_judge_errors(report),
        fit.determination[0],
        _judge_mass_matrix(report.definiteness),
        *_judge_bounds(fit),
        *_judge_offsets(fit),
        *(Remark(text, Status.DOUBTFUL) for text in standing_feet_findings(fit)),
        *_judge_legs(fit),
        *_judge_claims(report.claimed_loads, report.fit.base.model.robot),
        *_judge_friction(fit, report.identification),
        *_remarks_on_fit(report),
        *(Remark(note) for note in report.every_note if note not in bound_notes),
    ]
    if report.mistakes:
        # What a mistake spoils is no finding of its own.
        findings_on_fit = [
            dataclasses.replace(x, status=Status.NEUTRAL) for x in findings_on_fit
        ]
    findings = sort_remarks(
        [
            *(Remark(text, Status.BAD) for text in dict.fromkeys(report.mistakes)),
            *(Remark(text, Status.DOUBTFUL) for text in dict.fromkeys(report.doubts)),
            *findings_on_fit,
        ]
    )
    # Of a sentence that stands there twice, the most severe one counts.
    unique_findings = {finding.text: finding for finding in reversed(findings)}
    findings = list(reversed(unique_findings.values()))
    return Judgement(tuple(findings), _verdict(report, findings))


def _verdict(report: Report, findings: Sequence[Remark]) -> Remark:
    """Return the sentence for all findings, which follows the most severe one."""
    statuses = [finding.status for finding in findings]
    if Status.BAD in statuses:
        text = "Do not rely on this model yet: first correct what is marked ✗."
        return Remark(text, Status.BAD)
    if Status.DOUBTFUL in statuses:
        text = "A usable model; look at what is marked ! before you rely on it."
        return Remark(text, Status.DOUBTFUL)
    error = relative_error(report.verification)
    # The end of a log is less new than another log.
    is_split = report.settings.get("split") is not None
    motion = "the rest of its logs" if is_split else "other logs"
    words = error_words(report.fit)
    text = f"its {words} on {motion} is {percent(error)} % (RMS)."
    if error > ERRORS.good:
        text = f"A usable model: no other check found a problem, but {text}"
        return Remark(text, Status.NEUTRAL)
    return Remark(f"A good model: no check found a problem, and {text}", Status.GOOD)


def _judge_errors(report: Report) -> Iterator[Remark]:
    """Judge the torque errors on motions that the fit has not seen."""
    if not report.verification:
        yield Remark(
            "The model was not validated on another log: use `--verify` or `--split`",
            Status.DOUBTFUL,
        )
        yield _error_remark(report, report.identification, "the motion of the fit")
        return
    yield _error_remark(report, report.verification, "motion that the fit did not use")
    yield from _judge_growth(report)


def _error_remark(report: Report, logs: Sequence[TorqueErrors], motion: str) -> Remark:
    """Judge torque errors on some logs; on those of the fit they are never good."""
    robot = report.fit.base.model.robot
    error = relative_error(logs)
    relative_errors = relative_joint_errors(logs)
    judged_errors = joint_errors(logs)
    worst_error = float(judged_errors.max())
    # Only if a joint is what is wrong, it is named by what it must do.
    is_joint_wrong = worst_error > ERRORS.doubtful_joint
    errors_of_joints = judged_errors if is_joint_wrong else relative_errors
    joints = range(robot.joints)
    if robot.floating and not is_joint_wrong:
        # Moments on a trunk are small beside its weight: no fault of a joint.
        joints = robot.driven
    worst_joint = max(joints, key=lambda joint: errors_of_joints[joint])
    worst_share = percent(float(relative_errors[worst_joint]))
    status = Status.NEUTRAL
    if error <= ERRORS.good and logs is report.verification:
        status = Status.GOOD
    if error > ERRORS.doubtful or worst_error > ERRORS.doubtful_joint:
        status = Status.DOUBTFUL
    if error > ERRORS.bad or worst_error > ERRORS.bad_joint:
        status = Status.BAD
    return Remark(
        f"The {error_words(report.fit)} on {motion} is {percent(error)} % "
        f"(RMS{logs[0].band_words}); the largest is that of joint "
        f"`{robot.joint_names[worst_joint]}`, {worst_share} %",
        status,
        f"Good: up to {100 * ERRORS.good:g} %; ! above {100 * ERRORS.doubtful:g} % "
        f"({100 * ERRORS.doubtful_joint:g} % of a joint), ✗ above "
        f"{100 * ERRORS.bad:g} % ({100 * ERRORS.bad_joint:g} %). A joint under "
        "little load is judged by a fifth of its largest torque.",
    )


def _judge_growth(report: Report) -> Iterator[Remark]:
    """Point out errors on new motions that other parameters would not make."""
    error = relative_error(report.verification)
    ratio = error / max(unexplained_error(report.verification), 1e-9)
    if error > GROWTH.error and ratio > GROWTH.ratio:
        yield Remark(
            f"On new motion the errors are {significant(ratio, 2)} times as large as "
            "those of the same model fitted to that motion: the motion of the fit is "
            "too poor, or something has changed between the logs",
            Status.DOUBTFUL,
        )


def _judge_mass_matrix(definiteness: Definiteness) -> Remark:
    """Judge whether a simulation or a controller can use the mass matrix."""
    eigenvalue = significant(definiteness.smallest)
    return Remark(
        str(definiteness),
        Status.GOOD if definiteness.positive_definite else Status.BAD,
        f"Smallest eigenvalue over random poses: {eigenvalue} in SI units (Sec. 5). If "
        "it is negative, do not simulate or control with this model in poses that the "
        'logs do not cover: `kind = "consistent"` in `[estimator]` finds bodies that '
        "can exist physically.",
    )


def _judge_bounds(fit: Fit) -> Iterator[Remark]:
    """Judge the price of bounds: a large one says that the logs contradict them."""
    if fit.consistency is None:
        return
    price = fit.consistency.residual_increase
    active_bounds = "; ".join(fit.consistency.active) or "none"
    status = Status.GOOD if price <= PRICES.doubtful else Status.DOUBTFUL
    status = Status.BAD if price > PRICES.bad else status
    yield Remark(
        "All bodies are physically consistent; this makes the residuals "
        f"{percent(price)} % larger; active bounds: {active_bounds}",
        status,
        f"Good: up to {100 * PRICES.doubtful:g} %; tolerable: up to "
        f"{100 * PRICES.bad:g} %. Above that, the logs contradict the bounds: check "
        "`total_mass`, `mass_max`, units and signs.",
    )


def _judge_offsets(fit: Fit) -> Iterator[Remark]:
    """Judge constant forces: a large one is a weight that gravity does not explain."""
    robot = fit.base.model.robot
    estimates = zip(np.asarray(fit.parameters), fit.standard_deviations, strict=True)
    values = dict(zip(fit.base.names, estimates, strict=True))
    (offset,) = ConstantOffset.joint_parameters
    for j in robot.driven:
        name = robot.joint_names[j]
        parameter = f"{offset.name}{robot.numbers[j]}"
        value, deviation = map(float, values.get(parameter, (0.0, 0.0)))
        max_force = float(robot.known_max_forces[j])
        if abs(value) - 2.0 * deviation > MAX_OFFSET_SHARE * max_force:
            unit = robot.force_unit(j)
            yield Remark(
                f"Joint `{name}` has a constant force of {significant(value, 3)} "
                f"{unit}, and its limit is {significant(max_force, 3)} {unit}: is "
                "`gravity` right, or does a spring or a cable pull?",
                Status.DOUBTFUL,
                f"Good: up to {100 * MAX_OFFSET_SHARE:g} % of the largest force.",
            )


def _judge_legs(fit: Fit) -> Iterator[Remark]:
    """Compare the drives of equal joints of legs, which are usually built alike."""
    robot = fit.base.model.robot
    legs = legs_of(robot).own_joints if robot.contacts else ()
    if len(legs) < 2 or len(set(map(len, legs))) > 1:
        return
    comparisons = _leg_comparisons(fit, legs)
    limit = special.ndtri(1.0 - 0.5 * LEGS.chance / max(len(comparisons), 1))
    differences = [
        x
        for x in comparisons
        if abs(x.difference) > max(limit * x.deviation, LEGS.share * abs(x.others))
    ]
    for x in differences:
        yield Remark(
            f"Joint `{robot.joint_names[x.joint]}` differs from the same joint of the "
            f"other legs: {x.meaning} is {significant(x.others + x.difference, 2)} and "
            f"not {significant(x.others, 2)} {x.unit}; are the legs built alike?",
            detail="The difference is larger than both intervals explain.",
        )
    if comparisons and not differences:
        yield Remark(
            "Friction and rotors of equal joints of the legs agree within their "
            "intervals",
            Status.GOOD,
        )


class LegComparison(NamedTuple):
    """A parameter of a joint, compared with the same joint of the other legs."""

    joint: int
    meaning: str
    unit: str
    others: float  # median of the other legs
    difference: float  # from this median
    deviation: float  # standard deviation of the difference


def _leg_comparisons(fit: Fit, legs: Sequence[Sequence[int]]) -> list[LegComparison]:
    """Compare each identified parameter of the drives of legs with the other legs."""
    robot = fit.base.model.robot
    names = [*fit.base.names]
    terms = fit.base.model.terms
    parameters = [x for term in terms for x in term.joint_parameters if x.role]
    comparisons = []
    for parameter, joints in itertools.product(parameters, zip(*legs, strict=True)):
        keys = [f"{parameter.name}{robot.numbers[joint]}" for joint in joints]
        if not set(keys) <= set(names):
            continue
        places = [names.index(key) for key in keys]
        values = np.asarray(fit.parameters)[places]
        variances = fit.standard_deviations[places] ** 2
        for k, joint in enumerate(joints):
            # A median: one leg that differs does not make the others differ.
            others = float(np.median(np.delete(values, k)))
            variance = variances[k] + np.median(np.delete(variances, k))
            comparisons.append(
                LegComparison(
                    joint,
                    parameter.meaning.split(":")[0],
                    fit.base.units[places[k]],
                    others,
                    float(values[k] - others),
                    float(np.sqrt(variance)),
                )
            )
    return comparisons


def _judge_claims(
    claimed_loads: Sequence[TorqueErrors], robot: Robot
) -> Iterator[Remark]:
    """Compare the size of the forces with those of the bodies of the robot's file.

    A fit of forces in a wrong unit is as good as any, but its masses are not.
    """
    for log in claimed_loads:
        claims = np.linalg.norm(log.predicted, axis=0)
        sizes = np.linalg.norm(log.measured, axis=0)
        cause = (
            "are the forces currents (`recording.torque_constants`), motor torques "
            "(`forces_side`) or in another unit (`force_unit`), or is the file wrong?"
        )
        size = float(np.linalg.norm(sizes))
        # A log without forces has findings of its own.
        ratio = float(np.linalg.norm(claims)) / size if size > 0 else 0.0
        if ratio > MAX_CLAIM_RATIO:
            forces = f"{significant(ratio, 2)} times the forces of the logs"
            text = (
                f"With the bodies in the robot's file, the motion would need {forces}"
            )
            yield Remark(f"{text}: {cause}", Status.DOUBTFUL)
            continue
        is_small = (sizes > 0) & (claims > MAX_CLAIM_RATIO * sizes)
        # Forces on a trunk are not logged: they follow from those of the legs.
        is_small[[*robot.virtual]] = False
        for j in map(int, np.flatnonzero(is_small)):
            forces = f"{significant(claims[j] / sizes[j], 2)} times its logged force"
            joint = f"joint `{robot.joint_names[j]}`"
            text = f"With the bodies in the robot's file, {joint} would need {forces}"
            yield Remark(f"{text}: {cause}", Status.DOUBTFUL)


def _judge_friction(fit: Fit, logs: Sequence[TorqueErrors]) -> Iterator[Remark]:
    """Point out errors on the logs of a fit that depend on the speeds of the joints."""
    speed_dependence = np.any([log.depend_on_speed for log in logs], axis=0)
    joint_names = fit.base.model.robot.joint_names
    names = [
        f"`{name}`"
        for name, depends_on_speed in zip(joint_names, speed_dependence, strict=True)
        if depends_on_speed
    ]
    if names:
        joints = f"joint{'s' if len(names) > 1 else ''} {', '.join(names)}"
        yield Remark(
            f"Friction of {joints} seems to have another shape: errors depend on "
            "speed, so the intervals of these friction parameters are too narrow; "
            "`jaxid choose` tries other friction laws",
            detail="The mean errors in ranges of speed agree between parts of the log.",
        )


def _remarks_on_fit(report: Report) -> Iterator[Remark]:
    """Describe the fit by numbers that neither praise nor blame it."""
    fit = report.fit
    if report.verification:
        yield _error_remark(report, report.identification, "the motion of the fit")
    spectra = fit.residual_spectra
    if spectra is not None:
        white_count = int(np.count_nonzero(spectra.white))
        yield Remark(
            f"The errors of {white_count} of {len(spectra.white)} joints are random "
            "(white noise)",
            detail="Where they are not, the model lacks a small effect. If the torque "
            "errors are too large for you, `jaxid choose` tries further "
            "effects; otherwise you need not do anything: the intervals "
            "account for correlated errors. Bartlett's test compares the "
            "cumulative spectrum with a straight line.",
        )
    yield Remark(
        f"Estimates: {dict(fit.facts)['estimates']}",
        detail="Forces of random motions within the robot's limits, and 95 % intervals "
        "of the single parameters. A small parameter matters little, however wide "
        "its interval.",
    )
    condition = significant(fit.condition_numbers.scaled, 3)
    yield Remark(
        f"The condition number with columns of length one is {condition}",
        detail=f"Above {MAX_CONDITION_NUMBER:g}, some parameters are hard to tell "
        "apart, and their intervals are wide: record a motion of `jaxid excite`.",
    )
