"""Parametrisations of inertia against Pinocchio and sums over point masses."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest

from jaxid.robot.inertia import Inertia


@pytest.fixture(scope="module")
def bodies():
    """Mass, centre and tensor of random clouds of points, and Pinocchio's bodies."""
    random = np.random.default_rng(0)
    points, masses = random.normal(size=(5, 8, 3)), random.uniform(0.1, 1.0, (5, 8))
    m = masses.sum(axis=1)
    centre = np.einsum("bk,bki->bi", masses, points) / m[:, None]
    r = points - centre[:, None]
    squares = np.einsum("bk,bki,bki->b", masses, r, r)[:, None, None] * np.eye(3)
    tensor = squares - np.einsum("bk,bki,bkj->bij", masses, r, r)
    return Inertia(m, centre, tensor), points, masses


def test_parameters_are_those_of_pinocchio(bodies):
    inertia, _, _ = bodies
    for k in range(5):
        oracle = pin.Inertia(inertia.mass[k], inertia.centre[k], inertia.tensor[k])
        expected = oracle.toDynamicParameters()
        np.testing.assert_allclose(inertia.pinocchio[k], expected, rtol=1e-12, atol=1e-14)
        pseudo = oracle.toPseudoInertia().toMatrix()
        np.testing.assert_allclose(inertia.pseudo_inertia[k], pseudo, rtol=1e-12, atol=1e-14)


def test_pseudo_inertia_is_the_second_moment_of_the_points(bodies):
    inertia, points, masses = bodies
    lifted = np.concatenate([points, np.ones((5, 8, 1))], axis=-1)
    expected = np.einsum("bk,bki,bkj->bij", masses, lifted, lifted)
    np.testing.assert_allclose(inertia.pseudo_inertia, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("way", ["parameters", "pinocchio", "pseudo_inertia", "log_cholesky"])
@pytest.mark.parametrize("to", [np.asarray, jnp.asarray])
def test_every_parametrisation_has_a_way_back(bodies, way, to):
    inertia = jax.tree.map(to, bodies[0])
    back = getattr(Inertia, f"from_{way}")(getattr(inertia, way))
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(inertia), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)


def test_every_log_cholesky_vector_is_a_body():
    body = Inertia.from_log_cholesky(0.3 * np.random.default_rng(1).normal(size=(50, 10)))
    assert (np.linalg.eigvalsh(body.pseudo_inertia) > 0).all()
    assert not any(jax.tree.map(lambda x, k=k: x[k], body).fault() for k in range(50))


def test_a_moved_body_is_that_of_pinocchio(bodies):
    inertia = jax.tree.map(lambda x: x[0], bodies[0])
    R, r = pin.exp3(np.array([0.3, -0.5, 0.2])), np.array([0.1, 0.2, -0.4])
    own = pin.Inertia(float(inertia.mass), inertia.centre, inertia.tensor)
    expected = own.se3Action(pin.SE3(R, r)).toDynamicParameters()
    np.testing.assert_allclose(inertia.moved(R, r).pinocchio, expected, atol=1e-13)
    J = inertia.tensor
    moments = [J[0, 0], J[0, 1], J[0, 2], J[1, 1], J[1, 2], J[2, 2]]
    np.testing.assert_array_equal(inertia.moments, moments)


def test_a_massless_body_has_its_centre_at_the_origin():
    np.testing.assert_array_equal(Inertia.from_parameters(np.zeros(10)).centre, 0.0)
