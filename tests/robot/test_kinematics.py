import jax
import numpy as np
import pytest
from forward_kinematics import body_transforms, random_configuration, tip_transform
from jax import numpy as jnp

from jaxid.robot import library
from jaxid.robot.kinematics import placements, tip_placement

ROBOTS = [library.tx90l_on_rail, library.iiwa14, library.kr300, library.planar_arm]


@pytest.mark.parametrize("build", ROBOTS)
def test_placements_are_those_of_plain_numpy(build):
    robot = build()
    batch = np.stack([random_configuration(robot, seed) for seed in range(4)])
    rotations, origins = jax.jit(jax.vmap(lambda q: placements(robot, q)))(batch)
    tips = jax.vmap(lambda q: tip_placement(robot, q))(batch)
    for k, q in enumerate(batch):
        expected, tip = body_transforms(robot, q), tip_transform(robot, q)
        np.testing.assert_allclose(rotations[k], expected[:, :3, :3], atol=1e-13)
        np.testing.assert_allclose(origins[k], expected[:, :3, 3], atol=1e-13)
        np.testing.assert_allclose(tips[0][k], tip[:3, :3], atol=1e-13)
        np.testing.assert_allclose(tips[1][k], tip[:3, 3], atol=1e-13)


@pytest.mark.parametrize("build", ROBOTS)
def test_the_jacobian_of_the_tip_is_its_difference_quotient(build):
    robot = build()
    q = random_configuration(robot, 7)
    jacobian = jax.jacfwd(lambda q: tip_placement(robot, q)[1])(jnp.asarray(q))
    h = 1e-6
    for j, step in enumerate(h * np.eye(robot.joints)):
        ahead, behind = tip_transform(robot, q + step), tip_transform(robot, q - step)
        quotient = (ahead[:3, 3] - behind[:3, 3]) / (2 * h)
        np.testing.assert_allclose(jacobian[:, j], quotient, atol=1e-8)


def test_the_tip_can_be_differentiated_with_respect_to_a_length():
    arm = library.planar_arm(2)

    def height(offset):
        return tip_placement(arm.replace(offset=offset), np.array([0.3, 0.4]))[1][1]

    gradient = jax.grad(height)(jnp.asarray(arm.offset))
    assert gradient[1, 0] == pytest.approx(np.sin(0.3), abs=1e-14)
