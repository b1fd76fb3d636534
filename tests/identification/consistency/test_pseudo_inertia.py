"""Pseudo-inertias against clouds of points, and the laws of bodies that could exist."""

import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.consistency.pseudo_inertia import (
    ball,
    consistency_margin,
    inertial_parameters,
)


def test_it_is_the_integral_of_points():
    rng = np.random.default_rng(0)
    r, m = rng.normal(size=(8, 3)), rng.uniform(0.1, 1.0, 8)
    J = np.einsum("k,kij->ij", m, (r**2).sum(1)[:, None, None] * np.eye(3))
    J -= np.einsum("k,ki,kj->ij", m, r, r)
    body = [m.sum(), *(m @ r), J[0, 0], J[1, 1], J[2, 2], -J[1, 2], -J[0, 2], -J[0, 1]]
    points = np.column_stack([r, np.ones(8)])
    P = jid.pseudo_inertia(np.array(body))
    np.testing.assert_allclose(P, np.einsum("k,ki,kj->ij", m, points, points), rtol=1e-12)
    np.testing.assert_allclose(inertial_parameters(P), body, rtol=1e-12)


def test_the_order_is_that_of_tools():
    tool = jid.Tool(0, mass=2.0, centre_of_mass=(0.1, -0.2, 0.3), inertia=0.08 * np.eye(3))
    radius = np.sqrt(0.08 / 2.0 * 5 / 2)
    P = ball(np.array(2.0), np.array([0.1, -0.2, 0.3]), np.array(radius))
    np.testing.assert_allclose(jid.pseudo_inertia(tool.parameters), P, rtol=1e-12)


@pytest.mark.parametrize(
    ("moments", "possible"),
    [((1.0, 1.0, 1.9), True), ((1.0, 1.0, 2.1), False), ((0.1, 1.0, 1.0), True)],
)
def test_the_triangle_inequality_decides(moments, possible):
    body = np.array([5.0, 0.0, 0.0, 0.0, *moments, 0.0, 0.0, 0.0])
    assert (consistency_margin(body) > 0) == possible


def test_a_centre_of_mass_too_far_out_is_impossible():
    body = np.array([1.0, 0.5, 0.0, 0.0, 0.1, 0.2, 0.2, 0.0, 0.0, 0.0])
    assert consistency_margin(body) < 0
