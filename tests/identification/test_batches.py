"""Batches give what one identification after the other gives."""

import gc

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from virtual import motion, observations, standard_parameters

import jaxid as jid
from jaxid.dynamics.dispatch import in_numpy
from jaxid.identification import normal_equations
from jaxid.identification.batches import identify_batch
from jaxid.identification.identify import fit_problem
from jaxid.identification.uncertainty.blocks import bootstrap

SAMPLES = 150
WEIGHTS = np.array([0.3, 2.0])
GIVEN = jid.WeightedLeastSquares(jid.estimators.GivenWeights(WEIGHTS))


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    robot = jid.robots.planar_arm(2, 0.4)
    limits = jid.Limits(force=[50.0, 8.0])
    return jid.base_parameters(jid.Model(robot.replace(limits=limits), terms))


@pytest.fixture(scope="module")
def sets(base):
    return some_sets(base, 3)


@pytest.fixture(scope="module")
def arrays(sets):
    return stacked(sets)


def stacked(sets):
    fields = [np.stack([getattr(o.motion, x) for o in sets]) for x in ("q", "qd", "qdd")]
    return jid.Motion(*fields), np.stack([o.forces for o in sets])


def some_sets(base, count, **options):
    p = standard_parameters(base.model)
    return [
        observations(base.model, p, samples=SAMPLES, noise=0.3, seed=k, noise_seed=k, **options)
        for k in range(count)
    ]


def assert_same(fit, k, one):
    """Equal in units in which each parameter alone makes forces of length one."""
    size = 1.0 / np.asarray(one.naive_standard_deviations)
    error = (np.asarray(fit.parameters[k]) - one.parameters) * size
    assert np.linalg.norm(error) < 1e-10 * np.linalg.norm(one.parameters * size)
    np.testing.assert_allclose(fit.standard_deviations[k], one.naive_standard_deviations, rtol=1e-9)
    np.testing.assert_allclose(fit.residual_rms[k], one.residual_rms, rtol=1e-9)


def test_every_data_set_as_if_identified_alone(base):
    sets = some_sets(base, 20)
    fit = identify_batch(base, *stacked(sets))
    assert np.asarray(fit.determined).all()
    for k in (0, 7, 15, 16, 19):
        one = jid.identify(base, sets[k])
        assert_same(fit, k, one)
        scaled = one.condition_numbers.scaled
        assert scaled <= fit.condition_numbers[k] <= 1.001 * base.size * scaled


def test_masked_rows_and_weights_of_each_data_set(base, sets, arrays):
    mask = np.random.default_rng(1).random((3, SAMPLES, 2)) < 0.7
    weights = np.random.default_rng(2).uniform(0.1, 2.0, (3, 2))
    m, forces = arrays
    fit = identify_batch(base, m, np.where(mask, forces, np.nan), weights, mask=mask)
    for k, o in enumerate(sets):
        estimator = jid.WeightedLeastSquares(jid.estimators.GivenWeights(weights[k]))
        assert_same(fit, k, jid.identify(base, o.replace(mask=mask[k]), estimator))


def test_honest_deviations_of_many_draws(base, sets, arrays):
    """The compiled sandwich is that of one identification after the other."""
    mask = np.ones((2, SAMPLES, 2), bool)
    mask[1, :40, 0] = mask[1, 100:, 1] = False
    m, forces = arrays[0][:2], arrays[1][:2]
    slow = np.cumsum(np.random.default_rng(4).normal(size=(2, 3, SAMPLES, 2)), axis=2)
    draws = forces[:, None] + 0.1 * slow
    dt = sets[0].sample_time
    fit = identify_batch(base, m, draws, WEIGHTS, mask=mask, row_time=dt)
    naive = identify_batch(base, m, draws, WEIGHTS, mask=mask)
    assert fit.parameters.shape == (2, 3, base.size)
    np.testing.assert_allclose(fit.naive_standard_deviations, naive.standard_deviations)
    assert np.median(fit.standard_deviations / fit.naive_standard_deviations) > 1.5
    for k, draw in ((0, 0), (0, 2), (1, 1)):
        fields = {"mask": mask[k], "forces": draws[k, draw]}
        one = jid.identify(base, sets[k].replace(**fields), GIVEN)
        np.testing.assert_allclose(fit.parameters[k, draw], one.parameters, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            fit.standard_deviations[k, draw], one.standard_deviations, rtol=1e-8
        )
        np.testing.assert_allclose(fit.dof[k, draw], one.uncertainty.dof, rtol=1e-8)


