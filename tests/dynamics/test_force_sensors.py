"""Force sensors at wrist and base: their wrenches are those of MuJoCo's sensors."""

import dataclasses

import numpy as np
import pytest
from follower_arms import follower_arm
from scipy.spatial.transform import Rotation

import jaxid as jid
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import SensorBias, SensorRotation
from jaxid.robot.inertia import Inertia

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed")

ARM = """
<mujoco><compiler angle="radian"/><worldbody>
 <body name="base" pos="0 0 0.1"><site name="base" quat="0.9 0.1 0.2 0.3"/>
  <inertial pos="0 0 0" mass="2" diaginertia="1 1 1"/>
  <body name="a" pos="0 0.05 0.2"><joint name="a" axis="0 0 1"/>
   <inertial pos="0.1 0.2 0.1" mass="3" diaginertia="0.1 0.12 0.15"/>
   <body name="b" pos="0.2 0 0.1"><joint name="b" axis="0 1 0"/>
    <inertial pos="0 0.05 0.2" mass="2" diaginertia="0.04 0.05 0.03"/>
    <body name="c" pos="0 0 0.4"><joint name="c" axis="1 0 0"/>
     <inertial pos="0.01 0 0.1" mass="1" diaginertia="0.01 0.02 0.01"/>
     <body name="load" pos="0.02 0.03 0.15">
      <inertial pos="0.012 -0.02 0.09" mass="1.35"
       fullinertia="0.013 0.0125 0.0045 0.0004 -0.0006 0.0009"/>
      <site name="wrist" pos="0.01 0.02 -0.03" quat="0.8 -0.3 0.2 0.1"/>
 </body></body></body></body></body></worldbody>
 <sensor><force site="wrist"/><torque site="wrist"/><force site="base"/>
  <torque site="base"/></sensor></mujoco>
"""
BODIES = ("a", "b", "c")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    path = tmp_path_factory.mktemp("arm") / "arm.xml"
    path.write_text(ARM)
    model = mujoco.MjModel.from_xml_string(ARM)
    return path, model, mujoco.MjData(model)


def place(data, site, body):
    """Attitude and origin of a site in the frame of a body."""
    R = data.body(body).xmat.reshape(3, 3)
    rotation = R.T @ data.site(site).xmat.reshape(3, 3)
    return rotation, R.T @ (data.site(site).xpos - data.body(body).xpos)


def file_parameters(model, name):
    """Ten parameters of a body of MuJoCo about the origin of its frame."""
    body = model.body(name)
    turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
    return np.asarray(
        jid.Tool(
            0,
            mass=body.mass[0],
            centre_of_mass=body.ipos,
            inertia=turn @ np.diag(body.inertia) @ turn.T,
        ).body_inertia.parameters
    )


def moved(parameters, rotation, offset):
    """The parameters in a frame that is placed in the body's like this."""
    inertia = Inertia.from_parameters(parameters)
    return np.asarray(inertia.moved(rotation.T, -rotation.T @ offset).parameters)


