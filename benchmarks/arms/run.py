"""One table for the field: every method on every robot, judged alike.

    python benchmarks/arms/run.py                  # everything, about 15 minutes
    python benchmarks/arms/run.py --quick          # two robots, 90 seconds
    python benchmarks/arms/run.py ur10 closed_loop # only these robots
    python benchmarks/arms/run.py --write          # writes README.md, the picture, JSON

Each pair of a method and a robot runs in a process of its own, twice: the first run
compiles. A method that is not installed, or fails, has a reason in the table.
"""

import argparse
import ast
import inspect
import json
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from arm import HERE

QUICK_SETS = ("ur10", "closed_loop")
QUICK_METHODS = ("jaxid", "NumPy and Pinocchio", "FIGAROH")
WORKERS = 2
"""Processes that run at once."""
LIMIT = 900
"""Seconds after which a method is stopped."""


def sets():
    """Return the loaders of all robots by their names."""
    from sets import measured, simulated

    return {**measured.SETS, **simulated.SETS}


def methods():
    """Return all methods by their names, ours last: rivals stand first."""
    from methods import conic, figaroh_default, instruments, ours, pinocchio_script

    modules = (pinocchio_script, figaroh_default, instruments, conic, ours)
    found = {}
    for module in modules:
        found |= module.METHODS
    return found


def load(name, folder):
    """Return one of the robots; simulated ones are recorded into a folder."""
    from sets import measured

    loader = sets()[name]
    if name in measured.SETS:
        return loader()
    place = Path(folder) / name
    place.mkdir(exist_ok=True)
    return loader(place)


def measure(set_name, method_name, folder):
    """Return the figures of one method on one robot."""
    import resource

    import jax

    jax.config.update("jax_enable_x64", True)
    import score

    arm = load(set_name, folder)
    unseen = arm.signals(unseen=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    method = methods()[method_name]
    seconds = []
    for _ in range(2):
        start = time.process_time()
        result = method(arm)
        seconds.append(time.process_time() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    total, joints = score.torque_errors(result, unseen)
    simulations = [score.simulation_errors(result, unseen, x) for x in score.HORIZONS]
    return {
        "torque": total,
        "joints": joints.tolist(),
        "simulations": simulations,
        "definite": score.definite_share(result, unseen),
        "plausible": score.plausible_share(result.bodies),
        "seconds": seconds,
        "megabytes": peak / 1024,
    }


def lines_of(method):
    """Return the code lines of a method and of what it uses of its own module."""
    module = sys.modules[method.__module__]
    names = [method.__name__]
    count = 0
    while names:
        name = names.pop()
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
    try:
        done = subprocess.run(
            [*command, "--folder", str(folder)],
            capture_output=True,
            text=True,
            check=False,
            timeout=LIMIT,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    except subprocess.TimeoutExpired:
        return {"reason": f"stopped after {LIMIT} s"}
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no reason"])[-1]
        return {"reason": reason[:200]}
    return json.loads(done.stdout.splitlines()[-1])


def main():
    """Run what is asked for, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*")
    parser.add_argument("--quick", action="store_true", help="two robots")
    parser.add_argument("--write", action="store_true", help="write README and JSON")
    parser.add_argument("--methods", nargs="*", help="only these methods")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(measure(*given.one, given.folder)))
        return
    import table
    from sets import measured
    from timing import DATA

    set_names = given.robots or (QUICK_SETS if given.quick else list(sets()))
    if not DATA.is_dir():
        set_names = [name for name in set_names if name not in measured.SETS]
    method_names = QUICK_METHODS if given.quick else list(methods())
    method_names = given.methods or method_names
    results = {}
    with tempfile.TemporaryDirectory() as folder:
        for set_name in set_names:
            load(set_name, folder)  # simulated ones are recorded once
        pairs = [(x, y) for x in set_names for y in method_names]
        with ThreadPoolExecutor(WORKERS) as pool:
            measured_pairs = pool.map(lambda x: run_pair(*x, folder), pairs)
            for (set_name, method_name), pair in zip(
                pairs, measured_pairs, strict=True
            ):
                results.setdefault(set_name, {})[method_name] = pair
                print(table.line(set_name, method_name, pair), flush=True)
    lines = {name: lines_of(method) for name, method in methods().items()}
    print(table.text(results, lines))
    if given.write:
        table.write(results, lines)


if __name__ == "__main__":
    main()
