"""Merged tables with empty cells: channels come back at the times of the angles."""

import numpy as np
import polars as pl
import pytest

from jaxid.errors import InputError
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording
from jaxid.units import DEG

COLUMNS = Columns(("q1", "q2"), ("e1", "e2"), time="t")
DURATION = 6.0


def values(t):
    return np.stack([np.sin(2 * t), np.cos(t)], axis=1)


def merged(angle_times, force_times, turn=0.0):
    """Return a table with a row for each time of angles or forces, in order."""
    angles = values(angle_times)
    if turn:
        angles = np.rad2deg(4.0 * angles) % turn
    angle_rows = pl.DataFrame(
        {"t": angle_times, "q1": angles[:, 0], "q2": angles[:, 1]}
    )
    forces = 3.0 * values(force_times)
    force_rows = pl.DataFrame(
        {"t": force_times, "e1": forces[:, 0], "e2": forces[:, 1]}
    )
    return angle_rows.join(force_rows, on="t", how="full", coalesce=True).sort("t")


def times(rate, lag=0.0):
    return np.round(np.arange(0.0, DURATION, 1 / rate) + lag, 6)


@pytest.mark.parametrize("suffix", ["csv", "parquet", "npz"])
@pytest.mark.parametrize("rate", [90.0, 100.0, 25.0, 400.0])
def test_merged_tables_are_joined(tmp_path, suffix, rate):
    table = merged(times(100.0), times(rate, 0.0031))
    path = tmp_path / f"log.{suffix}"
    if suffix == "csv":
        table.write_csv(path)
    elif suffix == "parquet":
        table.write_parquet(path)
    else:
        np.savez(path, **{c: table[c].cast(float).to_numpy() for c in table.columns})
    r = read_recording(path, COLUMNS)
    assert r.sample_time == pytest.approx(0.01)
    assert r.segments == ((0, r.samples),)
    assert r.samples >= 590
    t = r.time + first_common_time(table)
    np.testing.assert_allclose(r.angles, values(t), atol=1e-9)
    error = 3.0 * 4.0 / 8.0 / rate**2  # of linear interpolation: f'' h² / 8
    np.testing.assert_allclose(r.forces, 3.0 * values(t), atol=1.01 * error + 1e-9)
    assert f"({rate:g} Hz)" in r.notes[0]
    assert "(100 Hz)" in r.notes[0]
    assert ("`filter.cutoff`" in r.notes[0]) == (rate < 80.0)


def first_common_time(table):
    """Return the first time of an angle at which forces are known."""
    force_times = table.filter(pl.col("e1").is_not_null())["t"]
    angle_times = table.filter(pl.col("q1").is_not_null())["t"].to_numpy()
    return angle_times[angle_times >= force_times[0]][0]


def test_rows_of_topics_that_nobody_asked_for_do_not_count(tmp_path):
    table = merged(times(100.0), times(100.0))
    others = pl.DataFrame({"t": times(70.0, 0.0007), "other": 1.0})
    table.join(others, on="t", how="full", coalesce=True).sort("t").write_csv(
        tmp_path / "log.csv"
    )
    r = read_recording(tmp_path / "log.csv", COLUMNS)
    assert r.samples == 600
    np.testing.assert_allclose(r.forces, 3.0 * values(r.time), atol=1e-9)


@pytest.mark.parametrize("unwrap", [True, False])
def test_turns_are_undone_before_angles_are_interpolated(tmp_path, unwrap):
    """Joint 2 has a driver of its own, and both start again at 360 degrees."""
    table = merged(times(100.0), times(100.0, 0.004), turn=360.0)
    columns = Columns(
        ("q1", "e1"), ("e2", "q2"), time="t", angle_unit=DEG, unwrap=unwrap
    )
    force_times = times(100.0, 0.004)
    angles = np.rad2deg(4.0 * values(force_times)[:, 0]) % 360.0
    e1 = pl.DataFrame({"t": force_times, "e1": angles})
    table = table.drop("e1").join(e1, on="t", how="left").sort("t")
    table.write_csv(tmp_path / "log.csv")
    r = read_recording(tmp_path / "log.csv", columns)
    difference = r.angles[:, 1] - r.angles[:, 0]
    if unwrap:
        np.testing.assert_allclose(difference - difference[0], 0.0, atol=1e-3)
    turns = np.round(difference / (2 * np.pi))
    np.testing.assert_allclose(difference, 2 * np.pi * turns, atol=1e-3)


