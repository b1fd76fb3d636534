"""Torque errors joint by joint, for identification beside verification (Fig. 10 of the paper)."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from matplotlib.figure import Figure

from jaxid.arrays import Float
from jaxid.errors import InputError
from jaxid.report.numbers import percent, shortened
from jaxid.report.style import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    WIDTH,
    heading,
    house_style,
    new_figure,
)
from jaxid.report.torques import require_joints
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors

BAR = 0.36
COLOURS = (BLUE, ORANGE, GREEN, PURPLE)
NUMBERED = 10
"""Most joints whose bars bear numbers."""


class _Pooled(eqx.Module):
    """Errors of several recordings as if they were one."""

    mean: Float[np.ndarray, " joints"]
    rms: Float[np.ndarray, " joints"]
    force_rms: Float[np.ndarray, " joints"]

    @classmethod
    def of(cls, recordings: Sequence[TorqueErrors]) -> "_Pooled":
        e = np.concatenate([r.errors for r in recordings])
        counted = np.concatenate([np.asarray(r.counted) for r in recordings])
        forces = np.concatenate([np.asarray(r.measured) for r in recordings])
        rows = np.maximum(counted.sum(axis=0), 1)
        e, forces = np.where(counted, e, 0.0), np.where(counted, forces, 0.0)
        return cls(
            np.abs(e).sum(axis=0) / rows,
            np.sqrt((e**2).sum(axis=0) / rows),
            np.sqrt((forces**2).sum(axis=0) / rows),
        )


def error_figure(
    identification: Sequence[TorqueErrors], verification: Sequence[TorqueErrors], robot: Robot
) -> Figure:
    """Draws mean absolute errors as bars and RMS errors as marks (Eq. 37, Fig. 10).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Several recordings count as one.

    Args:
        identification: On the recordings of the fit.
        verification: On recordings that the fit has not seen; may be empty.
        robot: Whose joints they are.

    Raises:
        InputError: If there is no recording at all, or the numbers of joints differ.
    """
    if not (*identification, *verification):
        raise InputError("`identification` or `verification` must hold errors, but both are empty.")
    groups = (("identification", identification), ("verification", verification))
    return bar_figure(groups, robot)


def bar_figure(groups: Sequence[tuple[str, Sequence[TorqueErrors]]], robot: Robot) -> Figure:
    """Draws mean absolute errors as bars and RMS errors as marks, for several groups (Eq. 37).

    In percent of the largest forces; of the RMS of the measured forces if a largest one is not
    known. Recordings of one group count as one.

    Args:
        groups: Names, and errors on some recordings, like those of one estimator; groups without
            recordings are left out.
        robot: Whose joints they are.

    Raises:
        InputError: If there is no recording at all, there are too many groups, or the numbers of
            joints differ.
    """
    filled = [(name, recordings) for name, recordings in groups if recordings]
    if not 0 < len(filled) <= len(COLOURS):
        raise InputError(
            f"`groups` must hold 1 to {len(COLOURS)} groups with errors, but holds {len(filled)}."
        )
    everything = [errors for _, recordings in filled for errors in recordings]
    for errors in everything:
        require_joints(errors, robot)
    largest = np.asarray(everything[0].max_forces)
    known = bool(np.isfinite(largest).all())
    n = robot.joints
    pooled_groups = [
        (label, colour, _Pooled.of(recordings))
        for colour, (label, recordings) in zip(COLOURS, filled, strict=False)
    ]
    bar = min(BAR, 2 * BAR / len(filled))
    with house_style():
        figure = new_figure(max(7.6, min(2.0 + 1.1 * n, 1.4 * WIDTH)), 4.4)
        axes = figure.add_subplot()
        for k, (label, colour, pooled) in enumerate(pooled_groups):
            place = np.arange(n) + (k - 0.5 * (len(filled) - 1)) * (bar + 0.02)
            scale = 100.0 / (largest if known else np.maximum(pooled.force_rms, 1e-300))
            mean, rms = pooled.mean * scale, pooled.rms * scale
            average = percent(float(np.mean(mean)) / 100.0)
            axes.bar(
                place, mean, bar, color=colour, label=f"{label}, mean |e|: {average} % on average"
            )
            axes.plot(
                place,
                rms,
                linestyle="none",
                marker="D",
                markersize=4.5 if n <= NUMBERED else 3.0,
                markerfacecolor="white",
                markeredgecolor=INK,
                markeredgewidth=0.9,
                label="RMS" if k == len(filled) - 1 else "_",
            )
            if n * len(filled) <= 2 * NUMBERED:
                for x, value in zip(place, mean, strict=True):
                    axes.annotate(
                        percent(value / 100.0),
                        (x, 0.0),
                        (0, 3),
                        textcoords="offset points",
                        ha="center",
                        fontsize=7.5,
                        color="white" if colour == BLUE else INK,
                    )
        names = [shortened(name, 20) for name in robot.joint_names]
        tilted = n > NUMBERED or max(map(len, names)) > 12
        axes.set_xticks(
            np.arange(n), names, rotation=35 if tilted else 0, ha="right" if tilted else "center"
        )
        axes.tick_params(axis="x", length=0)
        axes.grid(visible=False, axis="x")
        beside = 0.6 + 0.5 * max(0, 4 - n)
        axes.set_xlim(-beside, n - 1 + beside)
        axes.set_ylabel(f"error [% of {'the largest force' if known else 'RMS force'}]")
        heading(figure, f"{robot.name}: torque errors")
        handles, _ = axes.get_legend_handles_labels()
        bars_first = sorted(handles, key=lambda handle: handle.get_label() == "RMS")
        figure.legend(handles=bars_first, loc="outside lower left", ncols=3)
    return figure
