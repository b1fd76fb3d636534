"""Errors of a model joint by joint (Fig. 10 of the paper), and errors of following a path."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.report.style import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PURPLE,
    VERMILION,
    WIDTH,
    caption,
    heading,
    house_style,
    logarithmic,
    new_figure,
)
from jaxid.report.torques import require_joints
from jaxid.robot.robot import Robot
from jaxid.table import percent, shortened
from jaxid.validation import TorqueErrors


def error_figure(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors], robot: Robot
) -> Figure:
    """Draw mean absolute errors as bars and RMS errors as marks (Eq. 37, Fig. 10).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Several recordings count as one.

    Args:
        identification: Errors on the recordings of the fit.
        verification: Errors on recordings that the fit has not seen; may be empty.
        robot: Robot of the recordings.

    Raises:
        InputError: If there is no recording at all, or the numbers of joints differ.
    """
    if not (*identification, *verification):
        raise InputError("`identification` or `verification` must hold errors, but both are empty.")
    groups = (("identification", identification), ("verification", verification))
    return bar_figure(groups, robot)


def bar_figure(groups: Sequence[tuple[str, Sequence[TorqueErrors]]], robot: Robot) -> Figure:
    """Draw mean absolute errors as bars and RMS errors as marks, for several groups (Eq. 37).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Recordings of one group count as one.

    Args:
        groups: Names, and errors on some recordings, like those of one estimator; groups without
            recordings are left out.
        robot: Robot of the recordings.

    Raises:
        InputError: If there is no recording at all, there are too many groups, or the numbers of
            joints differ.
    """
    colours = (BLUE, ORANGE, GREEN, PURPLE)
    filled = [(name, recordings) for name, recordings in groups if recordings]
    if not 0 < len(filled) <= len(colours):
        raise InputError(
            f"`groups` must hold 1 to {len(colours)} groups with errors, but holds {len(filled)}."
        )
    everything = [errors for _, recordings in filled for errors in recordings]
    for errors in everything:
        require_joints(errors, robot)
    largest = np.asarray(everything[0].max_forces)
    known = bool(np.isfinite(largest).all())
    n = robot.joints
    numbered = n <= 10
    with house_style():
        figure = new_figure(max(7.6, min(2.0 + 1.1 * n, 1.4 * WIDTH)), 4.4)
        axes = figure.add_subplot()
        for k, (colour, (label, recordings)) in enumerate(zip(colours, filled, strict=False)):
            mean, rms, force_rms = _pool(recordings)
            scale = 100.0 / (largest if known else np.maximum(force_rms, 1e-300))
            width = min(0.36, 0.72 / len(filled))
            place = np.arange(n) + (k - 0.5 * (len(filled) - 1)) * (width + 0.02)
            _draw_bars(axes, place, width, colour, mean * scale, label, n * len(filled) <= 20)
            axes.plot(
                place,
                rms * scale,
                linestyle="none",
                marker="D",
                markersize=4.5 if numbered else 3.0,
                markerfacecolor="white",
                markeredgecolor=INK,
                markeredgewidth=0.9,
                label="RMS" if k == len(filled) - 1 else "_",
            )
        names = [shortened(name, 20) for name in robot.joint_names]
        tilted = not numbered or max(map(len, names)) > 12
        axes.set_xticks(
            np.arange(n), names, rotation=35 if tilted else 0, ha="right" if tilted else "center"
        )
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        margin = 0.6 + 0.5 * max(0, 4 - n)
        axes.set_xlim(-margin, n - 1 + margin)
        axes.set_ylabel(f"error [% of {'the largest force' if known else 'RMS force'}]")
        heading(figure, f"{robot.name}: torque errors")
        handles, _ = axes.get_legend_handles_labels()
        bars_first = sorted(handles, key=lambda handle: handle.get_label() == "RMS")
        figure.legend(handles=bars_first, loc="outside lower left", ncols=3)
    return figure


def _pool(
    recordings: Sequence[TorqueErrors],
) -> tuple[
    Float[np.ndarray, " joints"], Float[np.ndarray, " joints"], Float[np.ndarray, " joints"]
]:
    """Return mean and RMS of the errors, and RMS of the forces, as if all were one recording."""
    e = np.concatenate([r.errors for r in recordings])
    counted = np.concatenate([np.asarray(r.counted) for r in recordings])
    forces = np.concatenate([np.asarray(r.measured) for r in recordings])
    rows = np.maximum(counted.sum(axis=0), 1)
    e, forces = np.where(counted, e, 0.0), np.where(counted, forces, 0.0)
    mean = np.abs(e).sum(axis=0) / rows
    rms, force_rms = (np.sqrt((x**2).sum(axis=0) / rows) for x in (e, forces))
    return mean, rms, force_rms


def _draw_bars(
    axes: Axes,
    place: np.ndarray,
    width: float,
    colour: str,
    mean: np.ndarray,
    label: str,
    numbered: bool,
) -> None:
    average = percent(float(np.mean(mean)) / 100.0)
    axes.bar(place, mean, width, color=colour, label=f"{label}, mean |e|: {average} % on average")
    for x, value in zip(place, mean, strict=True) if numbered else ():
        axes.annotate(
            percent(value / 100.0),
            (x, 0.0),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=7.5,
            color="white" if colour == BLUE else INK,
        )


def distance_figure(
    runs: Sequence[tuple[str, Float[AnyArray, " samples"], Float[AnyArray, " samples"]]],
    title: str = "distance of the end-effector from its path",
) -> Figure:
    """Draw distances along a path on a logarithmic scale, a line for each run.

    Args:
        runs: Names, times [s] and distances [m] of one to three runs.
        title: Title of the figure.
    """
    least = 1e-2
    with house_style():
        figure = new_figure(WIDTH, 3.8)
        heading(figure, title)
        axes = figure.subplots()
        for (name, time, distance), colour in zip(runs, (GREY, VERMILION, BLUE), strict=False):
            millimetres = 1e3 * np.asarray(distance)
            rms = float(np.sqrt(np.mean(millimetres**2)))
            shown = np.maximum(millimetres, least)
            label = f"{name}: RMS {rms:.3g} mm"
            axes.plot(np.asarray(time), shown, color=colour, linewidth=1.0, label=label)
        logarithmic(axes, "y")
        axes.set_ylim(bottom=least)
        axes.set_xlim(float(runs[0][1][0]), float(runs[0][1][-1]))
        axes.set_xlabel("time [s]")
        caption(axes, "distance [mm]")
        figure.legend(loc="outside lower left", ncols=len(runs))
    return figure
