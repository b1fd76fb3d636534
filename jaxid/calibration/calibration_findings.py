"""Whether a calibrated geometry may be used: findings, the verdict first."""

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy

from jaxid.result_table import Remark, Status, significant, sort_remarks

if TYPE_CHECKING:
    from .geometry_fit import GeometryFit

MAX_EXAMPLES = 5
"""Number of poses or places that a sentence names."""
MIN_POSES = 10
"""Number of different poses of a place below which it tells little."""
POSE_DECIMALS = 2
"""Decimals to which equal poses agree [rad or m]."""
MIN_DISTANCES = 3
"""Number of known distances below which they are not judged."""


class FindingLimits(NamedTuple):
    """Numbers above which something needs a look."""

    session_error: float = 2.5  # held out, relative to the median of all sessions
    shift: float = 0.01  # of an origin [m]
    turn: float = 0.05  # of an origin [rad]
    improvement: float = 0.8  # held-out errors over nominal ones
    share_of_reach: float = 0.005  # held-out errors over the robot's reach


LIMITS = FindingLimits()


def calibration_findings(fit: "GeometryFit") -> list[Remark]:
    """Return the verdict and all findings, the most severe first."""
    findings = [
        *(Remark(note, Status.DOUBTFUL) for note in fit.notes),
        *_on_search(fit),
        *_on_few_poses(fit),
        *_on_wrong_poses(fit),
        *_on_corrections(fit),
        *_on_held_out_sessions(fit),
    ]
    sorted_findings = sort_remarks(findings)
    return [_verdict(fit, sorted_findings), *sorted_findings]


def _verdict(fit: "GeometryFit", findings: list[Remark]) -> Remark:
    """Return the sentence that sums up the result."""
    worst = findings[0].status if findings else Status.GOOD
    if not fit.can_hold_out:
        sentence = (
            "The geometry was not checked on sessions that it has not seen: this takes "
            f"three, but there are {len(fit.problem.sessions)}. Record more; or, if "
            "each file is a session, name the files instead of their folder; or divide "
            "the poses (`parts` in the experiment file)"
        )
        return Remark(sentence, worst if worst is Status.BAD else Status.DOUBTFUL)
    before = 1e3 * fit.mean_error(fit.held_out.nominal)
    after = 1e3 * fit.mean_error(fit.held_out.calibrated)
    numbers = f"from {significant(before)} to {significant(after)} mm"
    comparison = ""
    if after > 1e3 * LIMITS.share_of_reach * fit.problem.reach:
        comparison = "not that of this robot"
    if after > LIMITS.improvement * before:
        comparison = "hardly better than the nominal one"
    if comparison:
        text = (
            f"The calibrated geometry is {comparison}: on sessions held out in turn, "
            f"the mean error changes {numbers}; do not use it, and check joint "
            "coordinates, units and the robot's file"
        )
        return Remark(text, Status.BAD)
    text = f"On sessions held out in turn, the mean error falls {numbers}"
    if worst is Status.BAD:
        text += ", but do not use the geometry: first correct what is marked ✗"
    if worst is Status.DOUBTFUL:
        text += "; look at what is marked ! before you use the geometry"
    return Remark(text, worst)


