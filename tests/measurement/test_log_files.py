"""Log files: reading returns what was written; errors name file, column and line."""

import re

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat

from jaxid import units
from jaxid.measurement.columns import Columns
from jaxid.measurement.reading import read_recording
from jaxid.units import Quantity, Unit

COLUMNS = Columns(angles="q{}", forces="tau{}", velocities="dq{}", time="t")
PLAIN = Columns(angles="q{}", forces="tau{}", time="t")
UNTIMED = Columns(angles="q{}", forces="tau{}", sample_time=0.002)
FINITE = st.floats(-1e6, 1e6, allow_subnormal=False)


def a_log(joints=2, samples=12):
    rng = np.random.default_rng(7)
    log = {"t": 0.004 * np.arange(samples)}
    for group in ("q", "dq", "tau"):
        log |= {f"{group}{j + 1}": rng.normal(size=samples) for j in range(joints)}
    return log


def write_csv(path, log, separator=",", header=True):
    pl.DataFrame(log).write_csv(path, separator=separator, include_header=header)
    return path


def stack(log, group):
    return np.stack([log[f"{group}{j}"] for j in (1, 2)], axis=1)


def check(recording, log):
    np.testing.assert_array_equal(recording.angles, stack(log, "q"))
    np.testing.assert_array_equal(recording.velocities, stack(log, "dq"))
    np.testing.assert_array_equal(recording.forces, stack(log, "tau"))
    assert recording.sample_time == 0.004
    assert recording.segments == ((0, len(log["t"])),)
    assert recording.notes == ()


@pytest.mark.parametrize("separator", [",", ";", "\t", " "])
@pytest.mark.parametrize("header", [True, False])
def test_text_files_of_any_separator(tmp_path, separator, header):
    path = write_csv(tmp_path / "log.csv", a_log(), separator, header)
    places = Columns(angles=(1, 2), velocities=(3, 4), forces=(5, 6), time=0)
    check(read_recording(path, COLUMNS if header else places), a_log())


def test_decimal_commas_numbers_from_zero_and_headers_of_savetxt(tmp_path):
    log = a_log()
    cells = [
        "; ".join(f"{v:.17g}" for v in row) for row in zip(*log.values(), strict=True)
    ]
    path = tmp_path / "log.csv"
    path.write_text("\n".join(["; ".join(log), *cells]).replace(".", ","))
    check(read_recording(path, COLUMNS), log)
    groups = {
        f"{g}_{j:02d}": log[f"{g}{j + 1}"] for g in ("q", "tau") for j in range(2)
    }
    write_csv(path, {"t": log["t"]} | groups)
    r = read_recording(path, Columns(angles="q_{}", forces="tau_{}", time="t"))
    np.testing.assert_array_equal(r.angles, stack(log, "q"))
    np.savetxt(
        tmp_path / "log.txt", np.stack(list(log.values()), 1), header=" ".join(log)
    )
    recording = read_recording(tmp_path / "log.txt", COLUMNS)
    np.testing.assert_allclose(recording.forces, stack(log, "tau"), rtol=1e-15)


@settings(max_examples=6)
@given(data=st.data(), joints=st.integers(1, 4), samples=st.integers(10, 20))
def test_round_trip_of_all_formats(tmp_path_factory, data, joints, samples):
    folder = tmp_path_factory.mktemp("logs")
    q, tau = (
        data.draw(arrays(np.float64, (samples, joints), elements=FINITE)) for _ in "ab"
    )
    table = {f"q{j + 1}": q[:, j] for j in range(joints)}
    table |= {f"tau{j + 1}": tau[:, j] for j in range(joints)}
    pl.DataFrame(table).write_csv(folder / "a.csv")
    pl.DataFrame(table).write_parquet(folder / "a.parquet")
    np.savez(folder / "a.npz", **table)
    savemat(folder / "a.mat", {"log": table})
    whole = {"q": q, "tau": tau}
    np.savez(folder / "b.npz", **whole)
    savemat(folder / "b.mat", whole)
    for file in ("a.csv", "a.parquet", "a.npz", "a.mat", "b.npz", "b.mat"):
        pattern = "" if file[0] == "b" else "{}"
        prefix = "log." if file == "a.mat" else ""
        names = f"{prefix}q{pattern}", f"{prefix}tau{pattern}"
        recording = read_recording(folder / file, Columns(*names, sample_time=0.01))
        np.testing.assert_array_equal(recording.angles, q)
        np.testing.assert_array_equal(recording.forces, tau)


