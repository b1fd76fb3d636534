"""Commands on damaged files: exit code 2 with one sentence, or a result.

    python benchmarks/mutated_commands.py [--quick] [--json FILE] [--show]
        [--case "inspect: the log"] [--number 3] [--each 10]

A virtual arm's robot, experiment, log and report are written once. Each case damages
one of these files as `mutated_files.py` does, with the case's name and the number as
the seed, and runs one command. A process imports the package once, and each command
runs in a process that is forked from it, so that 60 of them take two minutes.

Right is exit code 2 with one sentence of `jaxid:` on the error channel, that names a
file or an option, or code 0 or 3 (a result, or one that must not be used). Counted
apart: a traceback, any other code, several sentences, and more than `MAX_SECONDS` of
processor time.
"""

import argparse
import collections
import json
import os
import random
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import timing
from file_samples import CSV, write_experiment
from mutated_files import damage, fault_of_sentence
from timing import Row, hand_over

MAX_SECONDS = 60
"""Processor time of a command, with what JAX compiles [s]."""


class Case(NamedTuple):
    """A command, and the file that is damaged before."""

    words: tuple[str, ...]
    target: str
    is_text: bool = True


INSPECT = ("inspect", "experiment.toml", "log.csv")
EXPORT = ("export", "report", "--to", "json", "-o", "arm.json")
CASES = {
    "inspect: the experiment": Case(INSPECT, "experiment.toml"),
    "inspect: the log": Case(INSPECT, "log.csv"),
    "inspect: the robot": Case(INSPECT, "arm.urdf"),
    "init: the robot": Case(("init", "arm.urdf"), "arm.urdf"),
    "identify: the experiment": Case(
        ("identify", *INSPECT[1:], "-o", "new"), "experiment.toml"
    ),
    "export: the model": Case(EXPORT, "report/model.json"),
    "export: the result": Case(EXPORT, "report/result.json"),
    "identify again: the result": Case(
        ("identify", *INSPECT[1:], "-o", "report"), "report/result.json"
    ),
}


def run(words, folder):
    """Run a command in a process of its own; return its exit code and its errors."""
    process = os.fork()
    if process == 0:
        os.chdir(folder)
        resource.setrlimit(resource.RLIMIT_CPU, (MAX_SECONDS, MAX_SECONDS))
        for channel, name in ((1, "output.txt"), (2, "errors.txt")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), channel)
        sys.argv = ["jaxid", *words]
        runpy.run_module("jaxid", run_name="__main__")
    _, status = os.waitpid(process, 0)
    errors = (folder / "errors.txt").read_text(errors="replace")
    return os.waitstatus_to_exitcode(status), errors


def judge(code, errors):
    """Return the kind of result of a command."""
    if "Traceback" in errors:
        return "traceback"
    if code in (0, 3):
        return "result"
    if code == -signal.SIGXCPU or code == -signal.SIGKILL:
        return "hang"
    if code != 2:
        return f"code {code}"
    lines = errors.strip().splitlines()
    is_sentence = len(lines) == 1 and lines[0].startswith("jaxid: ")
    fault = fault_of_sentence(lines[-1] if lines else "")
    return "refused" if is_sentence and fault in ("", "no file") else "sentence"


def work(place, each, names, number, show):
    """Run all commands; print the counts of each case as JSON."""
    import jaxid as jid

    _ = jid.InputError  # what all commands need
    original = place / "original"
    original.mkdir()
    write_experiment(original)
    CSV(original)
    code, errors = run(("identify", *INSPECT[1:], "-o", "report"), original)
    if code not in (0, 3):
        raise SystemExit(errors)
    for name in names:
        case = CASES[name]
        counts = collections.Counter()
        for k in range(each) if number is None else [number]:
            folder = place / f"{name} {k}".replace(" ", "-").replace(":", "")
            shutil.copytree(original, folder)
            damage(folder / case.target, case.is_text, random.Random(f"{name} {k}"))
            code, errors = run(case.words, folder)
            result = judge(code, errors)
            counts[result] += 1
            if show or result not in ("refused", "result"):
                print(f"{name} {k}: {result} {errors[-600:]}", file=sys.stderr)
            shutil.rmtree(folder)
        print(json.dumps([name, counts]), flush=True)


def row_of(name, counts):
    """Return the row of a case in the table of results."""
    holds = set(counts) <= {"refused", "result"}
    said = ", ".join(f"{count} {result}" for result, count in sorted(counts.items()))
    return Row("commands", name, "mutated_commands.py", "0 faults", said, holds)


def main():
    """Run all cases."""
    parser = timing.parser(__doc__, "two files of each case")
    parser.add_argument("--case", action="append", help="only these cases")
    parser.add_argument("--number", type=int, help="only the file of this number")
    parser.add_argument("--each", type=int, default=10, help="files of each case")
    parser.add_argument("--show", action="store_true", help="print every result")
    parser.add_argument("--place", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    each = 2 if options.quick else options.each
    names = options.case or list(CASES)
    if options.place:
        work(options.place, each, names, options.number, options.show)
        return 0
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "COLUMNS": "100"}
    environment["PYTHONPATH"] = str(timing.REPOSITORY)
    with tempfile.TemporaryDirectory() as place:
        command = [sys.executable, __file__, "--place", place, *sys.argv[1:]]
        lines = subprocess.run(
            command, stdout=subprocess.PIPE, env=environment, check=True
        ).stdout.splitlines()
    rows = [row_of(*json.loads(line)) for line in lines]
    hand_over(rows, options.json)
    return not all(row.holds for row in rows)


if __name__ == "__main__":
    raise SystemExit(main())
