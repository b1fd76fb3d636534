"""Logs on disk give what the same logs in memory give."""

import numpy as np
import polars as pl
import pytest
from virtual import motion, standard_parameters

import jaxid as jid
from jaxid.identification import long_logs
from jaxid.measurement.log_files import text_files
from jaxid.measurement.reading import scan_log
from jaxid.measurement.time_grid import NeedsMemory
from jaxid.program.sample_methods import in_numpy

COLUMNS = jid.Columns(angles="q{}", forces="tau{}", time="t")
SAMPLES = 20000
DT = 1e-3
SMOOTH = jid.ZeroPhaseButterworth(30.0, margin=0.3)
FILTERS = [SMOOTH, jid.ZeroPhaseButterworth(30.0, order=2)]
EVERY = jid.Subsample(15)


@pytest.fixture(scope="module")
def numbers(base):
    m, p = motion(2, SAMPLES), standard_parameters(base.model)
    forces = in_numpy(base.model, base.model.forces, m.q, m.qd, m.qdd, shared=(p,))
    random = np.random.default_rng(0)
    angles = m.q + 1e-4 * random.normal(size=m.q.shape)
    return DT * np.arange(SAMPLES), angles, forces + 0.1 * random.normal(size=m.q.shape)


def frame(time, angles, forces):
    columns = {
        "t": time,
        "q1": angles[:, 0],
        "q2": angles[:, 1],
        "more": np.zeros(len(time)),
    }
    return pl.DataFrame(columns | {"tau1": forces[:, 0], "tau2": forces[:, 1]})


@pytest.fixture(scope="module")
def parquet(numbers, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "log.parquet"
    frame(*numbers).write_parquet(path, row_group_size=3000)
    return path


@pytest.fixture
def text(parquet, tmp_path):
    pl.read_parquet(parquet).write_csv(tmp_path / "log.csv")
    return tmp_path / "log.csv"


@pytest.fixture
def short_parts(monkeypatch):
    monkeypatch.setattr(text_files, "BLOCK_SIZE", 5000)
    monkeypatch.setattr("jaxid.measurement.reading.PART_SIZE", 3000)


def in_memory(base, path, decimation, filter=SMOOTH):
    return jid.observe(
        jid.read_recording(path, COLUMNS), base.model.robot, filter, decimation
    )


def agree(base, log, o):
    a, b = (jid.RegressionProblem(base, [x]).blocks for x in (log, o))
    np.testing.assert_array_equal(a.total.rows, b.total.rows)
    for x, y in zip(a.parts, b.parts, strict=True):
        A, B = (np.column_stack(f.weighted(np.ones(2))) for f in (x, y))
        norms = np.maximum(np.linalg.norm(B, axis=0), 1e-6)
        # Parts of a log are filtered by themselves: second differences amplify
        # rounding.
        assert np.abs((A.T @ A - B.T @ B) / norms / norms[:, None]).max() < 1e-9


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("long", [1000, 100_000])
def test_parquet_compiled_and_in_numpy(base, parquet, monkeypatch, long, filter):
    monkeypatch.setattr(jid.RegressionProblem, "samples_per_chunk", 3000)
    monkeypatch.setattr(jid.RegressionProblem, "compiled_samples", long)
    monkeypatch.setattr(long_logs, "PIECE", 4096)
    log = scan_log(parquet, COLUMNS, base.model.robot, filter, EVERY)
    agree(base, log, in_memory(base, parquet, EVERY, filter))


def test_arrays_and_other_files(base, numbers, parquet, tmp_path):
    time, angles, forces = numbers
    robot = base.model.robot
    np.savez(tmp_path / "log.npz", t=time, q=np.asfortranarray(angles), tau=forces)
    columns = jid.Columns(angles="q", forces="tau", sample_time=DT)
    motion_and_forces = scan_log(tmp_path / "log.npz", columns, robot, SMOOTH).read(
        slice(1000, 2000)
    )
    expected = scan_log(parquet, COLUMNS, robot, SMOOTH).read(slice(1000, 2000))
    np.testing.assert_array_equal(motion_and_forces[0].qd, expected[0].qd)
    np.testing.assert_array_equal(motion_and_forces[1], forces[1000:2000])
    columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=DT)
    frame(*numbers).drop("tau1", "tau2").write_csv(tmp_path / "q.csv")
    log = scan_log(tmp_path / "q.csv", columns, robot, SMOOTH, forces_path=parquet)
    np.testing.assert_array_equal(log.read(slice(100, 200))[1], forces[100:200])
    frame(*(x[1:] for x in numbers)).write_csv(tmp_path / "less.csv")
    with pytest.raises(ValueError, match=r"`less.csv` has 19999 rows"):
        scan_log(
            tmp_path / "q.csv",
            columns,
            robot,
            SMOOTH,
            forces_path=tmp_path / "less.csv",
        )


