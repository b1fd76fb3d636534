"""Measurement of the benchmarks: interleaved medians, machine, physical floors.

It is imported before JAX, since threads and devices are chosen then.
"""

import argparse
import datetime
import importlib.metadata
import importlib.util
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

HERE = Path(__file__).resolve().parent
REPOSITORY = HERE.parent
DATA = REPOSITORY.parent / "shared" / "data"
EXPERIMENTS = REPOSITORY / "tests" / "real_data"
PENDULUM = """\
[robot]
urdf = "{folder}/pendubot_model_1.0.urdf"
[limits]
force = [10.0, 10.0]
[recording]
time = "time"
angles = "pos_meas{{}}"
forces = "tau_meas{{}}"
largest_gap = 3.0
"""
"""Experiment file of the measured double pendulum, whose folder is filled in."""
PENDULUM_LOGS = ("143339", "143524", "143601", "143704", "143747", "144003")
sys.path.insert(0, str(REPOSITORY))

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
SHORTEST = 5e-3
"""Shortest turn of a case [s]; shorter cases are called several times."""
PEERS = ("pin", "figaroh", "frax")


def parser(text: str, quick: str) -> argparse.ArgumentParser:
    """Return a parser of the options that all scripts have.

    Args:
        text: Docstring of the script.
        quick: Effect of `--quick`.
    """
    options = argparse.ArgumentParser(description=text.splitlines()[0])
    options.add_argument("--quick", action="store_true", help=quick)
    options.add_argument("--json", help="file for the rows, read by run.py")
    return options


def pin_to(cores: int) -> None:
    """Give this process some cores and as many threads, before JAX is imported."""
    for name in THREADS:
        os.environ[name] = str(cores)
    if hasattr(os, "sched_setaffinity"):
        allowed = sorted(os.sched_getaffinity(0))
        # Interrupts and other processes mostly run on the first core.
        os.sched_setaffinity(0, allowed[-cores:])
    if cores == 1:
        flags = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}".strip()
    os.environ["JAX_ENABLE_X64"] = "1"
    os.environ["JAX_PLATFORMS"] = "cpu"


@dataclass(frozen=True)
class Times:
    """Seconds for one call, for each turn."""

    turns: tuple[float, ...]

    @property
    def median(self) -> float:
        """Median of all turns."""
        return statistics.median(self.turns)

    @property
    def best(self) -> float:
        """Shortest turn."""
        return min(self.turns)

    def __truediv__(self, other: "Times") -> float:
        """Return the median of the ratios turn by turn, so that other load cancels."""
        return statistics.median(
            a / b for a, b in zip(self.turns, other.turns, strict=True)
        )


def interleaved(cases: dict[str, Callable[[], object]], turns: int) -> dict[str, Times]:
    """Time all cases in turn, again and again, after warming each of them up.

    A case must block until its result is available. Each turn begins with a call that
    does not count, since the case before has filled the caches.
    """
    calls = {}
    for name, case in cases.items():
        case()
        case()
        start = time.perf_counter()
        case()
        calls[name] = max(1, round(SHORTEST / (time.perf_counter() - start + 1e-9)))
    seconds = {name: [] for name in cases}
    for _ in range(turns):
        for name, case in cases.items():
            case()
            start = time.perf_counter()
            for _ in range(calls[name]):
                case()
            seconds[name].append((time.perf_counter() - start) / calls[name])
    return {name: Times(tuple(values)) for name, values in seconds.items()}


def elapsed(work: Callable[[], object]) -> tuple[object, float]:
    """Return the result of a call, and its duration [s]."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


@dataclass(frozen=True)
class Row:
    """Row of a table: quantity and recipe, target, result, and whether it holds."""

    number: str
    what: str
    recipe: str
    asked: str
    measured: str
    holds: bool | None = None


def hand_over(rows: list[Row], path: str | None) -> None:
    """Print rows, and write them where `run.py` reads them."""
    for row in rows:
        print(
            f"[{row.number}] {row.what}: {row.measured}; asked {row.asked}\n    "
            f"{row.recipe}"
        )
    if path is not None:
        # Comparisons of NumPy give its own booleans.
        Path(path).write_text(json.dumps([asdict(row) for row in rows], default=bool))


def version(package: str) -> str | None:
    """Return the version of an installed package, or None."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def missing(module: str) -> str | None:
    """Return a sentence if a module cannot be imported, else None."""
    if importlib.util.find_spec(module) is None:
        return f"`{module}` is not installed: skipped"
    return None


def machine() -> dict[str, str]:
    """Return what the figures depend on: date, processor, load, versions, compiler."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    features = ""
    if info.exists():
        lines = dict(
            map(str.strip, line.split(":", 1))
            for line in info.read_text().split("\n\n")[0].splitlines()
            if ":" in line
        )
        model = lines.get("model name", model)
        features = " with AVX-512" if "avx512f" in lines.get("flags", "") else ""
    cores = (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count()
    )
    packages = [f"{p} {version(p)}" for p in ("jax", "numpy", *PEERS) if version(p)]
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    return {
        "date": datetime.date.today().isoformat(),
        "machine": f"{model}{features}, {cores} cores",
        "load when the run began": load,
        "system": f"{platform.system()} {platform.machine()}",
        "versions": f"Python {platform.python_version()}, " + ", ".join(packages),
        "compiler": compiler(),
    }


def compiler() -> str:
    """Return the version of the C++ compiler."""
    try:
        return subprocess.run(
            ["g++", "--version"], capture_output=True, text=True, check=True
        ).stdout.splitlines()[0]
    except (OSError, subprocess.CalledProcessError):
        return "none"


def fill(doubles: int, samples: int) -> Callable[[], object]:
    """Return the floor of every result: writing as many doubles to mapped memory."""
    import numpy as np

    memory = np.ones((doubles, samples))
    return lambda: memory.fill(0.5)


def flop_rate(turns: int = 5) -> float:
    """Return multiplications and additions per second in a product of two matrices."""
    import numpy as np

    size = 768
    a = np.random.default_rng(0).random((size, size))
    out = np.empty_like(a)
    times = interleaved({"product": lambda: np.matmul(a, a, out=out)}, turns)["product"]
    return 2 * size**3 / times.median
