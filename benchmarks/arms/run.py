"""One table for the field: every method on every robot, judged alike.

    python benchmarks/arms/run.py                  # everything, about 15 minutes
    python benchmarks/arms/run.py --quick          # three robots, 90 seconds
    python benchmarks/arms/run.py ur10 closed_loop # only these robots
    python benchmarks/arms/run.py --write          # writes README.md, the picture, JSON

Three kinds of robots: logs with torques, servo joints without torques, and poses for
the geometry. Each pair of a method and a robot runs in a process of its own. A method
that is not installed, or fails, has a reason in the table.
"""

import argparse
import ast
import importlib
import inspect
import json
import os
import pkgutil
import resource
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from arm import HERE

SCORES = {
    "torques": "score",
    "servos": "score_servos",
    "geometry": "score_geometry",
}
"""Kinds of robots, and the module that judges the methods for each."""
QUICK_SETS = ("ur10", "closed_loop", "panda_1")
QUICK_METHODS = ("jaxid", "NumPy and Pinocchio", "FIGAROH", "scipy")
COVERAGE = "coverage"
"""Name of the job that measures how often intervals hold."""
WORKERS = 2
"""Processes that run at once."""
LIMIT = 600
"""CPU time after which a method is stopped [s]."""
REPEAT_LIMIT = 10.0
"""CPU time above which a method is not run again [s]."""


def found_in(package, table):
    """Return the entries of a table in all modules of a folder, and their kinds."""
    entries = {}
    for module_info in pkgutil.iter_modules([str(HERE / package)]):
        module = importlib.import_module(f"{package}.{module_info.name}")
        for name, entry in getattr(module, table, {}).items():
            entries[module.KIND, name] = entry
    return entries


def sets():
    """Return the loaders of all robots by their names."""
    return {name: x for (_, name), x in found_in("sets", "SETS").items()}


def kind_of(set_name):
    """Return the kind of a robot."""
    return next(k for k, name in found_in("sets", "SETS") if name == set_name)


def methods(kind):
    """Return all methods for one kind of robots by their names, rivals first."""
    found = found_in("methods", "METHODS")
    of_kind = {name: x for (own_kind, name), x in found.items() if own_kind == kind}
    return dict(sorted(of_kind.items(), key=lambda x: x[0].startswith("jaxid")))


def is_simulated(set_name):
    """Return whether a robot is recorded by MuJoCo, into a folder."""
    return bool(inspect.signature(sets()[set_name]).parameters)


def load(name, folder):
    """Return one of the robots; simulated ones are recorded into a folder."""
    if not is_simulated(name):
        return sets()[name]()
    place = Path(folder) / name
    place.mkdir(exist_ok=True)
    return sets()[name](place)


class Clock:
    """Method whose calls are measured: CPU time [s] and memory [MB]."""

    def __init__(self, method):
        self.method = method
        self.seconds = []
        self.peak = 0.0

    def __call__(self, arm):
        """Identify, and remember the cost."""
        start = time.process_time()
        result = self.method(arm)
        self.seconds.append(time.process_time() - start)
        self.peak = peak_memory()
        return result


def peak_memory():
    """Return the largest memory of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(set_name, method_name, folder):
    """Return the figures of one method on one robot."""
    import jax

    jax.config.update("jax_enable_x64", True)
    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 10))
    kind = kind_of(set_name)
    arm = load(set_name, folder)
    if method_name == COVERAGE:
        import intervals

        return intervals.figures(arm)
    if kind == "torques":
        arm.signals(unseen=True)  # what reading compiles is not the method's time
    before = peak_memory()
    clock = Clock(methods(kind)[method_name])
    figures = importlib.import_module(SCORES[kind]).figures(arm, clock)
    seconds = [sum(clock.seconds)]
    megabytes = clock.peak - before
    if kind == "torques" and seconds[0] < REPEAT_LIMIT:
        clock(arm)
        seconds.append(clock.seconds[-1])
    return {"kind": kind, **figures, "seconds": seconds, "megabytes": megabytes}


def lines_of(method):
    """Return the code lines of a method and of what it uses of its own module."""
    module = sys.modules[method.__module__]
    names = [method.__name__]
    counted = set()
    count = 0
    while names:
        name = names.pop()
        if name in counted:
            continue
        counted.add(name)
        tree = ast.parse(inspect.getsource(getattr(module, name)))
        definition = tree.body[0]
        body = definition.body[1:] if ast.get_docstring(definition) else definition.body
        count += 1 + len(ast.unparse(body).splitlines())
        used = {x.id for x in ast.walk(definition) if isinstance(x, ast.Name)}
        own = [x for x in used if inspect.isfunction(getattr(module, x, None))]
        names += [x for x in own if getattr(module, x).__module__ == module.__name__]
    return count


def run_pair(set_name, method_name, folder):
    """Measure one pair in a process of its own; a failure is a reason."""
    command = [sys.executable, str(HERE / "run.py"), "--one", set_name, method_name]
    done = subprocess.run(
        [*command, "--folder", str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    if done.returncode == -signal.SIGXCPU:
        return {"reason": f"stopped after {LIMIT} CPU s"}
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason"])[-1]
        return {"reason": reason[:200]}
    return json.loads(done.stdout.splitlines()[-1])


def jobs(set_names, chosen_methods, with_coverage):
    """Return all pairs of a robot and a method, or the measurement of coverage."""
    pairs = []
    for set_name in set_names:
        for name in methods(kind_of(set_name)):
            if not chosen_methods or name in chosen_methods:
                pairs.append((set_name, name))
        if with_coverage and kind_of(set_name) == "torques":
            pairs.append((set_name, COVERAGE))
    return pairs


def main():
    """Run what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--quick", action="store_true", help="three robots")
    parser.add_argument("--write", action="store_true", help="write README and JSON")
    parser.add_argument("--methods", nargs="*", help="only these methods")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure(*given.one, given.folder)))
        return
    import table
    from timing import DATA

    set_names = given.robots or (QUICK_SETS if given.quick else list(sets()))
    if not DATA.is_dir():
        set_names = [name for name in set_names if is_simulated(name)]
    chosen_methods = given.methods or (QUICK_METHODS if given.quick else None)
    with_coverage = chosen_methods is None or COVERAGE in chosen_methods
    pairs = jobs(set_names, chosen_methods, with_coverage)
    lines = {
        kind: {name: lines_of(method) for name, method in methods(kind).items()}
        for kind in SCORES
    }
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for set_name in filter(is_simulated, set_names):
            load(set_name, folder)  # recorded once
        with ThreadPoolExecutor(WORKERS) as pool:
            rows = pool.map(lambda x: run_pair(*x, folder), pairs)
            for pair, row in zip(pairs, rows, strict=True):
                set_name, method_name = pair
                results.setdefault(set_name, {})[method_name] = row
                print(table.line(*pair, row), flush=True)
                is_last = pair == [x for x in pairs if x[0] == set_name][-1]
                if given.write and is_last:
                    table.write({set_name: results[set_name]}, lines)
    times = os.times()
    print(table.text(results, lines))
    print(f"{times.children_user + times.children_system:.0f} CPU s")
    failed = [
        f"{name} on {set_name}"
        for set_name, by_method in results.items()
        for name, row in by_method.items()
        if "reason" in row and name.startswith("jaxid")
    ]
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
