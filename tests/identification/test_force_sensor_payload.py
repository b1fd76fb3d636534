"""Payloads by force sensors: wrench, torque or both, bias, mounting, static poses.

The wrench is that of a point-by-point Newton-Euler of the load alone, in NumPy.
"""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from wrench_logs import BIAS, LOAD, RATE, ROBOT, TURN, noisy, poses, wrench

import jaxid as jid
from jaxid.dynamics.terms import SensorBias, SensorLoad, SensorRotation
from jaxid.export.c_code import c_functions
from jaxid.identification.force_sensor import identify_sensor_rotation
from jaxid.program import evaluate
from jaxid.result_table import Status
from jaxid.validation.wrench_checks import wrench_remarks

TERMS = (SensorLoad(), SensorBias(), SensorRotation())
OPTIONS = (jid.ZeroPhaseButterworth(8.0), jid.Subsample(5))


def fit(measured, t, speed=1.0, terms=TERMS, forces=None, robot=ROBOT):
    robot = robot.with_sensor()
    recording = jid.Recording.of(
        poses(t, speed), forces, wrench=measured, sample_time=1 / RATE
    )
    observations = jid.observe(recording, robot, *OPTIONS)
    base = jid.base_parameters(jid.Model(robot, terms))
    return jid.identify(identify_sensor_rotation(base, observations), observations)


@pytest.fixture(scope="module")
def time():
    return np.arange(0.0, 20.0, 1 / RATE)


@pytest.fixture(scope="module")
def turned_fit(time):
    return fit(noisy(wrench(time), 0), time)


def test_load_bias_and_rotation_come_from_one_run(turned_fit):
    found = jid.identify_payload(None, turned_fit)
    half_widths = found.uncertainty.half_widths()
    assert (np.abs(found.estimate - LOAD.parameters) < 1.6 * half_widths).all()
    assert abs(found.mass - 1.35) < 0.004 * 1.35
    assert np.abs(found.centre_of_mass - LOAD.centre_of_mass).max() < 1e-3
    assert np.abs(np.rad2deg(found.sensor.rotation - TURN)).max() < 0.3
    errors = np.append(found.sensor.bias - BIAS, found.sensor.rotation - TURN)
    assert (np.abs(errors) < 1.6 * found.sensor.uncertainty.half_widths()).all()
    assert found.has_inertia
    rows = {row[0]: row for row in found.summary().rows}
    assert "deg" in " ".join(rows["rz4"])


def test_a_payload_on_a_gripper_is_the_difference_of_two_runs(time, turned_fit):
    """The gripper is in both; the bias may change between them."""
    gripper = jid.Tool(0, mass=0.7, centre_of_mass=(0.0, 0.0, 0.03), inertia=None)
    empty = fit(noisy(wrench(time, 0.9, load=gripper), 1) + 1.0, time, 0.9)
    both = wrench(time) + wrench(time, load=gripper)
    found = jid.identify_payload(empty, fit(noisy(both, 2), time))
    assert abs(found.mass - 1.35) < 1.5 * found.uncertainty.half_widths()[0] < 0.03
    assert np.abs(found.centre_of_mass - LOAD.centre_of_mass).max() < 2e-3


def test_parts_of_a_log_may_have_biases_of_their_own(time):
    halves = [fit(noisy(wrench(time), k) + 0.4 * k, time) for k in range(2)]
    drifting = jid.identify_payload(None, halves)
    assert drifting.sensor.drift_chance < 1e-3
    assert "drifts" in str(drifting)
    assert abs(drifting.mass - 1.35) < 0.01
    np.testing.assert_allclose(drifting.sensor.bias, BIAS + 0.4, atol=0.15)


def test_poses_at_rest_tell_no_inertia(time):
    """Mass, centre and bias come out; moments are refused in words."""
    measured = noisy(wrench(time, 0.12), 3)
    assert findings(time, measured, 0.12) == []
    slow_fit = fit(measured, time, 0.12)
    found = jid.identify_payload(None, slow_fit)
    assert not found.has_inertia
    assert abs(found.mass - 1.35) < 0.05
    assert np.abs(found.centre_of_mass - LOAD.centre_of_mass).max() < 0.01
    assert np.isnan(found.inertia).all()
    assert not np.any(found.tool.inertia)
    remarks = found.summary().remarks
    assert any("do not determine the moments" in str(x) for x in remarks)
    assert all(x.status is not Status.BAD for x in remarks)
    assert "possible" not in str(found)