def _on_search(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield a finding if the search has not ended."""
    if not fit.solution.adjustment.has_converged:
        yield Remark(
            "The search has not ended: check the joint coordinates and their units, "
            "and the robot's file",
            Status.BAD,
        )


def _on_few_poses(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield a finding on places with few different poses."""
    poses = fit.problem.poses
    counts = {}
    for place in np.unique(poses.place[poses.is_pose]):
        rows = poses.is_pose & (poses.place == place)
        q = np.round(poses.q[rows], POSE_DECIMALS)
        count = len(np.unique(q, axis=0))
        if count < MIN_POSES:
            counts[" ".join(fit.problem.frame_keys[place]).strip()] = count
    if counts:
        examples = [f"{name} ({count})" for name, count in counts.items()]
        yield Remark(
            f"Places with few different poses: {', '.join(examples[:MAX_EXAMPLES])}; "
            "record 20 to 30 in each",
            Status.DOUBTFUL,
        )


def _on_wrong_poses(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield a finding on poses that were left out."""
    poses = np.flatnonzero(fit.solution.is_wrong)
    if not len(poses):
        yield Remark("All poses belong to each other", Status.GOOD)
        return
    largest_first = poses[np.argsort(-fit.errors.lengths[poses])]
    examples = [
        f"{fit.problem.pose_names[pose]} ({significant(1e3 * length, 2)} mm)"
        for pose, length in zip(
            largest_first[:MAX_EXAMPLES],
            fit.errors.lengths[largest_first],
            strict=False,
        )
    ]
    yield Remark(
        f"{len(poses)} of {fit.problem.poses.is_pose.sum()} poses do not belong to the "
        f"others and were left out: {'; '.join(examples)}",
        Status.DOUBTFUL,
    )


def _on_corrections(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield findings on corrections and compliances that no robot should have."""
    sizes = np.abs(fit.origins)
    is_large = (sizes[:, :3] > LIMITS.shift) | (sizes[:, 3:] > LIMITS.turn)
    joints = [
        f"{fit.problem.robot.body_names[joint]} "
        f"({significant(1e3 * sizes[joint, :3].max(), 2)} mm, "
        f"{significant(1e3 * sizes[joint, 3:].max(), 2)} mrad)"
        for joint in np.flatnonzero(is_large.any(axis=1))
    ]
    if joints:
        yield Remark(
            f"The corrections of {', '.join(joints)} are larger than manufacturing "
            "errors: is it the file of this robot, and are the zeros of these joints "
            "right?",
            Status.DOUBTFUL,
        )
    values = fit.combinations.of(fit.values)
    upper_ends = values + fit.uncertainty.half_widths()
    for leader, end in zip(fit.combinations.leaders, upper_ends, strict=True):
        correction = fit.corrections[leader]
        if correction.kind == "compliance" and end < 0.0:
            yield Remark(
                f"The {correction.words} is negative: check the direction of gravity "
                "and the masses",
                Status.DOUBTFUL,
            )


def _on_held_out_sessions(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield findings on sessions that disagree with the others."""
    if not fit.can_hold_out:
        return
    errors = fit.held_out.calibrated.lengths
    poses = fit.problem.poses_of_sessions
    # Single wrong poses are named anyway.
    sizes = np.array([np.median(errors[x]) for x in poses])
    limit = LIMITS.session_error * np.median(sizes)
    for session in np.flatnonzero(sizes > limit):
        name = fit.problem.sessions[session]
        yield Remark(
            f"Session `{name}` disagrees with the others: held out, its typical error "
            f"is {significant(1e3 * sizes[session])} mm; was something loose?",
            Status.DOUBTFUL,
        )
    yield from _on_known_distances(fit)


def _on_known_distances(fit: "GeometryFit") -> Iterator[Remark]:
    """Yield whether known distances are predicted in sessions that are held out."""
    errors = 1e3 * fit.held_out.distances
    if len(errors) < MIN_DISTANCES:
        return
    mean = errors.mean()
    deviation = errors.std(ddof=1) / np.sqrt(len(errors))
    half_width = scipy.special.stdtrit(len(errors) - 1, 0.975) * deviation
    is_systematic = abs(mean) > half_width
    text = (
        "Known distances, in sessions held out, are predicted with a mean error of "
        f"{significant(mean, 2)} ± {significant(half_width, 2)} mm (largest "
        f"{significant(np.abs(errors).max(), 2)} mm)"
    )
    if is_systematic:
        text += ": check the distance, and the unit of the robot's file"
    yield Remark(text, Status.DOUBTFUL if is_systematic else Status.GOOD)
