"""Checks of a robot on legs: its columns, the frame of its IMU, flags of contact.

A foot that is wrongly called standing costs information only; one that is wrongly
called in the air spoils the fit, since its leg then carries a force that the model does
not know. So a first fit calls all feet standing, and tells how much torque each leg
lacks: much where the foot stands, hardly any where it is in the air. Where that fit
doubts a flag, another one takes the flags as they are.
"""

import contextlib
import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.identification.estimators import ResidualVariances, WeightedLeastSquares
from jaxid.identification.fit_result import Fit
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.filters import AbstractFilter, Subsample
from jaxid.measurement.floating_base import (
    all_standing,
    base_of,
    contact_grid,
    measured_gravity,
)
from jaxid.measurement.imu_offset import (
    STANDARD_GRAVITY,
    ImuOffset,
    identify_imu_offset,
)
from jaxid.measurement.observations import Progress, observe
from jaxid.measurement.recording import Recording
from jaxid.result_table import Remark, Status, percent, significant
from jaxid.robot.contacts import legs_of
from jaxid.robot.inertia import Inertia
from jaxid.robot.robot import Robot

from .leg_columns import column_mistakes
from .mistake_search import ignore_progress

STEP = 10
"""Samples for each row of the first fit, at most."""
MAX_STRETCHES = 5
"""Number of stretches with wrong flags that a finding lists."""


class ContactLimits(NamedTuple):
    """Limits of what flags and an IMU may say.

    In simulated logs of three quadrupeds, of 5 to 40 s, a leg in the air lacks less
    than a tenth of the torque that it lacks while it stands, in a fit with right flags.
    In logs of a Go2, a mass at a foot that always stands changes forces by less than
    0.4 % of what it does in the trunk; at a foot that is lifted, by twice as much.
    """

    load: float = 0.3  # torque that a leg in the air may lack, over that of standing
    unexplained: float = 0.15  # the same, in a fit with the flags as they are
    duration: float = 0.2  # shortest stretch that is judged [s]
    gravity: float = 0.05  # deviation of the mean acceleration, relative
    vertical_bias: float = 0.04  # the same [m/s²]; gravity on Earth differs by 0.03
    correlation: float = 0.6  # of flags with loads, summed over the feet, that tells
    mass: float = 0.02  # effect of a mass at a lifted foot, over that in the trunk
    # rotation [rad], displacement [m] and biases of an IMU [rad/s, m/s²] that are
    # usual: norms of what intervals leave of the three axes
    imu: tuple[float, ...] = (np.deg2rad(1.0), 0.03, 0.02, 0.05)
    turn: float = np.deg2rad(10.0)  # rotation that spoils any fit [rad]
    slip: float = 2.0  # error of feet that slip, over half of the 95 % interval
    # what no IMU can have: unexplained [rad/s, m/s²], displacement [m] and biases
    imu_errors: tuple[float, ...] = (0.2, 1.0, 1.0, 0.5, 2.0)


LIMITS = ContactLimits()


class CheckedContacts(NamedTuple):
    """Recording whose flags may be corrected, and what was found, as sentences.

    Attributes:
        recording: Recording in which loaded legs stand.
        findings: What needs a look.
        mistakes: What is wrong with columns, IMU or flags, so that no fit is right.
    """

    recording: Recording
    findings: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()


class LegTorques(NamedTuple):
    """Torques that the legs lack if they are in the air.

    Attributes:
        times: Times of the rows [s].
        stands: Whether each foot is called standing [rows feet].
        missing: Norm of the torques that each leg lacks [rows feet].
    """

    times: np.ndarray
    stands: np.ndarray
    missing: np.ndarray


