"""The column of a GPU: regressor, inverse dynamics, fences and a design's criterion on it.

    python benchmarks/gpu.py [--quick] [--json FILE]

It takes the first GPU that JAX finds; without one it says so and ends well. Results stay in the
GPU's memory. The numbers of the rows are those of the other scripts, so that `run.py` puts them
beside what the CPU does.
"""

import argparse
import os

import timing
from timing import Row, hand_over, interleaved

REGRESSOR, FORCES, DESIGN = "2", "3a", "6e"


def dynamics(name, samples, turns):
    """Regressor and inverse dynamics of the Panda."""
    from peers import forces_of, motion, packed_columns, per_sample
    from pinocchio_loop import Bodies

    import jaxid as jid

    robot = jid.robots.panda()
    model = jid.Model(robot, (jid.RigidBodies(),))
    state = motion(robot.joints, samples)
    p = Bodies(robot.joints).parameters.ravel()
    (_, regressor), compiling = timing.elapsed(lambda: packed_columns(model, state))
    times = interleaved({"regressor": regressor, "forces": forces_of(model, p, state)}, turns)
    recipe = (
        f"{name}, Panda, 70 columns, float64, N = {samples}, median of {turns} turns, trace and "
        f"compile of the regressor {compiling:.1f} s"
    )
    said = {key: f"{per_sample(value, samples)} (N = {samples})" for key, value in times.items()}
    return [
        Row(REGRESSOR, "regressor on a GPU", recipe, "-", said["regressor"]),
        Row(FORCES, "inverse dynamics on a GPU", recipe, "-", said["forces"]),
    ]


def criterion(name, turns):
    """Value and gradient of the design's criterion, 800 samples."""
    import jax
    import jax.numpy as jnp
    from design import arm_and_series, design_cost

    base, series = arm_and_series()
    function = jax.jit(jax.value_and_grad(design_cost(base, series)))
    coefficients = (jnp.asarray(series.a), jnp.asarray(series.b))
    run, compiling = timing.elapsed(lambda: function.lower(coefficients).compile())
    call = {"design": lambda: jax.block_until_ready(run(coefficients))}
    median = interleaved(call, turns)["design"].median
    recipe = f"{name}, Panda, 800 samples, median of {turns} turns, lower and compile "
    what = "log det of the information matrix and its gradient, on a GPU"
    recipe += f"{compiling:.1f} s"
    return [Row(DESIGN, what, recipe, "-", f"{median * 1e3:.2f} ms")]


def fenced(name, samples, turns):
    """What each fence does there."""
    import jax
    from fences import measure, row

    from jaxid.program import default_fence

    found = measure(samples, turns)
    without = {case.pair: case for case in found if case.name == "NoFence"}
    chosen = default_fence(jax.default_backend(), jax.__version_info__)
    recipe = f"{name}, Panda, 70 columns, N = {samples}, {turns} turns; the fence that is used "
    recipe += f"there: {type(chosen).__name__}"
    return [
        row(case, without[case.pair], chosen, recipe) for case in found if case.name != "NoFence"
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples and turns")
    parser.add_argument("--anywhere", action="store_true", help="on what JAX has, if it has no GPU")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    os.environ["JAX_ENABLE_X64"] = "1"
    import jax

    if jax.default_backend() != "gpu" and not options.anywhere:
        hand_over([Row("G", "the column of a GPU", "-", "-", "no GPU at hand")], options.json)
        return
    name = f"{jax.devices()[0].device_kind}, jax {jax.__version__}"
    samples, turns = (2**12, 5) if options.quick else (2**20, 15)
    rows = dynamics(name, samples, turns) + fenced(name, samples // 8, turns)
    hand_over(rows + criterion(name, turns), options.json)


if __name__ == "__main__":
    main()
