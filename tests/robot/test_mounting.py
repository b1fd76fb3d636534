import mujoco
import numpy as np
import pinocchio as pin
import pytest
from forward_kinematics import (
    body_transforms,
    from_rpy,
    random_configuration,
    tip_transform,
)
from hypothesis import given, settings, strategies as st
from urdf_text import inertial, joint, link, robot as urdf_robot

from jaxid.dynamics.base import base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import RigidBodies
from jaxid.robot.library import panda
from jaxid.robot.robot import Robot
from jaxid.robot.urdf import load_urdf, urdf_parameters

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


# Joints above `base` turn gravity.

BODY = inertial(3.0, (0.1, 0.05, 0.2), (0.1, 0, 0), (0.1, 0.01, 0, 0.12, 0, 0.08))
MOUNTS = {
    "ceiling": ("3.141592653589793 0 0", "0 0 0", "joint `to_torso` at a tilt of 180"),
    "rounded ceiling": ("3.14159 0 0", "0 0 0", "joint `to_torso` at a tilt of 180"),
    "wall": ("0 0 0", "0 1.5707963267948966 0", "joint `to_base` at a tilt of 90"),
    "two joints": (
        "1 0 0",
        "0 0.5 0",
        "joints `to_torso`, `to_base` at a tilt of 61.7",
    ),
}
LIMIT = '<limit lower="-2" upper="2" velocity="3" effort="9"/>'


def arm_on_mount(first="0 0 0", second="0 0 0", kind="fixed"):
    """Two joints on a base that hangs on a torso."""
    return urdf_robot(
        *map(link, ("world", "torso", "base")),
        link("a", BODY),
        link("b", BODY),
        joint("to_torso", "world", "torso", "fixed", rpy=first, xyz="0 0 2"),
        joint("to_base", "torso", "base", kind, rpy=second, axis="1 0 0"),
        joint("j1", "base", "a", rpy="0 0 0.4", inner=LIMIT),
        joint("j2", "a", "b", xyz="0 0 0.4", axis="0 1 0", inner=LIMIT),
    )


def forces(path, robot, motion):
    """Return forces of rigid bodies as the file claims them."""
    parameters = urdf_parameters(path, base="base")
    return Model(robot, (RigidBodies(),)).inverse_dynamics(parameters, motion)


def two_joint_motion():
    rng = np.random.default_rng(0)
    return Motion(*(rng.uniform(-s, s, (10, 2)) for s in (2.0, 2.0, 5.0)))


@pytest.mark.parametrize(("first", "second", "tilt"), MOUNTS.values(), ids=MOUNTS)
def test_fixed_joints_above_the_base_turn_gravity_as_in_pinocchio(
    tmp_path, first, second, tilt
):
    path = tmp_path / "arm.urdf"
    path.write_text(arm_on_mount(first, second))
    robot = load_urdf(path, base="base")
    motion = two_joint_motion()
    oracle = pin.buildModelFromUrdf(str(path))
    oracle.gravity.linear = np.array([0.0, 0.0, -9.81])
    data = oracle.createData()
    expected = [
        pin.rnea(oracle, data, *row)
        for row in zip(motion.q, motion.qd, motion.qdd, strict=True)
    ]
    np.testing.assert_allclose(forces(path, robot, motion), expected, atol=1e-11)
    assert f"`base` is carried by {tilt} degrees " in robot.notes[0]
    # The frames are those of the base, and gravity that a user states is as stated.
    assert robot.offset[0].tolist() == [0.0, 0.0, 0.0]
    upright = load_urdf(path, base="base", base_rotation=np.eye(3))
    stated = load_urdf(path, base="base", gravity=(0.0, 0.0, -1.62))
    assert upright.gravity.tolist() == [0.0, 0.0, -9.81]
    assert stated.gravity.tolist() == [0.0, 0.0, -1.62]
    assert upright.notes == stated.notes == robot.notes[1:]


def test_a_base_that_only_turns_about_the_vertical_has_no_note(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(arm_on_mount("0 0 0.7", "0 0 1.1"))
    robot = load_urdf(path, base="base")
    assert robot.gravity.tolist() == [0.0, 0.0, -9.81]
    assert not robot.notes


def test_a_rounded_ceiling_costs_no_base_parameter(tmp_path):
    sizes = []
    for angle in ("3.14159", "3.141592653589793"):
        path = tmp_path / "arm.urdf"
        path.write_text(arm_on_mount(f"{angle} 0 0"))
        robot = load_urdf(path, base="base")
        sizes.append(base_parameters(Model(robot, (RigidBodies(),))).size)
    assert sizes[0] == sizes[1]


def test_a_moving_joint_above_the_base_is_named(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(arm_on_mount(kind="revolute"))
    (note,) = load_urdf(path, base="base").notes
    assert "is carried by joint `to_base` at" in note
    path.write_text(arm_on_mount(second="3.141592653589793 0 0", kind="floating"))
    assert load_urdf(path, base="base").gravity.tolist() == [0.0, 0.0, 9.81]


def test_bodies_above_the_base_turn_gravity_as_in_mujoco(tmp_path):
    path = tmp_path / "arm.xml"
    path.write_text("""
<mujoco><compiler angle="degree"/><option gravity="0.3 0 -9.7"/><worldbody>
  <body name="torso" euler="0 30 0"><geom size="0.1"/>
    <body name="base" pos="0 0 1" euler="180 0 20">
      <body name="a" euler="0 0 40"><joint name="j1"/>
        <geom type="box" size="0.1 0.2 0.3" pos="0.1 0 0"/>
        <body name="b" pos="0 0 0.4"><joint name="j2" axis="0 1 0"/>
          <geom type="capsule" size="0.05" fromto="0 0 0 0.3 0.1 0"/></body>
      </body></body></body></worldbody></mujoco>""")
    robot = load_urdf(path, base="base")
    motion = two_joint_motion()
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(model)
    expected = []
    for q, qd, qdd in zip(motion.q, motion.qd, motion.qdd, strict=True):
        data.qpos = q
        data.qvel = qd
        data.qacc = qdd
        mujoco.mj_inverse(model, data)
        expected.append(data.qfrc_inverse.copy())
    np.testing.assert_allclose(forces(path, robot, motion), expected, atol=1e-10)
    assert "joints `torso mount`, `base mount` at a tilt of 147" in robot.notes[0]
