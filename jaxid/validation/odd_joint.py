"""The joint whose force does not belong to the log: without it, all others fit."""

import math
from typing import NamedTuple

import numpy as np

from jaxid.result_table import percent

from .descriptions import DescribedLog
from .row_fits import Judge


class OddJoint(NamedTuple):
    """A joint whose force does not fit, though the forces of the others do.

    Attributes:
        joint: Number of the joint.
        misfit: Fraction (0 to 1) of the forces of the others that is missed without it.
        gain: Its force over the one that the model of the others predicts.
        correlation: Correlation of both (-1 to 1).
    """

    joint: int
    misfit: float
    gain: float
    correlation: float


class OddJointLimits(NamedTuple):
    """When one joint explains that a model does not fit.

    On two simulated machines, whose model missed 15 to 50 % with one wrong column of
    forces, the others missed 1.1 to 1.6 % without it, as on a clean log; without any
    other joint they missed at least 4 times as much.
    """

    misfit: float = 0.04
    ratio: float = 3.0  # of the misfit without the next joint over that without it
    correlation: float = 0.9  # from which a gain is said
    cure: float = 3.0  # misfit with another mistake corrected, over that without it
    log_gain: float = 0.6  # smallest logarithm of a gain that the search does not find
    load: float = 0.25  # least force of a joint that is not passive, over its parts


LIMITS = OddJointLimits()


def odd_joint(described_log: DescribedLog) -> OddJoint | None:
    """Return the joint without whose force the model fits; None if there is none."""
    joints = described_log.rows.forces.shape[1]
    if joints == 1:
        return None
    candidates = [_without(described_log, joint) for joint in range(joints)]
    candidates.sort(key=lambda candidate: candidate.misfit)
    best, second = candidates[:2]
    is_alone = second.misfit > LIMITS.ratio * best.misfit
    return best if best.misfit < LIMITS.misfit and is_alone else None


def _without(described_log: DescribedLog, joint: int) -> OddJoint:
    """Return what a fit to the forces of the other joints says of one."""
    rows = described_log.rows
    judge = described_log.judge
    mask = judge.mask.copy()
    mask[:, joint] = False
    fit = Judge(mask, judge.folds).fit(rows)
    errors = np.delete(rows.relative_errors(fit.squares), joint)
    forces = rows.forces[:, joint]
    prediction = rows.columns[:, joint] @ fit.parameters
    product = forces @ prediction
    square = prediction @ prediction + 1e-300
    return OddJoint(
        joint=joint,
        misfit=float(np.sqrt(np.mean(errors**2))),
        gain=float(product / square),
        correlation=float(product / np.sqrt(square * (forces @ forces) + 1e-300)),
    )


def odd_joint_text(described_log: DescribedLog, odd: OddJoint, misfit: float) -> str:
    """Return a sentence that names the joint."""
    name = f"`{described_log.robot.joint_names[odd.joint]}`"
    return (
        f"the torque error of the model is {percent(misfit)} %, but "
        f"{percent(odd.misfit)} % without the force of joint {name}. That force seems "
        "to be wrong: check its column (`recording.forces`), its unit and gear "
        "(`recording.force_unit`, `force_gains`), and whether something pulls at the "
        "joint."
    )


def other_cause_text(described_log: DescribedLog, odd: OddJoint, text: str) -> str:
    """Return that the odd joint may be the cause, if a sentence blames other joints.

    A mistake that concerns several joints rarely leaves the others a perfect fit.
    """
    names = described_log.robot.joint_names
    blamed_joints = [j for j, name in enumerate(names) if f"`{name}`" in text]
    if blamed_joints == [odd.joint]:
        return ""
    return (
        f" Or only the force of joint `{names[odd.joint]}` is wrong (its column, unit "
        f"or gear): without it the error is {percent(odd.misfit)} %."
    )


def log_gain(odd: OddJoint | None) -> float | None:
    """Return the logarithm of a large gain of the force; None if there is none."""
    if odd is None or odd.correlation < LIMITS.correlation:
        return None
    logarithm = math.log(odd.gain)
    return logarithm if abs(logarithm) > LIMITS.log_gain else None


def missing_force_texts(described_log: DescribedLog) -> list[str]:
    """Return a sentence about each joint whose force is 0 though it carries a load.

    In a passive joint, gravity and inertia are each other's opposite: their sum is
    small beside them.
    """
    rows = described_log.rows
    fit = described_log.judge.fit(rows)
    robot = described_log.robot
    texts = []
    for joint in np.flatnonzero(~described_log.has_force):
        parts = rows.columns[:, joint] * fit.parameters
        force = _rms(parts.sum(axis=1))
        if force > LIMITS.load * _rms(np.abs(parts).sum(axis=1)):
            texts.append(
                f"the forces of joint `{robot.joint_names[joint]}` are 0 throughout, "
                f"but by those of the other joints it needs about {force:.2g} "
                f"{robot.force_unit(int(joint))}: it seems to be the wrong column "
                "(`recording.forces`)."
            )
    return texts


def _rms(x: np.ndarray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(x**2)))
