"""SIGKILL and Ctrl-C at random moments, and long use in one process.

    python benchmarks/faults.py [kill interrupt soak] [--quick] [--minutes 8]
        [--json FILE]

The files are those of `jaxid example`, the random numbers seeded.

kill: `jaxid identify` writes into the folder of an earlier report and gets SIGKILL at a
random moment of the time that it takes undisturbed. Right is: every file equals that of
one of the two reports, `result.json` is absent or all files belong to it, and the same
command then ends well.

interrupt: each command gets SIGINT, every fifth time SIGTERM, at a random moment
between 60 ms (in which Python itself starts) and its undisturbed end, or 20 s. Right
is: it ends within 2 s with 130 or 143 and one sentence, or as if nothing had come; no
traceback; no temporary file is left. Signals that end Python itself before it has read
the package are counted apart.

soak: logs are identified, batches fitted and motions designed for robots that change
every round. Printed: resident memory after the first sixth of the time and at the end,
and open files.
"""

import contextlib
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import timing
from timing import Row, hand_over

URDF = """<robot name="r"><link name="a"/><link name="b"><inertial>
<origin xyz="0 0 .1" rpy="0 0 0"/>
<mass value="2"/><inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/>
</inertial></link>
<link name="c"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
<origin xyz="0 0 .3" rpy="0 1.5708 0"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="50" velocity="3"/></joint>
<joint name="k" type="prismatic"><parent link="b"/><child link="c"/><axis xyz="1 0 0"/>
<limit upper="1" effort="5" velocity="1"/></joint></robot>"""


def jaxid(*words, **options):
    """Start a command of the package in a process of its own."""
    command = [sys.executable, "-m", "jaxid", *map(str, words)]
    options = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, **options}
    return subprocess.Popen(command, **options)


def example(folder):
    """Write the files of `jaxid example`."""
    import jaxid as jid

    folder.mkdir(exist_ok=True)
    jid.simulation.write_example(folder)
    return folder


def planar_base(lengths):
    """Return the base parameters of a planar arm with limits."""
    import jaxid as jid

    limits = {"position_min": [-2, -2], "position_max": [2, 2], "velocity": [3, 3]}
    limits = jid.Limits(2, **limits, acceleration=[10, 10], force=[50, 20])
    return jid.base_parameters(
        jid.Model(jid.robots.planar_arm(2, lengths).replace(limits=limits))
    )


# Kills


def contents(folder):
    """Return digests of the files of a report, its dates and times left out."""
    found = {}
    for path in folder.iterdir():
        data = path.read_bytes()
        if path.suffix == ".json":
            values = json.loads(data)
            values.pop("made", None)
            values.pop("date", None)
            data = json.dumps(
                values.get("base_parameters", values.get("parameters"))
            ).encode()
        if path.suffix != ".html":
            found[path.name] = hashlib.sha256(data).hexdigest()
    return found


def kill(folder, minutes, quick):
    """Kill `jaxid identify` at random moments and count reports that are not whole."""
    target, chance, wrong = folder / "report", random.Random(0), []
    words = ("identify", folder / "experiment.toml")

    def identify(log):
        return jaxid(*words, folder / f"{log}.csv", "-o", target)

    states, took = {}, 0.0
    for log in ("verification", "identification"):
        begun = time.monotonic()
        if identify(log).wait():
            raise SystemExit("`jaxid identify` failed")
        states[log], took = contents(target), time.monotonic() - begun
    count, end = 0, time.monotonic() + (4 * took if quick else 60 * minutes)
    while time.monotonic() < end:
        log = chance.choice(tuple(states))
        with contextlib.suppress(subprocess.TimeoutExpired):
            process = identify(log)
            process.wait(chance.uniform(0.5, 1.02) * took)
        process.send_signal(signal.SIGKILL)
        process.wait()
        count += 1
        found = contents(target)
        known = [{**state, **found} == state for state in states.values()]
        if "result.json" in found and not any(known):
            wrong.append(f"after {count} kills: a mixture of two reports")
        if identify(log).wait() or contents(target) != states[log]:
            wrong.append(f"after {count} kills: the next run is not the same")
    said = f"{count} kills, {len(wrong)} wrong {' '.join(wrong)}"
    return [Row("kill", "jaxid identify", "faults.py kill", "0 wrong", said, not wrong)]


# Ctrl-C


