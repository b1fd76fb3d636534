"""What is to be said of a designed motion, the same in the terminal and on its page."""

from collections.abc import Iterable, Sequence

import numpy as np

from jaxid.excitation.plan import VAGUE, ExcitationPlan
from jaxid.report.blocks import Remark, Tone
from jaxid.report.numbers import significant
from jaxid.robot.robot import Robot

DIMENSIONS = {
    "position_min": ("lower end of the range", ""),
    "position_max": ("upper end of the range", ""),
    "velocity": ("speed", "/s"),
    "acceleration": ("acceleration", "/s²"),
}
"""Limits that may be assumed, in words, and what they are per."""

ORDER = (Tone.PLAIN, Tone.GOOD, Tone.DOUBTFUL, Tone.BAD)
"""In which remarks are made."""


def remarks(plan: ExcitationPlan) -> tuple[Remark, ...]:
    """What a plan by itself knows, first what is plain; sentences without their full stops.

    Args:
        plan: The design.
    """
    published, unkept = plan.limits.limits.assumed, plan.diagnosis
    found = [
        Remark(
            Tone.PLAIN,
            f"standard deviations are {plan.mean_gain:.3g} times smaller than a random motion's",
        ),
        Remark(Tone.PLAIN, expectation(plan)),
    ]
    if published:
        text = f"limits that nobody published, assumed: {', '.join(published)}"
        found.append(Remark(Tone.DOUBTFUL, text))
    if plan.limits.assumed:
        text = f"assumed, because it is not given: {', '.join(assumptions(plan))}"
        found.append(Remark(Tone.DOUBTFUL, text))
    if plan.vague:
        text = f"deviations above {100 * VAGUE:g} % of the nominal value: {', '.join(plan.vague)}"
        found.append(Remark(Tone.DOUBTFUL, text))
    if plan.interrupted:
        text = "the design was stopped: `--resume` goes on where it was"
        found.append(Remark(Tone.DOUBTFUL, text))
    if plan.undetermined:
        text = f"this motion does not determine: {', '.join(plan.undetermined)}"
        found.append(Remark(Tone.BAD, text))
    return (*found, *(Remark(Tone.BAD, text) for text in unkept))


def ordered(said: Iterable[Remark]) -> list[Remark]:
    """First what is plain, last what is bad and must not be overlooked.

    Args:
        said: In any order.
    """
    return sorted(said, key=lambda remark: ORDER.index(remark.tone))


def expectation(plan: ExcitationPlan) -> str:
    """Behind which noise and which samples the expected deviations stand.

    Args:
        plan: The design.
    """
    robot = plan.base.model.robot
    start, then = plan.limits.basis.times(plan.samples)[:2]
    step = float(then - start)
    noise = [
        f"{significant(float(s))} {robot.force_unit(j)}"
        for j, s in enumerate(np.asarray(plan.noise))
    ]
    return (
        f"deviations to expect are those of {plan.samples} samples in {plan.samples * step:.4g} s "
        f"({1 / step:.4g} Hz), of one run, with white noise of the forces: standard deviation "
        f"{', '.join(grouped(robot, noise))}; of n runs they are √n times smaller"
    )


def assumptions(plan: ExcitationPlan) -> list[str]:
    """Limits that were assumed because nobody gave them, with their values.

    Args:
        plan: The design.
    """
    robot, limits = plan.base.model.robot, plan.limits.limits
    said = []
    for field, (words, per) in DIMENSIONS.items():
        values: list[str | None] = [None] * robot.joints
        for name, joint in plan.limits.assumed:
            if name == field:
                value = float(np.asarray(getattr(limits, field))[joint])
                values[joint] = f"{value:.4g} {robot.joint_unit(joint)}{per}"
        said += [f"{words} {text}" for text in grouped(robot, values, "of ")]
    return said


def grouped(robot: Robot, values: Sequence[str | None], of: str = "") -> list[str]:
    """Joints with the same text together: `all joints (8 rad/s²)`.

    Args:
        robot: Whose joints they are.
        values: A text for each joint; None for those that are left out.
        of: Stands before the joints.
    """
    found = []
    for value in dict.fromkeys(v for v in values if v is not None):
        joints = [j for j, v in enumerate(values) if v == value]
        found.append(f"{of}{named(robot, joints)} ({value})")
    return found


def named(robot: Robot, joints: Iterable[int]) -> str:
    """Joints by their names, or all of them.

    Args:
        robot: Whose joints they are.
        joints: From 0.
    """
    names = [robot.joint_names[j] for j in joints]
    if len(names) == robot.joints > 1:
        return "all joints"
    return ", ".join(f"`{name}`" for name in names)
