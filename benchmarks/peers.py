"""Regressor and inverse dynamics of a seven-joint arm against other packages.

    python benchmarks/peers.py [--quick] [--json FILE]

The script starts itself twice: on one core, then on two. What is compared runs in turn
in one process, on the same motion, and is compared number by number before it is timed.
Peers that are not installed are skipped by name.
"""

import json
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import timing
from timing import Row, fill, hand_over, interleaved

NS = 1e9


def motion(joints, samples):
    """Return random positions, velocities and accelerations [samples, joints]."""
    import numpy as np

    random = np.random.default_rng(0)
    return random.uniform(-2, 2, (3, samples, joints))


def compiled(function, *arrays):
    """Compile a function for some arrays; return a call that blocks."""
    import jax

    arrays = [jax.numpy.asarray(x) for x in arrays]
    run = jax.jit(function).lower(*arrays).compile()
    return lambda: jax.block_until_ready(run(*arrays))


def compiled_regressor(model, state):
    """Compile the packed regressor, also for few samples; return a call that blocks."""
    import jaxid as jid

    return compiled(lambda *x: model.packed_regressor(jid.Motion(*x)).values, *state)


def packed_regressor(model, state):
    """Return a call of the packed regressor that blocks."""
    import jax

    import jaxid as jid

    rows = jid.Motion(*map(jax.numpy.asarray, state))
    return lambda: jax.block_until_ready(model.packed_regressor(rows))


def inverse_dynamics(model, p, state):
    """Compile the inverse dynamics; return a call that blocks."""
    import jaxid as jid

    return compiled(lambda p, *x: model.inverse_dynamics(p, jid.Motion(*x)), p, *state)


def count_operations(model):
    """Return the counts of operations of a model's regressor."""
    import jaxid as jid

    n = (model.robot.joints,)
    return jid.program.trace(model.columns, n, n, n).counts


def per_sample(times, samples):
    """Return the median time for one sample in words."""
    return f"{times.median / samples * NS:.0f} ns"


def compare(number, what, recipe, asked, ours, peer, samples, target):
    """Return the row of a ratio to a peer."""
    ratio = peer / ours
    measured = (
        f"{ratio:.1f}x ({per_sample(ours, samples)} against "
        f"{per_sample(peer, samples)}); best turns {peer.best / ours.best:.1f}x "
        f"({ours.best / samples * NS:.0f} ns against {peer.best / samples * NS:.0f} ns)"
    )
    return Row(number, what, recipe, asked, measured, ratio >= target)


def with_friction(samples, turns):
    """Measure row 1: against FIGAROH, on two cores."""
    import jax
    import numpy as np
    from pinocchio_loop import Bodies, in_our_order, pinocchio_model

    import jaxid as jid

    what = "regressor with friction and rotors, against FIGAROH"
    recipe = (
        "Panda, bodies + viscous + Coulomb (sign) + rotor columns = 91, N = "
        f"{samples}, two cores (FIGAROH's loop uses one of them), "
        f"median of {turns} turns"
    )
    absent = timing.missing("figaroh") or timing.missing("pinocchio")
    robot = jid.robots.panda()
    n = robot.joints
    friction = jid.CoulombFriction(jid.terms.HardSign())
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
        config = {
            "has_friction": True,
            "has_actuator_inertia": True,
            "act_idxv": list(range(n)),
        }
        cases["figaroh"] = lambda: build_regressor_basic(
            figaroh_robot, q, qd, qdd, config
        )
        theirs = cases["figaroh"]()
        bodies = theirs[:, : 10 * n].reshape(n, samples, 10 * n).swapaxes(0, 1)
        bodies = in_our_order(bodies, n).swapaxes(0, 1).reshape(n * samples, -1)
        np.testing.assert_allclose(matrix()[:, : 10 * n], bodies, atol=1e-9)
        np.testing.assert_allclose(
            matrix()[:, 10 * n :], theirs[:, 10 * n :], atol=1e-9
        )
    times = interleaved(cases, turns)
    floor = f"floor: fill of the non-zero entries {per_sample(times['fill'], samples)}"
    recipe = (
        f"{recipe}; {floor}; `Model.regressor` {per_sample(times['public'], samples)}"
    )
    if absent is not None:
        ours = ", ".join(
            f"{k} {per_sample(times[k], samples)}" for k in ("packed", "matrix")
        )
        return [
            Row("1", what, recipe, ">= 25x packed, >= 7x dense", f"{ours}; {absent}")
        ]
    return [
        compare("1a", f"{what}, packed", recipe, ">= 25x (stretch "
"40x)", times["packed"],
                times["figaroh"], samples, 25),
        compare("1b", f"{what}, Fortran-ordered "
"matrix", recipe, ">= 7x", times["matrix"],
                times["figaroh"], samples, 7),
    ]  # fmt: skip