def test_units_signs_offsets_and_constants(tmp_path):
    log = a_log()
    path = write_csv(tmp_path / "log.csv", log | {"t": 4000 * np.arange(12)})
    columns = Columns(
        angles="q{}",
        forces="tau{}",
        velocities="dq{}",
        time="t",
        time_unit=units.US,
        angle_unit=(units.MM, units.DEG),
        velocity_unit=(units.MM_PER_S, units.RPM),
        force_unit=units.A,
        torque_constants=(2.0, 0.5),
        angle_signs=(1, -1),
        force_signs=(-1, 1),
        angle_offsets=(0.1, np.pi),
    )
    r = read_recording(path, columns)
    q, dq, tau = (stack(log, g) for g in ("q", "dq", "tau"))
    np.testing.assert_allclose(r.angles[:, 0], 1e-3 * q[:, 0] + 0.1, rtol=1e-14)
    np.testing.assert_allclose(r.angles[:, 1], np.pi - np.deg2rad(q[:, 1]), rtol=1e-14)
    np.testing.assert_allclose(r.velocities[:, 0], 1e-3 * dq[:, 0], rtol=1e-14)
    np.testing.assert_allclose(
        r.velocities[:, 1], -dq[:, 1] * 2 * np.pi / 60, rtol=1e-14
    )
    np.testing.assert_allclose(r.forces, tau * [-2.0, 0.5], rtol=1e-14)
    assert r.sample_time == 0.004


def test_nanoseconds_since_1970_keep_their_precision(tmp_path):
    ticks = 1_700_000_000_123_456_789 + 1_000_000 * np.arange(50)
    frame = pl.DataFrame({"t": ticks, "q1": np.arange(50.0), "tau1": np.arange(50.0)})
    frame.write_csv(tmp_path / "log.csv")
    frame.write_parquet(tmp_path / "log.parquet")
    dates = frame.with_columns(pl.col("t").cast(pl.Datetime("ns")))
    dates.write_parquet(tmp_path / "dates.parquet")
    nanoseconds = Columns(angles="q1", forces="tau1", time="t", time_unit=units.NS)
    for file in ("log.csv", "log.parquet", "dates.parquet"):
        r = read_recording(tmp_path / file, PLAIN if "dates" in file else nanoseconds)
        assert r.sample_time == 1e-3
        assert not [note for note in r.notes if "jitter" in note]


def test_several_files(tmp_path):
    log = a_log()
    motion = {f"Joint_{j}": log[f"q{j}"] for j in (1, 2)}
    motion |= {f"v{j}": log[f"dq{j}"] for j in (1, 2)}
    write_csv(tmp_path / "q.csv", motion)
    write_csv(tmp_path / "tau.csv", {f"Joint_{j}": log[f"tau{j}"] for j in (1, 2)})
    columns = Columns(
        angles="Joint_{}", forces="Joint_{}", velocities="v{}", sample_time=0.004
    )
    forces = tmp_path / "tau.csv"
    r = read_recording(tmp_path / "q.csv", columns, "run", forces_path=forces)
    check(r, log)
    assert r.name == "run"


