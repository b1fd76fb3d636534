"""Cost of the regressor and of `identify` by numbers of samples, joints and cores.

    python benchmarks/scaling.py [--quick] [--json FILE]

Writes `benchmarks/scaling.png` (nothing with `--quick`). Samples and joints: the
regressor on one core, ten parameters for each body, in a process of its own; from 16
384 samples on, ours goes through chunks of that size. A tree: the humanoid Talos with
32 joints (with `--quick` one arm).
Cores: `identify` of one log with every sample a row, on several cores, one process
for each number. Medians.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import timing
from timing import HERE, Row, hand_over, interleaved

CHUNK = 16384
LOG = 400_000
CORES = (1, 2)
SAMPLES = (1, 30, 1000, 16_384, 131_072, 1_048_576)
JOINTS = (2, 4, 7, 12, 20, 30)
PYTHON_UP_TO, CPP_UP_TO = 1000, 131_072


def chain(joints):
    """Return a serial arm: every second axis turned by 90 degrees, links of 0.3 m."""
    import numpy as np

    import jaxid as jid

    rows = [(np.pi / 2 * (k % 2), 0.3, 0.1 * (k % 3)) for k in range(joints)]
    return jid.from_dh(rows, convention="modified", name=f"chain of {joints}")


def cases_of(robot, samples, packed):
    """Return calls on some samples by name, and their numbers of samples."""
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
    """Return nanoseconds per sample by name: {name: [(x, ns)]}."""
    out = {}
    for x, cases in points:
        times = interleaved({name: call for name, (call, _) in cases.items()}, turns)
        for name, (_, samples) in cases.items():
            out.setdefault(name, []).append((x, times[name].median / samples * 1e9))
    return out


def by_samples(sizes, turns):
    """Measure the regressor of a Panda against the number of samples."""
    import jaxid as jid

    model = jid.Model(jid.robots.panda(), (jid.RigidBodies(),))
    ready = {}

    def points():
        from peers import compiled_regressor, motion

        def packed(state):
            size = len(state[0])
            if size not in ready:
                ready[size] = compiled_regressor(model, state)
            return ready[size]

        for samples in sizes:
            cases = cases_of(model.robot, samples, packed)
            if samples <= 4096:
                rows = jid.Motion(*motion(model.robot.joints, samples))
                cases["jaxid, NumPy"] = (
                    lambda m=rows: model.packed_regressor(m),
                    samples,
                )
            yield samples, cases

    return curves(points(), turns)


def by_joints(robots, samples, turns):
    """Measure the regressor and its compile time against the number of joints."""
    import jaxid as jid

    compiling = []

    def points():
        from peers import compiled_regressor, count_operations

        for robot in robots:
            model = jid.Model(robot, (jid.RigidBodies(),))

            def packed(state, model=model):
                call, seconds = timing.elapsed(lambda: compiled_regressor(model, state))
                compiling.append((model.robot.joints, seconds))
                return call

            yield robot.joints, cases_of(robot, samples, packed)
            print(f"{robot.joints} joints: {count_operations(model).total} operations")

    return curves(points(), turns), compiling


def humanoid(quick):
    """Measure a tree of 32 joints, or an arm of it (row 7)."""
    for module in ("pinocchio", "cmeel"):
        if timing.missing(module):
            return [Row("7", "tree", "-", "-", timing.missing(module))]
    import cmeel

    import jaxid as jid

    shared = (
        Path(next(iter(cmeel.__path__))).parent
        / "cmeel.prefix/share/example-robot-data"
    )
    name = "talos_left_arm" if quick else "talos_reduced"
    robot = jid.load_urdf(shared / f"robots/talos_data/robots/{name}.urdf")
    n, samples = robot.joints, 512 if quick else 2048
    found, ((_, seconds),) = by_joints([robot], samples, 5)
    said = ", ".join(f"{name} {points[0][1]:.0f} ns" for name, points in found.items())
    recipe = f"{robot.name}, {n} joints, {10 * n} columns, N = {samples}, one core"
    what, limit = f"{n}-joint tree, compile", "<= 60 s"
    return [
        Row("7a", what, recipe, limit, f"{seconds:.1f} s", seconds <= 60),
        Row("7b", f"{n}-joint tree, regressor by sample", recipe, "-", said),
    ]


def identified(samples, turns):
    """Return seconds for one log, and scaled estimates."""
    import numpy as np
    from batches import motions, seven_axes

    import jaxid as jid

    base = seven_axes()
    motion = motions(1, samples, base.model.robot.joints)[0]
    random = np.random.default_rng(1)
    forces = np.asarray(base.inverse_dynamics(random.normal(size=base.size), motion))
    forces = forces + 0.1 * random.normal(size=forces.shape)
    arrays = motion.q, motion.qd, motion.qdd, forces
    log = jid.Observations.of(*arrays, sample_time=1e-3)
    naive = jid.uncertainty.IndependentRows()

    def identify():
        return jid.identify(base, log, jid.estimators.LeastSquares(), uncertainty=naive)

    fit = identify()
    seconds = interleaved({"identify": identify}, turns)["identify"].median
    scaled = np.asarray(fit.parameters) / np.asarray(fit.standard_deviations)
    return seconds, scaled.tolist()


def by_cores(numbers, samples, turns):
    """Return ns per sample for numbers of cores, and the distance of estimates."""
    import numpy as np

    found, scaled = [], []
    for cores in numbers:
        given = [
            "--cores",
            str(cores),
            "--samples",
            str(samples),
            "--turns",
            str(turns),
        ]
        done = subprocess.run(
            [sys.executable, __file__, *given], capture_output=True, text=True
        )
        if done.returncode:
            sys.exit(f"{cores} cores: {done.stderr[-2000:]}")
        seconds, estimates = json.loads(done.stdout.splitlines()[-1])
        found.append((cores, seconds / samples * 1e9))
        scaled.append(np.array(estimates))
        print(f"{cores} core(s): {seconds:.3f} s for {samples} samples", flush=True)
    away = max(
        np.linalg.norm(x - scaled[0]) / np.linalg.norm(scaled[0]) for x in scaled
    )
    return found, float(away)


# Colours that people with any colour vision can distinguish (Okabe and Ito), and
# markers.
STYLES = {
    "jaxid, compiled": ("#0072B2", "o-"),
    "jaxid, NumPy": ("#56B4E9", "v--"),
    "Pinocchio, C++ loop": ("#D55E00", "s-"),
    "Pinocchio, Python loop": ("#CC79A7", "^--"),
}


def plot(samples, joints, compiling, cores, path):
    """Draw the four curves."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullFormatter, ScalarFormatter

    plt.rcParams["font.size"] = 11
    figure, panels = plt.subplots(2, 2, figsize=(11, 8), layout="constrained")
    (first, second), (third, fourth) = panels
    for axes, found in ((first, samples), (second, joints)):
        for name, (colour, style) in STYLES.items():
            if name in found:
                axes.plot(
                    *zip(*found[name], strict=True), style, color=colour, label=name
                )
        axes.set(yscale="log", ylabel="regressor, time per sample [ns]")
    first.set(xscale="log", xlabel="samples in a call", title="seven joints, one core")
    first.legend()
    second.set(xlabel="joints", title="serial arms, 2048 samples, one core")
    third.plot(*zip(*compiling, strict=True), "o-", color="#0072B2")
    third.set(xlabel="joints", ylabel="trace and compile, once [s]", ylim=(0, None))
    third.set_title("serial arms, one core")
    numbers, costs = zip(*cores, strict=True)
    cores = (
        len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count()
    )
    ideal = [costs[0] / min(n, cores or 1) for n in numbers]
    fourth.plot(numbers, costs, "o-", color="#0072B2", label="`identify`, measured")
    fourth.plot(numbers, ideal, ":", color="black", label=f"ideal on {cores} cores")
    fourth.set(
        xscale="log", xlabel="cores", ylabel="time per sample [ns]", ylim=(0, None)
    )
    fourth.set_title(f"{LOG} samples, seven joints with friction")
    fourth.set_xticks(numbers)
    fourth.xaxis.set_major_formatter(ScalarFormatter())
    fourth.xaxis.set_minor_formatter(NullFormatter())
    fourth.legend()
    for axes in panels.flat:
        axes.grid(True, which="major", alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def on_one_core(quick):
    """Measure cost by samples and joints, and compile times, on one core."""
    sizes, joints = ((1, 100), (2, 3)) if quick else (SAMPLES, JOINTS)
    by_size = by_samples(sizes, 5)
    by_joint, compiling = by_joints(map(chain, joints), 256 if quick else 2048, 5)
    return by_size, by_joint, compiling, [asdict(row) for row in humanoid(quick)]


def elsewhere(quick):
    """Return the same from a process of its own, since it is pinned to one core."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "curves.json"
        given = ["--one-core", str(path), *["--quick"] * quick]
        if subprocess.run([sys.executable, "-u", __file__, *given]).returncode:
            sys.exit("the curves on one core were not measured")
        return json.loads(path.read_text())


def table(samples, joints, compiling, cores, away):
    """Return the rows of all curves."""
    ten = "ten parameters per body, one core, median of 5 turns"

    def line(points, unit="ns"):
        return ", ".join(f"{x}: {y:.0f} {unit}" for x, y in points)

    rows = [
        Row("9a", f"regressor by samples, {name}", f"Panda, {ten}", "-", line(points))
        for name, points in samples.items()
    ]
    rows += [
        Row(
            "9b",
            f"regressor by joints, {name}",
            f"arms, {ten}, N = 2048",
            "-",
            line(points),
        )
        for name, points in joints.items()
    ]
    rows.append(
        Row(
            "9c",
            "trace + compile of the regressor by joints",
            "serial arms, one core",
            "-",
            "; ".join(f"{n}: {seconds:.1f} s" for n, seconds in compiling),
        )
    )
    rows.append(
        Row(
            "9d",
            "`identify` by cores, per sample",
            f"Panda with friction, {LOG} samples, each a row; "
            f"estimates of all are {away:.0e} apart (columns of length one)",
            "the same to 1e-12",
            line(cores),
            away <= 1e-12,
        )
    )
    return rows


def main():
    """Measure rows 7 and 9, and draw the plot."""
    parser = timing.parser(__doc__, "few points, no plot")
    parser.add_argument("--one-core", help=argparse.SUPPRESS)
    parser.add_argument("--cores", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--samples", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--turns", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.cores:
        timing.pin_to(options.cores)
        for name in timing.THREADS:
            os.environ[name] = "1"
        print(json.dumps(identified(options.samples, options.turns)))
        return
    if options.one_core:
        timing.pin_to(1)
        Path(options.one_core).write_text(json.dumps(on_one_core(options.quick)))
        return
    samples, joints, compiling, trees = elsewhere(options.quick)
    if options.quick:
        cores, away = by_cores((1, 2), 110_000, 3)
    else:
        cores, away = by_cores(CORES, LOG, 5)
        plot(samples, joints, compiling, cores, HERE / "scaling.png")
    rows = [Row(**row) for row in trees] + table(
        samples, joints, compiling, cores, away
    )
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
