import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

from jaxid.robot.rotations import axis_rotation, rpy_rotation, snap_angles, snap_directions

angles = st.floats(-7.0, 7.0)


def snap(angle, tolerance):
    return snap_angles("j", ("roll",), [angle], tolerance)[0][0]


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


@pytest.mark.parametrize(
    ("printed", "tolerance", "meant"),
    [
        (1.5708, 1e-4, np.pi / 2),
        (3.14159, 1e-4, np.pi),
        (-4.7124, 1e-4, -3 * np.pi / 2),
        (1.57, 1e-3, np.pi / 2),
        (1.57, 1e-4, 1.57),
        (1.5708, 0.0, 1.5708),
    ],
)
def test_printed_angles_snap_within_the_tolerance_only(printed, tolerance, meant):
    assert snap(printed, tolerance) == meant


@given(angles, angles, angles)
def test_a_rotation_is_left_alone_unless_all_of_it_is_near(roll, pitch, yaw):
    R = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    near = np.abs(R - np.round(R)).max() <= 1e-4
    snapped, _ = snap_directions("j", "attitude", R, 1e-4)
    if near:
        assert np.array_equal(snapped, np.round(R))
    else:
        np.testing.assert_allclose(snapped, R, atol=2e-15)
    np.testing.assert_array_equal(snap_directions("j", "attitude", snapped, 1e-4)[0], snapped)
    once = snap(roll, 1e-4)
    assert snap(once, 1e-4) == once


def test_rounding_is_cleaned_even_without_tolerance():
    R = Rotation.from_euler("x", np.pi / 2).as_matrix() + 6e-17
    assert set(np.abs(snap_directions("j", "attitude", R, 0.0)[0]).ravel()) == {0.0, 1.0}
