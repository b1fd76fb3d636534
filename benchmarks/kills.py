"""Kills commands at random moments: nothing corrupt may stay, and what is run again must be equal.

    python benchmarks/kills.py [--quick] [--json FILE] [--kills 30] [--job moves design …]

Four jobs, on a planar arm of two joints. design: `jaxid excite` (state saved, `--resume` until it
is done). streaming: a log that is read part by part is identified, and the run saved. report:
`jaxid identify` into the folder of an earlier report. moves: the files of two finished reports take
each other's places 40 times, as at the end of every command. Each runs in a fork of this process
with compiled computations on the disk, gets SIGKILL after a random part of the time that it takes
undisturbed, and is then run again to its end. Corrupt is: a file that is not bit by bit one of an
undisturbed run (its date left out), files of two runs side by side below a `result.json`, or a job
that then fails, or leaves a hidden folder of the one that was killed. Unequal is a result of the
second run that is not that of an undisturbed one, or a file of the earlier report beside it.

Faults beside: a file that may not grow (a full disk), a full tmpfs where this may be mounted, a log
and an experiment file that vanish, a log that is a pipe or a folder, two runs into one folder at
once. Each must end, within a time limit, in a sentence and exit code 2 (two runs: in one report
that is whole), and leave no partial result.
"""

import argparse
import contextlib
import csv
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import timing
from timing import Row, hand_over

MOVES = 40
LIMIT = 300.0
"""Seconds after which a command counts as hung."""
EXPERIMENT = """\
[robot]
builtin = "planar_arm"
[limits]
angle_unit = "deg"
position_min = [-120, -120]
position_max = [120, 120]
velocity = [120, 120]
acceleration = [400, 400]
force = [80, 20]
[recording]
angles = "q{}"
forces = "tau{}"
time = "t"
[filter]
kind = "butterworth"
cutoff = 10
[rows]
every = 4
[excitation]
harmonics = 2
starts = 4
polish = 4
samples = 100
leads = false
"""
DESIGN = ("excite", "e.toml", "-o", "motion.csv")


def write_log(path, seed, samples=1500):
    """Smooth angles, and forces that have to do with them."""
    import numpy as np

    chance = np.random.default_rng(seed)
    t = 0.005 * np.arange(samples)
    w = 1.3 * np.arange(1, 5)[:, None]
    a = chance.uniform(-0.25, 0.25, (4, 2))
    q = np.sin(w * t).T @ a
    tau = 9.0 * np.cos(q) - ((w**2) * np.sin(w * t)).T @ a + chance.normal(0, 0.05, q.shape)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "q1", "q2", "tau1", "tau2"])
        writer.writerows(np.column_stack([t, q, tau]).round(7).tolist())


def started(folder, work, before=lambda: None):
    """Some work in a fork of this process, in a folder: the fork's number."""
    number = os.fork()
    if number:
        return number
    code = 0
    try:
        os.chdir(folder)
        with open(f"{folder}.out", "a") as out:
            os.dup2(out.fileno(), 1)
            os.dup2(out.fileno(), 2)
            before()
            work()
    except SystemExit as stopped:
        code = stopped.code or 0
    except BaseException as error:
        os.write(2, f"Traceback: {error!r}\n".encode())
        code = 70
    finally:
        os._exit(code)


def command(*args):
    """A command line."""

    def work():
        from jaxid import cli

        sys.argv = ["jaxid", *args]
        cli.main()

    return work


def stream():
    """Identifies with a log part by part, and saves the run."""
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxid as jid
    import jaxid.identification.streaming as streaming
    from jaxid.experiment.experiment import load_experiment

    streaming.LONG = 10_000
    jid.keep_compiled()
    described = load_experiment("e.toml")
    run = jid.Run.of(described.base, described.open(Path("long.csv")))
    jid.save_run("run.npz", run)


def move():
    """Puts finished reports into one folder, in turn, the newer one last."""
    from jaxid.files import written_whole

    for k in range(MOVES):
        with written_whole(Path("report")) as staging:
            for path in Path("../new" if k % 2 else "../old").iterdir():
                shutil.copy(path, staging)


