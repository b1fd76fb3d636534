"""An hour of mixed batch jobs in one process: memory, compiled computations, open files.

    python benchmarks/soak.py [--quick] [--minutes 60] [--json FILE]

One round takes each job once. The first robot is always the same (planar, three joints); another
is new in every round (a random Denavit-Hartenberg table of three joints), so that nothing that
was compiled for it serves again. The jobs: a log is written as CSV, read, identified and
validated; `jaxid identify` writes a report with all its figures; many data sets in one call, of
sizes that vary; 120 000 samples chunk by chunk; physically consistent parameters; a motion is
designed; a log that is refused. After each round: resident memory, compiled
computations that JAX holds, open files, threads. The statistic: resident memory after the first
sixth of the time and at the end, and the slope of a line through the last two thirds.
"""

import argparse
import contextlib
import gc
import io
import json
import os
import sys
import tempfile
import time
from pathlib import Path

import timing
from timing import Row, hand_over

FLAT = 1.05
"""Resident memory may be so many times that after the first sixth."""
MIB = 2**20
EXPERIMENT = """\
[robot]
convention = "modified"
name = "soak"
{rows}
[limits]
angle_unit = "deg"
position_min = [-150, -150, -150]
position_max = [150, 150, 150]
velocity = [180, 180, 180]
acceleration = [600, 600, 600]
force = [80, 40, 20]
[recording]
angles = "q{{}}"
forces = "tau{{}}"
time = "t"
[filter]
kind = "butterworth"
cutoff = 10
[rows]
every = 10
"""


def robot_table(seed):
    """An arm of three joints that no other round has."""
    import numpy as np

    random = np.random.default_rng(seed)
    lines = []
    for k in range(3):
        a, d = random.uniform(0.2, 0.5, 2) * (k > 0)
        alpha = (0, 90, 0)[k]
        lines.append(
            f"[[robot.dh]]\nalpha = {alpha}\na = {a:.6f}\nd = {d:.6f}\n"
            f"theta = {0.0 if k < 2 else random.uniform(-60, 60):.6f}\n"
        )
    return EXPERIMENT.format(rows="".join(lines))


class Jobs:
    """What is done in each round."""

    def __init__(self, folder, quick):
        import jaxid as jid

        self.folder, self.quick = folder, quick
        self.arm = jid.base_parameters(jid.Model(jid.robots.planar_arm(3)))

    def log(self, base, seed, samples=4000):
        """Motion and noisy forces of a robot that does not exist."""
        import numpy as np

        import jaxid as jid

        robot, random = base.model.robot, np.random.default_rng(seed)
        t = 0.002 * np.arange(samples)
        motion = jid.random_fourier_series(robot, omega=0.8, seed=seed).motion(t)
        forces = np.asarray(base.model.inverse_dynamics(np.ones(base.model.size), motion))
        return t, np.asarray(motion.q), forces + random.normal(0, 0.1, forces.shape)

    def experiment(self, round_):
        """Writes the file of a new robot, and two logs of it."""
        import numpy as np

        from jaxid.experiment.experiment import load_experiment

        path = self.folder / "experiment.toml"
        path.write_text(robot_table(round_))
        found = load_experiment(path)
        for k, name in enumerate(("a", "b")):
            t, q, tau = self.log(found.base, 2 * round_ + k)
            table = np.column_stack([t, q, tau])
            header = "t,q1,q2,q3,tau1,tau2,tau3"
            np.savetxt(self.folder / f"{name}.csv", table, "%.9g", ",", header=header, comments="")
        return found

    def identified(self, round_):
        """From a file to a verdict, in Python."""
        import jaxid as jid

        found = self.experiment(round_)
        a, b = (found.observe(found.read(self.folder / f"{n}.csv")) for n in "ab")
        fit = found.fit(jid.Rows.of(found.base, [a]))
        jid.validate(fit, [b])

    def reported(self, round_):
        """The same on the command line, with its figures."""
        place = [str(self.folder / n) for n in ("experiment.toml", "a.csv", "b.csv", "report")]
        self.command("identify", place[0], place[1], "--verify", place[2], "-o", place[3])

    def refused(self, round_):
        """A log with a hole."""
        text = (self.folder / "a.csv").read_text().replace(",", ",nan,", 1)
        (self.folder / "bad.csv").write_text(text)
        args = (str(self.folder / "experiment.toml"), str(self.folder / "bad.csv"))
        if self.command("inspect", *args) != 2:
            raise RuntimeError("a log with a hole was not refused")

    def command(self, *args):
        """Runs a command line in this process."""
        from jaxid import cli

        before, sys.argv = sys.argv, ["jaxid", *args]
        try:
            with (
                contextlib.redirect_stdout(io.StringIO()),
                contextlib.redirect_stderr(io.StringIO()),
            ):
                cli.main()
        except SystemExit as stopped:
            return stopped.code
        finally:
            sys.argv = before

    def batch(self, round_):
        """Many data sets at once, as many and as long as no other round has."""
        import numpy as np

        import jaxid as jid

        sets, samples = 3 + round_ % 5, 300 + 7 * (round_ % 11)
        logs = [self.log(self.arm, 100 * round_ + k, samples) for k in range(sets)]
        t = 0.002 * np.arange(samples)
        motions = [
            jid.random_fourier_series(self.arm.model.robot, omega=0.8, seed=100 * round_ + k)
            for k in range(sets)
        ]
        motions = [m.motion(t) for m in motions]
        stacked = jid.Motion(
            *(np.stack([np.asarray(getattr(m, x)) for m in motions]) for x in ("q", "qd", "qdd"))
        )
        jid.identify_batch(self.arm, stacked, np.stack([f for _, _, f in logs]), np.ones(3))

    def streamed(self, round_):
        """A log that is long enough to go through part by part."""
        import jaxid as jid

        t, q, tau = self.log(self.arm, round_, 20_000 if self.quick else 120_000)
        recording = jid.Recording.of(q, tau, time=t)
        robot = self.arm.model.robot
        seen = jid.observe(recording, robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10))
        jid.identify(self.arm, seen, jid.WeightedLeastSquares(jid.ResidualVariances()))

    def consistent(self, round_):
        """Bodies that could exist."""
        import jaxid as jid

        t, q, tau = self.log(self.arm, round_)
        recording = jid.Recording.of(q, tau, time=t)
        robot = self.arm.model.robot
        seen = jid.observe(recording, robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10))
        weights = jid.GivenWeights((1.0, 1.0, 1.0))
        jid.identify(self.arm, seen, jid.PhysicallyConsistent(weights=weights))

    def designed(self, round_):
        """A motion within limits, short of polish."""
        import jax
        import numpy as np

        import jaxid as jid

        jid.design_excitation(
            self.arm,
            limits=jid.Limits.of(
                3,
                position_min=np.full(3, -2.0),
                position_max=np.full(3, 2.0),
                velocity=np.full(3, 2.0),
                acceleration=np.full(3, 8.0),
            ),
            noise=np.ones(3),
            starts=2,
            generations=1,
            polish=0,
            harmonics=3,
            samples=200,
            key=jax.random.key(round_),
            throw=False,
        )

    def all(self):
        """Jobs in their order: the first writes the files of the next two."""
        often = [self.identified, self.reported, self.refused, self.batch]
        return [*often, self.streamed, self.consistent, self.designed]


