"""Fences of a scalar program: run time of fenced against unfenced XLA, in one process.

    python benchmarks/fences.py [--quick] [--check] [--json FILE]

A new version of JAX can ignore a fence silently: results stay right and the program becomes many
times slower. The script prints run and compile time of a seven-joint regressor with and without
fences; with `--check` it fails if they have no effect. Ratios count; absolute times depend on the
machine.
"""

import statistics
import sys
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import timing
from timing import Row, hand_over

from jaxid.program import lower, sine_cosine, trace  # private: the compiler itself

JOINTS = 7
FENCES = (False, True)
PAIRS = {"polynomial": sine_cosine, "library": lambda x: (jnp.sin(x), jnp.cos(x))}
HOLDS_FROM = {"polynomial": 2.5, "library": 10.0}
"""Required speed of a fenced program relative to the unfenced one, by its sine and cosine."""

NUMBERS = {"library": "5a", "polynomial": "5b"}

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
    """Return acceleration less gravity, angular velocity and acceleration of each body."""
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
    """Compile a program; return it with the seconds that this takes."""

    def results(*x):
        return [y for y in lowered(*x) if not isinstance(y, float)]

    start = time.perf_counter()
    run = jax.jit(results).lower(*inputs).compile()
    return run, time.perf_counter() - start


class Measured(NamedTuple):
    """Times with or without fences, with one of the two pairs of sine and cosine.

    Attributes:
        fence: Whether there are fences.
        pair: Name of the pair.
        nanoseconds: Time for each sample, of all turns.
        compiling: Compile time [s].
        ratio: Speed relative to none.
    """

    fence: bool
    pair: str
    nanoseconds: list[float]
    compiling: float
    ratio: float

    @property
    def name(self):
        """Name of the case."""
        return "division" if self.fence else "none"

    @property
    def median(self):
        """Median of all turns."""
        return statistics.median(self.nanoseconds)

    @property
    def lost(self):
        """Whether the fences have no effect."""
        return self.fence and self.ratio < HOLDS_FROM[self.pair]


def measure(samples, turns, pairs):
    """Time the regressor with and without fences, with each pair of sine and cosine."""
    program = trace(regressor, (JOINTS,), (JOINTS,), (JOINTS,))
    generator = np.random.default_rng(0)
    inputs = [jnp.asarray(x) for x in generator.uniform(-1, 1, (3, JOINTS, samples))]
    print(f"seven-joint regressor: {program.counts}")
    cases = [(fence, pair) for pair in pairs for fence in FENCES]
    runs, compiling = {}, {}
    for fence, pair in cases:
        lowered = lower(program, fence, PAIRS[pair])
        runs[fence, pair], compiling[fence, pair] = compiled(lowered, inputs)
    expected = runs[cases[-1]](*inputs)
    times = {case: [] for case in cases}
    for run in runs.values():
        for got, want in zip(run(*inputs), expected, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-11, atol=1e-11)
    for _ in range(turns):
        for case, run in runs.items():
            start = time.perf_counter()
            jax.block_until_ready(run(*inputs))
            times[case].append((time.perf_counter() - start) / samples * 1e9)
    found = []
    for fence, pair in cases:
        own, without = times[fence, pair], times[FENCES[0], pair]
        ratio = statistics.median(a / b for a, b in zip(without, own, strict=True))
        found.append(Measured(fence, pair, own, compiling[fence, pair], ratio))
    return found


def row(case, without, recipe):
    """Return the row of the fences with one pair of sine and cosine."""
    said = f"{case.ratio:.1f}x ({case.median:.0f} ns against {without.median:.0f} ns)"
    if case.lost:
        said = f"{case.name} DOES NOT HOLD: {said}"
    return Row(
        NUMBERS[case.pair],
        f"regressor, {case.name} against none, {case.pair} sine and cosine",
        recipe,
        f">= {HOLDS_FROM[case.pair]:g}x",
        said,
        not case.lost,
    )


def main():
    """Time both."""
    parser = timing.parser(__doc__, "fewer samples, only the polynomial sine and cosine")
    parser.add_argument("--check", action="store_true", help="fail if the fence is lost")
    options = parser.parse_args()
    timing.pin_to(2)
    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_enable_x64", True)
    samples, turns = (2048, 5) if options.quick else (16384, 9)
    found = measure(samples, turns, ("polynomial",) if options.quick else tuple(PAIRS))
    print(f"\n{'sine, cosine':<13}{'fence':<15}{'median':>8}{'best':>8}{'compile':>9}{'ratio':>7}")
    print(f"{'':<28}{'[ns per sample]':>16}{'[s]':>9}")
    for case in found:
        print(
            f"{case.pair:<13}{case.name:<15}{case.median:>8.0f}{min(case.nanoseconds):>8.0f}"
            f"{case.compiling:>9.1f}{case.ratio:>7.1f}"
        )
    without = {case.pair: case for case in found if not case.fence}
    recipe = f"Panda, 70 columns, jax {jax.__version__}, two cores, N = {samples}, {turns} turns"
    fenced = [case for case in found if case.fence]
    rows = [row(case, without[case.pair], recipe) for case in fenced]
    lost = [case for case in fenced if case.lost]
    for case in lost:
        print(f"DOES NOT HOLD: {case.name} with {case.pair} sine and cosine")
    hand_over(sorted(rows, key=lambda r: r.number), options.json)
    if options.check and lost:
        sys.exit(f"LOST FENCE: jax {jax.__version__} computes shared values again")


if __name__ == "__main__":
    main()
