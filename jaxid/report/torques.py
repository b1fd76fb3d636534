"""Measured and predicted forces over time, and their errors (Figs. 6, 7, 9 and 10 of the paper)."""

from collections.abc import Sequence

import numpy as np

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.result_table import percent, shortened, significant
from jaxid.robot.robot import Robot
from jaxid.validation.torque_errors import TorqueErrors

from .figure import Figure
from .figure_elements import (
    BLUE,
    ERROR,
    GREEN,
    GREY,
    MEASURED,
    ORANGE,
    PREDICTED,
    PURPLE,
    Curve,
    Panel,
)


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
    shown = range(robot.joints) if joints is None else tuple(joints)
    counted = np.flatnonzero(np.asarray(errors.counted).any(axis=1))
    window = slice(counted[0], counted[-1] + 1)
    name = shortened(errors.name if title is None else title, 40)
    return Figure(
        f"{name}: relative error {percent(errors.relative)} %",
        [_joint_panel(errors, robot, j, window) for j in shown],
        columns=1 if len(shown) <= 2 else 2 if len(shown) <= 16 else 3,
        height=2.6,
        width=11.0 if len(shown) <= 16 else 15.0,
    )


def _joint_panel(errors: TorqueErrors, robot: Robot, j: int, window: slice) -> Panel:
    unit, difference = robot.force_unit(j), errors.errors[window, j]
    time = np.asarray(errors.time)[window]
    measured, predicted = (
        np.asarray(x)[window, j] for x in (errors.measured, errors.predicted)
    )
    text = "no row counts"
    if np.isfinite(difference).any():
        fraction = errors.mean_percent[j] / 100.0
        text = f"mean |e| {significant(errors.mean[j], 2)} {unit}"
        text += f" = {percent(fraction)} % of max" if np.isfinite(fraction) else ""
    largest = float(np.fmax.reduce(np.abs(difference), initial=0.0))
    below = Panel(
        [Curve(time, difference, "predicted - measured", ERROR, width=0.6)],
        unit=unit,
        y_range=(-1.1 * (largest or 1.0), 1.1 * (largest or 1.0)),
        levels=[("y", 0.0, GREY)],
        share=0.4,
    )
    return Panel(
        [
            Curve(time, measured, "measured", MEASURED, width=1.9),
            Curve(time, predicted, "predicted", PREDICTED, width=0.8),
        ],
        title=shortened(robot.joint_names[j], 26),
        value=text,
        y="torque" if robot.revolute[j] else "force",
        unit=unit,
        x_range=(float(time[0]), float(time[-1] if len(time) > 1 else time[0] + 1.0)),
        below=[below],
    )


def require_joints(errors: TorqueErrors, robot: Robot) -> None:
    """Reject errors of another robot."""
    if errors.measured.shape[1] != robot.joints:
        raise InputError(
            f"`errors` of `{errors.name}` must be of the {robot.joints} joints of "
            f"`{robot.name}`."
        )


def error_figure(
    identification: Sequence[TorqueErrors],
    verification: Sequence[TorqueErrors],
    robot: Robot,
) -> Figure:
    """Return mean absolute errors as bars and RMS errors as points (Eq. 37, Fig. 10).

    In percent of the largest forces; of the RMS of the measured forces if a largest one
    is not known. Several recordings count as one.

    Args:
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen; may be empty.
        robot: Robot of the recordings.

    Raises:
        InputError: If there is no recording at all, or the numbers of joints differ.
    """
    groups = (("identification", identification), ("verification", verification))
    return bar_figure(groups, robot)


def bar_figure(
    groups: Sequence[tuple[str, Sequence[TorqueErrors]]], robot: Robot, title: str = ""
) -> Figure:
    """Return mean absolute errors as bars and RMS errors as points, for some groups (Eq. 37).

    In percent of the largest forces; of the RMS of the measured forces if a largest one
    is not known. Recordings of one group count as one.

    Args:
        groups: Names, and errors on some recordings, like those of one estimator;
            groups without recordings are left out.
        robot: Robot of the recordings.
        title: Title of the figure; the robot's name if empty.

    Raises:
        InputError: If there is no recording at all, there are too many groups, or the
            numbers of joints differ.
    """
    colours = (BLUE, ORANGE, GREEN, PURPLE)
    filled = [(name, recordings) for name, recordings in groups if recordings]
    if not 0 < len(filled) <= len(colours):
        raise InputError(
            f"`groups` must hold 1 to {len(colours)} groups with errors, but holds "
            f"{len(filled)}."
        )
    everything = [errors for _, recordings in filled for errors in recordings]
    for errors in everything:
        require_joints(errors, robot)
    largest, n = np.asarray(everything[0].max_forces), robot.joints
    known = bool(np.isfinite(largest).all())
    width = min(0.36, 0.72 / len(filled))
    bars, points = [], []
    for k, (colour, (label, recordings)) in enumerate(
        zip(colours, filled, strict=False)
    ):
        mean, rms, force_rms = _pool(recordings)
        scale = 100.0 / (largest if known else np.maximum(force_rms, 1e-300))
        place = np.arange(n) + (k - 0.5 * (len(filled) - 1)) * (width + 0.02)
        texts = [percent(x / 100.0) for x in mean * scale]
        written = texts if n * len(filled) <= 20 else ()
        average = percent(float(np.mean(mean * scale)) / 100.0)
        label = f"{label}: {average} % on average"
        bars.append(
            Curve(place, mean * scale, label, colour, "bars", width, texts=written)
        )
        points.append(Curve(place, rms * scale, "RMS", colour, "points"))
    return Figure(
        title or f"{robot.name}: torque errors",
        [
            Panel(
                [*bars, *points],
                x="",
                y="mean |error|",
                unit=f"% of {'the largest force' if known else 'RMS force'}",
                x_range=(-0.6, n - 0.4),
                x_names=[shortened(name, 20) for name in robot.joint_names],
            )
        ],
        height=3.5,
        width=max(7.6, min(2.0 + 1.1 * n, 15.4)),
    )


def _pool(recordings: Sequence[TorqueErrors]) -> Float[np.ndarray, "3 joints"]:
    """Return mean and RMS of the errors, and RMS of the forces, as if all were one recording."""
    e = np.concatenate([r.errors for r in recordings])
    counted = np.concatenate([np.asarray(r.counted) for r in recordings])
    forces = np.concatenate([np.asarray(r.measured) for r in recordings])
    rows = np.maximum(counted.sum(axis=0), 1)
    e, forces = (np.where(counted, x, 0.0) for x in (e, forces))
    squares = [(x**2).sum(axis=0) / rows for x in (e, forces)]
    return np.stack([np.abs(e).sum(axis=0) / rows, *np.sqrt(squares)])
