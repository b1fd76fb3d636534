"""Run the benchmarks, each in a process of its own, and keep what they measure.

    python benchmarks/run.py                    # all figures of speed, about 25 minutes
    python benchmarks/run.py peers streaming    # only these scripts
    python benchmarks/run.py --methods          # also the quality of the methods: hours
    python benchmarks/run.py --resume           # only what is not measured today
    python benchmarks/run.py --check            # everything small: does it still run?

Each script leaves its figures in `measured/NAME.json`, with machine, versions and date,
as soon as it ends; all of them are written as tables to `results/measured.md`. A script
that fails or takes too long keeps its old figures, is named at the end, and the exit
code is 1.

`--check` runs every script with `--quick`, the notebooks, the site, and the tests with
run-time checks of shapes. It prints a table of results, writes it to
`results/check.md`, and exits with 1 if something failed. It measures nothing.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from timing import HERE, REPOSITORY, Row, machine

RESULTS, MEASURED = HERE / "results", HERE / "measured"
HEAD = ("row", "what", "asked", "measured", "holds", "recipe")


class Script(NamedTuple):
    """Script of this folder.

    Attributes:
        name: Name of its file.
        minutes: Approximate duration on two quiet cores.
        arguments: Arguments of a whole run.
    """

    name: str
    minutes: float
    arguments: tuple[str, ...] = ()

    @property
    def command(self):
        """Command without arguments."""
        return [sys.executable, "-u", str(HERE / f"{self.name}.py")]


SPEED = (
    Script("peers", 2),
    Script("speed_table", 10),
    Script("surface", 4),
    Script("fences", 2),
    Script("compile", 2),
    Script("streaming", 6),
    Script("python_loop", 2),
    Script("batches", 2),
    Script("scaling", 8),
    Script("large_trees", 12),
    Script("compile_robots", 90),
    Script("gpu", 2),
)
METHODS = (
    Script("consistency", 25),
    Script("coverage", 20),
    Script("held_out", 10),
    Script("friction", 60),
    Script("states", 5),
    Script("agreement", 10),
    Script("closed_chains", 5),
    Script("rollout", 55),
    Script("calibration", 6),
    Script("force_sensor", 10),
    Script("floating", 10),
    Script("designed_legs", 12),
    Script("leg_mistakes", 40),
    Script("transients", 1),
    Script("excitation", 60),
    Script("safe_motions", 40),
    Script("first_motion", 15),
    Script("export", 10),
    Script("virtual_robot", 5),
    Script("demo", 10),
    Script("measured_robots", 4),
    Script("other_tools", 2),
    Script("faults", 25),
    Script("mutated_files", 6),
    Script("mutated_commands", 3),
    Script("delay", 40),
    Script("resolution", 10),
    Script("report", 1),
    Script("robot_files", 2),
    Script("public_reports/run", 12),
    Script("judgement/rates", 40),
    Script("judgement/priors", 25),
)
SCRIPTS = SPEED + METHODS


def run(command, limit, show=True):
    """Return what a command prints, and whether it ended well within some seconds."""
    with tempfile.TemporaryFile("w+", errors="replace") as file:
        process = subprocess.Popen(
            command,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            cwd=REPOSITORY,
        )
        try:
            code = process.wait(limit)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
            code = f"it took more than {limit / 60:.0f} minutes"
        file.seek(0)
        text = file.read()
    if show or code:
        print(text, end="", flush=True)
    return text, code == 0


def measure(script):
    """Return the rows of a script, or its text if it has none; None if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.json"
        command = [*script.command, *script.arguments, "--json", str(path)]
        text, good = run(command, 180 * script.minutes)
        if not good:
            return None
        return (
            {"rows": json.loads(path.read_text())} if path.exists() else {"text": text}
        )


def stored(name):
    """Return what was measured last, or None."""
    path = MEASURED / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def write(path, text):
    """Write a file as a whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".part")
    draft.write_text(text, encoding="utf-8")
    draft.replace(path)


def is_fresh(name, facts):
    """Return whether a script was measured today with the same machine and versions."""
    found = stored(name)
    same = ("date", "machine", "versions")
    return found is not None and all(found["facts"].get(k) == facts[k] for k in same)


def table(head, rows):
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [
        [str(x).replace("|", "/").replace("\n", " ") for x in line] for line in lines
    ]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


def section(name, found):
    """Return a script's section: facts of the machine, and its rows or text."""
    facts = "; ".join(f"{key}: {value}" for key, value in found["facts"].items())
    duration = f"; took {found['seconds']} s" if found["seconds"] else ""
    lines = f"## {name}\n\n{facts}{duration}.\n\n"
    if "text" in found:
        return f"{lines}```\n{found['text'].strip()}\n```\n"
    holds = {True: "yes", False: "**no**", None: ""}
    rows = [Row(**row) for row in found["rows"]]
    cells = [
        (r.number, r.what, r.asked, r.measured, holds[r.holds], r.recipe) for r in rows
    ]
    return lines + table(HEAD, cells)


