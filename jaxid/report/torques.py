"""Measured and predicted forces over time, and their errors (Figs. 6, 7, 9 and 10)."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.result_table import percent, significant
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import (
    TorqueErrors,
    relative_error,
    relative_joint_errors,
)

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
        f"{name}: RMS error {percent(errors.relative)} % of the RMS forces"
        f"{errors.band_words}",
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
        value=_error_text(errors, j, unit),
        y="torque" if robot.revolute[j] else "force",
        unit=unit,
        x_range=(float(time[0]), float(end)),
        below=[error_panel],
    )


def _error_text(errors: TorqueErrors, j: int, unit: str) -> str:
    """Return a joint's RMS error, and its share of the RMS force."""
    if not np.isfinite(errors.errors[:, j]).any():
        return "no row counts"
    share = percent(float(errors.rms_relative[j]))
    return f"RMS error {significant(errors.rms[j], 2)} {unit} = {share} %"


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
    """Return errors of the joints as bars, RMS error over RMS force, by group.

    Recordings of one group count as one.

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
    for recordings in groups.values():
        for errors in recordings:
            require_joints(errors, robot)

    joints = robot.joints
    bar_width = min(0.36, 0.72 / len(groups))
    # The bars of a joint stand side by side, with their middle at the joint's number.
    middle_group = 0.5 * (len(groups) - 1)
    show_numbers = joints * len(groups) <= MAX_BARS_WITH_NUMBERS
    bars = []
    for k, (name, recordings) in enumerate(groups.items()):
        shift = (k - middle_group) * (bar_width + 0.02)
        places = np.arange(joints) + shift
        shares = relative_joint_errors(recordings)
        texts = [percent(float(share)) for share in shares] if show_numbers else []
        legend = f"{name}: {percent(relative_error(recordings))} % in all"
        colour = GROUP_COLOURS[k]
        bars.append(
            Curve(places, 100 * shares, legend, colour, "bars", bar_width, texts=texts)
        )
    panel = Panel(
        bars,
        x="",
        y="RMS error",
        unit="% of RMS force",
        x_range=(-0.6, joints - 0.4),
        x_names=robot.joint_names,
    )
    return Figure(
        title or f"{robot.name}: torque errors",
        [panel],
        height=3.5,
        width=max(7.6, min(2.0 + 1.1 * joints, 15.4)),
    )
