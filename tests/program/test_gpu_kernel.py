"""Programs as kernels of a GPU: values on a CPU, and what is compiled for CUDA."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental.pallas import triton
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from sample_functions import every_operation

import jaxid as jid
from jaxid.program import gpu_kernel, trace, xla_sample_blocks
from jaxid.program.gpu_kernel import BLOCK, in_kernel
from jaxid.program.sample_methods import in_numpy, program_of

ARM = jid.Model(jid.robots.planar_arm())
PANDA = jid.Model(jid.robots.panda())
KERNEL = "__gpu$xla.gpu.triton"


def numbers(model, samples, seed=0):
    """Parameters of bodies that can exist, and arrays of all samples."""
    n = model.robot.joints
    link = [2.0, 0.05, -0.02, 0.1, 0.05, 0.06, 0.04, 0.002, -0.001, 0.003]
    others = np.full(model.size - 10 * n, 0.3)
    arrays = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, samples, n))
    return np.concatenate([link * n, others]), *arrays


def error(found, expected):
    return np.abs(np.asarray(found) - expected).max() / np.abs(expected).max()


@pytest.fixture
def has_gpu(monkeypatch):
    """A process with a GPU, as far as the choice of a kernel is concerned."""
    monkeypatch.setattr(gpu_kernel, "has_triton", lambda: True)


@pytest.fixture
def on_gpu(has_gpu, monkeypatch):
    """What a GPU would compute, on the CPU: kernels are executed step by step."""

    def branch_of_gpu(*arrays, default, cpu=None, cuda=None):
        return (cuda or default)(*arrays)

    kernel = functools.partial(in_kernel, interpret=True)
    monkeypatch.setattr(xla_sample_blocks, "in_kernel", kernel)
    monkeypatch.setattr(jax.lax, "platform_dependent", branch_of_gpu)


METHODS = {
    "inverse_dynamics": ("forces", 3),
    "bias_forces": ("bias", 2),
    "forward_dynamics": ("acceleration", 3),
    "potential_energy": ("potential", 1),
}


@pytest.mark.parametrize(
    ("name", "samples"),
    [
        ("inverse_dynamics", 1),
        ("inverse_dynamics", BLOCK - 1),
        ("inverse_dynamics", BLOCK),
        *((name, 2 * BLOCK + 1) for name in METHODS),
    ],
)
def test_a_kernel_has_the_values_of_numpy_and_xla(name, samples, on_gpu):
    definition, count = METHODS[name]
    p, *arrays = numbers(ARM, samples)
    arrays = arrays[:count]
    found = jax.jit(lambda *x: getattr(ARM, name)(*x))(p, *arrays)
    expected = in_numpy(ARM, getattr(ARM, definition), *arrays, shared=(p,))
    assert found.shape == expected.shape
    assert error(found, expected) <= 1e-15
    definition = jax.vmap(getattr(ARM, definition), (None, *(0,) * count))
    assert error(found, definition(p, *map(jnp.asarray, arrays))) <= 1e-15


@pytest.mark.parametrize(("dtype", "bound"), [(np.float64, 1e-15), (np.float32, 2e-6)])
def test_seven_joints(dtype, bound, on_gpu):
    p, *arrays = (x.astype(dtype) for x in numbers(PANDA, 150))
    found = jax.jit(lambda *x: PANDA.inverse_dynamics(*x))(p, *arrays)
    assert found.dtype == dtype
    expected = in_numpy(PANDA, PANDA.forces, *arrays, shared=(p,))
    assert error(found, expected) <= bound


@pytest.mark.parametrize("samples", [1, 2 * BLOCK + 1])
def test_many_results_are_placed_by_a_second_kernel(samples, on_gpu):
    model = jid.Model(ARM.robot, (*ARM.terms, jid.ConstantOffset()))
    _, *arrays = numbers(model, samples)
    found = jax.jit(lambda *x: model.regressor(jid.Motion(*x)))(*arrays)
    assert model.robot.joints * model.size > gpu_kernel.MAX_OUTPUTS
    expected = in_numpy(model, model.columns, *arrays)
    assert found.dtype == np.float64
    assert error(found, expected) <= 1e-15
    # Constants are stored too: zeros, and the columns of the offsets.
    np.testing.assert_array_equal(np.asarray(found)[expected == 0.0], 0.0)
    np.testing.assert_array_equal(found[..., -2:], [np.eye(2)] * samples)


def test_every_operation():
    def function(x):
        return every_operation(x[0], x[1])

    x = np.random.default_rng(0).uniform(-1.5, 1.5, (2, 300))
    kernel = functools.partial(in_kernel, trace(function, (2,)), interpret=True)
    expected = jax.vmap(function)(jnp.asarray(x.T))
    np.testing.assert_allclose(jax.jit(kernel)(x.T), expected, rtol=3e-15)


def test_results_that_are_inputs_or_constants():
    program = trace(lambda p, x: jnp.stack([x[1], p[0], 2.0, x[1] * p[0]]), (1,), (2,))
    x = np.random.default_rng(0).normal(size=(5, 2))
    p = np.array([3.0])
    found = in_kernel(program, p, x, interpret=True)
    expected = np.stack([x[:, 1], np.full(5, 3.0), np.full(5, 2.0), 3.0 * x[:, 1]], 1)
    np.testing.assert_array_equal(found, expected)


def test_inputs_are_loaded_where_they_are_read():
    """All of them at the start would not fit into the registers of a thread."""
    p, *arrays = numbers(PANDA, 300)
    shapes = [p.shape, *[(7,)] * 3]
    kernel = functools.partial(in_kernel, program_of(PANDA, PANDA.forces, *shapes))
    (call,) = jax.make_jaxpr(kernel)(p, *arrays).eqns
    (call,) = call.params["call"].eqns
    names = [x.primitive.name for x in call.params["jaxpr"].eqns]
    loads = np.flatnonzero(np.array(names) == "get")
    assert len(loads) == 101
    assert names.index("cos") < loads[1]
    assert np.median(loads) > 0.3 * len(names)


def test_no_samples(on_gpu):
    p, *arrays = numbers(ARM, 0)
    assert jax.jit(lambda *x: ARM.inverse_dynamics(*x))(p, *arrays).shape == (0, 2)


def test_vectorised_calls(on_gpu):
    p, *arrays = numbers(ARM, 5)
    expected = ARM.inverse_dynamics(p, *arrays)
    scales = np.array([1.0, 2.0, 3.0])

    def forces(*x):
        return ARM.inverse_dynamics(*x)

    of_parameters = jax.jit(jax.vmap(forces, (0, None, None, None)))
    many = scales[:, None] * p
    assert error(of_parameters(many, *arrays), scales[:, None, None] * expected) < 1e-15
    of_samples = jax.jit(jax.vmap(forces, (None, 0, 0, 0)))
    assert error(of_samples(p, *arrays), expected) <= 1e-15
    # Blocks of samples with parameters of their own follow one after the other.
    p, *arrays = numbers(ARM, 300)
    expected = ARM.inverse_dynamics(p, *arrays)
    found = of_parameters(many, *arrays)
    assert error(found, scales[:, None, None] * expected) <= 1e-15


def test_derivatives(on_gpu):
    p, *arrays = numbers(ARM, 5)
    forces = in_numpy(ARM, ARM.forces, *arrays, shared=(p,))
    columns = in_numpy(ARM, ARM.columns, *arrays)

    def loss(p, *arrays):
        return 0.5 * jnp.sum(ARM.inverse_dynamics(p, *arrays) ** 2)

    slope = jax.jit(jax.grad(loss))(p, *arrays)
    assert error(slope, np.einsum("sjp,sj->p", columns, forces)) <= 1e-14
    values, slopes = jax.jit(
        lambda p, t: jax.jvp(lambda p: ARM.inverse_dynamics(p, *arrays), (p,), (t,))
    )(p, 2.0 * p)
    assert error(values, forces) <= 1e-14
    assert error(slopes, 2.0 * forces) <= 1e-14


# Since JAX 0.11 Triton lowers only for a GPU that is there.
lowers_without_gpu = pytest.mark.skipif(
    hasattr(triton, "get_gpu_info") and jax.default_backend() != "gpu",
    reason="this version of JAX compiles kernels only where a GPU is",
)


def compiled_for(platform, function, *arguments):
    traced = jax.jit(lambda *x: function(*x)).trace(*arguments)
    return traced.lower(lowering_platforms=(platform,)).as_text()


@lowers_without_gpu
@pytest.mark.parametrize("name", METHODS)
def test_a_gpu_gets_one_kernel(name, has_gpu):
    arguments = numbers(PANDA, 300)[: 1 + METHODS[name][1]]
    method = getattr(PANDA, name)
    text = compiled_for("cuda", method, *arguments)
    assert text.count(KERNEL) == 1
    # Nothing else: neither operations of the program nor other calls.
    assert text.count("custom_call") == 1
    assert "stablehlo.sine" not in text
    assert "stablehlo.optimization_barrier" not in text
    # A kernel reads and writes rows of samples as they are in memory.
    assert "stablehlo.transpose" not in text
    for platform in ("cpu", "tpu"):
        text = compiled_for(platform, method, *arguments)
        assert KERNEL not in text
        assert "stablehlo" in text


@lowers_without_gpu
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_gpu_gets_kernels_for_many_results(dtype, has_gpu):
    p, *arrays = (x.astype(dtype) for x in numbers(PANDA, 300))
    texts = {
        2: compiled_for("cuda", PANDA.mass_matrix, p, arrays[0]),
        7: compiled_for("cuda", lambda *x: PANDA.regressor(jid.Motion(*x)), *arrays),
    }
    for kernels, text in texts.items():
        assert text.count(KERNEL) == text.count("custom_call") == kernels
        for operation in ("transpose", "sine", "optimization_barrier", "concatenate"):
            assert f"stablehlo.{operation}" not in text


@lowers_without_gpu
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_xla_transposes_each_input_once(dtype):
    """Results that XLA computes are stacked in place, in either precision."""
    p, *arrays = (x.astype(dtype) for x in numbers(PANDA, 300))
    text = compiled_for("cuda", PANDA.mass_matrix, p, arrays[0])
    assert text.count("stablehlo.transpose") == 1
    text = compiled_for("cuda", lambda *x: PANDA.regressor(jid.Motion(*x)), *arrays)
    assert text.count("stablehlo.transpose") == 3
    assert "callback" not in text


@lowers_without_gpu
def test_samples_of_many_data_sets_are_one_kernel(has_gpu):
    p, *arrays = numbers(ARM, 600)
    sets = [x.reshape(3, 200, 2) for x in arrays]
    text = compiled_for(
        "cuda", jax.vmap(ARM.inverse_dynamics, (None, 0, 0, 0)), p, *sets
    )
    assert text.count(KERNEL) == 1


@lowers_without_gpu
def test_each_device_of_a_mesh_gets_one_kernel(has_gpu):
    p, *arrays = numbers(ARM, 300)
    spec = PartitionSpec("d")
    mesh = Mesh(np.array(jax.devices()[:1]), ("d",))
    on_mesh = jax.shard_map(
        functools.partial(ARM.inverse_dynamics, p),
        mesh=mesh,
        in_specs=spec,
        out_specs=spec,
    )
    assert compiled_for("cuda", on_mesh, *arrays).count(KERNEL) == 1
    divided = [jax.device_put(x, NamedSharding(mesh, spec)) for x in arrays]
    assert compiled_for("cuda", ARM.inverse_dynamics, p, *divided).count(KERNEL) == 1


@lowers_without_gpu
def test_each_device_of_a_mesh_places_its_results(has_gpu):
    _, *arrays = numbers(ARM, 300)
    spec = PartitionSpec("d")
    mesh = Mesh(np.array(jax.devices()[:1]), ("d",))

    def regressor(*arrays):
        return ARM.regressor(jid.Motion(*arrays))

    on_mesh = jax.shard_map(regressor, mesh=mesh, in_specs=spec, out_specs=spec)
    assert compiled_for("cuda", on_mesh, *arrays).count(KERNEL) == 2
    divided = [jax.device_put(x, NamedSharding(mesh, spec)) for x in arrays]
    assert compiled_for("cuda", regressor, *divided).count(KERNEL) == 2


def test_what_kernels_cannot_compute_is_left_to_xla(has_gpu, monkeypatch):
    joints = (7,)
    columns = program_of(PANDA, PANDA.columns, *[joints] * 3)

    def suits(program, samples=300, dtype="float64"):
        rows = jax.ShapeDtypeStruct((samples, 7), jnp.dtype(dtype))
        return gpu_kernel.suits_kernel(program, rows, rows, rows)

    assert suits(columns)
    assert suits(columns, dtype="float32")
    assert not suits(columns, dtype="bfloat16")
    # Places of results are numbers of 32 bits.
    most_samples = (2**31 - 1) // (7 * PANDA.size)
    assert suits(columns, most_samples)
    assert not suits(columns, most_samples + 1)
    assert not suits(trace(lambda q, qd, qdd: jnp.eye(7), *[joints] * 3))
    monkeypatch.setattr(gpu_kernel, "MAX_NODES", len(columns.nodes) - 1)
    assert not suits(columns)


class Device:
    def __init__(self, compute_capability):
        self.compute_capability = compute_capability


@pytest.mark.parametrize(
    ("capabilities", "expected"), [("9.0", True), ("8.0", True), ("7.5", False)]
)
def test_kernels_need_a_gpu_that_triton_knows(capabilities, expected, monkeypatch):
    devices = [Device("10.0"), Device(capabilities)]
    monkeypatch.setattr(jax, "devices", lambda backend: devices)
    assert gpu_kernel.has_triton.__wrapped__() is expected


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="a GPU is here")
def test_without_a_gpu_nothing_changes():
    assert not gpu_kernel.has_triton()
    p, *arrays = numbers(ARM, 300)
    text = compiled_for("cuda", ARM.inverse_dynamics, p, *arrays)
    assert KERNEL not in text
    assert text.count("stablehlo.optimization_barrier") == 1
