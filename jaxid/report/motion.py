"""Figures of a motion: joints and their limits, end-effector, filtered signals (Figs. 4, 5)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxid.arrays import AnyArray, Float, double_precision
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.excitation.constraints import tip_motion
from jaxid.report.style import (
    BLUE,
    GREY,
    MEASURED,
    PREDICTED,
    VERMILION,
    WIDTH,
    caption,
    heading,
    house_style,
    new_figure,
)
from jaxid.robot.joints import Limits
from jaxid.robot.robot import Robot


def joint_figure(
    robot: Robot, limits: Limits, time: Float[AnyArray, " samples"], motion: Motion
) -> Figure:
    """Draw position, velocity and acceleration of every joint between their limits (Fig. 4).

    Args:
        robot: Robot that moves.
        limits: Limits, drawn as lines where they are finite.
        time: Instants of the samples [s].
        motion: Motion at the samples.
    """
    bounds = (
        (limits.position_min, limits.position_max),
        *((-np.asarray(x), np.asarray(x)) for x in (limits.velocity, limits.acceleration)),
    )
    with house_style():
        figure = new_figure(WIDTH, 1.25 * robot.joints + 0.36)
        heading(figure, f"{robot.name}: motion of the joints (dashed: limits)")
        panels = figure.subplots(robot.joints, 3, sharex=True, squeeze=False)
        for j, row in enumerate(panels):
            unit = robot.joint_unit(j)
            kinds = (("", motion.q), ("/s", motion.qd), ("/s²", motion.qdd))
            for axes, (rate, values), (low, high) in zip(row, kinds, bounds, strict=True):
                axes.plot(time, np.asarray(values)[:, j], color=BLUE, linewidth=1.0)
                for limit in (float(low[j]), float(high[j])):
                    if np.isfinite(limit):
                        axes.axhline(limit, color=VERMILION, linewidth=0.7, linestyle="--")
                caption(axes, robot.joint_names[j] if axes is row[0] else "", f"[{unit}{rate}]")
        _label_time(panels[-1], time)
    return figure


def tip_figure(robot: Robot, time: Float[AnyArray, " samples"], motion: Motion) -> Figure:
    """Draw position, speed and acceleration of the end-effector (Sec. 4).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        motion: Motion of the joints at the samples.
    """
    with double_precision():
        position, *rates = (np.asarray(x) for x in tip_motion(robot, motion))
    with house_style():
        figure = new_figure(WIDTH, 5.2)
        heading(figure, f"{robot.name}: motion of the end-effector")
        panels = figure.subplots(3, 1, sharex=True)
        for k, (name, color) in enumerate(zip("xyz", (BLUE, VERMILION, GREY), strict=True)):
            panels[0].plot(time, position[:, k], color=color, linewidth=1.0, label=name)
        panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=3)
        caption(panels[0], "position [m]")
        quantities = (("speed", "m/s"), ("acceleration", "m/s²"))
        for axes, vectors, (name, unit) in zip(panels[1:], rates, quantities, strict=True):
            values = np.linalg.norm(vectors, axis=1)
            axes.plot(time, values, color=BLUE, linewidth=1.0)
            caption(axes, name, f"up to {values.max():.3g} {unit}")
        _label_time(panels[-1:], time)
    return figure


def filtered_figure(
    robot: Robot,
    time: Float[AnyArray, " samples"],
    desired: Motion,
    filtered: Motion,
    joint: int,
) -> Figure:
    """Draw velocity and acceleration of a joint: as desired, and behind a filter (Fig. 5).

    Args:
        robot: Robot that moves.
        time: Instants of the samples [s].
        desired: Desired motion at the samples.
        filtered: Motion that the filter makes of measured positions.
        joint: Index of the joint, from 0.

    Raises:
        InputError: If there is no such joint.
    """
    if not 0 <= joint < robot.joints:
        raise InputError(f"`joint` must lie between 0 and {robot.joints - 1}, but is {joint}.")
    unit = robot.joint_unit(joint)
    with house_style():
        figure = new_figure(WIDTH, 4.5)
        heading(figure, f"{robot.name}: {robot.joint_names[joint]}, desired and filtered")
        panels = figure.subplots(2, 1, sharex=True)
        for axes, name, rate, *pair in (
            (panels[0], "velocity", "/s", desired.qd, filtered.qd),
            (panels[1], "acceleration", "/s²", desired.qdd, filtered.qdd),
        ):
            wanted, measured = (np.asarray(x)[:, joint] for x in pair)
            axes.plot(time, wanted, color=MEASURED, linewidth=2.4)
            axes.plot(time, measured, color=PREDICTED, linewidth=1.0)
            rms = float(np.sqrt(np.mean((measured - wanted) ** 2)))
            caption(axes, f"{name} [{unit}{rate}]", f"RMS difference {rms:.3g} {unit}{rate}")
        _label_time(panels[-1:], time)
        handles = [
            Line2D([], [], color=MEASURED, lw=2.4, label="desired"),
            Line2D([], [], color=PREDICTED, lw=1.2, label="filtered"),
        ]
        figure.legend(handles=handles, loc="outside lower left", ncols=2)
    return figure


def _label_time(panels: np.ndarray, time: Float[AnyArray, " samples"]) -> None:
    axes: Axes
    for axes in panels:
        axes.set_xlabel("time [s]")
        axes.set_xlim(float(time[0]), float(time[-1]))
