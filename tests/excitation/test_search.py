"""Candidates and children: which survive, and which parents give them their joints."""

import jax
import numpy as np

from jaxid.excitation.feasible_candidates import (
    EXCESS_PENALTY,
    Candidates,
    evaluate,
)
from jaxid.excitation.search import crossover, draw_matings
from jaxid.trajectory.fourier import FourierBasis

BASIS = FourierBasis(3, 1.1)


def test_start_and_direction_of_a_period_do_not_matter(free):
    """Children rely on this: all joints retimed together give the same information."""
    x = free.random(jax.random.key(0))
    coefficients = free.limits.coefficients(np.asarray(x))
    scale = free.limits.scale
    retimed = [(coefficients @ T.T / scale).ravel() for T in BASIS.retimings()[::9]]
    values = evaluate(free, np.array([x, *retimed])).value
    np.testing.assert_allclose(values, values[0], atol=1e-9)


def test_each_joint_of_a_child_moves_as_in_a_parent(free, parents):
    matings = draw_matings(free, len(parents), np.random.default_rng(2))
    children = crossover(free, np.asarray(parents), matings)
    limits, maps = free.limits, BASIS.retimings()
    first = np.asarray(limits.coefficients(parents))
    foreign = 0
    for place, child in enumerate(np.asarray(limits.coefficients(children))):
        for joint, x in enumerate(child):
            if np.array_equal(x, first[place, joint]):
                continue
            foreign += 1
            others = np.delete(first[:, joint], place, axis=0)
            possible = np.einsum("rvw,ow->orv", maps, others).reshape(-1, len(x))
            assert np.abs(possible - x).max(axis=1).min() < 1e-9 * np.abs(x).max()
    assert 6 <= foreign < first.shape[0] * first.shape[1]
    compiled = jax.jit(lambda x: crossover(free, x, matings))(parents)
    np.testing.assert_allclose(compiled, children, atol=1e-12)
    # Limits hold for each joint alone: children keep them like their parents.
    assert (limits.use(limits.coefficients(np.asarray(children[0])))[:3] < 1.01).all()


def test_a_small_excess_does_not_outweigh_a_better_value():
    best = Candidates(
        np.zeros((3, 1)), np.array([-1.0, -1.5, -1.6]), np.array([-0.1, 0.01, 1.0])
    )
    assert list(best.order()) == [0, 1, 2]
    assert list(best.promising()) == [1, 0, 2]
    assert 0.01 * EXCESS_PENALTY < 0.5


def test_the_best_of_two_generations_survive_and_none_twice():
    parents = Candidates(
        np.arange(3.0)[:, None], np.array([-1.0, -2.0, -3.0]), np.array([-1.0, -1, 0.2])
    )
    children = Candidates(
        np.arange(10.0, 13.0)[:, None],
        np.array([-2.0, -1.5, np.inf]),
        np.array([-1.0, -1, np.inf]),
    )
    best = parents.survivors(children)
    assert list(best.x[:, 0]) == [1.0, 11.0, 0.0]
    assert list(best.value) == [-2.0, -1.5, -1.0]
    assert list(parents.survivors(parents).x[:, 0]) == [1.0, 0.0, 2.0]
