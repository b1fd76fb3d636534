"""Figures of a motion: its joints against their limits, and its end-effector (Figs. 3, 4)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.dynamics.motion import Motion
from jaxid.excitation.constraints.tip import tip_motion
from jaxid.report.style import (
    BLUE,
    GREY,
    HEADING,
    VERMILION,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
)
from jaxid.robot.limits import Limits
from jaxid.robot.robot import Robot
from jaxid.types import AnyArray, Float, double_precision

ROW = 1.25
"""Height of a row of panels [inch]."""


def joint_figure(
    robot: Robot, limits: Limits, time: Float[AnyArray, " samples"], motion: Motion
) -> Figure:
    """Position, velocity and acceleration of every joint between their limits (Fig. 3).

    Args:
        robot: Whose joints they are.
        limits: Drawn as lines where they are finite.
        time: Of the samples [s].
        motion: At the samples.
    """
    with house_style():
        figure = new_figure(WIDTH, ROW * robot.joints + HEADING)
        heading(figure, f"{robot.name}: motion of the joints (dashed: limits)")
        panels = figure.subplots(robot.joints, 3, sharex=True, squeeze=False)
        bounds = (
            (limits.position_min, limits.position_max),
            *((-np.asarray(x), np.asarray(x)) for x in (limits.velocity, limits.acceleration)),
        )
        for j, row in enumerate(panels):
            unit = robot.joint_unit(j)
            kinds = (("", motion.q), ("/s", motion.qd), ("/s²", motion.qdd))
            for axes, (rate, values), (low, high) in zip(row, kinds, bounds, strict=True):
                axes.plot(time, np.asarray(values)[:, j], color=BLUE, linewidth=1.0)
                for limit in (float(low[j]), float(high[j])):
                    if np.isfinite(limit):
                        axes.axhline(limit, color=VERMILION, linewidth=0.7, linestyle="--")
                caption(axes, robot.joint_names[j] if axes is row[0] else "", f"[{unit}{rate}]")
        _time_axis(panels[-1], time)
    return figure


def tip_figure(robot: Robot, time: Float[AnyArray, " samples"], motion: Motion) -> Figure:
    """Position, speed and acceleration of the end-effector (Fig. 4).

    Args:
        robot: Whose end-effector moves.
        time: Of the samples [s].
        motion: At the samples.
    """
    with double_precision():
        position, *rates = (np.asarray(x) for x in tip_motion(robot, motion))
    speed, rate = (np.linalg.norm(x, axis=1) for x in rates)
    with house_style():
        figure = new_figure(WIDTH, 3 * 1.6 + HEADING)
        heading(figure, f"{robot.name}: motion of the end-effector")
        panels = figure.subplots(3, 1, sharex=True)
        for k, (name, color) in enumerate(zip("xyz", (BLUE, VERMILION, GREY), strict=True)):
            panels[0].plot(time, position[:, k], color=color, linewidth=1.0, label=name)
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3)
        caption(panels[0], "position [m]", "")
        for axes, values, name, unit in (
            (panels[1], speed, "speed", "m/s"),
            (panels[2], rate, "acceleration", "m/s²"),
        ):
            axes.plot(time, values, color=BLUE, linewidth=1.0)
            caption(axes, name, f"up to {values.max():.3g} {unit}")
        _time_axis(panels[-1:], time)
    return figure


def _time_axis(panels: np.ndarray, time: Float[AnyArray, " samples"]) -> None:
    axes: Axes
    for axes in panels:
        axes.set_xlabel("time [s]")
        axes.set_xlim(float(time[0]), float(time[-1]))
