"""Forward kinematics against plain NumPy, and coordinates along paths."""

import jax
import numpy as np
import pytest
from forward_kinematics import body_transforms, random_configuration, tip_transform
from jax import numpy as jnp
from scipy.spatial.transform import Rotation

from jaxid.robot import library
from jaxid.robot.forward_kinematics import (
    placements,
    tip_curvature,
    tip_jacobian,
    tip_placement,
)
from jaxid.robot.inverse_kinematics import inverse_kinematics_along
from jaxid.robot.limits_and_drives import Limits

RAIL = library.tx90l_on_rail()
DOWN = np.diag([1.0, -1.0, -1.0])


def within(robot, seed, count):
    low, high = (
        np.asarray(robot.limits.position_min),
        np.asarray(robot.limits.position_max),
    )
    low, high = (
        np.where(np.isfinite(low), low, -np.pi),
        np.where(np.isfinite(high), high, np.pi),
    )
    return np.random.default_rng(seed).uniform(low, high, (count, robot.joints))


def fingers(robot):
    return robot.replace(tip_offset=np.array([0.1, -0.2, 0.3]))


@pytest.mark.parametrize("build", [library.tx90l_on_rail, library.planar_arm])
def test_placements_and_jacobian_are_those_of_plain_numpy(build):
    robot = build()
    batch = np.stack([random_configuration(robot, seed) for seed in range(4)])

    @jax.jit
    @jax.vmap
    def place(q):
        return placements(robot, q), tip_placement(robot, q)

    (rotations, origins), tips = place(batch)
    for k, q in enumerate(batch):
        expected, tip = body_transforms(robot, q), tip_transform(robot, q)
        np.testing.assert_allclose(rotations[k], expected[:, :3, :3], atol=1e-13)
        np.testing.assert_allclose(origins[k], expected[:, :3, 3], atol=1e-13)
        np.testing.assert_allclose(tips[0][k], tip[:3, :3], atol=1e-13)
        np.testing.assert_allclose(tips[1][k], tip[:3, 3], atol=1e-13)


def test_the_tip_can_be_differentiated_by_coordinates_and_lengths():
    arm = library.planar_arm(2)

    def tip(offset, q):
        return tip_placement(arm.replace(offset=offset), q)[1][:2]

    q = jnp.array([0.3, 0.4])
    by_offset, by_q = jax.jit(jax.jacfwd(tip, argnums=(0, 1)))(
        jnp.asarray(arm.offset), q
    )
    assert by_offset[1, 1, 0] == pytest.approx(np.sin(0.3), abs=1e-14)
    np.testing.assert_allclose(by_q[:, 1], [-np.sin(0.7), np.cos(0.7)], atol=1e-14)


def test_the_jacobian_and_curvature_are_difference_quotients():
    robot = fingers(RAIL)
    q, h = within(robot, 5, 1)[0], 1e-5
    tip = tip_jacobian(robot, q[None])
    force, moment = np.random.default_rng(0).standard_normal((2, 1, 3))

    def shifted(steps):
        now = tip_transform(robot, q + steps)
        turned = Rotation.from_matrix(now[:3, :3] @ tip.rotation[0].T).as_rotvec()
        return now[:3, 3] - tip.position[0], turned

    def work(steps):
        return sum(
            x[0] @ y for x, y in zip((force, moment), shifted(steps), strict=True)
        )

    curvature = tip_curvature(tip, force, moment)[0]
    for i, a in enumerate(h * np.eye(7)):
        ahead, behind = shifted(a), shifted(-a)
        np.testing.assert_allclose(
            (ahead[0] - behind[0]) / (2 * h), tip.velocity[0, i], atol=1e-9
        )
        np.testing.assert_allclose(
            (ahead[1] - behind[1]) / (2 * h), tip.turn[0, i], atol=1e-9
        )
        for k in range(7):
            a, b = 10 * h * np.eye(7)[i], 10 * h * np.eye(7)[k]
            mixed = work(a + b) - work(a - b) - work(b - a) + work(-a - b)
            assert curvature[i, k] == pytest.approx(mixed / (400 * h * h), abs=1e-5)


def test_a_closed_path_of_the_tip_is_a_closed_path_of_the_joints():
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack(
        [0.3 * np.cos(angle), 0.7 + 0 * angle, 0.6 + 0.2 * np.sin(angle)], axis=1
    )
    q = inverse_kinematics_along(RAIL, circle, DOWN)
    np.testing.assert_allclose(q[0], q[-1], atol=1e-9)
    assert np.abs(np.diff(q, axis=0)).max() < 0.1
    for row, place in zip(q[::20], circle[::20], strict=True):
        pose = tip_transform(RAIL, row)
        np.testing.assert_allclose(pose[:3, 3], place, atol=1e-9)
        np.testing.assert_allclose(pose[:3, :3], DOWN, atol=1e-9)


def test_of_all_coordinates_they_are_the_nearest_to_the_posture():
    posture = np.array([0.4, 0.2, 0.3, 1.2, 0.1, 0.4, 0.0])
    pose = tip_transform(RAIL, posture + 0.1)
    q = inverse_kinematics_along(RAIL, pose[None, :3, 3], pose[:3, :3], posture)[0]
    np.testing.assert_allclose(tip_transform(RAIL, q), pose, atol=2e-9)
    half = (RAIL.limits.position_max - RAIL.limits.position_min) / 2
    tip = tip_jacobian(RAIL, q[None])
    by_joints = np.concatenate([tip.velocity[0], tip.turn[0]], axis=1).T
    redundant_motion = np.linalg.svd(by_joints * half)[2][-1]
    assert abs(redundant_motion @ ((q - posture) / half)) < 1e-7


def test_says_where_a_path_cannot_be_followed():
    with pytest.raises(
        ValueError, match=r"pose 1 of 1, .* comes to within .* m and .* rad"
    ):
        inverse_kinematics_along(library.ur10(), np.array([[1.9, 0.0, 0.3]]), np.eye(3))
    line = np.linspace([1.5, 0.5, 0.0], [3.5, 0.5, 0.0], 6)
    with pytest.raises(ValueError, match=r"pose 5 of 6, .* comes to within"):
        inverse_kinematics_along(library.planar_arm(3), line, np.eye(3))
    tight = RAIL.replace(limits=Limits(position_min=[-0.1] * 7, position_max=[0.1] * 7))
    pose = tip_transform(RAIL, np.full(7, 0.15))
    with pytest.raises(ValueError, match="leaves its range"):
        inverse_kinematics_along(tight, pose[None, :3, 3], pose[:3, :3])
