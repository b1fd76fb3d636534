"""The public dynamics of many samples: by blocks, transformed, on all platforms."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trees import random_tree

import jaxid as jid
from jaxid.dynamics.motion import Motion
from jaxid.program import sample_methods
from jaxid.program.sample_methods import in_numpy, program_of, spatial_form
from jaxid.program.xla_sample_blocks import BLOCK_OF_PRODUCTS, BLOCK_ON_GPU

MODEL = jid.Model(jid.robots.planar_arm())
P = np.random.default_rng(0).uniform(0.5, 1.0, MODEL.size)


def motion(samples, joints=2, seed=1):
    q, qd, qdd = np.random.default_rng(seed).normal(size=(3, samples, joints))
    return Motion(q, qd, qdd)


def in_jax(x):
    return jax.tree.map(jnp.asarray, x)


@pytest.mark.parametrize("samples", [1, 2, 255, 256, 257, 700])
def test_blocks_of_any_number_of_samples(samples):
    x = motion(samples)
    given = x.q, x.qd, x.qdd
    forces = in_numpy(MODEL, MODEL.forces, *given, shared=(P,))
    columns = in_numpy(MODEL, MODEL.columns, *given)
    found = jax.jit(MODEL.inverse_dynamics)(P, in_jax(x))
    np.testing.assert_allclose(found, forces, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jax.jit(MODEL.regressor)(in_jax(x)), columns, atol=1e-12)
    weights = np.array([0.5, 2.0])
    rows = (weights[:, None] * columns).reshape(-1, MODEL.size)
    np.testing.assert_allclose(
        MODEL.gram(x, weights), rows.T @ rows, rtol=1e-11, atol=1e-10
    )


def test_no_samples():
    x = motion(0)
    assert jax.jit(MODEL.inverse_dynamics)(P, in_jax(x)).shape == (0, 2)
    assert MODEL.regressor(x).shape == (0, 2, MODEL.size)
    np.testing.assert_array_equal(MODEL.gram(x), np.zeros((MODEL.size, MODEL.size)))


def test_numpy_stays_in_numpy_and_jax_in_jax():
    x = motion(3)
    assert type(MODEL.inverse_dynamics(P, x)) is np.ndarray
    assert type(MODEL.regressor(motion(5000))) is np.ndarray
    assert isinstance(MODEL.inverse_dynamics(P, in_jax(x)), jax.Array)


def test_large_results_are_computed_in_parts(monkeypatch):
    monkeypatch.setattr(sample_methods, "MAX_SAMPLES_IN_NUMPY", 0)
    # Of 256 samples: the regressor of 700 has three parts, that of 1400 six.
    monkeypatch.setattr(sample_methods, "PART_NUMBERS", 1)
    method = sample_methods.method_of(MODEL, MODEL.columns, (2,), (2,), (2,))
    compiled_before = method.compiled_nonzeros._cache_size()
    x = motion(1400)
    expected = in_numpy(MODEL, MODEL.columns, x.q, x.qd, x.qdd)
    np.testing.assert_allclose(MODEL.regressor(x), expected, atol=1e-12)
    np.testing.assert_allclose(MODEL.regressor(x[:700]), expected[:700], atol=1e-12)
    pairs = Motion(*(a.reshape(2, 700, 2) for a in (x.q, x.qd, x.qdd)))
    columns = MODEL.regressor(pairs)
    assert type(columns) is np.ndarray
    np.testing.assert_allclose(columns.reshape(expected.shape), expected, atol=1e-12)
    # Arrays of JAX stay on their device, and bound to it or not.
    for device in (None, jax.devices()[-1]):
        placed = jax.device_put(in_jax(x), device)
        columns = MODEL.regressor(placed)
        assert columns.sharding == placed.q.sharding
        assert columns.committed == placed.q.committed
        np.testing.assert_allclose(columns, expected, atol=1e-12)
    # One compiled function serves all of a device.
    assert method.compiled_nonzeros._cache_size() <= compiled_before + 2


@pytest.mark.parametrize("samples", [3, 300])
def test_leading_axes_of_parameters_and_motion_broadcast(samples):
    many = P * np.array([1.0, 2.0, 3.0])[:, None, None]
    x = motion(samples)
    expected = MODEL.inverse_dynamics(P, x) * np.array([1.0, 2.0, 3.0])[:, None, None]
    assert MODEL.inverse_dynamics(many, x).shape == (3, samples, 2)
    for run in (MODEL.inverse_dynamics, jax.jit(MODEL.inverse_dynamics)):
        np.testing.assert_allclose(
            run(jnp.asarray(many), in_jax(x)), expected, rtol=1e-12
        )
        np.testing.assert_allclose(run(many, x), expected, rtol=1e-12)
    over_p = jax.jit(jax.vmap(MODEL.inverse_dynamics, (0, None)))
    np.testing.assert_allclose(over_p(many[:, 0], in_jax(x)), expected, rtol=1e-12)
    three = jax.tree.map(lambda a: jnp.stack([a] * 3), in_jax(x))
    over_both = jax.jit(jax.vmap(MODEL.inverse_dynamics))
    np.testing.assert_allclose(over_both(many[:, 0], three), expected, rtol=1e-12)
    single = jax.jit(jax.vmap(MODEL.inverse_dynamics, (None, 0)))
    np.testing.assert_allclose(single(P, in_jax(x)), expected[0], rtol=1e-12)


def test_parameters_that_are_constants_cost_nothing():
    """XLA folds a fence of constants only, and computes shared values many times."""

    def fences(function, *arguments):
        return jax.jit(function).lower(*arguments).compile().as_text().count(" divide(")

    with jax.default_device(jax.devices("cpu")[0]):
        x = in_jax(motion(512))
        passed = fences(MODEL.inverse_dynamics, P, x)
        assert passed == fences(lambda x: MODEL.inverse_dynamics(P, x), x) > 0


def own_divisions(name):
    """Divisions of the scalar program itself."""
    shapes = [(2,)] * 3
    method, shapes = {
        "inverse_dynamics": (MODEL.forces, [P.shape, *shapes]),
        "mass_matrix": (MODEL.inertia, [P.shape, (2,)]),
        "forward_dynamics": (MODEL.acceleration, [P.shape, *shapes]),
        "gram": (MODEL.columns, shapes),
    }[name]
    return program_of(MODEL, method, *shapes).counts.divisions


@pytest.mark.parametrize(
    "name", ["inverse_dynamics", "mass_matrix", "forward_dynamics", "gram"]
)
def test_a_gpu_gets_no_fences_and_no_host_callbacks(name):
    x = in_jax(motion(600))
    arguments = {
        "inverse_dynamics": (P, x),
        "mass_matrix": (P, x.q),
        "forward_dynamics": (P, x.q, x.qd, x.qdd),
        "gram": (x,),
    }[name]
    traced = jax.jit(getattr(MODEL, name)).trace(*arguments)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    # Quotients of the method itself: speeds over epsilon, and the solution for
    # accelerations.
    own = own_divisions(name)
    assert text.count("stablehlo.divide") == own
    assert "callback" not in text
    assert "callback" not in traced.lower(lowering_platforms=("cpu",)).as_text()
    # What is stacked is computed before, and what is multiplied is not stored.
    assert text.count("stablehlo.optimization_barrier") == (name != "gram")


def test_gram_stores_no_columns_of_all_samples():
    count = 2 * BLOCK_ON_GPU
    x = in_jax(motion(count))
    traced = jax.jit(MODEL.gram).trace(x)
    text = traced.lower(lowering_platforms=("cuda",)).as_text()
    shapes = re.findall(r"tensor<([0-9x]+)xf64>", text)
    assert {shape for shape in shapes if str(count) in shape.split("x")} == {
        f"{count}x2"
    }
    # On a CPU temporaries do not grow with the samples.
    sizes = []
    for samples in (2 * BLOCK_OF_PRODUCTS, 8 * BLOCK_OF_PRODUCTS):
        compiled = jax.jit(MODEL.gram).lower(x[:samples]).compile()
        sizes.append(compiled.memory_analysis().temp_size_in_bytes)
    assert sizes[1] == sizes[0]


@pytest.mark.parametrize("seed", range(4))
def test_the_spatial_form_is_the_definition(seed):
    robot = random_tree(seed, 7).robot()
    model = jid.Model(robot)
    p = jnp.asarray(np.random.default_rng(seed).normal(size=model.size))
    q, qd, qdd = jnp.asarray(np.random.default_rng(seed + 9).normal(size=(3, 7)))
    spatial = spatial_form(model)
    for name, given in (
        ("columns", (q, qd, qdd)),
        ("forces", (p, q, qd, qdd)),
        ("inertia", (p, q)),
    ):
        expected = np.asarray(getattr(model, name)(*given))
        found = np.asarray(getattr(spatial, name)(*given))
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


def test_a_robot_of_many_joints_moves_as_its_definition_says():
    """Beyond some joints the mass matrix is no scalar program."""
    robot = random_tree(5, 18).robot()
    model = jid.Model(robot, (jid.RigidBodies(),))
    p = np.tile([2.0, 0.1, 0.0, 0.2, 0.3, 0.3, 0.2, 0.0, 0.0, 0.0], 18)
    x = motion(2, 18)
    forces = model.inverse_dynamics(p, x)
    np.testing.assert_allclose(
        model.forward_dynamics(p, x.q, x.qd, forces), x.qdd, atol=1e-8
    )


def test_a_motion_and_its_arrays_give_the_same():
    x = motion(3)
    for name, arrays in (
        ("inverse_dynamics", (x.q, x.qd, x.qdd)),
        ("bias_forces", (x.q, x.qd)),
        ("kinetic_energy", (x.q, x.qd)),
    ):
        method = getattr(MODEL, name)
        np.testing.assert_array_equal(method(P, x), method(P, *arrays))
        with pytest.raises(jid.InputError, match=r"but 4 arrays"):
            method(P, x.q, x.qd, x.qdd, x.q)
    np.testing.assert_array_equal(
        MODEL.forward_dynamics(P, x, x.qdd), MODEL.forward_dynamics(P, x.q, x.qd, x.qdd)
    )


@pytest.mark.parametrize("samples", [8, 300])
def test_the_samples_of_a_mesh_of_devices(samples):
    """Branches and loops agree on differences along a mesh, of any argument."""
    model = jid.Model(jid.robots.planar_arm(1))
    p = P[: model.size]
    mesh = jax.sharding.Mesh(np.array(jax.devices()[:1]), ("d",))
    spec = jax.sharding.PartitionSpec("d")
    x = in_jax(motion(samples, 1))

    def on_mesh(function, spec_out=spec):
        run = jax.shard_map(function, mesh=mesh, in_specs=spec, out_specs=spec_out)
        return jax.jit(run)(x)

    def cost(x):
        return jnp.sum(model.inverse_dynamics(p, x) ** 2)

    found = on_mesh(lambda x: model.inverse_dynamics(p, x))
    np.testing.assert_allclose(found, model.inverse_dynamics(p, x), rtol=1e-12)
    np.testing.assert_allclose(on_mesh(model.regressor), model.regressor(x), atol=1e-12)
    sums = on_mesh(
        lambda x: jax.lax.psum(model.gram(x), "d"), jax.sharding.PartitionSpec()
    )
    np.testing.assert_allclose(sums, model.gram(x), rtol=1e-11, atol=1e-11)
    slopes, expected = on_mesh(jax.grad(cost)), jax.jit(jax.grad(cost))(x)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9), slopes, expected
    )


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float32])
def test_eager_results_have_the_precision_of_compiled_ones(dtype):
    x = jax.tree.map(lambda x: jnp.asarray(x, dtype), motion(3))
    p = jnp.asarray(P, dtype)
    compiled = jax.jit(MODEL.inverse_dynamics)(p, x)
    assert MODEL.inverse_dynamics(p, x).dtype == compiled.dtype == dtype


def test_a_long_chain_runs_in_loops_over_equal_parts(monkeypatch):
    in_loops = sample_methods.FormLimits(piece=100, repetition=1)
    monkeypatch.setattr(sample_methods, "LIMITS", in_loops)
    tree = random_tree(5, 6)
    model = jid.Model(tree.robot(), (jid.RigidBodies(), jid.ViscousFriction()))
    p = np.random.default_rng(1).normal(size=model.size)
    x = motion(300, joints=6)
    given = x.q, x.qd, x.qdd
    forces = in_numpy(model, model.forces, *given, shared=(p,))
    columns = in_numpy(model, model.columns, *given)
    assert program_of(model, model.columns, (6,), (6,), (6,)).loops is not None
    assert program_of(model, model.forces, p.shape, (6,), (6,), (6,)).loops is not None
    found = jax.jit(model.inverse_dynamics)(p, in_jax(x))
    np.testing.assert_allclose(found, forces, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(jax.jit(model.regressor)(in_jax(x)), columns, atol=1e-11)
    rows = columns.reshape(-1, model.size)
    np.testing.assert_allclose(model.gram(x), rows.T @ rows, rtol=1e-10, atol=1e-9)
    packed = jax.jit(lambda x: model.packed_regressor(x).values)(in_jax(x))
    eager = model.packed_regressor(x).values
    np.testing.assert_allclose(np.stack(packed), np.stack(eager), atol=1e-11)


def test_articulated_bodies_cause_the_accelerations_of_the_mass_matrix():
    """Many joints on a floating base, slides and branches, with rotors and friction."""
    virtual = tuple(range(6))
    tree = random_tree(7, 14)
    fields = {"revolute": (False,) * 3 + (True,) * 3 + tree.revolute[6:]}
    fields["parent"] = (*range(-1, 5), *(max(x, 5) for x in tree.parent[6:]))
    tree = dataclasses.replace(tree, **fields)
    robot = tree.robot(virtual=virtual, floating=True)
    model = jid.Model(robot)
    assert model.derived_program("acceleration", (model.size,), *[(14,)] * 3)
    p = np.zeros(model.size)
    bodies = len(robot.solid_bodies)
    p[: 10 * bodies] = np.tile([2.0, 0.1, 0.2, -0.1, 0.5, 0.6, 0.7, 0, 0, 0], bodies)
    p[10 * bodies :] = 0.3
    q, qd, forces = np.random.default_rng(2).normal(size=(3, 300, 14))
    q[:, list(virtual)] = 0.0
    bias = model.bias_forces(p, q, qd)
    expected = np.linalg.solve(model.mass_matrix(p, q), (forces - bias)[..., None])
    found = model.forward_dynamics(p, q, qd, forces)
    np.testing.assert_allclose(found, expected[..., 0], rtol=1e-9, atol=1e-9)
    inputs = jnp.asarray(q), jnp.asarray(qd), jnp.asarray(forces)
    compiled = jax.jit(lambda *x: model.forward_dynamics(p, *x))(*inputs)
    np.testing.assert_allclose(compiled, found, rtol=1e-9, atol=1e-9)


def test_coupled_drives_and_traced_geometry_keep_the_mass_matrix():
    robot = random_tree(7, 14).robot()
    reduction = np.eye(14)
    reduction[3, 2] = 0.5
    coupled = robot.replace(
        drives=dataclasses.replace(robot.drives, reduction=reduction)
    )
    terms = (jid.RigidBodies(), jid.terms.CoupledDrives())
    model = jid.Model(coupled, terms)
    shapes = (model.size,), (14,), (14,), (14,)
    assert model.derived_program("acceleration", *shapes) is None
    assert jid.Model(random_tree(7, 12).robot()).derived_program("acceleration") is None