def interrupt(folder, minutes, quick):
    """Send signals to commands at random moments, and count what is not right."""
    experiment, log = folder / "experiment.toml", folder / "identification.csv"
    report, rows = folder / "done", []
    (folder / "arm.urdf").write_text(URDF, encoding="utf-8")
    if jaxid("identify", experiment, log, "-o", report).wait():
        raise SystemExit("`jaxid identify` failed")
    shutil.copytree(report, folder / "again")
    commands = {
        "init": ("init", folder / "arm.urdf"),
        "example": ("example", folder / "motion" / "new"),
        "inspect": ("inspect", experiment, log),
        "identify": ("identify", experiment, log, "-o", folder / "report"),
        "export": ("export", report, "--to", "c", "-o", folder / "arm.c", "--force"),
        "compare": ("compare", report, folder / "again", "-o", folder / "comparison"),
        "states": (
            "states",
            experiment,
            log,
            folder / "verification.csv",
            "-o",
            folder / "states",
        ),
        "excite": ("excite", experiment, "-o", folder / "motion" / "motion.csv"),
        "demo": ("demo", "-o", folder / "demo"),
    }
    for name, words in commands.items():
        chance, wrong, slowest, early = random.Random(name), [], 0.0, 0
        begun = time.monotonic()
        with contextlib.suppress(subprocess.TimeoutExpired):
            first = jaxid(*words)
            first.wait(20.0)
        first.kill()
        took = time.monotonic() - begun
        moments = 2 if quick else 50
        for count in range(moments):
            shutil.rmtree(folder / "motion", ignore_errors=True)
            signals = signal.SIGTERM if count % 5 == 4 else signal.SIGINT
            process = jaxid(*words, stderr=subprocess.PIPE)
            time.sleep(chance.uniform(0.06, took))
            sent = time.monotonic()
            process.send_signal(signals)
            said = process.communicate()[1].decode()
            slowest = max(slowest, time.monotonic() - sent)
            left = [str(x) for x in folder.rglob(".jaxid-*")]
            stopped = process.returncode == 128 + signals and said.count("\n") == 1
            if process.returncode == -signals and "jaxid/" not in said:
                early += 1
                continue
            if (
                left
                or "Traceback" in said
                or not (stopped or process.returncode in (0, 3))
            ):
                wrong.append(f"{process.returncode}: {said[-200:]!r} {left}")
        said = f"{moments} signals, {early} while Python started, "
        said += f"{len(wrong)} wrong, slowest {slowest:.2f} s {' '.join(wrong)}"
        holds = not wrong and slowest < 2.0
        rows.append(
            Row("interrupt", name, "faults.py interrupt", "0 wrong, 2 s", said, holds)
        )
        print(name, said, flush=True)
    return rows


# Long use


def resident():
    """Return the resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def round_of_jobs(seed):
    """Identify, fit a batch and design a motion for a robot that no other round has."""
    import jax
    import numpy as np

    import jaxid as jid

    base = planar_base(np.random.default_rng(seed).uniform(0.3, 0.6, 2))
    series = jid.trajectories.random_fourier_series(
        base.model.robot, omega=0.8, seed=seed
    )
    motion = series.motion(0.002 * np.arange(4000))
    forces = np.asarray(base.model.inverse_dynamics(np.ones(base.model.size), motion))
    noise = np.random.default_rng(seed).normal(0.0, 0.1, (8, *forces.shape))
    log = jid.Recording.of(motion.q, forces + noise[0], sample_time=0.002)
    rows = jid.observe(
        log, base.model.robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10)
    )
    jid.identify(base, rows)
    with contextlib.suppress(jid.InputError):
        jid.identify(base, rows.split(0.99)[1])
    parts = (x[None, ::10] for x in (motion.q, motion.qd, motion.qdd))
    jid.identify_batch(base, jid.Motion(*parts), (forces + noise)[None, :, ::10])
    settings = {
        "harmonics": 2,
        "starts": 2,
        "generations": 0,
        "samples": 100,
    }
    jid.design_excitation(base, key=jax.random.key(seed), **settings)


def soak(folder, minutes, quick):
    """Repeat jobs of changing robots; compare memory at the beginning and the end."""
    begun, rounds, early = time.monotonic(), 0, None
    length = 60.0 * minutes
    while rounds < 2 or (not quick and time.monotonic() - begun < length):
        round_of_jobs(rounds)
        rounds += 1
        if early is None and (quick or time.monotonic() - begun > length / 6):
            early = resident()
    files = len(os.listdir("/proc/self/fd"))
    late = resident()
    said = (
        f"{rounds} rounds, {early:.0f} MiB after a sixth, {late:.0f} at the end, "
        f"{files} files"
    )
    flat = quick or late < 1.05 * early
    return [Row("soak", "memory", "faults.py soak", "at most 1.05 times", said, flat)]


def main():
    """Run the chosen parts."""
    parser = timing.parser(__doc__, "a few seconds of each")
    parts = {"kill": kill, "interrupt": interrupt, "soak": soak}
    parser.add_argument("parts", nargs="*", default=list(parts))
    parser.add_argument("--minutes", type=float, default=8.0)
    options = parser.parse_args()
    rows = []
    for part in options.parts:
        with tempfile.TemporaryDirectory() as folder:
            place = example(Path(folder) / "example")
            rows += parts[part](place, options.minutes, options.quick)
    hand_over(rows, options.json)
    return not all(row.holds for row in rows)


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    raise SystemExit(main())
