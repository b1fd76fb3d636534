"""Feed-forward in C: time of a call and number of operations for each form.

    python benchmarks/export.py [--quick] [--model NAME ...] [--table NAME ...]

Models: bodies only, so that peers do the same work; with viscous and Coulomb friction
and rotors; the TX90L with seven parameters for each body (44 base parameters) and with
ten (57); the TX40 with its coupled wrist. Parameters: uniform random numbers (seed 0),
of which base parameters are made; times do not depend on them. `--quick`: a planar arm
alone: does it still run, and agree?

`times`: Eq. 39 factored (the recursion on base parameters that `export_c` writes); Eq.
39 literally as regressor times parameters; Eq. 38 as M qdd + h with M by composite
bodies or by projection, on base parameters or on all parameters; sines and cosines
alone, which are a part of each. All are straight-line C with parameters folded in,
written by the same generator, with the same sine and cosine. States: 1024 random ones,
in turn. One core, one process, all forms in turn, 1001 turns of 2048 calls, CPU time of
the thread; the best of all turns, so that other work on the machine shows little, and
ratios of these. `-O2` and `-O3 -march=native`, each with `-std=c99`, which leaves
multiplications and additions unfused. Peers, of the Panda without friction, with `-O3
-march=native`: Pinocchio's `rnea` in C++, and what CasADi generates from it.

`worst`: 10^6 calls, each timed by the clock, beside as many calls of nothing: the
clock's own cost and interruptions by the operating system. `counts`: operations for
arms of which others have published programs. Agreement with JAX, Pinocchio and MuJoCo
is tested in `tests/export`.
"""

import ctypes
import hashlib
import re
import shutil
import subprocess
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import timing

import jaxid as jid

FLAGS = {"O2": ["-O2"], "O3": ["-O3", "-march=native"]}
FRICTION = (jid.ViscousFriction(), jid.CoulombFriction(), jid.RotorInertia())
ARMS = {
    "Panda": (jid.robots.panda, (jid.RigidBodies(),)),
    "Panda, friction, rotors": (jid.robots.panda, (jid.RigidBodies(), *FRICTION)),
    "rail + TX90L, 44": (
        jid.robots.tx90l_on_rail,
        (jid.RigidBodies(principal_axes=True), *FRICTION),
    ),
    "rail + TX90L, 57": (jid.robots.tx90l_on_rail, (jid.RigidBodies(), *FRICTION)),
    "TX40, coupled wrist": (
        jid.robots.tx40,
        (jid.RigidBodies(), *FRICTION, jid.terms.CoupledDrives()),
    ),
}
QUICK = {
    "planar arm": (
        lambda: jid.robots.planar_arm(3, 0.4),
        (jid.RigidBodies(), *FRICTION),
    )
}
FACTORED, ALONE = "Eq. 39 factored", "sines and cosines alone"
PEER_CALL = """
static double memory[{size}];
void peer_form(const double *q, const double *qd, const double *qdd, double *tau)
{{
    const double *given[3];
    double *found[1];
    given[0] = q; given[1] = qd; given[2] = qdd; found[0] = tau;
    peer(given, found, 0, memory, 0);
}}
"""
HARNESS = """
#include <time.h>
typedef void form(const double *, const double *, const double *, double *);
static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1e9 + t.tv_nsec;
}
void many(form *f, long calls, int n,
          const double *q, const double *qd, const double *qdd,
          double *tau)
{
    long k;
    for (k = 0; k < calls; ++k) {
        const long row = (k & 1023) * n;
        f(q + row, qd + row, qdd + row, tau + row);
    }
}
void each(form *f, long calls, int n,
          const double *q, const double *qd, const double *qdd,
          double *tau, double *took)
{
    long k;
    for (k = 0; k < calls; ++k) {
        const long row = (k & 1023) * n;
        const double start = now();
        f(q + row, qd + row, qdd + row, tau + row);
        took[k] = now() - start;
    }
}
"""


