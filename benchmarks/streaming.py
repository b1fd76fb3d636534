"""Identification from long logs: time, memory and accuracy.

    python benchmarks/streaming.py [--quick] [--disk SAMPLES] [--json FILE]

A seven-axis arm at 1 kHz in float64: every sample a row; forces and columns filtered
(zero phase, 20 Hz) and every 25th a row; the first against a loop over Pinocchio's
regressor in NumPy, interleaved with it; the second from a Parquet file, whose reading
overlaps with the computing. Medians of warm runs; compile times are given apart. Memory
is the growth of the process's resident set during warm runs. The log on disk is one
motion of 500 000 samples again and again. Ratios count; absolute times depend on the
machine.
"""

import functools
import math
import os
import statistics
import tempfile
import threading
import time
from pathlib import Path

# Before NumPy is imported: chunks run in parallel, and threads of BLAS would compete
# with them.
os.environ["OPENBLAS_NUM_THREADS"] = os.environ["OMP_NUM_THREADS"] = "1"
os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import numpy as np
import polars as pl
import timing
from timing import Row, hand_over

import jaxid as jid

PAGE = os.sysconf("SC_PAGE_SIZE")
RATE = 1000.0


class Peak:
    """Largest growth of the resident set inside of a `with` block [MB]."""

    def __enter__(self):
        self._start, self.megabytes, self._done = (
            self._resident(),
            0.0,
            threading.Event(),
        )
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._done.set()
        self._thread.join()

    def _watch(self):
        while not self._done.wait(0.002):
            self.megabytes = max(self.megabytes, (self._resident() - self._start) / 1e6)

    @staticmethod
    def _resident():
        return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE


def excited(samples, joints, seed=0):
    """Return five harmonics of 0.1 Hz for each joint, with random phases."""
    random = np.random.default_rng(seed)
    q, qd, qdd = (np.zeros((samples, joints)) for _ in range(3))
    for start in range(0, samples, 50_000):
        part = slice(start, min(start + 50_000, samples))
        t = np.arange(part.start, part.stop)[:, None] / RATE
        random = np.random.default_rng(seed)
        for k in range(1, 6):
            w = 2 * math.pi * 0.1 * k
            a, phase = random.uniform(0.1, 0.5, joints), random.uniform(0, 6, joints)
            q[part] += a * np.sin(w * t + phase)
            qd[part] += a * w * np.cos(w * t + phase)
            qdd[part] -= a * w**2 * np.sin(w * t + phase)
    return jid.Motion(q, qd, qdd)


def virtual_log(base, samples):
    """Return a motion, and the model's forces with noise."""
    model, random = base.model, np.random.default_rng(1)
    p = random.uniform(0.2, 2.0, model.size)
    motion = excited(samples, model.robot.joints)
    forces = np.asarray(model.inverse_dynamics(p, motion))
    return motion, forces + random.normal(size=forces.shape)


def unfiltered(motion, forces):
    """Return observations of which every sample is a row."""
    arrays = motion.q, motion.qd, motion.qdd, forces
    return jid.Observations.of(*arrays, sample_time=1 / RATE)


def filtered(motion, forces):
    """Return observations that are low-passed at 20 Hz, every 25th sample a row."""
    smooth = {"filter": jid.ZeroPhaseButterworth(20.0), "decimation": jid.Subsample(25)}
    arrays = motion.q, motion.qd, motion.qdd, forces
    return jid.Observations.of(*arrays, sample_time=1 / RATE, **smooth)


def timed(run, *arguments):
    """Return the duration of a call [s] and its result."""
    start = time.perf_counter()
    result = run(*arguments)
    return time.perf_counter() - start, result


def identification(base, o):
    """Identify without weights, with the naive covariance."""
    naive = jid.uncertainty.IndependentRows()
    return jid.identify(base, o, jid.estimators.LeastSquares(), uncertainty=naive)


def distance(base, o):
    """Return the distance from estimates of a dense QR with columns of length one."""
    theta = o.reduce(np.asarray(base.regressor(o.motion))).reshape(-1, base.size)
    norms = np.linalg.norm(theta, axis=0)
    Q, R = np.linalg.qr(theta / norms)
    expected = np.linalg.solve(R, Q.T @ o.reduced_forces.ravel())
    away = identification(base, o).parameters * norms - expected
    return np.linalg.norm(away) / np.linalg.norm(expected), np.linalg.cond(R)


def in_pinocchio(robot):
    """Return a model of Pinocchio with the joints of a robot."""
    import pinocchio as pin

    model, joint = pin.Model(), 0
    model.gravity.linear = np.asarray(robot.gravity)
    for k in range(robot.joints):
        kind = pin.JointModelRevoluteUnaligned
        kind = kind if robot.revolute[k] else pin.JointModelPrismaticUnaligned
        place = pin.SE3(np.asarray(robot.rotation[k]), np.asarray(robot.offset[k]))
        joint = model.addJoint(
            joint, kind(np.asarray(robot.axis[k])), place, f"joint{k}"
        )
    return model


