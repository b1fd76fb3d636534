"""Several devices give what one of them gives."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import patience
import pytest
from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.identification import long_logs

HERE = Path(__file__).resolve().parent
COMMON = """
import os, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxid as jid
from virtual import observations, standard_parameters

terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))
p = standard_parameters(base.model)
def write(fit):
    s = fit.naive_standard_deviations
    np.savez(sys.argv[1], p=fit.parameters, s=s, rows=fit.rows)
"""
LONG = """
assert len(jax.devices()) == 3
from jaxid.identification import long_logs
jid.RegressionProblem.compiled_samples, long_logs.PIECE = 1000, 2048
smooth, shares = jid.ZeroPhaseButterworth(30.0), []
o = observations(base.model, p, samples=20011, noise=0.3, filter=smooth, every=15)
write(jid.identify(base, o, jid.estimators.LeastSquares(), progress=shares.append))
assert shares == sorted(shares) and shares[-1] == 1.0
"""
DIVIDED = """
import re
from jax.sharding import Mesh, NamedSharding, PartitionSpec
motion = np.random.default_rng(0).normal(size=(3, 8, 60, 2))
forces = np.ones((8, 60, 2))
own = NamedSharding(Mesh(np.array(jax.devices()), ("sets",)), PartitionSpec("sets"))
data = jid.Motion(*motion), forces + motion.sum(axis=0)
def found(motion, forces):
    return jid.identify_batch(base, motion, forces, np.ones(2), row_time=0.01)
run = jax.jit(found).lower(*jax.device_put(data, own)).compile()
assert len(jax.devices()) == 4
collectives = "all-gather|all-reduce|all-to-all|collective-permute"
assert not re.findall(collectives, run.as_text())
fit = run(*jax.device_put(data, own))
assert fit.parameters.sharding.spec == PartitionSpec("sets")
slope = jax.jit(jax.grad(lambda f: found(data[0], f).parameters.sum()))
change = np.random.default_rng(1).normal(size=forces.shape)
after = run(*jax.device_put((data[0], data[1] + change), own))
np.testing.assert_allclose(
    np.vdot(slope(jax.device_put(data[1], own)), change),
    np.sum(after.parameters - fit.parameters),
    rtol=1e-9,
)
alone = found(*data)
np.savez(sys.argv[1], p=fit.parameters, s=fit.standard_deviations)
np.testing.assert_allclose(fit.parameters, alone.parameters, rtol=1e-10)
"""


def start(script, *arguments, flags):
    paths = [str(HERE), str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(p for p in paths if p),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": flags,
    }
    return subprocess.Popen(
        [sys.executable, "-c", COMMON + script, *map(str, arguments)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def assert_same(found, p, deviations, rows):
    error = np.linalg.norm((found["p"] - p) / deviations)
    assert error < 1e-12 * np.linalg.norm(p / deviations)
    np.testing.assert_allclose(found["s"], deviations, rtol=1e-10)
    np.testing.assert_array_equal(found["rows"], rows)


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


def test_a_long_log_on_three_devices_without_asking(base, tmp_path, monkeypatch):
    process = start(
        LONG, tmp_path / "3.npz", flags="--xla_force_host_platform_device_count=3"
    )
    monkeypatch.setattr(jid.RegressionProblem, "compiled_samples", 1000)
    monkeypatch.setattr(long_logs, "PIECE", 2048)
    smooth, p = jid.ZeroPhaseButterworth(30.0), standard_parameters(base.model)
    o = observations(base.model, p, samples=20011, noise=0.3, filter=smooth, every=15)
    fit = jid.identify(base, o, jid.estimators.LeastSquares())
    (output,) = patience.outputs([process])
    assert process.returncode == 0, output
    found = np.load(tmp_path / "3.npz")
    assert_same(found, fit.parameters, fit.naive_standard_deviations, fit.rows)


def test_data_sets_are_divided_as_the_inputs_are(tmp_path):
    process = start(
        DIVIDED, tmp_path / "4.npz", flags="--xla_force_host_platform_device_count=4"
    )
    (output,) = patience.outputs([process])
    assert process.returncode == 0, output
    assert np.isfinite(np.load(tmp_path / "4.npz")["s"]).all()