def fit_of(model, p):
    """Identify given parameters from forces without noise."""
    base, random = jid.base_parameters(model), np.random.default_rng(3)
    m = jid.Motion(*states_of(model.robot, random, 500))
    forces = base.inverse_dynamics(base.from_standard(p), m)
    o = jid.Observations.of(m.q, m.qd, m.qdd, forces, sample_time=0.001)
    naive = jid.uncertainty.IndependentRows()
    return jid.identify(base, o, jid.estimators.LeastSquares(), uncertainty=naive)


def projected_mass_matrix(model, p, q):
    """Return M as the paper forms it: the sum of F^T M_i F of all bodies (Eq. 38)."""
    F = jnp.zeros((len(q), 6, len(q)))
    for body, joint, row in jid.dynamics.partial_velocities(model.robot, q):
        F = F.at[body, :, joint].set(row)
    total = jnp.zeros((len(q), len(q)))
    bodies = np.zeros((len(q), 10))
    for term, values in model.split(p):
        if term.body_parameters:
            rows = np.asarray(values).reshape(len(q), -1)
            bodies[:, : term.body_parameters] += rows
        else:
            total = total + term.mass_matrix(model.robot, values, q)
    for f, body in zip(F, bodies.tolist(), strict=True):
        m, x, y, z, A, B, C, D, E, G = body
        h = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        J = np.array([[A, -G, -E], [-G, B, -D], [-E, -D, C]])
        total = total + f.T @ (np.block([[m * np.eye(3), -h], [h, J]]) @ f)
    return total


def programs(model, p):
    """Return the fit and the forms of one model, by name."""
    fit, one = fit_of(model, p), (model.robot.joints,)
    base = fit.base
    own, full = np.asarray(base.to_standard(fit.parameters)), np.asarray(p)
    numbers = np.asarray(fit.parameters)

    def eq38(x, inertia):
        return jid.program.trace(
            lambda q, qd, qdd: inertia(q) @ qdd + model.bias(x, q, qd), one, one, one
        )

    factored = jid.export.torque_program(fit)
    angles = len({x.operands for x in factored.nodes if x.operation == "sin"})
    found = {
        FACTORED: factored,
        ALONE: jid.program.trace(
            lambda q, qd, qdd: jnp.sin(q[-angles:]) + jnp.cos(q[-angles:]),
            one,
            one,
            one,
        ),
        "Eq. 39 literal": jid.program.trace(
            lambda *s: base.columns(*s) @ numbers, one, one, one
        ),
    }
    for name, x in (("base", own), ("all", full)):
        composite = eq38(x, lambda q, x=x: model.inertia(x, q))
        projected = eq38(x, lambda q, x=x: projected_mass_matrix(model, x, q))
        found[f"Eq. 38 composite, {name}"] = composite
        found[f"Eq. 38 projected, {name}"] = projected
    return fit, found


def build(found, flags):
    """Compile all forms of a model as one library."""
    names = {name: f"form{k}" for k, name in enumerate(found)}
    text = "#define _POSIX_C_SOURCE 199309L\n#include <float.h>\n#include <math.h>\n"
    writer = jid.program.CWriter(True, "arm", [*found.values()])
    text += "#include <stdint.h>\n#include <string.h>\n" + writer.library()
    for name, program in found.items():
        text += writer.definition(program, names[name], ["q", "qd", "qdd"], ["tau"])
    opened = ctypes.CDLL(str(compiled(text + HARNESS, flags)))
    return {
        name: ctypes.cast(getattr(opened, f), ctypes.c_void_p)
        for name, f in names.items()
    }, opened


def compiled(text, flags):
    """Compile C code as a library, or take the one of an earlier run."""
    command = ["gcc", "-std=c99", "-w", *flags, "-shared", "-fPIC"]
    key = hashlib.sha256((text + " ".join(command)).encode()).hexdigest()[:16]
    target = Path(tempfile.gettempdir()) / f"jaxid-export-{key}.so"
    if not target.exists():
        source = target.with_suffix(".c")
        source.write_text(text)
        subprocess.run(
            [*command, str(source), "-o", f"{target}.part", "-lm"], check=True
        )
        Path(f"{target}.part").replace(target)
    return target


def pointer(x):
    """Return the address of an array."""
    return ctypes.c_void_p(x.ctypes.data)


