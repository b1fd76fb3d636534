"""Design of the motion that identifies best, within all limits that can be checked."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import jax
import numpy as np

from jaxid.arrays import Texts, double_precision
from jaxid.errors import InputError
from jaxid.excitation.constraints import AbstractConstraint, TipLimits
from jaxid.excitation.design import DesignProgress, design_excitation
from jaxid.excitation.design_result import ExcitationPlan
from jaxid.excitation.motions_on_feet import MotionsOnFeet, Standing
from jaxid.io import atomic_folder, import_extra
from jaxid.report.excitation_page import (
    motion_verdict,
    plan_remarks,
    write_excitation,
)
from jaxid.result_table import Remark, Status, Summarised, Table, sort_remarks
from jaxid.robot.limits_and_drives import complete_limits
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import driven_robot
from jaxid.trajectory.controllers import CONTROLLER_SUFFIXES, CONTROLLERS
from jaxid.trajectory.files import (
    load_trajectory,
    save_trajectory,
    write_csv,
    write_ros,
)
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.lead_in_and_out import WithLeads, with_leads
from jaxid.trajectory.motion_on_feet import MotionOnFeet
from jaxid.trajectory.trajectory import (
    AbstractBasis,
    AbstractTrajectory,
    LinearTrajectory,
    PaddedToCycle,
)

from .excitation_settings import HARMONICS_ON_FEET, STEP_ON_FEET, Excitation
from .motion_check import check_motion, describe_standing
from .nominal_parameters import (
    UNKNOWN_SHARE,
    LimitedForces,
    Nominal,
    find_nominal,
    limit_forces,
    require_weight,
)
from .setup import Progress, Setup, ignore_progress
from .surroundings import Surroundings, compared_on_feet

Improvement = Callable[[LinearTrajectory | MotionOnFeet], None]
"""Callback, called with every better motion that keeps all limits."""


class MotionTask(NamedTuple):
    """Motion to design, and all that its search needs to know.

    Attributes:
        setup: Robot, and the parameters to identify.
        excitation: Settings of the motion and of its search.
        surroundings: Shapes that must keep a distance.
        nominal: Parameters that are known; None without.
        constraints: Constraints beside the limits of the joints.
        force_fault: Why forces are not among the constraints; empty if they are.
        begin: Motion to go on with; None to begin anew.
    """

    setup: Setup
    excitation: Excitation
    surroundings: Surroundings
    nominal: Nominal | None
    constraints: tuple[AbstractConstraint, ...]
    force_fault: str
    begin: LinearTrajectory | MotionOnFeet | None = None

    @property
    def family(self) -> dict[str, Any]:
        """Arguments of `design_excitation` that say what kind of motion it is."""
        if not self.setup.robot.floating:
            return {"basis": self.basis}
        excitation = self.excitation
        parameters = cast(Nominal, self.nominal).parameters
        is_known = not np.isnan(parameters).any()
        margin = excitation.force_margin
        if margin is None:
            margin = 0.0 if is_known else UNKNOWN_SHARE
        standing = Standing(
            np.nan_to_num(parameters),
            excitation.pose,
            excitation.ground_friction,
            excitation.support_margin,
            excitation.sole_radius,
            margin,
        )
        return {
            "standing": standing,
            "harmonics": excitation.harmonics or HARMONICS_ON_FEET,
            "omega": excitation.omega,
        }

    @property
    def basis(self) -> AbstractBasis:
        """Basis of the motion, with leads where these have limits of their own."""
        # A design adds the limits of closed loops.
        has_constraints = bool(self.constraints or self.setup.robot.loops)
        return self.excitation.basis(has_constraints)

    @property
    def faults(self) -> Texts:
        """Sentences about all that will not be checked."""
        forces = (f"forces: {self.force_fault}",) if self.force_fault else ()
        return (*self.surroundings.faults, *forces)


class PlayableMotion(NamedTuple):
    """A motion as a robot can play it."""

    motion: AbstractTrajectory  # from standstill to standstill where that is possible
    # as it is written in samples: until a sample meets its end
    sampled_motion: AbstractTrajectory
    sample_time: float  # time between those samples [s]
    window: tuple[float, float]  # times between which it is the designed motion [s]
    fault: str  # why it does not start and end at rest; empty if it does, or need not


@dataclasses.dataclass(frozen=True, eq=False)
class DesignedMotion(Summarised):
    """Designed motion as a robot can play it."""

    plan: ExcitationPlan  # result of the optimisation
    playable: PlayableMotion  # motion that the robot plays
    remarks: tuple[Remark, ...]  # remarks beside those of the plan

    @property
    def verdict(self) -> Remark:
        """Whether the motion may be recorded, in one sentence."""
        return motion_verdict(self.plan, self.remarks)

    @property
    def findings(self) -> list[Remark]:
        """All remarks, the most severe first."""
        return sort_remarks((*plan_remarks(self.plan), *self.remarks))

    def overview(self) -> list[Table]:
        """Return the verdict and the findings; for a good motion the use of limits."""
        checks = [x for x in self.findings if x.status is not Status.NEUTRAL]
        lines = Table("", remarks=[self.verdict, *checks])
        # First must be corrected what the lines name; the page has all tables.
        if self.verdict.status is Status.BAD:
            return [lines]
        _, _, limits, *_ = self.plan.tables()
        return [lines, limits]

    def tables(self) -> list[Table]:
        """Return the tables of the plan, then all findings and the verdict."""
        lines = [*self.findings, self.verdict]
        return [*self.plan.tables(), Table("", remarks=lines)]


def prepare_motion(
    setup: Setup,
    excitation: Excitation,
    surroundings: Surroundings,
    earlier_design: Path | None = None,
) -> MotionTask:
    """Find the constraints of a design, and the motion of an earlier one to go on with.

    Args:
        setup: Robot, and the parameters to identify.
        excitation: Settings of the motion and of its search.
        surroundings: Shapes that must keep a distance.
        earlier_design: File of the motion to go on with (.json).

    Raises:
        InputError: If the settings do not fit the robot, or the earlier motion does not
            fit them.
    """
    require_playable(setup, excitation)
    nominal = find_nominal(setup, excitation)
    forces = LimitedForces(None, "")
    if setup.robot.floating:
        require_weight(setup, nominal)
    else:
        forces = limit_forces(setup, excitation, nominal)
    tip = TipLimits(
        excitation.tip_speed, excitation.tip_acceleration, *(excitation.workspace or ())
    )
    constraints: list[AbstractConstraint] = []
    if surroundings.clearance is not None:
        constraints.append(surroundings.clearance)
    if tip.entries(setup.robot):
        constraints.append(tip)
    if forces.limits is not None:
        constraints.append(forces.limits)
    task = MotionTask(
        setup, excitation, surroundings, nominal, tuple(constraints), forces.fault
    )
    if setup.robot.floating:
        motions = MotionsOnFeet(setup.base, **task.family)
        surroundings = compared_on_feet(surroundings, motions)
        clearance = surroundings.clearance
        near_limits = () if clearance is None else (clearance,)
        task = task._replace(surroundings=surroundings, constraints=near_limits)
    if earlier_design is None:
        return task
    begin = load_trajectory(earlier_design)
    begin = begin.inner if isinstance(begin, WithLeads) else begin
    is_alike = isinstance(begin, MotionOnFeet)
    if not setup.robot.floating:
        basis = getattr(begin, "basis", None)
        is_alike = str(basis) == str(task.basis)
    if not is_alike:
        raise InputError(
            f"`{earlier_design}` holds a motion of another kind: design anew."
        )
    return task._replace(begin=begin)


def require_playable(setup: Setup, excitation: Excitation) -> None:
    """Reject settings that the controller or the file for ROS cannot have."""
    if excitation.ros == "mcap":
        import_extra("rosbags.rosbag2", "logs", "a bag of ROS 2 is written by")
    if excitation.controller is not None:
        CONTROLLERS[excitation.controller].require(setup.robot)
        if not excitation.rests:
            raise InputError(
                "`controller` needs a motion that starts and ends at rest: remove "
                "`leads = false`, or set `rest = true`."
            )


def design_motion(
    task: MotionTask,
    progress: Progress = ignore_progress,
    improvement: Improvement | None = None,
    seconds: float | None = None,
) -> DesignedMotion:
    """Design a motion.

    Args:
        task: Motion to design.
        progress: Callback, called with a stage and its completed fraction (0 to 1).
        improvement: Callback, called with every better motion that keeps all limits.
        seconds: Time for the search [s]; by default that of the settings.

    Raises:
        InputError: If the settings do not fit the robot, or no motion keeps all limits.
    """
    setup = task.setup
    excitation = task.excitation
    noise = None if excitation.noise is None else np.array(excitation.noise)
    plan = design_excitation(
        setup.base,
        **task.family,
        constraints=task.constraints,
        key=jax.random.key(excitation.seed),
        noise=noise,
        samples=excitation.count_samples(setup.robot),
        criterion=excitation.objective,
        starts=excitation.starts,
        generations=excitation.generations,
        progress=follow_design(progress, improvement),
        begin=task.begin,
        seconds=excitation.time if seconds is None else seconds,
    )
    playable_motion = make_playable(setup.robot, excitation, plan.trajectory)
    return DesignedMotion(
        plan, playable_motion, tuple(describe_motion(task, plan, playable_motion))
    )


def follow_design(
    progress: Progress, improvement: Improvement | None = None
) -> Callable[[DesignProgress], None]:
    """Return a design's callback that shows progress and hands better motions on."""
    best_value = np.inf

    def follow(step: DesignProgress) -> None:
        nonlocal best_value
        value = f", best so far {step.best:.5g}" if np.isfinite(step.best) else ""
        limits = "" if step.feasible else ", limits not yet kept"
        text = f"{step.task}{value}{limits}"
        progress(text, step.fraction)
        if improvement is not None and step.feasible and step.best < best_value:
            improvement(step.trajectory)
            best_value = step.best

    return follow


