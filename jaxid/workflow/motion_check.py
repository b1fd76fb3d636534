"""Checks of a designed motion, a remark each: joints, loops, shapes, forces."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxid.excitation.constraints import Finding, LoopLimits
from jaxid.excitation.design_result import ExcitationPlan
from jaxid.result_table import Remark, Status
from jaxid.robot.robot import Robot
from jaxid.robot.shapes import HalfSpace
from jaxid.trajectory.motion_on_feet import MotionOnFeet

from .surroundings import Surroundings

MAX_ROUNDING = 1e-6
"""Excess over a limit of the joints that counts as rounding, relative to the limit."""


def check_motion(
    surroundings: Surroundings, plan: ExcitationPlan, force_fault: str
) -> Iterator[Remark]:
    """Yield a remark for each check of a motion: kept, exceeded, why not checked.

    Args:
        surroundings: Shapes that must keep a distance.
        plan: Designed motion, and its findings on what was checked.
        force_fault: Why forces were not checked; empty if they were.
    """
    yield check_joints(plan)
    yield from check_loops(plan)
    floors = [x.name for x in surroundings.obstacles if isinstance(x, HalfSpace)]
    floor_findings = []
    other_findings = []
    for finding in plan.findings:
        if finding.name.startswith("the clearance of "):
            is_of_floor = any(finding.name.endswith(f" and {x}") for x in floors)
            group = floor_findings if is_of_floor else other_findings
            group.append(finding)
    force_findings = [
        finding
        for finding in plan.findings
        if finding.name.startswith(("the force of", "the torque of"))
    ]
    if plan.base.model.robot.floating:
        known_findings = [*other_findings, *force_findings]
        findings = [x for x in plan.findings if x not in known_findings]
        yield judge("standing on the feet", findings)
    else:
        yield check_floor(surroundings, bool(floors), floor_findings)
    yield from check_self_collision(surroundings, other_findings)
    if force_fault:
        yield Remark(f"forces: {force_fault}", Status.BAD)
    elif force_findings:
        yield judge("forces by the nominal parameters", force_findings)
        doubts = plan.base.model.robot.remarks
        yield from (remark for remark in doubts if remark.status is Status.DOUBTFUL)


def check_joints(plan: ExcitationPlan) -> Remark:
    """Return whether the joints keep their limits."""
    derivatives = 4 if np.isfinite(plan.limits.jerk).any() else 3
    excess = plan.use[:derivatives].max() - 1.0
    quantities = "positions, speeds, accelerations"
    if excess > MAX_ROUNDING:
        text = f"{quantities}: limits are exceeded by {100 * excess:.2g} %"
        return Remark(text, Status.BAD)
    return Remark(
        f"{quantities}: all joints keep their limits {plan.occasion}", Status.GOOD
    )


def describe_standing(robot: Robot, motion: MotionOnFeet) -> Iterator[Remark]:
    """Yield the standing pose, the phases, and what is not known of standing.

    Args:
        robot: Robot of the driven joints.
        motion: Its motion.
    """
    pose = np.asarray(motion.motion(np.zeros(1)).q)[0]
    angles = ", ".join(
        f"{name} {angle:.3f}"
        for name, angle in zip(robot.joint_names, pose, strict=True)
    )
    yield Remark(f"standing pose, at the begin and at the end [rad]: {angles}")
    lifts = ", ".join(
        f"{foot} from {start:.2f} to {stop:.2f} s"
        for foot, (start, stop) in zip(motion.feet, motion.lifts, strict=True)
    )
    yield Remark(
        f"feet in the air: {lifts}; columns `contact_…` of the table are 0 then"
    )
    yield Remark(
        "standing on the feet: not checked are ground that is not level, and legs that "
        "give way under the weight: give controllers gains of 20 rad⁻¹ times the "
        "largest torque, or a larger `support_margin`, and secure the robot against a "
        "fall",
        Status.DOUBTFUL,
    )


def check_loops(plan: ExcitationPlan) -> Iterator[Remark]:
    """Yield whether closed loops keep their limits, if the robot has loops."""
    robot = plan.base.model.robot
    if not robot.loops:
        return
    names = [entry.name for entry in LoopLimits().entries(robot)]
    findings = [finding for finding in plan.findings if finding.name in names]
    yield judge("closed loops", findings)


def check_floor(
    surroundings: Surroundings, has_floor: bool, findings: Sequence[Finding]
) -> Remark:
    """Return whether the robot stays above the floor."""
    if has_floor and findings:
        return judge("floor", findings)
    if has_floor:
        return Remark("floor: no shape of the robot can reach it", Status.GOOD)
    if surroundings.collision.floor is False:
        text = "floor: not checked, because of `floor = false`"
        return Remark(text, Status.DOUBTFUL, unchecked="floor")
    return Remark(
        ("floor: not checked, since no shape of the robot is known"), Status.BAD
    )


def check_self_collision(
    surroundings: Surroundings, findings: Sequence[Finding]
) -> Iterator[Remark]:
    """Yield whether bodies keep their distance, and which shapes are not known."""
    for note in surroundings.notes:
        yield Remark(f"self-collision: {note}", Status.DOUBTFUL)
    for fault in surroundings.faults:
        yield Remark(f"self-collision: {fault}", Status.BAD)
    if findings:
        yield judge("self-collision", findings)
    elif not surroundings.collision.fit:
        text = "self-collision: not checked, because of `fit = false`"
        yield Remark(text, Status.DOUBTFUL, unchecked="self-collision")
    elif not surroundings.faults:
        yield Remark("self-collision: no two bodies can touch", Status.GOOD)


def judge(name: str, findings: Sequence[Finding]) -> Remark:
    """Return a remark on the quantity nearest to its limit, or furthest beyond it."""
    worst_finding = max(findings, key=lambda finding: finding.value)
    kept_limits = sum(finding.value <= 0 for finding in findings)
    text = (
        f"{name}: {kept_limits} of {len(findings)} limits are kept; the closest: "
        f"{str(worst_finding).removeprefix('the ')}"
    )
    return Remark(text, Status.GOOD if worst_finding.value <= 0 else Status.BAD)