def time_forms(name, arm, quick):
    """Print times and counts of one arm, as rows of a table."""
    make, terms = arm
    robot = make()
    model = jid.Model(robot, terms)
    n = robot.joints
    random = np.random.default_rng(0)
    _, found = programs(model, random.uniform(0.1, 1.0, model.size))
    states = states_of(robot, random, 1024)
    out, calls = np.zeros((1024, n)), 2048
    cases = {}
    for level, flags in FLAGS.items():
        forms, opened = build(found, flags)
        for form, function in forms.items():
            cases[level, form] = (opened, function)
    others = peers(robot, states) if name == "Panda" else {}
    work = {key: lambda c=c: call(*c, calls, states, out) for key, c in cases.items()}
    work |= {key: other[0] for key, other in others.items()}
    times = interleaved(work, 21 if quick else 1001)
    print(f"\n{name} ({jid.base_parameters(model).size} base parameters)\n")
    print(
        "| form | multiplications + additions | -O2 [ns] | -O3 native [ns] | factored "
        "over it: operations | time, -O2 and -O3 | without sines and cosines |"
    )
    print("|---|---|---|---|---|---|---|")
    own = found[FACTORED].counts
    for form, program in found.items():
        cells = [f"{times[level, form].best / calls * 1e9:.1f}" for level in FLAGS]
        counts = program.counts
        cells.insert(0, f"{counts.multiplications} + {counts.additions}")
        if form == ALONE:
            cells = ["", *cells[1:], "", "", ""]
        else:
            total = counts.multiplications + counts.additions
            cells += [f"{(own.multiplications + own.additions) / total:.2f}"]
            for less in (0, 1):
                shares = [
                    (times[level, FACTORED].best - less * times[level, ALONE].best)
                    / (times[level, form].best - less * times[level, ALONE].best)
                    for level in FLAGS
                ]
                cells += [", ".join(f"{x:.2f}" for x in shares)]
        print(f"| {form} | {' | '.join(cells)} |")
    for key, (_, many, counts) in others.items():
        shown = times[key].best / many * 1e9
        ratio = times["O3", FACTORED].best / calls * 1e9 / shown
        print(f"| {key} | {counts} | | {shown:.1f} | | {ratio:.3f} | |")


def interleaved(work, turns):
    """Measure CPU seconds of all cases, in turn, again and again."""
    seconds = {key: [] for key in work}
    for turn in range(turns + 1):
        for key, case in work.items():
            start = time.thread_time_ns()
            case()
            took = (time.thread_time_ns() - start) * 1e-9
            # The first turn only warms up.
            seconds[key] += [took] if turn else []
    return {key: timing.Times(tuple(x)) for key, x in seconds.items()}


def states_of(robot, random, samples):
    """Draw positions, velocities and accelerations."""
    return [random.uniform(-s, s, (samples, robot.joints)) for s in (3.0, 2.0, 5.0)]


def call(opened, function, calls, states, out):
    """Call a form on all states."""
    opened.many(
        function, ctypes.c_long(calls), out.shape[1], *map(pointer, (*states, out))
    )


def peers(robot, states):
    """Return Pinocchio's rnea in C++ and CasADi's code: work, calls, operations."""
    found = {}
    try:
        import pinocchio_loop

        loop = pinocchio_loop.Loop(robot, pinocchio_loop.Bodies(robot.joints), *states)
        found["Pinocchio C++ rnea"] = (loop.torques, len(states[0]), "")
        wanted = loop.torques().copy()
        text = pinocchio_loop.generated(robot, pinocchio_loop.Bodies(robot.joints))
    except (ImportError, RuntimeError, OSError) as problem:
        print(f"a peer is skipped: {problem}")
        return found
    size = 1 + max(map(int, re.findall(r"\bw\[(\d+)\]", text)), default=0)
    text = (
        "#define _POSIX_C_SOURCE 199309L\n"
        + text
        + PEER_CALL.format(size=size)
        + HARNESS
    )
    peer = ctypes.CDLL(str(compiled(text, FLAGS["O3"])))
    function, out = ctypes.cast(peer.peer_form, ctypes.c_void_p), np.zeros_like(wanted)
    call(peer, function, len(out), states, out)
    np.testing.assert_allclose(out, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())
    body = re.findall(r"^  [aw]\d*(?:\[\d+\])?=.*;", text, re.M)
    # Numbers are written out of the way: their exponents have signs.
    body = [re.sub(r"\d[\d.]*(e[+-]\d+)?", "1", line.split("=", 1)[1]) for line in body]
    products = sum(line.count("*") for line in body)
    sums = sum(len(re.findall(r"[\w)][+-]", line)) for line in body)
    found["CasADi from Pinocchio"] = (
        lambda: call(peer, function, len(out), states, out),
        len(out),
        f"{products} + {sums}",
    )
    return found


