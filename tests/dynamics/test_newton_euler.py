"""The package against Newton's and Euler's laws in plain NumPy."""

import newton_euler
import numpy as np
import pytest
import trees

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import RigidBodies
from jaxid.robot.inertia import Tool

BODIES = (RigidBodies(),)
TREE = trees.mixed_tree(0)
SAMPLES = 4


def _expected(tree, parameters, motion):
    return np.array(
        [
            newton_euler.inverse_dynamics(tree, parameters, *x)
            for x in zip(*motion, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def forces():
    """The package's forces of rigid bodies."""
    return Model(TREE.robot(), BODIES).inverse_dynamics


@pytest.mark.parametrize("tree", [TREE, trees.random_tree(5, 6)])
def test_regressor_times_parameters_is_newton_euler(tree):
    rng = np.random.default_rng(1)
    p = trees.standard_parameters(trees.random_bodies(rng, tree.joints))
    motion = trees.random_motion(rng, 6, tree.joints)
    theta = Model(tree.robot(), BODIES).regressor(Motion(*motion))
    assert trees.relative(theta @ p.ravel(), _expected(tree, p, motion)) < 1e-13


def test_forces_are_newton_euler_for_parameters_that_no_body_has(forces):
    """Linear in the parameters: also for negative masses and indefinite inertias."""
    rng = np.random.default_rng(2)
    p = rng.normal(size=(TREE.joints, 10))
    motion = trees.random_motion(rng, SAMPLES, TREE.joints)
    found = forces(p.ravel(), Motion(*motion))
    assert trees.relative(found, _expected(TREE, p, motion)) < 1e-12


def test_points_of_a_cloud_feel_newtons_law_alone(forces):
    """Without Euler's law or inertia tensors: each point mass on a path of its own."""
    rng = np.random.default_rng(3)
    bodies = trees.random_bodies(rng, TREE.joints)
    motion = trees.random_motion(rng, SAMPLES, TREE.joints)
    expected = np.zeros((SAMPLES, TREE.joints))
    for i, body in enumerate(bodies):
        for mass, x in zip(body.masses, body.points, strict=True):
            moments = [x @ x - x[0] ** 2, x @ x - x[1] ** 2, x @ x - x[2] ** 2]
            products = [x[1] * x[2], x[0] * x[2], x[0] * x[1]]
            alone = [None] * TREE.joints
            alone[i] = mass * np.array([1.0, *x, *moments, *products])
            expected += _expected(TREE, alone, motion)
    found = forces(trees.standard_parameters(bodies).ravel(), Motion(*motion))
    assert trees.relative(found, expected) < 1e-13


@pytest.mark.parametrize("point_mass", [False, True])
def test_tool_forces_are_newton_euler_of_the_tool(point_mass):
    rng = np.random.default_rng(4)
    load = trees.random_bodies(rng, 1)[0]
    inertia = None if point_mass else load.inertia
    tool = Tool(2, mass=load.mass, centre_of_mass=load.centre, inertia=inertia)
    motion = trees.random_motion(rng, SAMPLES, TREE.joints)

    m, c = load.mass, load.centre
    J = m * (c @ c * np.eye(3) - np.outer(c, c)) + (0.0 if point_mass else load.inertia)
    alone = [None] * TREE.joints
    alone[2] = np.array([m, *(m * c), *np.diag(J), -J[1, 2], -J[0, 2], -J[0, 1]])
    expected = _expected(TREE, alone, motion)

    found = Model(TREE.robot(tool=tool)).tool_forces(Motion(*motion))
    assert trees.relative(found, expected) < 1e-13
    assert np.abs(expected[:, :3]).min() > 0
    np.testing.assert_array_equal(found[:, 3:], 0.0)


def test_known_tool_is_apart_from_the_models_own_forces(forces):
    rng = np.random.default_rng(5)
    motion = Motion(*trees.random_motion(rng, SAMPLES, TREE.joints))
    load = trees.random_bodies(rng, 1)[0]
    tool = Tool(4, mass=load.mass, centre_of_mass=load.centre, inertia=load.inertia)
    carrying = Model(TREE.robot(tool=tool), BODIES)
    p = rng.normal(size=(TREE.joints, 10))
    heavier = p.copy()
    heavier[4] += load.parameters
    own = carrying.inverse_dynamics(p.ravel(), motion)
    np.testing.assert_array_equal(own, forces(p.ravel(), motion))
    total = own + carrying.tool_forces(motion)
    assert trees.relative(total, forces(heavier.ravel(), motion)) < 1e-13
