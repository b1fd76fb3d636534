import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forward_kinematics import body_transforms, from_rpy, random_configuration, tip_transform
from hypothesis import given
from hypothesis import strategies as st

from jaxid.robot.drives import Drives
from jaxid.robot.library import panda, planar_arm, tx90l_on_rail
from jaxid.robot.limits import Limits
from jaxid.robot.robot import Robot, Tool

INERTIA = np.diag([0.01, 0.02, 0.015])


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


def test_mounting_refuses_what_is_no_placement():
    with pytest.raises(ValueError, match="base's rotation is no rotation matrix"):
        planar_arm().mounted(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(ValueError, match="base's rotation must be a 3 x 3 matrix"):
        planar_arm().mounted([0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="base's position must hold three finite"):
        planar_arm().mounted(position=(0.0, np.inf, 0.0))


def test_a_tool_at_the_end_effector_weighs_where_the_end_effector_is():
    R = from_rpy([0.4, -0.3, 0.9], [0, 0, 0])[:3, :3]
    robot = panda().replace(tip_rotation=R)
    carried = robot.with_tool(mass=2.0, centre_of_mass=(0.01, 0.02, 0.05), inertia=INERTIA)
    q = random_configuration(robot, 3)
    on_ground = tip_transform(robot, q) @ [0.01, 0.02, 0.05, 1.0]
    body = body_transforms(robot, q)[carried.tool.body]
    np.testing.assert_allclose(body @ [*carried.tool.centre_of_mass, 1.0], on_ground, atol=1e-14)
    kept = body[:3, :3] @ carried.tool.inertia @ body[:3, :3].T
    tip = tip_transform(robot, q)[:3, :3]
    np.testing.assert_allclose(kept, tip @ INERTIA @ tip.T, atol=1e-15)


def test_tool_parameters_are_moments_of_point_masses():
    rng = np.random.default_rng(5)
    points, masses = rng.normal(size=(6, 3)), rng.uniform(0.1, 1.0, 6)
    m, com = masses.sum(), masses @ points / masses.sum()
    about = points - com
    inertia = sum(
        w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(masses, about, strict=True)
    )
    p = Tool(0, mass=m, centre_of_mass=com, inertia=inertia).parameters
    x, y, z = points.T
    expected = [
        *(m, *(m * com)),
        *(masses @ (y**2 + z**2), masses @ (x**2 + z**2), masses @ (x**2 + y**2)),
        *(masses @ (y * z), masses @ (x * z), masses @ (x * y)),
    ]
    np.testing.assert_allclose(p, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("tool", "sentence"),
    [
        ({"mass": 0.0}, "`mass` of the tool must be a positive number"),
        ({"mass": np.nan}, "`mass` of the tool must be a positive number"),
        ({"centre_of_mass": (0.0, 1.0)}, "`centre_of_mass` of the tool must hold three"),
        ({"inertia": np.ones((2, 2))}, "`inertia` of the tool must be a symmetric 3 x 3"),
        ({"inertia": np.triu(np.ones((3, 3)))}, "`inertia` of the tool must be a symmetric"),
        ({"inertia": np.full((3, 3), np.nan)}, "`inertia` of the tool must be a symmetric"),
        ({"inertia": np.diag([1.0, 1.0, -0.1])}, "`inertia` of the tool belongs to no body"),
        ({"inertia": np.diag([1.0, 1.0, 2.1])}, "`inertia` of the tool belongs to no body"),
    ],
)
def test_a_tool_that_cannot_exist_is_refused(tool, sentence):
    given_tool = {"mass": 1.0, "centre_of_mass": (0.0, 0.0, 0.1), **tool}
    with pytest.raises(ValueError, match=sentence):
        tx90l_on_rail().with_tool(**given_tool)


def test_a_tip_or_a_tool_on_no_body_is_refused():
    arm = {
        "revolute": (True,),
        "axis": [(0.0, 0.0, 1.0)],
        "rotation": [np.eye(3)],
        "offset": [(0.0, 0.0, 0.0)],
    }
    with pytest.raises(ValueError, match="`tip_body` must be a body from 0 to 0, but is 1"):
        Robot("arm", **arm, tip_body=1)
    load = Tool(2, mass=1.0, centre_of_mass=(0, 0, 0))
    with pytest.raises(ValueError, match=r"`tool\.body` must be a body from 0 to 0, but is 2"):
        Robot("arm", **arm, tool=load)
    with pytest.raises(ValueError, match="`tip_rotation` is no rotation matrix"):
        Robot("arm", **arm, tip_rotation=2 * np.eye(3))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({"tool": Tool(3, mass=1.0, centre_of_mass=(0, 0, 0))}, "`tool.body` must be a body"),
        ({"tip_body": -1}, "`tip_body` must be a body from 0 to 2, but is -1"),
        ({"parent": (-1, 1, 0)}, "`parent` must name for each of the 3 bodies an earlier one"),
        ({"joint_names": ("a", "b")}, "`joint_names` must be 3 different names"),
        ({"limits": Limits(2)}, "`limits` must be of 3 joints, like the robot, but are of 2"),
        ({"drives": Drives(4)}, "`drives` must be of 3 joints, like the robot, but are of 4"),
    ],
)
def test_a_replaced_field_is_checked_like_a_given_one(fields, sentence):
    with pytest.raises(ValueError, match=sentence):
        planar_arm(3).replace(**fields)


def test_mounting_and_a_tool_are_differentiable():
    """The gradient by the base's attitude and the tool agrees with differences."""

    def number(x):
        c, s = jnp.cos(x[0]), jnp.sin(x[0])
        R = jnp.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        robot = planar_arm(2).mounted(R, position=x[1:4])
        tool = robot.with_tool(mass=x[4], centre_of_mass=x[5:8], inertia=x[8] * jnp.eye(3)).tool
        parts = robot.rotation[0] @ np.arange(3.0), robot.offset[0] ** 2, tool.parameters**2
        return sum(jnp.sum(part) for part in parts)

    x = np.array([0.4, 0.1, 0.2, 0.3, 2.0, 0.05, 0.02, 0.01, 0.03])
    found = np.asarray(jax.jit(jax.grad(number))(x))
    value = jax.jit(number)
    expected = [float(value(x + h) - value(x - h)) / 2e-6 for h in 1e-6 * np.eye(len(x))]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.abs(found).min() > 0.01