def tables():
    """Return all stored figures as tables."""
    parts = [section(s.name, found) for s in SCRIPTS if (found := stored(s.name))]
    head = "# Measured figures\n\nWritten by `python benchmarks/run.py`.\n\n"
    return head + "\n".join(parts)


def write_tables():
    """Write the tables of all stored figures."""
    write(RESULTS / "measured.md", tables())


def measure_all(scripts, resume):
    """Run scripts and keep what they measure; return the names of those that failed."""
    failed, lost = [], []
    for number, script in enumerate(scripts, 1):
        start, facts = time.perf_counter(), machine()
        if resume and is_fresh(script.name, facts):
            continue
        print(
            f"== {number}/{len(scripts)} {script.name}, about {script.minutes:g} min",
            flush=True,
        )
        found = measure(script)
        if found is None:
            failed.append(script.name)
            continue
        seconds = round(time.perf_counter() - start)
        content = {"facts": facts, "seconds": seconds, **found}
        write(MEASURED / f"{script.name}.json", json.dumps(content, indent=1) + "\n")
        write_tables()
        lost += [Row(**row) for row in found.get("rows", []) if row["holds"] is False]
    for row in lost:
        print(
            f"DOES NOT HOLD [{row.number}] {row.what}: {row.measured}; asked "
            f"{row.asked}"
        )
    return failed


def check(scripts, whole):
    """Run everything small, write the table of results; return names of failures."""
    jobs = {f"benchmarks/{s.name}.py --quick": [*s.command, "--quick"] for s in scripts}
    if whole:
        jobs["notebooks/run_all.py"] = [
            sys.executable,
            str(REPOSITORY / "notebooks/run_all.py"),
        ]
        jobs["benchmarks/arms/run.py --quick"] = [
            sys.executable,
            str(REPOSITORY / "benchmarks/arms/run.py"),
            "--quick",
        ]
        jobs["docs/build.py"] = [sys.executable, str(REPOSITORY / "docs/build.py")]
        settings = ("JAXID_CHECK_SHAPES=1", "JAX_DISABLE_MOST_OPTIMIZATIONS=0")
        jobs["tests with checked shapes, optimised"] = [
            *("env", *settings, sys.executable, "-m", "pytest")
        ]
    rows, begun = [], time.perf_counter()
    for name, command in jobs.items():
        start = time.perf_counter()
        _, good = run(command, 3600, show=False)
        rows.append(
            (name, f"{time.perf_counter() - start:.0f}", "ok" if good else "**failed**")
        )
        print(f"{name}: {rows[-1][1]} s, {'ok' if good else 'failed'}", flush=True)
    failed = [name for name, _, result in rows if result != "ok"]
    facts = "; ".join(f"{key}: {value}" for key, value in machine().items())
    result = (
        f"# Result of `python benchmarks/run.py --check`\n\n{facts}.\n\n"
        f"{table(('what', 'seconds', 'result'), rows)}\n"
        f"{len(rows) - len(failed)} of {len(rows)} ok, "
        f"{(time.perf_counter() - begun) / 60:.0f} minutes.\n"
    )
    write(RESULTS / "check.md", result)
    print(f"\n{result}")
    return failed


def main():
    """Run the selected scripts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    known = {script.name: script for script in SCRIPTS}
    parser.add_argument("scripts", nargs="*", help=f"only these: {', '.join(known)}")
    parser.add_argument(
        "--check", action="store_true", help="everything small; the tests"
    )
    parser.add_argument(
        "--resume", action="store_true", help="skip what was measured today"
    )
    parser.add_argument(
        "--methods", action="store_true", help="also the quality of the methods"
    )
    parser.add_argument(
        "--tables", action="store_true", help="only write the tables again"
    )
    options = parser.parse_args()
    unknown = [name for name in options.scripts if name not in known]
    if unknown:
        parser.error(
            f"no such script: {', '.join(unknown)}; there are {', '.join(known)}"
        )
    every = SCRIPTS if options.methods or options.check else SPEED
    scripts = [known[name] for name in options.scripts] or every
    if options.tables:
        write_tables()
        return
    if options.check:
        failed = check(scripts, whole=not options.scripts)
    else:
        failed = measure_all(scripts, options.resume)
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