def make_playable(
    robot: Robot, excitation: Excitation, motion: LinearTrajectory | MotionOnFeet
) -> PlayableMotion:
    """Return a motion from standstill to standstill, in samples of the controller."""
    leads = excitation.chosen_leads
    times = np.asarray(motion.measured_times(excitation.count_samples(robot)))
    step = float(times[1] - times[0])
    begin = float(times[0])
    end = float(times[-1]) + step
    played_motion = motion
    fault = ""
    if isinstance(motion, MotionOnFeet):
        # It stands still at both ends.
        leads = None
        step = STEP_ON_FEET
    # Where there are constraints, leads were designed together with the motion.
    elif leads is not None and isinstance(motion.basis, FourierBasis):
        limited_robot = robot.replace(limits=complete_limits(robot))
        try:
            played_motion = with_leads(motion, limited_robot, periods=leads.periods)
            begin, end = (float(time) for time in played_motion.window)
        except InputError as error:
            fault = (
                "the motion has no lead in or out, so it starts and ends at full "
                f"speed: {error} `rest = true` designs a motion that starts and ends "
                "at rest."
            )
    elif leads is not None:
        end = begin + leads.periods * (end - begin)
    sampled_motion = played_motion
    if excitation.cycle is not None:
        step = excitation.cycle
        if excitation.rests and not fault:
            sampled_motion = PaddedToCycle(played_motion, step)
    return PlayableMotion(played_motion, sampled_motion, step, (begin, end), fault)


