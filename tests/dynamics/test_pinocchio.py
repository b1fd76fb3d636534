"""The package against Pinocchio, on random trees."""

import jax
import numpy as np
import pinocchio as pin
import pytest
import trees

from jaxid.dynamics.model import Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import RigidBodies

BODIES = (RigidBodies(),)
GEOMETRIES = 7
SAMPLES = 3
# Five structures of 1 to 8 joints, seven geometries of each: 35 trees, with branches,
# several roots, and both kinds of joints.
STRUCTURES = [(1, 11), (2, 13), (4, 38), (6, 22), (8, 12)]


def _regressor(pinned: pin.Model, q, qd, qdd) -> np.ndarray:
    data = pinned.createData()
    n = pinned.nv
    columns = pin.computeJointTorqueRegressor(pinned, data, q, qd, qdd).reshape(
        n, n, 10
    )
    return (columns[:, :, trees.FROM_PINOCCHIO] * trees.SIGNS).reshape(n, 10 * n)


@pytest.mark.parametrize(("joints", "seed"), STRUCTURES)
def test_regressors_of_random_trees(joints, seed):
    """One structure with seven geometries, which are a batch axis here."""
    rng = np.random.default_rng(seed)
    parent, revolute = trees.structure(rng, joints)
    family = [
        trees.Tree(
            parent, revolute, *trees.geometry(rng, joints), rng.normal(size=3) * 9.81
        )
        for _ in range(GEOMETRIES)
    ]
    motion = trees.random_motion(rng, GEOMETRIES, SAMPLES, joints)
    template = family[0].robot()

    def regressor(axis, rotation, offset, gravity, *state):
        robot = template.replace(
            axis=axis, rotation=rotation, offset=offset, gravity=gravity
        )
        return Model(robot, BODIES).regressor(Motion(*state))

    stacked = (
        np.stack([getattr(t, what) for t in family])
        for what in ("axis", "rotation", "offset", "gravity")
    )
    found = np.asarray(trees.compiled(jax.vmap(regressor))(*stacked, *motion))
    for k, tree in enumerate(family):
        pinned = tree.pinocchio()
        expected = [
            _regressor(pinned, *(x[k, s] for x in motion)) for s in range(SAMPLES)
        ]
        assert trees.relative(found[k], np.array(expected)) < 1e-12


def test_forces_mass_matrix_bias_and_energies():
    tree = trees.bushy_tree(22)
    n = tree.joints
    rng = np.random.default_rng(23)
    bodies = trees.random_bodies(rng, n)
    p = trees.standard_parameters(bodies).ravel()
    q, qd, qdd = trees.random_motion(rng, 4, n)
    pinned = tree.pinocchio(bodies)
    model = Model(tree.robot(), BODIES)

    def each(function, *arrays):
        data = pinned.createData()
        return np.array([function(pinned, data, *x) for x in zip(*arrays, strict=True)])

    def crba(*x):
        upper = np.triu(pin.crba(*x))
        return upper + np.triu(upper, 1).T

    forces = model.inverse_dynamics(p, Motion(q, qd, qdd))
    assert trees.relative(forces, each(pin.rnea, q, qd, qdd)) < 1e-13
    assert trees.relative(model.mass_matrix(p, q), each(crba, q)) < 1e-13
    assert (
        trees.relative(model.bias_forces(p, q, qd), each(pin.nonLinearEffects, q, qd))
        < 1e-13
    )
    kinetic = each(pin.computeKineticEnergy, q, qd)
    assert trees.relative(model.kinetic_energy(p, q, qd), kinetic) < 1e-13
    potential = model.potential_energy(p, q)
    expected = each(pin.computePotentialEnergy, q)
    assert trees.relative(potential - potential[0], expected - expected[0]) < 1e-12


def test_parameters_convert_as_the_conventions_say():
    """docs/conventions.md: Pinocchio has (m, h, Ixx, Ixy, Iyy, Ixz, Iyz, Izz)."""
    body = trees.random_bodies(np.random.default_rng(24), 1)[0]
    m, mx, my, mz, A, B, C, D, E, F = body.parameters
    theirs = body.pinocchio().toDynamicParameters()
    assert trees.relative([m, mx, my, mz, A, -F, B, -E, -D, C], theirs) < 1e-14
