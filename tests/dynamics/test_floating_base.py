"""Robots with a floating base: the regressor of Pinocchio's free-flyer, and ranks."""

import re
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import trees

import jaxid as jid
from jaxid.dynamics.motion import floating_motion
from jaxid.export.mujoco_model import mjcf_text

ROBOTS = Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
# Ranks of the bodies of a dog and a humanoid (ANYmal C: 94, G1: 213).
RANKS = {
    "go2_description/urdf/go2.urdf": 94,
    "talos_data/robots/talos_reduced.urdf": 234,
}
SAMPLES = 4


def free_flyer(path: Path) -> pin.Model:
    text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", path.read_text())
    model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    model.gravity.linear = np.zeros(3)
    return model


@pytest.mark.parametrize("name", RANKS)
def test_regressor_is_that_of_a_free_flyer(name):
    if not (ROBOTS / name).exists():
        pytest.skip("the robots of example-robot-data are not installed")
    robot = jid.load_urdf(ROBOTS / name, floating=True)
    model = jid.Model(robot, (jid.RigidBodies(),))
    pinned = free_flyer(ROBOTS / name)
    data = pinned.createData()
    names = list(pinned.names)[2:]
    places = np.array([robot.joint_names.index(name) for name in names])
    rows = np.r_[range(6), places]
    bodies = np.r_[0, places - 5]

    rng = np.random.default_rng(1)
    n = len(names)
    q, qd, qdd = rng.normal(size=(3, SAMPLES, n))
    a, w, wd = 3 * rng.normal(size=(3, SAMPLES, 3))
    theta = model.regressor(floating_motion(q, qd, qdd, a, w, wd))
    theta = theta.reshape(SAMPLES, n + 6, n + 1, 10)[:, rows][:, :, bodies]
    order = places - 6
    pose = np.r_[0, 0, 0, 0, 0, 0, 1]
    for k in range(SAMPLES):
        velocities = np.r_[0, 0, 0, w[k], qd[k, order]]
        accelerations = np.r_[a[k], wd[k], qdd[k, order]]
        expected = pin.computeJointTorqueRegressor(
            pinned, data, np.r_[pose, q[k, order]], velocities, accelerations
        ).reshape(n + 6, n + 1, 10)
        expected = expected[:, :, trees.FROM_PINOCCHIO] * trees.SIGNS
        assert trees.relative(theta[k], expected) < 1e-12
    assert jid.base_parameters(model).size == RANKS[name]


def test_parameters_of_the_file_are_those_of_all_bodies():
    """Ten for the trunk, then ten for each leg body; virtual bodies have none."""
    path = ROBOTS / "go2_description/urdf/go2.urdf"
    if not path.exists():
        pytest.skip("the robots of example-robot-data are not installed")
    robot = jid.load_urdf(path, floating=True)
    p = jid.robots.urdf_parameters(path, floating=True)
    pinned = free_flyer(path)
    names = [jid.Model(robot).parameter_names[k] for k in range(len(p))]
    assert names[:2] == ["m0", "mx0"]
    assert names[10] == "m1"
    masses = p[::10]
    assert np.isclose(masses.sum(), sum(x.mass for x in pinned.inertias))
    assert np.isclose(masses[0], pinned.inertias[1].mass)
    # Friction and rotors belong to the driven joints alone.
    friction = [x for x in jid.Model(robot).parameter_names if x.startswith("fv")]
    assert friction == [f"fv{number}" for number in range(1, 13)]
    # Standing still on known forces, the force on the base is the weight.
    n = len(robot.driven)
    assert str(robot).strip().startswith(f"{robot.name}: 12 joints\n")
    zeros = np.zeros((1, n))
    up = np.array([[0.0, 0.0, 9.81]])
    still = np.zeros((1, 3))
    motion = floating_motion(zeros, zeros, zeros, up, still, still)
    model = jid.Model(robot, (jid.RigidBodies(),))
    assert np.isclose(model.inverse_dynamics(p, motion)[0, 2], 9.81 * masses.sum())


MJCF = """
<mujoco model="hopper"><worldbody><geom type="plane" size="1 1 0.1"/>
 <body name="trunk" pos="0 0 1"><freejoint/><geom size="0.1" mass="3"/>
  <body name="leg" pos="0 0 -0.1"><joint name="hip" axis="0 1 0" range="-2 2"/>
   <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="1"/></body>
 </body></worldbody></mujoco>
"""


def test_free_joint_of_an_mjcf_file(tmp_path):
    path = tmp_path / "hopper.xml"
    path.write_text(MJCF)
    robot = jid.load_urdf(path, floating=True)
    assert robot.body_names[5] == "trunk"
    assert robot.joint_names[6:] == ("hip",)
    assert np.allclose(jid.robots.urdf_parameters(path, floating=True)[::10], [3, 1])
    with pytest.raises(jid.InputError, match="base"):
        jid.load_urdf(path, floating=True, base="wheel")


def test_an_exported_robot_stands_on_its_feet_in_mujoco():
    mujoco = pytest.importorskip("mujoco")
    path = ROBOTS / "go2_description/urdf/go2.urdf"
    if not path.exists():
        pytest.skip("the robots of example-robot-data are not installed")
    feet = {f"{leg}_foot": jid.Sphere(0.022) for leg in ("FL", "FR", "RL", "RR")}
    robot = jid.load_urdf(path, floating=True, contacts=feet)
    p = jid.robots.urdf_parameters(path, floating=True)
    bodies = np.zeros((robot.bodies, 10))
    bodies[list(robot.solid_bodies)] = np.reshape(p, (-1, 10))
    spec = mujoco.MjSpec.from_string(mjcf_text(robot, bodies, {}))
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1])
    m = spec.compile()
    assert m.body_mass.sum() == pytest.approx(p[::10].sum())
    d = mujoco.MjData(m)
    pose = np.tile([0.0, 0.8, -1.6], 4)
    d.qpos[7:] = pose
    d.qpos[2] = 0.32
    for _ in range(2000):
        d.ctrl[:] = 60.0 * (pose - d.qpos[7:]) - 2.0 * d.qvel[6:]
        mujoco.mj_step(m, d)
    touching = {m.geom(c.geom2).name for c in d.contact[: d.ncon]}
    assert touching == {*feet}
    assert 0.25 < d.qpos[2] < 0.32