def ended(number, limit=LIMIT):
    """Exit code of a fork; None if it had to be stopped."""
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(number, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    return None


def killed(number, seconds):
    """Kills a fork after some time; whether it was still running."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        done, _ = os.waitpid(number, os.WNOHANG)
        if done:
            return False
        time.sleep(0.001)
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)
    return True


def content(folder):
    """Files of a folder, by name, without what may differ from run to run."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and not any(p.startswith(".jaxid-") for p in path.parts):
            data = path.read_bytes()
            if path.suffix in (".json", ".html"):
                data = re.sub(rb"20\d\d-\d\d-\d\d[T ][\d:.+Z-]*", b"", data)
            if path.suffix == ".npz":
                data = arrays(path)
            found[str(path.relative_to(folder))] = data
    return found


def arrays(path):
    """What an archive holds: its own bytes tell the time of their writing."""
    from jaxid.files import read_arrays

    return {name: (x.dtype.str, x.tobytes()) for name, x in read_arrays(path).items()}


class Trials:
    """What is done, and what was found wrong."""

    def __init__(self, root, chance):
        self.root, self.chance = root, chance
        self.kills, self.late, self.corrupt, self.unequal, self.leftovers = (
            0,
            0,
            [],
            [],
            0,
        )

    def place(self, name, report=None):
        """A fresh folder with the experiment, and with an earlier report."""
        place = self.root / name
        if place.exists():
            shutil.rmtree(place)
        shutil.copytree(self.root / "good", place)
        if report is not None:
            shutil.copytree(report, place / "report")
        return place

    def hidden(self, folder):
        """What a kill has left of a result that was not ready."""
        return list(folder.rglob(".jaxid-*"))

    def cleared(self, what, place):
        """The run after a kill leaves nothing hidden."""
        if self.hidden(place):
            self.corrupt.append(f"{what}: {self.hidden(place)} stays")

    def counted(self, was_running):
        """Whether a kill came in time."""
        self.kills += was_running
        self.late += not was_running

    def undisturbed(self, work, report=None):
        """What a job leaves, and how long it takes the second time."""
        for _ in range(2):
            place = self.place("whole", report)
            began = time.monotonic()
            if ended(started(place, work)) != 0:
                raise RuntimeError(Path(f"{place}.out").read_text())
        return content(place), time.monotonic() - began

    def design(self, kills):
        """`--resume` again and again, killed each time, then to the end."""
        resumed = command(*DESIGN, "--resume")
        whole, took = self.undisturbed(command(*DESIGN))
        outputs = {k: v for k, v in whole.items() if k.startswith("motion")}
        done = 0
        while done < kills:
            place = self.place("design")
            for turn in range(6):
                number = started(place, resumed if turn else command(*DESIGN))
                self.counted(killed(number, self.chance.uniform(0.0, took)))
                done += 1
                self.wrong("design", place, outputs)
                if (place / "motion.json").exists() or done >= kills:
                    break
            code = ended(started(place, resumed))
            if code not in (0, 2):
                self.corrupt.append("design: the resumed run failed")
            elif code == 0:
                self.cleared("design", place)
            now = content(place)
            if any(now.get(name) != data for name, data in outputs.items()):
                self.unequal.append(f"design: {[n for n in outputs if now.get(n) != outputs[n]]}")

    def streaming(self, kills):
        """Killed, then run again."""
        whole, took = self.undisturbed(stream)
        for _ in range(kills):
            place = self.place("streaming")
            self.counted(killed(started(place, stream), self.chance.uniform(0.0, took)))
            self.wrong("streaming", place, whole)
            if ended(started(place, stream)) != 0:
                self.corrupt.append("streaming: the next run failed")
            elif content(place) != whole:
                self.unequal.append("streaming")
            self.cleared("streaming", place)

    def replaced(self, what, kills, work):
        """A report over an earlier one: killed, then written again."""
        new, took = self.undisturbed(work, self.root / "old")
        old = content(self.place("whole", self.root / "old"))
        for _ in range(kills):
            place = self.place("replaced", self.root / "old")
            self.counted(killed(started(place, work), self.chance.uniform(0.0, took)))
            self.leftovers += len(self.hidden(place))
            now = content(place)
            whole = any(all(now.get(k) == x for k, x in one.items()) for one in (old, new))
            if "report/result.json" in now and not whole:
                self.corrupt.append(f"{what}: {sorted(now)}")
            if ended(started(place, work)) != 0:
                self.corrupt.append(f"{what}: the next run failed")
            elif content(place) != new:
                self.unequal.append(what)
            self.cleared(what, place)

    def wrong(self, what, place, outputs):
        """Files that are there are those of an undisturbed run, or a state that can be read."""
        self.leftovers += len(self.hidden(place))
        for name, data in content(place).items():
            if name in outputs and data != outputs[name]:
                self.corrupt.append(f"{what}: {name}")


class Faults:
    """What a disk, a file system and a process may do; a line for each."""

    def __init__(self, trials):
        self.trials, self.lines = trials, []
        self.run = command("identify", "e.toml", "a.csv", "-o", "report")

    def told(self, what, folder, code, words, seconds):
        """Right is exit code 2 in time, a sentence, and no report."""
        out = Path(f"{folder}.out").read_text().strip().splitlines()
        sentence = out[-1] if out else ""
        trace = any("Traceback" in line for line in out)
        report = (folder / "report" / "result.json").exists()
        hidden = len(list(folder.rglob(".jaxid-*")))
        right = code == 2 and words in sentence and not trace and not report and not hidden
        self.lines.append((what, sentence, code, seconds, hidden + report, right))

    def one(self, what, words, before=lambda: None, prepare=lambda place: None):
        """A fault in one command."""
        place = self.trials.place("fault")
        Path(f"{place}.out").write_text("")
        prepare(place)
        began = time.monotonic()
        code = ended(started(place, self.run, before))
        self.told(what, place, code, words, time.monotonic() - began)

    def all(self):
        """One after the other."""

        def small():
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

        self.one("a file may not grow beyond 20 kB", "make room", before=small)
        self.tmpfs()

        def lost(name):
            return lambda place: (place / name).unlink()

        self.one("the log is gone", "`a.csv` is no file", prepare=lost("a.csv"))
        self.one("the experiment file is gone", "`e.toml` is no file", prepare=lost("e.toml"))

        def pipe(place):
            (place / "a.csv").unlink()
            os.mkfifo(place / "a.csv")

        self.one("the log is a pipe that nobody fills", "`a.csv` is no file", prepare=pipe)
        if os.geteuid():
            hide = lambda place: (place / "a.csv").chmod(0)  # noqa: E731
            self.one("the log may not be read", "Permission denied", prepare=hide)
        self.one(
            "the log is a folder",
            "but at least one log must be given as a file",
            prepare=lambda place: ((place / "a.csv").unlink(), (place / "a.csv").mkdir()),
        )
        self.together()
        return self.lines

    def tmpfs(self):
        """A disk of one megabyte."""
        place = self.trials.place("full")
        Path(f"{place}.out").write_text("")
        (place / "report").mkdir()
        mount = [
            "mount",
            "-t",
            "tmpfs",
            "-o",
            "size=60k",
            "none",
            str(place / "report"),
        ]
        if subprocess.run(mount, capture_output=True).returncode:
            return
        try:
            began = time.monotonic()
            code = ended(started(place, self.run))
            self.told(
                "the disk is full",
                place,
                code,
                "No space left",
                time.monotonic() - began,
            )
        finally:
            subprocess.run(["umount", str(place / "report")], check=True)

    def together(self):
        """Two runs into one folder at once: one of them whole, whoever is last."""
        wrong, began, turns = 0, time.monotonic(), 3
        for _ in range(turns):
            place = self.trials.place("both")
            works = [command("identify", "e.toml", f"{x}.csv", "--force") for x in "ab"]
            pair = [started(place, work) for work in works]
            codes = [ended(number) for number in pair]
            now = content(place / "report")
            told = json.loads(now["result.json"])["files"]
            whole = self.trials.root / ("old" if "torque_a.png" in told else "new")
            good = content(whole)
            wrong += codes != [0, 0] or any(now.get(name) != good[name] for name in told)
            wrong += bool(self.trials.hidden(place))
        seconds = (time.monotonic() - began) / turns
        said = f"{turns} times: the report of one of them, whole"
        self.lines.append(("two runs into one folder", said, 0, seconds, wrong, not wrong))


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--json")
    parser.add_argument("--job", nargs="*", default=("moves", "streaming", "design", "report"))
    given = parser.parse_args()
    kills = 3 if given.quick else given.kills
    timing.pin_to(1)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack():
        root = Path(folder)
        root.chmod(0o755)
        os.environ["JAXID_CACHE_DIR"] = str(root / "cache")
        os.environ["MPLCONFIGDIR"] = str(root / "mpl")
        import jaxid.report.write  # noqa: F401
        from jaxid import cli  # noqa: F401

        trials = Trials(root, random.Random(2026))
        (root / "good").mkdir()
        (root / "good" / "e.toml").write_text(EXPERIMENT)
        for seed, name in enumerate("ab"):
            write_log(root / "good" / f"{name}.csv", seed)
        write_log(root / "good" / "long.csv", 5, 30_000)
        for name, log in (("old", "a"), ("new", "b")):
            place = trials.place("first")
            code = ended(started(place, command("identify", "e.toml", f"{log}.csv")))
            if code != 0:
                raise RuntimeError(Path(f"{place}.out").read_text())
            shutil.copytree(place / "report", root / name)
        table = []
        into_old = command("identify", "e.toml", "b.csv", "-o", "report")
        for name, run in (
            ("moves", lambda: trials.replaced("moves", kills, move)),
            ("streaming", lambda: trials.streaming(kills)),
            ("design", lambda: trials.design(kills)),
            ("report", lambda: trials.replaced("report", max(1, kills // 10), into_old)),
        ):
            if name not in given.job:
                continue
            before = trials.kills, trials.late, len(trials.corrupt), len(trials.unequal)
            began = time.monotonic()
            run()
            after = trials.kills, trials.late, len(trials.corrupt), len(trials.unequal)
            counts = [b - a for a, b in zip(before, after, strict=True)]
            table.append((name, *counts, time.monotonic() - began))
            print(table[-1], flush=True)
        faults = Faults(trials).all() if len(given.job) > 1 else []
        print(
            "\n| job | kills | too late | corrupt | unequal | minutes |\n|---|---|---|---|---|---|"
        )
        for name, hit, late, corrupt, unequal, seconds in table:
            print(f"| {name} | {hit} | {late} | {corrupt} | {unequal} | {seconds / 60:.1f} |")
        print(f"\nhidden folders that kills have left: {trials.leftovers}")
        for line in (*trials.corrupt, *trials.unequal):
            print("wrong:", line)
        print("\n| fault | what is said | exit code | seconds | left behind | right |")
        print("|---|---|---|---|---|---|")
        for what, sentence, code, seconds, left, right in faults:
            shown = re.sub(re.escape(str(root)) + r"\S*/", "", sentence)
            print(f"| {what} | {shown} | {code} | {seconds:.1f} | {left} | {right} |")
        rows = [
            Row(
                "kills",
                "SIGKILL at random moments",
                "design, streaming, report; run again and compared",
                "no corrupt result, all equal",
                f"{trials.kills} kills: {len(trials.corrupt)} corrupt, "
                f"{len(trials.unequal)} unequal",
                not trials.corrupt and not trials.unequal,
            ),
            Row(
                "faults",
                "disk, files, processes",
                "see above",
                "a sentence, exit code 2, nothing left",
                f"{sum(f[-1] for f in faults)} of {len(faults)} right",
                all(f[-1] for f in faults),
            ),
        ]
        hand_over(rows, given.json)


if __name__ == "__main__":
    main()
