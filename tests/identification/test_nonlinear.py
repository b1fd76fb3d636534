"""Nonlinear friction: known shapes are found again, with honest uncertainties."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import virtual

import jaxid as jid
from jaxid.identification.friction_laws import ShapeSearch, select_shapes

# Two joints: compiling takes most of the time of these tests.
ROBOT = jid.robots.planar_arm(2)
TRUE_EPSILON, TRUE_SPEED = np.array([0.02, 0.05]), np.array([0.2, 0.3])
WLS = jid.estimators.LeastSquares()


def model(epsilon, speed=None, exponent=2.0):
    dry = jid.CoulombFriction(jid.terms.Tanh(epsilon))
    if speed is not None:
        dry = jid.terms.StribeckFriction(speed, exponent, jid.terms.Tanh(epsilon))
    terms = (jid.RigidBodies(), jid.ViscousFriction(), dry, jid.ConstantOffset())
    return jid.Model(ROBOT, terms)


TRUTH = model(TRUE_EPSILON, TRUE_SPEED)
P = virtual.standard_parameters(TRUTH, seed=3)
START = jid.base_parameters(model(0.04, 0.4))


def observations(**changed):
    return virtual.observations(TRUTH, P, **{"samples": 1500, **changed})


def search_of(base, *logs):
    return ShapeSearch.of(jid.RegressionProblem(base, logs), select_shapes(base))


def test_shapes_are_found_again_through_filters():
    """Exact forces, smoothed and decimated: the minimum is zero, at the truth."""
    o = observations(filter=jid.ZeroPhaseButterworth(5.0), every=4)
    fit = jid.identify_nonlinear_friction(START, o, WLS).fit
    stribeck = fit.base.model.terms[2]
    np.testing.assert_allclose(stribeck.transition.epsilon, TRUE_EPSILON, rtol=1e-3)
    np.testing.assert_allclose(stribeck.speed, TRUE_SPEED, rtol=1e-3)
    assert stribeck.exponent == 2.0
    assert fit.residual < 1e-4
    np.testing.assert_allclose(
        fit.parameters, START.from_standard(P), rtol=2e-3, atol=2e-3
    )


def test_shapes_are_found_by_name():
    o = virtual.observations(model(TRUE_EPSILON, TRUE_SPEED, 1.5), P, samples=1500)
    base = jid.base_parameters(model(TRUE_EPSILON, TRUE_SPEED, 2.0))
    fit = jid.identify_nonlinear_friction(base, o, WLS, shapes=("delta",)).fit
    stribeck = fit.base.model.terms[2]
    np.testing.assert_allclose(stribeck.exponent, 1.5, rtol=1e-3)
    np.testing.assert_array_equal(stribeck.speed, TRUE_SPEED)


def test_what_is_left_is_that_of_the_model_with_these_shapes():
    """Fixed columns once and friction anew: like everything at once; masks count."""
    mask = np.random.default_rng(5).random((375, 2)) < 0.7
    o = observations(
        filter=jid.ZeroPhaseButterworth(5.0, margin=0.0), every=4, mask=mask
    )
    logs = o, observations(samples=600, noise=0.3, seed=1)
    search, weights = search_of(START, *logs), np.array([1.0, 2.0])
    x = np.array([0.01, 0.02, 0.5, 0.2])
    c, left = search.fit(x, search.row_weights(weights))
    total = jid.RegressionProblem(search.shapes.set(START, x), logs).factors
    R, z = total.weighted(weights)
    np.testing.assert_allclose(c, np.linalg.lstsq(R, z)[0], rtol=1e-8, atol=1e-9)
    squares = total.residual_squares(np.asarray(c))
    np.testing.assert_allclose(np.sum(np.square(left), axis=0), squares, rtol=1e-9)


def test_the_jacobian_is_that_of_what_is_left():
    """Central differences; the linear parameters follow the shapes."""
    base = jid.base_parameters(model(0.04, 0.4, 1.3))
    search = search_of(base, observations(samples=600, noise=1.0))
    rows, x = search.row_weights(np.array([1.0, 2.0])), search.start
    left = jax.jit(lambda x: (rows * search.fit(x, rows)[1]).ravel())
    jacobian = jax.jit(jax.jacfwd(left))(x)
    steps = np.diag(1e-5 * x)
    differences = np.stack(
        [(left(x + s) - left(x - s)) / (2 * s.sum()) for s in steps], axis=1
    )
    np.testing.assert_allclose(
        jacobian, differences, atol=1e-6 * np.abs(differences).max()
    )


def test_the_search_can_be_mapped_and_differentiated():
    """Draws of the forces side by side; the derivative by forces is a difference's."""
    search = search_of(START, observations(samples=400))
    rng, weights = np.random.default_rng(6), np.ones(2)
    draw, change = search.forces + rng.normal(
        scale=[[[0.1]], [[0.01]]], size=(2, 400, 2)
    )
    change = change - search.forces

    def found(forces):
        return dataclasses.replace(search, forces=forces)(weights)[0]

    before, first, after = jax.jit(jax.vmap(found))(
        jnp.stack([draw - change, draw, draw + change])
    )
    alone, slopes = jax.jit(lambda a, b: jax.jvp(found, (a,), (b,)))(draw, change)
    np.testing.assert_allclose(first, alone, rtol=1e-6)
    np.testing.assert_allclose(slopes, 0.5 * (after - before), rtol=0.01)


