"""Designs the motion of an experiment file, and makes of it what a robot can play."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import Float, double_precision
from jaxid.excitation.design import NOISE, DesignProgress, assumed_noise, design_excitation
from jaxid.excitation.plan import CRITERIA as ALL
from jaxid.excitation.plan import ExcitationPlan
from jaxid.experiment.excitation_tables import (
    CRITERIA,
    build_basis,
    build_constraints,
    build_prior,
)
from jaxid.experiment.excited_forces import force_remarks
from jaxid.experiment.experiment import Experiment
from jaxid.experiment.nominal import Nominal, build_nominal
from jaxid.experiment.robot_tables import within
from jaxid.io import atomic_folder
from jaxid.report.blocks import Remark, Tone
from jaxid.report.excited import Aside, write_pictures
from jaxid.trajectory.files import save_trajectory, write_csv, write_ros_json, write_ros_yaml
from jaxid.trajectory.leads import with_leads
from jaxid.trajectory.trajectory import AbstractTrajectory, PaddedToCycle

FEW = 8
"""Starts of the designs that only show what a criterion buys."""
FEWER = 4
"""Generations of these designs."""


class Excited(NamedTuple):
    """A designed motion as a robot can play it.

    Attributes:
        plan: The design.
        played: The motion from standstill to standstill where that could be had.
        window: Times of it between which lies the designed motion [s].
        aside: What else is to be said of it, and how it came about.
        sampled: The motion as it is written in samples: until a sample meets its end.
        sample_time: Of those samples [s].
        ros: Language of the file for ROS: yaml or json.
    """

    plan: ExcitationPlan
    played: AbstractTrajectory
    window: tuple[float, float]
    aside: Aside
    sampled: AbstractTrajectory
    sample_time: float
    ros: str


def design(
    experiment: Experiment,
    progress: Callable[[DesignProgress], None],
    state: Path,
    resume: bool,
) -> Excited:
    """Designs the motion that the experiment file asks for.

    Args:
        experiment: With its table `[excitation]`, or the defaults.
        progress: Is told how far the design is.
        state: File that keeps the state of the design.
        resume: Goes on from that file if it is there.

    Raises:
        InputError: If the table does not fit the robot, or no motion keeps all limits.
    """
    with within(experiment.path.name, "excitation"):
        nominal = build_nominal(experiment)
        plan = design_excitation(
            experiment.base,
            criterion=CRITERIA[experiment.excitation.criterion](),
            starts=experiment.excitation.starts,
            generations=experiment.excitation.generations,
            polish=min(experiment.excitation.polish, experiment.excitation.starts),
            progress=progress,
            state=state,
            resume=resume,
            **_settings(experiment, nominal),
        )
        return _played(experiment, plan, nominal)


def side_by_side(
    experiment: Experiment, progress: Callable[[DesignProgress], None]
) -> list[ExcitationPlan]:
    """Designs by every criterion, from few starts and without polishing, until Ctrl-C.

    Args:
        experiment: With its table `[excitation]`, or the defaults.
        progress: Is told how far the designs are.
    """
    found, table = [], experiment.excitation
    starts, generations = min(FEW, table.starts), min(FEWER, table.generations)
    for number, criterion in enumerate(ALL):

        def tell(now: DesignProgress, number: int = number) -> None:
            share = (number + now.share) / len(ALL)
            doing = f"criterion {number + 1} of {len(ALL)}, {now.doing}"
            progress(now._replace(share=share, doing=doing))

        try:
            with within(experiment.path.name, "excitation"):
                nominal = build_nominal(experiment)
                plan = design_excitation(
                    experiment.base,
                    criterion=criterion,
                    starts=starts,
                    generations=generations,
                    polish=0,
                    progress=tell,
                    throw=False,
                    **_settings(experiment, nominal, bool(criterion.weighted)),
                )
        except KeyboardInterrupt:
            break
        found.append(plan)
        if plan.interrupted:
            break
    return found


def write(excited: Excited, output: Path, command: str = "") -> list[Path]:
    """Writes table, trajectory, ROS message and pictures; returns the files.

    Args:
        excited: The motion.
        output: Of the table; the others lie beside it.
        command: The line that makes it again, for the page.
    """
    plan, played = excited.plan, excited.played
    aside = excited.aside._replace(settings={**excited.aside.settings, "command": command})
    robot, step = plan.base.model.robot, excited.sample_time
    names = [output.name, f"{output.stem}.json", f"{output.stem}.ros.{excited.ros}"]
    write_ros = write_ros_json if excited.ros == "json" else write_ros_yaml
    with double_precision(), atomic_folder(output.parent) as folder:
        write_csv(excited.sampled, robot, folder / names[0], sample_time=step)
        save_trajectory(jax.tree.map(np.asarray, played), folder / names[1])
        write_ros(excited.sampled, robot, folder / names[2], sample_time=step)
        # Before the others take their places: where there is no room for pictures, nothing changes.
        pictures = write_pictures(output.with_suffix(""), plan, played, aside)
    return [output.parent / n for n in names] + pictures


def _settings(experiment: Experiment, nominal: Nominal | None, weighted: bool = True) -> dict:
    """What all designs of one experiment have in common."""
    table, robot = experiment.excitation, experiment.robot
    noise = assumed_noise(robot) if table.noise is None else np.array(table.noise)
    constraints = build_constraints(experiment, nominal)
    return {
        "basis": build_basis(table, bool(constraints)),
        "constraints": constraints,
        "key": jax.random.key(table.seed),
        "noise": noise,
        "nominal": None if nominal is None else nominal.sizes,
        "prior": build_prior(experiment, noise) if weighted else None,
        "samples": table.samples,
    }


def _played(experiment: Experiment, plan: ExcitationPlan, nominal: Nominal | None) -> Excited:
    motion, table, led = plan.trajectory, experiment.excitation, experiment.excitation.led
    begin, last, end = _measured(plan)[[0, 1, -1]].tolist()
    step, refused = last - begin, ""
    # Where constraints were found, leads were designed together with the motion.
    if led is not None and led.time is None and not plan.findings:
        robot = experiment.robot.replace(limits=plan.limits.limits)
        try:
            motion = with_leads(motion, robot, periods=led.periods)
        except ValueError as error:
            refused = str(error)
        else:
            begin, end = (float(t) for t in motion.window)
    elif led is not None:
        end = begin + led.periods * (end - begin)
    window = begin, end
    said = (
        *_said(experiment, plan, float(motion.duration), window, refused),
        *force_remarks(experiment, nominal, motion),
    )
    settings = {"facts": (("seed", str(table.seed)),), "experiment_text": experiment.text}
    step = step if table.sample_time is None else table.sample_time
    rests = led is not None or table.rest or table.spline is not None
    whole_cycles = table.sample_time is not None and rests and not refused
    sampled = PaddedToCycle(motion, step) if whole_cycles else motion
    return Excited(plan, motion, window, Aside(said, settings), sampled, step, table.ros)


def _said(
    experiment: Experiment,
    plan: ExcitationPlan,
    whole: float,
    window: tuple[float, float],
    refused: str,
) -> Iterator[Remark]:
    table, (begin, end) = experiment.excitation, window
    if begin > 0:
        yield Remark(
            Tone.PLAIN,
            f"the robot starts at rest and is in the designed motion from {begin:.3f} to "
            f"{end:.3f} s of {whole:.3f} s",
        )
    if table.noise is None:
        share = f"{100 * NOISE:g} % of the largest forces"
        yield Remark(Tone.PLAIN, f"the noise is assumed as {share}: give `noise` if it is known")
    if table.earlier:
        yield Remark(Tone.PLAIN, f"deviations are those together with {', '.join(table.earlier)}")
    if table.led is not None and table.led.periods > 1:
        text = f"the motion runs through {table.led.periods} periods; the deviations are of one"
        yield Remark(Tone.PLAIN, text)
    for text in table.idle:
        yield Remark(Tone.PLAIN, text)
    if plan.nominal is None:
        text = "for relative deviations, say in `excitation.nominal` where an earlier result is"
        yield Remark(Tone.PLAIN, text)
    if refused:
        yield Remark(
            Tone.BAD,
            f"the motion is without leads, and starts and ends at full speed: {refused} "
            "`rest = true` designs one that is at rest there.",
        )


def _measured(plan: ExcitationPlan) -> Float[np.ndarray, " times"]:
    """Times of the samples of one run, and its end [s]."""
    times = plan.limits.basis.times(plan.samples)
    return np.append(times, times[-1] + times[1] - times[0])
