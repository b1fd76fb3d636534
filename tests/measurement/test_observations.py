"""Observations: forces and columns stay aligned through filters, gaps and chunks."""

import dataclasses

import numpy as np
import pytest

from jaxid.measurement.filters import (
    PaperFilter,
    PeriodicFourier,
    Subsample,
    ZeroPhaseButterworth,
)
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.recording import Recording
from jaxid.robot.limits_and_drives import Drives
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


def a_recording(gaps=()):
    t = DT * np.arange(6000)
    for gap in gaps:
        t[gap:] += 0.5
    w = np.pi
    q = np.stack(
        [np.sin(w * t) + 0.3 * np.cos(3 * w * t), 0.5 * np.cos(2 * w * t)], axis=1
    )
    qd = np.stack(
        [w * np.cos(w * t) - 0.9 * w * np.sin(3 * w * t), -w * np.sin(2 * w * t)], 1
    )
    rng = np.random.default_rng(5)
    forces = np.sign(qd) + 2 * q + 0.3 * rng.normal(size=q.shape)
    return Recording.of(q, forces, velocities=qd, time=t)


CASES = [
    (ZeroPhaseButterworth(20.0), Subsample()),
    (ZeroPhaseButterworth(20.0), Subsample(11)),
    (ZeroPhaseButterworth(100, force_cutoff=9.0, margin=0.02), Subsample(40)),
    (PaperFilter(), Subsample(15)),
    (PeriodicFourier(2.0, 4), Subsample(10)),
]
every = pytest.mark.parametrize(("filter", "decimation"), CASES)


def columns_of(o):
    """Three columns for each joint, one of them the force itself."""
    return np.stack([np.sign(o.motion.qd), o.motion.qdd, o.forces], axis=2)


