"""Dynamics, batches of data sets and the design of a motion on a GPU.

    python benchmarks/gpu.py [--quick] [--json FILE]

All functions are compiled; arrays lie on the GPU; a call blocks until its result is
there. Without a GPU there is one row that says so, unless `--quick` is given. Values
are compared with NumPy's. All of it takes less than four minutes.
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
    """Return the median time of a call [ms], and that of the first, which compiles [s].

    The result of the last call comes third.
    """
    import jax

    seconds = []
    for _ in range(TURNS + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds[1:]), seconds[0], result


def error(result, expected):
    """Return the largest difference of the first samples, relative to the largest."""
    import numpy as np

    difference = np.asarray(result[: len(expected)]) - expected
    return np.abs(difference).max() / np.abs(expected).max()


def dynamics(samples, recipe):
    """Measure functions of a model in both precisions, and compare them with NumPy."""
    import jax
    import numpy as np
    from pinocchio_loop import Bodies

    import jaxid as jid

    robot = jid.robots.panda()
    model = jid.Model(robot)
    bodies = Bodies(robot.joints).parameters.ravel()
    p = np.concatenate([bodies, np.full(model.size - bodies.size, 0.2)])
    arrays = np.random.default_rng(0).uniform(-1.0, 1.0, (3, samples, robot.joints))

    def regressor(*motion):
        return model.regressor(jid.Motion(*motion))

    def gram(*motion):
        return model.gram(jid.Motion(*motion))

    # Function, parameters, samples, and what is asked in both precisions [ms].
    some = arrays[:, : samples // 4]
    functions = {
        "inverse_dynamics": (model.inverse_dynamics, (p,), arrays, (0.55, 0.35)),
        "mass_matrix": (model.mass_matrix, (p,), arrays[:1], (1.2, 0.8)),
        "forward_dynamics": (model.forward_dynamics, (p,), arrays, (1.5, 1.0)),
        "regressor": (regressor, (), some, (1.6, 0.9)),
        "gram": (gram, (), arrays, None),
    }
    rows = []
    for name, (function, parameters, motion, asked) in functions.items():
        times = []
        words = []
        few = motion[:, :1000]
        for precision in (np.float64, np.float32):
            on_device = [
                jax.numpy.asarray(x, precision) for x in (*parameters, *motion)
            ]
            milliseconds, first, result = median_time(jax.jit(function), *on_device)
            times.append(milliseconds)
            said = (
                f"{precision.__name__} {milliseconds:.2f} ms, first call {first:.1f} s"
            )
            if precision is np.float64:
                plain, _, _ = median_time(function, *on_device)
                said += f", without jit {plain:.2f} ms"
            if name != "gram":
                said += f", error {error(result, function(*parameters, *few)):.0e}"
            words.append(said)
        target = "-" if asked is None else f"{asked[0]}, float32 {asked[1]} ms"
        holds = None if asked is None else bool((np.array(times) <= asked).all())
        what = f"{name}, {motion.shape[1]:,} samples"
        rows.append(Row("gpu", what, recipe, target, "; ".join(words), holds))
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
    for words, function, asked in (
        ("rows independent", independent, 4.0),
        ("`row_time` given", correlated, 10.0),
    ):
        compiled, first, _ = median_time(jax.jit(function), *on_device)
        plain, _, _ = median_time(function, *on_device)
        said = (
            f"{compiled:.1f} ms, without jit {plain:.1f} ms, first call {first:.1f} s"
        )
        target = f"{asked} ms, without jit 1.3x"
        holds = compiled <= asked and plain <= 1.3 * compiled
        rows.append(Row("gpu", f"{what}, {words}", recipe, target, said, holds))
    return rows


def design(seconds, recipe):
    """Measure the search for a motion of the paper's robot, in a limited time."""
    import excitation
    import jax

    import jaxid as jid

    base = excitation.base_of(True)
    start = time.perf_counter()
    plan = jid.design_excitation(
        base, key=jax.random.key(0), throw=False, seconds=seconds
    )
    duration = time.perf_counter() - start
    (gain, *_) = excitation.Evaluation([base]).gains(plan.trajectory)
    said = f"gain {gain:.2f} in {duration:.1f} s with compiling"
    holds = gain >= 2.35 and duration <= 10.0
    what = f"design_excitation of the paper's robot, `seconds={seconds:g}`"
    return [Row("gpu", what, recipe, "gain 2.35 in 10 s", said, bool(holds))]


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
    for seconds in (3.0,) if options.quick else (9.0, 60.0):
        rows += design(seconds, recipe)
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
