"""Inverse kinematics against forward kinematics in plain NumPy, and what cannot be reached."""

import numpy as np
import pytest
from forward_kinematics import tip_transform
from scipy.spatial.transform import Rotation

from jaxid.robot import library
from jaxid.robot.inverse_kinematics import inverse_kinematics, inverse_kinematics_along
from jaxid.robot.kinematics import rotation_vectors, tip_jacobian
from jaxid.robot.limits import Limits

RAIL = library.tx90l_on_rail()
ROBOTS = [library.tx90l_on_rail, library.panda, library.ur10, library.kr300]


def within(robot, seed, count):
    low, high = np.asarray(robot.limits.position_min), np.asarray(robot.limits.position_max)
    low, high = np.where(np.isfinite(low), low, -np.pi), np.where(np.isfinite(high), high, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, robot.joints))


def fingers(robot):
    return robot.replace(tip_offset=np.array([0.1, -0.2, 0.3]))


@pytest.mark.parametrize("build", ROBOTS, ids=lambda b: b.__name__)
def test_forward_after_inverse_is_the_pose(build):
    robot = fingers(build())
    low, high = robot.limits.position_min, robot.limits.position_max
    for q in within(robot, 3, 4):
        pose = tip_transform(robot, q)
        found = inverse_kinematics(robot, pose[:3, 3], pose[:3, :3])
        np.testing.assert_allclose(tip_transform(robot, found), pose, atol=2e-9)
        assert (found >= low).all()
        assert (found <= high).all()


def test_of_all_coordinates_it_is_the_nearest_to_the_posture():
    pose = tip_transform(RAIL, within(RAIL, 8, 1)[0])
    posture = np.array([0.4, 0.2, 0.3, 1.2, 0.1, 0.4, 0.0])
    q = inverse_kinematics(RAIL, pose[:3, 3], pose[:3, :3], posture=posture)
    half = (RAIL.limits.position_max - RAIL.limits.position_min) / 2
    tip = tip_jacobian(RAIL, q[None])
    J = np.concatenate([tip.shift[0], tip.turn[0]], axis=1).T * half
    free = np.linalg.svd(J)[2][-1]
    assert abs(free @ ((q - posture) / half)) < 1e-7
    assert inverse_kinematics(RAIL, pose[:3, 3], pose[:3, :3], posture=q) == pytest.approx(q)


def test_a_position_alone_works_in_a_plane():
    arm = library.planar_arm(3)
    q = inverse_kinematics(arm, [1.1, 0.7, 0.0])
    np.testing.assert_allclose(tip_transform(arm, q)[:3, 3], [1.1, 0.7, 0.0], atol=2e-9)


def test_the_jacobian_and_curvature_are_difference_quotients():
    robot = fingers(RAIL)
    q, h = within(robot, 5, 1)[0], 1e-5
    tip = tip_jacobian(robot, q[None])
    force, moment = np.random.default_rng(0).standard_normal((2, 1, 3))

    def shifted(steps):
        now = tip_transform(robot, q + steps)
        turned = rotation_vectors((now[:3, :3] @ tip.rotation[0].T)[None])[0]
        return now[:3, 3] - tip.position[0], turned

    curvature = tip.curvature(force, moment)[0]
    for i, a in enumerate(h * np.eye(7)):
        ahead, behind = shifted(a), shifted(-a)
        np.testing.assert_allclose((ahead[0] - behind[0]) / (2 * h), tip.shift[0, i], atol=1e-9)
        np.testing.assert_allclose((ahead[1] - behind[1]) / (2 * h), tip.turn[0, i], atol=1e-9)
        for k, b in enumerate(10 * h * np.eye(7)):
            values = [
                force[0] @ x + moment[0] @ w
                for x, w in (shifted(10 * a + b), shifted(10 * a - b), shifted(b - 10 * a))
            ]
            values.append(
                sum(c[0] @ d for c, d in zip((force, moment), shifted(-10 * a - b), strict=True))
            )
            quotient = (values[0] - values[1] - values[2] + values[3]) / (400 * h * h)
            assert curvature[i, k] == pytest.approx(quotient, abs=1e-5)


def test_rotation_vectors_go_the_shorter_way():
    vectors = np.random.default_rng(0).standard_normal((50, 3))
    vectors *= (np.linspace(1e-9, np.pi - 1e-6, 50) / np.linalg.norm(vectors, axis=1))[:, None]
    found = rotation_vectors(Rotation.from_rotvec(vectors).as_matrix())
    np.testing.assert_allclose(found, vectors, atol=1e-7)
    half = rotation_vectors(np.diag([-1.0, -1.0, 1.0])[None])
    assert np.linalg.norm(half) == pytest.approx(np.pi)


def test_a_closed_path_of_the_tip_is_a_closed_path_of_the_joints():
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([0.3 * np.cos(angle), 0.7 + 0 * angle, 0.6 + 0.2 * np.sin(angle)], axis=1)
    down = np.diag([1.0, -1.0, -1.0])
    q = inverse_kinematics_along(RAIL, circle, down)
    np.testing.assert_allclose(q[0], q[-1], atol=1e-9)
    assert np.abs(np.diff(q, axis=0)).max() < 0.1
    for row, place in zip(q[::20], circle[::20], strict=True):
        pose = tip_transform(RAIL, row)
        np.testing.assert_allclose(pose[:3, 3], place, atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3], down, atol=1e-9)
    # Without joints to spare the arm alone would have to follow: the rail does its part.
    assert np.ptp(q[:, 0]) > 0.1


def test_says_what_cannot_be_reached():
    with pytest.raises(ValueError, match=r"comes to within 0\.\d+ m and .* rad of it"):
        inverse_kinematics(library.ur10(), [1.9, 0.0, 0.3], np.eye(3))
    tight = RAIL.replace(
        limits=Limits(
            7, position_min=[-0.1, *[-0.2] * 6], position_max=[0.1, *[0.2] * 6], force=[1.0] * 7
        )
    )
    with pytest.raises(ValueError, match="only beyond the range of joint `"):
        inverse_kinematics(tight, [0.6, 0.0, 0.6])
    line = np.linspace([0.0, 0.6, 0.6], [0.0, 2.5, 0.6], 60)
    with pytest.raises(ValueError, match=r"pose \d+ of 60, .* out of reach"):
        inverse_kinematics_along(RAIL, line)