def refused(path, columns, *parts, **kwargs):
    with pytest.raises(ValueError) as caught:
        read_recording(path, columns, **kwargs)
    message = str(caught.value)
    for part in parts:
        assert part in message, message
    assert message.endswith((".", "?")), message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("q", "complaint"),
    [
        (np.repeat([[0.0, 0.0], [np.inf, -np.inf]], [3, 17], axis=0), "row 4"),
        (
            np.full((20, 2), 0x7F800001, np.uint32).view(np.float32),
            "all values",
        ),  # signalling NaN
        (np.zeros((20, 0)), "(20, 0)"),
        (np.array(["a"] * 20), "real numbers"),
        (np.full((20, 2), None), "without objects"),
    ],
)
def test_arrays_that_no_sensor_measures(tmp_path, q, complaint):
    np.savez(tmp_path / "log.npz", q=q, tau=np.zeros((20, 2)))
    columns = Columns(angles="q", forces="tau", sample_time=0.1)
    name = "`log.npz`" if "objects" in complaint else "`q`"
    refused(tmp_path / "log.npz", columns, name, "`log.npz`", complaint)


def test_missing_columns_name_the_others_and_the_closest(tmp_path):
    path = write_csv(tmp_path / "log.csv", a_log())
    wrong = Columns(angles="q{}", forces="tua{}", time="t")
    refused(path, wrong, "`log.csv`", "`tua1`", "`forces`", "`tau1`", "`dq2`")
    refused(path, Columns(angles="q{}", forces="tau{}", time="time"), "`time`", "`t`")
    refused(path, Columns(angles="q{}", forces="tau{}"), "`time`", "`sample_time`")
    refused(
        path,
        Columns(angles=(1, 9), forces="tau{}", time="t"),
        "column 9",
        "from 0 to 6",
    )
    refused(path, Columns("q{}", "q{}", time="t"), "`q1`", "`angles`", "`forces`")
    log = a_log(3)
    del log["q2"]
    path = write_csv(tmp_path / "hole.csv", log)
    refused(path, COLUMNS, "`q1`, `q3`", "from 1 to 2")
    refused(
        path,
        Columns(angles=("q1", "q3"), forces="tau{}", time="t"),
        "3 columns",
        "have 2",
    )
    path = write_csv(tmp_path / "double.csv", a_log() | {"q01": np.zeros(12)})
    refused(path, COLUMNS, "`q01`, `q1`", "`angles`")
    path = write_csv(tmp_path / "bare.csv", a_log(), header=False)
    refused(path, COLUMNS, "no header", "from 0 to 6")
    path.write_text("t,q1674407370955165,q2,tau1,tau2\n" + "0,1,2,3,4\n" * 30)
    refused(path, PLAIN, "`q2`", "from 1 to 2")


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("log.xlsx", b"x", "`log.xlsx`"),
        ("log.csv", b"", "empty"),
        ("log.csv", b"q,tau\n", "no rows"),
        ("log.csv", b"q,q,tau\n1,2,3\n", "`q` twice"),
        ("log.csv", b"q,tau\n" + b"1,2\n" * 9 + b"1,2,3\n" + b"1,2\n" * 9, "2 columns"),
        ("log.csv", "q,tau\n1,2\n".encode("utf-16"), "UTF-16"),
        ("log.csv", "q,tau\n1,2\n".encode("utf-16-le"), "UTF-16"),
        ("log.csv", b'q,tau\n"[1.5, 2]",2\n"[1.6, 2]",2\n', "one number in each cell"),
        (
            "log.csv",
            b"q,tau\n" + b'"1,234",2.5\n"2,345",2.5\n1,2.5\n' * 90,
            "no commas between",
        ),
        ("log.csv", b"q,tau\n" + b"1,2\n" * 9 + b'1,"2\n' + b"1,2\n" * 9, "line 11"),
        ("log.parquet", b"not parquet", "damaged"),
        ("log.npz", b"not npz", "`log.npz`"),
        ("log.mat", b"not mat at all" * 30, "damaged"),
        (
            "log.mat",
            b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x00" * 512,
            "damaged",
        ),
    ],
)
def test_damaged_files(tmp_path, name, content, complaint):
    path = tmp_path / name
    path.write_bytes(content)
    refused(
        path, Columns(angles="q", forces="tau", sample_time=0.1), f"`{name}`", complaint
    )


