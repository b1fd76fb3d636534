"""Observations: forces and columns stay aligned through filters, decimation, gaps and chunks."""

import dataclasses

import numpy as np
import pytest

from jaxid.measurement.columns import Columns
from jaxid.measurement.filters import (
    Decimation,
    PaperFilter,
    PeriodicFourier,
    Subsample,
    ZeroPhaseButterworth,
)
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.reading import read_recording
from jaxid.measurement.recording import Recording
from jaxid.robot.joints import Drives
from jaxid.robot.robot import Robot

DT = 0.001


def a_robot(joints=2, drives=None):
    return Robot(
        "arm",
        revolute=(True,) * joints,
        axis=np.tile([0.0, 0.0, 1.0], (joints, 1)),
        rotation=np.tile(np.eye(3), (joints, 1, 1)),
        offset=np.zeros((joints, 3)),
        drives=drives,
    )


def a_recording(samples=6000, gaps=(), period=2.0, **kwargs):
    t = DT * np.arange(samples)
    for gap in gaps:
        t[gap:] += 0.5
    w = 2 * np.pi / period
    q = np.stack([np.sin(w * t) + 0.3 * np.cos(3 * w * t), 0.5 * np.cos(2 * w * t)], axis=1)
    qd = np.stack([w * np.cos(w * t) - 0.9 * w * np.sin(3 * w * t), -w * np.sin(2 * w * t)], 1)
    rng = np.random.default_rng(5)
    forces = np.sign(qd) + 2 * q + 0.3 * rng.normal(size=q.shape)
    return Recording.of(q, forces, velocities=qd, time=t, **kwargs)


CASES = [
    (ZeroPhaseButterworth(20.0), None),
    (ZeroPhaseButterworth(20.0), Subsample(11)),
    (ZeroPhaseButterworth(100, force_cutoff=np.inf, margin=0.02), Decimation((10, 4))),
    (ZeroPhaseButterworth(15.0), Decimation((7,))),
    (PaperFilter(), Decimation((5, 3))),
    (PeriodicFourier(2.0, 4), Subsample(10)),
]
every = pytest.mark.parametrize(("filter", "decimation"), CASES)


def columns_of(o):
    """Three columns for each joint, one of them the force itself."""
    return np.stack([np.sign(o.motion.qd), o.motion.qdd, o.forces], axis=2)


@every
@pytest.mark.parametrize("gaps", [(), (2600, 2700, 4300)])
def test_columns_and_forces_stay_aligned(filter, decimation, gaps):
    r = a_recording(gaps=gaps)
    if len(gaps) == 3 and isinstance(filter, PeriodicFourier):
        gaps = ()
        r = a_recording()
    o = observe(r, a_robot(), filter, decimation)
    rows = o.reduce(columns_of(o))
    assert rows.shape == (o.rows, 2, 3)
    assert o.mask.all()
    np.testing.assert_array_equal(rows[:, :, 2], o.reduced_forces)
    combined = o.reduce(columns_of(o) @ np.array([0.5, -0.1, 2.0]))
    np.testing.assert_allclose(rows @ np.array([0.5, -0.1, 2.0]), combined, atol=1e-10)
    np.testing.assert_allclose(o.reduce(np.full(len(o.time), 1.5)), 1.5, rtol=1e-9)
    assert o.reduced_time.shape == (o.rows,)
    assert o.row_segments[-1][1] == o.rows
    assert len(o.row_segments) == len(o.segments)


@every
@pytest.mark.parametrize("size", [300, 100_000])
def test_chunks_reduce_to_the_same_rows(filter, decimation, size):
    o = observe(a_recording(gaps=(2500,)), a_robot(), filter, decimation)
    x = columns_of(o)
    whole = o.reduce(x)
    out = np.full_like(whole, np.nan)
    chunks = o.chunks(size)
    for chunk in chunks:
        out[slice(*chunk.rows)] = chunk.reduce(x[slice(*chunk.samples)])
    np.testing.assert_allclose(out, whole, atol=1e-11 * np.abs(x).max())
    if size == 300 and filter.memory(DT) < 100:
        assert max(c.samples[1] - c.samples[0] for c in chunks) < 3500
    if size == 100_000:
        assert len(chunks) == 2
    with pytest.raises(ValueError, match="`samples`"):
        o.chunks(0)


