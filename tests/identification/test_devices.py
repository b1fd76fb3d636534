"""Several devices and several processes give what one of them gives."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from virtual import observations, standard_parameters

import jaxid as jid
from jaxid.identification.devices import factorise_across_processes

HERE = Path(__file__).resolve().parent
COMMON = """
import os, sys
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxid as jid
from virtual import observations, standard_parameters
from jaxid.identification.devices import factorise_across_processes

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
def recording(seed):
    p = standard_parameters(base.model)
    return observations(base.model, p, samples=1003, noise=0.3, seed=seed, noise_seed=seed)
def say(*words):
    # In one piece: an unbuffered print writes word by word, and JAX's own log comes between.
    os.write(1, (" ".join(map(str, words)) + "\\n").encode())
def write(problem):
    fit = jid.identification.identify.fit_problem(problem, jid.estimators.LeastSquares())
    np.savez(sys.argv[1], p=fit.parameters, s=fit.naive_standard_deviations, rows=fit.rows)
"""
LONG = """
assert len(jax.devices()) == int(sys.argv[2])
from jaxid.identification import streaming
streaming.LONG, streaming.PIECE = 1000, 2048
o = observations(base.model, standard_parameters(base.model), samples=20011, noise=0.3,
                 filter=jid.ZeroPhaseButterworth(30.0), every=15)
shares = []
fit = jid.identify(base, o, jid.estimators.LeastSquares(), progress=shares.append)
assert shares == sorted(shares) and shares[-1] == 1.0
np.savez(sys.argv[1], p=fit.parameters, s=fit.standard_deviations, rows=fit.rows)
"""
SHARDS = """
from pathlib import Path
columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=1e-3)
paths = jid.devices.shards(sys.argv[4])
assert 1 <= len(paths) <= 3, paths
logs = [jid.scan_log(p, columns, base.model.robot, jid.ZeroPhaseButterworth(20.0)) for p in paths]
write(factorise_across_processes(base, logs, patience=60.0))
"""
KILLED = """
import signal, time
from jaxid.identification import devices
if number == 1:
    def killed(*_):
        os.kill(os.getpid(), signal.SIGKILL)
    devices._pack = killed
start = time.monotonic()
try:
    factorise_across_processes(base, [recording(number)], patience=30.0)
except (RuntimeError, TimeoutError) as error:
    say("ended:", type(error).__name__, error)
    os._exit(7)
"""
LEFT_ALONE = """
if number == 1:
    os._exit(3)
try:
    factorise_across_processes(base, [recording(0)], patience=float(sys.argv[4]))
except (RuntimeError, TimeoutError) as error:
    say(type(error).__name__, error)
    os._exit(7)
"""


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


def recording(base, seed, samples=1003):
    p = standard_parameters(base.model)
    return observations(base.model, p, samples=samples, noise=0.3, seed=seed, noise_seed=seed)


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


def assert_same(path, fit):
    found = np.load(path)
    size = 1.0 / np.asarray(fit.naive_standard_deviations)
    error = np.linalg.norm((found["p"] - fit.parameters) * size)
    assert error < 1e-12 * np.linalg.norm(fit.parameters * size)
    np.testing.assert_allclose(found["s"], fit.naive_standard_deviations, rtol=1e-10)
    np.testing.assert_array_equal(found["rows"], fit.rows)


def test_a_long_log_on_three_devices_without_asking(tmp_path):
    flags = "--xla_force_host_platform_device_count={}"
    processes = [start(LONG, tmp_path / f"{n}.npz", n, flags=flags.format(n)) for n in (1, 3)]
    outputs = finish(*processes)
    assert [p.returncode for p in processes] == [0, 0], "\n\n".join(outputs)
    one, three = (np.load(tmp_path / f"{n}.npz") for n in (1, 3))
    size = 1.0 / one["s"]
    error = np.linalg.norm((one["p"] - three["p"]) * size)
    assert error < 1e-12 * np.linalg.norm(one["p"] * size)
    np.testing.assert_array_equal(one["rows"], three["rows"])


def test_three_processes_read_their_own_shards(base, tmp_path):
    """One of them has more recordings than the others."""
    count = 3
    folder = tmp_path / "logs"
    folder.mkdir()
    columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=1e-3)
    for k, samples in enumerate((9000, 8000, 3000, 2900, 2800)):
        o = recording(base, k, samples)
        arrays = {"q": o.motion.q, "tau": o.forces}
        frame = {f"{n}{j + 1}": x[:, j] for n, x in arrays.items() for j in range(2)}
        pl.DataFrame(frame).write_parquet(folder / f"{k}.parquet", row_group_size=1000)
    paths, port = [tmp_path / f"{k}.npz" for k in range(count)], free_port()
    processes = [start(SHARDS, p, port, f"{k}/{count}", folder) for k, p in enumerate(paths)]
    outputs = finish(*processes)
    assert [p.returncode for p in processes] == [0] * count, "\n\n".join(outputs)
    assert len(jid.devices.shards(folder)) == 5
    logs = [
        jid.scan_log(p, columns, base.model.robot, jid.ZeroPhaseButterworth(20.0))
        for p in jid.devices.shards(folder)
    ]
    fit = jid.identify(base, logs, jid.estimators.LeastSquares())
    for path in paths:
        assert_same(path, fit)
        np.testing.assert_array_equal(np.load(path)["p"], np.load(paths[0])["p"])


def test_a_process_that_is_killed_in_the_exchange_ends_the_others(tmp_path):
    port = free_port()
    began = time.monotonic()
    processes = [start(KILLED, tmp_path / "no.npz", port, f"{k}/2") for k in range(2)]
    outputs = finish(*processes)
    assert processes[1].returncode == -signal.SIGKILL
    # Whichever notices first: the exchange, or JAX's own watch, which ends the process.
    assert processes[0].returncode not in (0, None), outputs[0]
    assert "lost another one" in outputs[0] or "unhealthy" in outputs[0].lower(), outputs[0]
    assert time.monotonic() - began < 90.0


@pytest.mark.parametrize(
    ("heartbeat", "patience", "said"),
    [
        (100, 3, "TimeoutError process 0 of 2 waited for the others' factors, but not all came"),
        (3, 100, "RuntimeError process 0 lost another one"),
    ],
)
def test_a_process_that_dies_ends_the_others(tmp_path, heartbeat, patience, said):
    """Whichever of the two notices first: this package's patience or JAX's own watch."""
    arguments = tmp_path / "no.npz", free_port()
    processes = [
        start(LEFT_ALONE, *arguments, f"{k}/2", patience, heartbeat=heartbeat) for k in range(2)
    ]
    outputs = finish(*processes)
    assert processes[1].returncode == 3
    assert processes[0].returncode == 7, outputs[0]
    assert said in outputs[0], outputs[0]


def test_a_program_of_one_process_needs_no_coordinator(base):
    o = recording(base, 0)
    a = factorise_across_processes(base, [o]).factors.weighted(np.ones(2))
    b = jid.RegressionProblem(base, [o]).blocks.total.weighted(np.ones(2))
    np.testing.assert_array_equal(a[0], b[0])


def test_refusals():
    with pytest.raises(ValueError, match="holds no file"):
        jid.devices.shards(HERE)