def test_deviations_of_shapes_agree_with_their_scatter():
    """White noise on every row: the linearised problem predicts scatter over draws."""
    found = []
    for seed in range(14):
        search = search_of(
            START, observations(samples=1000, noise=0.3, noise_seed=seed)
        )
        found.append(eqx.filter_jit(search)(np.ones(2))[0])
    o = observations(samples=1000, noise=0.3)
    fit = jid.identify_nonlinear_friction(START, o, WLS)
    # 14 draws tell a deviation to 19 %: 1.6 is less than three of these.
    scatter = np.std(found, axis=0, ddof=1) / fit.shape_deviations
    assert np.abs(np.log(scatter)).max() < np.log(1.6)
    assert (
        np.abs(fit.shapes - [*TRUE_EPSILON, *TRUE_SPEED]) < 4 * fit.shape_deviations
    ).all()
    # Unknown shapes make the levels of friction less certain, a second recording more
    # certain.
    known = jid.identify(fit.fit.base, o, WLS)
    ratio = fit.fit.standard_deviations / known.standard_deviations
    assert (ratio > 1 - 1e-9).all()
    assert ratio[list(START.names).index("fs1")] > 1.1


@pytest.mark.parametrize(
    ("truth", "noise", "low", "high"),
    [(TRUTH, 0.05, 0.3, 1.0), (model(0.03), 0.5, -0.05, 0.05)],
)
def test_it_pays_where_friction_is_nonlinear_and_only_there(truth, noise, low, high):
    p = virtual.standard_parameters(truth, seed=3)
    o = virtual.observations(truth, p, samples=1000, noise=noise)
    linear = jid.base_parameters(model(0.03))
    whole = jid.identify_nonlinear_friction(START, o, WLS, linear=linear)
    assert whole.held_out.pays == (truth is TRUTH)
    assert low < whole.held_out.gain < high
    assert whole.better.base is (whole.fit if truth is TRUTH else whole.linear).base
    assert str(whole.held_out) in whole.better.notes
    assert ("vs2 = 0.3" in whole.better.notes[-1]) == (truth is TRUTH)


def test_what_cannot_be_searched_is_rejected():
    hard = jid.CoulombFriction(jid.terms.HardSign())
    with pytest.raises(ValueError, match="`StribeckFriction`"):
        select_shapes(jid.base_parameters(jid.Model(ROBOT, (jid.RigidBodies(), hard))))
    with pytest.raises(ValueError, match="`shapes`"):
        select_shapes(START, ("vs", "rate"))
    zero = dataclasses.replace(START, model=model(0.04, np.array([0.1, 0.0])))
    with pytest.raises(ValueError, match="`vs2`"):
        _ = select_shapes(zero).values