def test_rows_lie_where_they_say():
    """A slow signal comes out at the rows' own instants, in time."""
    r = a_recording(gaps=(2500,))
    for filter, decimation in CASES[:3]:
        o = observe(r, a_robot(), filter, decimation)
        slow = np.cos(2 * np.pi * 0.7 * o.time)
        inner = np.concatenate([np.arange(a + 5, b - 5) for a, b in o.row_segments])
        expected = np.cos(2 * np.pi * 0.7 * o.reduced_time)
        np.testing.assert_allclose(o.reduce(slow)[inner], expected[inner], atol=5e-3)
        np.testing.assert_array_equal(o.reduced_motion.q, o.motion.q[o.instants])
        for a, b in o.row_segments:
            np.testing.assert_allclose(np.diff(o.reduced_time[a:b]), o.row_time, rtol=1e-9)


def test_slow_rows_are_masked_for_their_joint_alone():
    speeds = np.array([0.5, 1.2])
    o = observe(a_recording(), a_robot(), CASES[1][0], CASES[1][1], min_speed=(0.5, 1.2))
    np.testing.assert_array_equal(o.mask, np.abs(o.reduced_motion.qd) >= speeds)
    assert not o.mask.all(axis=0).any()
    assert (o.mask[:, 0] != o.mask[:, 1]).any()
    with pytest.raises(ValueError, match="joint `joint2` never reaches the speed 99"):
        observe(a_recording(), a_robot(), CASES[1][0], min_speed=[0.0, 99.0])
    with pytest.raises(ValueError, match="`min_speed`"):
        observe(a_recording(), a_robot(), CASES[1][0], min_speed=[0.0])


@pytest.mark.parametrize("angles", [True, False])
@pytest.mark.parametrize("forces", [True, False])
def test_motor_side_goes_through_the_drives(angles, forces):
    A = np.array([[45.0, 0.0], [32.0, -32.0]])
    drives = Drives(2, reduction=A, zero=[0.3, -0.7])
    r = a_recording()
    motors = dataclasses.replace(
        r,
        angles=(r.angles - [0.3, -0.7]) @ A.T if angles else r.angles,
        velocities=r.velocities @ A.T if angles else r.velocities,
        forces=r.forces @ np.linalg.inv(A) if forces else r.forces,
        angles_on_motor_side=angles,
        forces_on_motor_side=forces,
    )
    filter = ZeroPhaseButterworth(20.0)
    o, expected = (observe(x, a_robot(2, drives), filter) for x in (motors, r))
    np.testing.assert_allclose(o.motion.q, expected.motion.q, atol=1e-12)
    np.testing.assert_allclose(o.motion.qdd, expected.motion.qdd, atol=1e-8)
    np.testing.assert_allclose(o.forces, expected.forces, atol=1e-12)


def test_refusals():
    r = a_recording()
    with pytest.raises(ValueError, match="has 2 joints, but the robot `arm` has 3"):
        observe(r, a_robot(3), ZeroPhaseButterworth(20.0))
    with pytest.raises(ValueError, match=r"one of 25 samples at most, a lower cut-off"):
        observe(r, a_robot(), ZeroPhaseButterworth(20.0), Subsample(26))
    observe(r, a_robot(), ZeroPhaseButterworth(20.0), Subsample(25))
    with pytest.raises(ValueError, match="Decimation"):
        observe(r, a_robot(), ZeroPhaseButterworth(20.0, force_cutoff=np.inf), Subsample(2))
    with pytest.raises(ValueError, match=r"longest segment of `recording` has 6000 samples"):
        observe(r, a_robot(), ZeroPhaseButterworth(0.05))
    hasty = dataclasses.replace(r, sample_time=1e-2 * r.sample_time)
    with pytest.raises(ValueError, match=r"longest seg.* at 100000 Hz.*`time_unit`"):
        observe(hasty, a_robot(), ZeroPhaseButterworth(5.0))