def write_design(
    task: MotionTask,
    design: DesignedMotion,
    output: Path,
    command: str = "",
    experiment_text: str = "",
) -> list[Path]:
    """Write a motion as `write_motion` does, and its page; return the files.

    Args:
        task: Motion that was designed.
        design: Designed motion.
        output: Table of the motion (.csv); the page is in a folder beside it.
        command: Command to repeat the design, for the page.
        experiment_text: Text of the experiment file, for the page.
    """
    facts = (("seed", str(task.excitation.seed)),)
    settings = {"facts": facts, "experiment_text": experiment_text, "command": command}
    # First the page: where there is no room for pictures, nothing changes.
    pages = write_excitation(
        output.with_suffix(""),
        design.plan,
        design.playable.motion,
        design.remarks,
        settings,
        task.surroundings.shapes,
    )
    motion_files = write_motion(
        design.plan.robot, task.excitation, design.playable, output
    )
    return motion_files + pages


def write_best_motion(
    task: MotionTask, motion: LinearTrajectory | MotionOnFeet, output: Path
) -> None:
    """Write a motion of a search, as it can be played."""
    robot = driven_robot(task.setup.robot)
    playable = make_playable(robot, task.excitation, motion)
    write_motion(robot, task.excitation, playable, output)


def write_motion(
    robot: Robot, excitation: Excitation, playable: PlayableMotion, output: Path
) -> list[Path]:
    """Write table, trajectory and ROS message of a motion; return the files."""
    sampled_motion = playable.sampled_motion
    step = playable.sample_time
    table = output.name
    message = f"{output.stem}.ros.{excitation.ros}"
    trajectory = f"{output.stem}.json"
    names = [table, message, trajectory]
    replaced_names = {f"{output.stem}{suffix}" for suffix in CONTROLLER_SUFFIXES}
    with (
        double_precision(),
        atomic_folder(output.parent, lambda _: replaced_names) as folder,
    ):
        write_csv(sampled_motion, robot, folder / table, sample_time=step)
        write_ros(sampled_motion, robot, folder / message, sample_time=step)
        controller = CONTROLLERS.get(excitation.controller or "")
        if controller is not None and controller.write and not playable.fault:
            program = f"{output.stem}{controller.suffix}"
            controller.write(sampled_motion, robot, folder / program, step)
            names.append(program)
        motion = jax.tree.map(np.asarray, playable.motion)
        save_trajectory(motion, folder / trajectory)
    return [output.parent / name for name in names]