def check_contacts(
    base: BaseParameters,
    recording: Recording,
    filter: AbstractFilter,
    progress: Progress = ignore_progress,
) -> CheckedContacts:
    """Return a recording in which loaded legs stand, and what its columns hide.

    What is wrong spoils all that is checked after it, which is then left out.

    Args:
        base: Base parameters of the robot, which has contacts.
        recording: Log of the robot.
        filter: Filter of the log.
        progress: Callback, called with the completed fraction (0 to 1) of a search.

    Raises:
        InputError: If the recording lacks signals of the base.
    """
    robot = base.model.robot
    mistakes = column_mistakes(base, recording, progress)
    if mistakes:
        return CheckedContacts(recording, mistakes=tuple(mistakes))
    standing_torques = _missing_torques(
        base, all_standing(recording, robot), recording, filter
    )
    flag_text = _flag_mistake(robot, standing_torques)
    if flag_text:
        return CheckedContacts(recording, mistakes=(flag_text,))
    remarks = imu_remarks(robot, recording, filter)
    imu_texts = tuple(remark.text for remark in remarks)
    if any(remark.status is Status.BAD for remark in remarks):
        return CheckedContacts(recording, mistakes=imu_texts)
    loads = _loads(robot, recording, standing_torques)
    doubtful = {place: load for place, load in loads.items() if load > LIMITS.load}
    if not doubtful:
        return CheckedContacts(recording, imu_texts)
    # A short log in which all feet stand tells too little of a leg to predict it;
    # right flags explain its torques.
    with contextlib.suppress(InputError):
        torques = _missing_torques(base, recording, recording, filter)
        unexplained = _loads(robot, recording, torques)
        doubtful = {
            place: load
            for place, load in doubtful.items()
            if unexplained.get(place, 0.0) > LIMITS.unexplained
        }
    return _with_loaded_feet(robot, recording, doubtful, imu_texts)


def _with_loaded_feet(
    robot: Robot,
    recording: Recording,
    doubtful: dict[tuple[int, int], float],
    findings: tuple[str, ...],
) -> CheckedContacts:
    """Return the recording with standing feet where they carry load."""
    signals = base_of(recording, robot)
    stands = signals.stands.copy()
    stretches = {}
    for (foot, sample), load in doubtful.items():
        start, stop = _stretch(signals.stands[:, foot], sample)
        stands[start:stop, foot] = True
        times = f"{recording.time[start]:.1f} s to {recording.time[stop - 1]:.1f} s"
        name = robot.contacts[foot].name
        stretches[foot, start] = f"`{name}` from {times} ({100 * load:.0f} %)"
    if not stretches:
        return CheckedContacts(recording, findings)
    texts = list(stretches.values())
    if len(texts) > MAX_STRETCHES:
        texts[MAX_STRETCHES:] = [f"{len(texts) - MAX_STRETCHES} more"]
    finding = (
        f"feet are called in the air, but their legs carry load: {', '.join(texts)} of "
        "that of a leg that stands: they count as standing there; check "
        "`recording.contact`."
    )
    signals = dataclasses.replace(signals, contacts=stands.astype(float))
    checked_recording = dataclasses.replace(recording, base=signals)
    return CheckedContacts(checked_recording, (*findings, finding))


def _flag_mistake(robot: Robot, torques: LegTorques) -> str:
    """Return that all flags are inverted or in another order, as the loads tell."""
    feet = len(robot.contacts)
    # Most feet stand most of the time: how much load they carry then does not matter.
    loads = np.minimum(torques.missing, np.median(torques.missing, axis=0))
    # A flag that never changes tells nothing.
    with np.errstate(invalid="ignore", divide="ignore"):
        correlations = np.corrcoef(loads.T, torques.stands.T)
    scores = np.nan_to_num(correlations[:feet, feet:])
    own_score = np.trace(scores)
    is_mostly_in_the_air = torques.stands.mean() < 0.5
    if is_mostly_in_the_air and own_score < -LIMITS.correlation:
        return (
            "the flags of contact are inverted: legs carry load where their feet are "
            "called in the air, and only there (`recording.contact_inverted = true`)."
        )
    legs, flags = scipy.optimize.linear_sum_assignment(-scores)
    if scores[legs, flags].sum() < abs(own_score) + LIMITS.correlation:
        return ""
    names = [f"`{robot.contacts[foot].name}`" for foot in legs[flags != legs]]
    return (
        f"the flags of {' and '.join(names)} are exchanged: each tells when another "
        "leg carries load (`recording.contact`, in the order of `robot.contacts`)."
    )