def test_long_data_sets_go_by_chunks(base, sets, arrays, monkeypatch):
    dt = sets[0].sample_time
    whole = identify_batch(base, *arrays, WEIGHTS)
    for at_once in (64, 80):
        monkeypatch.setattr(normal_equations, "AT_ONCE", at_once)
        normal_equations._compiled.cache_clear()
        parts = identify_batch(base, *arrays, WEIGHTS, row_time=dt)
        names = ("parameters", "naive_standard_deviations", "residual_rms", "condition_numbers")
        for name in names:
            np.testing.assert_allclose(getattr(whole, name), getattr(parts, name), rtol=1e-9)
    # Chunks are stretches of their own, as if a gap divided them.
    half = SAMPLES // 2
    one = jid.identify(base, sets[1].replace(segments=((0, half), (half, SAMPLES))), GIVEN)
    np.testing.assert_allclose(parts.standard_deviations[1], one.standard_deviations, rtol=1e-8)
    monkeypatch.undo()
    normal_equations._compiled.cache_clear()


def test_any_estimator_takes_batches(base, sets, arrays):
    mask = np.random.default_rng(1).random((3, SAMPLES, 2)) < 0.8
    m, forces = arrays
    draws = np.where(mask[:, None], np.stack([forces, 2.0 * forces], axis=1), np.nan)
    estimator = jid.estimators.IterativelyReweighted(jid.estimators.Tukey())
    dt = sets[0].sample_time
    fit = identify_batch(base, m, draws, mask=mask, estimator=estimator, row_time=dt)
    assert fit.parameters.shape == (3, 2, base.size)
    assert np.asarray(fit.determined).all()
    one = jid.identify(base, sets[1].replace(mask=mask[1]), estimator)
    np.testing.assert_allclose(fit.parameters[1, 0], one.parameters, rtol=1e-8)
    np.testing.assert_allclose(fit.standard_deviations[1, 0], one.standard_deviations, rtol=1e-8)
    np.testing.assert_allclose(fit.parameters[1, 1], 2 * one.parameters, rtol=1e-2)


def test_draws_scatter_as_the_standard_deviations_say(base, arrays):
    m, forces = arrays[0][:1], arrays[1][:1]
    rng = np.random.default_rng(0)
    fit = identify_batch(base, m, forces[:, None] + 5 * rng.normal(size=(1, 3000, SAMPLES, 2)))
    scatter = np.std(fit.parameters[0], axis=0, ddof=1)
    expected = np.sqrt(np.mean(np.asarray(fit.standard_deviations[0]) ** 2, axis=0))
    np.testing.assert_allclose(scatter, expected, rtol=4 / np.sqrt(2 * 3000))


def test_data_sets_that_determine_too_little_are_marked_and_solved_like_alone(base, sets):
    weak = [sets[0], some_sets(base, 1, still=(1,))[0], sets[2]]
    fit = identify_batch(base, *stacked(weak))
    assert list(fit.determined) == [True, False, True]
    one = jid.identify(base, weak[1])
    np.testing.assert_allclose(fit.parameters[1], one.parameters, rtol=1e-9, atol=1e-12)
    known = np.isfinite(one.naive_standard_deviations)
    assert 0 < known.sum() < base.size
    np.testing.assert_array_equal(np.isfinite(fit.standard_deviations[1]), known)
    assert np.isinf(fit.condition_numbers[1])
    few = np.ones((3, SAMPLES, 2), bool)
    few[0, 2:] = False
    fit = identify_batch(base, *stacked(sets), mask=few)
    assert list(fit.determined) == [False, True, True]
    assert np.isfinite(fit.parameters).all()
    assert np.isinf(fit.standard_deviations[0]).all()


def test_nearly_dependent_columns_are_as_accurate_as_alone(base):
    sets = some_sets(base, 2)
    sets = [o.replace(motion=jax.tree.map(lambda x: 3e-5 * x, o.motion)) for o in sets]
    fit = identify_batch(base, *stacked(sets))
    one = jid.identify(base, sets[0])
    assert one.condition_numbers.scaled > normal_equations.WELL_CONDITIONED
    np.testing.assert_allclose(fit.standard_deviations[0], one.naive_standard_deviations, rtol=1e-5)
    error = np.abs(np.asarray(fit.parameters[0]) - one.parameters)
    known = np.isfinite(one.naive_standard_deviations)
    assert (error[known] < 1e-3 * one.naive_standard_deviations[known]).all()


