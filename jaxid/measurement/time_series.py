"""Channels with times of their own, interpolated at the times of the first angle."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.errors import InputError

MAX_STEP_RATIO = 3.0
"""Distance of two values, in typical ones, up to which others are interpolated."""
MIN_SPARSE_SHARE = 0.2
"""Fraction of incomplete rows from which channels have times of their own."""
MIN_CHANGES = 20
"""Rows at which other channels than before have values, in such a table."""
SLOW_RATE = 0.8
"""Rate of a channel, in that of the angles, below which it is slow."""
MAX_COMMON_SHARE = 0.3
"""Fraction of a channel's changes that may come with those of another's clock."""
MIN_HELD_ROWS = 1.5
"""Rows for each change, in the mean, from which a channel holds its values."""
MIN_EVEN_SHARE = 0.9
"""Fraction of the changes that come evenly where a slower channel is repeated."""
PASSED_BAND = 0.1
"""Frequency, in rates of a channel, up to which interpolation keeps amplitudes."""

NamedChannels = dict[str, Matrix]
"""Values (rows x joints) by channel; those that are not finite are not there."""


class JoinedChannels(NamedTuple):
    """Channels at common times."""

    stamps: Vector  # [s]
    channels: NamedChannels
    notes: Texts


def is_sparse(channels: NamedChannels) -> bool:
    """Return whether channels have values at different rows, as in a merged table."""
    has_value = np.isfinite(np.hstack([*channels.values()]))
    incomplete_share = np.mean(~has_value.all(axis=1))
    changes = np.count_nonzero(np.diff(has_value, axis=0).any(axis=1))
    is_mixed = incomplete_share > MIN_SPARSE_SHARE and changes >= MIN_CHANGES
    return bool(incomplete_share == 1.0 or is_mixed)


def without_filling(channels: NamedChannels) -> NamedChannels:
    """Return channels with NaN where a merged table repeats the last value instead.

    Only where each row has new angles or new forces, but hardly one has both.
    """
    changes = {
        name: np.append(True, np.diff(values, axis=0).any(axis=1))
        for name, values in channels.items()
    }
    measured_names = [x for x in ("forces", "wrench", "commands") if x in changes]
    rows = np.stack([changes["angles"], changes[measured_names[0]]])
    smaller_count = rows.sum(axis=1).min()
    is_filled = (
        smaller_count >= MIN_CHANGES
        and np.count_nonzero(rows.all(axis=0)) < MAX_COMMON_SHARE * smaller_count
        and np.mean(rows.any(axis=0)) > MIN_EVEN_SHARE
    )
    if not is_filled:
        return channels
    return {
        name: np.where(changes[name][:, None], values, np.nan)
        for name, values in channels.items()
    }


def join_channels(
    stamps: Vector | None, channels: NamedChannels, source: str
) -> JoinedChannels:
    """Return channels at the times of the first angle, interpolated linearly.

    Rows before the first or after the last value of a channel, and in its pauses, are
    left out.

    Raises:
        InputError: If there are no stamps, or no common times.
    """
    if stamps is None:
        raise InputError(
            f"the channels of `{source}` have values in different rows, and so have "
            "different times: give `time` (its column of time stamps; bags have a "
            "clock) instead of `sample_time`."
        )
    order = np.argsort(stamps, kind="stable")
    order = order[np.isfinite(stamps[order])]
    stamps = stamps[order]
    rows = np.flatnonzero(np.isfinite(channels["angles"][order, 0]))
    times = stamps[rows]
    joined = {}
    notes = []
    for channel, values in channels.items():
        ordered_values = values[order]
        are_angles = channel in ("angles", "commands")
        joined[channel] = _at_rows(stamps, ordered_values, rows, are_angles)
        notes += _rate_notes(channel, stamps, ordered_values, rows)
    is_common = np.isfinite(np.hstack([*joined.values()])).all(axis=1)
    if not is_common.any():
        raise InputError(
            f"the channels of `{source}` do not overlap in time: check their clocks."
        )
    lost_rows = int(np.sum(~is_common))
    if lost_rows:
        notes.append(
            f"{lost_rows} of {len(rows)} rows of the angles were left out: other "
            "channels pause there"
        )
    common = {channel: values[is_common] for channel, values in joined.items()}
    return JoinedChannels(times[is_common], common, tuple(notes))


def _at_rows(stamps: Vector, values: Matrix, rows: Vector, are_angles: bool) -> Matrix:
    """Return the values of a channel at some rows, interpolated where it has none."""
    columns = []
    for column in values.T:
        value_rows = np.flatnonzero(np.isfinite(column))
        method = partial(interpolate, stamps[value_rows], targets=stamps[rows])
        if np.array_equal(value_rows, rows):
            columns.append(column[rows])
        elif are_angles:
            columns.append(interpolate_turns(method, column[value_rows]))
        else:
            columns.append(method(column[value_rows]))
    return np.column_stack(columns)


def _rate_notes(
    channel: str, stamps: Vector, values: Matrix, rows: Vector
) -> list[str]:
    """Return a remark about the joints of each rate that have other times."""
    joints_of_rate: dict[float, list[str]] = {}
    for joint, column in enumerate(values.T, 1):
        value_rows = np.flatnonzero(np.isfinite(column))
        if not np.array_equal(value_rows, rows):
            rate = _rate(stamps[value_rows])
            joints_of_rate.setdefault(rate, []).append(str(joint))
    main_rate = _rate(stamps[rows])
    return [
        _rate_note(channel, joints, rate, main_rate)
        for rate, joints in joints_of_rate.items()
    ]


def hold_notes(channels: NamedChannels, sample_time: float) -> list[str]:
    """Return a remark about each channel that repeats its values at even distances.

    Programs that merge a slow channel with fast ones repeat its last value.
    """
    notes = []
    for channel, values in channels.items():
        changes = np.flatnonzero(np.diff(values, axis=0).any(axis=1))
        # Servos hold their commands, which is no fault of the log.
        if channel in ("angles", "commands") or len(changes) < MIN_CHANGES:
            continue
        lengths = np.diff(changes)
        length = float(np.mean(lengths))
        is_even = np.mean(np.abs(lengths - length) < 1.0) > MIN_EVEN_SHARE
        if length > MIN_HELD_ROWS and is_even:
            rate = 1.0 / (length * sample_time)
            cure = "leave `velocities` out, or record them faster"
            if channel in ("forces", "wrench"):
                delay = 0.5 * (length - 1.0) * sample_time
                cure = (
                    "unless the drive itself holds the values, remove their delay "
                    f"with `force_delay = {delay:.3g}`, and keep `filter.cutoff` below "
                    f"{PASSED_BAND * rate:.3g} Hz"
                )
            notes.append(
                f"`{channel}` change at {rate:.3g} Hz only, but the rows come at "
                f"{1.0 / sample_time:.3g} Hz, so that each value is repeated: {cure}"
            )
    return notes


def _rate(times: Vector) -> float:
    """Return the typical number of values in a second [Hz]."""
    steps = np.diff(times)
    steps = steps[steps > 0]
    return float(f"{1.0 / np.median(steps):.3g}") if steps.size else 0.0


def _rate_note(channel: str, joints: list[str], rate: float, main_rate: float) -> str:
    """Return a remark about a channel with other times, and what its rate costs."""
    note = (
        f"`{channel}` of joints {', '.join(joints)} have their own time stamps "
        f"({rate:g} Hz): they were interpolated linearly at the stamps of the angles "
        f"({main_rate:g} Hz)"
    )
    if rate < SLOW_RATE * main_rate:
        note += (
            f"; this weakens motion faster than {PASSED_BAND * rate:.3g} Hz: record "
            "both at one rate, or keep `filter.cutoff` below that"
        )
    return note


def interpolate(times: Vector, values: Vector, targets: Vector) -> Vector:
    """Return values at other times; NaN outside and in pauses."""
    nan = np.nan
    target_values = np.interp(targets, times, values, left=nan, right=nan)
    steps = np.diff(times, prepend=times[0])
    max_step = MAX_STEP_RATIO * np.median(steps)
    # The step that ends at or after each target.
    index = np.searchsorted(times, targets)
    index = np.minimum(index, len(times) - 1)
    is_after_pause = steps[index] > max_step
    is_between = times[index] != targets
    target_values[is_after_pause & is_between] = nan
    return target_values


def interpolate_turns(
    method: Callable[[np.ndarray], np.ndarray], angles: np.ndarray
) -> np.ndarray:
    """Interpolate angles; those that jump by full turns go on doing so.

    Args:
        method: Interpolation of smooth channels.
        angles: Angles (rows, or rows x joints) [rad].
    """
    turn = 2 * np.pi
    unwrapped = np.unwrap(angles, axis=0)
    # Fast motors turn by half a turn between two values, too, but go on and on.
    is_within_turn = np.ptp(angles, axis=0) <= 1.01 * turn
    has_jumps = is_within_turn & (unwrapped != angles).any(axis=0)
    values = method(np.where(has_jumps, unwrapped, angles))
    lower_limit = angles.min(axis=0) - 1e-9
    return np.where(has_jumps, lower_limit + (values - lower_limit) % turn, values)