def one_core(samples, turns):
    """Measure rows 2 to 4: against Pinocchio in C++, frax and the memory."""
    import numpy as np
    from pinocchio_loop import Bodies, Loop, in_our_order

    import jaxid as jid

    robot = jid.robots.panda()
    n = robot.joints
    model = jid.Model(robot, (jid.RigidBodies(),))
    state = motion(n, samples)
    bodies = Bodies(n)
    packed = packed_regressor(model, state)
    nonzero = len(packed().values)
    counts = count_operations(model)
    forces = inverse_dynamics(model, bodies.parameters.ravel(), state)
    cases = {"regressor": packed, "forces": forces, "fill": fill(nonzero, samples)}
    notes = []
    try:
        loop = Loop(robot, bodies, *state)
        matrix = packed().matrix()
        theirs = (
            in_our_order(loop.regressors(), n).swapaxes(0, 1).reshape(n * samples, -1)
        )
        np.testing.assert_allclose(matrix, theirs, atol=1e-9)
        np.testing.assert_allclose(forces(), loop.torques(), atol=1e-9)
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
        f"Panda, ten parameters per body = 70 columns, {nonzero} non-zero entries, N = "
        f"{samples}, one core, median of {turns} turns; floors: warm fill "
        f"{per_sample(floor, samples)}, {work} operations at {rate / NS:.0f} Gflop/s "
        f"{work / rate * NS:.0f} ns"
    )
    asked = {
        2: ">= 3.5x (stretch 5x)",
        31: ">= 6x",
        32: ">= 30x",
        4: "<= 9x (stretch 6x)",
    }
    ours, torque = times["regressor"], times["forces"]
    rows = []
    if "C++ regressor" in times:
        what = "regressor, against Pinocchio in C++ with store"
        rows.append(
            compare(
                "2", what, recipe, asked[2], ours, times["C++ regressor"], samples, 3.5
            )
        )
        what = "inverse dynamics, against Pinocchio in C++"
        rows.append(
            compare(
                "3a", what, recipe, asked[31], torque, times["C++ forces"], samples, 6
            )
        )
    if "frax" in times:
        what = "inverse dynamics, against frax"
        rows.append(
            compare("3b", what, recipe, asked[32], torque, times["frax"], samples, 30)
        )
    over = ours / floor
    measured = (
        f"{over:.1f}x ({per_sample(ours, samples)} against "
        f"{per_sample(floor, samples)}); best turns {ours.best / floor.best:.1f}x"
    )
    what = "regressor, against a warm fill of its non-zero entries"
    rows.append(Row("4", what, recipe, asked[4], measured, over <= 9))
    rows += [Row("2-3", "skipped", recipe, "-", note) for note in notes]
    return rows


def frax_forces(state):
    """Compile the inverse dynamics of frax; return a call that blocks."""
    import jax
    import numpy as np
    from frax.robots.franka_panda import load_panda

    robot = load_panda()
    gravity = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])
    each = jax.vmap(lambda q, v, a: robot.rnea(q, v, a, gravity, None))
    return compiled(each, *state)


def main():
    """Measure on one core and on two, each in a process of its own."""
    parser = timing.parser(__doc__, "fewer samples and turns")
    parser.add_argument(
        "--cores", type=int, choices=(1, 2), help="only the rows of so many cores"
    )
    options = parser.parse_args()
    if options.cores is not None:
        timing.pin_to(options.cores)
        samples, turns = (1024, 5) if options.quick else (16384, 25)
        rows = (
            with_friction(samples, turns)
            if options.cores == 2
            else one_core(samples, turns)
        )
        hand_over(rows, options.json)
        return
    rows = []
    for cores in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rows.json"
            again = [
                sys.executable,
                __file__,
                "--cores",
                str(cores),
                "--json",
                str(path),
            ]
            subprocess.run([*again, *["--quick"] * options.quick], check=True)
            rows += [Row(**row) for row in json.loads(path.read_text())]
    if options.json:
        Path(options.json).write_text(json.dumps([asdict(row) for row in rows]))


if __name__ == "__main__":
    main()
