"""What estimators, recordings and robots are not made of: one sentence each, when they are made."""

import inspect

import jax
import numpy as np
import pytest

import jaxid as jid

MADE = {
    "weights of zero": (lambda: jid.estimators.GivenWeights(np.zeros(2)), "not all zero, but are"),
    "weights below zero": (lambda: jid.estimators.GivenWeights([1.0, -1.0]), "none below zero"),
    "weights that are no number": (
        lambda: jid.estimators.GivenWeights([np.nan, 1.0]),
        "one finite number",
    ),
    "a share of all": (
        lambda: jid.estimators.Truncated(2.0),
        "`rcond` of `Truncated` must be",
    ),
    "a negative ridge": (
        lambda: jid.estimators.Ridge(-1.0),
        "`strength` of `Ridge` must be a finite number",
    ),
    "a ridge that is no number": (
        lambda: jid.estimators.Ridge(np.nan),
        "`strength` of `Ridge` must be",
    ),
    "a limit that is no number": (
        lambda: jid.estimators.Huber(np.nan),
        "`limit` of `Huber` must be a posit",
    ),
    "a limit of zero": (
        lambda: jid.estimators.Tukey(0.0),
        "`limit` of `Tukey` must be a positive number",
    ),
    "a negative torque": (
        lambda: jid.Drives(2, max_torques=[-5.0, 1.0]),
        "`max_torques` must be positive, but that of joint 1 is -5",
    ),
    "a zero beyond all": (
        lambda: jid.Drives(2, zero=[0.0, np.inf]),
        "`zero` must be finite, but that of joint 2 is inf",
    ),
    "complex angles": (
        lambda: jid.Recording.of(np.ones((20, 1)) * 1j, np.ones((20, 1)), sample_time=0.1),
        "`recording` holds complex numbers",
    ),
    "a negative gap": (
        lambda: jid.Recording.of(
            np.ones((20, 1)), np.ones((20, 1)), sample_time=0.1, largest_gap=-1
        ),
        "`largest_gap` must be above 1 sample time, but is -1",
    ),
}


@pytest.mark.parametrize(("make", "sentence"), MADE.values(), ids=MADE.keys())
def test_what_cannot_be_is_refused_where_it_is_made(make, sentence):
    with pytest.raises(ValueError, match=sentence):
        make()


def test_weights_go_through_jit_and_vmap():
    total = jax.jit(lambda w: jid.estimators.GivenWeights(w).weights.sum())
    assert total(np.zeros(2)) == 0.0
    made = jid.estimators.GivenWeights(np.ones((3, 2))[0])
    axes = jax.tree.map(lambda _: 0, made)
    many = jax.tree.map(lambda w: np.stack([0.0 * w, w]), made)
    sums = jax.vmap(lambda one: one.weights.sum(), in_axes=(axes,))(many)
    np.testing.assert_array_equal(sums, [0.0, 2.0])


def test_what_does_not_belong_together_is_named():
    robot = jid.robots.planar_arm(2)
    model = jid.Model(robot, (jid.ViscousFriction(), jid.ConstantOffset()))
    base = jid.base_parameters(model)
    t = 0.01 * np.arange(400.0)
    q = np.stack([np.sin(3 * t), np.cos(5 * t)], axis=1)
    forces = np.stack([np.cos(3 * t), np.sin(5 * t)], axis=1)
    recording = jid.Recording.of(q, forces, sample_time=0.01)
    observed = jid.observe(recording, robot, jid.ZeroPhaseButterworth(10.0))
    identify = inspect.unwrap(jid.identify)  # tests check annotations first, users do not
    with pytest.raises(TypeError, match="`observations`"):
        identify(base, recording)
    with pytest.raises(TypeError, match="`base` must be base parameters, but is a `Model`"):
        identify(model, observed)
    weights = jid.estimators.GivenWeights(np.ones(3))
    with pytest.raises(ValueError, match="one number for each of the 2 joints of `planar arm"):
        jid.identify(base, observed, jid.WeightedLeastSquares(weights))
    fit = jid.identify(base, observed, jid.estimators.LeastSquares())
    with pytest.raises(ValueError, match="`motion` must be of the 2 joints of `planar arm"):
        fit.predict(jid.Motion(*np.zeros((3, 5, 3))))
