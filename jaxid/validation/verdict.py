"""Verdict on an identified model: one sentence for all, and one for each criterion."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxid.dynamics.terms import ConstantOffset
from jaxid.identification.estimators.regularisation_and_weights import (
    LARGEST_UNCERTAINTY,
)
from jaxid.identification.fit_result import Fit
from jaxid.result_table import Remark, Status, significant

from .torque_errors import Definiteness, TorqueErrors, Validation

RMS_ERROR = (5.0, 50.0)
"""RMS errors on new motions: good, and tolerable [% of the RMS force, worst joint]."""
FIT_ERROR = (1.0, 30.0)
"""Missed forces of a fit, noise apart: good, and tolerable [% of the RMS force]."""
MIN_UNSEEN_ERROR = 2.0
"""Errors on new motions that are judged relative to the fit's [% of the RMS force]."""
UNSEEN_RATIO = 1.5
"""Errors on new motions, relative to those of the fit, that are good."""
MAX_CONDITION_NUMBER = 1e3
"""Condition number (scaled columns) above which parameters are hard to tell apart."""
PRICE = (10.0, 100.0)
"""Increase of the residuals by bounds that is good, and tolerable [%]."""
OFFSET = 0.3
"""Constant force to be explained, relative to the largest force of its joint."""
MAX_CLAIM = 4.0
"""Forces of the file's bodies, over those of the logs, that wrong masses explain."""


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
    claimed_mass: float = 0.0  # mass of all bodies that it claims [kg]; 0 without

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
    def every_note(self) -> tuple[str, ...]:
        """Notes on the robot, the fit and the logs, each once."""
        fit = self.fit
        return tuple(
            dict.fromkeys((*fit.base.model.robot.notes, *fit.notes, *self.notes))
        )


def verdict(report: Report) -> list[Remark]:
    """Return the verdict on a model: one sentence for all, then one per criterion."""
    fit = report.fit
    definiteness = report.definiteness
    condition = fit.condition_numbers.scaled
    eigenvalue = significant(definiteness.smallest)
    remarks = [
        *(Remark(text, Status.BAD) for text in dict.fromkeys(report.mistakes)),
        *(Remark(text, Status.DOUBTFUL) for text in dict.fromkeys(report.doubts)),
        _judge_fit(fit, report.identification),
        _judge_new_motions(report.identification, report.verification),
        *_judge_friction(fit, report.identification),
        dataclasses.replace(
            fit.determination[0],
            detail="A combination counts as undetermined if it leaves more than "
            f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open.",
        ),
        Remark(
            f"Estimates: {dict(fit.facts)['estimates']}",
            detail="Standard deviation over estimate. A parameter near zero is never "
            "known to a few percent, and that is no fault: look at its interval.",
        ),
        Remark(
            str(definiteness),
            Status.GOOD if definiteness.positive_definite else Status.BAD,
            f"Smallest eigenvalue over random poses: {eigenvalue} in SI units (Sec. "
            "5). If it is negative, do not simulate or control with this model where "
            'joints were not moved: `kind = "consistent"` in `[estimator]` finds '
            "bodies that can exist.",
        ),
        Remark(
            "The condition number with columns of length one is "
            f"{significant(condition, 3)}.",
            Status.GOOD if condition < MAX_CONDITION_NUMBER else Status.DOUBTFUL,
            f"Good: below {MAX_CONDITION_NUMBER:g}. Above, some parameters are hard to "
            "tell apart.",
        ),
        *_judge_bounds(fit),
        *_judge_offsets(fit),
        *_judge_size(report.claimed),
    ]
    statuses = [remark.status for remark in remarks]
    if Status.BAD in statuses:
        overall_remark = Remark(
            "Do not rely on this model yet: what is marked ✗ comes first.", Status.BAD
        )
    elif Status.DOUBTFUL in statuses:
        text = "A usable model; look at what is marked ! before you rely on it."
        overall_remark = Remark(text, Status.DOUBTFUL)
    else:
        overall_remark = Remark(
            "A good model: all criteria below are met.", Status.GOOD
        )
    return [overall_remark, *remarks]


def _judge_fit(fit: Fit, logs: Sequence[TorqueErrors]) -> Remark:
    """Judge how much of the forces a fit misses, unless that is white noise."""
    spectra = fit.residual_spectra
    names = fit.base.model.robot.joint_names
    misfits = 100 * _relative_errors(logs)
    causes = []
    # Of a residual that is white, no part counts; of others about what departs from
    # white noise.
    coloured_shares = np.ones(len(names))
    if spectra is not None:
        coloured_shares = (
            np.clip(np.asarray(spectra.departure) - spectra.limit, 0.0, None) ** 0.5
        )
        white_count = sum(coloured_shares == 0)
        causes = [
            f"the residuals of {white_count} of {len(names)} joints are white noise"
        ]
    worst_joint = int(np.argmax(misfits * np.where(coloured_shares > 0, 1.0, 1e-3)))
    coloured_misfit = float(np.max(misfits * coloured_shares))
    status = Status.GOOD if coloured_misfit <= FIT_ERROR[0] else Status.DOUBTFUL
    if status is Status.DOUBTFUL:
        causes.append(
            "some effect is not in the model, or the noise itself is coloured"
        )
        status = Status.BAD if misfits[worst_joint] > FIT_ERROR[1] else status
    text = (
        f"The model misses up to {significant(misfits[worst_joint], 2)} % of the RMS "
        "forces that it "
    )
    return Remark(
        f"{text}was fitted to (joint `{names[worst_joint]}`): {', '.join(causes)}.",
        status,
        f"Good: white noise, or up to {FIT_ERROR[0]:g} % that are not; tolerable: up "
        f"to {FIT_ERROR[1]:g} %. Bartlett's test compares the cumulative spectrum with "
        "a straight line. The intervals account for correlated residuals, not for what "
        "the model lacks.",
    )


