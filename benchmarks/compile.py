"""Compile times, apart from run times: cold, and from JAX's persistent compilation cache.

    python benchmarks/compile.py [--quick] [--json FILE]

Each figure is a process of its own: one without a cache, one that fills a cache in an empty folder,
one that finds it there. The time runs from the definition in JAX to the function that can be
called: tracing to a scalar program, XLA's lowering, compiling. Imports are not counted.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time

import timing
from timing import Row, elapsed, hand_over, interleaved


def regressor_work():
    """Row 6a: the regressor of a seven-joint arm with friction and rotors."""
    import jax
    import jax.numpy as jnp

    import jaxid as jid
    from jaxid.dynamics.machine import program_of
    from jaxid.program import lower

    model = jid.Model(jid.robots.panda())
    n = (model.robot.joints,)
    program, tracing = elapsed(lambda: program_of(model, model.columns, n, n, n))
    lowered = lower(program)
    arrays = [jnp.zeros((*n, 16384))] * 3
    function = jax.jit(lambda *x: [y for y in lowered(*x) if not isinstance(y, float)])
    return tracing, function, arrays


def design_work():
    """Row 6b: log det of the information matrix of a Fourier motion, with its gradient."""
    import jax
    import jax.numpy as jnp
    from design import arm_and_series, design_cost

    base, series = arm_and_series()
    cost, tracing = elapsed(lambda: design_cost(base, series))
    coefficients = (jnp.asarray(series.a), jnp.asarray(series.b))
    return tracing, jax.jit(jax.value_and_grad(cost)), (coefficients,)


def worker(name, cache, turns):
    """Prints the times of one process as JSON."""
    timing.pin_to(2)
    import jax
    import numpy as np

    if cache:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    # What JAX sets up once in a process is not the function's.
    jax.block_until_ready(jax.jit(lambda x: x + 1)(np.zeros(3)))
    start, cpu = time.perf_counter(), time.process_time()
    tracing, function, arguments = {"regressor": regressor_work, "design": design_work}[name]()
    prepared = time.perf_counter() - start
    lowered, lowering = elapsed(lambda: function.lower(*arguments))
    run, compiling = elapsed(lowered.compile)
    cpu = time.process_time() - cpu
    out = {
        "cpu": cpu,
        "trace": tracing,
        "lower": lowering,
        "compile": compiling,
        "prepare": prepared,
    }
    if turns:
        if name == "design":
            out["gradient_error"] = gradient_error(function, *arguments)
        times = interleaved({name: lambda: jax.block_until_ready(run(*arguments))}, turns)[name]
        out |= {"median": times.median, "best": times.best}
    print(json.dumps(out))


def gradient_error(function, coefficients):
    """The gradient against a central difference along one direction."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    random = np.random.default_rng(0)
    direction = jax.tree.map(lambda x: jnp.asarray(random.normal(size=x.shape)), coefficients)
    step = 1e-6

    def value(h):
        return function(jax.tree.map(lambda x, d: x + h * d, coefficients, direction))[0]

    difference = (value(step) - value(-step)) / (2 * step)
    gradient = function(coefficients)[1]
    along = sum(jax.tree.leaves(jax.tree.map(lambda g, d: jnp.sum(g * d), gradient, direction)))
    return float(abs(along - difference) / abs(difference))


def measured(name, cache="", turns=0):
    command = [sys.executable, __file__, "--worker", name, "--cache", cache, "--turns", str(turns)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def total(times):
    return times["trace"] + times["lower"] + times["compile"]


def words(times):
    parts = ", ".join(f"{k} {times[k]:.2f}" for k in ("trace", "lower", "compile"))
    return f"{total(times):.2f} s ({parts}; {times['cpu']:.1f} s of CPU time with set-up)"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="only the regressor, once")
    parser.add_argument("--json", help="where to write the rows")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--cache", default="", help=argparse.SUPPRESS)
    parser.add_argument("--turns", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        worker(options.worker, options.cache, options.turns)
        return
    rows = []
    limits = {"regressor": 5.0} if options.quick else {"regressor": 5.0, "design": 10.0}
    what = {
        "regressor": "regressor of the Panda, 91 columns, packed",
        "design": "log det of a Fourier motion's information matrix and its gradient",
    }
    for key, (name, limit) in zip("ac", limits.items(), strict=False):
        recipe = "two cores, one process for each figure"
        if name == "design":
            recipe += "; Panda, base columns with friction and rotors, 800 samples, 5 harmonics"
        with tempfile.TemporaryDirectory() as folder:
            first = measured(name, folder)
            again = measured(name, folder)
        cold = measured(name, turns=0 if name == "regressor" else 25)
        best = min(total(first), total(cold))
        said = f"{words(cold)}; once more, filling the cache: {total(first):.2f} s"
        rows.append(
            Row(f"6{key}", f"{what[name]}, cold", recipe, f"<= {limit:g} s", said, best <= limit)
        )
        holds = total(again) <= 1.0
        following = chr(ord(key) + 1)
        rows.append(
            Row(f"6{following}", f"{what[name]}, cached", recipe, "<= 1 s", words(again), holds)
        )
        if "median" in cold:
            said = (
                f"{cold['median'] * 1e3:.2f} ms (best {cold['best'] * 1e3:.2f} ms; gradient "
                f"against central differences {cold['gradient_error']:.0e})"
            )
            title = f"{what[name]}, warm run"
            rows.append(Row("6e", title, recipe, "<= 2.5 ms", said, cold["median"] <= 2.5e-3))
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
