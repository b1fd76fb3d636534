"""Motions in the form in which the controllers of common robots play them."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import write_text
from jaxid.robot.robot import Robot

from .trajectory import AbstractTrajectory


class Controller(NamedTuple):
    """Interface of a robot's controller that takes one position in each cycle."""

    joints: int  # number of joints of its robots, all revolute
    sample_time: float  # cycle that is taken if none is given [s]
    # suffix and writer of its file; none if it plays the rows of the table
    suffix: str = ""
    write: Callable[[AbstractTrajectory, Robot, Path, float], None] | None = None

    def require(self, robot: Robot) -> None:
        """Reject a robot with another number of joints, or with a prismatic one."""
        if robot.joints != self.joints or not all(robot.revolute):
            raise InputError(
                f"`controller` moves robots of {self.joints} revolute joints, but "
                f"`{robot.name}` has {robot.joints} joint(s), {sum(robot.revolute)} of "
                "them revolute: leave the key out, and give `sample_time`."
            )


def write_urscript(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: Path,
    sample_time: float,
) -> None:
    """Write a program in URScript: to the start, then one `servoj` a cycle.

    Positions are rounded to 1e-9 rad.
    """
    q = trajectory.sample(sample_time)[1].q
    rows = ["[" + ", ".join(f"{x:.9f}" for x in row) + "]" for row in q.tolist()]
    lines = [
        f"# Motion of `{robot.name}`: "
        f"{len(rows)} positions [rad], one in {sample_time:.6g} s.",
        "def play_motion():",
        f"  movej({rows[0]}, a=0.5, v=0.3)",
        *(f"  servoj({row}, 0, 0, {sample_time:.6g}, 0.1, 300)" for row in rows),
        "  stopj(2.0)",
        "end",
    ]
    write_text(path, "\n".join(lines) + "\n")


def write_rsi(
    trajectory: AbstractTrajectory,
    robot: Robot,
    path: Path,
    sample_time: float,
) -> None:
    """Write a table for RSI: degrees from the first position, one row a cycle."""
    q = trajectory.sample(sample_time)[1].q
    angles = np.rad2deg(q - q[0])
    columns = {f"AK.A{j + 1} [deg]": angles[:, j] for j in range(robot.joints)}
    write_text(path, pl.DataFrame(columns).write_csv())


CONTROLLERS = {
    "franka": Controller(7, 0.001),
    "kuka_fri": Controller(7, 0.005),
    "kuka_rsi": Controller(6, 0.004, ".rsi.csv", write_rsi),
    "universal_robots": Controller(6, 0.008, ".script", write_urscript),
}
"""Controllers by the names of the key `controller`."""
CONTROLLER_SUFFIXES = (".ros.yaml", ".ros.mcap", ".rsi.csv", ".script")
"""Suffixes of the files that may stand beside the table of a motion."""
