"""The commands on measured robots of the README: verdicts, exit codes, errors.

    python benchmarks/measured_robots.py [--quick] [--json FILE]

`--quick` runs the first command alone. Rows are skipped where the logs are absent.
"""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import timing
from timing import DATA, EXPERIMENTS, Row, hand_over

COMMANDS = {
    "tx40_100hz": ("tx40/motor_position.csv",),
    "tx40": ("tx40/motor_position.csv", "--split", "0.6"),
    "ur10": ("ur10/exciting_measured.csv",),
    "ur10_split": ("ur10/exciting_measured.csv", "--split", "0.6"),
    "kr300": (
        "kr300/traj_A.csv",
        "--verify",
        "kr300/traj_B.csv",
        "--verify",
        "kr300/traj_C.csv",
    ),
}
"""Arguments of each command by its output folder, logs below the data folder."""


def percent(share):
    """Return a share in percent, with two digits."""
    return f"{100.0 * share:#.2g}".removesuffix(".") + " %"


def run(name, arguments):
    """Run a command; return its row."""
    arguments = [str(DATA / x) if x.endswith(".csv") else x for x in arguments]
    experiment = EXPERIMENTS / f"{name.removesuffix('_split')}.toml"
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / name
        command = [sys.executable, "-m", "jaxid", "identify", str(experiment)]
        start = time.perf_counter()
        done = subprocess.run(
            [*command, *arguments, "-o", str(output)],
            capture_output=True,
            text=True,
            check=False,
        )
        seconds = time.perf_counter() - start
        result = json.loads((output / "result.json").read_text(encoding="utf-8"))
    errors = result["errors"]
    logs = [*errors["identification"], *errors["verification"]]
    said = ", ".join(percent(log["relative"]) for log in logs)
    verdict = result["verdict"][0]["text"]
    measured = f"{said}; exit code {done.returncode}; {verdict}"
    recipe = f"jaxid identify of the README, {seconds:.0f} s"
    return Row(name, "error on each log; exit code; verdict", recipe, "-", measured)


def main():
    """Print the rows."""
    given = timing.parser(__doc__, "the first command").parse_args()
    commands = dict(list(COMMANDS.items())[:1]) if given.quick else COMMANDS
    rows = [
        run(name, arguments)
        for name, arguments in commands.items()
        if (DATA / arguments[0]).exists()
    ]
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