def describe_motion(
    task: MotionTask, plan: ExcitationPlan, playable: PlayableMotion
) -> Iterator[Remark]:
    """Yield what must be known of a designed motion beside its plan."""
    excitation = task.excitation
    if playable.fault:
        yield Remark(playable.fault, Status.BAD)
    begin, end = playable.window
    if begin > 0:
        yield Remark(
            "the robot starts at rest and follows the designed motion from "
            f"{begin:.3f} to {end:.3f} s of {float(playable.motion.duration):.3f} s"
        )
    if excitation.noise is None:
        yield Remark(
            "the noise is assumed to be 1 % of the largest forces: "
            "give `noise` if it is known"
        )
    leads = excitation.chosen_leads
    if isinstance(plan.trajectory, MotionOnFeet):
        yield from describe_standing(plan, plan.trajectory)
    elif leads is not None and leads.periods > 1:
        yield Remark(
            f"the motion runs through {leads.periods} periods; the deviations are for "
            "one period"
        )
    yield from check_motion(task.surroundings, plan, task.force_fault)
    if task.nominal is not None:
        yield from describe_nominal(task, task.nominal)


def describe_nominal(task: MotionTask, nominal: Nominal) -> Iterator[Remark]:
    """Yield what the forces of a motion leave out."""
    unknown_names = [
        name
        for name, value in zip(task.setup.base.names, nominal.parameters, strict=True)
        if np.isnan(value)
    ]
    if unknown_names:
        text = f"unknown, and taken as zero in the forces: {', '.join(unknown_names)}"
        if task.excitation.force_margin is None:
            text += (
                f"; so {100 * UNKNOWN_SHARE:g} % of the largest "
                "forces are kept free (`force_margin`)"
            )
        yield Remark(text, Status.DOUBTFUL)
    if nominal.undetermined:
        text = (
            f"`{task.excitation.nominal}` does not determine "
            f"{', '.join(nominal.undetermined)}: their uncertainty is taken as zero"
        )
        yield Remark(text, Status.DOUBTFUL)