def _loads(
    robot: Robot, recording: Recording, torques: LegTorques
) -> dict[tuple[int, int], float]:
    """Return the loads of legs in the air, relative to standing, by foot and sample."""
    times, row_stands, missing = torques
    stands = base_of(recording, robot).stands
    log_times = np.asarray(recording.time)
    sizes = [
        np.sqrt(np.mean(torque[is_standing] ** 2)) if is_standing.any() else 0.0
        for torque, is_standing in zip(missing.T, row_stands.T, strict=True)
    ]
    # A leg that never stands is compared with the others; if none does, with all.
    largest_size = max(sizes) or np.sqrt(np.mean(missing**2))
    usual_sizes = np.where(np.array(sizes) > 0.0, sizes, largest_size)
    min_samples = LIMITS.duration / recording.sample_time
    loads = {}
    for a, b in contact_grid(recording, robot).segments:
        is_inside = (times >= log_times[a]) & (times <= log_times[b - 1])
        # A stretch without rows changes no fit.
        if b - a < min_samples or not is_inside.any():
            continue
        torques_inside = np.sqrt(np.mean(missing[is_inside] ** 2, axis=0))
        for foot in np.flatnonzero(~stands[a]).tolist():
            loads[foot, a] = float(torques_inside[foot] / usual_sizes[foot])
    return loads


def _stretch(stands: np.ndarray, sample: int) -> tuple[int, int]:
    """Return the samples around one in which a foot is in the air."""
    earlier = np.flatnonzero(stands[:sample])
    later = np.flatnonzero(stands[sample:])
    start = int(earlier[-1]) + 1 if earlier.size else 0
    stop = sample + int(later[0]) if later.size else len(stands)
    return start, stop


def _missing_torques(
    base: BaseParameters, log: Recording, recording: Recording, filter: AbstractFilter
) -> LegTorques:
    """Return the torques that each leg lacks if it is in the air.

    Args:
        base: Base parameters of the robot.
        log: The recording, with the flags that are assumed in the fit.
        recording: The recording, whose flags are checked.
        filter: Filter of the log.
    """
    robot = base.model.robot
    step = _row_step(filter, log.sample_time)
    rows = RegressionProblem(base, [observe(log, robot, filter, Subsample(step))])
    parameters = WeightedLeastSquares(ResidualVariances())(rows).parameters
    observations = rows.recordings[0]
    motion = observations.motion[::step]
    # Legs feel what moves them, whatever stands.
    predicted = base.forces_in_numpy(parameters, motion)
    differences = predicted - np.asarray(observations.forces)[::step]
    missing = []
    for joints in legs_of(robot).own_joints:
        missing.append(np.linalg.norm(differences[:, list(joints)], axis=1))
    times = observations.time[::step]
    stands = base_of(recording, robot).stands
    samples = np.searchsorted(np.asarray(recording.time), times)
    row_stands = stands[np.clip(samples, 0, len(stands) - 1)]
    return LegTorques(times, row_stands, np.stack(missing, axis=1))


def _row_step(filter: AbstractFilter, sample_time: float) -> int:
    """Return the samples for each row that keep what the filter lets through."""
    cutoff = filter.low_pass(sample_time).cutoff
    samples_of_half_period = 0.5 / (cutoff * sample_time)
    return max(1, min(STEP, int(np.ceil(samples_of_half_period)) - 1))


def standing_feet_findings(fit: Fit) -> list[str]:
    """Return a finding on feet that hardly leave the ground in the logs of a fit.

    A mass at a foot that stands does not move, and the ground carries it.
    """
    robot = fit.base.model.robot
    if not robot.contacts or fit.blocks is None:
        return []
    trunk_effect = _mass_effect(fit, robot.solid_bodies[0], (0.0, 0.0, 0.0))
    names = [
        f"`{foot.name}`"
        for foot in robot.contacts
        if _mass_effect(fit, foot.body, foot.position) < LIMITS.mass * trunk_effect
    ]
    if not names:
        return []
    return [
        f"The logs tell nothing of a mass at {', '.join(names)}, since a foot that "
        "stands does not move: the total mass and the bodies of these legs are not "
        "determined; lift these feet, and move these legs in the air."
    ]


