"""Page and remarks of a designed excitation motion."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxid.arrays import double_precision
from jaxid.dynamics.open_directions import status_of
from jaxid.excitation.design_result import ExcitationPlan
from jaxid.io import write_text
from jaxid.result_table import Remark, Status, significant, sort_remarks
from jaxid.robot.collision import CollisionModel
from jaxid.robot.limits_and_drives import listed
from jaxid.robot.virtual_joints import with_moving_base
from jaxid.trajectory.motion_on_feet import MotionOnFeet
from jaxid.trajectory.trajectory import AbstractTrajectory

from .motion_figures import joint_figure, speed_figure
from .page import Settings, picture, provenance, render_page


def plan_remarks(plan: ExcitationPlan) -> list[Remark]:
    """Return the assumptions and doubts that a reader of a design must know."""
    robot = plan.base.model.robot
    times = plan.trajectory.measured_times(plan.samples)
    step = float(times[1] - times[0])
    noise = ", ".join(
        f"{significant(float(deviation))} {robot.force_unit(j)}"
        for j, deviation in enumerate(plan.noise)
    )
    deviations = Remark(
        f"The expected deviations hold for one run of {plan.samples * step:.4g} s "
        f"({plan.samples} samples at {1 / step:.4g} Hz), if the measured forces have "
        f"random noise with a standard deviation of {noise}. With four runs they are "
        "half as large."
    )

    doubts = []
    unpublished_limits = ", ".join(plan.limits.assumed)
    if unpublished_limits:
        doubts.append(
            "The manufacturer has not published these limits, so they are assumed: "
            f"{unpublished_limits}"
        )
    if plan.assumed:
        doubts.append(
            "The robot's description lacks these limits, so they are assumed: "
            f"{_assumed_limits(plan)}"
        )
    if plan.interrupted:
        doubts.append("The search was stopped: `--resume` may find a better motion")
    remarks = [Remark(text, Status.DOUBTFUL) for text in doubts]
    return [*plan.remarks, deviations, *remarks]


def _assumed_limits(plan: ExcitationPlan) -> str:
    """Return the limits that were assumed, with their values and joints."""
    robot = plan.robot
    rate_units = {"velocity": "/s", "acceleration": "/s²"}
    joints_by_limit: dict[str, list[str]] = {}
    for name, j in plan.assumed:
        values = getattr(plan.limits, name)
        value = float(values[j])
        unit = f"{robot.joint_unit(j)}{rate_units.get(name, '')}"
        # Joints with the same value are named together.
        limit = f"{name} {value:.4g} {unit}"
        joints_by_limit.setdefault(limit, []).append(robot.joint_names[j])
    texts = []
    for limit, joints in joints_by_limit.items():
        are_all = len(joints) == robot.joints > 1
        texts.append(f"{limit} of {'all joints' if are_all else listed(joints)}")
    return ", ".join(texts)


def write_excitation(
    folder: Path,
    plan: ExcitationPlan,
    played: AbstractTrajectory,
    remarks: Sequence[Remark],
    settings: Settings,
    shapes: CollisionModel | None,
) -> list[Path]:
    """Write the page of a design; return its file.

    The motion as it is played is drawn among the `shapes`. `settings` tell the origin
    of the design as in `provenance`.
    """
    robot = plan.robot
    caption = (
        "The colour of a link shows the speed of its joint. The pale shapes were "
        "checked for collisions; grey ones do not move. Drag the picture to turn it."
    )
    with double_precision():
        time = np.linspace(0.0, float(played.duration), 801)
        motion = played.motion(time)
    limits = plan.limits
    scene_robot = robot
    scene_motion = motion
    if isinstance(played, MotionOnFeet):
        # The trunk moves, too.
        scene_robot = with_moving_base(plan.base.model.robot)
        scene_motion = played.path.motion(time)
    scene = speed_figure(scene_robot, scene_robot.limits, time, scene_motion, shapes)
    all_remarks = sort_remarks((*plan_remarks(plan), *remarks))
    criteria, deviations, *use = plan.tables()
    gain = (
        "Both motions use the same limits. Each criterion measures how well a motion "
        "determines the parameters: smaller is better."
    )
    sections = [
        ("Verdict", [motion_verdict(plan, remarks), all_remarks]),
        (
            "The motion",
            [
                picture(scene, caption),
                joint_figure(robot, limits, time, motion),
            ],
        ),
        ("Use of the limits", use),
        ("Comparison with a random motion", [gain, criteria]),
        ("Expected standard deviations", [deviations]),
        provenance(settings),
    ]
    page = render_page(
        f"{robot.name}: a motion to record",
        sections,
        f"Designed to determine {plan.base.size} base parameters of {robot.joints} "
        "joints.",
    )
    file = folder / "report.html"
    write_text(file, page)
    return [file]


def motion_verdict(plan: ExcitationPlan, remarks: Sequence[Remark]) -> Remark:
    """Return the verdict on a motion in one sentence; `remarks` has one per check."""
    status = Status.BAD
    unchecked_names = [remark.unchecked for remark in remarks if remark.unchecked]
    openness = status_of(plan.open_share)
    if openness is Status.BAD:
        text = "This motion does not determine all base parameters."
    elif not plan.feasible:
        text = "This motion does not keep all limits."
    elif any(remark.status is Status.BAD for remark in remarks):
        text = "Do not record this motion yet: first correct what is marked ✗."
    elif unchecked_names:
        status = Status.DOUBTFUL
        names = ", ".join(unchecked_names)
        text = f"This motion keeps all limits that were checked; not checked: {names}."
    elif openness is Status.DOUBTFUL:
        status = openness
        count = len(plan.undetermined)
        text = (
            "This motion keeps all limits, but one run leaves "
            f"{count} of {plan.base.size} combinations of parameters open: record it "
            "several times."
        )
    elif plan.mean_gain < 1.0:
        status = Status.DOUBTFUL
        text = (
            "This motion keeps all limits, but determines the parameters "
            f"{1.0 / plan.mean_gain:.3g} times worse than a random motion: search "
            "longer."
        )
    else:
        status = Status.GOOD
        text = "Record this motion: it keeps all limits and determines all parameters."
    return Remark(text, status)
