"""Numbers as text, and lines of long logs."""

import numpy as np
import pytest

from jaxid.report.lines import thinned
from jaxid.report.numbers import aligned, percent, shortened, significant, with_deviation


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.2345, "1.23"),
        (-0.012345, "-0.0123"),
        (123.456, "123"),
        (9.999, "10.0"),
        (0.9951, "0.995"),
        (1.5e-12, "1.50e-12"),
        (0.0, "0"),
        (float("inf"), "∞"),
        (float("nan"), "–"),  # noqa: RUF001
    ],
)
def test_significant_digits(value, text):
    assert significant(value) == text


@pytest.mark.parametrize(
    ("value", "deviation", "texts"),
    [
        (1.23456, 0.0123, ("1.235", "0.012")),
        (1.23456, 0.00996, ("1.235", "0.010")),
        (1234.56, 12.3, ("1235", "12")),
        (0.5, float("inf"), ("0.5000", "∞")),
    ],
)
def test_estimates_have_the_digits_of_their_deviation(value, deviation, texts):
    assert with_deviation(value, deviation) == texts


def test_percent_and_names():
    assert percent(0.01234) == "1.2"
    assert percent(1.57) == "157"
    assert shortened("short", 8) == "short"
    assert shortened("a_very_long_joint_name", 10) == "a_very…ame"


def test_points_stand_in_one_column():
    lines = aligned(["1.25", "10.5", "300", "–"])  # noqa: RUF001
    width = max(map(len, lines))
    right = [line.rjust(width) for line in lines]
    assert right[0].index(".") == right[1].index(".") == right[2].index("300") + 3


def test_short_lines_stay_as_they_are():
    t, y = np.arange(50.0), np.arange(50.0) ** 2
    times, values = thinned(t, y, 100)
    np.testing.assert_array_equal(times, t)
    np.testing.assert_array_equal(values, y)


def test_long_lines_keep_every_peak_and_their_ends():
    random = np.random.default_rng(0)
    t, y = np.arange(100_000) * 1e-3, random.standard_normal(100_000)
    y[12_345], y[77_777] = 9.0, -9.0
    times, values = thinned(t, y, 300)
    assert len(times) <= 600
    assert values.max() == 9.0
    assert values.min() == -9.0
    assert abs(times[np.argmax(values)] - t[12_345]) < 100.0 / 300
    assert times[0] == t[0]
    assert times[-1] == t[-1]
    assert (np.diff(times) >= 0).all()


@pytest.mark.parametrize("rows", [100, 50_000])
def test_gaps_in_time_break_the_line(rows):
    t = np.arange(rows) / rows
    t[rows // 2 :] += 1.0
    times, values = thinned(t, np.ones(rows), 200)
    assert np.count_nonzero(np.isnan(values)) >= 1
    finite = np.isfinite(times)
    jump = np.flatnonzero(np.diff(times[finite]) > 0.9)
    assert len(jump) == 1
    assert np.isnan(times[jump[0] + 1])


def test_missing_values_stay_out():
    t, y = np.arange(10_000.0), np.ones(10_000)
    y[:5_000] = np.nan
    times, values = thinned(t, y, 100)
    assert np.isnan(values[times < 4_900]).all()
    assert (values[times > 5_100] == 1.0).all()
