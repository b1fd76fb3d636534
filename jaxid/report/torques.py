"""Measured and predicted forces over time, and their errors (Figs. 6, 7, 9 and 10)."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.result_table import percent, significant
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import (
    BLUE,
    ERROR,
    GREEN,
    GREY,
    MEASUREMENT_COLOUR,
    ORANGE,
    PREDICTION_COLOUR,
    PURPLE,
    Curve,
    Panel,
)

MAX_BARS_WITH_NUMBERS = 20
"""Largest number of bars on which their values are written."""
GROUP_COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
"""Colours of the groups of recordings beside each other."""


def torque_figure(
    errors: TorqueErrors,
    robot: Robot,
    title: str | None = None,
    joints: Sequence[int] | None = None,
) -> Figure:
    """Return measured and predicted forces of every joint, and their difference below.

    Rows at both ends that count for no joint are left out; where a row within does not
    count for a joint, the difference is left blank.

    Args:
        errors: Errors on one recording.
        robot: Robot of the recording.
        title: Title of the figure; the recording's name if None.
        joints: Indices of the joints to show, from 0; all if None.

    Raises:
        InputError: If the numbers of joints differ.
    """
    require_joints(errors, robot)
    joints = range(robot.joints) if joints is None else joints
    rows = np.flatnonzero(np.asarray(errors.counted).any(axis=1))
    window = slice(rows[0], rows[-1] + 1)
    panels = [_joint_panel(errors, robot, j, window) for j in joints]
    columns = 2 if len(panels) > 2 else 1
    name = errors.name if title is None else title
    return Figure(
        f"{name}: relative error {percent(errors.relative)} %",
        panels,
        columns,
        height=2.6,
    )


def _joint_panel(errors: TorqueErrors, robot: Robot, j: int, window: slice) -> Panel:
    """Return forces of a joint, with the errors in a panel below."""
    unit = robot.force_unit(j)
    time = np.asarray(errors.time)[window]
    measured_forces = np.asarray(errors.measured)[window, j]
    predicted_forces = np.asarray(errors.predicted)[window, j]
    difference = errors.errors[window, j]
    limit = 1.1 * (np.fmax.reduce(np.abs(difference), initial=0.0) or 1.0)
    error_panel = Panel(
        [Curve(time, difference, "predicted - measured", ERROR, width=0.6)],
        unit=unit,
        y_range=(-limit, limit),
        levels=[("y", 0.0, GREY)],
        share=0.4,
    )
    # A single row has no duration.
    end = time[-1] if len(time) > 1 else time[0] + 1.0
    return Panel(
        [
            Curve(time, measured_forces, "measured", MEASUREMENT_COLOUR, width=1.9),
            Curve(time, predicted_forces, "predicted", PREDICTION_COLOUR, width=0.8),
        ],
        title=robot.joint_names[j],
        value=_mean_error_text(errors, j, unit),
        y="torque" if robot.revolute[j] else "force",
        unit=unit,
        x_range=(float(time[0]), float(end)),
        below=[error_panel],
    )


def _mean_error_text(errors: TorqueErrors, j: int, unit: str) -> str:
    """Return a joint's mean error, and its share of the largest force if known."""
    if not np.isfinite(errors.errors[:, j]).any():
        return "no row counts"
    text = f"mean |e| {significant(errors.mean[j], 2)} {unit}"
    fraction = errors.mean_percent[j] / 100.0
    return f"{text} = {percent(fraction)} % of max" if np.isfinite(fraction) else text


def require_joints(errors: TorqueErrors, robot: Robot) -> None:
    """Reject errors of another robot."""
    if errors.measured.shape[1] != robot.joints:
        raise InputError(
            f"`errors` of `{errors.name}` must be of the {robot.joints} joints of "
            f"`{robot.name}`."
        )


def bar_figure(
    groups: Mapping[str, Sequence[TorqueErrors]], robot: Robot, title: str = ""
) -> Figure:
    """Return mean errors as bars, RMS errors as points, by group (Eq. 37, Fig. 10).

    In percent of the largest forces; of the RMS of the measured forces if a largest one
    is not known. Recordings of one group count as one.

    Args:
        groups: Errors on some recordings by the name of the group, like
            `{"identification": errors[:1], "verification": errors[1:]}`; groups without
            recordings are left out.
        robot: Robot of the recordings.
        title: Title of the figure; the robot's name if empty.

    Raises:
        InputError: If there is no recording at all, there are too many groups, or the
            numbers of joints differ.
    """
    groups = {name: recordings for name, recordings in groups.items() if recordings}
    if not 0 < len(groups) <= len(GROUP_COLOURS):
        raise InputError(
            f"`groups` must hold 1 to {len(GROUP_COLOURS)} groups with errors, but "
            f"holds {len(groups)}."
        )
    all_errors = [errors for recordings in groups.values() for errors in recordings]
    for errors in all_errors:
        require_joints(errors, robot)

    # All recordings are of one robot: the largest forces of the first are those of all.
    max_forces = np.asarray(all_errors[0].max_forces)
    reference = "the largest force"
    if not np.isfinite(max_forces).all():
        max_forces = None
        reference = "RMS force"

    joints = robot.joints
    bar_width = min(0.36, 0.72 / len(groups))
    # The bars of a joint stand side by side, with their middle at the joint's number.
    middle_group = 0.5 * (len(groups) - 1)
    show_numbers = joints * len(groups) <= MAX_BARS_WITH_NUMBERS
    bars = []
    points = []
    for k, (name, recordings) in enumerate(groups.items()):
        colour = GROUP_COLOURS[k]
        shift = (k - middle_group) * (bar_width + 0.02)
        places = np.arange(joints) + shift
        mean_percents, rms_percents = _pooled_percents(recordings, max_forces)
        texts = (
            [percent(value / 100.0) for value in mean_percents] if show_numbers else []
        )
        legend = (
            f"{name}: {percent(float(np.mean(mean_percents)) / 100.0)} % on average"
        )
        bars.append(
            Curve(places, mean_percents, legend, colour, "bars", bar_width, texts=texts)
        )
        points.append(Curve(places, rms_percents, "RMS", colour, "points"))
    panel = Panel(
        [*bars, *points],
        x="",
        y="mean |error|",
        unit=f"% of {reference}",
        x_range=(-0.6, joints - 0.4),
        x_names=robot.joint_names,
    )
    return Figure(
        title or f"{robot.name}: torque errors",
        [panel],
        height=3.5,
        width=max(7.6, min(2.0 + 1.1 * joints, 15.4)),
    )


def _pooled_percents(
    recordings: Sequence[TorqueErrors], max_forces: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and RMS errors [%], as if all recordings were one."""
    errors = np.concatenate([log.errors for log in recordings])
    is_counted = np.isfinite(errors)
    rows = np.maximum(is_counted.sum(axis=0), 1)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.where(is_counted, values, 0.0).sum(axis=0) / rows

    scale = max_forces
    if scale is None:
        forces = np.concatenate([np.asarray(log.measured) for log in recordings])
        rms_forces = np.sqrt(mean(forces**2))
        # No division by zero for a joint without forces.
        scale = np.maximum(rms_forces, np.finfo(float).tiny)
    mean_error = mean(np.abs(errors))
    rms_error = np.sqrt(mean(errors**2))
    return 100.0 * mean_error / scale, 100.0 * rms_error / scale
