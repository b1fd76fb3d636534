"""The effect of coarse encoders is found without knowing their step."""

import numpy as np
import pytest

import jaxid as jid
from jaxid.identification.encoder_resolution import encoder_steps, resolution_note

STEP = 2 * np.pi / 2**11
ARM = jid.robots.planar_arm(2, 0.4)
BASE = jid.base_parameters(
    jid.Model(ARM, (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction()))
)
T = 0.002 * np.arange(5000)
MOTION = jid.trajectories.random_fourier_series(ARM, omega=0.7, seed=1).motion(T)
P = np.linspace(0.5, 1.5, BASE.size)
FORCES = np.asarray(BASE.inverse_dynamics(P, MOTION))


def fitted(angles, noise, seed=0):
    rng = np.random.default_rng(seed)
    forces = FORCES + noise * rng.normal(size=FORCES.shape)
    log = jid.Recording.of(angles, forces, time=T)
    rows = jid.observe(log, ARM, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10))
    estimator = jid.WeightedLeastSquares(jid.estimators.GivenWeights([1.0, 1.0]))
    return jid.identify(BASE, rows, estimator), log, rows


@pytest.mark.parametrize("step", [1e-4, STEP, 0.0])
@pytest.mark.parametrize("offset", [0.0, 0.1234567])
def test_the_step_is_found_in_numbers_as_files_print_them(step, offset):
    q = np.asarray(MOTION.q)
    rounded = step * np.round(q / step) + offset if step else q
    printed = np.vectorize(lambda x: float(f"{x:.9g}"))(rounded)
    log = jid.Recording.of(printed, FORCES, time=T)
    np.testing.assert_allclose(encoder_steps(log), step, rtol=1e-3)


def test_the_bias_is_that_of_many_encoders():
    q, found, told = np.asarray(MOTION.q), [], []
    for seed in range(12):
        zero = np.random.default_rng(seed).random(2)
        fit, log, rows = fitted((np.round(q / STEP + zero) - zero) * STEP, 0.0)
        exact = fitted(q, 0.0)[0]
        found.append(fit.parameters - exact.parameters)
        told.append(jid.resolution_bias(fit, log, rows))
    bias, expected = np.mean(told, axis=0), np.mean(found, axis=0)
    scatter = np.std(found, axis=0) / np.sqrt(12) + np.std(told, axis=0) / np.sqrt(12)
    large = np.abs(expected) > 5 * scatter
    assert large.any()
    np.testing.assert_allclose(bias[large], expected[large], rtol=0.35)


def test_only_encoders_that_matter_are_pointed_out():
    q = np.asarray(MOTION.q)
    coarse, fine = (fitted(s * np.round(q / s), 0.05) for s in (STEP, 2e-5))
    (said,) = resolution_note(*coarse)
    assert "the encoders are so coarse" in said
    assert resolution_note(*fine) == resolution_note(*fitted(q, 0.05)) == ()
