"""Time stamps as loggers write them: twins, gaps, jitter; and parts of recordings."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from jaxid.measurement.recording import Recording


def recording(time, **kwargs):
    t = np.asarray(time)
    x = np.stack([np.sin(3 * t), np.cos(2 * t)], axis=1)
    return Recording.of(x, 2 * x, time=t, **kwargs)


def test_uniform_stamps_stay_as_they_are():
    t = np.round(0.01 * np.arange(100), 4) + 5.0
    r = recording(t)
    assert r.sample_time == 0.01
    np.testing.assert_allclose(r.time, 0.01 * np.arange(100), atol=1e-12)
    np.testing.assert_array_equal(r.angles[:, 0], np.sin(3 * t))
    assert r.notes == ("time starts at zero at the first row, whose stamp was 5 s",)


def test_repeated_stamps_are_removed_and_counted():
    t = np.insert(0.01 * np.arange(100), [10, 50, 50], [0.09, 0.49, 0.49])
    r = recording(t)
    assert r.samples == 100
    np.testing.assert_allclose(
        r.angles[:, 0], np.sin(0.03 * np.arange(100)), atol=1e-12
    )
    assert "3 of 103 rows repeat the time stamp" in r.notes[0]


def test_backward_stamps_are_refused_with_their_row():
    t = 0.01 * np.arange(100)
    t[40:] -= 0.2
    with pytest.raises(
        ValueError, match=r"backwards from 0.39 s to 0.2 s at row 41, .* set back"
    ):
        recording(t)


@settings(max_examples=15, deadline=None)
@given(
    gaps=st.lists(st.integers(20, 480), min_size=1, max_size=4, unique=True),
    width=st.floats(2.0, 1000.0),
    noise=st.floats(0.0, 0.03),
)
def test_gaps_split(gaps, width, noise):
    gaps = sorted({g for g in gaps if all(g - o >= 10 or g <= o for o in gaps)})
    rng = np.random.default_rng(len(gaps))
    steps = np.full(499, 0.002)
    steps[np.array(gaps) - 1] *= width
    t = np.concatenate([[0], np.cumsum(steps)]) + 0.002 * noise * rng.uniform(
        -0.5, 0.5, 500
    )
    r = recording(t - t[0])
    assert r.segments == tuple(zip([0, *gaps], [*gaps, 500], strict=True))
    assert r.sample_time == pytest.approx(0.002, rel=1e-2)
    assert f"{len(gaps)} gap" in r.notes[0]
    for a, b in r.segments:
        np.testing.assert_allclose(np.diff(r.time[a:b]), r.sample_time, rtol=1e-9)


def test_short_gaps_are_bridged_on_demand_and_lonely_rows_are_left_out():
    t = np.delete(0.01 * np.arange(200), [50, 120, 121])
    split = recording(t)
    assert split.segments == ((0, 50), (50, 119), (119, 197))
    bridging = float(split.notes[0].split("`largest_gap` above ")[1].split()[0])
    r = recording(t, largest_gap=1.05 * bridging)
    assert r.segments == ((0, 200),)
    np.testing.assert_allclose(r.angles[:, 0], np.sin(3 * r.time), atol=1e-6)
    r = recording(np.concatenate([t[:50], [1.0, 1.01], 2.0 + t[:50]]))
    assert r.segments == ((0, 50), (50, 100))
    np.testing.assert_allclose(r.angles[50:, 0], np.sin(3 * (2.0 + t[:50])))
    assert "2 rows between gaps" in r.notes[1]


@pytest.mark.parametrize("jitter", [0.1, 0.4])
def test_jitter_is_undone_by_interpolation(jitter):
    rng = np.random.default_rng(3)
    t = 0.01 * np.arange(1000)
    t[1:-1] += 0.01 * jitter * rng.uniform(-1, 1, 998)
    r = recording(t)
    assert r.segments == ((0, 1000),)
    np.testing.assert_allclose(np.diff(r.time), r.sample_time, rtol=1e-9)
    assert "jitter" in r.notes[-1]
    np.testing.assert_allclose(r.angles[:, 0], np.sin(3 * r.time), atol=1e-6)
    assert np.abs(np.sin(0.03 * np.arange(1000)) - np.sin(3 * t)).max() > 1e-3


X = np.zeros((20, 2))


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"forces": np.zeros((20, 3))}, r"`forces` of `recording` .* shape \(20, 3\)"),
        ({"sample_time": None}, "either `time` or `sample_time`"),
        ({"sample_time": 0.0}, "`sample_time` must be positive"),
        ({"sample_time": None, "time": np.arange(19.0)}, r"`time` .* shape \(19,\)"),
        ({"sample_time": None, "time": np.zeros(20)}, "does not advance"),
        (
            {"velocities": np.where(np.arange(20) == 3, np.inf, X.T).T},
            "`velocities` .* row 4",
        ),
    ],
)
def test_shapes_and_values_are_checked(arguments, complaint):
    with pytest.raises(ValueError, match=complaint):
        Recording.of(**({"angles": X, "forces": X, "sample_time": 0.1} | arguments))


def test_crop_and_split():
    r = recording(np.concatenate([0.01 * np.arange(100), 3 + 0.01 * np.arange(100)]))
    part = r.crop(0.5, 3.5)
    assert part.segments == ((0, 50), (50, 100))
    assert part.time[0] == pytest.approx(0.5)
    assert part.time[-1] == pytest.approx(3.49)
    assert r.crop(stop=0.5).segments == ((0, 50),)
    with pytest.raises(ValueError, match=r"has 5 samples from 0.5 s to 0.55 s"):
        r.crop(0.5, 0.55)
    first, rest = r.split(0.6)
    assert (first.samples, rest.samples) == (120, 80)
    assert (first.segments, rest.segments) == (((0, 100), (100, 120)), ((0, 80),))
    np.testing.assert_array_equal(np.concatenate([first.angles, rest.angles]), r.angles)
    with pytest.raises(ValueError, match="`fraction`"):
        r.split(0.01)
