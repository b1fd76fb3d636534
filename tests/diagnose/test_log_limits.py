"""Each finding about units and rates is raised by its own mistake, and by nothing else."""

import numpy as np
import pytest

from jaxid.diagnosis.limits import rate_findings, unit_findings
from jaxid.robot.joints import Drives
from jaxid.robot.library import panda, planar_arm
from jaxid.trajectory.fourier import random_fourier_series

ROBOT = panda().replace(drives=Drives(7, reduction=[100.0, -100, 100, 100, 50, 50, 50]))
T = np.arange(0.0, 10.0, 0.005)
Q = np.asarray(random_fourier_series(ROBOT, omega=0.6, seed=3).motion(T).q)


def units(angles, on_motor_side=False):
    return unit_findings(ROBOT, angles.min(axis=0), angles.max(axis=0), on_motor_side)


def test_sane_angles_raise_no_doubt():
    assert units(Q) == []
    assert unit_findings(planar_arm(2), np.full(2, -9.0), np.full(2, 9.0), False) == []


def test_degrees_are_recognised():
    (said,) = units(np.rad2deg(Q))
    assert "would not if those in the log were degrees" in said


def test_radians_that_are_taken_for_degrees_are_recognised():
    (said,) = units(np.deg2rad(Q))
    assert "are the angles of the log in radians" in said


def test_motor_angles_are_recognised():
    motors = np.asarray(ROBOT.drives.motor_angles(Q))
    (said,) = units(motors)
    assert 'the motors\' (`recording.side = "motor"`)' in said
    assert units(motors, on_motor_side=True) == []


@pytest.mark.parametrize(("rate", "doubted"), [(1.0, 1), (100.0, 0), (1e4, 0), (1e6, 1)])
def test_a_rate_that_no_robot_has_is_doubted(rate, doubted):
    assert len(rate_findings(1.0 / rate)) == doubted
