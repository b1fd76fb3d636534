"""The GPU column: regressor and inverse dynamics on a GPU, where JAX finds one.

    python benchmarks/gpu.py [--quick] [--json FILE]

Without a GPU it says so and ends well. Results stay in the GPU's memory.
"""

import argparse
import os

import timing
from timing import Row, hand_over, interleaved


def measure(samples, turns):
    import jax
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
        f"{jax.devices()[0].device_kind}, Panda, 70 columns, float64, N = {samples}, "
        f"median of {turns} turns, trace and compile of the regressor {compiling:.1f} s"
    )
    return [
        Row("G1", "regressor on a GPU", recipe, "-", per_sample(times["regressor"], samples)),
        Row("G2", "inverse dynamics on a GPU", recipe, "-", per_sample(times["forces"], samples)),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples and turns")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    os.environ["JAX_ENABLE_X64"] = "1"
    import jax

    if jax.default_backend() != "gpu":
        row = Row("G", "regressor and inverse dynamics on a GPU", "-", "-", "no GPU at hand")
        hand_over([row], options.json)
        return
    hand_over(measure(2**14 if options.quick else 2**20, 5 if options.quick else 15), options.json)


if __name__ == "__main__":
    main()
