"""Stamps out of order and bursts of reception: even logs come back, notes say why."""

import numpy as np
import polars as pl
import pytest

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording
from jaxid.measurement.recording import Recording

STEP = 0.01
TIMES = STEP * np.arange(600)


def recording(rows, stamps, **kwargs):
    """Return a log of smooth joints whose rows were measured at other times."""
    t = TIMES[rows]
    x = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    return Recording.of(x, 2 * x, time=stamps, **kwargs)


def check(r, samples=600):
    assert r.samples == samples
    assert r.sample_time == pytest.approx(STEP, rel=1e-3)
    np.testing.assert_allclose(r.angles[:, 0], np.sin(3 * TIMES[:samples]), atol=1e-9)


@pytest.mark.parametrize("exchange", ["neighbours", "late by three", "blocks"])
def test_rows_out_of_order_are_sorted(tmp_path, exchange):
    rows = np.arange(600)
    if exchange == "neighbours":
        rows[100::50], rows[101::50] = rows[101::50].copy(), rows[100::50].copy()
    elif exchange == "late by three":
        rows[200:204] = [201, 202, 203, 200]
    else:
        rows = np.roll(rows, 250)
    r = recording(rows, TIMES[rows])
    check(r)
    assert "sorted by their stamps" in r.notes[0]
    assert ("from 5.99 s to 0 s at row 251" in r.notes[0]) == (exchange == "blocks")
    path = tmp_path / "log.csv"
    x = np.sin(3 * TIMES[rows])
    pl.DataFrame({"t": TIMES[rows], "q1": x, "tau1": x}).write_csv(path)
    read = read_recording(path, Columns("q{}", "tau{}", time="t"))
    check(read)
    assert "sorted by their stamps" in read.notes[0]


@pytest.mark.parametrize("shift", [0.2, 1.004])
def test_a_clock_that_was_set_back_is_refused(shift):
    stamps = TIMES.copy()
    stamps[300:] -= shift
    with pytest.raises(InputError, match=r"row 301.* set back; .*`sample_time`"):
        recording(np.arange(600), stamps)


@pytest.mark.parametrize("kind", ["seconds alone", "coarse clock", "two drivers"])
def test_stamps_that_many_samples_share_are_refused(kind):
    rows = np.arange(600)
    stamps = np.floor(TIMES)
    if kind == "coarse clock":
        stamps = np.floor(TIMES / 0.1) * 0.1
    elif kind == "two drivers":
        rows = np.stack([rows, 0 * rows], axis=1).ravel()
        stamps = np.repeat(TIMES, 2)
    with pytest.raises(InputError, match=r"rows of `recording` have the time stamp"):
        recording(rows, stamps)


def test_samples_that_a_fast_logger_repeats_are_removed():
    rows = np.repeat(np.arange(600), 5)
    check(recording(rows, TIMES[rows]))


@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_seconds_and_nanoseconds_of_two_columns(tmp_path, suffix):
    ticks = 1_700_000_000_950_000_000 + np.round(TIMES * 1e9).astype(np.int64)
    x = np.sin(3 * TIMES)
    columns = {"sec": ticks // 10**9, "nanosec": ticks % 10**9, "q1": x, "tau1": x}
    path = tmp_path / f"log{suffix}"
    if suffix == ".csv":
        pl.DataFrame(columns).write_csv(path)
    else:
        np.savez(path, **columns)
    names = Columns("q{}", "tau{}", time=["sec", "nanosec"])
    log = read_recording(path, names)
    check(log)
    assert log.stamp_deviation < 1e-6


def test_turns_are_not_smeared_by_jitter():
    """A joint that turns on and on, whose angle starts again at 180 degrees."""
    rng = np.random.default_rng(3)
    stamps = TIMES + STEP * rng.uniform(-0.2, 0.2, 600)
    stamps -= stamps[0]
    angle = 1.3 * stamps + np.sin(stamps)
    x = np.stack([(angle + np.pi) % (2 * np.pi) - np.pi, np.sin(stamps)], axis=1)
    r = Recording.of(x, x, time=stamps)
    assert "jitter" in r.notes[-1]
    expected = 1.3 * r.time + np.sin(r.time)
    turns = (r.angles[:, 0] - expected) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
    assert np.ptp(r.angles[:, 0]) < 2 * np.pi
    np.testing.assert_allclose(r.angles[:, 1], np.sin(r.time), atol=1e-5)


def bursts(lengths, delay=1e-4):
    """Return stamps of reception of bursts with these numbers of rows."""
    ends = np.cumsum(lengths)
    numbers = np.repeat(np.arange(len(ends)), lengths)
    starts = np.repeat(ends - lengths, lengths)
    return STEP * ends[numbers] + delay * (np.arange(ends[-1]) - starts)


@pytest.mark.parametrize("length", [2, 4, 15])
def test_bursts_of_reception_become_even(length):
    r = recording(np.arange(600), bursts(np.full(600 // length, length)))
    check(r)
    assert f"bursts of about {length}" in r.notes[0]
    assert "`sample_time`" in r.notes[0]


def test_bursts_of_several_lengths_become_even():
    lengths = np.tile([3, 5, 4, 4], 37)
    r = recording(np.arange(592), bursts(lengths))
    check(r, 592)


def test_uneven_bursts_ask_for_the_sample_time():
    stamps = bursts(np.full(150, 4))
    stamps[300:] += 10.5 * 4 * STEP  # no whole number of bursts
    with pytest.raises(InputError, match=r"bursts of about 4.*give `sample_time`"):
        recording(np.arange(600), stamps)


@pytest.mark.parametrize("lost_rows", [[5, 90, 301, 302, 440], range(200, 208)])
def test_bursts_that_lack_rows_are_refused_without_a_sample_time(lost_rows):
    stamps = np.delete(bursts(np.full(150, 4)), lost_rows)
    numbers = np.delete(np.arange(600), lost_rows)
    if len(lost_rows) == 5:
        stamps = np.delete(stamps, np.arange(100, 130, 4))
        numbers = np.delete(numbers, np.arange(100, 130, 4))
    with pytest.raises(InputError, match=r"rows .* are lost.*last row of each burst"):
        recording(numbers, stamps)
    is_last = np.append(np.diff(stamps) > 1e-3, True)
    r = recording(numbers[is_last], stamps[is_last])
    assert r.sample_time == pytest.approx(4 * STEP)


@pytest.mark.parametrize("rows", [20, 30])
def test_short_episodes_are_no_bursts(rows):
    episodes = 600 // rows
    stamps = TIMES + np.repeat(5.0 * np.arange(episodes), rows)
    r = recording(np.arange(600), stamps)
    assert len(r.segments) == episodes