def _judge_friction(fit: Fit, logs: Sequence[TorqueErrors]) -> Iterator[Remark]:
    """Warn if errors on the logs of a fit depend on the speeds of the joints."""
    speed_dependence = np.any([e.depend_on_speed for e in logs], axis=0)
    names = [
        f"`{n}`"
        for n, x in zip(
            fit.base.model.robot.joint_names, speed_dependence, strict=False
        )
        if x
    ]
    if names:
        yield Remark(
            f"Errors depend on speed (joints {', '.join(names)}): friction seems to "
            "have another shape, and the intervals of its parameters may be too "
            "narrow.",
            Status.DOUBTFUL,
            "Means over classes of speed agree between blocks of time: try `jaxid "
            "choose`.",
        )


def _relative_errors(logs: Sequence[TorqueErrors]) -> np.ndarray:
    """Return the RMS errors over the RMS forces of each joint, all logs together."""
    rms_errors, rms_forces = (
        np.sqrt(np.mean([np.asarray(x) ** 2 for x in group], axis=0))
        for group in ([e.rms for e in logs], [e.force_rms for e in logs])
    )
    # Forces below a hundredth of the largest count as that.
    min_forces = 0.01 * np.nan_to_num(np.asarray(logs[0].max_forces))
    rms_forces = np.maximum(rms_forces, min_forces)
    return np.nan_to_num(rms_errors / np.where(rms_forces > 0, rms_forces, np.inf))


def _judge_new_motions(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors]
) -> Remark:
    if not verification:
        text = (
            "The model was not validated on an unseen log: use `--verify` or `--split`."
        )
        return Remark(text, Status.DOUBTFUL)
    unseen_errors = 100 * _relative_errors(verification)
    max_error = float(np.max(unseen_errors))
    text = (
        "On logs that the fit has not seen, it misses up to "
        f"{significant(max_error, 2)} % of the RMS forces"
    )
    # Errors that do not matter may grow.
    ratios = unseen_errors / np.maximum(100 * _relative_errors(identification), 1e-9)
    ratio = float(np.max(np.where(unseen_errors > MIN_UNSEEN_ERROR, ratios, 1.0)))
    if ratio > 1:
        text += f", and up to {significant(ratio, 2)} times as much as of the fit's own"
    status = Status.GOOD
    if max_error > RMS_ERROR[0] or ratio > UNSEEN_RATIO:
        status = Status.BAD if max_error > RMS_ERROR[1] else Status.DOUBTFUL
    detail = (
        f"Good: up to {RMS_ERROR[0]:g} % for every joint, and {UNSEEN_RATIO:g} times "
        f"the errors of the fit where they exceed {MIN_UNSEEN_ERROR:g} %; tolerable: "
        f"up to {RMS_ERROR[1]:g} %."
    )
    return Remark(f"{text}.", status, detail)


def _judge_bounds(fit: Fit) -> Iterator[Remark]:
    """Judge the price of bounds: a large one says that the logs contradict them."""
    if fit.consistency is None:
        return
    price = 100 * fit.consistency.residual_increase
    active_bounds = "; ".join(fit.consistency.active) or "none"
    status = Status.GOOD if price <= PRICE[0] else Status.DOUBTFUL
    status = Status.BAD if price > PRICE[1] else status
    yield Remark(
        f"All bodies are physically consistent, for {significant(price, 2)} % larger "
        f"residuals; active bounds: {active_bounds}",
        status,
        f"Good: up to {PRICE[0]:g} %; tolerable: up to {PRICE[1]:g} %. Above, the logs "
        "contradict the bounds: check `total_mass`, `mass_max`, units and signs.",
    )


def _judge_size(claimed: Sequence[TorqueErrors]) -> Iterator[Remark]:
    """Compare the size of the forces with those of the bodies of the robot's file.

    A fit of forces in a wrong unit is as good as any, but its masses are not.
    """
    for log in claimed[:1]:
        claim = float(np.linalg.norm(log.predicted))
        size = float(np.linalg.norm(log.measured))
        if claim > MAX_CLAIM * size > 0:
            ratio = significant(claim / size, 2)
            yield Remark(
                f"The bodies of the robot's file need {ratio} times the forces of the "
                "logs: are these currents "
                "(`recording.torque_constants`), the motors' (`forces_side`) or in "
                "another unit (`force_unit`), or is the file wrong?",
                Status.DOUBTFUL,
            )


def _judge_offsets(fit: Fit) -> Iterator[Remark]:
    """Judge constant forces: a large one is a weight that gravity does not explain."""
    robot = fit.base.model.robot
    estimates = zip(np.asarray(fit.parameters), fit.standard_deviations, strict=True)
    values = dict(zip(fit.base.names, estimates, strict=True))
    (offset,) = ConstantOffset.joint_parameters
    for j, name in enumerate(robot.joint_names):
        value, deviation = map(float, values.get(f"{offset.name}{j + 1}", (0.0, 0.0)))
        max_force = float(robot.known_max_forces[j])
        if abs(value) - 2.0 * deviation > OFFSET * max_force:
            unit = robot.force_unit(j)
            yield Remark(
                f"Joint `{name}` has a constant force of {significant(value, 3)} "
                f"{unit}, and its limit is {significant(max_force, 3)} {unit}: is "
                "`gravity` right, or does a spring or a cable pull?",
                Status.DOUBTFUL,
                f"Good: up to {100 * OFFSET:g} % of the largest force.",
            )
