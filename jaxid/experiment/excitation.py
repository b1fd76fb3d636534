"""Design of the motion that an experiment file asks for, and the files that a robot can play."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.errors import InputError
from jaxid.excitation.constraints import (
    AbstractConstraint,
    Clearance,
    ForceLimits,
    TipLimits,
)
from jaxid.excitation.criteria import CRITERIA, information
from jaxid.excitation.design import DesignProgress, design_excitation
from jaxid.excitation.plan import ExcitationPlan
from jaxid.excitation.problem import assumed_noise
from jaxid.experiment.decoder import within
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.robot_tables import named
from jaxid.io import atomic_folder
from jaxid.report.excitation import write_excitation
from jaxid.report.result_files import read_fit
from jaxid.table import Remark, Status
from jaxid.trajectory.files import load_trajectory, save_trajectory, write_csv, write_ros
from jaxid.trajectory.leads import with_leads
from jaxid.trajectory.trajectory import AbstractTrajectory, PaddedToCycle


class Nominal(NamedTuple):
    """Base parameters as far as they are known before the experiment.

    Attributes:
        names: Names of the base parameters.
        parameters: Values; NaN where nothing is known.
        covariance: Covariance of an earlier fit; None if the parameters are only claimed. Zero for
            what the fit does not determine.
        undetermined: Names of parameters that an earlier fit does not determine.
    """

    names: tuple[str, ...]
    parameters: Float[np.ndarray, " base"]
    covariance: Float[np.ndarray, "base base"] | None
    undetermined: tuple[str, ...] = ()

    @property
    def sizes(self) -> Float[np.ndarray, " base"]:
        """Parameters; NaN also for what is not determined, whose estimate alone means nothing."""
        return np.where(np.isin(self.names, self.undetermined), np.nan, self.parameters)


class Design(NamedTuple):
    """Designed motion as a robot can play it.

    Attributes:
        plan: Result of the optimisation.
        played: Motion from standstill to standstill where that is possible.
        window: Times of it between which lies the designed motion [s].
        remarks: Remarks beside those of the plan.
        sampled: Motion as it is written in samples: until a sample meets its end.
        sample_time: Time between those samples [s].
    """

    plan: ExcitationPlan
    played: AbstractTrajectory
    window: tuple[float, float]
    remarks: tuple[Remark, ...]
    sampled: AbstractTrajectory
    sample_time: float


def design_motion(
    experiment: Experiment,
    progress: Callable[[DesignProgress], None],
    state: Path,
    resume: bool,
) -> Design:
    """Design the motion that the experiment file asks for.

    Raises:
        InputError: If the table does not fit the robot, or no motion keeps all limits.
    """
    table = experiment.excitation
    with within("excitation", experiment.path.name):
        nominal = find_nominal(experiment)
        plan = design_excitation(
            experiment.base,
            criterion=table.objective,
            starts=table.starts,
            generations=table.generations,
            polish=min(table.polish, table.starts),
            progress=progress,
            state=state,
            resume=resume,
            **_settings(experiment, nominal),
        )
        return _add_leads(experiment, plan, nominal)


def compare_criteria(
    experiment: Experiment, progress: Callable[[DesignProgress], None]
) -> list[ExcitationPlan]:
    """Design by every criterion, from few starts and without polishing, until Ctrl-C."""
    plans, table = [], experiment.excitation
    for number, criterion in enumerate(CRITERIA, 1):

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
                    polish=0,
                    progress=tell,
                    throw=False,
                    **_settings(experiment, find_nominal(experiment), bool(criterion.weighted)),
                )
        except KeyboardInterrupt:
            break
        plans.append(plan)
        if plan.interrupted:
            break
    return plans


def write_design(
    experiment: Experiment, design: Design, output: Path, command: str = ""
) -> list[Path]:
    """Write table, trajectory, ROS message and pictures; return the files."""
    plan, step, table = design.plan, design.sample_time, experiment.excitation
    robot = experiment.robot
    names = [output.name, f"{output.stem}.json", f"{output.stem}.ros.{table.ros}"]
    seed = (("seed", str(table.seed)),)
    settings = {"facts": seed, "experiment_text": experiment.text, "command": command}
    with double_precision(), atomic_folder(output.parent) as folder:
        write_csv(design.sampled, robot, folder / names[0], sample_time=step)
        save_trajectory(jax.tree.map(np.asarray, design.played), folder / names[1])
        write_ros(design.sampled, robot, folder / names[2], sample_time=step)
        # Before the others take their places: where there is no room for pictures, nothing changes.
        place = output.with_suffix("")
        pictures = write_excitation(place, plan, design.played, design.remarks, settings)
    return [output.parent / n for n in names] + pictures


def _settings(experiment: Experiment, nominal: Nominal | None, weighted: bool = True) -> dict:
    """Return what all designs of one experiment have in common."""
    table = experiment.excitation
    noise = assumed_noise(experiment.robot) if table.noise is None else np.array(table.noise)
    constraints = find_constraints(experiment, nominal)
    return {
        "basis": table.basis(bool(constraints)),
        "constraints": constraints,
        "key": jax.random.key(table.seed),
        "noise": noise,
        "nominal": None if nominal is None else nominal.sizes,
        "prior": _earlier_information(experiment, noise) if weighted else None,
        "samples": table.samples,
    }


def find_constraints(
    experiment: Experiment, nominal: Nominal | None
) -> tuple[AbstractConstraint, ...]:
    """Return the constraints of the motion beside the limits of the joints.

    Raises:
        InputError: If forces are limited, but no parameters or no largest forces are known.
    """
    table = experiment.excitation
    constraints: list[AbstractConstraint] = []
    if experiment.collision is not None:
        constraints.append(Clearance(experiment.collision, experiment.clearance))
    if table.tip_speed or table.tip_acceleration or table.workspace is not None:
        box = ((-np.inf,) * 3, (np.inf,) * 3) if table.workspace is None else table.workspace
        speeds = table.tip_speed or np.inf, table.tip_acceleration or np.inf
        constraints.append(TipLimits(*speeds, *box))
    if table.force_margin is None:
        return tuple(constraints)
    if nominal is None:
        raise InputError(
            "`force_margin` needs parameters to compute forces with: say in `nominal` where an "
            "earlier result of `jaxid identify` is."
        )
    forces = _force_limits(experiment, nominal, table.force_margin)
    if not forces.entries(experiment.robot):
        raise InputError(
            "`force_margin` needs largest forces: give `limits.force` or `drives.max_torques`."
        )
    return (*constraints, forces)


def _force_limits(experiment: Experiment, nominal: Nominal, margin: float) -> ForceLimits:
    parameters = np.nan_to_num(nominal.parameters)
    return ForceLimits(experiment.base, parameters, nominal.covariance, margin)


def _earlier_information(
    experiment: Experiment, noise: Float[np.ndarray, " joints"]
) -> Float[np.ndarray, "base base"] | None:
    """Return the information of earlier motions; None if there are none."""
    table, folder = experiment.excitation, experiment.path.parent
    if not table.earlier:
        return None
    if not table.objective.weighted:
        raise InputError(
            f'`earlier` and `criterion = "{table.criterion}"` do not go together: what motions '
            "tell adds up in units of the noise, which this criterion does not know; leave out "
            '`earlier`, or choose a criterion like "d_optimal".'
        )
    total = 0.0
    for name in table.earlier:
        trajectory = load_trajectory(folder / name)
        if trajectory.joints != experiment.robot.joints:
            raise InputError(
                f"`earlier`: the motion of `{name}` moves {trajectory.joints} joint(s), but the "
                f"robot `{experiment.robot.name}` has {experiment.robot.joints}: name motions of "
                "this robot."
            )
        times = np.arange(table.samples) * (float(trajectory.duration) / table.samples)
        weighted = information(experiment.base, trajectory.motion(times), 1.0 / noise).weighted
        total = total + np.asarray(weighted)
    return np.asarray(total)


def find_nominal(experiment: Experiment) -> Nominal | None:
    """Return nominal parameters of an earlier result, or those that the URDF file claims.

    Raises:
        InputError: If the earlier result is of other parameters.
    """
    if experiment.excitation.nominal is not None:
        return _earlier_result(experiment, experiment.excitation.nominal)
    try:
        bodies = experiment.source.parameters(experiment.path.parent)
    except InputError:
        if experiment.excitation.force_margin is not None:
            raise
        return None  # nothing depends on it, and the robot's notes name the body that cannot exist
    if bodies is None or not np.any(bodies):
        return None
    base, standard, known = experiment.base, experiment.model.parameter_names, named(bodies)
    values = np.asarray(base.from_standard([known.get(name, 0.0) for name in standard]))
    leads = [standard[k] in known for k in base.indices]
    return Nominal(base.names, np.where(leads, values, np.nan), None)


def _earlier_result(experiment: Experiment, report: str) -> Nominal:
    base, fit = experiment.base, read_fit(experiment.path.parent / report)
    if fit.base.names != base.names:
        raise InputError(
            f"`nominal`: the {fit.base.size} base parameters of `{report}` are not the "
            f"{base.size} of this experiment: identify with the same robot and model."
        )
    covariance = np.array(fit.covariance)
    undetermined = ~np.isfinite(np.diag(covariance))
    covariance[undetermined | undetermined[:, None]] = 0.0
    names = tuple(n for n, u in zip(base.names, undetermined, strict=True) if u)
    return Nominal(base.names, np.asarray(fit.parameters), covariance, names)


def _add_leads(experiment: Experiment, plan: ExcitationPlan, nominal: Nominal | None) -> Design:
    """Return the motion from standstill to standstill, in samples of the controller."""
    motion, table = plan.trajectory, experiment.excitation
    leads, times = table.chosen_leads, np.asarray(plan.limits.basis.times(plan.samples))
    begin, end = float(times[0]), float(times[-1] + times[1] - times[0])
    step = float(times[1] - times[0])
    remarks = []
    # Where there are constraints, leads were designed together with the motion.
    if leads is not None and leads.time is None and not plan.findings:
        robot = experiment.robot.replace(limits=plan.limits.limits)
        try:
            motion = with_leads(motion, robot, periods=leads.periods)
            begin, end = (float(t) for t in motion.window)
        except InputError as error:
            text = f"the motion is without leads, and starts and ends at full speed: {error}"
            remarks.append(Remark(f"{text} `rest = true` designs one at rest there.", Status.BAD))
    elif leads is not None:
        end = begin + leads.periods * (end - begin)
    rests = not remarks and (leads is not None or table.rest or table.spline is not None)
    if begin > 0:
        text = f"from {begin:.3f} to {end:.3f} s of {float(motion.duration):.3f} s"
        remarks.append(Remark(f"the robot starts at rest and is in the designed motion {text}"))
    remarks += _remarks(experiment, plan)
    remarks += force_remarks(experiment, nominal, motion)
    sampled = motion
    if table.sample_time is not None:
        step = table.sample_time
        sampled = PaddedToCycle(motion, step) if rests else motion
    return Design(plan, motion, (begin, end), tuple(remarks), sampled, step)


def _remarks(experiment: Experiment, plan: ExcitationPlan) -> list[Remark]:
    table = experiment.excitation
    count = 1 if table.chosen_leads is None else table.chosen_leads.periods
    notes = {
        "the noise is assumed as 1 % of the largest forces: give `noise` if it is known": (
            table.noise is None
        ),
        f"deviations are those together with {', '.join(table.earlier)}": table.earlier,
        f"the motion runs through {count} periods; the deviations are of one": count > 1,
        "for relative deviations, say in `excitation.nominal` where an earlier result is": (
            plan.nominal is None
        ),
    }
    return [Remark(text) for text, holds in notes.items() if holds]


def force_remarks(
    experiment: Experiment, nominal: Nominal | None, played: AbstractTrajectory
) -> list[Remark]:
    """Return remarks about the forces of a motion, where any are limited."""
    if not np.isfinite(experiment.robot.known_max_forces).any():
        return []
    if nominal is None:
        text = (
            "forces were not checked, although they have limits, for no parameters are known: "
            "say in `excitation.nominal` where an earlier result is, and give `force_margin` to "
            "keep the limits"
        )
        return [Remark(text, Status.DOUBTFUL)]
    remarks = []
    if experiment.excitation.force_margin is None:
        remarks.append(_force_use(experiment, nominal, played))
    unknown = [n for n, p in zip(nominal.names, nominal.parameters, strict=True) if np.isnan(p)]
    if unknown:
        text = f"not known, and counted as zero in the forces: {', '.join(unknown)}"
        remarks.append(Remark(text, Status.DOUBTFUL))
    if nominal.undetermined:
        text = (
            f"`{experiment.excitation.nominal}` does not determine "
            f"{', '.join(nominal.undetermined)}: the forces are computed with its estimates of "
            "them, whose uncertainty counts as zero"
        )
        remarks.append(Remark(text, Status.DOUBTFUL))
    return remarks


def _force_use(experiment: Experiment, nominal: Nominal, played: AbstractTrajectory) -> Remark:
    robot = experiment.robot
    with double_precision():
        motion = played.motion(np.linspace(0.0, float(played.duration), 4000))
        limits = _force_limits(experiment, nominal, 0.0)
        findings = limits.describe(robot, np.asarray(limits(robot, motion)))
    worst = max(findings, key=lambda finding: finding.value)
    nearest = f"{worst.name} with {100 * worst.used:.1f} % of {worst.limit:.4g} {worst.unit}"
    if worst.value > 0:
        return Remark(
            "by the nominal parameters this motion needs more than robot and motors can give: "
            f"{nearest}; give `force_margin`, and the design keeps these limits",
            Status.BAD,
        )
    return Remark(
        "forces were not part of the design; by the nominal parameters they stay within their "
        f"limits, the nearest being {nearest} (`force_margin` keeps them with room)"
    )
