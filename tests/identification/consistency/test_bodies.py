"""Single bodies: pseudo-inertias against point clouds, and the nearest body."""

import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.consistency.pseudo_inertia import (
    consistency_margin,
    inertial_parameters,
)

BOUNDS = jid.consistency.BodyBounds(mass_max=10.0, radius=0.5)


def ball(mass, centre, radius):
    """Return the pseudo-inertia of a ball, by integrals over its volume."""
    second_moments = radius**2 / 5 * np.eye(3) + np.outer(centre, centre)
    centre = np.array(centre)[:, None]
    return mass * np.block([[second_moments, centre], [centre.T, np.eye(1)]])


BODY = inertial_parameters(ball(3.0, [0.0, 0.1, 0.2], 0.12))


def test_it_is_the_integral_of_points():
    rng = np.random.default_rng(0)
    r, m = rng.normal(size=(8, 3)), rng.uniform(0.1, 1.0, 8)
    J = np.einsum("k,kij->ij", m, (r**2).sum(1)[:, None, None] * np.eye(3))
    J -= np.einsum("k,ki,kj->ij", m, r, r)
    body = [m.sum(), *(m @ r), J[0, 0], J[1, 1], J[2, 2], -J[1, 2], -J[0, 2], -J[0, 1]]
    points = np.column_stack([r, np.ones(8)])
    P = jid.consistency.pseudo_inertia(np.array(body))
    np.testing.assert_allclose(
        P, np.einsum("k,ki,kj->ij", m, points, points), rtol=1e-12
    )
    np.testing.assert_allclose(inertial_parameters(P), body, rtol=1e-12)


def test_the_order_is_that_of_tools():
    tool = jid.Tool(
        0, mass=2.0, centre_of_mass=(0.1, -0.2, 0.3), inertia=0.08 * np.eye(3)
    )
    radius = np.sqrt(0.08 / 2.0 * 5 / 2)
    P = ball(2.0, [0.1, -0.2, 0.3], radius)
    np.testing.assert_allclose(
        jid.consistency.pseudo_inertia(tool.parameters), P, rtol=1e-12
    )


@pytest.mark.parametrize(
    ("first_moment", "moments", "possible"),
    [
        (0.0, (1.0, 1.0, 1.9), True),
        (0.0, (1.0, 1.0, 2.1), False),
        (0.0, (0.1, 1.0, 1.0), True),
        (2.5, (0.5, 1.0, 1.0), False),
    ],
)
def test_triangle_inequality_and_centre_of_mass_decide(first_moment, moments, possible):
    body = np.array([5.0, first_moment, 0.0, 0.0, *moments, 0.0, 0.0, 0.0])
    assert (consistency_margin(body) > 0) == possible


def test_a_body_moves_as_little_as_its_errors_allow():
    found, distance, _ = jid.consistency.consistent_body(
        BODY, 1e-4 * np.eye(10), BOUNDS
    )
    np.testing.assert_allclose(found, BODY, atol=1e-4)
    assert distance < 0.05
    wrong = BODY.copy()
    wrong[6] = -0.02
    covariance = np.diag([1e-4, *[1e-4] * 3, *[1e-6] * 2, 1e-2, *[1e-6] * 3])
    found, distance, _ = jid.consistency.consistent_body(wrong, covariance, BOUNDS)
    assert consistency_margin(found) > 0
    assert abs(found[4] - wrong[4]) < 5e-3
    shift = (found - wrong) / np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(distance, np.linalg.norm(shift), rtol=1e-6)
    with pytest.raises(ValueError, match="`covariance`"):
        jid.consistency.consistent_body(BODY, np.diag([1.0] * 9 + [-1.0]), BOUNDS)