def test_a_merged_table_without_times_names_the_cure(tmp_path):
    merged(times(100.0), times(100.0, 0.004)).write_csv(tmp_path / "log.csv")
    columns = Columns(("q1", "q2"), ("e1", "e2"), sample_time=0.01)
    with pytest.raises(InputError, match=r"give `time` .* instead of `sample_time`"):
        read_recording(tmp_path / "log.csv", columns)


@pytest.mark.parametrize("channel", ["forces", "velocities"])
@pytest.mark.parametrize("empty", ["", "nan"])
def test_a_channel_that_the_driver_does_not_report_is_one_line(
    tmp_path, channel, empty
):
    t = times(100.0)
    lines = [f"{x},{np.sin(x)},{np.cos(x)},{empty},{empty}" for x in t]
    (tmp_path / "log.csv").write_text("\n".join(["t,q1,q2,x1,x2", *lines]))
    others = {"forces": ("x1", "x2")}
    if channel == "velocities":
        others = {"forces": ("q1", "q2"), "velocities": ("x1", "x2")}
        others["forces"] = ("other1", "other2")
        text = (tmp_path / "log.csv").read_text().split("\n")
        rows = [f"{line},1.0,2.0" for line in text[1:]]
        header = f"{text[0]},other1,other2"
        (tmp_path / "log.csv").write_text("\n".join([header, *rows]))
    columns = Columns(("q1", "q2"), time="t", **others)
    with pytest.raises(InputError) as caught:
        read_recording(tmp_path / "log.csv", columns)
    message = str(caught.value)
    assert message.startswith("all values of `x1`, `x2` of `log.csv` are empty or NaN")
    assert ("leave `velocities` out" in message) == (channel == "velocities")


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
@pytest.mark.parametrize("rate", [10.0, 20.0, 50.0])
def test_slow_channels_that_were_repeated_are_said_with_both_rates(
    tmp_path, suffix, rate
):
    table = merged(times(100.0), times(rate)).select(pl.all().forward_fill())
    path = tmp_path / f"log.{suffix}"
    write = table.write_csv if suffix == "csv" else table.write_parquet
    write(path)
    (note,) = [x for x in read_recording(path, COLUMNS).notes if "repeated" in x]
    held_rows = table.height / DURATION / rate
    assert note.startswith(f"`forces` change at {rate:g} Hz only, but the rows come at")
    delay = float(note.partition("`force_delay = ")[2].partition("`")[0])
    assert delay == pytest.approx(0.005 * (held_rows - 1), rel=0.05)
    columns = Columns(("q1", "q2"), ("x1", "x2"), ("e1", "e2"), time="t")
    table = table.with_columns(x1=2 * pl.col("q1"), x2=3 * pl.col("q2"))
    table.write_parquet(tmp_path / "log.parquet")
    (note,) = read_recording(tmp_path / "log.parquet", columns).notes
    assert "`velocities` change at" in note
    assert "leave `velocities` out" in note


@pytest.mark.parametrize("rate", [25.0, 90.0, 400.0])
def test_merged_tables_whose_empty_cells_were_filled(tmp_path, rate):
    sparse_table = merged(times(100.0), times(rate, 0.0031))
    sparse_table.write_parquet(tmp_path / "sparse.parquet")
    table = sparse_table.select(pl.all().forward_fill())
    table.write_parquet(tmp_path / "filled.parquet")
    expected = read_recording(tmp_path / "sparse.parquet", COLUMNS)
    r = read_recording(tmp_path / "filled.parquet", COLUMNS)
    np.testing.assert_allclose(r.angles, expected.angles, atol=1e-9)
    np.testing.assert_allclose(r.forces, expected.forces, atol=1e-9)
    assert r.notes == expected.notes


@pytest.mark.parametrize("step", [0.02, 0.1, 0.5])
def test_coarse_forces_are_not_called_repeated(tmp_path, step):
    table = merged(times(100.0), times(100.0))
    coarse = [(pl.col(name) / step).round() * step for name in ("e1", "e2")]
    table.with_columns(coarse).write_parquet(tmp_path / "log.parquet")
    assert read_recording(tmp_path / "log.parquet", COLUMNS).notes == ()
