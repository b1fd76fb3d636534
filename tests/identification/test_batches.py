"""Batches give what one identification after the other gives."""

import collections
import math
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from virtual import left_out_in_turn, observations, standard_parameters

import jaxid as jid
from jaxid.arrays import in_parts
from jaxid.identification import many_data_sets
from jaxid.identification.batch_solution import MAX_CONDITION, BatchFit
from jaxid.identification.factors import Blocks
from jaxid.identification.identify import fit_problem
from jaxid.identification.many_data_sets import identify_batch
from jaxid.identification.uncertainty.blocks import bootstrap
from jaxid.program import sample_methods

SAMPLES = 150
WEIGHTS = np.array([0.3, 2.0])


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
    fields = [
        np.stack([getattr(o.motion, x) for o in sets]) for x in ("q", "qd", "qdd")
    ]
    return jid.Motion(*fields), np.stack([o.forces for o in sets])


def some_sets(base, count, **options):
    p = standard_parameters(base.model)
    return [
        observations(
            base.model, p, samples=SAMPLES, noise=0.3, seed=k, noise_seed=k, **options
        )
        for k in range(count)
    ]


def assert_same(fit, k, one):
    """Equal in units in which each parameter alone makes forces of length one."""
    size = 1.0 / np.asarray(one.naive_standard_deviations)
    error = (np.asarray(fit.parameters[k]) - one.parameters) * size
    assert np.linalg.norm(error) < 1e-10 * np.linalg.norm(one.parameters * size)
    np.testing.assert_allclose(
        fit.standard_deviations[k], one.naive_standard_deviations, rtol=1e-9
    )
    np.testing.assert_allclose(fit.residual_rms[k], one.residual_rms, rtol=1e-9)


def test_every_data_set_as_if_identified_alone(base, sets, arrays):
    fit = identify_batch(base, *arrays)
    assert np.asarray(fit.determined).all()
    for k in range(3):
        one = jid.identify(base, sets[k])
        assert_same(fit, k, one)
        scaled = one.condition_numbers.scaled
        assert scaled <= fit.condition_numbers[k] <= 1.001 * base.size * scaled
    x = np.arange(37.0)
    np.testing.assert_array_equal(in_parts(lambda part: 2.0 * part, x), 2.0 * x)


def test_columns_of_a_long_program_run_in_loops(base, sets, arrays, monkeypatch):
    """XLA would take minutes to compile those of a humanoid robot in one piece."""
    in_loops = sample_methods.FormLimits(piece=10, repetition=1)
    monkeypatch.setattr(sample_methods, "LIMITS", in_loops)
    monkeypatch.setattr(sample_methods, "_methods", collections.OrderedDict())
    assert base.joint_regressor.program.loops is not None
    fit = identify_batch(base, *arrays)
    for k in range(3):
        assert_same(fit, k, jid.identify(base, sets[k]))


def test_a_gpu_takes_all_data_sets_from_where_they_are(monkeypatch):
    x = jnp.arange(37.0)
    calls = []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    in_parts(calls.append, x)
    (given,) = calls
    assert given.unsafe_buffer_pointer() == x.unsafe_buffer_pointer()


def test_a_gpu_gets_and_gives_nothing_unasked(base, arrays, monkeypatch):
    """Every implicit way of an array to a device or from it is an error here."""
    device_arrays = jax.tree.map(jnp.asarray, arrays)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    # What is compiled may hold constants.
    expected = identify_batch(base, *device_arrays)
    with jax.transfer_guard("disallow"):
        found = identify_batch(base, *device_arrays)
    np.testing.assert_array_equal(found.parameters, expected.parameters)


