import numpy as np
from forward_kinematics import (
    body_transforms,
    from_rpy,
    random_configuration,
    tip_transform,
)
from hypothesis import given, settings, strategies as st

from jaxid.robot.library import panda
from jaxid.robot.robot import Robot

INERTIA = np.diag([0.01, 0.02, 0.015])


@settings(max_examples=20)
@given(st.integers(0, 1000))
def test_mounting_moves_every_body_by_the_same_placement(seed):
    rng = np.random.default_rng(seed)
    base = from_rpy(rng.uniform(-3, 3, 3), rng.uniform(-1, 1, 3))
    robot = Robot(
        "two arms",
        parent=(-1, 0, -1, 2),
        revolute=(True, False, True, True),
        axis=rng.normal(size=(4, 3)),
        rotation=[from_rpy(rng.uniform(-3, 3, 3), [0, 0, 0])[:3, :3] for _ in range(4)],
        offset=rng.normal(size=(4, 3)),
    )
    mounted = robot.mounted(base[:3, :3], base[:3, 3])
    q = random_configuration(robot, seed)
    np.testing.assert_allclose(
        body_transforms(mounted, q), base @ body_transforms(robot, q), atol=1e-12
    )
    assert np.array_equal(mounted.gravity, robot.gravity)


def test_a_tool_at_the_end_effector_weighs_where_the_end_effector_is():
    R = from_rpy([0.4, -0.3, 0.9], [0, 0, 0])[:3, :3]
    robot = panda().replace(tip_rotation=R)
    carried = robot.with_tool(
        mass=2.0, centre_of_mass=(0.01, 0.02, 0.05), inertia=INERTIA
    )
    q = random_configuration(robot, 3)
    on_ground = tip_transform(robot, q) @ [0.01, 0.02, 0.05, 1.0]
    body = body_transforms(robot, q)[carried.tool.body]
    np.testing.assert_allclose(
        body @ [*carried.tool.centre_of_mass, 1.0], on_ground, atol=1e-14
    )
    expected = body[:3, :3] @ carried.tool.inertia @ body[:3, :3].T
    tip = tip_transform(robot, q)[:3, :3]
    np.testing.assert_allclose(expected, tip @ INERTIA @ tip.T, atol=1e-15)
