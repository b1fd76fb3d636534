"""Limits as matrices: random, restored motions keep them at all times, and use them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxid.excitation.coefficient_limits import JointLimits
from jaxid.robot.limits_and_drives import Limits
from jaxid.trajectory.fourier import FourierBasis, RestToRestBasis
from jaxid.trajectory.spline import RestToRestSplineBasis

BASES = (FourierBasis(4, 1.1), RestToRestBasis(4, 1.1), RestToRestSplineBasis(12, 6.0))


@pytest.fixture(params=BASES, ids=lambda b: type(b).__name__)
def limits(request, arm):
    return JointLimits(arm, request.param)


def peaks(limits, x, samples=8000):
    """Largest relative excess of any limit, from dense samples and no envelope."""
    rows = limits.basis.rows(np.linspace(0.0, limits.basis.duration, samples))
    q, qd, qdd = (part @ np.asarray(x).T for part in rows[:3])
    own = limits.limits
    middle = (own.position_max + own.position_min) / 2
    use = (
        (q - middle) / (own.position_max - middle),
        qd / own.velocity,
        qdd / own.acceleration,
    )
    return np.max(np.abs(use)) - 1.0


def test_random_and_restored_motions_keep_limits_and_use_them(limits):
    fine = limits.grid(512)
    for seed in range(5):
        shape, place = jax.random.split(jax.random.key(seed))
        size = limits.scale.size
        draws = 3.0 * jax.random.normal(shape, (size,))
        y = fine.fill(draws, jax.random.uniform(place, (2,)), 1.0)
        assert -0.12 < peaks(limits, limits.coefficients(y)) <= 0.0
        # A motion that breaks its limits is brought back to them.
        held = fine.scale_into_limits(3.0 * y + 0.5)
        x = np.asarray(limits.coefficients(held))
        assert peaks(limits, x) <= 1e-12
        assert limits.use(x).max() <= 1.0 + 1e-9
        assert (limits.use(x).max(axis=0) > 0.9).all()


def test_unknown_limits_are_assumed_and_known_jerks_are_kept(arm):
    assert len(JointLimits(arm, BASES[0], Limits(2)).grid(64).kinds) == 3
    jerky = JointLimits(arm, BASES[0], Limits(2, jerk=[5.0, np.inf]))
    grid = jerky.grid(64)
    assert len(grid.kinds) == 4
    y = grid.scale_into_limits(jnp.ones(jerky.scale.size))
    assert jerky.use(jerky.coefficients(np.asarray(y)))[3, 0] <= 1.05
