"""Do the fences of a scalar program still hold? Fenced against unfenced XLA, in one process.

    python benchmarks/fences.py [--quick] [--check] [--json FILE]

A new version of JAX can lose a fence silently: the results stay right and the program becomes many
times slower. This prints run and compile time of a seven-joint regressor behind each fence, and
says by name which one does not hold; with `--check` it then fails, if that is the default fence.
Ratios count; absolute times depend on the machine.
"""

import argparse
import statistics
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from timing import Row, hand_over

from jaxid.program import (
    BarrierFence,
    DivisionFence,
    NoFence,
    default_fence,
    library_sine_cosine,
    lower,
    sine_cosine,
    trace,
)

JOINTS = 7
HOLDS_FROM = {"polynomial": 2.5, "library": 10.0}
"""How many times faster a fenced program must be than the unfenced one, by its sine and cosine."""

TURNS = np.pi / 2 * np.array([0, -1, 1, 1, -1, 1, 1])
LENGTHS = np.array([0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088])
OFFSETS = np.array([0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0])


def skew(a):
    o = 0.0 * a[0]
    return jnp.array([[o, -a[2], a[1]], [a[2], o, -a[0]], [-a[1], a[0], o]])


def inertia_operator(w):
    x, y, z = w
    o = 0.0 * x
    return jnp.array([[x, y, o, z, o, o], [o, x, y, o, z, o], [o, o, o, x, y, z]])


def accelerations(q, qd, qdd):
    """Acceleration without gravity, angular velocity and acceleration of each body of the arm."""
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
    """Joint torques per inertial parameter, [joint, body, parameter]."""
    partial = jax.jacfwd(lambda x: [(a, wd) for a, _, wd in accelerations(q, qd, x)])(qdd)
    columns = []
    for (along, about), (a, w, wd) in zip(partial, accelerations(q, qd, qdd), strict=True):
        force = [a[:, None], skew(wd) + skew(w) @ skew(w), np.zeros((3, 6))]
        moment = [
            np.zeros((3, 1)),
            -skew(a),
            inertia_operator(wd) + skew(w) @ inertia_operator(w),
        ]
        columns.append(jnp.concatenate([along, about]).T @ jnp.block([force, moment]))
    return jnp.stack(columns, 1)


def compiled(lowered, inputs):
    def results(*x):
        return [y for y in lowered(*x) if not isinstance(y, float)]

    start = time.perf_counter()
    run = jax.jit(results).lower(*inputs).compile()
    return run, time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer samples and repetitions")
    parser.add_argument("--check", action="store_true", help="fail if the default fence is lost")
    parser.add_argument("--json", help="where to write the rows")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    quick = options.quick
    samples, repetitions = (2048, 5) if quick else (16384, 9)
    program = trace(regressor, (JOINTS,), (JOINTS,), (JOINTS,))
    backend = jax.default_backend()
    chosen = default_fence(backend, jax.__version_info__)
    generator = np.random.default_rng(0)
    inputs = [jnp.asarray(x) for x in generator.uniform(-1, 1, (3, JOINTS, samples))]
    print(f"jax {jax.__version__} on {backend}, {samples} samples, {repetitions} repetitions")
    print(f"seven-joint regressor: {program.counts}")

    fences = (NoFence(), DivisionFence(), BarrierFence())
    pairs = {"polynomial": sine_cosine, "library": library_sine_cosine}
    cases = [(fence, pair) for pair in pairs for fence in fences]
    runs, compile_times = {}, {}
    for fence, pair in cases:
        lowered = lower(program, fence, pairs[pair])
        runs[fence, pair], compile_times[fence, pair] = compiled(lowered, inputs)
    expected = runs[fences[0], "library"](*inputs)
    times = {case: [] for case in cases}
    for run in runs.values():
        for got, want in zip(run(*inputs), expected, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11)
    for _ in range(repetitions):
        for case, run in runs.items():
            start = time.perf_counter()
            jax.block_until_ready(run(*inputs))
            times[case].append((time.perf_counter() - start) / samples * 1e9)

    print(f"\n{'sine, cosine':<13}{'fence':<15}{'median':>8}{'best':>8}{'compile':>9}{'ratio':>7}")
    print(f"{'':<28}{'[ns per sample]':>16}{'[s]':>9}{'':>7}")
    lost, rows = [], []
    for fence, pair in cases:
        median = statistics.median(times[fence, pair])
        ratio = statistics.median(times[fences[0], pair]) / median
        name = type(fence).__name__
        mark = " default" if fence == chosen and pair == "polynomial" else ""
        if fence != fences[0] and ratio < HOLDS_FROM[pair]:
            lost.append(f"{name} ({pair} sine and cosine): only {ratio:.1f} times faster than none")
        print(
            f"{pair:<13}{name:<15}{median:>8.0f}{min(times[fence, pair]):>8.0f}"
            f"{compile_times[fence, pair]:>9.1f}{ratio:>7.1f}{mark}"
        )
        if fence == chosen and fence != fences[0]:
            unfenced = statistics.median(times[fences[0], pair])
            said = f"{ratio:.1f}x ({median:.0f} ns against {unfenced:.0f} ns)"
            recipe = f"Panda, 70 columns, {name}, N = {samples}, median of {repetitions} turns"
            what = f"regressor, fenced against unfenced, {pair} sine and cosine"
            target = HOLDS_FROM[pair]
            number = "5a" if pair == "library" else "5b"
            rows.append(Row(number, what, recipe, f">= {target:g}x", said, ratio >= target))
    print()
    for line in lost:
        print(f"DOES NOT HOLD: {line}")
    default = type(chosen).__name__
    broken = [line for line in lost if line.startswith(default)]
    print(f"default fence here: {default}{', which does NOT hold' if broken else ''}")
    hand_over(rows, options.json)
    if options.check and broken:
        sys.exit("LOST FENCE: " + "; ".join(broken))


if __name__ == "__main__":
    main()
