"""A designed motion as a robot can play it, and its files."""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxid.arrays import double_precision
from jaxid.errors import InputError
from jaxid.io import atomic_folder
from jaxid.robot.robot import Robot, complete_limits
from jaxid.trajectory.controllers import BESIDE, CONTROLLERS
from jaxid.trajectory.files import save_trajectory, write_csv, write_ros
from jaxid.trajectory.fourier import FourierBasis
from jaxid.trajectory.lead_in_and_out import with_leads
from jaxid.trajectory.trajectory import (
    AbstractTrajectory,
    LinearTrajectory,
    PaddedToCycle,
)

from .excitation_settings import Excitation


class PlayableMotion(NamedTuple):
    """A motion as a robot can play it."""

    motion: AbstractTrajectory  # from standstill to standstill where that is possible
    sampled: (
        AbstractTrajectory  # as it is written in samples: until a sample meets its end
    )
    sample_time: float  # time between those samples [s]
    window: tuple[float, float]  # times between which it is the designed motion [s]
    fault: str  # why it does not start and end at rest; empty if it does, or need not


def make_playable(
    robot: Robot, excitation: Excitation, motion: LinearTrajectory
) -> PlayableMotion:
    """Return a motion from standstill to standstill, in samples of the controller."""
    leads = excitation.chosen_leads
    times = np.asarray(motion.basis.times(excitation.samples))
    step = float(times[1] - times[0])
    begin, end = float(times[0]), float(times[-1]) + step
    fault, playable = "", motion
    # Where there are constraints, leads were designed together with the motion.
    if leads is not None and isinstance(motion.basis, FourierBasis):
        limited_robot = robot.replace(limits=complete_limits(robot))
        try:
            playable = with_leads(motion, limited_robot, periods=leads.periods)
            begin, end = (float(time) for time in playable.window)
        except InputError as error:
            fault = (
                "the motion is without leads, and starts and ends at full speed: "
                f"{error} `rest = true` designs one at rest there."
            )
    elif leads is not None:
        end = begin + leads.periods * (end - begin)
    sampled = playable
    if excitation.cycle is not None:
        step = excitation.cycle
        if excitation.rests and not fault:
            sampled = PaddedToCycle(playable, step)
    return PlayableMotion(playable, sampled, step, (begin, end), fault)


def write_motion(
    robot: Robot, excitation: Excitation, playable: PlayableMotion, output: Path
) -> list[Path]:
    """Write table, trajectory and ROS message of a motion; return the files."""
    sampled, step = playable.sampled, playable.sample_time
    table, trajectory = output.name, f"{output.stem}.json"
    message = f"{output.stem}.ros.{excitation.ros}"
    names = [table, message, trajectory]
    replaced_names = {f"{output.stem}{suffix}" for suffix in BESIDE}
    with (
        double_precision(),
        atomic_folder(output.parent, lambda _: replaced_names) as folder,
    ):
        write_csv(sampled, robot, folder / table, sample_time=step)
        write_ros(sampled, robot, folder / message, sample_time=step)
        controller = CONTROLLERS.get(excitation.controller or "")
        if controller is not None and controller.write and not playable.fault:
            names.append(f"{output.stem}{controller.suffix}")
            controller.write(sampled, robot, folder / names[-1], step)
        save_trajectory(jax.tree.map(np.asarray, playable.motion), folder / trajectory)
    return [output.parent / name for name in names]
