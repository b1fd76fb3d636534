"""Several devices and several processes give what one of them gives."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.identification.devices import factorise_across_processes, factorise_on_devices
from jaxid.identification.factors import factorise
from jaxid.identification.identify import fit_blocks

HERE = Path(__file__).resolve().parent
COMMON = """
import os, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxid as jid
from virtual import observations, standard_parameters
from jaxid.identification.devices import factorise_across_processes, factorise_on_devices
from jaxid.identification.identify import fit_blocks

if len(sys.argv) > 2:
    # Before anything else: making a robot may already start JAX.
    number = int(sys.argv[3])
    jax.distributed.initialize(
        f"127.0.0.1:{sys.argv[2]}", num_processes=2, process_id=number, initialization_timeout=60
    )
terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))
def recording(seed):
    p = standard_parameters(base.model)
    return observations(base.model, p, samples=1003, noise=0.3, seed=seed, noise_seed=seed)
def write(blocks):
    fit = fit_blocks(base, blocks, jid.LeastSquares())
    np.savez(sys.argv[1], p=fit.parameters, s=fit.standard_deviations, rows=fit.rows)
"""
DEVICES = """
assert len(jax.devices()) == 8
o = recording(0)
blocks = factorise_on_devices(base, o.motion, o.forces)
assert len(blocks.parts) == 8
write(blocks)
"""
PROCESSES = """
# The second process has two recordings, the first one: factors are filled up to the same number.
own = [recording(0)] if number == 0 else [recording(1), recording(2)]
write(factorise_across_processes(base, own, patience=60.0))
"""
LEFT_ALONE = """
if number == 1:
    os._exit(3)
try:
    factorise_across_processes(base, [recording(0)], patience=3.0)
except TimeoutError as error:
    print(error, flush=True)
    os._exit(7)
"""


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


def recording(base, seed):
    p = standard_parameters(base.model)
    return observations(base.model, p, samples=1003, noise=0.3, seed=seed, noise_seed=seed)


def start(script, *arguments, flags=""):
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


def finish(*processes):
    try:
        return [p.communicate(timeout=120)[0] for p in processes]
    finally:
        for p in processes:
            p.kill()
            p.wait()


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def assert_same(path, fit):
    found = np.load(path)
    size = 1.0 / np.asarray(fit.standard_deviations)
    error = np.linalg.norm((found["p"] - fit.parameters) * size)
    assert error < 1e-12 * np.linalg.norm(fit.parameters * size)
    np.testing.assert_allclose(found["s"], fit.standard_deviations, rtol=1e-10)
    np.testing.assert_array_equal(found["rows"], fit.rows)


def test_eight_devices(base, tmp_path):
    process = start(DEVICES, tmp_path / "fit.npz", flags="--xla_force_host_platform_device_count=8")
    (output,) = finish(process)
    assert process.returncode == 0, output
    fit = fit_blocks(base, factorise(base, [recording(base, 0)], 8), jid.LeastSquares())
    assert_same(tmp_path / "fit.npz", fit)


def test_one_device_by_chunks(base, monkeypatch):
    from jaxid.identification import devices

    monkeypatch.setattr(devices, "AT_ONCE", 100)
    o = recording(base, 0)
    found = factorise_on_devices(base, o.motion, o.forces).total
    expected = factorise(base, [o]).total
    for a, b in zip(found.joints, expected.joints, strict=True):
        assert a.rows == b.rows == 1003
        np.testing.assert_allclose(a.R.T @ a.R, b.R.T @ b.R, rtol=1e-12, atol=1e-9)


def test_two_processes(base, tmp_path):
    port = free_port()
    paths = [tmp_path / f"{k}.npz" for k in range(2)]
    processes = [start(PROCESSES, path, port, k) for k, path in enumerate(paths)]
    outputs = finish(*processes)
    assert [p.returncode for p in processes] == [0, 0], "\n\n".join(outputs)
    recordings = [recording(base, k) for k in range(3)]
    fit = fit_blocks(base, factorise(base, recordings), jid.LeastSquares())
    for path in paths:
        assert_same(path, fit)
    a, b = (np.load(path)["p"] for path in paths)
    np.testing.assert_array_equal(a, b)


def test_a_process_that_dies_ends_the_others(tmp_path):
    port = free_port()
    processes = [start(LEFT_ALONE, tmp_path / "no.npz", port, k) for k in range(2)]
    outputs = finish(*processes)
    assert processes[1].returncode == 3
    # Whichever of the two notices first: this package's patience or JAX's own watch.
    assert processes[0].returncode != 0, outputs[0]
    assert "not all came within 3 s" in outputs[0], outputs[0]


def test_a_program_of_one_process_needs_no_coordinator(base):
    o = recording(base, 0)
    a = factorise_across_processes(base, [o]).total.weighted(np.ones(2))
    b = factorise(base, [o]).total.weighted(np.ones(2))
    np.testing.assert_array_equal(a[0], b[0])


def test_refusals(base):
    o = recording(base, 0)
    with pytest.raises(ValueError, match=r"must have the shape \[samples, 2\]"):
        factorise_on_devices(base, o.motion, o.forces[1:])