@every
@pytest.mark.parametrize("gaps", [(), (2500,), (2600, 2700, 4300)])
def test_columns_and_forces_stay_aligned_in_one_or_many_chunks(
    filter, decimation, gaps
):
    if isinstance(filter, PeriodicFourier):
        gaps = gaps[:1]
    o = observe(a_recording(gaps=gaps), a_robot(), filter, decimation)
    x, p = columns_of(o), np.array([0.5, -0.1, 2.0])
    rows = o.reduce(x)
    assert rows.shape == (o.rows, 2, 3)
    np.testing.assert_array_equal(rows[:, :, 2], o.reduced_forces)
    np.testing.assert_allclose(rows @ p, o.reduce(x @ p), atol=1e-10)
    for size in (300, 100_000):
        out, chunks = np.full_like(rows, np.nan), o.chunks(size)
        for chunk in chunks:
            out[slice(*chunk.rows)] = chunk.reduce(x[slice(*chunk.samples)])
        np.testing.assert_allclose(out, rows, atol=1e-11 * np.abs(x).max())
        wanted = [(1, 2), (o.rows // 3, o.rows - 3)]
        parts = o.chunks(size, wanted)
        made = [k for chunk in parts for k in range(*chunk.rows)]
        assert made == [k for ends in wanted for k in range(*ends)]
        for chunk in parts:
            own = chunk.reduce(x[slice(*chunk.samples)])
            expected = rows[slice(*chunk.rows)]
            np.testing.assert_allclose(own, expected, atol=1e-11 * np.abs(x).max())
        most = size + 2 * filter.low_pass(DT).memory()
        assert max(c.samples[1] - c.samples[0] for c in chunks) <= most


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
            np.testing.assert_allclose(
                np.diff(o.reduced_time[a:b]), o.row_time, rtol=1e-9
            )


def test_slow_rows_are_masked_for_their_joint_alone():
    o = observe(a_recording(), a_robot(), *CASES[1], min_speed=(0.5, 1.2))
    np.testing.assert_array_equal(o.mask, np.abs(o.reduced_motion.qd) >= [0.5, 1.2])
    assert (o.mask[:, 0] != o.mask[:, 1]).any()


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


@pytest.mark.parametrize(
    ("joints", "dt", "settings", "complaint"),
    [
        (
            3,
            DT,
            [ZeroPhaseButterworth(20.0)],
            "has 2 joints, but the robot `arm` has 3",
        ),
        (
            2,
            DT,
            [ZeroPhaseButterworth(20.0), Subsample(26)],
            "step of at most 25 samples",
        ),
        (
            2,
            DT,
            [ZeroPhaseButterworth(20.0, force_cutoff=np.inf), Subsample(2)],
            "lower `force_cutoff`",
        ),
        (
            2,
            DT,
            [ZeroPhaseButterworth(0.05)],
            "longest segment of `recording` has 6000 samples",
        ),
        (
            2,
            1e-2 * DT,
            [ZeroPhaseButterworth(5.0)],
            "longest seg.* at 100000 Hz.*`time_unit`",
        ),
        (
            2,
            DT,
            [*CASES[0], [0.0, 99.0]],
            "joint `joint2` never reaches the speed 99",
        ),
        (2, DT, [*CASES[0], [0.0]], "`min_speed`"),
    ],
)
def test_refusals(joints, dt, settings, complaint):
    with pytest.raises(ValueError, match=complaint):
        observe(
            dataclasses.replace(a_recording(), sample_time=dt),
            a_robot(joints),
            *settings,
        )


def test_remarks_say_what_was_left_out():
    r = a_recording(gaps=(2500, 2550))
    o = observe(r, a_robot(), ZeroPhaseButterworth(20.0))
    assert o.segments == ((0, 2500), (2500, 5950))
    assert o.time[2500] == pytest.approx(3.55)
    assert "1 segment(s), shorter" in o.notes[-1]
    assert (
        "measured velocities are not used"
        in observe(r, a_robot(), PaperFilter()).notes[-1]
    )


@pytest.mark.parametrize("noise", [0.0, 1e-3])
@pytest.mark.parametrize("wrong", [-1.0, 1.5, 0.0, 180 / np.pi])
def test_velocities_that_are_no_derivatives_are_left_out(wrong, noise):
    """One channel is wrong; one at rest, with noise in both signals, is not judged."""
    r, rng = a_recording(gaps=(2500,)), np.random.default_rng(2)
    quiet = np.asarray(r.angles) * [1.0, 0.0] + noise * rng.normal(size=r.angles.shape)
    good = np.asarray(r.velocities) * [1.0, 0.0] + 10 * noise * rng.normal(
        size=r.angles.shape
    )
    settings = a_robot(), ZeroPhaseButterworth(20.0)
    right = dataclasses.replace(r, angles=quiet, velocities=good)
    assert not any(
        "not the derivatives" in note for note in observe(right, *settings).notes
    )
    bad = observe(dataclasses.replace(right, velocities=good * [wrong, 1.0]), *settings)
    assert "velocities of channels 1 are not the derivatives" in bad.notes[-1]
    without = observe(dataclasses.replace(right, velocities=None), *settings)
    np.testing.assert_array_equal(bad.motion.qd, without.motion.qd)


def test_arrays_that_are_filtered_already_become_observations():
    o = observe(
        a_recording(), a_robot(), ZeroPhaseButterworth(20.0, margin=0.0), Subsample(5)
    )
    m = o.motion
    settings = {"filter": o.filter, "decimation": o.decimation, "mask": o.mask}
    same = Observations.of(m.q, m.qd, m.qdd, o.forces, sample_time=DT, **settings)
    np.testing.assert_array_equal(same.reduced_forces, o.reduced_forces)
    np.testing.assert_allclose(same.reduced_time, o.reduced_time, atol=1e-12)
    plain = Observations.of(m.q, m.qd, m.qdd, o.forces, sample_time=DT)
    assert plain.mask.all()
    np.testing.assert_array_equal(plain.reduced_forces, o.forces)
    np.testing.assert_array_equal(
        plain.replace(forces=2 * o.forces).forces, 2 * o.forces
    )
    for wrong in (
        {"sample_time": 0.0},
        {"mask": np.ones((3, 2), bool)},
        {"qd": m.qd[:5]},
    ):
        arrays = {
            "q": m.q,
            "qd": m.qd,
            "qdd": m.qdd,
            "forces": o.forces,
            "sample_time": DT,
        }
        with pytest.raises(ValueError, match=f"`{next(iter(wrong))}`"):
            Observations.of(**(arrays | wrong))