def test_refusals(time):
    robot = ROBOT.with_sensor()
    values = wrench(time)
    q = poses(time, 1.0)
    with pytest.raises(jid.InputError, match="`wrench`"):
        jid.Recording.of(q, None, sample_time=0.01)
    for columns in (None, values[:, :3], 0.0 * values):
        log = jid.Recording.of(q, 0.0 * q, wrench=columns, sample_time=0.01)
        with pytest.raises(jid.InputError, match="`wrench`"):
            jid.observe(log, robot, *OPTIONS)
    log = jid.Recording.of(q, 0.0 * q, wrench=values, sample_time=0.01)
    with pytest.raises(jid.InputError, match="with_sensor"):
        jid.observe(log, ROBOT, *OPTIONS)
    base = jid.base_parameters(jid.Model(ROBOT, (jid.RigidBodies(),)))
    plain = jid.Recording.of(q, np.ones_like(q), sample_time=0.01)
    plain_fit = jid.identify(base, jid.observe(plain, ROBOT, *OPTIONS))
    with pytest.raises(jid.InputError, match="`unloaded`"):
        jid.identify_payload(None, plain_fit)


def findings(time, measured, speed=1.0):
    robot = ROBOT.with_sensor()
    log = jid.Recording.of(poses(time, speed), None, wrench=measured, sample_time=0.01)
    model = jid.Model(robot, (SensorLoad(),))
    return wrench_remarks(model, jid.observe(log, robot, *OPTIONS))


def attitudes(time):
    turns = [
        Rotation.from_rotvec(np.outer(angle, axis))
        for angle, axis in zip(poses(time, 1.0).T, ROBOT.axis, strict=True)
    ]
    return (turns[0] * turns[1] * turns[2]).as_matrix()


def test_a_wrench_that_is_not_the_one_described_is_named_by_gravity(time):
    right = wrench(time)
    assert findings(time, noisy(right, 0)) == []
    (reversed_sign,) = findings(time, noisy(-right, 1))
    assert "opposite sign" in reversed_sign.text
    (unit,) = findings(time, noisy(right, 1) / 1000)
    assert "kN" in unit.text
    quarter = Rotation.from_euler("xyz", [0, 90, 90], degrees=True)
    (turned,) = findings(time, noisy(wrench(time, turn=quarter.as_rotvec()), 2))
    numbers = turned.text.partition("about ")[2].partition(" degrees")[0]
    named = Rotation.from_euler("xyz", json.loads(numbers), degrees=True)
    assert (named.inv() * quarter).magnitude() < np.deg2rad(1.0)
    R = attitudes(time)
    parts = np.einsum("nij,nkj->nki", R, wrench(time, turn=0 * TURN).reshape(-1, 2, 3))
    (ground,) = findings(time, noisy(parts.reshape(-1, 6), 3))
    assert "axes of the ground" in ground.text
    (exchanged,) = findings(time, noisy(np.roll(right, 3, axis=1), 6))
    assert "forces and moments are exchanged" in exchanged.text
    weight = LOAD.mass * 9.81 * R[:, 2]
    moment = np.cross(LOAD.centre_of_mass, weight)
    inertial = wrench(time, turn=0 * TURN) - np.hstack([weight, moment])
    (compensated,) = findings(time, noisy(inertial, 4))
    assert "gravity of the load is missing" in compensated.text
    (half,) = findings(time, noisy(inertial + np.hstack([weight, moment]) / 2, 4))
    assert "51 % of the gravity" in half.text
    (units,) = findings(time, noisy(right, 1) * [1, 1, 1, 1000, 1000, 1000])
    assert "N mm" in units.text
    columns, _ = findings(time, noisy(right, 1)[:, [1, 0, 2, 4, 3, 5]])
    assert "left-handed" in columns.text
    cable = np.outer(poses(time, 1.0)[:, -1], [0, 0, 0, 0.07, -0.03, 0.065])
    (pulled,) = findings(time, noisy(right + cable, 7))
    assert f"follow `{ROBOT.joint_names[-1]}` by 0.099 N m" in pulled.text
    tared = right - right[40]
    noise = np.random.default_rng(5).normal(size=tared.shape) * 0.02
    (zeroed,) = findings(time, tared + noise)
    assert "tared" in zeroed.text


def test_exported_wrench_is_that_of_the_load_and_the_bias(time, turned_fit):
    """From the driven joints alone, at any motion."""
    functions = {x.name: x for x in c_functions(turned_fit)}
    function = functions["wrench"]
    assert (function.inputs, function.size) == (("q", "qd", "qdd"), 6)
    t = time[::100]
    h = 1e-4
    before, q, after = (poses(t + shift, 1.0) for shift in (-h, 0.0, h))
    motion = (q, (after - before) / (2 * h), (after - 2 * q + before) / h**2)
    result = np.array(evaluate(function.program, *(x.T for x in motion))).T
    expected = wrench(t) + BIAS
    np.testing.assert_allclose(result[:, :3], expected[:, :3], atol=0.3)
    np.testing.assert_allclose(result[:, 3:], expected[:, 3:], atol=0.02)
    assert functions["torque"].size == ROBOT.joints