def test_short_segments_are_left_out_and_reported():
    o = observe(a_recording(gaps=(2500, 2550)), a_robot(), ZeroPhaseButterworth(20.0))
    assert o.segments == ((0, 2500), (2500, 5950))
    assert o.time[2500] == pytest.approx(3.55)
    assert "1 segment(s), shorter" in o.notes[-1]


def test_tx40_by_the_published_settings(shared_data):
    """100 Hz, 20 samples cut, 10 x 10: 450 rows at 50 Hz; it stands still from 7.5 s on."""
    columns = Columns(
        angles="Joint_{}",
        forces="Joint_{}",
        sample_time=2e-4,
        angles_on_motor_side=True,
        forces_on_motor_side=True,
    )
    folder = shared_data / "tx40"
    r = read_recording(
        folder / "motor_position.csv", columns, forces_path=folder / "motor_torque.csv"
    )
    A = np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    A[5, 4] = 32.0
    zero = np.array([0, -np.pi / 2, np.pi / 2, 0, 0, 0])
    robot = a_robot(6, Drives(6, reduction=A, zero=zero))
    filter = ZeroPhaseButterworth(100, force_cutoff=np.inf, margin=0.004)
    slow = (0.0501, 0.0501, 0.0750, 0.0716, 0.0559, 0.1222)
    o = observe(r, robot, filter, Decimation((10, 10)), slow)
    assert filter.edge(2e-4) == 20
    assert o.rows == 450
    assert o.row_time == pytest.approx(0.02)
    q0 = np.linalg.solve(A, r.angles[0]) + zero
    np.testing.assert_allclose(o.motion.q[0], q0, atol=1e-4)
    assert not o.mask[o.reduced_time > 7.6].any()
    assert (o.mask.mean(axis=0) > 0.5).all()


def test_measured_velocities_that_are_not_used_are_mentioned():
    r = a_recording()
    expected = ("the measured velocities are not used: `PaperFilter` takes them from the angles",)
    assert observe(r, a_robot(), PaperFilter()).notes == expected
    without = dataclasses.replace(r, velocities=None)
    assert observe(without, a_robot(), PaperFilter()).notes == ()


def test_arrays_that_are_filtered_already_become_observations():
    o = observe(a_recording(), a_robot(), ZeroPhaseButterworth(20.0, margin=0.0), Subsample(5))
    m = o.motion
    same = Observations.of(
        *(m.q, m.qd, m.qdd, o.forces),
        sample_time=DT,
        filter=o.filter,
        decimation=o.decimation,
        mask=o.mask,
    )
    np.testing.assert_array_equal(same.reduced_forces, o.reduced_forces)
    np.testing.assert_allclose(same.reduced_time, o.reduced_time, atol=1e-12)
    plain = Observations.of(m.q, m.qd, m.qdd, o.forces, sample_time=DT)
    assert plain.mask.all()
    np.testing.assert_array_equal(plain.reduced_forces, o.forces)
    np.testing.assert_array_equal(plain.replace(forces=2 * o.forces).forces, 2 * o.forces)
    for wrong in ({"sample_time": 0.0}, {"mask": np.ones((3, 2), bool)}, {"qd": m.qd[:5]}):
        arrays = {"q": m.q, "qd": m.qd, "qdd": m.qdd, "forces": o.forces, "sample_time": DT}
        with pytest.raises(ValueError, match=f"`{next(iter(wrong))}`"):
            Observations.of(**(arrays | wrong))
