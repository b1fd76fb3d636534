"""Runs the benchmarks, each in a process of its own, and rewrites the tables of `README.md`.

    python benchmarks/run.py                    # all figures of speed, about 25 minutes
    python benchmarks/run.py peers streaming    # these; the other tables stay as they are
    python benchmarks/run.py --resume           # what this machine has not measured today
    python benchmarks/run.py --methods          # also how good the methods are, which takes longer
    python benchmarks/run.py --tables           # measures nothing, writes the tables again
    python benchmarks/run.py --quick            # small, writes nothing: does it still run?

What a script has measured is kept in `measured/NAME.json` as soon as it ends, with the machine, the
versions and the date, so an interrupted run goes on with `--resume`, and figures of a machine with
a GPU stand beside those of another without. A script that fails or takes too long keeps its old
table, is named at the end, and makes the run end with 1; so is every figure that does not hold.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import NamedTuple

from timing import HERE, Row, machine

README, MEASURED = HERE / "README.md", HERE / "measured"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
HEAD = ("row", "what", "asked", "measured", "holds", "recipe")
LONGER = 3.0
"""How many times longer than expected a script may take."""
NO_GPU = "G"
"""Number of the row that says so."""
BUSY = 0.5
"""Load of each core above which times say more about the load."""


class Script(NamedTuple):
    """A script of this folder.

    Attributes:
        name: Of its file.
        minutes: What it takes on two quiet cores, about.
        arguments: With which it is called.
        rows: Whether it hands over rows; what others print is kept as it is.
    """

    name: str
    minutes: float
    arguments: tuple[str, ...] = ()
    rows: bool = True


SPEED = (
    Script("peers", 2),
    Script("fences", 2),
    Script("compile", 2),
    Script("humanoid", 2),
    Script("small", 1),
    Script("streaming", 6),
    Script("batches", 2),
    Script("scaling", 6),
    Script("gpu", 2),
)
METHODS = (
    Script("excitation", 20, ("cond", "d7", "d10", "panda", "gradients", "step", "batch"), False),
    Script("excitation_rivals", 15, (), False),
    Script("constrained_excitation", 60, (), False),
    Script("consistency", 15),
    Script("weighting", 5),
    Script("coverage", 20),
    Script("robustness", 10, (), False),
    Script("held_out", 10, (), False),
    Script("stepwise", 10, (), False),
)
SCRIPTS = tuple(s for s in (*SPEED, *METHODS) if (HERE / f"{s.name}.py").exists())


def measured(script, quick):
    """What a script measures: its rows or its text, or None if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.json"
        command = [sys.executable, "-u", str(HERE / f"{script.name}.py")]
        command += ["--quick"] if quick else script.arguments
        command += ["--json", str(path)] if script.rows else []
        text = printed(command, 60 * LONGER * script.minutes)
        if text is None:
            return None
        if not script.rows:
            return {"text": text}
        if not path.exists():
            print("   it ended well, but handed over no rows")
            return None
        return {"rows": json.loads(path.read_text())}


def printed(command, limit):
    """What a command prints, here too while it runs; None if it fails or takes longer than that."""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, errors="replace", start_new_session=True
    ) as process:
        late = threading.Event()

        def stop():
            if process.poll() is None:
                late.set()
                end(process)

        watch = threading.Timer(limit, stop)
        watch.start()
        lines = []
        try:
            for line in process.stdout:
                print("   " + line, end="", flush=True)
                lines.append(line)
            process.wait()
        except BaseException:
            end(process)
            raise
        finally:
            watch.cancel()
    if late.is_set():
        print(f"   stopped: it took more than {limit / 60:.0f} minutes")
        return None
    return None if process.returncode else "".join(lines)


def end(process):
    """Ends a script and the processes that it has started."""
    if hasattr(os, "killpg"):
        os.killpg(process.pid, signal.SIGKILL)
    else:
        process.kill()


def stored(name):
    """What was measured last, or None."""
    path = MEASURED / f"{name}.json"
    return json.loads(path.read_text()) if path.exists() else None


def store(name, facts, seconds, found):
    MEASURED.mkdir(exist_ok=True)
    path = MEASURED / f"{name}.json"
    draft = path.with_suffix(".part")
    text = json.dumps({"facts": facts, "seconds": round(seconds), **found}, indent=1)
    draft.write_text(text + "\n")
    draft.replace(path)


