"""Compile times of each function for the robots of `example-robot-data`.

    nice python benchmarks/compile_robots.py [--only TEXT] [--quick] [--json FILE]

CPU seconds of tracing and compiling under `jax.jit`, 1,000 samples, one thread. Robots
stand on the ground, and those with three tips or more also on a floating base. Robots
whose programs have the same numbers of operations are compiled once. All 69 files take
hours; the name of a file chooses robots.
"""

import time
from pathlib import Path

import timing
from timing import Row, hand_over

SAMPLES = 1000
MIN_TIPS_OF_LEGGED_ROBOT = 3
MAX_SECONDS = 16
"""CPU seconds from which XLA may print its message on slow compiling."""
QUICK = "anymal_c"


def functions(model):
    """Return each function with the number of joint arrays that it takes."""
    import jax.numpy as jnp

    import jaxid as jid

    p = jnp.full(model.size, 0.3)
    return {
        "inverse_dynamics": (lambda *x: model.inverse_dynamics(p, *x), 3),
        "mass_matrix": (lambda q: model.mass_matrix(p, q), 1),
        "forward_dynamics": (lambda *x: model.forward_dynamics(p, *x), 3),
        "regressor": (lambda *x: model.regressor(jid.Motion(*x)), 3),
        "packed_regressor": (
            lambda *x: model.packed_regressor(jid.Motion(*x)).values,
            3,
        ),
        "gram": (lambda *x: model.gram(jid.Motion(*x)), 3),
    }


def compile_seconds(robot):
    """Return the CPU seconds of each function of a robot."""
    import jax
    import jax.numpy as jnp

    import jaxid as jid

    model = jid.Model(robot)
    motion = [jnp.zeros((SAMPLES, robot.joints))] * 3
    seconds = {}
    for name, (function, arrays) in functions(model).items():
        start = time.process_time()
        jax.jit(function).lower(*motion[:arrays]).compile()
        seconds[name] = time.process_time() - start
    return seconds


def robots(text):
    """Yield names and robots, fixed to the ground and floating."""
    import cmeel

    import jaxid as jid

    prefix = Path(next(iter(cmeel.__path__))).parent / "cmeel.prefix"
    folder = prefix / "share/example-robot-data/robots"
    for file in sorted(folder.glob("**/*.urdf")):
        name = str(file.relative_to(folder))
        if text not in name:
            continue
        try:
            robot = jid.load_urdf(file)
            yield name, robot
            tips = set(range(robot.joints)) - set(robot.parent)
            if len(tips) >= MIN_TIPS_OF_LEGGED_ROBOT:
                yield f"{name}, floating", jid.load_urdf(file, floating=True)
        except jid.InputError as error:
            print(f"{name}: {error}")


def operations(robot):
    """Return the length of a robot's regressor and inverse dynamics."""
    import jaxid as jid

    model = jid.Model(robot)
    joints = [(robot.joints,)] * 3
    forces = jid.program.trace(model.forces, (model.size,), *joints)
    columns = jid.program.trace(model.columns, *joints)
    return robot.joints, forces.counts, columns.counts


def main():
    """Compile the functions of all robots."""
    parser = timing.parser(__doc__, f"only {QUICK}")
    parser.add_argument("--only", default="", help="files with this text")
    options = parser.parse_args()
    timing.pin_to(1)
    rows = []
    compiled_robots = set()
    for name, robot in robots(QUICK if options.quick else options.only):
        length = operations(robot)
        if length in compiled_robots:
            continue
        compiled_robots.add(length)
        seconds = compile_seconds(robot)
        said = ", ".join(f"`{key}` {value:.1f}" for key, value in seconds.items())
        holds = max(seconds.values()) <= MAX_SECONDS
        what = f"{name}, {robot.joints} joints"
        asked = f"<= {MAX_SECONDS} CPU s"
        rows.append(Row("robots", what, "one thread", asked, f"{said} CPU s", holds))
        print(f"{what}: {said}", flush=True)
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
