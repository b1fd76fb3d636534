"""Regressor and inverse dynamics of a seven-joint arm against other packages.

    python benchmarks/peers.py [--quick] [--json FILE]

It starts itself twice: on one core, then on two. What is compared runs in turn in one process, on
the same motion, and is compared number by number before it is timed. Peers that are not installed
are skipped by name.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import timing
from timing import Row, fill, hand_over, interleaved

NS = 1e9


def motion(joints, samples):
    import numpy as np

    random = np.random.default_rng(0)
    return random.uniform(-2, 2, (3, samples, joints))


def compiled(function, *arrays):
    """A function of JAX arrays, compiled for these, as a call that blocks."""
    import jax

    arrays = [jax.numpy.asarray(x) for x in arrays]
    run = jax.jit(function).lower(*arrays).compile()
    return lambda: jax.block_until_ready(run(*arrays))


def packed_columns(model, motion):
    """The varying entries of the regressor, compiled however few the samples, and their program."""
    from jaxid.dynamics.machine import program_of
    from jaxid.program import lower

    n = (model.robot.joints,)
    program = program_of(model, model.columns, n, n, n)
    lowered = lower(program)

    def entries(*x):
        return [y for y in lowered(*x) if not isinstance(y, float)]

    return program, compiled(entries, *(x.T for x in motion))


def packed_regressor(model, motion):
    """The regressor without its zeros, as a call that blocks."""
    import jax

    import jaxid as jid

    rows = jid.Motion(*map(jax.numpy.asarray, motion))
    return lambda: jax.block_until_ready(model.packed_regressor(rows))


def per_sample(times, samples):
    return f"{times.median / samples * NS:.0f} ns"


def compare(number, what, recipe, asked, ours, peer, samples, target):
    ratio = peer / ours
    measured = (
        f"{ratio:.1f}x ({per_sample(ours, samples)} against {per_sample(peer, samples)}); "
        f"best turns {peer.best / ours.best:.1f}x ({ours.best / samples * NS:.0f} ns against "
        f"{peer.best / samples * NS:.0f} ns)"
    )
    return Row(number, what, recipe, asked, measured, ratio >= target)


def with_friction(samples, turns):
    """Row 1: against FIGAROH, on two cores."""
    import jax
    import numpy as np
    from pinocchio_loop import Bodies, in_our_order, pinocchio_model

    import jaxid as jid

    what = "regressor with friction and rotors, against FIGAROH"
    recipe = (
        f"Panda, bodies + viscous + Coulomb (sign) + rotor columns = 91, N = {samples}, two cores "
        f"(FIGAROH's loop uses one of them), median of {turns} turns"
    )
    absent = timing.missing("figaroh") or timing.missing("pinocchio")
    robot = jid.robots.panda()
    n = robot.joints
    friction = jid.CoulombFriction(jid.HardSign())
    terms = (jid.RigidBodies(), jid.ViscousFriction(), friction, jid.RotorInertia())
    model = jid.Model(robot, terms)
    q, qd, qdd = state = motion(n, samples)
    packed = packed_regressor(model, state)

    def matrix():
        return packed().matrix()

    rows = jid.Motion(*map(jax.numpy.asarray, state))
    cases = {
        "packed": packed,
        "matrix": matrix,
        "public": lambda: jax.block_until_ready(model.regressor(rows)),
        "fill": fill(len(packed().values), samples),
    }
    if absent is None:
        from figaroh.tools.regressor import build_regressor_basic

        pinned = pinocchio_model(robot, Bodies(n))
        figaroh_robot = SimpleNamespace(model=pinned, data=pinned.createData())
        config = {"has_friction": True, "has_actuator_inertia": True, "act_idxv": list(range(n))}
        cases["figaroh"] = lambda: build_regressor_basic(figaroh_robot, q, qd, qdd, config)
        theirs = cases["figaroh"]()
        bodies = theirs[:, : 10 * n].reshape(n, samples, 10 * n).swapaxes(0, 1)
        bodies = in_our_order(bodies, n).swapaxes(0, 1).reshape(n * samples, -1)
        np.testing.assert_allclose(matrix()[:, : 10 * n], bodies, atol=1e-9)
        np.testing.assert_allclose(matrix()[:, 10 * n :], theirs[:, 10 * n :], atol=1e-9)
    times = interleaved(cases, turns)
    floor = f"floor: fill of the non-zero entries {per_sample(times['fill'], samples)}"
    recipe = f"{recipe}; {floor}; `Model.regressor` {per_sample(times['public'], samples)}"
    if absent is not None:
        ours = ", ".join(f"{k} {per_sample(times[k], samples)}" for k in ("packed", "matrix"))
        return [Row("1", what, recipe, ">= 25x packed, >= 7x dense", f"{ours}; {absent}")]
    return [
        compare("1a", f"{what}, packed", recipe, ">= 25x (stretch 40x)", times["packed"],
                times["figaroh"], samples, 25),
        compare("1b", f"{what}, Fortran-ordered matrix", recipe, ">= 7x", times["matrix"],
                times["figaroh"], samples, 7),
    ]  # fmt: skip


def one_core(samples, turns):
    """Rows 2, 3 and 4: against Pinocchio in C++, frax and the memory."""
    import numpy as np
    from pinocchio_loop import Bodies, Loop, in_our_order

    import jaxid as jid
    from jaxid.dynamics.machine import program_of

    robot = jid.robots.panda()
    n = robot.joints
    model = jid.Model(robot, (jid.RigidBodies(),))
    state = motion(n, samples)
    bodies = Bodies(n)
    packed = packed_regressor(model, state)
    nonzero = len(packed().values)
    counts = program_of(model, model.columns, (n,), (n,), (n,)).counts
    forces = forces_of(model, bodies.parameters.ravel(), state)
    cases = {"regressor": packed, "forces": forces, "fill": fill(nonzero, samples)}
    notes = []
    try:
        loop = Loop(robot, bodies, *state)
        matrix = packed().matrix()
        theirs = in_our_order(loop.regressors(), n).swapaxes(0, 1).reshape(n * samples, -1)
        np.testing.assert_allclose(matrix, theirs, atol=1e-9)
        np.testing.assert_allclose(np.stack(forces()).T, loop.torques(), atol=1e-9)
        cases |= {"C++ regressor": loop.regressors, "C++ forces": loop.torques}
    except (RuntimeError, ImportError) as problem:
        notes.append(f"Pinocchio in C++ skipped: {problem}")
    absent = timing.missing("frax")
    if absent is None:
        cases["frax"] = frax_forces(state)
    else:
        notes.append(absent)
    times = interleaved(cases, turns)

    rate = timing.flop_rate()
    floor = times["fill"]
    work = counts.multiplications + counts.additions
    recipe = (
        f"Panda, ten parameters per body = 70 columns, {nonzero} non-zero entries, N = {samples}, "
        f"one core, median of {turns} turns; floors: warm fill {per_sample(floor, samples)}, "
        f"{work} operations at {rate / NS:.0f} Gflop/s {work / rate * NS:.0f} ns"
    )
    asked = {2: ">= 3.5x (stretch 5x)", 31: ">= 6x", 32: ">= 30x", 4: "<= 9x (stretch 6x)"}
    ours, torque = times["regressor"], times["forces"]
    rows = []
    if "C++ regressor" in times:
        what = "regressor, against Pinocchio in C++ with store"
        rows.append(
            compare("2", what, recipe, asked[2], ours, times["C++ regressor"], samples, 3.5)
        )
        what = "inverse dynamics, against Pinocchio in C++"
        rows.append(compare("3a", what, recipe, asked[31], torque, times["C++ forces"], samples, 6))
    if "frax" in times:
        what = "inverse dynamics, against frax"
        rows.append(compare("3b", what, recipe, asked[32], torque, times["frax"], samples, 30))
    over = ours / floor
    measured = (
        f"{over:.1f}x ({per_sample(ours, samples)} against {per_sample(floor, samples)}); "
        f"best turns {ours.best / floor.best:.1f}x"
    )
    what = "regressor, against a warm fill of its non-zero entries"
    rows.append(Row("4", what, recipe, asked[4], measured, over <= 9))
    rows += [Row("2-3", "skipped", recipe, "-", note) for note in notes]
    return rows


def forces_of(model, p, state):
    from jaxid.dynamics.machine import program_of
    from jaxid.program import lower

    n = (model.robot.joints,)
    lowered = lower(program_of(model, model.forces, p.shape, n, n, n))
    return compiled(lambda *x: lowered(*x), p, *(x.T for x in state))


def frax_forces(state):
    import jax
    import numpy as np
    from frax.robots.franka_panda import load_panda

    robot = load_panda()
    gravity = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
    each = jax.vmap(lambda q, v, a: robot.rnea(q, v, a, gravity, None))
    return compiled(each, *state)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples and turns")
    parser.add_argument("--cores", type=int, choices=(1, 2), help="only the rows of so many cores")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    turns = 5 if options.quick else 25
    if options.cores is not None:
        timing.pin_to(options.cores)
        samples = 1024 if options.quick else 16384
        rows = with_friction(samples, turns) if options.cores == 2 else one_core(samples, turns)
        hand_over(rows, options.json)
        return
    rows = []
    for cores in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rows.json"
            again = [sys.executable, __file__, "--cores", str(cores), "--json", str(path)]
            subprocess.run([*again, *["--quick"] * options.quick], check=True)
            rows += [Row(**row) for row in json.loads(path.read_text())]
    if options.json:
        from dataclasses import asdict

        Path(options.json).write_text(json.dumps([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
