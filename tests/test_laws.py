"""Laws of friction and filters, and damaged files, by Hypothesis."""

import json
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import jaxid as jid
from jaxid.dynamics.terms import TERMS
from jaxid.errors import InputError

ARM = jid.robots.planar_arm(2, 0.4)
ODD = (
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.CoulombFriction(jid.terms.HardSign()),
    jid.terms.StribeckFriction(),
    jid.terms.StribeckFriction(0.3, exponent=1.3),
    jid.terms.TemperatureScaled(jid.ViscousFriction(), rate=0.02, temperature=40.0),
    *(term() for term in TERMS.values() if term.shares_friction),
)
# The second of these is an offset as well: with a tanh it pushes near standstill.
ASYMMETRIC = (
    jid.terms.AsymmetricViscousFriction(),
    jid.terms.AsymmetricCoulombFriction(jid.terms.HardSign()),
)
few = settings(max_examples=10)
seeds = st.integers(0, 1000)
# XLA takes subnormal numbers for zero.
speed = st.floats(-20.0, 20.0, allow_subnormal=False)
speeds = st.lists(speed, min_size=2, max_size=2).map(np.array)


def friction(term, seed, qd):
    """Forces of a law with random coefficients that none of its kind has below zero."""
    p = np.random.default_rng(seed).uniform(0.0, 3.0, len(term.parameters(ARM)))
    zero = jnp.zeros(2)
    return np.asarray(term.columns(ARM, zero, jnp.asarray(qd), zero)) @ p


@pytest.mark.parametrize("term", ODD, ids=lambda t: type(t).__name__)
@few
@given(seed=seeds, qd=speeds)
def test_symmetric_friction_is_odd(term, seed, qd):
    there, back = friction(term, seed, qd), friction(term, seed, -qd)
    np.testing.assert_allclose(back, -there, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("term", [*ODD, *ASYMMETRIC], ids=lambda t: type(t).__name__)
@few
@given(seed=seeds, qd=speeds)
def test_friction_takes_energy_on_every_joint(term, seed, qd):
    assert (friction(term, seed, qd) * qd >= 0.0).all()


@few
@given(
    seed=seeds,
    cutoff=st.floats(5.0, 60.0),
    order=st.integers(1, 4),
    shift=st.floats(-10.0, 10.0),
)
def test_a_zero_phase_filter_knows_no_direction_of_time(seed, cutoff, order, shift):
    filter = jid.ZeroPhaseButterworth(cutoff, order=order)
    x = np.random.default_rng(seed).standard_normal((900, 2))
    there, back = filter.smooth(x, 1e-3), filter.smooth(x[::-1], 1e-3)[::-1]
    edge = filter.low_pass(1e-3).memory() + filter.edge(1e-3)
    inner = slice(min(edge, 430), -min(edge, 430))
    np.testing.assert_allclose(back[inner], there[inner], atol=1e-3)
    moved = filter.smooth(x + shift, 1e-3)
    np.testing.assert_allclose(moved, there + shift, atol=1e-9 * (1 + abs(shift)))


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    base = jid.base_parameters(
        jid.Model(ARM, (jid.RigidBodies(), jid.ViscousFriction()))
    )
    series = jid.trajectories.random_fourier_series(ARM, omega=0.8, harmonics=2, seed=0)
    motion = series.motion(0.01 * np.arange(300))
    forces = base.model.inverse_dynamics(np.ones(base.model.size), motion)
    log = jid.Recording.of(motion.q, forces, sample_time=0.01)
    o = jid.observe(log, ARM, jid.ZeroPhaseButterworth(10.0))
    return jid.identify(base, o, jid.estimators.LeastSquares()).save(
        tmp_path_factory.mktemp("model") / "arm.json"
    )


@settings(max_examples=40)
@given(place=st.floats(0.0, 1.0), length=st.integers(0, 8), put=st.binary(max_size=8))
def test_a_model_file_is_the_one_that_was_written_or_refused(
    model_file, place, length, put
):
    good = model_file.read_bytes()
    start = int(place * len(good))
    data = good[:start] + put + good[start + length :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.json"
        path.write_bytes(data)
        try:
            fit, refused = jid.load_fit(path), None
        except ValueError as error:
            fit, refused = None, error
    if fit is None:
        assert isinstance(refused, InputError | OSError)
        assert "arm.json" in str(refused)
        return
    # Spaces between values mean nothing.
    assert json.loads(data) == json.loads(good)
    np.testing.assert_array_equal(fit.parameters, jid.load_fit(model_file).parameters)
