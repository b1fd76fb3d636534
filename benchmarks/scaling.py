"""Plots of the regressor's cost: against the number of samples, and of joints.

    python benchmarks/scaling.py [--quick] [--json FILE]

Writes `benchmarks/scaling.png` (with `--quick`, nothing). From 16 384 samples on, ours goes
through chunks of that size, as one would through a long recording.
"""

import argparse

import timing
from timing import REPOSITORY, Row, hand_over, interleaved

CHUNK = 16384
SAMPLES = (1, 30, 1000, 16_384, 131_072, 1_048_576)
JOINTS = (2, 4, 7, 12, 20, 30)
PYTHON_UP_TO, CPP_UP_TO = 1000, 131_072


def chain(joints):
    """A serial arm: every second axis turned by a quarter, links of 0.3 m."""
    import numpy as np

    import jaxid as jid

    rows = [(np.pi / 2 * (k % 2), 0.3, 0.1 * (k % 3)) for k in range(joints)]
    return jid.from_dh(rows, convention="modified", name=f"chain of {joints}")


def cases_of(robot, samples, packed):
    """What runs on so many samples: by name, a call and the number of samples that it does."""
    import numpy as np
    from peers import motion
    from pinocchio_loop import Bodies, Loop, pinocchio_model

    n, bodies = robot.joints, Bodies(robot.joints)
    state = motion(n, min(samples, CHUNK))
    chunks = -(-samples // CHUNK)
    once = packed(state)

    def ours():
        for _ in range(chunks):
            once()

    cases = {"jaxid, compiled": (ours, chunks * len(state[0]))}
    if timing.missing("pinocchio") is None:
        import pinocchio as pin

        pinned = pinocchio_model(robot, bodies)
        data, few = pinned.createData(), [x[:PYTHON_UP_TO] for x in state]

        def looped():
            out = np.empty((len(few[0]), n, 10 * n))
            for k, (q, v, a) in enumerate(zip(*few, strict=True)):
                out[k] = pin.computeJointTorqueRegressor(pinned, data, q, v, a)
            return out

        if samples <= PYTHON_UP_TO:
            cases["Pinocchio, Python loop"] = (looped, len(few[0]))
        if samples <= CPP_UP_TO:
            try:
                loop = Loop(robot, bodies, *state)

                def native():
                    for _ in range(chunks):
                        loop.regressors()

                cases["Pinocchio, C++ loop"] = (native, chunks * len(state[0]))
            except RuntimeError as problem:
                print(f"Pinocchio in C++ skipped: {problem}")
    return cases


def curves(points, turns):
    """Nanoseconds per sample by name: {name: [(x, ns)]}."""
    out = {}
    for x, cases in points:
        times = interleaved({name: call for name, (call, _) in cases.items()}, turns)
        for name, (_, samples) in cases.items():
            out.setdefault(name, []).append((x, times[name].median / samples * 1e9))
    return out


def by_samples(sizes, turns):
    import jaxid as jid
    from jaxid.dynamics.machine import program_of
    from jaxid.program import evaluate_packed

    robot = jid.robots.panda()
    model = jid.Model(robot, (jid.RigidBodies(),))
    n = (robot.joints,)
    program = program_of(model, model.columns, n, n, n)

    ready = {}

    def points():
        from peers import motion, packed_columns

        def packed(state):
            size = len(state[0])
            if size not in ready:
                ready[size] = packed_columns(model, state)[1]
            return ready[size]

        for samples in sizes:
            cases = cases_of(robot, samples, packed)
            if samples <= CHUNK:
                arrays = [x.T.copy() for x in motion(robot.joints, samples)]
                numpy = lambda x=arrays: evaluate_packed(program, *x)  # noqa: E731
                cases["jaxid, NumPy"] = (numpy, samples)
            yield samples, cases

    return curves(points(), turns)


def by_joints(sizes, samples, turns):
    import jaxid as jid
    from jaxid.dynamics.machine import program_of

    compiling = []

    def points():
        from peers import packed_columns

        for joints in sizes:
            model = jid.Model(chain(joints), (jid.RigidBodies(),))

            def packed(state, model=model, joints=joints):
                (_, call), seconds = timing.elapsed(lambda: packed_columns(model, state))
                compiling.append((joints, seconds))
                return call

            yield joints, cases_of(model.robot, samples, packed)
            n = (joints,)
            print(f"{joints} joints: {program_of(model, model.columns, n, n, n).counts.total}")

    return curves(points(), turns), compiling


def plot(samples, joints, compiling, path):
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    for axes, found in ((left, samples), (right, joints)):
        for name in sorted({*samples, *joints}):
            if name in found:
                axes.plot(*zip(*found[name], strict=True), "o-", label=name)
        axes.set_yscale("log")
        axes.grid(True, which="major", alpha=0.3)
    left.set(xscale="log", xlabel="samples", ylabel="regressor, ns per sample")
    left.set_title("seven joints, one core")
    left.legend()
    right.set(xlabel="joints")
    right.set_title("serial arms, 2048 samples, one core")
    seconds = right.twinx()
    seconds.plot(*zip(*compiling, strict=True), "k:", label="trace + compile")
    seconds.set(ylabel="trace + compile [s]", ylim=(0, None))
    seconds.legend(loc="lower right")
    figure.savefig(path, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few points, no plot")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    timing.pin_to(1)
    if options.quick:
        by_samples((1, 100), 5)
        _, compiling = by_joints((2, 3), 256, 5)
    else:
        samples = by_samples(SAMPLES, 5)
        joints, compiling = by_joints(JOINTS, 2048, 5)
        plot(samples, joints, compiling, REPOSITORY / "benchmarks/scaling.png")
        for name, points in (*samples.items(), *joints.items()):
            print(name, ", ".join(f"{x}: {ns:.0f} ns" for x, ns in points))
    said = "; ".join(f"{n}: {seconds:.1f} s" for n, seconds in compiling)
    what = "trace + compile of the regressor by joints"
    hand_over([Row("9", what, "serial arms, one core", "-", said)], options.json)


if __name__ == "__main__":
    main()