@pytest.mark.parametrize("filter", FILTERS)
def test_a_part_is_filtered_like_the_whole(base, parquet, filter):
    log = scan_log(parquet, COLUMNS, base.model.robot, filter)
    whole = in_memory(base, parquet, jid.Subsample(), filter).motion
    for a, b in ((0, 500), (7000, 9000), (SAMPLES - 300, SAMPLES)):
        part, _ = log.read(slice(a, b))
        np.testing.assert_allclose(part.q, whole.q[a:b], atol=1e-13)
        np.testing.assert_allclose(part.qd, whole.qd[a:b], atol=1e-10)
        np.testing.assert_allclose(part.qdd, whole.qdd[a:b], atol=1e-7)
    np.testing.assert_allclose(log.motion.qd, whole.qd, atol=1e-10)


@pytest.mark.usefixtures("short_parts")
@pytest.mark.parametrize(
    ("separator", "header", "end", "point"),
    [(";", True, "\r\n", ","), (" , ", False, "\n", "."), ("\t", True, "\n", ".")],
)
def test_text_of_any_kind(base, numbers, tmp_path, separator, header, end, point):
    rows = np.column_stack([x[:3000] for x in numbers])
    lines = [
        separator.join(f"{x:.9f}".replace(".", point) for x in row) for row in rows
    ]
    lines = [separator.join(["t", "q1", "q2", "tau1", "tau2"])] * header + lines
    path = tmp_path / "log.txt"
    path.write_bytes(end.join(lines).encode() + b"\n\n" * header)
    columns = COLUMNS if header else jid.Columns(angles=(1, 2), forces=(3, 4), time=0)
    log = scan_log(path, columns, base.model.robot, SMOOTH)
    assert log.samples == 3000
    whole = jid.read_recording(path, columns)
    rows = log.source.read_rows(slice(0, 3000))
    angles, forces = rows["angles"], rows["forces"]
    np.testing.assert_array_equal(angles, whole.angles)
    np.testing.assert_array_equal(forces, whole.forces)


@pytest.mark.usefixtures("short_parts")
@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("15,x,0,0,0,0", "is `x`, not a number"),
        ("15,0,,0,0,0", "is empty"),
        ("15,0,nan,0,0,0", "is not finite"),
        ('15,0,",0,0,0', "an open quotation"),
        (
            "1,2,3,4,5,6,7",
            "line 15001 of `log.csv` is not a row .7 cells, but 6 columns",
        ),
    ],
)
def test_bad_rows_of_long_texts_are_named(base, text, row, complaint):
    lines = text.read_text().splitlines()
    lines[15000] = row
    text.write_text("\n".join(lines))
    with pytest.raises(ValueError, match=complaint) as caught:
        scan_log(text, COLUMNS, base.model.robot, SMOOTH)
    assert "`log.csv`" in str(caught.value)
    assert "columns" in complaint or "line 15001" in str(caught.value)


@pytest.mark.usefixtures("short_parts")
def test_gaps_slow_rows_and_limits_as_in_memory(base, numbers, tmp_path):
    time, angles, forces = numbers
    time = (
        time
        + 7.0
        + 0.5 * (np.arange(SAMPLES) >= 9000)
        + 0.3 * (np.arange(SAMPLES) >= 9003)
    )
    path = tmp_path / "log.npz"
    np.savez(path, t=time, q=angles, tau=forces)
    columns = jid.Columns(angles="q", forces="tau", time="t")
    settings = (base.model.robot, SMOOTH, EVERY, (0.3, 0.2))
    log = scan_log(path, columns, *settings, start=1.0, stop=18.0)
    o = jid.observe(jid.read_recording(path, columns).crop(1.0, 18.0), *settings)
    assert log.notes == o.notes
    assert len(o.segments) == 2
    np.testing.assert_array_equal(log.mask, o.mask)
    np.testing.assert_allclose(log.reduced_time, o.reduced_time, atol=1e-9)
    agree(base, log, o)
    for a, b in zip(log.split(0.6), o.split(0.6), strict=True):
        agree(base, a, b)
    with pytest.raises(ValueError, match="from 90 s to inf s"):
        scan_log(path, columns, *settings, start=90.0)


def test_refusals(base, numbers, parquet, tmp_path):
    robot, (time, angles, forces) = base.model.robot, numbers
    with pytest.raises(ValueError, match="is not a file"):
        scan_log(tmp_path / "none.parquet", COLUMNS, robot, SMOOTH)
    with pytest.raises(NeedsMemory, match="PeriodicFourier"):
        scan_log(parquet, COLUMNS, robot, jid.filters.PeriodicFourier(2.0, 3))
    with pytest.raises(ValueError, match="has 2 joints"):
        scan_log(parquet, COLUMNS, jid.robots.planar_arm(3, 0.4), SMOOTH)
    late = np.where(np.arange(SAMPLES) == 9000, time + 4e-4, time)
    repeated = np.where(np.arange(SAMPLES) == 9000, time[8999], time)
    back = np.r_[0.0, 1, 2, 3, np.full(SAMPLES - 4, 2.0)]
    path = tmp_path / "stamps.parquet"
    for stamps, error, complaint in (
        (late, NeedsMemory, "uniform grid"),
        (repeated, NeedsMemory, "row 9001"),
        (back, ValueError, "backwards .* at row 5"),
    ):
        frame(stamps, angles, forces).write_parquet(path)
        with pytest.raises(error, match=complaint):
            scan_log(path, COLUMNS, robot, SMOOTH)
