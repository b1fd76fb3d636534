"""Dynamics and batches of data sets on a GPU.

    python benchmarks/gpu.py [--quick] [--json FILE]

All functions are compiled; arrays lie on the GPU; a call blocks until its result is
there. Without a GPU there is one row that says so, unless `--quick` is given.
"""

import os
import statistics
import time

import timing
from timing import Row, hand_over

TURNS = 15
"""Calls of each function; their median counts."""
ROW_TIME = 0.0125
"""Time between two rows of a data set [s]."""


def median_time(function, *arguments):
    """Return the median time of a call [ms] after one that compiles."""
    import jax

    seconds = []
    for _ in range(TURNS + 1):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds[1:])


def dynamics(samples, recipe):
    """Measure functions of a model in both precisions."""
    import jax
    import numpy as np
    from pinocchio_loop import Bodies

    import jaxid as jid

    robot = jid.robots.panda()
    model = jid.Model(robot)
    bodies = Bodies(robot.joints).parameters.ravel()
    p = np.concatenate([bodies, np.full(model.size - bodies.size, 0.2)])
    arrays = np.random.default_rng(0).uniform(-1.0, 1.0, (3, samples, robot.joints))
    some = samples // 4
    functions = {
        f"inverse_dynamics, {samples:,} samples": (
            model.inverse_dynamics,
            (p, *arrays),
        ),
        f"mass_matrix, {samples:,} samples": (model.mass_matrix, (p, arrays[0])),
        f"forward_dynamics, {samples:,} samples": (
            model.forward_dynamics,
            (p, *arrays),
        ),
        f"regressor, {some:,} samples": (
            lambda *motion: model.regressor(jid.Motion(*motion)),
            tuple(arrays[:, :some]),
        ),
    }
    rows = []
    for name, (function, arguments) in functions.items():
        times = []
        for precision in (np.float64, np.float32):
            on_device = [jax.numpy.asarray(x, precision) for x in arguments]
            times.append(median_time(jax.jit(function), *on_device))
        said = f"{times[0]:.2f} ms, float32 {times[1]:.2f} ms"
        rows.append(Row("gpu", name, recipe, "-", said))
    return rows


def batches(sets, samples, recipe):
    """Measure `identify_batch` with and without compiling."""
    import jax
    import numpy as np
    from batches import motions, seven_axes

    import jaxid as jid

    base = seven_axes()
    motion = motions(sets, samples, base.model.robot.joints)
    random = np.random.default_rng(1)
    forces = np.asarray(base.inverse_dynamics(random.normal(size=base.size), motion))
    forces = forces + 0.1 * random.normal(size=forces.shape)
    on_device = jax.tree.map(jax.numpy.asarray, (motion, forces))

    def independent(motion, forces):
        return jid.identify_batch(base, motion, forces)

    def correlated(motion, forces):
        return jid.identify_batch(base, motion, forces, row_time=ROW_TIME)

    what = f"identify_batch, {sets} data sets of {samples} samples"
    rows = []
    for words, function in (
        ("rows independent", independent),
        ("`row_time` given", correlated),
    ):
        compiled = median_time(jax.jit(function), *on_device)
        plain = median_time(function, *on_device)
        said = f"{compiled:.1f} ms, without jit {plain:.1f} ms"
        rows.append(Row("gpu", f"{what}, {words}", recipe, "-", said))
    return rows


def main():
    """Print the rows."""
    options = timing.parser(__doc__, "small, on any device").parse_args()
    os.environ["JAX_ENABLE_X64"] = "1"
    import jax

    if jax.default_backend() != "gpu" and not options.quick:
        hand_over([Row("gpu", "a GPU", "-", "-", "none at hand")], options.json)
        return
    recipe = (
        f"{jax.devices()[0].device_kind}, jax {jax.__version__}, Panda with friction, "
        f"float64, median of {TURNS} calls"
    )
    rows = dynamics(2**10 if options.quick else 2**20, recipe)
    rows += batches(*(4, 100) if options.quick else (1000, 800), recipe)
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
