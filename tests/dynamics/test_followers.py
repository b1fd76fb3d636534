"""Joints that follow others: the tree of Pinocchio, projected on the coordinates."""

import jax
import numpy as np
import pinocchio as pin
import pytest
from follower_arms import RELATIONS, follower_arm

import jaxid as jid
from jaxid.dynamics.model import SpatialModel
from jaxid.robot.forward_kinematics import (
    placements,
    tip_curvature,
    tip_jacobian,
    tip_placement,
)
from jaxid.robot.inertia import Inertia
from jaxid.robot.urdf import joint_parameters, urdf_parameters
from jaxid.workflow.robot_file import RobotFile

SAMPLES = 5


@pytest.fixture(params=RELATIONS)
def arm(request):
    return follower_arm(request.param)


@pytest.fixture
def path(arm, tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(arm.text)
    return file


def random_motion(arm, samples=SAMPLES):
    random = np.random.default_rng(1)
    shape = (3, samples, 4 - len(arm.relations))
    return jid.Motion(*random.uniform(-1.5, 1.5, shape))


def rows(arm, motion):
    """Projected regressors of Pinocchio, with the columns of our bodies in order."""
    data = arm.tree.createData()
    ratios, _ = arm.ratios
    bodies = [arm.tree.getJointId(name) - 1 for name in arm.names]
    tree_motion = arm.tree_motion((motion.q, motion.qd, motion.qdd))
    for q, qd, qdd in zip(*tree_motion, strict=True):
        full = pin.computeJointTorqueRegressor(arm.tree, data, q, qd, qdd)
        yield ratios.T @ full.reshape(4, 4, 10)[:, bodies].reshape(4, 40)


def pinocchio_parameters(arm):
    ids = [arm.tree.getJointId(name) for name in arm.names]
    return np.concatenate([arm.tree.inertias[i].toDynamicParameters() for i in ids])


def test_bodies_are_those_of_the_file(arm, path):
    robot = jid.load_urdf(path)
    assert robot.body_names == tuple(arm.names)
    assert robot.joints == 4 - len(arm.relations)
    ours = Inertia.from_parameters(urdf_parameters(path).reshape(-1, 10)).pinocchio
    np.testing.assert_allclose(np.ravel(ours), pinocchio_parameters(arm), atol=1e-12)


def test_regressor_forces_and_mass_matrix_are_projected_ones(arm, path):
    robot, p = jid.load_urdf(path), urdf_parameters(path)
    model, motion = jid.Model(robot, (jid.RigidBodies(),)), random_motion(arm)
    expected = np.array([x @ pinocchio_parameters(arm) for x in rows(arm, motion)])
    tolerance = {"rtol": 0, "atol": 1e-10 * np.abs(expected).max()}
    np.testing.assert_allclose(model.inverse_dynamics(p, motion), expected, **tolerance)
    theta = np.asarray(model.regressor(motion))
    np.testing.assert_allclose(theta @ p, expected, **tolerance)

    data, (ratios, _) = arm.tree.createData(), arm.ratios
    tree_q, _, _ = arm.tree_motion((motion.q, motion.qd, motion.qdd))
    matrices = []
    for q in tree_q:
        upper = np.triu(pin.crba(arm.tree, data, q))
        full = upper + np.triu(upper, 1).T
        matrices.append(ratios.T @ full @ ratios)
    np.testing.assert_allclose(model.mass_matrix(p, motion.q), matrices, **tolerance)

    # The spatial form is what JAX differentiates.
    spatial = SpatialModel(robot, tuple(t.spatial_form for t in model.terms))
    for k in range(SAMPLES):
        sample = [np.asarray(x[k]) for x in (motion.q, motion.qd, motion.qdd)]
        columns = spatial.columns(*map(jax.numpy.asarray, sample))
        np.testing.assert_allclose(columns, theta[k], atol=1e-12 * np.abs(theta).max())
        forces = spatial.forces(p, *map(jax.numpy.asarray, sample))
        np.testing.assert_allclose(forces, expected[k], **tolerance)
        inertia = spatial.inertia(p, jax.numpy.asarray(sample[0]))
        np.testing.assert_allclose(inertia, matrices[k], **tolerance)


def test_base_parameters_are_as_many_as_the_rank(arm, path):
    base = jid.base_parameters(jid.Model(jid.load_urdf(path), (jid.RigidBodies(),)))
    stacked = np.concatenate(list(rows(arm, random_motion(arm, 60))))
    norms = np.linalg.norm(stacked, axis=0)
    values = np.linalg.svd(stacked / np.where(norms > 1e-9, norms, 1.0))[1]
    assert base.size == np.count_nonzero(values > 1e-9 * values[0])
    assert not base.notes


@pytest.mark.parametrize("arm", ["before its leader"], indirect=True)
def test_gravity_is_the_slope_of_the_potential_energy(arm, path):
    robot, p = jid.load_urdf(path), urdf_parameters(path)
    model, motion = jid.Model(robot, (jid.RigidBodies(),)), random_motion(arm, 1)
    q = np.asarray(motion.q[0])
    slope = jax.grad(lambda x: model.potential(p, x))(jax.numpy.asarray(q))
    gravity = model.inverse_dynamics(p, q, 0 * q, 0 * q)
    np.testing.assert_allclose(slope, gravity, atol=1e-10)


def test_placements_and_their_derivatives(arm, path):
    robot, motion = jid.load_urdf(path), random_motion(arm)
    robot = robot.replace(tip_body=robot.body_names.index("j4"), tip_offset=np.zeros(3))
    tree_q, _, _ = arm.tree_motion((motion.q, motion.qd, motion.qdd))
    data = arm.tree.createData()
    ratios, _ = arm.ratios
    jacobian = tip_jacobian(robot, np.asarray(motion.q))
    last = arm.tree.getJointId("j4")
    for k, q in enumerate(tree_q):
        pin.computeJointJacobians(arm.tree, data, q)
        world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        expected = pin.getJointJacobian(arm.tree, data, last, world) @ ratios
        np.testing.assert_allclose(jacobian.slopes[k].T, expected, atol=1e-12)
        np.testing.assert_allclose(jacobian.position[k], data.oMi[last].translation)
        _, tip = tip_placement(robot, motion.q[k])
        np.testing.assert_allclose(tip, data.oMi[last].translation, atol=1e-12)
        rotations, _ = placements(robot, motion.q[k])
        np.testing.assert_allclose(
            rotations[robot.tip_body], data.oMi[last].rotation, atol=1e-12
        )


def test_limits_and_friction_of_followers_count_at_their_leaders(arm, path):
    robot, values = jid.load_urdf(path), joint_parameters(path)
    ratios, offsets = arm.ratios
    np.testing.assert_allclose(values["damping"], 0.5 * np.sum(ratios**2, axis=0))
    np.testing.assert_allclose(values["friction"], 0.25 * np.abs(ratios).sum(axis=0))
    claims = RobotFile(path).claims()
    joints = range(1, robot.joints + 1)
    np.testing.assert_allclose([claims[f"fv{i}"] for i in joints], values["damping"])
    np.testing.assert_allclose([claims[f"fc{i}"] for i in joints], values["friction"])
    assert "ks1" not in claims
    for ends in (robot.limits.position_min, robot.limits.position_max):
        positions = np.abs(np.diag(ends) @ ratios.T + offsets)
        own = np.abs(ratios.T) > 0
        np.testing.assert_allclose(np.where(own, positions, 0).max(axis=1).max(), 3.0)
    assert np.abs(ratios * robot.limits.velocity).max() == pytest.approx(2.0)


@pytest.mark.parametrize("arm", ["parallelogram", "half the speed"], indirect=True)
def test_identification_finds_the_bodies_of_the_file(arm, path):
    robot, p = jid.load_urdf(path), urdf_parameters(path)
    model = jid.Model(robot, (jid.RigidBodies(), jid.ViscousFriction()))
    p = np.concatenate([p, np.linspace(1.0, 2.0, robot.joints)])
    base, motion = jid.base_parameters(model), random_motion(arm, 60)
    observations = jid.Observations.of(
        *(motion.q, motion.qd, motion.qdd, model.inverse_dynamics(p, motion)),
        filter=jid.ZeroPhaseButterworth(4.0, force_cutoff=np.inf, margin=0.0),
        sample_time=0.1,
    )
    for estimator in (jid.estimators.LeastSquares(), jid.PhysicallyConsistent()):
        fit = jid.identify(base, observations, estimator)
        expected = np.asarray(base.from_standard(p))
        error = np.abs(fit.parameters - expected)
        assert error.max() < 1e-5 * np.abs(expected).max()
    assert len(fit.consistency.bodies) == 4


def test_second_derivatives_of_the_tip(arm, path):
    robot, motion = jid.load_urdf(path), random_motion(arm, 1)
    force, q = np.array([[1.0, -2.0, 0.5]]), np.asarray(motion.q)
    curvature = tip_curvature(tip_jacobian(robot, q), force, 0.0 * force)
    steps = 1e-6 * np.concatenate([np.eye(robot.joints), -np.eye(robot.joints)])
    slopes = tip_jacobian(robot, q + steps).slopes[:, :, :3] @ force[0]
    forward_slopes, backward_slopes = np.split(slopes, 2)
    differences = (forward_slopes - backward_slopes) / 2e-6
    np.testing.assert_allclose(curvature[0], differences, atol=1e-8)
