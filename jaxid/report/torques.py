"""Measured and predicted forces over time, and their errors (Figs. 6, 7, 9 and 10)."""

from collections.abc import Mapping, Sequence

import numpy as np

from jaxid.errors import InputError
from jaxid.identification.model_selection import HeldOutPrediction
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
MODEL_COLOURS = (PREDICTION_COLOUR, BLUE)
"""Colours of what one or two models predict."""


Predictions = Mapping[str, HeldOutPrediction | TorqueErrors]
"""Predictions of one or two models for one log, by their names."""


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
    rows = np.flatnonzero(errors.counted.any(axis=1))
    window = slice(rows[0], rows[-1] + 1)
    panels = [
        force_panel(
            {"predicted": errors}, robot, j, window, _error_text(errors, robot, j)
        )
        for j in joints
    ]
    name = errors.name if title is None else title
    title = f"{name}: RMS error {percent(errors.relative)} % of the RMS forces"
    return _force_figure(f"{title}{errors.band_words}", panels)


def model_force_figure(predictions: Predictions, robot: Robot, title: str) -> Figure:
    """Return the measured forces of each joint, those of two models, and their errors.

    Args:
        predictions: What each model predicts, by its name; all of one log.
        robot: Robot of the log.
        title: Title of the figure.
    """
    errors = next(iter(predictions.values())).errors
    # Forces of some joints may not be measured.
    is_measured = np.isfinite(errors).any(axis=0)
    joints = np.flatnonzero(is_measured).tolist()
    return _force_figure(title, [force_panel(predictions, robot, j) for j in joints])


def _force_figure(title: str, panels: Sequence[Panel]) -> Figure:
    return Figure(title, panels, columns=2 if len(panels) > 2 else 1, height=2.8)


def force_panel(
    predictions: Predictions,
    robot: Robot,
    joint: int,
    rows: slice = slice(None),
    value: str = "",
) -> Panel:
    """Return the forces of a joint, with the errors of the models in a panel below."""
    unit = robot.force_unit(joint)
    log = next(iter(predictions.values()))
    time = log.time[rows]
    measured_forces = log.measured[rows, joint]
    curves = [Curve(time, measured_forces, "measured", MEASUREMENT_COLOUR, width=1.9)]
    error_curves = []
    for (name, prediction), colour in zip(
        predictions.items(), MODEL_COLOURS, strict=False
    ):
        predicted_forces = prediction.predicted[rows, joint]
        errors = prediction.errors[rows, joint]
        curves.append(Curve(time, predicted_forces, name, colour, width=0.8))
        error_curves.append(Curve(time, errors, name, colour, width=0.6))
    error_panel = Panel(
        error_curves, y="error", unit=unit, levels=[("y", 0.0, GREY)], share=0.5
    )
    return Panel(
        curves,
        title=robot.joint_names[joint],
        value=value,
        y="torque" if robot.revolute[joint] else "force",
        unit=unit,
        below=[error_panel],
    )


def _error_text(errors: TorqueErrors, robot: Robot, j: int) -> str:
    """Return a joint's RMS error, and its share of the RMS force."""
    if not np.isfinite(errors.errors[:, j]).any():
        return "no row counts"
    share = percent(errors.rms_relative[j])
    return (
        f"RMS error {significant(errors.rms[j], 2)} {robot.force_unit(j)} = {share} %"
    )


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
        texts = [percent(share) for share in shares] if show_numbers else []
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
