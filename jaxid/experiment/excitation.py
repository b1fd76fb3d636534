"""Design of the motion that an experiment file asks for, and the files that a robot can play."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.errors import InputError
from jaxid.excitation.constraints import AbstractConstraint, ForceLimits, TipLimits
from jaxid.excitation.criteria import CRITERIA, information
from jaxid.excitation.design import DesignProgress, design_excitation
from jaxid.excitation.design_result import ExcitationPlan
from jaxid.excitation.problem import assumed_noise
from jaxid.io import atomic_folder, import_extra
from jaxid.report.excitation import write_excitation
from jaxid.report.result_files import read_fit
from jaxid.result_table import Remark, Status
from jaxid.trajectory.controllers import BESIDE, CONTROLLERS
from jaxid.trajectory.files import (
    load_trajectory,
    save_trajectory,
    write_csv,
    write_ros,
)
from jaxid.trajectory.fourier import FourierBasis, complete_limits
from jaxid.trajectory.lead_in_and_out import WithLeads, with_leads
from jaxid.trajectory.trajectory import (
    AbstractTrajectory,
    LinearTrajectory,
    PaddedToCycle,
)

from .decoder import within
from .experiment import Experiment
from .motion_check import gravity_fault, motion_checks

UNKNOWN = 0.3
"""Fraction of the largest forces that is kept free where friction, or anything else, is unknown."""


class Nominal(NamedTuple):
    """Base parameters as far as they are known before the experiment."""

    parameters: Float[np.ndarray, " base"]  # values; NaN where nothing is known
    # covariance of an earlier fit, zero for what it does not determine; None if they
    # are claims
    covariance: Float[np.ndarray, "base base"] | None
    undetermined: tuple[
        str, ...
    ] = ()  # names of what an earlier fit does not determine


class Played(NamedTuple):
    """A motion as a robot can play it."""

    motion: AbstractTrajectory  # from standstill to standstill where that is possible
    sampled: (
        AbstractTrajectory  # as it is written in samples: until a sample meets its end
    )
    sample_time: float  # time between those samples [s]
    window: tuple[float, float]  # times between which it is the designed motion [s]
    fault: str  # why it does not start and end at rest; empty if it does, or need not


class Design(NamedTuple):
    """Designed motion as a robot can play it."""

    plan: ExcitationPlan  # result of the optimisation
    played: Played  # motion that the robot plays
    remarks: tuple[Remark, ...]  # remarks beside those of the plan


class Preparation(NamedTuple):
    """Knowledge that a design needs before its search."""

    nominal: Nominal | None  # parameters that are known
    constraints: tuple[
        AbstractConstraint, ...
    ]  # constraints beside the limits of the joints
    force_fault: str  # why forces are not among the constraints; empty if they are
    begin: LinearTrajectory | None = None  # motion to go on with; None to begin anew

    def faults(self, experiment: Experiment) -> tuple[str, ...]:
        """Return what will not be checked, in sentences."""
        forces = (f"forces: {self.force_fault}",) if self.force_fault else ()
        return (*experiment.surroundings.faults, *forces)


def prepare_design(experiment: Experiment, written: Path | None) -> Preparation:
    """Find the constraints of a design, and the motion of an earlier one to go on with.

    Raises:
        InputError: If the table does not fit the robot, or the earlier motion does not
            fit either.
    """
    controller = experiment.excitation.controller
    if experiment.excitation.ros == "mcap":
        import_extra("rosbags.rosbag2", "logs", "a bag of ROS 2 is written by")
    with within("excitation", experiment.path.name):
        if controller is not None:
            CONTROLLERS[controller].require(experiment.robot)
            if not experiment.excitation.rests:
                raise InputError(
                    "`controller` plays motions from standstill to standstill: leave "
                    "`leads = false` out, or set `rest = true`."
                )
        nominal = find_nominal(experiment)
        found = Preparation(nominal, *find_constraints(experiment, nominal))
    if written is None:
        return found
    begin = load_trajectory(written)
    begin = begin.inner if isinstance(begin, WithLeads) else begin
    basis = experiment.excitation.basis(bool(found.constraints))
    if not (isinstance(begin, LinearTrajectory) and str(begin.basis) == str(basis)):
        raise InputError(f"`{written}` holds a motion of another kind: design anew.")
    return found._replace(begin=begin)


def design_motion(
    experiment: Experiment,
    preparation: Preparation,
    progress: Callable[[DesignProgress], None],
    seconds: float | None = None,
) -> Design:
    """Design the motion that the experiment file asks for.

    Raises:
        InputError: If the table does not fit the robot, or no motion keeps all limits.
    """
    table = experiment.excitation
    with within("excitation", experiment.path.name):
        plan = design_excitation(
            experiment.base,
            criterion=table.objective,
            starts=table.starts,
            generations=table.generations,
            progress=progress,
            begin=preparation.begin,
            seconds=table.time if seconds is None else seconds,
            **_settings(experiment, preparation),
        )
    played = play(experiment, plan.trajectory)
    return Design(plan, played, tuple(_remarks(experiment, plan, played, preparation)))


def compare_criteria(
    experiment: Experiment, progress: Callable[[DesignProgress], None]
) -> list[ExcitationPlan]:
    """Design by every criterion, from few starts, until Ctrl-C."""
    plans, table = [], experiment.excitation
    preparation = prepare_design(experiment, None)
    for number, criterion in enumerate(CRITERIA.values(), 1):

        def tell(step: DesignProgress, number: int = number) -> None:
            task = f"criterion {number} of {len(CRITERIA)}: {step.task}"
            progress(step._replace(task=task))

        try:
            with within("excitation", experiment.path.name):
                plan = design_excitation(
                    experiment.base,
                    criterion=criterion,
                    starts=min(8, table.starts),
                    generations=min(4, table.generations),
                    progress=tell,
                    throw=False,
                    **_settings(experiment, preparation, bool(criterion.weighted)),
                )
        except KeyboardInterrupt:
            break
        plans.append(plan)
        if plan.interrupted:
            break
    return plans


def write_motion(experiment: Experiment, played: Played, output: Path) -> list[Path]:
    """Write table, trajectory and ROS message of a motion; return the files."""
    robot, step, table = experiment.robot, played.sample_time, experiment.excitation
    names = [output.name, f"{output.stem}.ros.{table.ros}", f"{output.stem}.json"]
    every = {f"{output.stem}{suffix}" for suffix in BESIDE}
    with double_precision(), atomic_folder(output.parent, lambda _: every) as folder:
        write_csv(played.sampled, robot, folder / names[0], sample_time=step)
        write_ros(played.sampled, robot, folder / names[1], sample_time=step)
        if table.controller is not None:
            own = CONTROLLERS[table.controller]
            if own.write is not None and not played.fault:
                names.append(f"{output.stem}{own.suffix}")
                own.write(played.sampled, robot, folder / names[-1], step)
        save_trajectory(jax.tree.map(np.asarray, played.motion), folder / names[2])
    return [output.parent / name for name in names]


def write_design(
    experiment: Experiment, design: Design, output: Path, command: str = ""
) -> list[Path]:
    """Write a motion as `write_motion` does, and its page; return the files."""
    seed = (("seed", str(experiment.excitation.seed)),)
    settings = {"facts": seed, "experiment_text": experiment.text, "command": command}
    # First the page: where there is no room for pictures, nothing changes.
    place, motion = output.with_suffix(""), design.played.motion
    shapes = experiment.surroundings.shapes
    pictures = write_excitation(
        place, design.plan, motion, design.remarks, settings, shapes
    )
    return write_motion(experiment, design.played, output) + pictures


def _settings(
    experiment: Experiment, preparation: Preparation, weighted: bool = True
) -> dict:
    """Return what all designs of one experiment have in common."""
    table, nominal = experiment.excitation, preparation.nominal
    noise = (
        assumed_noise(experiment.robot)
        if table.noise is None
        else np.array(table.noise)
    )
    sizes = None
    if nominal is not None:
        # An estimate of what is not determined means nothing alone.
        open_ones = np.isin(experiment.base.names, nominal.undetermined)
        sizes = np.where(open_ones, np.nan, nominal.parameters)
    return {
        "basis": table.basis(bool(preparation.constraints)),
        "constraints": preparation.constraints,
        "key": jax.random.key(table.seed),
        "noise": noise,
        "nominal": sizes,
        "prior": _earlier_information(experiment, noise) if weighted else None,
        "samples": table.samples,
    }


def find_constraints(
    experiment: Experiment, nominal: Nominal | None
) -> tuple[tuple[AbstractConstraint, ...], str]:
    """Return constraints beside the limits of the joints, and why forces are not among them.

    Raises:
        InputError: If `force_margin` is given, but no motion can keep the limits of
            forces.
    """
    table, robot = experiment.excitation, experiment.robot
    clearance = experiment.surroundings.clearance
    constraints: list[AbstractConstraint] = [] if clearance is None else [clearance]
    tip = TipLimits(table.tip_speed, table.tip_acceleration, *(table.workspace or ()))
    if tip.entries(robot):
        constraints.append(tip)
    fault = (
        "not checked: no inertias are known; say in `excitation.nominal` where a "
        "report is"
    )
    if nominal is not None:
        known, margin = np.nan_to_num(nominal.parameters), table.force_margin
        if margin is None:
            margin = UNKNOWN if np.isnan(nominal.parameters).any() else 0.0
        forces = ForceLimits(experiment.base, known, nominal.covariance, margin)
        fault = "not checked: no largest forces are known; give `limits.force`"
        if forces.entries(robot) and not (fault := gravity_fault(experiment, forces)):
            constraints.append(forces)
    if fault and table.force_margin is not None:
        raise InputError(f"`force_margin`: {fault}.")
    return tuple(constraints), fault


def _earlier_information(
    experiment: Experiment, noise: Float[np.ndarray, " joints"]
) -> Float[np.ndarray, "base base"] | None:
    """Return the information of earlier motions; None if there are none."""
    table, folder = experiment.excitation, experiment.path.parent
    if not table.earlier:
        return None
    if not table.objective.weighted:
        raise InputError(
            f'`earlier` and `criterion = "{table.criterion}"` do not go together: '
            "choose a "
            'criterion in units of the noise, like "d_optimal".'
        )
    total = 0.0
    for name in table.earlier:
        trajectory = load_trajectory(folder / name)
        if trajectory.joints != experiment.robot.joints:
            raise InputError(
                f"`earlier`: the motion of `{name}` moves {trajectory.joints} "
                "joint(s), but the "
                f"robot `{experiment.robot.name}` has {experiment.robot.joints}."
            )
        times = np.arange(table.samples) * (float(trajectory.duration) / table.samples)
        known = information(experiment.base, trajectory.motion(times), 1.0 / noise)
        total = total + np.asarray(known.weighted)
    return np.asarray(total)


def find_nominal(experiment: Experiment) -> Nominal | None:
    """Return nominal parameters of an earlier result, or those that the robot's file claims.

    Raises:
        InputError: If the earlier result is of other parameters.
    """
    base, report, folder = (
        experiment.base,
        experiment.excitation.nominal,
        experiment.path.parent,
    )
    if report is None:
        try:
            known = experiment.source.claims(folder)
        except InputError:
            if experiment.excitation.force_margin is not None:
                raise
            return None  # nothing depends on it, and the robot's notes name the body
        if not known:
            return None
        standard = experiment.model.parameter_names
        values = np.asarray(
            base.from_standard([known.get(name, 0.0) for name in standard])
        )
        leads = [standard[k] in known for k in base.indices]
        return Nominal(np.where(leads, values, np.nan), None)
    fit = read_fit(folder / report)
    if fit.base.names != base.names:
        raise InputError(
            f"`nominal`: the base parameters of `{report}` are not the {base.size} of "
            "this file."
        )
    covariance = np.array(fit.covariance)
    undetermined = ~np.isfinite(np.diag(covariance))
    covariance[undetermined | undetermined[:, None]] = 0.0
    names = tuple(n for n, u in zip(base.names, undetermined, strict=True) if u)
    return Nominal(np.asarray(fit.parameters), covariance, names)


def play(experiment: Experiment, motion: LinearTrajectory) -> Played:
    """Return a motion from standstill to standstill, in samples of the controller."""
    table = experiment.excitation
    leads, times = table.chosen_leads, np.asarray(motion.basis.times(table.samples))
    begin, end = float(times[0]), float(times[-1] + times[1] - times[0])
    step, fault, played = float(times[1] - times[0]), "", motion
    # Where there are constraints, leads were designed together with the motion.
    if leads is not None and isinstance(motion.basis, FourierBasis):
        robot = experiment.robot.replace(limits=complete_limits(experiment.robot))
        try:
            played = with_leads(motion, robot, periods=leads.periods)
            begin, end = (float(t) for t in played.window)
        except InputError as error:
            fault = (
                "the motion is without leads, and starts and ends at full speed: "
                f"{error} "
                "`rest = true` designs one at rest there."
            )
    elif leads is not None:
        end = begin + leads.periods * (end - begin)
    rests = not fault and table.rests
    sampled = played
    if table.cycle is not None:
        step = table.cycle
        sampled = PaddedToCycle(played, step) if rests else played
    return Played(played, sampled, step, (begin, end), fault)


def _remarks(
    experiment: Experiment,
    plan: ExcitationPlan,
    played: Played,
    preparation: Preparation,
) -> Iterator[Remark]:
    """Yield what must be known of a designed motion beside its plan."""
    table, (begin, end) = experiment.excitation, played.window
    if played.fault:
        yield Remark(played.fault, Status.BAD)
    if begin > 0:
        text = (
            f"from {begin:.3f} to {end:.3f} s of {float(played.motion.duration):.3f} s"
        )
        yield Remark(f"the robot starts at rest and is in the designed motion {text}")
    count = 1 if table.chosen_leads is None else table.chosen_leads.periods
    notes = {
        "the noise is assumed as 1 % of the largest forces: give `noise` if it is "
        "known": (table.noise is None),
        f"deviations are those together with {', '.join(table.earlier)}": table.earlier,
        f"the motion runs through {count} periods; the deviations are of one": count
        > 1,
        "for relative deviations, say in `excitation.nominal` where an earlier result "
        "is": (preparation.nominal is None),
    }
    for text, holds in notes.items():
        if holds:
            yield Remark(text)
    yield from motion_checks(experiment, plan, preparation.force_fault)
    yield from _force_doubts(experiment, preparation.nominal)


def _force_doubts(experiment: Experiment, nominal: Nominal | None) -> Iterator[Remark]:
    """Yield what the forces of a motion leave out."""
    if nominal is None:
        return
    names = experiment.base.names
    unknown = [n for n, p in zip(names, nominal.parameters, strict=True) if np.isnan(p)]
    if unknown:
        text = f"not known, and counted as zero in the forces: {', '.join(unknown)}"
        if experiment.excitation.force_margin is None:
            text += (
                f"; so {100 * UNKNOWN:g} % of the largest forces are kept free "
                "(`force_margin`)"
            )
        yield Remark(text, Status.DOUBTFUL)
    if nominal.undetermined:
        text = (
            f"`{experiment.excitation.nominal}` does not determine "
            f"{', '.join(nominal.undetermined)}: their uncertainty counts as zero"
        )
        yield Remark(text, Status.DOUBTFUL)
