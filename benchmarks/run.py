"""Runs all benchmarks and rewrites the table of `benchmarks/README.md`.

    python benchmarks/run.py [--quick] [--only NAME ...]

With `--quick` everything runs small, and nothing is written. `--only peers small` measures only
these, and keeps the other rows of the table.
"""

import argparse
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from timing import HERE, Row, machine

SCRIPTS = ("peers", "fences", "compile", "humanoid", "small", "scaling", "gpu")
README = HERE / "README.md"
BEGIN, END = "<!-- measured: begin -->", "<!-- measured: end -->"
HEAD = "| row | what | asked | measured | holds | recipe |\n|---|---|---|---|---|---|\n"


def measured(script, quick):
    """The rows of one script; a script that fails leaves a row that says so."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.json"
        command = [sys.executable, str(HERE / f"{script}.py"), "--json", str(path)]
        done = subprocess.run([*command, *["--quick"] * quick])
        if done.returncode:
            return None
        return [Row(**row) for row in json.loads(path.read_text())]


def line(row):
    holds = {True: "yes", False: "no", None: ""}[row.holds]
    cells = (row.number, row.what, row.asked, row.measured, holds, row.recipe)
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def kept(text, scripts):
    """The lines of scripts that do not run now, by script."""
    sections = re.findall(r"^### (\w+)\n\n(.*?)(?=^### |\Z)", text, re.M | re.S)
    return {name: body for name, body in sections if name not in scripts}


def generated(facts, found, earlier):
    parts = []
    for script in SCRIPTS:
        if script in found:
            stamp = "; ".join(f"{name}: {value}" for name, value in facts.items())
            rows = "\n".join(map(line, found[script]))
            parts.append(f"### {script}\n\n{stamp}.\n\n{HEAD}{rows}\n\n")
        elif script in earlier:
            parts.append(f"### {script}\n\n{earlier[script]}")
    return "".join(parts)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="small, and write nothing")
    parser.add_argument("--only", nargs="+", choices=SCRIPTS, default=SCRIPTS)
    options = parser.parse_args()
    found, failed = {}, []
    for script in options.only:
        start = time.perf_counter()
        facts = machine()
        print(f"== {script}", flush=True)
        rows = measured(script, options.quick)
        print(f"   {time.perf_counter() - start:.0f} s", flush=True)
        if rows is None:
            failed.append(script)
            continue
        found[script] = rows
        if not options.quick:
            text = README.read_text()
            before, rest = text.split(BEGIN)
            middle, after = rest.split(END)
            table = generated(facts, {script: rows}, kept(middle, (script,)))
            README.write_text(f"{before}{BEGIN}\n\n{table}{END}{after}")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
