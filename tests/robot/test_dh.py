import numpy as np
import pytest
from forward_kinematics import (
    body_transforms,
    dh_frames,
    from_rpy,
    random_configuration,
    tip_transform,
)
from hypothesis import given, settings, strategies as st

from jaxid.robot.library import from_dh

# A realistic mixture: quarter twists, an oblique one, theta offsets, every length.
ROWS = np.array(
    [
        (0.0, 0.1, 0.4, 0.2),
        (-np.pi / 2, 0.05, 0.0, -np.pi / 2),
        (0.7, 0.3, -0.1, 0.0),
        (np.pi / 2, 0.0, 0.25, 1.1),
        (np.pi, -0.2, 0.05, np.pi),
    ]
)
kinds = st.lists(st.booleans(), min_size=5, max_size=5).map(tuple)
few = settings(max_examples=20)


@few
@given(kinds, st.sampled_from(["modified", "standard"]), st.integers(0, 1000))
def test_the_end_effector_is_the_product_of_the_table(revolute, convention, seed):
    robot = from_dh(ROWS, convention=convention, revolute=revolute)
    q = random_configuration(robot, seed)
    frames = dh_frames(ROWS, q, convention, revolute)
    np.testing.assert_allclose(tip_transform(robot, q), frames[-1], atol=1e-13)
    if convention == "modified":
        np.testing.assert_allclose(body_transforms(robot, q), frames[1:], atol=1e-13)


@few
@given(kinds, st.integers(0, 1000))
def test_standard_bodies_stand_on_their_own_joints_axis(revolute, seed):
    robot = from_dh(ROWS, convention="standard", revolute=revolute)
    q = random_configuration(robot, seed)
    bodies = body_transforms(robot, q)
    before = dh_frames(ROWS, q, "standard", revolute)[:-1]
    np.testing.assert_allclose(bodies[:, :3, 2], before[:, :3, 2], atol=1e-13)
    from_frame = bodies[:, :3, 3] - before[:, :3, 3]
    np.testing.assert_allclose(np.cross(from_frame, before[:, :3, 2]), 0.0, atol=1e-13)
    assert np.array_equal(robot.axis, np.tile([0.0, 0.0, 1.0], (5, 1)))


@pytest.mark.parametrize("convention", ["modified", "standard"])
def test_base_and_tip_frames_multiply_from_both_sides(convention):
    base, tip = (
        from_rpy([0.3, -0.2, 2.0], [1.0, 2.0, 3.0]),
        from_rpy([1.0, 0.1, 0.4], [0, 0.1, 0.2]),
    )
    robot = from_dh(
        ROWS[:, :3],
        convention=convention,
        base_rotation=base[:3, :3],
        base_position=base[:3, 3],
        tip_rotation=tip[:3, :3],
        tip_offset=tip[:3, 3],
    )
    q = random_configuration(robot, 1)
    expected = base @ dh_frames(ROWS[:, :3], q, convention)[-1] @ tip
    np.testing.assert_allclose(tip_transform(robot, q), expected, atol=1e-13)
