"""Files and functions of robots whose joints follow others hold the same forces."""

import dataclasses

import numpy as np
import pinocchio as pin
import pytest
from export_samples import fit_of, motion, possible
from follower_arms import follower_arm
from mujoco_robot import MujocoRobot

import jaxid as jid
from jaxid.errors import InputError
from jaxid.program import evaluate
from jaxid.robot.urdf import urdf_parameters
from jaxid.simulation.friction_and_ripple import SmoothFriction
from jaxid.simulation.virtual import Sensors, VirtualRobot

SMALL = "follower of a follower"


@pytest.fixture(params=["half the speed", "slide on a turning joint", SMALL])
def arm(request):
    return follower_arm(request.param)


@pytest.fixture
def source(arm, tmp_path):
    file = tmp_path / "source.urdf"
    file.write_text(arm.text)
    return file


@pytest.fixture
def fit(source):
    model = jid.Model(jid.load_urdf(source))
    return fit_of(model, possible(model), full=True)


def bodies_alone(fit, m):
    """Forces of the bodies, without friction and rotors."""
    model, p = fit.base.model, fit.standard_parameters.copy()
    p[10 * model.robot.bodies :] = 0.0
    return np.asarray(model.inverse_dynamics(p, m))


def close(values, expected, tolerance=1e-10):
    np.testing.assert_allclose(
        values, expected, rtol=0, atol=tolerance * np.abs(expected).max()
    )


def test_the_urdf_keeps_followers_and_their_inertias(arm, fit, source, tmp_path):
    m = motion(fit.base.model.robot.joints, 6)
    path = jid.export_urdf(fit, source, tmp_path / "arm.urdf")
    tree = pin.buildModelFromUrdf(str(path))
    ratios, _ = arm.ratios
    samples = zip(*arm.tree_motion((m.q, m.qd, m.qdd)), strict=True)
    forces = [pin.rnea(tree, tree.createData(), *sample) for sample in samples]
    close(forces @ ratios, bodies_alone(fit, m))
    again = jid.load_urdf(path)
    assert again.followers == fit.base.model.robot.followers
    p = fit.standard_parameters[: 10 * again.bodies]
    np.testing.assert_allclose(urdf_parameters(path), p, atol=1e-12)
    # Friction of followers is that of their leaders.
    followers = [tree.idx_vs[tree.getJointId(f.name)] for f in again.followers]
    assert not tree.damping[followers].any()
    assert not tree.friction[followers].any()


def test_mjcf_holds_the_relation_as_an_equality(arm, fit, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    m = motion(fit.base.model.robot.joints, 6)
    path = jid.export_mjcf(fit, tmp_path / "arm.xml")
    model = mujoco.MjModel.from_xml_path(str(path))
    assert model.neq == len(arm.relations)
    flags = mujoco.mjtDisableBit
    model.opt.disableflags |= flags.mjDSBL_CONSTRAINT | flags.mjDSBL_DAMPER
    model.dof_armature[:] = 0.0
    data, forces = mujoco.MjData(model), []
    places = [model.joint(name).qposadr[0] for name in arm.tree.names[1:]]
    for sample in zip(*arm.tree_motion((m.q, m.qd, m.qdd)), strict=True):
        data.qpos[places], data.qvel[places], data.qacc[places] = sample
        mujoco.mj_inverse(model, data)
        forces.append(data.qfrc_inverse[places])
    ratios, _ = arm.ratios
    close(forces @ ratios, bodies_alone(fit, m))
    again = jid.load_mjcf(path)
    assert again.body_names == tuple(arm.names)
    rigid = jid.Model(again, (jid.RigidBodies(),))
    close(rigid.inverse_dynamics(urdf_parameters(path), m), bodies_alone(fit, m))


def test_feed_forward_and_saved_model_are_the_fit(fit, tmp_path):
    m = motion(fit.base.model.robot.joints, 6)
    expected = np.asarray(fit.predict(m))
    program = jid.export.torque_program(fit)
    values = np.asarray(
        evaluate(program, *(np.asarray(x).T for x in (m.q, m.qd, m.qdd)))
    )
    close(values.T, expected)
    again = jid.load_fit(fit.save(tmp_path / "model.json"))
    close(again.predict(m), expected, 1e-14)
    assert again.base.model.robot.followers == fit.base.model.robot.followers


def test_a_file_with_another_relation_is_refused(fit, source, tmp_path):
    robot = fit.base.model.robot
    followers = [
        dataclasses.replace(follower, factor=2.0 * follower.factor)
        for follower in robot.followers
    ]
    model = jid.Model(robot.replace(followers=tuple(followers)))
    other_fit = fit_of(model, possible(model), full=True)
    with pytest.raises(InputError, match="<mimic>"):
        jid.export_urdf(other_fit, source, tmp_path / "arm.urdf")


@pytest.mark.parametrize("arm", [SMALL], indirect=True)
def test_a_virtual_robot_follows_its_own_model_but_mujoco_is_refused(fit):
    robot = fit.base.model.robot
    terms = (jid.RigidBodies(),)
    values = fit.standard_parameters[: 10 * robot.bodies]
    still = np.zeros(robot.joints)
    virtual = VirtualRobot(
        robot=robot,
        terms=terms,
        values=values,
        friction=SmoothFriction(still, still),
        sensors=Sensors(1e-9, still, still),
    )
    m = motion(robot.joints, 6)
    close(virtual.forces(m), bodies_alone(fit, m))
    plant = virtual.plant(1e-3)
    plant.start(m.q[0], m.qd[0], 0.0 * m.qdd[0])
    plant.step([0.0] * robot.joints)
    model = jid.Model(robot, terms)
    expected = model.forward_dynamics(values, m.q[0], m.qd[0], still)
    step_accelerations = np.asarray(plant.read())[2 * robot.joints :]
    np.testing.assert_allclose(step_accelerations, expected, rtol=0.1, atol=0.5)
    with pytest.raises(InputError, match="follows another joint"):
        MujocoRobot(virtual).forces(m)
