"""Logs on the disk give what the same logs in memory give."""

import math

import numpy as np
import polars as pl
import pytest
from virtual import motion, standard_parameters

import jaxid as jid
from jaxid.dynamics.machine import in_numpy
from jaxid.identification import streaming
from jaxid.measurement import chunked_files, units
from jaxid.measurement.log_on_disk import filter_memory, scan_log
from jaxid.measurement.timestamps import NeedsMemory

COLUMNS = jid.Columns(angles="q{}", forces="tau{}", time="t")
SAMPLES = 20000
DT = 1e-3
SMOOTH = jid.ZeroPhaseButterworth(30.0, margin=0.3)


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


@pytest.fixture(scope="module")
def numbers(base):
    m, p = motion(2, SAMPLES), standard_parameters(base.model)
    forces = in_numpy(base.model, base.model.forces, m.q, m.qd, m.qdd, shared=(p,))
    random = np.random.default_rng(0)
    angles = m.q + 1e-4 * random.normal(size=m.q.shape)
    return DT * np.arange(SAMPLES), angles, forces + 0.1 * random.normal(size=m.q.shape)


@pytest.fixture(scope="module")
def parquet(numbers, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.parquet"
    time, angles, forces = numbers
    columns = {"t": time, "q1": angles[:, 0], "q2": angles[:, 1], "more": time}
    columns |= {"tau1": forces[:, 0], "tau2": forces[:, 1]}
    pl.DataFrame(columns).write_parquet(path, row_group_size=3000)
    return path


def in_memory(base, path, decimation, filter=SMOOTH):
    return jid.observe(jid.read_recording(path, COLUMNS), base.model.robot, filter, decimation)


def agree(base, log, o):
    a, b = (jid.RegressionProblem(base, [x]).blocks for x in (log, o))
    np.testing.assert_array_equal(a.total.rows, b.total.rows)
    for x, y in zip(a.parts, b.parts, strict=True):
        A, B = (np.column_stack(f.weighted(np.ones(2))) for f in (x, y))
        norms = np.maximum(np.linalg.norm(B, axis=0), 1e-6)
        # Parts of a log are filtered by themselves: differences of the second order see rounding.
        assert np.abs((A.T @ A - B.T @ B) / norms / norms[:, None]).max() < 1e-9


@pytest.mark.parametrize("decimation", [jid.Subsample(1), jid.Subsample(15)])
def test_parquet_in_numpy(base, parquet, decimation, monkeypatch):
    monkeypatch.setattr(jid.RegressionProblem, "samples_per_chunk", 3000)
    log = scan_log(parquet, COLUMNS, base.model.robot, SMOOTH, decimation)
    agree(base, log, in_memory(base, parquet, decimation))


def test_parquet_compiled(base, parquet, monkeypatch):
    monkeypatch.setattr(streaming, "LONG", 1000)
    monkeypatch.setattr("jaxid.identification.compiled.PIECE", 4096)
    log = scan_log(parquet, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
    assert log.name == "log"
    agree(base, log, in_memory(base, parquet, jid.Subsample(15)))
    shares = []
    fit = jid.identify(base, log, jid.LeastSquares(), progress=shares.append)
    assert fit.recordings == ("log",)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_mapped_arrays(base, numbers, parquet, tmp_path):
    time, angles, forces = numbers
    path = tmp_path / "log.npz"
    np.savez(path, t=time, q=np.asfortranarray(angles), tau=forces)
    columns = jid.Columns(angles="q", forces="tau", sample_time=DT)
    log = scan_log(path, columns, base.model.robot, SMOOTH, jid.Subsample(15))
    mapped = log.read(slice(1000, 2000))
    other = scan_log(parquet, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
    expected = other.read(slice(1000, 2000))
    np.testing.assert_array_equal(mapped[0].qd, expected[0].qd)
    np.testing.assert_array_equal(mapped[1], forces[1000:2000])


def test_a_part_is_filtered_like_the_whole(base, parquet):
    log = scan_log(parquet, COLUMNS, base.model.robot, SMOOTH)
    whole = in_memory(base, parquet, None).motion
    for a, b in ((0, 500), (7000, 9000), (SAMPLES - 300, SAMPLES)):
        part, _ = log.read(slice(a, b))
        np.testing.assert_allclose(part.q, whole.q[a:b], atol=1e-13)
        np.testing.assert_allclose(part.qd, whole.qd[a:b], atol=1e-10)
        np.testing.assert_allclose(part.qdd, whole.qdd[a:b], atol=1e-7)


def test_refusals(base, numbers, parquet, tmp_path):
    robot, (time, angles, forces) = base.model.robot, numbers
    np.savez_compressed(tmp_path / "small.npz", t=time, q=angles, tau=forces)
    with pytest.raises(ValueError, match="compressed"):
        scan_log(tmp_path / "small.npz", COLUMNS, robot, SMOOTH)
    with pytest.raises(ValueError, match="is no file"):
        scan_log(tmp_path / "none.parquet", COLUMNS, robot, SMOOTH)
    (tmp_path / "log.bag").write_text("t,q1\n0,1\n")
    with pytest.raises(ValueError, match=r"must end in .csv"):
        scan_log(tmp_path / "log.bag", COLUMNS, robot, SMOOTH)
    three = jid.robots.planar_arm(3, 0.4)
    with pytest.raises(ValueError, match="have 2 columns, but"):
        scan_log(parquet, COLUMNS, three, SMOOTH)
    for stamps, sentence in (
        (np.where(np.arange(SAMPLES) == 9000, time + 4e-4, time), "leave a uniform grid"),
        (np.where(np.arange(SAMPLES) == 9000, time[8999], time), "repeat .* first at row 9001"),
    ):
        path = tmp_path / "stamps.parquet"
        pl.read_parquet(parquet).with_columns(pl.Series("t", stamps)).write_parquet(path)
        with pytest.raises(NeedsMemory, match=sentence):
            scan_log(path, COLUMNS, robot, SMOOTH)
    back = pl.Series("t", np.r_[0.0, 1, 2, 3, np.full(SAMPLES - 4, 2.0)])
    pl.read_parquet(parquet).with_columns(back).write_parquet(tmp_path / "back.parquet")
    with pytest.raises(ValueError, match=r"backwards .* at row 5"):
        scan_log(tmp_path / "back.parquet", COLUMNS, robot, SMOOTH)


def test_how_long_filters_remember():
    slow, fast = (filter_memory(jid.ZeroPhaseButterworth(f), DT, False) for f in (5.0, 50.0))
    assert slow > 5 * fast
    assert filter_memory(jid.ZeroPhaseButterworth(math.inf), DT, True) < 10
    with pytest.raises(ValueError, match="PeriodicFourier"):
        filter_memory(jid.PeriodicFourier(2.0, 3), DT, False)


@pytest.fixture(scope="module")
def text(parquet):
    path = parquet.with_suffix(".csv")
    pl.read_parquet(parquet).write_csv(path)
    return path


@pytest.fixture
def short_strides(monkeypatch):
    monkeypatch.setattr(chunked_files, "BLOCK", 5000)
    monkeypatch.setattr("jaxid.measurement.log_on_disk.AT_ONCE", 3000)


@pytest.mark.usefixtures("short_strides")
def test_text_is_read_part_by_part(base, parquet, text):
    log = scan_log(text, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
    other = scan_log(parquet, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
    assert log.sample_time == other.sample_time == DT
    assert (log.samples, log.rows) == (other.samples, other.rows)
    for a, b in ((0, 1), (4321, 4321 + 999), (0, SAMPLES), (SAMPLES - 1, SAMPLES)):
        for x, y in zip(
            log.source.read_unfiltered(slice(a, b)),
            other.source.read_unfiltered(slice(a, b)),
            strict=True,
        ):
            np.testing.assert_array_equal(x, y)
    agree(base, log, in_memory(base, text, jid.Subsample(15)))


@pytest.mark.usefixtures("short_strides")
@pytest.mark.parametrize(
    ("separator", "header", "end", "comma"),
    [
        (",", True, "\n", False),
        (";", True, "\r\n", True),
        ("  ", False, "", False),
        (" , ", False, "\n\n\n", False),
        ("\t", True, "", False),
    ],
)
def test_text_of_any_kind(base, numbers, tmp_path, separator, header, end, comma):
    time, angles, forces = (x[:3000] for x in numbers)
    rows = np.column_stack([time, angles, forces])
    lines = [
        separator.join(f"{x:.9f}".replace(".", "," if comma else ".") for x in r) for r in rows
    ]
    lines = [separator.join(["t", "q1", "q2", "tau1", "tau2"])] * header + lines
    path = tmp_path / "log.txt"
    path.write_bytes(((end.strip("\n") or "") + "\n").join(lines).encode() + end.encode())
    columns = COLUMNS if header else jid.Columns(angles=(1, 2), forces=(3, 4), time=0)
    log = scan_log(path, columns, base.model.robot, SMOOTH)
    assert log.samples == 3000
    whole = jid.read_recording(path, columns)
    angles, _, forces = log.source.read_unfiltered(slice(0, 3000))
    np.testing.assert_array_equal(angles, whole.angles)
    np.testing.assert_array_equal(forces, whole.forces)


@pytest.mark.usefixtures("short_strides")
@pytest.mark.parametrize(
    ("cell", "complaint"), [("x", "is `x`, no number"), ("", "is empty"), ("nan", "is not finite")]
)
def test_bad_cells_of_long_texts_are_named_with_line_and_column(
    base, text, tmp_path, cell, complaint
):
    lines = text.read_text().splitlines()
    row = lines[15000].split(",")
    row[2] = cell
    lines[15000] = ",".join(row)
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=rf"column `q2` of `log.csv`, line 15001, {complaint}"):
        scan_log(path, COLUMNS, base.model.robot, SMOOTH)
    lines[15000] = "1,2,3,4,5,6,7"
    path.write_text("\n".join(lines))
    with pytest.raises(ValueError, match="is no table with 6 columns in every line"):
        scan_log(path, COLUMNS, base.model.robot, SMOOTH)


@pytest.mark.usefixtures("short_strides")
def test_gaps_slow_rows_and_limits_as_in_memory(base, numbers, tmp_path):
    time, angles, forces = numbers
    time = time + 7.0 + 0.5 * (np.arange(SAMPLES) >= 9000) + 0.3 * (np.arange(SAMPLES) >= 9003)
    np.savez(tmp_path / "log.npz", t=time, q=angles, tau=forces)
    columns = jid.Columns(angles="q", forces="tau", time="t")
    robot, every, slow = base.model.robot, jid.Subsample(15), (0.3, 0.2)
    log = scan_log(tmp_path / "log.npz", columns, robot, SMOOTH, every, slow, start=1.0, stop=18.0)
    recording = jid.read_recording(tmp_path / "log.npz", columns).crop(1.0, 18.0)
    o = jid.observe(recording, robot, SMOOTH, every, slow)
    assert log.notes == o.notes
    assert len(o.segments) == 2
    np.testing.assert_array_equal(log.mask, o.mask)
    np.testing.assert_allclose(log.reduced_time, o.reduced_time, atol=1e-9)
    agree(base, log, o)
    for a, b in zip(log.split(0.6), o.split(0.6), strict=True):
        agree(base, a, b)
    with pytest.raises(ValueError, match="from 90 s to inf s"):
        scan_log(tmp_path / "log.npz", columns, robot, SMOOTH, start=90.0)


def test_nanoseconds_since_1970(base, numbers, tmp_path):
    _, angles, forces = (x[:5000] for x in numbers)
    ticks = 1_700_000_000_000_000_001 + 1_000_000 * np.arange(5000)
    names = ("q1", "q2", "tau1", "tau2")
    frame = pl.DataFrame(
        {"t": ticks} | dict(zip(names, np.hstack([angles, forces]).T, strict=True))
    )
    frame.write_csv(tmp_path / "log.csv")
    columns = jid.Columns(angles="q{}", forces="tau{}", time="t", time_unit=units.NS)
    log = scan_log(tmp_path / "log.csv", columns, base.model.robot, SMOOTH)
    assert log.sample_time == DT
    assert log.segments == ((0, 5000),)


def test_forces_in_another_file(base, numbers, tmp_path):
    _, angles, forces = (x[:5000] for x in numbers)
    pl.DataFrame({"q1": angles[:, 0], "q2": angles[:, 1]}).write_csv(tmp_path / "q.csv")
    pl.DataFrame({"tau1": forces[:, 0], "tau2": forces[:, 1]}).write_parquet(tmp_path / "f.parquet")
    columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=DT)
    robot = base.model.robot
    log = scan_log(tmp_path / "q.csv", columns, robot, SMOOTH, forces_path=tmp_path / "f.parquet")
    np.testing.assert_array_equal(log.source.read_unfiltered(slice(100, 200))[2], forces[100:200])
    pl.DataFrame({"tau1": forces[1:, 0], "tau2": forces[1:, 1]}).write_csv(tmp_path / "less.csv")
    with pytest.raises(ValueError, match=r"4999 rows, but `q.csv` has 5000"):
        scan_log(tmp_path / "q.csv", columns, robot, SMOOTH, forces_path=tmp_path / "less.csv")
