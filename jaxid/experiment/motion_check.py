"""Checks of a designed motion, one remark each: joints, floor, self-collision, forces."""

from collections.abc import Iterator

import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints import Finding, ForceLimits
from jaxid.excitation.design_result import ExcitationPlan
from jaxid.result_table import Remark, Status
from jaxid.robot.shapes import HalfSpace

from .experiment import Experiment

POSES = 2000
"""Number of random poses in which the forces of gravity are computed."""


def motion_checks(
    experiment: Experiment, plan: ExcitationPlan, force_fault: str
) -> Iterator[Remark]:
    """Yield one remark for each check of a motion: kept, exceeded, or why it was not checked.

    Args:
        experiment: Experiment whose motion was designed.
        plan: Designed motion; what its findings name was checked.
        force_fault: Why forces were not checked; empty if they were.
    """
    use = np.asarray(plan.use)
    excess = (
        use[: 4 if np.isfinite(np.asarray(plan.limits.limits.jerk)).any() else 3].max()
        - 1.0
    )
    text = (
        "positions, speeds and accelerations: all joints keep their limits at all times"
    )
    if excess > 1e-6:
        text = (
            "positions, speeds and accelerations: limits are exceeded by "
            f"{100 * excess:.2g} %"
        )
    yield Remark(text, Status.BAD if excess > 1e-6 else Status.GOOD)
    faults, shapes = experiment.surroundings.faults, experiment.surroundings.shapes
    near = [f for f in plan.findings if f.name.startswith("the clearance of ")]
    obstacles = () if shapes is None else shapes.obstacles
    floors = [o.name for o in obstacles if isinstance(o, HalfSpace)]
    on_floor = [
        f for f in near if any(f.name.endswith(f" and {floor}") for floor in floors)
    ]
    apart = [f for f in near if f not in on_floor]
    if floors and on_floor:
        yield _judge("floor", on_floor)
    elif floors:
        yield Remark("floor: no shape of the robot can come near it", Status.GOOD)
    elif experiment.collision.floor is False:
        yield Remark("floor: not checked, as `floor = false` asks", Status.DOUBTFUL)
    else:
        yield Remark(
            "floor: not checked, for no shape of the robot is known", Status.BAD
        )
    for note in () if shapes is None else shapes.notes:
        yield Remark(f"self-collision: {note}", Status.DOUBTFUL)
    for fault in faults:
        yield Remark(f"self-collision: {fault}", Status.BAD)
    if apart:
        yield _judge("self-collision", apart)
    elif not experiment.collision.fit:
        yield Remark(
            "self-collision: not checked, as `fit = false` asks", Status.DOUBTFUL
        )
    elif not faults:
        yield Remark("self-collision: no two bodies can meet", Status.GOOD)
    forces = [
        f for f in plan.findings if f.name.startswith(("the force of", "the torque of"))
    ]
    if force_fault:
        yield Remark(f"forces: {force_fault}", Status.BAD)
    elif forces:
        yield _judge("forces by the nominal parameters", forces)


def _judge(name: str, findings: list[Finding]) -> Remark:
    """Return a remark about the quantity that is nearest to its limit, or furthest beyond it."""
    worst = max(findings, key=lambda finding: finding.value)
    verb = "keep their limits" if worst.value <= 0 else "do not keep their limits"
    said = str(worst).removeprefix("the ")
    text = f"{name}: {len(findings)} quantities {verb}; the nearest: {said}"
    return Remark(text, Status.GOOD if worst.value <= 0 else Status.BAD)


def gravity_fault(experiment: Experiment, limits: ForceLimits) -> str:
    """Return which joint cannot hold the robot in any pose of its range; empty if all can."""
    robot = experiment.robot
    low, high = (
        np.asarray(getattr(robot.limits, f"position_{x}")) for x in ("min", "max")
    )
    ends = np.where(robot.revolute, np.pi, 1.0)
    low, high = (
        np.where(np.isfinite(low), low, -ends),
        np.where(np.isfinite(high), high, ends),
    )
    q = np.random.default_rng(0).uniform(low, high, (POSES, robot.joints))
    q[0] = np.clip(0.0, low, high)
    with double_precision():
        values: Float[np.ndarray, "poses values"] = np.asarray(
            limits(robot, Motion(q, np.zeros_like(q), np.zeros_like(q)))
        )
    worst = values.max(axis=1)
    best = int(worst.argmin())
    if worst[best] <= 0:
        return ""
    finding = limits.entries(robot)[int(values[best].argmax())]
    needed = finding.limit * (1.0 + worst[best])
    return (
        f"in every one of {POSES} poses gravity needs more than the limits of the "
        "forces allow; "
        f"at best {finding.name} needs {needed:.3g} of {finding.limit:.3g} "
        f"{finding.unit}: check "
        "efforts and inertias of the robot's file, or give `limits.force`"
    )