def test_only_the_mark_of_good_data_sets_leaves_a_gpu(base, arrays, monkeypatch):
    """Without `jit`, too: estimates stay there, and nothing is computed one by one."""
    device_arrays = jax.tree.map(jnp.asarray, arrays)
    inputs = []

    class OnGpu:
        ndim = 2

        def __array__(self, *_, **__):
            pytest.fail("an array of the GPU was copied")

    def solve(_, data_sets):
        inputs.append(data_sets)
        marks = jnp.ones(3, bool)
        estimates = [OnGpu() for _ in range(6)]
        return BatchFit(*estimates[:4], marks, *estimates[4:])

    monkeypatch.setattr(many_data_sets, "in_parts", solve)
    fit = identify_batch(base, *device_arrays)
    assert isinstance(fit.parameters, OnGpu)
    assert inputs[0].motion is device_arrays[0]
    assert inputs[0].forces is device_arrays[1]


def test_honest_deviations_of_many_draws(base, sets, arrays):
    """The compiled sandwich is that of one identification after the other."""
    mask = np.ones((3, SAMPLES, 2), bool)
    mask[1, :40, 0] = mask[1, 100:, 1] = mask[2, 2:] = False
    slow = np.cumsum(np.random.default_rng(4).normal(size=(3, 3, SAMPLES, 2)), axis=2)
    draws = arrays[1][:, None] + 0.1 * slow
    dt = sets[0].sample_time
    weights = np.array([WEIGHTS, [1.5, 0.2], WEIGHTS])
    draws = np.where(mask[:, None], draws, np.nan)
    fit = identify_batch(base, arrays[0], draws, weights, mask=mask, row_time=dt)
    assert fit.parameters.shape == (3, 3, base.size)
    assert (
        np.median(fit.standard_deviations[:2] / fit.naive_standard_deviations[:2]) > 1.5
    )
    # Too few rows.
    assert list(fit.determined) == [True, True, False]
    assert np.isfinite(fit.parameters).all()
    assert np.isinf(fit.standard_deviations[2]).all()
    for k, draw in ((0, 0), (0, 2), (1, 1)):
        fields = {"mask": mask[k], "forces": np.nan_to_num(draws[k, draw])}
        estimator = jid.WeightedLeastSquares(jid.estimators.GivenWeights(weights[k]))
        one = jid.identify(base, sets[k].replace(**fields), estimator)
        np.testing.assert_allclose(
            fit.parameters[k, draw], one.parameters, rtol=1e-9, atol=1e-9
        )
        for name in ("standard_deviations", "naive_standard_deviations"):
            found = getattr(fit, name)[k, draw]
            np.testing.assert_allclose(found, getattr(one, name), rtol=1e-8)
        np.testing.assert_allclose(fit.dof[k, draw], one.uncertainty.dof, rtol=1e-8)


def test_draws_scatter_as_the_standard_deviations_say(base, arrays):
    m, forces = arrays[0][:1], arrays[1][:1]
    rng = np.random.default_rng(0)
    fit = identify_batch(
        base, m, forces[:, None] + 5 * rng.normal(size=(1, 3000, SAMPLES, 2))
    )
    scatter = np.std(fit.parameters[0], axis=0, ddof=1)
    expected = np.sqrt(np.mean(np.asarray(fit.standard_deviations[0]) ** 2, axis=0))
    np.testing.assert_allclose(scatter, expected, rtol=4 / np.sqrt(2 * 3000))


def test_data_sets_that_determine_too_little_are_marked_and_solved_like_alone(
    base, sets
):
    weak = [sets[0], some_sets(base, 1, still=(1,))[0], sets[2]]
    fit = identify_batch(base, *stacked(weak))
    assert list(fit.determined) == [True, False, True]
    one = jid.identify(base, weak[1])
    np.testing.assert_allclose(fit.parameters[1], one.parameters, rtol=1e-9, atol=1e-12)
    known = np.isfinite(one.naive_standard_deviations)
    assert 0 < known.sum() < base.size
    np.testing.assert_array_equal(np.isfinite(fit.standard_deviations[1]), known)
    motion, forces = stacked(weak)
    draws = identify_batch(base, motion, np.stack([forces, forces], axis=1))
    for draw in range(2):
        np.testing.assert_allclose(
            draws.parameters[:, draw], fit.parameters, rtol=1e-9, atol=1e-12
        )
        np.testing.assert_allclose(
            draws.standard_deviations[:, draw], fit.standard_deviations, rtol=1e-9
        )
    honest = identify_batch(base, *stacked(weak), row_time=sets[0].sample_time)
    np.testing.assert_allclose(
        honest.standard_deviations[1], one.standard_deviations, rtol=1e-6
    )