def peer(model, base, o):
    """Identify without this package: a loop over samples, then a QR."""
    import pinocchio as pin

    data, n = model.createData(), model.nv
    bodies = 10 * np.arange(n)[:, None] + np.array([0, 1, 2, 3, 4, 6, 9, 8, 7, 5])
    signs = np.tile([1.0] * 7 + [-1.0] * 3, n)
    theta = np.empty((len(o.forces), n, base.model.size))
    friction = np.arange(n)
    q, qd, qdd = o.motion.q, o.motion.qd, o.motion.qdd
    for i in range(len(theta)):
        pin_columns = pin.computeJointTorqueRegressor(model, data, q[i], qd[i], qdd[i])
        theta[i, :, : 10 * n] = pin_columns[:, bodies.ravel()] * signs
    theta[:, :, 10 * n :] = 0.0
    for place, column in enumerate((qd, np.tanh(qd / 0.01), qdd)):
        theta[:, friction, 10 * n + place * n + friction] = column
    matrix = theta.reshape(-1, base.model.size)[:, list(base.indices)]
    Q, R = np.linalg.qr(matrix)
    return np.linalg.solve(R, Q.T @ np.asarray(o.forces).ravel())


def case(number, name, base, o, repetitions, most, memory=math.inf):
    """Measure a log in memory: seconds, and memory beyond the inputs [MB]."""
    first, _ = timed(identification, base, o)
    with Peak() as peak:
        runs = [timed(identification, base, o) for _ in range(repetitions)]
    times, fit = [seconds for seconds, _ in runs], runs[-1][1]
    median = statistics.median(times)
    asked = f"<= {most:g} s" + (f", <= {memory:g} MB" if memory < math.inf else "")
    return Row(
        number,
        f"{len(o.forces)} samples in memory to base parameters, {name}",
        f"rail + TX90L, {base.size} base parameters with friction and rotors, naive "
        f"covariance, two cores, median of {repetitions} runs; {fit.rows[0]} rows; the "
        f"first run, which compiles, {first:.1f} s",
        asked,
        f"{median:.2f} s (best {min(times):.2f} s), {peak.megabytes:.0f} MB beyond "
        "the inputs",
        median <= most and peak.megabytes <= memory,
    )


def default_intervals(base, o, repetitions):
    """Measure what the default intervals cost beside the naive ones (row 15)."""
    identify = functools.partial(jid.identify, base, o)
    identify(), identification(base, o)
    pairs, peaks = [], []
    for _ in range(repetitions):
        pairs.append((timed(identify)[0], timed(identification, base, o)[0]))
        # Apart, since reading the size of the process takes time.
        with Peak() as peak:
            identify()
        peaks.append(peak.megabytes)
    default, naive = (statistics.median(x) for x in zip(*pairs, strict=True))
    memory = statistics.median(peaks)
    ratio = statistics.median(a / b for a, b in pairs)
    return Row(
        "15",
        f"{len(o.forces)} samples in memory with default intervals, against naive ones",
        f"Panda, {base.size} base parameters, every sample a row, two cores, median of "
        f"{repetitions} turns",
        "<= 1.3 x, <= 100 MB, naive <= 1.0 s",
        f"{ratio:.2f} x ({default:.2f} s against {naive:.2f} s), {memory:.0f} MB",
        ratio <= 1.3 and memory <= 100 and naive <= 1.0,
    )