def test_quotations_may_hold_separators(tmp_path):
    rows = [
        "t,q1,tau1,note",
        *(f'{0.01 * k:.2f},{k},1,"a ""still"", held"' for k in range(60)),
    ]
    (tmp_path / "log.csv").write_text("\r\n".join(rows))
    assert read_recording(tmp_path / "log.csv", PLAIN).samples == 60


SPOILT = (
    lambda cells: cells[:3],  # a line that was cut
    lambda cells: [*cells, "7"],
    lambda cells: [],
    lambda cells: [cells[0], "oops", *cells[2:]],
    lambda cells: [cells[0], "", *cells[2:]],
    lambda cells: [*cells[:3], "nan", *cells[4:]],
    lambda cells: [*cells[:3], "-inf", *cells[4:]],
    lambda cells: [*cells[:3], "1e99", *cells[4:]],
    lambda cells: [cells[0], f'"{cells[1]}', *cells[2:]],
    lambda cells: ["0.5", *cells[1:]],  # a clock that was set back for one sample
    lambda cells: ["99", *cells[1:]],
)


@pytest.mark.parametrize("timed", [True, False])
def test_bad_rows_are_left_out_and_counted(tmp_path, timed):
    t = 0.001 * np.arange(11_000)
    rows = [
        [f"{x:.9g}" for x in row]
        for row in np.stack([t, np.sin(t), 1 + t, np.cos(t)], 1)
    ]
    for k, spoil in enumerate(SPOILT):
        rows[1000 * k + 500] = spoil(rows[1000 * k + 500])
    lines = ["t,q1,other,tau1", *(",".join(row) for row in rows)]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    columns = (
        PLAIN if timed else Columns(angles="q{}", forces="tau{}", sample_time=0.001)
    )
    recording = read_recording(tmp_path / "log.csv", columns, bridged=0.01)
    assert recording.segments == ((0, 11_000),)
    np.testing.assert_allclose(
        recording.angles[:, 0], np.sin(recording.time), atol=1e-8
    )
    np.testing.assert_allclose(
        recording.forces[:, 0], np.cos(recording.time), atol=1e-8
    )
    count = len(SPOILT) - (0 if timed else 2)
    assert (
        f"{count} of 11000 rows are bad and were left out: line 502 ("
        in recording.notes[0]
    )
    for k in range(6):
        assert f"line {1000 * k + 502} (" in recording.notes[0]
    assert recording.notes[0].endswith(f"and {count - 6} more")
    with pytest.raises(
        ValueError, match=f"{count} of 11000 rows are bad: line 502"
    ) as error:
        read_recording(tmp_path / "log.csv", columns, bad_rows=0.0)
    assert "\n" not in str(error.value)


def test_equal_complaints_are_one(tmp_path):
    cells = ["nan" if 20 <= k < 35 else f"{np.cos(0.01 * k)}" for k in range(600)]
    rows = [f"{0.01 * k},{k},1,{cells[k]}" for k in range(600)]
    (tmp_path / "log.csv").write_text("\n".join(["t,q1,other,tau1", *rows]))
    with pytest.raises(ValueError, match="15 of 600 rows are bad") as error:
        read_recording(tmp_path / "log.csv", PLAIN)
    text = "line 22, 23, 24, 25, 26 and 10 more (`tau1` is not finite"
    assert text in str(error.value)
    assert str(error.value).count("not finite") == 1


SPOILT_PARTS = {
    "forces that are not there yet": (slice(0, 40), lambda row: [*row[:2], "nan"]),
    "a title in the middle": (slice(2, 3), lambda row: ["driver is up", "", ""]),
    "empty cells": (slice(3, 20), lambda row: [row[0], "", ""]),
    "lines that are cut": (slice(5, 9), lambda row: row[:2]),
    "a stamp out of order": (slice(20, 21), lambda row: ["99", *row[1:]]),
    "no stamp": (slice(20, 24), lambda row: ["", *row[1:]]),
    "forces after the end": (slice(950, 1000), lambda row: [*row[:2], "1e99"]),
    "texts after the end": (slice(990, 1000), lambda row: ["stop", "stop", "stop"]),
}


