"""Several devices and several processes give what one of them gives."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
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
from jaxid.identification.multihost import factorise_across_processes

if len(sys.argv) > 3:
    # Before anything else: making a robot may already start JAX.
    number, processes = map(int, sys.argv[3].split("/"))
    jax.distributed.initialize(
        f"127.0.0.1:{sys.argv[2]}", num_processes=processes, process_id=number,
        initialization_timeout=60,
        heartbeat_timeout_seconds=int(os.environ["HEARTBEAT"]),
        coordinator_bind_address=f"127.0.0.1:{sys.argv[2]}",
    )
terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))
p = standard_parameters(base.model)
def write(fit):
    np.savez(sys.argv[1], p=fit.parameters, s=fit.naive_standard_deviations, rows=fit.rows)
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
motion, (forces,) = np.random.default_rng(0).normal(size=(3, 8, 60, 2)), np.ones((1, 8, 60, 2))
own = NamedSharding(Mesh(np.array(jax.devices()), ("sets",)), PartitionSpec("sets"))
data = jid.Motion(*motion), forces + motion.sum(axis=0)
def found(motion, forces):
    return jid.identify_batch(base, motion, forces, np.ones(2), row_time=0.01)
run = jax.jit(found).lower(*jax.device_put(data, own)).compile()
assert len(jax.devices()) == 4
assert not re.findall("all-gather|all-reduce|all-to-all|collective-permute", run.as_text())
fit = run(*jax.device_put(data, own))
assert fit.parameters.sharding.spec == PartitionSpec("sets")
slope = jax.jit(jax.grad(lambda f: found(data[0], f).parameters.sum()))
same = [np.asarray(slope(x)) for x in (data[1], jax.device_put(data[1], own))]
np.testing.assert_allclose(*same, rtol=1e-9, atol=1e-12)
alone = found(*data)
np.savez(sys.argv[1], p=fit.parameters, s=fit.standard_deviations)
np.testing.assert_allclose(fit.parameters, alone.parameters, rtol=1e-10)
"""
SHARDS = """
from pathlib import Path
columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=1e-3)
paths = jid.multihost.shards(sys.argv[4])
assert 1 <= len(paths) <= 2, paths
logs = [jid.scan_log(p, columns, base.model.robot, jid.ZeroPhaseButterworth(20.0)) for p in paths]
problem = factorise_across_processes(base, logs, patience=60.0)
write(jid.identify(base, problem, jid.estimators.LeastSquares()))
"""
LEFT_ALONE = """
if number == 1:
    os._exit(3)
try:
    log = observations(base.model, p, samples=1003)
    factorise_across_processes(base, [log], patience=float(sys.argv[4]))
except (RuntimeError, TimeoutError) as error:
    # In one piece: an unbuffered print writes word by word, and JAX's own log comes between.
    os.write(1, f"{type(error).__name__} {error}\\n".encode())
    os._exit(7)
"""


def start(script, *arguments, flags="", heartbeat=10):
    paths = [str(HERE), str(HERE.parent.parent), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(p for p in paths if p),
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": flags,
        "HEARTBEAT": str(heartbeat),
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
    (output,) = finish(process)
    assert process.returncode == 0, output
    found = np.load(tmp_path / "3.npz")
    assert_same(found, fit.parameters, fit.naive_standard_deviations, fit.rows)


def test_data_sets_are_divided_as_the_inputs_are(tmp_path):
    process = start(
        DIVIDED, tmp_path / "4.npz", flags="--xla_force_host_platform_device_count=4"
    )
    (output,) = finish(process)
    assert process.returncode == 0, output
    assert np.isfinite(np.load(tmp_path / "4.npz")["s"]).all()


def test_processes_read_their_own_shards(base, tmp_path):
    """One of them has more recordings than the others."""
    count, folder = 2, tmp_path / "logs"
    folder.mkdir()
    p = standard_parameters(base.model)
    columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=1e-3)
    for k, samples in enumerate((9000, 3000, 2800)):
        o = observations(
            base.model, p, samples=samples, noise=0.3, seed=k, noise_seed=k
        )
        arrays = {"q": o.motion.q, "tau": o.forces}
        frame = {f"{n}{j + 1}": x[:, j] for n, x in arrays.items() for j in range(2)}
        pl.DataFrame(frame).write_parquet(folder / f"{k}.parquet", row_group_size=1000)
    paths, port = [tmp_path / f"{k}.npz" for k in range(count)], free_port()
    processes = [
        start(SHARDS, p, port, f"{k}/{count}", folder) for k, p in enumerate(paths)
    ]
    outputs = finish(*processes)
    assert [p.returncode for p in processes] == [0] * count, "\n\n".join(outputs)
    assert len(jid.multihost.shards(folder)) == 3
    logs = [
        jid.scan_log(p, columns, base.model.robot, jid.ZeroPhaseButterworth(20.0))
        for p in jid.multihost.shards(folder)
    ]
    fit = jid.identify(base, logs, jid.estimators.LeastSquares())
    results = list(map(np.load, paths))
    for found in results:
        assert_same(found, fit.parameters, fit.naive_standard_deviations, fit.rows)
        np.testing.assert_array_equal(found["p"], results[0]["p"])


def test_a_process_that_dies_ends_the_others(tmp_path):
    """Whichever of the two notices first: this package's patience or JAX's own watch."""
    cases = {
        (
            100,
            3,
        ): "TimeoutError process 0 of 2 waited for the others' factors, but not all "
        "came",
        (3, 100): "RuntimeError process 0 lost another one",
    }
    processes = []
    for heartbeat, patience in cases:
        port = free_port()
        for k in range(2):
            arguments = tmp_path / "no.npz", port, f"{k}/2", patience
            processes.append(start(LEFT_ALONE, *arguments, heartbeat=heartbeat))
    outputs = finish(*processes)
    assert [p.returncode for p in processes] == [7, 3, 7, 3], "\n\n".join(outputs)
    for said, output in zip(cases.values(), outputs[::2], strict=True):
        assert said in output, output
