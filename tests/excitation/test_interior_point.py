"""The interior point method against scipy on convex problems whose limits bind."""

import jax
import numpy as np
import scipy.optimize

from jaxid.arrays import namespace
from jaxid.excitation import interior_point
from jaxid.excitation.coefficient_limits import JointLimits
from jaxid.excitation.interior_point_iterates import Evaluation, Stage
from jaxid.trajectory.fourier import FourierBasis

RANDOM = np.random.default_rng(0)


def problem(arm):
    """Limits, a wish outside of them, and how dear it is to be away from it."""
    limits = JointLimits(arm, FourierBasis(3, 1.1))
    size = limits.scale.size
    A, wish = RANDOM.standard_normal((size, size)), 1.5 * RANDOM.standard_normal(size)
    return limits, wish, 0.1 * A @ A.T + np.eye(size)


def solved(limits, objective, *stages, constraints=0):
    """Return iterates in NumPy, after a comparison with those in JAX; and the rows."""
    grid, size = limits.grid(64), limits.scale.size
    starts = 0.1 * RANDOM.standard_normal((3, size))

    def every(points):
        evaluations = [objective(y) for y in points]
        return Evaluation(
            *(namespace(points).stack(x) for x in zip(*evaluations, strict=True))
        )

    def run(y):
        states = interior_point.begin(grid, y, constraints)
        for bound, barrier, least, iterations in stages:
            stage = Stage(bound, barrier, least, iterations, penalty=100.0)
            states = interior_point.run(grid, every, states, stage)
        return states

    states, compiled = run(starts), jax.jit(run)(starts)
    np.testing.assert_allclose(
        compiled.evaluation.value, states.evaluation.value, rtol=1e-4
    )
    rows = np.zeros((*grid.c.shape, 2, limits.shape[1]))
    for j in range(2):
        rows[j, :, j] = grid.R[j]
    return states, rows.reshape(-1, size), grid.c.reshape(-1), grid.bound


def by_scipy(wish, H, G, c, bound, *more):
    return scipy.optimize.minimize(
        lambda y: (0.5 * (y - wish) @ H @ (y - wish), H @ (y - wish)),
        np.zeros(len(wish)),
        jac=True,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda y: bound - G @ y + c, "jac": lambda y: -G},
            {"type": "ineq", "fun": lambda y: bound + G @ y - c, "jac": lambda y: G},
            *more,
        ],
        options={"maxiter": 300, "ftol": 1e-12},
    )


def test_reaches_the_constrained_minimum_from_every_start(arm):
    limits, wish, H = problem(arm)

    def objective(y):
        away = y - wish
        none = np.zeros((0, len(y)))
        return Evaluation(0.5 * away @ H @ away, H @ away, none[:, 0], none)

    states, G, c, bound = solved(
        limits, objective, (2.0, 1.0, 1e-3, 40), (1.0, 1.0, 1e-8, 200)
    )
    best = by_scipy(wish, H, G, c, bound)
    assert best.success
    np.testing.assert_allclose(states.evaluation.value, best.fun, rtol=1e-4)
    assert (np.abs(states.y @ G.T - c) <= bound).all()


def curved(wish, H, radii):
    """The same within ellipsoids about places that are not inside of them all."""
    size = len(wish)
    places = 0.3 * RANDOM.standard_normal((len(radii), size))

    def objective(y):
        away, from_places = y - wish, y[None] - places
        return Evaluation(
            0.5 * away @ H @ away,
            H @ away,
            (from_places**2).sum(axis=1) / radii**2 - 1.0,
            2 * from_places / radii[:, None] ** 2,
        )

    return objective, places


def test_keeps_constraints_that_are_not_linear(arm):
    limits, wish, H = problem(arm)
    radii = np.array([1.4, 1.6, 1.8])
    objective, places = curved(wish, H, radii)
    stages = (1.0, 1e-1, 1e-3, 80), (1.0, 1e-3, 1e-8, 300)
    states, G, c, bound = solved(limits, objective, *stages, constraints=3)
    ball = {
        "type": "ineq",
        "fun": lambda y: 1 - ((y - places) ** 2).sum(1) / radii**2,
        "jac": lambda y: -2 * (y - places) / radii[:, None] ** 2,
    }
    best = by_scipy(wish, H, G, c, bound, ball)
    assert best.success
    assert best.fun > 1.02 * by_scipy(wish, H, G, c, bound).fun, "the ellipsoids bind"
    np.testing.assert_allclose(states.evaluation.value, best.fun, rtol=1e-4)
    assert states.evaluation.excess.max() <= 1e-6
    assert (np.abs(states.y @ G.T - c) <= bound).all()


def test_what_cannot_be_kept_is_exceeded_as_little_as_can_be(arm):
    limits, wish, H = problem(arm)
    radii = np.array([0.5, 0.6])
    objective, places = curved(wish, H, radii)
    stages = (1.0, 1.0, 1e-2, 100), (1.0, 1e-2, 1e-6, 400)
    states, G, c, bound = solved(limits, objective, *stages, constraints=2)

    def excess(y):
        return ((y - places) ** 2).sum(1) / radii**2 - 1

    least = scipy.optimize.minimize(
        lambda z: z[-1],
        np.append(np.zeros(len(wish)), 100.0),
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda z: bound - np.abs(G @ z[:-1] - c)},
            {"type": "ineq", "fun": lambda z: z[-1] - excess(z[:-1])},
        ],
        options={"maxiter": 300},
    )
    assert least.success
    assert least.fun > 0.5
    found = states.evaluation.excess.max(axis=1)
    np.testing.assert_allclose(found, least.fun, rtol=1e-2)
