"""Parametrisations of inertia against Pinocchio and sums over point masses."""

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest

from jaxid.robot.inertia import Inertia


@pytest.fixture(scope="module")
def inertia():
    """Mass, centre and tensor of random clouds of points."""
    random = np.random.default_rng(0)
    points, masses = random.normal(size=(5, 8, 3)), random.uniform(0.1, 1.0, (5, 8))
    m = masses.sum(axis=1)
    centre = np.einsum("bk,bki->bi", masses, points) / m[:, None]
    r = points - centre[:, None]
    squares = np.einsum("bk,bki,bki->b", masses, r, r)[:, None, None] * np.eye(3)
    return Inertia(m, centre, squares - np.einsum("bk,bki,bkj->bij", masses, r, r))


def test_parameters_are_those_of_pinocchio(inertia):
    for k in range(5):
        oracle = pin.Inertia(inertia.mass[k], inertia.centre[k], inertia.tensor[k])
        expected = oracle.toDynamicParameters()
        np.testing.assert_allclose(
            inertia.pinocchio[k], expected, rtol=1e-12, atol=1e-14
        )


@pytest.mark.parametrize("to", [np.asarray, jnp.asarray])
def test_parameters_have_a_way_back(inertia, to):
    inertia = jax.tree.map(to, inertia)
    back = Inertia.from_parameters(inertia.parameters)
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(inertia), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)


def test_a_moved_body_is_that_of_pinocchio(inertia):
    inertia = jax.tree.map(lambda x: x[0], inertia)
    R, r = pin.exp3(np.array([0.3, -0.5, 0.2])), np.array([0.1, 0.2, -0.4])
    peer = pin.Inertia(float(inertia.mass), inertia.centre, inertia.tensor)
    expected = peer.se3Action(pin.SE3(R, r)).toDynamicParameters()
    np.testing.assert_allclose(inertia.moved(R, r).pinocchio, expected, atol=1e-13)
    J = inertia.tensor
    moments = [J[0, 0], J[0, 1], J[0, 2], J[1, 1], J[1, 2], J[2, 2]]
    np.testing.assert_array_equal(inertia.moments, moments)


@pytest.mark.parametrize(
    "moments", [(0.1, 0.1, 0.3), (-0.2, 0.5, 0.6), (0.01, 0.5, 0.2), (-1.0, -1.0, -1.0)]
)
def test_no_possible_body_is_nearer_than_the_nearest(moments):
    R = pin.exp3(np.array([0.3, -0.5, 0.2]))
    claimed = Inertia(2.0, (0.1, 0.0, 0.2), R @ np.diag(moments) @ R.T)
    assert "cannot belong to a real body" in claimed.fault()
    nearest = claimed.nearest_possible()
    assert nearest.fault() == ""
    assert nearest.mass == 2.0
    assert nearest.centre.tolist() == [0.1, 0.0, 0.2]

    def second_moments(tensor):
        return 0.5 * np.trace(tensor) * np.eye(3) - tensor

    target = second_moments(claimed.tensor)
    distance = np.linalg.norm(second_moments(nearest.tensor) - target)
    random = np.random.default_rng(0)
    # Bodies around the nearest one, from masses at points.
    roots = np.linalg.cholesky(second_moments(nearest.tensor) + 1e-9 * np.eye(3))
    for change in 0.05 * random.normal(size=(200, 3, 3)):
        other = (roots + change) @ (roots + change).T
        assert np.linalg.norm(other - target) > distance - 1e-3


def test_a_possible_body_stays_as_it_is(inertia):
    inertia = jax.tree.map(lambda x: x[0], inertia)
    assert inertia.nearest_possible() is inertia
    rod = Inertia(1.0, (0.0, 0.0, 0.0), np.diag([0.0, 1.0, 1.0]))
    assert rod.nearest_possible() is rod


def test_a_massless_body_has_its_centre_at_the_origin():
    np.testing.assert_array_equal(Inertia.from_parameters(np.zeros(10)).centre, 0.0)