def is_fresh(name, facts):
    """Whether it was measured today with the same machine and versions."""
    found = stored(name)
    same = ("date", "machine", "versions")
    return found is not None and all(found["facts"].get(k) == facts[k] for k in same)


def cells(values):
    return "| " + " | ".join(v.replace("|", "/").replace("\n", " ") for v in values) + " |"


def table(found, gpu):
    """The section of a script, with a column for a GPU where figures of one are at hand."""
    stamp = "; ".join(f"{name}: {value}" for name, value in found["facts"].items())
    stamp += f"; took {found['seconds']} s" if found["seconds"] else ""
    if "text" in found:
        return f"{stamp}.\n\n```\n{found['text'].strip()}\n```\n"
    rows = [Row(**row) for row in found["rows"]]
    beside = any(row.number in gpu for row in rows)
    head = (*HEAD[:4], "on a GPU", *HEAD[4:]) if beside else HEAD
    lines = [cells(head), "|---" * len(head) + "|"]
    for row in rows:
        holds = {True: "yes", False: "**no**", None: ""}[row.holds]
        on_gpu = [gpu.get(row.number, "")] if beside else []
        lines.append(
            cells([row.number, row.what, row.asked, row.measured, *on_gpu, holds, row.recipe])
        )
    return f"{stamp}.\n\n" + "\n".join(lines) + "\n"


def write_tables():
    """Writes all that is stored between the marks of the README."""
    on_gpu = stored("gpu")
    gpu = {row["number"]: row["measured"] for row in (on_gpu or {"rows": []})["rows"]}
    sections = []
    for script in SCRIPTS:
        found = stored(script.name)
        if found is not None:
            sections.append(f"### {script.name}\n\n{table(found, gpu)}\n")
    before, rest = README.read_text().split(BEGIN)
    draft = README.with_suffix(".part")
    draft.write_text(f"{before}{BEGIN}\n\n{''.join(sections)}{END}{rest.split(END)[1]}")
    draft.replace(README)


def chosen(options):
    known = {s.name: s for s in SCRIPTS}
    unknown = [name for name in options.scripts if name not in known]
    if unknown:
        sys.exit(f"no such script: {', '.join(unknown)}; there are {', '.join(known)}")
    if options.scripts:
        return [known[name] for name in options.scripts]
    return [s for s in SCRIPTS if options.methods or s in SPEED]


def warn_of_load():
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    if load > BUSY * cores:
        print(
            f"Other programs are running (load {load:.1f} on {cores} cores): ratios of what only "
            "computes carry over to a quiet machine, times and compile times do not.\n"
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scripts", nargs="*", help="only these")
    parser.add_argument("--quick", action="store_true", help="small, and write nothing")
    parser.add_argument("--resume", action="store_true", help="skip what was measured today")
    parser.add_argument("--methods", action="store_true", help="also how good the methods are")
    parser.add_argument("--tables", action="store_true", help="only write the tables again")
    options = parser.parse_args()
    if options.tables:
        write_tables()
        return
    scripts, facts = chosen(options), machine()
    if options.resume:
        scripts = [s for s in scripts if not is_fresh(s.name, facts)]
    warn_of_load()
    failed, lost, began = [], [], time.perf_counter()
    for number, script in enumerate(scripts, 1):
        start, facts = time.perf_counter(), machine()
        expected = "" if options.quick else f", about {script.minutes:g} min on two quiet cores"
        print(f"== {number}/{len(scripts)} {script.name}{expected}", flush=True)
        found = measured(script, options.quick)
        seconds = time.perf_counter() - start
        whole = (time.perf_counter() - began) / 60
        print(f"   {script.name}: {seconds:.0f} s; {whole:.1f} min in all\n", flush=True)
        if found is None:
            failed.append(script.name)
            continue
        if [row["number"] for row in found.get("rows", [])] == [NO_GPU]:
            # Figures of a machine that has one stay.
            continue
        lost += [Row(**r) for r in found.get("rows", []) if r["holds"] is False]
        if not options.quick:
            store(script.name, facts, seconds, found)
            write_tables()
    if not options.quick:
        for row in lost:
            print(f"DOES NOT HOLD [{row.number}] {row.what}: {row.measured}; asked {row.asked}")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
