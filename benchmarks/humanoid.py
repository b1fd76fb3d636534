"""A tree of about thirty joints: compile time, and cost per sample against Pinocchio.

    python benchmarks/humanoid.py [--quick] [--json FILE]

With `--quick` one arm of the humanoid stands for the whole.
"""

import argparse
from pathlib import Path

import timing
from timing import Row, elapsed, hand_over, interleaved

WHOLE = "talos_data/robots/talos_reduced.urdf"
PART = "talos_data/robots/talos_left_arm.urdf"


def urdf(name):
    import cmeel

    shared = "cmeel.prefix/share/example-robot-data/robots"
    return Path(next(iter(cmeel.__path__))).parent / shared / name


def measure(file, samples, few, turns):
    import jax
    import numpy as np
    import pinocchio as pin
    from peers import motion, per_sample
    from pinocchio_loop import Bodies, Loop, in_our_order, pinocchio_model

    import jaxid as jid
    from jaxid.dynamics.machine import program_of
    from jaxid.program import evaluate, lower

    robot = jid.load_urdf(urdf(file))
    n = robot.joints
    model, bodies = jid.Model(robot, (jid.RigidBodies(),)), Bodies(n)
    program, tracing = elapsed(lambda: program_of(model, model.columns, (n,), (n,), (n,)))
    lowered = lower(program)
    state = motion(n, samples)
    arrays = [jax.numpy.asarray(x.T) for x in state]
    function = jax.jit(lambda *x: [y for y in lowered(*x) if not isinstance(y, float)])
    run, compiling = elapsed(lambda: function.lower(*arrays).compile())
    ours = lambda: jax.block_until_ready(run(*arrays))  # noqa: E731

    pinned = pinocchio_model(robot, bodies)
    data = pinned.createData()
    rows = [x[:few] for x in state]

    def looped():
        out = np.empty((few, n, 10 * n))
        for k, (q, v, a) in enumerate(zip(*rows, strict=True)):
            out[k] = pin.computeJointTorqueRegressor(pinned, data, q, v, a)
        return out

    found = np.moveaxis(evaluate(program, *(x.T for x in rows)), -1, 0)
    np.testing.assert_allclose(found, in_our_order(looped(), n), atol=1e-8)
    cases = {"ours": ours, "Python": looped}
    try:
        loop = Loop(robot, bodies, *state)
        np.testing.assert_allclose(
            in_our_order(loop.regressors()[:few].copy(), n), found, atol=1e-8
        )
        cases["C++"] = loop.regressors
        note = ""
    except RuntimeError as problem:
        note = f"; C++ skipped: {problem}"
    times = interleaved(cases, turns)

    each = dict.fromkeys(cases, samples) | {"Python": few}
    said = [f"ours {per_sample(times['ours'], samples)}"]
    for name in cases:
        if name != "ours":
            ratio = times[name] / times["ours"] * samples / each[name]
            said.append(f"{name} loop {per_sample(times[name], each[name])} = {ratio:.1f}x")
    recipe = (
        f"{robot.name}, {n} joints, {10 * n} columns, {program.counts.total} operations, "
        f"N = {samples}, one core, median of {turns} turns"
    )
    whole = tracing + compiling
    took = f"{whole:.1f} s (trace {tracing:.1f}, XLA {compiling:.1f})"
    return [
        Row("7a", f"{n}-joint tree, trace + compile", recipe, "<= 60 s", took, whole <= 60),
        Row("7b", f"{n}-joint tree, against Pinocchio", recipe, "-", ", ".join(said) + note),
    ]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one arm, few samples")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    timing.pin_to(1)
    for module in ("pinocchio", "cmeel"):
        if timing.missing(module):
            hand_over([Row("7", "tree", "-", "-", timing.missing(module))], options.json)
            return
    file, samples, few, turns = (PART, 512, 32, 5) if options.quick else (WHOLE, 2048, 256, 7)
    hand_over(measure(file, samples, few, turns), options.json)


if __name__ == "__main__":
    main()