@pytest.mark.parametrize("part", SPOILT_PARTS)
@pytest.mark.parametrize("columns", [PLAIN, UNTIMED])
def test_bad_rows_outside_start_and_stop_do_not_count(tmp_path, part, columns):
    t = 0.002 * np.arange(1000)
    cells = [
        [f"{x:.9g}" for x in row] for row in np.stack([t, np.sin(t), np.cos(t)], 1)
    ]
    rows, spoil = SPOILT_PARTS[part]
    cells[rows] = [spoil(row) for row in cells[rows]]
    text = "\n".join([",".join(row) for row in [["t", "q1", "tau1"], *cells]])
    (tmp_path / "log.csv").write_text(text)
    inside = {"start": 0.08, "stop": 1.9}
    recording = read_recording(tmp_path / "log.csv", columns, **inside)
    assert recording.samples == 910
    assert recording.segments == ((0, 910),)
    assert recording.notes == ()
    assert recording.time[0] == pytest.approx(0.08, abs=1e-12)
    np.testing.assert_allclose(
        recording.angles[:, 0], np.sin(recording.time), atol=1e-8
    )
    np.testing.assert_allclose(
        recording.forces[:, 0], np.cos(recording.time), atol=1e-8
    )
    if columns is PLAIN:
        with pytest.raises(ValueError, match=r"rows? .* bad"):
            read_recording(tmp_path / "log.csv", columns, bad_rows=0.0)


@pytest.mark.parametrize("row", [40, 500, 949])
def test_bad_rows_between_start_and_stop_count(tmp_path, row):
    t = 0.002 * np.arange(1000)
    table = {
        "t": t,
        "q1": np.sin(t),
        "tau1": np.where(np.arange(1000) == row, np.nan, 1),
    }
    path = write_csv(tmp_path / "log.csv", table)
    with pytest.raises(ValueError, match=f"1 of 1000 rows are bad: line {row + 2} "):
        read_recording(path, PLAIN, start=0.08, stop=1.9, bad_rows=0.0)


def test_lengths_and_shapes_must_agree(tmp_path):
    log = a_log()
    path = write_csv(tmp_path / "q.csv", log)
    forces = write_csv(tmp_path / "tau.csv", {k: v[:-1] for k, v in log.items()})
    refused(path, COLUMNS, "11 rows", "has 12", forces_path=forces)
    refused(
        path, Columns("q{}", "tau{}", time="t", angle_offsets=(1.0,)), "`angle_offsets`"
    )
    short = write_csv(tmp_path / "short.csv", {k: v[:8] for k, v in log.items()})
    refused(short, COLUMNS, "8 samples", "at least 10")
    np.savez(
        tmp_path / "lying.npz",
        t=np.arange(50.0),
        q=np.zeros((2, 50)),
        tau=np.zeros((2, 50)),
    )
    lying = Columns(angles="q", forces="tau", time="t")
    refused(tmp_path / "lying.npz", lying, "50 samples")
    refused(tmp_path / "none.csv", COLUMNS, "is not a file")


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"sample_time": 0.1}, "`sample_time`"),
        ({"time": None, "sample_time": -1.0}, "`sample_time`"),
        ({"angle_unit": units.NM}, "`angle_unit`"),
        ({"time_unit": units.DEG}, "`time_unit`"),
        ({"force_unit": units.A}, "`torque_constants`"),
        ({"torque_constants": (1.0,)}, "`torque_constants`"),
        ({"angle_signs": (2,)}, "`angle_signs`"),
        ({"angle_unit": 0.0}, "`angle_unit`"),
        ({"angle_unit": units.PERCENT}, "`angle_unit`"),
        ({"force_unit": (1.0, np.inf)}, "`force_unit`"),
        ({"force_unit": units.PERCENT}, "`rated_forces`"),
        ({"rated_forces": (1.0,)}, "`rated_forces`"),
        ({"angle_unit": units.PERCENT}, "`rated_angles` [rad or m]"),
        ({"velocity_unit": units.PERMILLE}, "`rated_velocities` [rad/s or m/s]"),
        ({"rated_angles": (0.0,), "angle_unit": units.PERCENT}, "positive"),
    ],
)
def test_columns_that_contradict_themselves(change, name):
    with pytest.raises(ValueError, match=re.escape(name)):
        Columns(**({"angles": "q{}", "forces": "tau{}", "time": "t"} | change))


