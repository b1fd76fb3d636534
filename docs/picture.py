"""Draw the pictures of README and guides: `python docs/picture.py [NAME …]`.

* picture: the TX90L on its rail along a motion.
* report: the top of the page of a measured UR10, which needs `../shared/data`.
* report_example: the top of the page of the tutorial's example.

Pages are photographed by the program `chromium`.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import numpy as np

import jaxid as jid

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
DATA = ROOT.parent / "shared" / "data"
OMEGA = 0.8
"""Base frequency of the motion, as in the paper [rad/s]."""


def draw_robot() -> None:
    """Draw four poses of the motion."""
    jax.config.update("jax_enable_x64", True)
    robot = jid.robots.tx90l_on_rail()
    time = np.linspace(0.0, 7.85, 400)
    motion = jid.trajectories.random_fourier_series(robot, omega=OMEGA, seed=3).motion(
        time
    )
    figure = jid.plot.poses(
        robot, motion.q, time, poses=4, title="TX90L on rail: a motion"
    )
    figure.save(DOCS / "picture.png")


def run(*words: str) -> None:
    """Run a command of jaxid."""
    subprocess.run([sys.executable, "-m", "jaxid", *words], check=True)


def photograph(page: Path, target: Path, height: int) -> None:
    """Photograph the top of a page."""
    size = f"--window-size=1180,{height}"
    options = ("--headless", "--no-sandbox", "--hide-scrollbars", size)
    waits = ("--virtual-time-budget=15000", f"--screenshot={target}")
    command = ["chromium", *options, *waits, page.as_uri()]
    subprocess.run(command, check=True, capture_output=True)


def draw_report() -> None:
    """Identify the UR10 with 60 % of its log, and photograph the page."""
    with tempfile.TemporaryDirectory() as folder:
        experiment = str(ROOT / "tests" / "real_data" / "ur10.toml")
        log = str(DATA / "ur10" / "exciting_measured.csv")
        report = str(Path(folder) / "ur10")
        run("identify", experiment, log, "--split", "0.6", "-o", report)
        photograph(Path(report) / "report.html", DOCS / "report.png", 800)


def draw_example() -> None:
    """Identify the example, and photograph the page."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        run("example", str(place / "example"))
        experiment, log, other = (
            str(place / "example" / name)
            for name in ("experiment.toml", "identification.csv", "verification.csv")
        )
        report = place / "report"
        run("identify", experiment, log, "--verify", other, "-o", str(report))
        photograph(report / "report.html", DOCS / "report_example.png", 620)


PICTURES = {
    "picture": draw_robot,
    "report": draw_report,
    "report_example": draw_example,
}


def main() -> None:
    """Draw the pictures that are named, or all."""
    for name in sys.argv[1:] or PICTURES:
        PICTURES[name]()


if __name__ == "__main__":
    main()