@pytest.fixture(scope="module")
def wrenches(arm):
    """A random motion, torques, and the wrenches at wrist and base."""
    _, model, data = arm
    motion = np.random.default_rng(3).normal(size=(3, 12, 3))
    rows = []
    for q, qd, qdd in zip(*motion, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, qd, qdd
        mujoco.mj_inverse(model, data)
        rows.append(np.concatenate([data.qfrc_inverse, data.sensordata]))
    torques, wrist, base = np.split(np.array(rows), [3, 9], axis=1)
    data.qpos[:] = 0.0
    mujoco.mj_forward(model, data)
    return motion, torques, wrist, base


def test_wrist_sensor_measures_the_load(arm, wrenches):
    path, model, data = arm
    motion, torques, wrist, _ = wrenches
    rotation, offset = place(data, "wrist", "c")
    robot = jid.load_urdf(path, tip="c").with_sensor(rotation, offset)
    assert robot.body_names[robot.tip_body] == "sensor"
    bodies = [file_parameters(model, name) for name in BODIES]
    load = moved(file_parameters(model, "load"), *place(data, "wrist", "load"))
    motion = Motion(*np.concatenate([motion, np.zeros((3, 12, 6))], axis=2))
    forces = jid.Model(robot, (jid.RigidBodies(),)).inverse_dynamics(
        np.concatenate([*bodies, load]), motion
    )
    np.testing.assert_allclose(forces, np.hstack([torques, wrist]), atol=1e-12)


def test_base_sensor_measures_the_arm(arm, wrenches):
    path, model, data = arm
    motion, torques, _, base = wrenches
    rotation = data.site("base").xmat.reshape(3, 3)
    robot = jid.load_urdf(path, tip="load")
    robot = robot.with_sensor(rotation, data.site("base").xpos, under_base=True)
    load = file_parameters(model, "load")
    shift = model.body("load").pos
    bodies = [file_parameters(model, name) for name in BODIES]
    bodies[2] = bodies[2] + moved(load, np.eye(3), -shift)
    motion = Motion(*np.concatenate([np.zeros((3, 12, 6)), motion], axis=2))
    forces = jid.Model(robot, (jid.RigidBodies(),)).inverse_dynamics(
        np.concatenate(bodies), motion
    )
    # The base does not move: its gravity is a part of the sensor's bias.
    foot = model.body("base")
    origin = data.site("base").xpos
    weight = foot.mass[0] * np.array([0.0, 0.0, 9.81])
    moment = np.cross(data.body("base").xipos - origin, weight)
    constant = np.concatenate([weight @ rotation, moment @ rotation])
    np.testing.assert_allclose(
        forces, np.hstack([base - constant, torques]), atol=1e-12
    )


def test_a_load_behind_the_sensor_is_determined_alone(arm):
    path, *_ = arm
    robot = jid.load_urdf(path, tip="c").with_sensor()
    bodies = jid.base_parameters(jid.Model(robot, (jid.RigidBodies(),)))
    without = jid.base_parameters(
        jid.Model(jid.load_urdf(path, tip="c"), (jid.RigidBodies(),))
    )
    assert bodies.size == without.size + 10
    assert bodies.expressions[-10:] == bodies.names[-10:]
    terms = (jid.RigidBodies(), SensorBias(), SensorRotation())
    base = jid.base_parameters(jid.Model(robot, terms))
    assert base.size == bodies.size + 9
    assert base.names[-9:] == (
        *(f"b{name}4" for name in ("fx", "fy", "fz", "mx", "my", "mz")),
        *("rx4", "ry4", "rz4"),
    )
    assert base.units[-9:] == (*("N",) * 3, *("N m",) * 3, *("rad",) * 3)


def test_a_small_rotation_of_the_sensor_is_that_of_its_axes(arm, wrenches):
    """The column of each angle is the difference that turned axes make."""
    path, *_ = arm
    motion = Motion(*np.concatenate([wrenches[0], np.zeros((3, 12, 6))], axis=2))
    robot = jid.load_urdf(path, tip="c").with_sensor()
    load = np.array([1.35, 0.02, -0.03, 0.12, 0.03, 0.028, 0.006, 0.001, 0.002, 0.001])
    p = np.concatenate([np.zeros(30), load])
    columns = jid.Model(robot, (SensorRotation(load),)).regressor(motion)
    step = 1e-5
    for k, axis in enumerate(np.eye(3)):
        forces = []
        for sign in (1, -1):
            turn = Rotation.from_rotvec(sign * step * axis).as_matrix()
            axes = np.array(robot.axis)
            axes[-6:] = axes[-6:] @ turn.T
            turned = jid.Model(robot.replace(axis=axes), (jid.RigidBodies(),))
            forces.append(np.asarray(turned.inverse_dynamics(p, motion)))
        difference = (forces[0] - forces[1]) / (2 * step)
        np.testing.assert_allclose(columns[..., k], difference, atol=1e-7)


def test_driven_joints_feel_what_is_behind_the_sensor(tmp_path):
    """Also where joints follow others: as a known tool at the same place."""
    path = tmp_path / "arm.urdf"
    path.write_text(follower_arm("side branch").text)
    robot = jid.load_urdf(path, tip="l3")
    assert robot.followers
    behind = robot.with_sensor(position=(0.01, 0.02, 0.03))
    n = robot.joints
    motion = np.random.default_rng(1).normal(size=(3, 5, n))
    tool = {"mass": 2.0, "centre_of_mass": (0.1, 0.0, 0.2)}
    expected = jid.Model(robot.with_tool(**tool)).tool_forces(Motion(*motion))
    padded = Motion(*np.concatenate([motion, np.zeros((3, 5, 6))], axis=2))
    forces = jid.Model(behind.with_tool(**tool)).tool_forces(padded)
    np.testing.assert_allclose(forces[:, :n], expected, atol=1e-12)
    assert np.abs(forces[:, n:]).max() > 1.0


def test_refusals(arm):
    path, *_ = arm
    robot = jid.load_urdf(path)
    with pytest.raises(jid.InputError, match="`rotation` of the sensor"):
        robot.with_sensor(2 * np.eye(3))
    with pytest.raises(jid.InputError, match="already"):
        robot.with_sensor().with_sensor()
    with pytest.raises(jid.InputError, match="base"):
        robot.with_sensor(under_base=True).with_sensor(under_base=True)
    both = robot.with_sensor(under_base=True).with_sensor()
    assert both.numbers[-1] == len(both.driven) + 1
    assert dataclasses.replace(both).virtual == both.virtual


def test_base_sensor_identifies_the_arm_without_torques(arm, wrenches):
    """Friction of the joints is no force between arm and ground."""
    path, model, data = arm
    rotation = data.site("base").xmat.reshape(3, 3)
    robot = jid.load_urdf(path, tip="load")
    robot = robot.with_sensor(rotation, data.site("base").xpos, under_base=True)
    terms = (jid.RigidBodies(), SensorBias())
    base = jid.base_parameters(jid.Model(robot, terms))
    rng = np.random.default_rng(5)
    motion = np.concatenate([np.zeros((3, 300, 6)), rng.normal(size=(3, 300, 3))], 2)
    forces = np.zeros((300, 9))
    bias = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    for row, (q, qd, qdd) in zip(forces, np.moveaxis(motion, 0, 1), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[6:], qd[6:], qdd[6:]
        mujoco.mj_inverse(model, data)
        row[:6] = bias + data.sensordata[6:]
    mask = np.arange(9) < 6
    observations = jid.Observations.of(
        *motion, forces, sample_time=0.01, mask=np.tile(mask, (300, 1))
    )
    fit = jid.identify(base, observations)
    # What is not determined is the bias beside the weight of the base.
    predicted = fit.predict(
        Motion(*np.concatenate([np.zeros((3, 12, 6)), wrenches[0]], 2))
    )
    np.testing.assert_allclose(predicted[:, 6:], wrenches[1], atol=1e-6)
    assert not fit.undetermined
