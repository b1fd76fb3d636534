"""Compile times: cold, and from JAX's persistent compilation cache.

    python benchmarks/compile.py [--quick] [--json FILE]

Each figure is a process of its own: one without a cache, one that fills a cache in an
empty folder, one that finds it there. The time runs from the definition in JAX to the
function that can be called: tracing to a scalar program, lowering by XLA, compiling.
Imports are not counted.
"""

import json
import subprocess
import sys
import tempfile
import time

import timing
from timing import Row, elapsed, hand_over, interleaved

WHAT = {
    "regressor": "regressor of the Panda, 91 columns, packed",
    "design": "D-optimality of a Fourier motion and its gradient",
}
LIMITS = {"regressor": 5.0, "design": 10.0}


def regressor_function():
    """Return the packed regressor of seven joints with friction and rotors (row 6a)."""
    import jax
    import jax.numpy as jnp

    import jaxid as jid

    model = jid.Model(jid.robots.panda())
    arrays = [jnp.zeros((16384, model.robot.joints))] * 3
    return jax.jit(lambda *x: model.packed_regressor(jid.Motion(*x)).values), arrays


def design_function():
    """Return the D-optimality of 800 samples with its gradient (row 6c)."""
    import jax

    import jaxid as jid

    problem = jid.ExcitationProblem(jid.base_parameters(jid.Model(jid.robots.panda())))
    return jax.jit(jax.value_and_grad(problem.value)), problem.random(jax.random.key(0))


def work(name, cache, turns):
    """Print the times of one process as JSON."""
    timing.pin_to(2)
    import jax
    import numpy as np

    if cache:
        jax.config.update("jax_compilation_cache_dir", cache)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    # The first compilation sets up JAX, which does not count.
    jax.block_until_ready(jax.jit(lambda x: x + 1)(np.zeros(3)))
    cpu = time.process_time()
    prepare = regressor_function if name == "regressor" else design_function
    (function, arguments), preparing = elapsed(prepare)
    arguments = arguments if isinstance(arguments, list) else [arguments]
    lowered, lowering = elapsed(lambda: function.lower(*arguments))
    run, compiling = elapsed(lowered.compile)
    times = {"prepare": preparing, "lower": lowering, "compile": compiling}
    out = times | {"cpu": time.process_time() - cpu}
    if turns:
        found = interleaved(
            {name: lambda: jax.block_until_ready(run(*arguments))}, turns
        )[name]
        out |= {"median": found.median, "best": found.best}
    print(json.dumps(out))


def measure(name, cache="", turns=0):
    """Return the times of a process of its own."""
    command = [
        sys.executable,
        __file__,
        "--work",
        name,
        "--cache",
        cache,
        "--turns",
        str(turns),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name}: {done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def total(times):
    """Return the seconds from the definition to the compiled function."""
    return times["lower"] + times["compile"]


def words(times):
    """Return the parts of the time in words."""
    parts = ", ".join(f"{k} {times[k]:.2f}" for k in ("lower", "compile"))
    return (
        f"{total(times):.2f} s ({parts}; {times['cpu']:.1f} s of CPU time with set-up)"
    )


def main():
    """Measure compile times, cold and cached, and the run time of a criterion."""
    parser = timing.parser(__doc__, "only the regressor")
    parser.add_argument("--work", choices=WHAT, help="one process: prints its times")
    parser.add_argument(
        "--cache", default="", help="folder of the cache of that process"
    )
    parser.add_argument(
        "--turns", type=int, default=0, help="timed calls of that process"
    )
    options = parser.parse_args()
    if options.work:
        work(options.work, options.cache, options.turns)
        return
    rows, recipe = [], "two cores, one process for each figure"
    for key, name in zip("ac", ("regressor",) if options.quick else WHAT, strict=False):
        with tempfile.TemporaryDirectory() as folder:
            first, again = measure(name, folder), measure(name, folder)
        cold = measure(name, turns=0 if name == "regressor" else 25)
        best, limit = min(total(first), total(cold)), LIMITS[name]
        said = f"{words(cold)}; once more, filling the cache: {total(first):.2f} s"
        asked = f"<= {limit:g} s"
        rows.append(
            Row(f"6{key}", f"{WHAT[name]}, cold", recipe, asked, said, best <= limit)
        )
        number, holds = f"6{chr(ord(key) + 1)}", total(again) <= 1.0
        rows.append(
            Row(number, f"{WHAT[name]}, cached", recipe, "<= 1 s", words(again), holds)
        )
        if "median" in cold:
            said = f"{cold['median'] * 1e3:.2f} ms (best {cold['best'] * 1e3:.2f} ms)"
            title = f"{WHAT[name]}, warm run"
            rows.append(
                Row("6e", title, recipe, "<= 2.5 ms", said, cold["median"] <= 2.5e-3)
            )
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