def written(base, samples, folder):
    """Write a Parquet file of one motion after the other."""
    step = min(samples, 500_000)
    motion, forces = virtual_log(base, step)
    arrays = {"q": motion.q, "tau": forces}
    columns = {
        f"{n}{j + 1}": x[:, j] for n, x in arrays.items() for j in range(x.shape[1])
    }
    part, path = folder / "part.parquet", folder / "log.parquet"
    pl.DataFrame(columns).write_parquet(part, row_group_size=65536)
    whole_log = pl.concat([pl.scan_parquet(part)] * -(-samples // step)).head(samples)
    whole_log.sink_parquet(path, row_group_size=65536)
    part.unlink()
    return path


def from_disk(base, samples, repetitions):
    """Measure row 14."""
    columns = jid.Columns(angles="q{}", forces="tau{}", sample_time=1 / RATE)
    smooth, every = jid.ZeroPhaseButterworth(20.0), jid.Subsample(25)
    with tempfile.TemporaryDirectory() as name:
        path = written(base, samples, Path(name))
        log = jid.scan_log(path, columns, base.model.robot, smooth, every)
        part = slice(100_000 // 2, 100_000 // 2 + 65536)
        reading = [timed(log.read, part)[0] * samples / 65536 for _ in range(5)]
        motion, forces = log.read(slice(0, min(samples, 200_000)))
        held = filtered(motion, forces)
        timed(identification, base, held)
        computing = [
            timed(identification, base, held)[0] * samples / len(forces)
            for _ in range(repetitions)
        ]
        with Peak() as peak:
            times = [timed(identification, base, log)[0] for _ in range(repetitions)]
        size = path.stat().st_size / 1e6
    median, read, computed = map(statistics.median, (times, reading, computing))
    ratio = median / max(read, computed)
    return Row(
        "14",
        f"{samples} samples from Parquet on disk, 20 Hz, every 25th a row",
        f"rail + TX90L, {base.size} base parameters, a file of {size:.0f} MB, two "
        f"cores, median of {repetitions} runs; reading and filtering alone {read:.2f} "
        f"s, computing alone {computed:.2f} s, both by a part of the log",
        "<= 1.2 x the larger of reading and computing, <= 1000 MB",
        f"{ratio:.2f} x the larger ({median:.2f} s), {peak.megabytes:.0f} MB",
        ratio <= 1.2 and peak.megabytes <= 1000,
    )


def against_pinocchio(base, motion, forces, samples, repetitions):
    """Measure row 11."""
    o = unfiltered(motion[:samples], forces[:samples])
    model = in_pinocchio(base.model.robot)
    own, other = [], []
    fit = identification(base, o)
    for _ in range(repetitions):
        own.append(timed(identification, base, o)[0])
        seconds, p = timed(peer, model, base, o)
        other.append(seconds)
    norms = 1 / np.asarray(fit.naive_standard_deviations)
    away = np.linalg.norm(norms * (fit.parameters - p)) / np.linalg.norm(norms * p)
    a, b = statistics.median(own), statistics.median(other)
    ratio = statistics.median(y / x for x, y in zip(own, other, strict=True))
    return Row(
        "11",
        f"{samples} samples in memory to base parameters, against NumPy + Pinocchio",
        f"rail + TX90L, {base.size} base parameters, every sample a row; the loop is "
        f"in Python, then a QR; median of {repetitions} turns; estimates differ by "
        f"{away:.0e}",
        ">= 25x",
        f"{ratio:.0f}x ({a:.3f} s against {b:.2f} s)",
        ratio >= 25,
    )


def accuracy(base, motion, forces):
    """Measure the largest distance from a dense QR, filtered and not (row 12)."""
    found = []
    for name, prepare in (
        ("every sample a row", unfiltered),
        ("20 Hz, every 25th", filtered),
    ):
        o = prepare(motion, forces)
        away, condition = distance(base, o)
        found.append((away, f"{name} {away:.1e} (condition number {condition:.0f})"))
    worst = max(away for away, _ in found)
    return Row(
        "12",
        "estimates from long logs, distance from a dense QR",
        f"rail + TX90L, {base.size} base parameters, {len(forces)} samples, columns "
        "of length one",
        "<= 1e-12",
        "; ".join(words for _, words in found),
        worst <= 1e-12,
    )


def main():
    """Measure rows 10 to 15 on two cores."""
    parser = timing.parser(__doc__, "fewer samples and repetitions")
    parser.add_argument("--disk", type=int, help="samples of the Parquet file")
    given = parser.parse_args()
    timing.pin_to(2)
    jax.config.update("jax_enable_x64", True)
    quick = given.quick
    samples, checked, looped, on_disk, repetitions = (
        (120_000, 10_000, 5_000, 200_000, 3)
        if quick
        else (1_000_000, 100_000, 200_000, 10_000_000, 5)
    )
    base = jid.base_parameters(jid.Model(jid.robots.tx90l_on_rail()))
    motion, forces = virtual_log(base, samples)
    rows = [
        case(
            "10",
            "every sample a row",
            base,
            unfiltered(motion, forces),
            repetitions,
            1.0,
            50.0,
        ),
        case(
            "13",
            "20 Hz, every 25th a row",
            base,
            filtered(motion, forces),
            repetitions,
            4.0,
        ),
        accuracy(base, motion[:checked], forces[:checked]),
    ]
    absent = timing.missing("pinocchio")
    if absent is None:
        rows.insert(1, against_pinocchio(base, motion, forces, looped, 3))
    else:
        print(absent)
    del motion, forces
    panda = jid.base_parameters(jid.Model(jid.robots.panda()))
    rows.append(
        default_intervals(panda, unfiltered(*virtual_log(panda, samples)), repetitions)
    )
    rows.append(from_disk(base, given.disk or on_disk, 1 if quick else 3))
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
