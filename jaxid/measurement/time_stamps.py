"""Repair of time stamps: rows out of order are sorted, bursts of rows made even."""

from typing import NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.errors import InputError


class BurstLimits(NamedTuple):
    """Limits that tell bursts of reception from jitter, gaps and short episodes.

    Buffers of USB and networks hand over up to some sixteen rows at once, so that most
    of the steps are far shorter than their mean; episodes of fewer rows than that could
    not be filtered.
    """

    step: float = 0.1  # steps within bursts, in mean steps
    share: float = 0.3  # smallest fraction of such steps; equal stamps do not count
    rows: int = 16  # largest mean number of rows of a burst
    bursts: int = 10  # smallest number of bursts
    deviation: float = 0.4  # largest deviation from even times, in burst periods
    unevenness: float = 0.25  # largest error of steps of even bursts, in their periods


BURSTS = BurstLimits()
MAX_OVERLAP = 1.5
"""Rows between two stamps, in those of an even log, up to which time ran only once."""
MAX_LATE_ROWS = 20
"""Rows by which a row may come late on its way to the logger."""
MAX_SHARED_STAMPS = 0.3
"""Fraction of the rows that may have the stamp of another sample."""


def refuse_shared_stamps(stamps: Vector, angles: Matrix, source: str) -> None:
    """Refuse stamps that many different samples share: they do not tell their times."""
    # A logger that is faster than the robot repeats whole samples.
    is_other_sample = (np.diff(angles, axis=0) != 0).any(axis=1)
    share = float(np.mean((np.diff(stamps) == 0) & is_other_sample))
    step = float(np.ptp(stamps)) / len(stamps)
    if share > MAX_SHARED_STAMPS and step > 0:
        raise InputError(
            f"{100 * share:.0f} % of the rows of `{source}` have the time stamp of the "
            "row before, but other angles: if seconds and nanoseconds have columns of "
            "their own, name both as `time`; if two drivers wrote the log, remove the "
            "rows of one; otherwise give `sample_time` instead of the stamps, here "
            f"about {step:.4g} s."
        )


def stamp_order(
    stamps: Vector, source: str, first_row: int
) -> tuple[np.ndarray, Texts]:
    """Return the rows in the order of their stamps, and a note if that is another one.

    Raises:
        InputError: If the clock was set back, so that some times are there twice.
    """
    order = np.argsort(stamps, kind="stable")
    ends = np.flatnonzero(np.diff(stamps) < 0)
    if not ends.size:
        return order, ()
    sorted_stamps = stamps[order]
    steps = np.diff(sorted_stamps)
    step = float(np.median(steps[steps > 0]))
    # All rows between two stamps that are in reverse order, and those of an even log.
    first_position = np.searchsorted(sorted_stamps, stamps[ends + 1], "left")
    end_position = np.searchsorted(sorted_stamps, stamps[ends], "right")
    even_rows = (stamps[ends] - stamps[ends + 1]) / step + 1
    overlaps = (end_position - first_position) / even_rows
    is_refused = overlaps.max() > MAX_OVERLAP
    k = int(ends[np.argmax(overlaps if is_refused else even_rows)])
    place = (
        f"from {stamps[k]:.9g} s to {stamps[k + 1]:.9g} s at row {k + 1 + first_row}"
    )
    if is_refused:
        raise InputError(
            f"the time of `{source}` runs backwards {place}, and some times occur "
            "twice: the clock was set back; cut the log there into two files, or, if "
            "the motion goes on there as if nothing had happened, give `sample_time` "
            f"(about {step:.4g} s)."
        )
    plural = "s" if ends.size > 1 else ""
    note = (
        f"time runs backwards at {ends.size} row{plural}, farthest {place}: the rows "
        "were sorted by their stamps"
    )
    return order, (note,)


def burst_length(stamps: Vector) -> float:
    """Return how many rows a burst of reception has; 0 if there are no bursts."""
    steps = np.diff(stamps)
    is_short = steps < BURSTS.step * steps.mean()
    bursts = np.count_nonzero(~is_short) + 1
    length = len(stamps) / bursts
    is_likely = (
        np.mean(is_short & (steps > 0)) >= BURSTS.share
        and bursts >= BURSTS.bursts
        and length <= BURSTS.rows
    )
    return length if is_likely else 0.0


def even_stamps(stamps: Vector, source: str) -> tuple[Vector, Texts]:
    """Return even stamps for rows that were received in bursts, and a note.

    Raises:
        InputError: If the bursts do not come as evenly as their rows.
    """
    length = burst_length(stamps)
    if not length:
        return stamps, ()
    steps = np.diff(stamps)
    # The last row of a burst was measured just before the burst was received.
    is_last = np.append(steps >= BURSTS.step * steps.mean(), True)
    rows = np.flatnonzero(is_last)
    times = stamps[rows] - stamps[0]
    sample_time, start = np.polyfit(rows, times, 1)
    deviation = np.abs(start + sample_time * rows - times).max()
    period = length * sample_time
    text = f"rows were received in bursts of about {length:.3g}, every {period:.4g} s"
    if deviation > BURSTS.deviation * period:
        burst_steps = np.diff(times) / np.median(np.diff(times))
        if np.abs(burst_steps - np.round(burst_steps)).max() < BURSTS.unevenness:
            raise InputError(
                f"{text}, but some rows of `{source}` are lost, so that the times of "
                "the others cannot be determined: keep only the last row of each "
                "burst, or record again."
            )
        raise InputError(
            f"{text}, but not evenly, so that the times of the measurements cannot be "
            f"determined from the stamps of `{source}`: give `sample_time` instead, "
            f"here about {sample_time:.4g} s."
        )
    sample_time = float(f"{sample_time:.4g}")
    note = (
        f"{text}: evenly spaced stamps were assigned, {sample_time:.4g} s apart; "
        "give `sample_time` if you know a better one"
    )
    return stamps[0] + sample_time * np.arange(len(stamps)), (note,)
