"""Checks of a designed motion, a remark each: joints, loops, shapes, forces."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxid.excitation.constraints import Finding, LoopLimits
from jaxid.excitation.design_result import USUAL_NOISE, ExcitationPlan
from jaxid.result_table import Remark, Status
from jaxid.robot.contacts import Sole
from jaxid.robot.shapes import HalfSpace
from jaxid.robot.virtual_joints import GROUP
from jaxid.trajectory.motion_on_feet import MotionOnFeet

from .surroundings import Surroundings

GAIN_OVER_MOMENT = 2.0
"""Gain of a controller that also adds forces, over weight times height [1/rad]."""
GAIN_OVER_TORQUE = 20.0
"""Gain of one that does not, over the largest torque [1/rad]."""
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


def describe_standing(plan: ExcitationPlan, motion: MotionOnFeet) -> Iterator[Remark]:
    """Yield the standing pose, the phases, and what is not known of standing.

    Args:
        plan: Design of a robot on its feet.
        motion: Its motion.
    """
    robot = plan.robot
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
    # The noise of a moment on the trunk is a share of weight times height.
    gain = GAIN_OVER_MOMENT * float(plan.noise[GROUP - 1]) / USUAL_NOISE
    stiff_gain = GAIN_OVER_TORQUE * float(np.abs(motion.forces).max())
    alternative = f"they need gains of {stiff_gain:.0f} N m/rad"
    if any(isinstance(x.shape, Sole) for x in plan.base.model.robot.contacts):
        alternative = "a robot on soles falls"
    yield Remark(
        "standing on the feet: not checked are ground that is not level, and legs that "
        "give way under the weight: let controllers add the forces `tau_…` of the "
        "table, which rest on the nominal parameters, to gains of at least "
        f"{gain:.0f} N m/rad (twice the weight times the height of the trunk); without "
        f"these forces {alternative}; and secure the robot against a fall",
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