def _mass_effect(fit: Fit, body: int, position: Sequence[float]) -> float:
    """Return the norm of the weighted forces of 1 kg at a point of a body."""
    model = fit.base.model
    start = model.parameter_names.index(f"m{model.robot.numbers[body]}")
    point_mass = Inertia(1.0, np.array(position), np.zeros((3, 3)))
    parameters = np.zeros(model.size)
    parameters[start : start + 10] = np.asarray(point_mass.parameters)
    R, _ = fit.factor
    return float(np.linalg.norm(R @ fit.base.from_standard(parameters)))


def _is_gravity(acceleration: float) -> bool:
    """Return whether a mean acceleration [m/s²] is that of gravity."""
    return abs(acceleration / STANDARD_GRAVITY - 1.0) <= LIMITS.gravity


def imu_remarks(
    robot: Robot, recording: Recording, filter: AbstractFilter
) -> list[Remark]:
    """Return remarks on the IMU: its unit, and its frame by gravity or the legs."""
    signals = base_of(recording, robot)
    gravity = measured_gravity(recording, robot)
    size = float(np.mean(np.linalg.norm(np.asarray(signals.accelerations), axis=1)))
    if not _is_gravity(gravity):
        # The vertical is unknown then.
        text = (
            f"the accelerometer measures {size:.3g} m/s² on average, but gravity is "
            f"{STANDARD_GRAVITY} m/s²: check `accelerometer_unit`, and that gravity is "
            "not subtracted."
        )
        if _is_gravity(size):
            text = (
                "the direction of gravity does not turn as the gyroscope says: check "
                "`gyro_unit`, and the signs and the order of the columns `gyro`."
            )
        return [Remark(text, Status.BAD)]
    offset = identify_imu_offset(recording, robot, filter)
    remarks = [] if offset is None else _offset_remarks(offset)
    if remarks or abs(gravity - STANDARD_GRAVITY) <= LIMITS.vertical_bias:
        return remarks
    share = percent(abs(gravity / STANDARD_GRAVITY - 1.0), 1)
    text = (
        f"the accelerometer measures {gravity:.2f} m/s² along the vertical, but "
        "gravity is 9.78 to 9.83 m/s²: its bias or scale makes all masses wrong by "
        f"{share} %; give `imu_offset = true` in `[recording]`, which removes a bias, "
        "or calibrate the sensor."
    )
    return [Remark(text, Status.DOUBTFUL)]


def _offset_remarks(offset: ImuOffset) -> list[Remark]:
    """Return that the IMU is not as it is described, as the legs tell it."""
    sizes = np.linalg.norm(offset.values, axis=1)
    if (np.append(offset.errors, sizes[1:]) > LIMITS.imu_errors).any():
        text = (
            "gyroscope and accelerometer do not follow the motion that the legs tell "
            "while all feet stand: check signs and order of the columns `gyro` and "
            "`accelerometer`, and `recording.contact`."
        )
        return [Remark(text, Status.BAD)]
    # Each axis for itself: a well-known one counts where another is hardly known.
    certain_sizes = np.abs(offset.values) - LIMITS.slip * offset.half_widths
    known_values = np.where(certain_sizes > 0, offset.values, 0.0)
    angle, distance, rate, acceleration = np.linalg.norm(known_values, axis=1)
    slope = np.rad2deg(acceleration / STANDARD_GRAVITY)
    words = (
        f"is turned by {significant(np.rad2deg(angle), 2)} degrees",
        f"is displaced by {significant(1e3 * distance, 2)} mm",
        f"has a gyroscope with a bias of {significant(rate, 2)} rad/s",
        f"has an accelerometer with a bias of {significant(acceleration, 2)} m/s² (or "
        f"the ground slopes by {slope:.1f} degrees)",
    )
    is_large = np.linalg.norm(known_values, axis=1) > LIMITS.imu
    faults = [text for text, is_fault in zip(words, is_large, strict=True) if is_fault]
    if not faults:
        return []
    text = (
        f"the IMU {', and '.join(faults)} against its description, as the legs tell "
        "while all feet stand: give `imu_offset = true` in `[recording]`, which "
        "estimates and removes it, or describe the IMU (`robot.imu`)."
    )
    is_spoilt = certain_sizes[0].max() > LIMITS.turn
    return [Remark(text, Status.BAD if is_spoilt else Status.DOUBTFUL)]
