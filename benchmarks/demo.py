"""Cost and results of `jaxid demo` as one table.

The command runs in processes of its own, on the virtual TX90L on its rail, seed 0
(others with `--seeds`): first with an empty cache of compiled functions, then with the
cache that the first run has left. Wall time and peak memory (largest resident set) are
those of the processes; the rest is what `demo.json` says, the median over the seeds and
the worst of them:

* average errors (Eq. 37): worst axis, percent of the largest torque, on identification
  and verification, by least squares without weights, with weights, of bodies that could
  exist, and by the true parameters, whose errors are what disturbs;
* share of 2000 random poses in which the mass matrix has an eigenvalue that is not
  positive;
* six base parameters cold and warm (Sec. 6), less the paper's, in percent of the
  paper's;
* speed and acceleration of the end-effector along the designed motion.

    python benchmarks/demo.py [--seeds 0 1 2] [--quick]

`--quick` runs once, with the compiled functions of earlier runs.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import timing

ESTIMATORS = ("without weights", "weighted", "consistent", "true parameters")


def run(folder, seed, cache):
    """Return wall time [s], peak memory [MB] and results of one run."""
    environment = dict(os.environ)
    if cache is not None:
        environment["JAXID_CACHE_DIR"] = str(cache)
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxid", "demo", "--seed", str(seed), "-o", str(folder)],
        stdout=subprocess.DEVNULL,
        env=environment,
    )
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begin
    if status:
        raise SystemExit(f"`jaxid demo --seed {seed}` ended with status {status}")
    return wall, usage.ru_maxrss / 1e3, json.loads((folder / "demo.json").read_text())


def figures(record):
    """Return names and numbers of one run."""
    found = {}
    for name in ESTIMATORS:
        estimate = record["estimates"][name]
        for role in ("identification", "verification"):
            found[f"average error, {role}, {name} [%]"] = max(
                estimate[f"mean_percent_{role}"]
            )
        found[f"poses with an indefinite mass matrix, {name} [%]"] = (
            100 * estimate["indefinite_share"]
        )
    for one in record["temperature"]:
        for k, state in enumerate(("cold", "warm")):
            paper = one["paper"][k]
            found[f"p_B({one['number']}) {state}, off the paper's [%]"] = (
                100 * (one["estimates"][k] - paper) / paper
            )
    excitation = record["excitation"]
    found["end-effector, speed up to [m/s]"] = excitation["tip_speed"]
    found["end-effector, acceleration up to [m/s²]"] = excitation["tip_acceleration"]

    return found


def main():
    """Print the table."""
    parser = timing.parser(__doc__, "one run")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        if options.quick:
            runs = [run(root / "demo", options.seeds[0], None)]
            print(f"wall time {runs[0][0]:.0f} s, peak memory {runs[0][1]:.0f} MB")
        else:
            cache = root / "cache"
            cold = run(root / "cold", options.seeds[0], cache)
            runs = [run(root / f"warm{seed}", seed, cache) for seed in options.seeds]
            warm = float(np.median([wall for wall, _, _ in runs]))
            print(f"wall time, cold cache {cold[0]:.0f} s, warm {warm:.0f} s (median)")
            print(
                f"peak memory, cold {cold[1]:.0f} MB, warm "
                f"{max(r[1] for r in runs):.0f} MB"
            )
        found = [figures(record) for _, _, record in runs]
    print("\n| figure | median | worst |\n|---|---|---|")
    for name in found[0]:
        values = np.array([one[name] for one in found])
        print(
            f"| {name} | {np.median(values):.4g} | "
            f"{values[np.abs(values).argmax()]:.4g} |"
        )


if __name__ == "__main__":
    main()
