import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxid.robot.kinematics import axis_rotation, rpy_rotation
from jaxid.robot.plausibility import (
    angle_notes,
    snap_angles,
    snap_axis,
    snap_rotation,
)

angles = st.floats(-7.0, 7.0)


@given(angles, angles, angles)
def test_rpy_is_the_fixed_axes_rotation_of_scipy(roll, pitch, yaw):
    expected = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    np.testing.assert_allclose(rpy_rotation([roll, pitch, yaw]), expected, atol=1e-14)


@pytest.mark.parametrize("quarters", range(-8, 9))
@pytest.mark.parametrize("axis", np.eye(3))
def test_quarter_turns_are_exact(axis, quarters):
    R = axis_rotation(axis, quarters * np.pi / 2)
    assert set(np.abs(R).ravel()) == {0.0, 1.0}
    assert not np.signbit(R[R == 0.0]).any()
    expected = Rotation.from_rotvec(axis * quarters * np.pi / 2).as_matrix()
    np.testing.assert_allclose(R, expected, atol=1e-14)


@pytest.mark.parametrize(
    ("printed", "tolerance", "meant"),
    [
        (1.5708, 1e-4, np.pi / 2),
        (-1.5708, 1e-4, -np.pi / 2),
        (3.14159, 1e-4, np.pi),
        (4.7124, 1e-4, 3 * np.pi / 2),
        (1.57, 1e-3, np.pi / 2),
        (3.14, 2e-3, np.pi),
        (1.57, 1e-4, 1.57),
        (0.3, 1e-4, 0.3),
        (1.5708, 0.0, 1.5708),
    ],
)
def test_printed_angles_snap_within_the_tolerance_only(printed, tolerance, meant):
    assert snap_angles(printed, tolerance) == meant


def test_one_angle_snaps_though_its_neighbour_is_oblique():
    R = rpy_rotation(snap_angles([1.5708, 0.0, 0.3], 1e-4))
    assert R[2, 2] == 0.0
    assert R[2, 1] == 1.0
    assert R[1, 0] == pytest.approx(np.sin(0.3), abs=1e-15)


@given(angles, angles, angles)
def test_a_rotation_is_left_alone_unless_all_of_it_is_near(roll, pitch, yaw):
    R = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix()
    near = np.abs(R - np.round(R)).max() <= 1e-4
    snapped = snap_rotation(R, 1e-4)
    if near:
        assert np.array_equal(snapped, np.round(R))
    else:
        np.testing.assert_allclose(snapped, R, atol=2e-15)


def test_rounding_is_cleaned_even_without_tolerance():
    R = Rotation.from_euler("x", np.pi / 2).as_matrix() + 6e-17
    assert set(np.abs(snap_rotation(R, 0.0)).ravel()) == {0.0, 1.0}


def test_axes_snap_to_signed_coordinate_axes():
    assert np.array_equal(snap_axis([0.0, -2.0, 1e-5], 1e-4), [0.0, -1.0, 0.0])
    oblique = snap_axis([1.0, 1.0, 0.0], 1e-4)
    np.testing.assert_allclose(oblique, [np.sqrt(0.5), np.sqrt(0.5), 0.0])
    assert snap_axis([0.0, 1.0, 1e-5], 0.0)[2] != 0.0


def test_notes_name_the_joint_and_the_angle():
    before = [1.5708, 0.3, 1e-14]
    notes = angle_notes("elbow", ("roll", "pitch", "yaw"), before, snap_angles(before, 1e-4))
    assert notes == ("joint `elbow`: roll 1.5708 rad snapped to 90 degrees.",)