def state():
    """What the process holds now."""
    import threading

    import jax

    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "rss": pages * os.sysconf("SC_PAGE_SIZE") / MIB,
        "compiled": len(jax.devices("cpu")[0].client.live_executables()),
        "files": len(os.listdir("/proc/self/fd")),
        "threads": threading.active_count(),
        "objects": len(gc.get_objects()),
    }


def soak(minutes, quick, say):
    import jax

    jax.config.update("jax_enable_x64", True)
    seen, start, round_ = [], time.monotonic(), 0
    with tempfile.TemporaryDirectory() as folder:
        jobs = Jobs(Path(folder), quick)
        while time.monotonic() - start < 60 * minutes or round_ < 2:
            round_ += 1
            spent = {}
            for job in jobs.all():
                began = time.monotonic()
                job(round_)
                spent[job.__name__] = round(time.monotonic() - began, 2)
            gc.collect()
            seen.append({"minute": (time.monotonic() - start) / 60, "round": round_, **state()})
            say(seen[-1] | spent)
    return seen


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--json")
    parser.add_argument("--log", help="each round as a line of JSON")
    given = parser.parse_args()
    timing.pin_to(1)
    os.environ["JAXID_CACHE_DIR"] = "off"
    import numpy as np

    def say(line):
        if given.log:
            with open(given.log, "a") as file:
                file.write(json.dumps(line) + "\n")

    minutes = 0.0 if given.quick else given.minutes
    seen = soak(minutes, given.quick, say)
    first = seen[len(seen) // 6]
    late = seen[len(seen) // 3 :]
    slope = 0.0
    if len(late) > 2:
        slope = np.polyfit([s["minute"] for s in late], [s["rss"] for s in late], 1)[0] * 60
    print("| minute | rounds | resident [MiB] | compiled | open files | threads |")
    print("|---|---|---|---|---|---|")
    for k in np.unique(np.linspace(0, len(seen) - 1, 13).astype(int)):
        s = seen[k]
        print(
            f"| {s['minute']:.0f} | {s['round']} | {s['rss']:.0f} | {s['compiled']} "
            f"| {s['files']} | {s['threads']} |"
        )
    row = Row(
        "soak",
        f"{seen[-1]['minute']:.0f} minutes of mixed jobs",
        "resident memory after the first sixth and at the end, slope over the last two thirds",
        "memory flat, caches bounded",
        f"{len(seen)} rounds: {first['rss']:.0f} → {seen[-1]['rss']:.0f} MiB "
        f"({slope:+.1f} MiB an hour); compiled {first['compiled']} → {seen[-1]['compiled']}, "
        f"open files {first['files']} → {seen[-1]['files']}",
        None if given.quick else seen[-1]["rss"] < FLAT * first["rss"],
    )
    hand_over([row], given.json)


if __name__ == "__main__":
    main()