def test_nearly_dependent_columns_are_as_accurate_as_alone(base):
    sets = some_sets(base, 3)
    sets = [o.replace(motion=jax.tree.map(lambda x: 3e-5 * x, o.motion)) for o in sets]
    fit = identify_batch(base, *stacked(sets))
    one = jid.identify(base, sets[0])
    assert one.condition_numbers.scaled > MAX_CONDITION
    np.testing.assert_allclose(
        fit.standard_deviations[0], one.naive_standard_deviations, rtol=1e-5
    )
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

    both, deviations = jax.jit(jax.vmap(found))(jnp.stack([forces, 2 * forces]))
    np.testing.assert_allclose(both[0], expected.parameters, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(both[1], 2 * expected.parameters, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(deviations[0], expected.standard_deviations, rtol=1e-9)
    direction = np.random.default_rng(0).normal(size=forces.shape)
    gradient = jax.jit(jax.grad(lambda f: found(f)[0][1].sum()))(forces)
    step = found(forces + direction)[0] - expected.parameters
    np.testing.assert_allclose(jnp.vdot(gradient, direction), step[1].sum(), rtol=1e-8)


def test_a_gpu_solves_many_data_sets_at_once_without_callbacks(base):
    q, qd, qdd, forces = np.random.default_rng(0).normal(size=(4, 1000, 800, 2))

    def run(motion, forces):
        return identify_batch(base, motion, forces, WEIGHTS)

    traced = jax.jit(run).trace(jid.Motion(q, qd, qdd), forces)
    texts = {
        p: traced.lower(lowering_platforms=(p,)).as_text() for p in ("cpu", "cuda")
    }
    trips = {
        p: {int(n) for n in re.findall(r"dense<(\d+)> : tensor<i64>", texts[p])}
        for p in texts
    }
    assert 500 in trips["cpu"]
    assert 7 in trips["cuda"]
    assert 500 not in trips["cuda"]
    assert "callback" not in texts["cuda"]
    # Columns [samples, columns] of one group at a time are in memory.
    shapes = re.findall(r"tensor<([0-9x]+)xf64>", texts["cuda"])
    sizes = {math.prod(map(int, shape.split("x"))) for shape in shapes}
    columns = max(map(len, base.acting_columns))
    all_inputs = 7 * 143 * 800 * 2
    assert max(sizes) <= max(2**17 * columns, all_inputs)
    assert 1000 * 800 * columns > max(sizes)
    # Fences are divisions.
    assert texts["cuda"].count("stablehlo.divide") < 0.5 * texts["cpu"].count(
        "stablehlo.divide"
    )


def test_data_sets_of_a_mesh_of_devices(base, arrays):
    sets = jax.sharding.PartitionSpec("d")
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("d",))

    def found(motion, forces):
        return identify_batch(base, motion, forces, WEIGHTS).parameters

    run = jax.shard_map(found, mesh=mesh, in_specs=(sets, sets), out_specs=sets)
    np.testing.assert_allclose(
        jax.jit(run)(*arrays), found(*arrays), rtol=1e-9, atol=1e-12
    )


def test_derivatives_by_the_geometry_are_differences(base, sets, arrays):
    """Along one direction that changes offsets, axes and gravity."""
    motion, forces = arrays
    robot = base.model.robot
    geometry = {
        k: jnp.asarray(getattr(robot, k)) for k in ("offset", "axis", "gravity")
    }
    rng = np.random.default_rng(4)
    direction = {k: 0.1 * rng.normal(size=x.shape) for k, x in geometry.items()}

    def identified(values):
        changed = base
        for name, value in values.items():
            changed = eqx.tree_at(
                lambda b, name=name: getattr(b.model.robot, name), changed, value
            )
        fit = identify_batch(
            changed, motion, forces, WEIGHTS, row_time=sets[0].sample_time
        )
        return fit.parameters, fit.standard_deviations

    @jax.jit
    def along_direction(values):
        return jax.jvp(identified, (values,), (direction,))

    def identified_at(step):
        values = {k: x + step * direction[k] for k, x in geometry.items()}
        return [np.asarray(x) for x in along_direction(values)[0]]

    h = 1e-4
    _, tangents = along_direction(geometry)
    near = zip(identified_at(h), identified_at(-h), strict=True)
    far = zip(identified_at(2 * h), identified_at(-2 * h), strict=True)
    for tangent, (a, b), (c, d) in zip(tangents, near, far, strict=True):
        quotient = (8 * (a - b) - (c - d)) / (12 * h)
        np.testing.assert_allclose(
            tangent, quotient, atol=1e-6 * np.abs(quotient).max()
        )
    slopes = jax.jit(jax.grad(lambda values: identified(values)[0].sum()))(geometry)
    slope = sum(jnp.vdot(slopes[k], direction[k]) for k in geometry)
    np.testing.assert_allclose(slope, tangents[0].sum(), rtol=1e-9)


def test_all_numbers_of_a_model_may_be_inputs(base, arrays):
    found = eqx.filter_jit(identify_batch)(base, *arrays, WEIGHTS)
    known = identify_batch(base, *arrays, WEIGHTS)
    np.testing.assert_allclose(
        found.parameters, known.parameters, rtol=1e-9, atol=1e-11
    )
    with pytest.raises(ValueError, match="`weights` must be given"):
        eqx.filter_jit(identify_batch)(base, *arrays)


def test_robots_of_one_topology(base):
    own = base.model.robot
    robots = [
        own.replace(offset=np.asarray(own.offset) * length) for length in (1.0, 1.75)
    ]
    bases = [
        jid.base_parameters(jid.Model(robot, base.model.terms)) for robot in robots
    ]
    sets = [some_sets(alone, 1)[0] for alone in bases]
    fit = identify_batch(base, *stacked(sets), robots=robots)
    for k, (alone, o) in enumerate(zip(bases, sets, strict=True)):
        assert alone.indices == base.indices
        assert_same(fit, k, jid.identify(alone, o))


@pytest.mark.parametrize(
    ("samples", "options", "message"),
    [
        (slice(1, None), {}, "`motion` must have the shape"),
        (slice(None), {"mask": np.ones((3, 3, 2), bool)}, "`mask` must have the shape"),
        (slice(None), {"robots": [jid.robots.planar_arm(3)] * 3}, "topology of"),
    ],
)
def test_refusals(base, arrays, samples, options, message):
    with pytest.raises(ValueError, match=message):
        identify_batch(base, arrays[0], arrays[1][:, samples], **options)
    with pytest.raises(ValueError, match="4 rows"):
        identify_batch(base, *jax.tree.map(lambda x: x[:, :2], arrays))


def test_bootstrap_agrees_with_the_scatter_of_blocks(base):
    o = observations(
        base.model, standard_parameters(base.model), samples=12000, noise=2.0
    )
    order = np.random.default_rng(0).permutation(12000)
    o = o.replace(motion=o.motion[order], forces=o.forces[order])
    blocks = jid.RegressionProblem(base, [o], divisions=60).blocks
    with pytest.raises(ValueError, match="at least two blocks"):
        bootstrap(Blocks(blocks.parts[:1]), WEIGHTS, 50, jax.random.key(0))
    fit = fit_problem(
        jid.RegressionProblem(base, blocks=blocks), jid.estimators.LeastSquares()
    )
    draws = bootstrap(blocks, fit.weights, 4000, jax.random.key(0))
    np.testing.assert_allclose(
        np.mean(draws, axis=0), fit.parameters, atol=0.2 * fit.standard_deviations.max()
    )
    jackknife = np.std(left_out_in_turn(blocks, fit.weights), axis=0) * np.sqrt(59)
    np.testing.assert_allclose(np.std(draws, axis=0), jackknife, rtol=0.1)
