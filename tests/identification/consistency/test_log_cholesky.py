"""Log-Cholesky coordinates: every body that can exist, and no other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.consistency import LogCholesky, consistency_margin
from jaxid.robot.inertia import Inertia

BODIES = np.stack(
    [
        Inertia(3.0, [0.1, -0.2, 0.3], np.diag([0.3, 0.4, 0.5])).parameters,
        Inertia(
            0.5, [0.0, 0.0, -0.05], [[0.02, 1e-3, 0], [1e-3, 0.03, 0], [0, 0, 0.02]]
        ).parameters,
    ]
)


def test_bodies_are_found_again():
    np.testing.assert_allclose(
        LogCholesky.of(BODIES).parameters, BODIES, rtol=1e-12, atol=1e-15
    )
    np.testing.assert_allclose(
        LogCholesky.of(BODIES.ravel()).parameters, BODIES, rtol=1e-12
    )
    assert LogCholesky.of(BODIES[0]).parameters.shape == (10,)


def test_any_coordinates_are_a_body():
    x = np.random.default_rng(0).normal(0.0, 2.0, (1000, 10))
    p = np.asarray(LogCholesky(jnp.asarray(x)).parameters)
    assert (consistency_margin(p) > 0).all()
    assert (p[:, 0] > 0).all()
    assert all(
        (np.linalg.eigvalsh(x.tensor) > 0).all()
        for x in map(Inertia.from_parameters, p)
    )


def test_what_cannot_exist_is_refused():
    impossible = BODIES[0].copy()
    impossible[4] = 10.0
    for bodies in (impossible, np.zeros(10), np.ones(7)):
        with pytest.raises(jid.InputError, match="`bodies`"):
            LogCholesky.of(bodies)


def test_a_fit_through_a_rollout_stays_possible():
    """Gradient steps that leave the possible set where the parameters are free."""
    model = jid.Model(jid.robots.planar_arm(), (jid.RigidBodies(),))
    truth = LogCholesky.of(np.concatenate([BODIES[0], BODIES[0]]))
    forces = jnp.asarray(np.random.default_rng(1).normal(size=(30, 2)))

    def motion(chart):
        def step(state, tau):
            q, qd = state
            qd = qd + 0.01 * model.forward_dynamics(
                chart.parameters.ravel(), q, qd, tau
            )
            return (q + 0.01 * qd, qd), q

        return jax.lax.scan(step, (jnp.zeros(2), jnp.zeros(2)), forces)[1]

    measured = motion(truth)
    start = LogCholesky(truth.coordinates + 0.5)
    loss = jax.jit(
        jax.value_and_grad(lambda chart: jnp.sum((motion(chart) - measured) ** 2))
    )
    chart, values = start, []
    for _ in range(20):
        value, slope = loss(chart)
        values.append(float(value))
        size = jnp.linalg.norm(slope.coordinates)
        chart = LogCholesky(chart.coordinates - 0.05 * slope.coordinates / size)
    assert values[-1] < 0.5 * values[0]
    assert (consistency_margin(np.asarray(chart.parameters)) > 0).all()
