import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from jaxid.robot.rotations import (
    axis_rotation,
    rpy_rotation,
    snapped_rotations,
    without_rounding,
)

angles = st.floats(-7.0, 7.0)


@given(angles, angles, angles)
def test_rpy_is_the_fixed_axes_rotation_of_scipy(roll, pitch, yaw):
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(rpy_rotation([roll, pitch, yaw]), expected, atol=1e-14)


def test_quarter_turns_are_exact():
    for axis in np.eye(3):
        for angle in np.arange(-8, 9) * np.pi / 2:
            R = axis_rotation(axis, angle)
            assert set(np.abs(R).ravel()) == {0.0, 1.0}
            assert not np.signbit(R[R == 0.0]).any()
            expected = Rotation.from_rotvec(axis * angle).as_matrix()
            np.testing.assert_allclose(R, expected, atol=1e-14)


@pytest.mark.parametrize("printed", [1.5708, 3.14159, -4.7124, 1.57079633, 5.49e-5])
@pytest.mark.parametrize("order", ["xyz", "zyx", "yzx"])
def test_rounded_quarter_turns_become_exact(printed, order):
    meant = np.round(printed / (np.pi / 2)) * (np.pi / 2)
    for other in (0.3, -1.1, 2.0, np.pi / 2, 0.0):
        R, exact = (
            Rotation.from_euler(order, [other, angle, 0.0]).as_matrix()
            for angle in (printed, meant)
        )
        np.testing.assert_allclose(snapped_rotations(R, 1e-4), exact, atol=3e-15)
        np.testing.assert_array_equal(snapped_rotations(R, 0.0), R)


def test_rounding_is_cleaned():
    R = Rotation.from_euler("x", np.pi / 2).as_matrix() + 6e-17
    assert set(np.abs(without_rounding(R)).ravel()) == {0.0, 1.0}
