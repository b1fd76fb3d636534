"""Logs on the disk give what the same logs in memory give."""

import math

import numpy as np
import polars as pl
import pytest
from virtual import motion, standard_parameters

import jaxid as jid
from jaxid.dynamics.machine import in_numpy
from jaxid.identification import streaming
from jaxid.identification.factors import factorise
from jaxid.identification.streaming_log import forgetting, open_log

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
    a, b = (factorise(base, [x]) for x in (log, o))
    np.testing.assert_array_equal(a.total.rows, b.total.rows)
    for x, y in zip(a.parts, b.parts, strict=True):
        A, B = (np.column_stack(f.weighted(np.ones(2))) for f in (x, y))
        norms = np.linalg.norm(B, axis=0)
        # Parts of a log are filtered by themselves: differences of the second order see rounding.
        assert np.abs((A.T @ A - B.T @ B) / norms / norms[:, None]).max() < 1e-9


@pytest.mark.parametrize("decimation", [jid.Subsample(1), jid.Subsample(15)])
def test_parquet_in_numpy(base, parquet, decimation, monkeypatch):
    monkeypatch.setattr("jaxid.identification.factors.CHUNK", 3000)
    log = open_log(parquet, COLUMNS, base.model.robot, SMOOTH, decimation)
    agree(base, log, in_memory(base, parquet, decimation))


def test_parquet_compiled(base, parquet, monkeypatch):
    monkeypatch.setattr(streaming, "LONG", 1000)
    monkeypatch.setattr("jaxid.identification.kernel.PIECE", 4096)
    log = open_log(parquet, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
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
    log = open_log(path, columns, base.model.robot, SMOOTH, jid.Subsample(15))
    mapped = log.read(slice(1000, 2000))
    other = open_log(parquet, COLUMNS, base.model.robot, SMOOTH, jid.Subsample(15))
    expected = other.read(slice(1000, 2000))
    np.testing.assert_array_equal(mapped[0].qd, expected[0].qd)
    np.testing.assert_array_equal(mapped[1], forces[1000:2000])


def test_a_part_is_filtered_like_the_whole(base, parquet):
    log = open_log(parquet, COLUMNS, base.model.robot, SMOOTH)
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
        open_log(tmp_path / "small.npz", COLUMNS, robot, SMOOTH)
    with pytest.raises(ValueError, match="is no file"):
        open_log(tmp_path / "none.parquet", COLUMNS, robot, SMOOTH)
    (tmp_path / "log.csv").write_text("t,q1\n0,1\n")
    with pytest.raises(ValueError, match="sink_parquet"):
        open_log(tmp_path / "log.csv", COLUMNS, robot, SMOOTH)
    three = jid.robots.planar_arm(3, 0.4)
    with pytest.raises(ValueError, match="have 2 columns, but"):
        open_log(parquet, COLUMNS, three, SMOOTH)
    gap = np.where(np.arange(SAMPLES) < 9000, time, time + 0.5)
    path = tmp_path / "gap.parquet"
    pl.read_parquet(parquet).with_columns(pl.Series("t", gap)).write_parquet(path)
    with pytest.raises(ValueError, match="after row 9000"):
        factorise(base, [open_log(path, COLUMNS, robot, SMOOTH)])


def test_how_long_filters_remember():
    slow, fast = (forgetting(jid.ZeroPhaseButterworth(f), DT, False) for f in (5.0, 50.0))
    assert slow > 5 * fast
    assert forgetting(jid.ZeroPhaseButterworth(math.inf), DT, True) < 10
    with pytest.raises(ValueError, match="PeriodicFourier"):
        forgetting(jid.PeriodicFourier(2.0, 3), DT, False)
