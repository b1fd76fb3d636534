"""The interior point method against scipy on convex problems whose limits bind."""

import jax.numpy as jnp
import numpy as np
import scipy.optimize

from jaxid.excitation.interior_point import InteriorPoint, Stage
from jaxid.excitation.limits import JointLimits
from jaxid.trajectory.basis import FourierBasis


def test_reaches_the_constrained_minimum_from_every_start(arm):
    limits = JointLimits.of(arm, FourierBasis(3, 1.1))
    grid = limits.grid(64)
    size = limits.scale.size
    random = np.random.default_rng(0)
    A, wish = random.standard_normal((size, size)), 1.5 * random.standard_normal(size)
    H = 0.1 * A @ A.T + np.eye(size)

    def objective(y, context):
        away = y - wish[None]
        return 0.5 * jnp.einsum("bi,ij,bj->b", away, H, away), away @ H

    solver = InteriorPoint(objective, grid, limits.still)
    state = solver.start(jnp.asarray(0.1 * random.standard_normal((3, size))))
    for stage in (Stage(2.0, 1.0, 1e-3, 40), Stage(1.0, 1.0, 1e-8, 200)):
        state = solver.run(state, stage, None)
    rows = np.zeros((*grid.c.shape, 2, limits.shape[1]))
    for j in range(2):
        rows[j, :, j] = grid.R[j]
    G, c = rows.reshape(-1, size), grid.c.reshape(-1)
    best = scipy.optimize.minimize(
        lambda y: (0.5 * (y - wish) @ H @ (y - wish), H @ (y - wish)),
        np.zeros(size),
        jac=True,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda y: grid.bound - G @ y + c, "jac": lambda y: -G},
            {"type": "ineq", "fun": lambda y: grid.bound + G @ y - c, "jac": lambda y: G},
        ],
        options={"maxiter": 300, "ftol": 1e-12},
    )
    assert best.success
    np.testing.assert_allclose(state.value, best.fun, rtol=1e-4)
    assert (np.abs(np.asarray(state.y) @ G.T - c) <= grid.bound).all()