def test_under_transformations(base, sets, arrays):
    m, forces = arrays
    dt = sets[0].sample_time
    expected = identify_batch(base, m, forces, WEIGHTS, row_time=dt)

    def found(f):
        fit = identify_batch(base, m, f, WEIGHTS, row_time=dt)
        return fit.parameters, fit.standard_deviations

    def parameters(f):
        return identify_batch(base, m, f, WEIGHTS).parameters

    p, deviations = jax.jit(found)(jnp.asarray(forces))
    np.testing.assert_allclose(p, expected.parameters)
    np.testing.assert_allclose(deviations, expected.standard_deviations, rtol=1e-9)
    both = jax.vmap(parameters)(jnp.stack([forces, 2 * forces]))
    np.testing.assert_allclose(both[1], 2 * expected.parameters, rtol=1e-9)
    direction = np.random.default_rng(0).normal(size=forces.shape)
    gradient = jax.grad(lambda f: parameters(f)[1].sum())(jnp.asarray(forces))
    step = parameters(forces + direction) - expected.parameters
    np.testing.assert_allclose(jnp.vdot(gradient, direction), step[1].sum(), rtol=1e-8)


def test_robots_of_one_topology(base):
    own, rng = base.model.robot, np.random.default_rng(5)
    robots, forces = [], []
    m = jid.Motion(*(np.stack([x] * 2) for x in vars(motion(2, SAMPLES)).values()))
    for length in (0.4, 0.7):
        robots.append(own.replace(offset=np.asarray(own.offset) * length / 0.4))
        model = jid.Model(robots[-1], base.model.terms)
        p = standard_parameters(model)
        exact = in_numpy(model, model.forces, m.q[0], m.qd[0], m.qdd[0], shared=(p,))
        forces.append(exact + 0.1 * rng.normal(size=exact.shape))
    fit = identify_batch(base, m, np.stack(forces), WEIGHTS, robots=robots)
    for k, robot in enumerate(robots):
        alone = jid.base_parameters(jid.Model(robot, base.model.terms))
        assert alone.indices == base.indices
        one = identify_batch(alone, m[k : k + 1], forces[k][None], WEIGHTS)
        np.testing.assert_allclose(fit.parameters[k], one.parameters[0], rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m, f: {"forces": f[..., :1]}, "joints of"),
        (lambda m, f: {"forces": f[:, 1:]}, r"must have the shape \[datasets"),
        (
            lambda m, f: {"motion": jax.tree.map(lambda x: x[:, :2], m), "forces": f[:, :2]},
            "4 rows",
        ),
        (lambda m, f: {"mask": np.ones((3, 3, 2), bool)}, "`mask`"),
        (lambda m, f: {"robots": [jid.robots.planar_arm(3)] * 3}, "topology of"),
        (lambda m, f: {"weights": WEIGHTS, "estimator": GIVEN}, "`estimator`"),
    ],
)
def test_refusals(base, arrays, change, message):
    m, forces = arrays
    with pytest.raises(ValueError, match=message):
        identify_batch(base, **({"motion": m, "forces": forces} | change(m, forces)))


def test_bootstrap_agrees_with_the_scatter_of_blocks(base):
    o = observations(base.model, standard_parameters(base.model), samples=12000, noise=2.0)
    order = np.random.default_rng(0).permutation(12000)
    o = o.replace(motion=o.motion[order], forces=o.forces[order])
    blocks = jid.RegressionProblem(base, [o], divisions=60).blocks
    fit = fit_problem(jid.RegressionProblem(base, blocks=blocks), jid.estimators.LeastSquares())
    draws = bootstrap(blocks, fit.weights, 4000, jax.random.key(0))
    np.testing.assert_allclose(
        np.mean(draws, axis=0), fit.parameters, atol=0.2 * fit.standard_deviations.max()
    )
    left_out = [
        np.linalg.lstsq(*blocks.without(k).weighted(fit.weights), rcond=None)[0] for k in range(60)
    ]
    jackknife = np.std(left_out, axis=0) * np.sqrt(59)
    np.testing.assert_allclose(np.std(draws, axis=0), jackknife, rtol=0.1)


def test_bootstrap_refuses_what_it_cannot_answer(base, sets):
    still = some_sets(base, 1, still=(1,))
    for logs, message in (
        (sets[:1], "at least two blocks"),
        (still + sets[:1], "do not determine all parameters"),
    ):
        blocks = jid.RegressionProblem(base, logs, divisions=1).blocks
        with pytest.raises(ValueError, match=message):
            bootstrap(blocks, WEIGHTS, 50, jax.random.key(0))


def test_what_was_compiled_for_shapes_that_are_forgotten_is_given_back(base, arrays):
    client = jax.devices("cpu")[0].client
    normal_equations._compiled.cache_clear()
    gc.collect()
    identify_batch(base, *jax.tree.map(lambda x: x[:1, :-1], arrays), WEIGHTS)
    held = len(client.live_executables())
    normal_equations._compiled.cache_clear()
    gc.collect()
    assert len(client.live_executables()) < held