def time_worst(name, arm, quick):
    """Print quantiles of single calls of the factored form, beside calls of nothing."""
    make, terms = arm
    model = jid.Model(make(), terms)
    random = np.random.default_rng(0)
    fit = fit_of(model, random.uniform(0.1, 1.0, model.size))
    one = (model.robot.joints,)
    nothing = jid.program.trace(lambda q, qd, qdd: q[0], one, one, one)
    found = {FACTORED: jid.export.torque_program(fit), "nothing": nothing}
    states = states_of(model.robot, random, 1024)
    calls = 10_000 if quick else 1_000_000
    out, took = np.zeros((1024, model.robot.joints)), np.zeros(calls)
    print(f"\n{name}: {calls} calls one by one [ns]\n")
    print("| form | median | 99 % | 99.9 % | 99.99 % | worst |")
    print("|---|---|---|---|---|---|")
    for level, flags in FLAGS.items():
        forms, opened = build(found, flags)
        for form, function in forms.items():
            given = [*map(pointer, (*states, out, took))]
            opened.each(function, ctypes.c_long(calls), out.shape[1], *given)
            shown = np.quantile(took, [0.5, 0.99, 0.999, 0.9999, 1.0])
            print(f"| {form}, {level} | {' | '.join(f'{x:.0f}' for x in shown)} |")


def published(name, arm, quick):
    """Print operations for arms of which others have published programs, bodies only.

    An RX90 with its joints as in robots/RX90/RX90_idm.txt of github.com/symoro/symoro;
    the LWR, with joints like those of S7RRRRRRR1 in
    github.com/SchapplM/robsynth-serroblib.
    """
    twists = {"RX90": (0, 1, 0, -1, 1, -1), "LWR": (0, 1, -1, -1, 1, 1, -1)}
    lengths = {"RX90": (0, 0, 0.45, 0, 0, 0), "LWR": (0,) * 7}
    offsets = {"RX90": (0, 0, 0, 0.45, 0, 0), "LWR": (0.31, 0, 0.4, 0, 0.39, 0, 0.078)}
    for arm_name in twists:
        alpha = np.multiply(twists[arm_name], np.pi / 2)
        table = np.stack([alpha, lengths[arm_name], offsets[arm_name]], axis=1)
        robot = jid.from_dh(table, convention="modified", name=arm_name)
        model = jid.Model(robot, (jid.RigidBodies(),))
        fit = fit_of(model, np.random.default_rng(0).uniform(0.1, 1.0, model.size))
        counts = jid.export.torque_program(fit).counts
        print(f"{arm_name}: {counts}; {fit.base.size} base parameters")


TABLES = {
    "times": time_forms,
    "worst": time_worst,
    "counts": published,
}


def main():
    """Print the selected tables."""
    parser = timing.parser(__doc__, "a planar arm, few calls")
    parser.add_argument("--model", nargs="+", choices=ARMS, default=list(ARMS))
    parser.add_argument("--table", nargs="+", choices=TABLES, default=list(TABLES))
    options = parser.parse_args()
    if shutil.which("gcc") is None:
        print("no gcc on this machine: skipped")
        return
    timing.pin_to(1)
    jax.config.update("jax_enable_x64", True)
    for key, value in timing.machine().items():
        print(f"{key}: {value}")
    arms = QUICK if options.quick else {name: ARMS[name] for name in options.model}
    for table in options.table:
        for name, arm in arms.items():
            TABLES[table](name, arm, options.quick)
            if table == "counts":
                break


if __name__ == "__main__":
    main()