SCALES = {
    "counts of an encoder": (
        {"angle_unit": 2 * np.pi / 4096, "angle_offsets": (-np.pi, -np.pi)},
        (2 * np.pi / 4096, 2 * np.pi / 4096),
        (-np.pi, -np.pi),
        (1.0, 1.0),
    ),
    "calibrated ranges": (
        {"angle_unit": (0.011, -0.012), "angle_offsets": (0.2, 0.1)},
        (0.011, -0.012),
        (0.2, 0.1),
        (1.0, 1.0),
    ),
    "percent of ranges": (
        {
            "angle_unit": units.PERCENT,
            "rated_angles": (1.2, 2.0),
            "angle_offsets": (0.1, -1.0),
        },
        (0.012, 0.02),
        (0.1, -1.0),
        (1.0, 1.0),
    ),
    "per mille": (
        {"force_unit": units.PERMILLE, "rated_forces": (80.0, 20.0)},
        (1.0, 1.0),
        (0.0, 0.0),
        (0.08, 0.02),
    ),
    "percent of currents": (
        {
            "force_unit": units.PERCENT,
            "rated_forces": (3.0, 2.0),
            "torque_constants": (0.1, -0.2),
        },
        (1.0, 1.0),
        (0.0, 0.0),
        (0.003, -0.004),
    ),
    "steps of currents": (
        {"force_unit": 0.00269, "torque_constants": (1.7, 1.5)},
        (1.0, 1.0),
        (0.0, 0.0),
        (0.00269 * 1.7, 0.00269 * 1.5),
    ),
    "a number beside a unit": (
        {"angle_unit": (units.DEG, 0.5), "force_unit": (units.NM, 0.25)},
        (np.pi / 180, 0.5),
        (0.0, 0.0),
        (1.0, 0.25),
    ),
}


@pytest.mark.parametrize("name", SCALES)
def test_units_that_only_one_drive_has(name):
    change, angle_scale, offsets, force_scale = SCALES[name]
    columns = Columns(angles="q{}", forces="tau{}", time="t", **change)
    values = np.array([[3.0, -50.0], [100.0, 7.0]])
    channels = dict.fromkeys(("angles", "velocities", "forces"), values)
    angles, velocities, forces = columns.to_si(channels).values()
    np.testing.assert_allclose(angles, values * angle_scale + offsets, rtol=1e-14)
    np.testing.assert_allclose(velocities, values * angle_scale, rtol=1e-14)
    np.testing.assert_allclose(forces, values * force_scale, rtol=1e-14)


def test_velocities_in_percent_and_angles_in_counts():
    scales = {"angle_unit": 0.5, "velocity_unit": units.PERCENT}
    rates = {"rated_velocities": (3.0, 2.0), "angle_signs": (1, -1)}
    columns = Columns("q{}", "tau{}", time="t", **scales, **rates)
    values = np.array([[50.0, 100.0]])
    channels = dict.fromkeys(("angles", "velocities"), values)
    angles, velocities = columns.to_si(channels).values()
    np.testing.assert_allclose(angles, [[25.0, -50.0]])
    np.testing.assert_allclose(velocities, [[1.5, -2.0]])


def test_units_by_symbol():
    assert all(units.unit(known.symbol) is known for known in units.UNITS.values())
    with pytest.raises(ValueError, match=r"`degrees`.* deg,"):
        units.unit("degrees")
    with pytest.raises(ValueError, match="`factor`"):
        Unit("nothing", 0.0, Quantity.FORCE)
