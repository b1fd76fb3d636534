"""A servo on a virtual robot: it follows, better with a better model; its sensors."""

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.robot.limits_and_drives import Drives, Limits
from jaxid.simulation.tx90l import virtual_tx90l_on_rail
from jaxid.simulation.virtual import Sensors, Servo
from jaxid.trajectory.fourier import random_fourier_series

DURATION = 0.8


@pytest.fixture(scope="module")
def virtual():
    return virtual_tx90l_on_rail()


@pytest.fixture(scope="module")
def motion(virtual):
    return random_fourier_series(virtual.robot, omega=0.8, reach=0.7, seed=1)


def feeding(virtual, parameters):
    return lambda motion: virtual.model.inverse_dynamics(parameters, motion)


@pytest.fixture(scope="module")
def run(virtual, motion):
    return virtual.track(
        motion,
        feed_forward=feeding(virtual, virtual.parameters),
        duration=DURATION,
        seed=1,
    )


def rms(x):
    return np.sqrt(np.mean(np.square(x), axis=0))


def test_a_better_model_tracks_better(virtual, motion, run):
    alone = virtual.track(motion, duration=DURATION, seed=1)
    rough = virtual.track(
        motion,
        feed_forward=feeding(virtual, 0.7 * virtual.parameters),
        duration=DURATION,
        seed=1,
    )
    errors = [np.mean(rms(r.tracking_error)[:6]) for r in (alone, rough, run)]
    assert errors[0] > errors[1] > 3 * errors[2]
    assert not run.saturated.any()


def test_without_disturbances_the_true_model_leaves_no_error(motion):
    ideal = virtual_tx90l_on_rail(disturbed=False)
    fine = ideal.replace(sensors=Sensors(1e-9, *np.zeros((2, 7))))
    errors = []
    for tick in (1e-3, 5e-4):
        servo = ideal.servo(sample_time=tick)
        known = feeding(ideal, ideal.parameters)
        run = fine.track(motion, servo=servo, feed_forward=known, duration=0.5, seed=1)
        errors.append(np.abs(run.tracking_error).max())
    wanted = ideal.model.inverse_dynamics(ideal.parameters, run.actual)
    error = rms(run.forces - np.asarray(wanted)) / np.asarray(ideal.robot.max_forces)
    assert error.max() < 2e-3
    # What is left is that torques are held between ticks: it falls with them.
    assert errors[1] < 0.7 * errors[0] < 1e-3


def test_the_log_is_on_the_motors_side_in_steps_of_the_encoders(virtual, run):
    log = run.recording
    assert log.angles_on_motor_side
    assert log.forces_on_motor_side
    step = 2 * np.pi / 2**17
    lines = np.asarray(log.angles) / step
    np.testing.assert_allclose(lines, np.round(lines), atol=1e-6)
    drives = virtual.robot.drives
    np.testing.assert_allclose(
        drives.joint_angles(log.angles),
        run.actual.q,
        atol=step / drives.reduction[6, 6],
    )
    noise = (
        np.asarray(drives.joint_forces(log.forces)) - run.forces
    ) / virtual.robot.max_forces
    np.testing.assert_allclose(rms(noise), 0.01, rtol=0.1)


def test_a_log_can_be_slower_than_the_servo(virtual, motion, run):
    known = feeding(virtual, virtual.parameters)
    again = virtual.track(
        motion, feed_forward=known, duration=DURATION, sample_time=0.004, seed=1
    )
    np.testing.assert_array_equal(again.actual.q, run.actual.q[::4])
    assert again.recording.sample_time == pytest.approx(0.004)


def test_drives_do_not_give_more_than_they_can(virtual, motion):
    weak = Limits(7, force=0.1 * np.asarray(virtual.robot.max_forces))
    robot = virtual.replace(robot=virtual.robot.replace(limits=weak))
    run = robot.track(motion, servo=virtual.servo(), duration=0.3, seed=1)
    assert run.saturated.max() > 0.2
    assert (np.abs(run.forces) <= weak.force + 1e-9).all()


REFUSALS = [
    ("`sample_time`", lambda v, m: v.track(m, sample_time=0.0015, seed=0)),
    ("`duration`", lambda v, m: v.track(m, duration=0.0, seed=0)),
    (
        "`feed_forward`",
        lambda v, m: v.track(m, feed_forward=lambda x: x.q[:, :3], seed=0),
    ),
    ("`values`", lambda v, m: v.replace(values=np.ones(3))),
    ("`temperature`", lambda v, m: v.replace(heating=None).at(30.0)),
    ("`servo`", lambda v, m: diverge(v, m)),
]


def diverge(virtual, motion):
    strong = virtual.robot.replace(limits=Limits(7), drives=Drives(7))
    stiff = Servo(1e9 * np.ones(7), 1e9 * np.ones(7))
    virtual.replace(robot=strong).track(motion, servo=stiff, duration=1.0, seed=0)


@pytest.mark.parametrize(("name", "call"), REFUSALS, ids=[name for name, _ in REFUSALS])
def test_invalid_input_is_rejected(virtual, motion, name, call):
    with pytest.raises(InputError, match=name):
        call(virtual, motion)
