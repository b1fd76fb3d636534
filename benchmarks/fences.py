"""Fences of a scalar program: run time of fenced against unfenced XLA, in one process.

    python benchmarks/fences.py [--quick] [--check] [--json FILE]

A new version of JAX can ignore a fence silently: results stay right and the program
becomes many times slower. The script prints run and compile time of a seven-joint
regressor with and without fences; with `--check` it fails if they have no effect.
Ratios count; absolute times depend on the machine.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import timing
from timing import Row, hand_over

import jaxid as jid

JOINTS = 7
FENCES = (False, True)
HOLDS_FROM = 2.5
"""Required speed of a fenced program relative to the unfenced one."""

TURNS = np.pi / 2 * np.array([0, -1, 1, 1, -1, 1, 1])
LENGTHS = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
OFFSETS = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])


def skew(a):
    """Return the matrix of a cross product."""
    o = 0.0 * a[0]
    return jnp.array([[o, -a[2], a[1]], [a[2], o, -a[0]], [-a[1], a[0], o]])


def inertia_operator(w):
    """Return the matrix of the six moments of inertia."""
    x, y, z = w
    o = 0.0 * x
    return jnp.array([[x, y, o, z, o, o], [o, x, y, o, z, o], [o, o, o, x, y, z]])


def accelerations(q, qd, qdd):
    """Return each body's acceleration less gravity, angular velocity, acceleration."""
    a, w, wd, z = jnp.array([0.0, 0.0, 9.81]), jnp.zeros(3), jnp.zeros(3), np.eye(3)[2]
    bodies = []
    for k in range(JOINTS):
        ct, st = np.round([np.cos(TURNS[k]), np.sin(TURNS[k])])
        fixed = np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
        offset = np.array([LENGTHS[k], -st * OFFSETS[k], ct * OFFSETS[k]])
        c, s, o = jnp.cos(q[k]), jnp.sin(q[k]), 0.0 * q[k]
        turn = fixed @ jnp.array([[c, -s, o], [s, c, o], [o, o, o + 1.0]])
        a = turn.T @ (a + (skew(wd) + skew(w) @ skew(w)) @ offset)
        w, wd = turn.T @ w, turn.T @ wd
        w, wd = w + z * qd[k], wd + z * qdd[k] + jnp.cross(w, z) * qd[k]
        bodies.append((a, w, wd))
    return bodies


def regressor(q, qd, qdd):
    """Return joint torques per inertial parameter, [joint, body, parameter]."""
    partial = jax.jacfwd(lambda x: [(a, wd) for a, _, wd in accelerations(q, qd, x)])(
        qdd
    )
    columns = []
    for (along, about), (a, w, wd) in zip(
        partial, accelerations(q, qd, qdd), strict=True
    ):
        force = [a[:, None], skew(wd) + skew(w) @ skew(w), np.zeros((3, 6))]
        moment = [
            np.zeros((3, 1)),
            -skew(a),
            inertia_operator(wd) + skew(w) @ inertia_operator(w),
        ]
        columns.append(jnp.concatenate([along, about]).T @ jnp.block([force, moment]))
    return jnp.stack(columns, 1)


def compiled(lowered, inputs):
    """Compile a program; return it with the seconds that this takes."""

    def results(*x):
        return [y for y in lowered(*x) if not isinstance(y, float)]

    start = time.perf_counter()
    run = jax.jit(results).lower(*inputs).compile()
    return run, time.perf_counter() - start


def measure(samples, turns):
    """Return times per sample [ns] and compile times [s], without and with."""
    program = jid.program.trace(regressor, (JOINTS,), (JOINTS,), (JOINTS,))
    generator = np.random.default_rng(0)
    inputs = [jnp.asarray(x) for x in generator.uniform(-1, 1, (3, JOINTS, samples))]
    print(f"seven-joint regressor: {program.counts}")
    runs, compiling = zip(
        *(compiled(jid.program.lower(program, x), inputs) for x in FENCES), strict=True
    )
    for plain, fenced in zip(*(run(*inputs) for run in runs), strict=True):
        np.testing.assert_allclose(fenced, plain, rtol=1e-11, atol=1e-11)
    times = []
    for _ in range(turns):
        for run in runs:
            start = time.perf_counter()
            jax.block_until_ready(run(*inputs))
            times.append((time.perf_counter() - start) / samples * 1e9)
    return np.reshape(times, (turns, 2)), compiling


def main():
    """Time both."""
    parser = timing.parser(__doc__, "fewer samples")
    parser.add_argument(
        "--check", action="store_true", help="fail if the fence is lost"
    )
    options = parser.parse_args()
    timing.pin_to(2)
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    samples, turns = (2048, 5) if options.quick else (16384, 9)
    times, compiling = measure(samples, turns)
    ratio = np.median(times[:, 0] / times[:, 1])
    plain, fenced = np.median(times, axis=0)
    said = f"{ratio:.1f}x ({fenced:.0f} ns against {plain:.0f} ns)"
    print(f"{said}; compiled in {compiling[1]:.1f} s against {compiling[0]:.1f} s")
    recipe = (
        f"Panda, 70 columns, jax {jax.__version__}, two cores, N = {samples}, "
        f"{turns} turns"
    )
    holds, wanted = bool(ratio >= HOLDS_FROM), f">= {HOLDS_FROM:g}x"
    rows = [
        Row("5b", "regressor, division against no fence", recipe, wanted, said, holds)
    ]
    hand_over(rows, options.json)
    if options.check and not holds:
        sys.exit(f"LOST FENCE: jax {jax.__version__} computes shared values again")


if __name__ == "__main__":
    main()
