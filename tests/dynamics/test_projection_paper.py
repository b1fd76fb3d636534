"""The package against Eqs. 1-12 as the paper words them."""

import jax
import jax.numpy as jnp
import newton_euler
import numpy as np
import projection_paper as paper
import pytest
import trees

from jaxid.dynamics import projection_equation
from jaxid.robot.inertia import inertia_tensor


@pytest.fixture(scope="module")
def case():
    """One sample of a tree with every kind of joint, and bodies on it."""
    tree = trees.mixed_tree(7)
    rng = np.random.default_rng(7)
    bodies = trees.random_bodies(rng, tree.joints)
    centred = (
        [b.mass for b in bodies],
        np.array([b.centre for b in bodies]),
        np.array([b.inertia for b in bodies]),
    )
    motion = tuple(jnp.asarray(x) for x in trees.random_motion(rng, tree.joints))
    return tree, trees.standard_parameters(bodies), centred, motion


@pytest.mark.parametrize("form", [paper.momentum_form, paper.matrix_form])
def test_forces_are_the_projected_momenta(case, form):
    tree, p, centred, motion = case
    expected = trees.compiled(lambda *x: form(tree, *centred, *x))(*motion)
    robot = tree.robot()
    found = trees.compiled(
        lambda *x: projection_equation.rigid_body_forces(robot, p, *x)
    )(*motion)
    assert trees.relative(found, expected) < 1e-13
    literal = newton_euler.inverse_dynamics(tree, p, *(np.asarray(x) for x in motion))
    assert trees.relative(expected, literal) < 1e-13


def test_regressor_is_the_sum_of_the_three_matrices(case):
    tree, _, _, motion = case
    expected = trees.compiled(lambda *x: paper.regressor(tree, *x))(*motion)
    robot = tree.robot()
    found = trees.compiled(
        lambda *x: projection_equation.rigid_body_regressor(robot, *x)
    )(*motion)
    assert trees.relative(found.reshape(tree.joints, -1), expected) < 1e-13


def test_projection_is_the_jacobian_of_velocities_by_velocities(case):
    """Eqs. 5 and 7 with the joint velocities below the fraction."""
    tree, _, _, (q, qd, _) = case
    robot = tree.robot()
    expected = trees.compiled(
        jax.jacfwd(lambda x: paper.origin_velocities(tree, q, x))
    )(qd)

    def jacobians(q):
        slopes = jnp.zeros((tree.joints, 6, tree.joints))
        for body, joint, row in projection_equation.partial_velocities(robot, q):
            slopes = slopes.at[body, :, joint].set(row)
        return slopes

    slope = trees.compiled(jacobians)(q)
    assert trees.relative(slope, expected) < 1e-14


def test_body_motions_are_derivatives_of_positions(case):
    """a = vd_o + w x v_o - g, w and wd of every body (Eqs. 6, 8)."""
    tree, _, _, (q, qd, qdd) = case

    def all_of(q, qd, qdd):
        rows, rates = paper.along(
            lambda x, xd: paper.origin_velocities(tree, x, xd), q, qd, qdd
        )
        weights = jnp.stack([R.T @ tree.gravity for R, _ in paper.frames(tree, q)])
        v, w = rows[:, :3], rows[:, 3:]
        return rates[:, :3] + jnp.cross(w, v) - weights, w, rates[:, 3:]

    robot = tree.robot()
    found = trees.compiled(lambda *x: projection_equation.body_motions(robot, *x))(
        q, qd, qdd
    )
    for mine, theirs in zip(
        zip(*found, strict=True), trees.compiled(all_of)(q, qd, qdd), strict=True
    ):
        assert trees.relative(jnp.stack(mine), theirs) < 1e-13


def test_body_regressor_is_eq_8_with_the_inertia_about_the_origin():
    """The wrench of a free body from its velocities, in the matrices of Eq. 8."""
    rng = np.random.default_rng(8)
    body = trees.random_bodies(rng, 1)[0]
    v, w, vd, wd, g = rng.normal(size=(5, 3))
    m, c = body.mass, body.centre
    C, W = (np.cross(np.eye(3), x) for x in (c, w))
    J_o = body.inertia + m * C @ C.T
    matrix = np.block([[m * np.eye(3), m * C.T], [m * C, J_o]])
    gyration = np.block([[W * m, W @ C.T * m], [C @ W * m, W @ J_o]])
    weight = np.concatenate([m * g, m * np.cross(c, g)])
    expected = matrix @ [*vd, *wd] + gyration @ [*v, *w] - weight
    a, w, wd = (jnp.asarray(x) for x in (vd + np.cross(w, v) - g, w, wd))
    found = projection_equation.body_regressor(a, w, wd) @ body.parameters
    assert trees.relative(found, expected) < 1e-14


def test_momentum_matrix_and_tensor_hold_the_products_with_a_minus():
    """Eq. 9: D = integral of y z, E of x z, F of x y."""
    rng = np.random.default_rng(9)
    body = trees.random_bodies(rng, 1)[0]
    w = jnp.asarray(rng.normal(size=3))
    j = body.parameters[4:]
    momentum = sum(
        m * np.cross(x, np.cross(w, x))
        for m, x in zip(body.masses, body.points, strict=True)
    )
    assert trees.relative(projection_equation.momentum_matrix(w) @ j, momentum) < 1e-14
    assert trees.relative(inertia_tensor(jnp.asarray(j)) @ w, momentum) < 1e-14
