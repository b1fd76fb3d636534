"""Speed of the main functions and commands, also beside another version.

Each row is measured by a process of its own, which prints seconds. With `--against`
the same rows are measured with another checkout of the package, in turn, and the table
shows the ratio of the shortest times.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import timing

PREPARATION = """
import sys, time
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import jaxid as jid

def shortest(call, seconds):
    times, end = [], time.perf_counter() + seconds
    while len(times) < 5 or time.perf_counter() < end:
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return min(times)

def motion(samples):
    rng = np.random.default_rng(0)
    return jid.Motion(*rng.uniform(-1.0, 1.0, (3, samples, 7)))

friction = jid.RotorInertia(), jid.ViscousFriction(), jid.CoulombFriction()
model = jid.Model(jid.robots.panda(), (jid.RigidBodies(), *friction))
p = np.random.default_rng(1).uniform(0.1, 1.0, model.size)
"""
DYNAMICS = """
samples = motion(int(sys.argv[1]))
function = getattr(model, sys.argv[2])
arguments = (p, samples) if sys.argv[2] == "inverse_dynamics" else (samples,)
print(shortest(lambda: function(*arguments), 1.0))
"""
IDENTIFICATION = """
samples = motion(int(sys.argv[1]))
base = jid.base_parameters(model)
forces = np.asarray(model.inverse_dynamics(p, samples))
forces = forces + np.random.default_rng(2).normal(size=forces.shape)
arrays = samples.q, samples.qd, samples.qdd, forces
rows = jid.Observations.of(*arrays, sample_time=1e-3)
print(shortest(lambda: jid.identify(base, rows).parameters, 1.0))
"""
DESIGN = """
base = jid.base_parameters(model)
start = time.process_time()
jid.design_excitation(
    base, harmonics=5, omega=0.6, starts=8, generations=4, key=jax.random.key(0)
)
print(time.process_time() - start)
"""
COMMAND = """
import resource, subprocess, sys
command = [sys.executable, "-m", "jaxid", *sys.argv[1:]]
subprocess.run(command, stdout=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(used.ru_utime + used.ru_stime)
"""


class SpeedRow(NamedTuple):
    """Row of the table.

    Attributes:
        text: What is measured.
        script: Program that prints the time.
        arguments: Arguments of the program.
        repeats: Number of its runs.
    """

    text: str
    script: str
    arguments: tuple[str, ...]
    repeats: int = 3


def rows(folder: str, quick: bool) -> list[SpeedRow]:
    """Return the rows; commands write into a folder."""
    table = [
        SpeedRow(
            f"`{function}`, {samples} samples, Panda [s]",
            PREPARATION + DYNAMICS,
            (str(samples), function),
        )
        for function in ("inverse_dynamics", "regressor")
        for samples in ((64,) if quick else (64, 2048, 16384))
    ]
    if quick:
        return table
    ur10 = (
        "identify",
        str(timing.EXPERIMENTS / "ur10.toml"),
        str(timing.DATA / "ur10" / "exciting_measured.csv"),
        "--force",
        "-o",
        f"{folder}/ur10",
    )
    demo = ("demo", "--force", "-o", f"{folder}/demo")
    return [
        *table,
        SpeedRow(
            "`identify`, a million samples, Panda [s]",
            PREPARATION + IDENTIFICATION,
            ("1000000",),
        ),
        SpeedRow("one design, Panda [CPU s]", PREPARATION + DESIGN, ()),
        SpeedRow("`jaxid identify`, UR10 [CPU s]", COMMAND, ur10),
        SpeedRow("`jaxid demo` [CPU s]", COMMAND, demo, 2),
    ]


def measure(row: SpeedRow, checkout: Path) -> float:
    """Return the seconds that one run of a row prints."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [sys.executable, "-c", row.script, *row.arguments],
        env=environment,
        cwd=checkout,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{row.text}: {done.stderr.splitlines()[-1]}")
    return float(done.stdout.split()[-1])


def main() -> None:
    """Print the table, row by row."""
    options = timing.parser(__doc__, "dynamics of 64 samples alone")
    options.add_argument("--against", type=Path, help="another checkout of the package")
    arguments = options.parse_args()
    checkouts = [timing.REPOSITORY]
    if arguments.against is not None:
        checkouts.append(arguments.against.resolve())
    measurements = []
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(folder, arguments.quick):
            times = {checkout: [] for checkout in checkouts}
            for _ in range(row.repeats):
                for checkout in checkouts:
                    times[checkout].append(measure(row, checkout))
            shortest = [min(times[checkout]) for checkout in checkouts]
            ratio = f"  {shortest[0] / shortest[1]:.2f}x" if len(shortest) > 1 else ""
            values = "  ".join(f"{value:.4g}" for value in shortest)
            print(f"{row.text:50s} {values}{ratio}", flush=True)
            recipe = f"shortest of {row.repeats} processes"
            number = f"speed {len(measurements) + 1}"
            measured = f"{shortest[0]:.4g}{ratio}"
            measurements.append(timing.Row(number, row.text, recipe, "", measured))
    timing.hand_over(measurements, arguments.json)


if __name__ == "__main__":
    main()
