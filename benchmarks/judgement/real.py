"""What `jaxid identify` says of the logs of real robots, clean and with planted slips.

    python benchmarks/judgement/real.py [--quick] [--json FILE] [--robot tx40]
        [--slips] [--slip contact]

Experiments are those of `tests/real_data`, with their settings ("README") and with
default ones. Each robot is identified with one log, and validated with its last 40 %
or with its other logs. With `--slips` the 14 mistakes of `PLANTED` are made in one log,
or in the robot, for its second joint and for one of the wrist. The logs lie beside the
project, in `../shared/data`.

A slip is named if a sentence with ✗ says what it is, and told if any sentence with ✗
or ! says more than the clean log gets.
"""

import argparse
import dataclasses
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import rates
import timing
from timing import DATA, EXPERIMENTS, PENDULUM, PENDULUM_LOGS, Row

LOG_SLIPS = (
    "force sign",
    "angle sign",
    "forces exchanged",
    "angles exchanged",
    "gain 1.4",
    "ratio 1.25",
    "offset 0.2",
    "late 10 ms",
    "late 20 ms",
    "degrees",
    "contact",
)
"""Slips of logs, as `slips.SLIPS` makes them."""
PLANTED = (*LOG_SLIPS, "gravity taken out", "gravity sideways", "twist 20")
OF_ALL_JOINTS = (
    "late 10 ms",
    "late 20 ms",
    "degrees",
    "gravity taken out",
    "gravity sideways",
)
TWIST = 0.35
"""Angle by which a link is turned about its x axis [rad]."""
MAX_RATE = 500.0
"""Rows in a second of a log that is spoilt; more tell nothing [Hz]."""


@dataclasses.dataclass
class Log:
    """Log on the joints' side, as `slips.SLIPS` changes it."""

    time: Any
    angles: Any
    forces: Any
    commands: Any


class Robot(NamedTuple):
    """A real robot and its logs.

    Attributes:
        experiment: Text of its experiment file.
        log: Log of the identification.
        others: Logs of the validation; without them it is the end of the first log.
        joints: Numbers of the joints in which slips are made, from 0.
    """

    experiment: str
    log: Path
    others: tuple[Path, ...] = ()
    joints: tuple[int, ...] = (1, 4)


def robots():
    """Return the robots by name."""
    texts = {}
    for name in ("tx40", "ur10", "kr300"):
        text = (EXPERIMENTS / f"{name}.toml").read_text(encoding="utf-8")
        texts[f"{name}, README"] = text
        settings = r"(?ms)^\[(estimator|filter|rows)\]$.*?(?=^\[|\Z)"
        texts[name] = re.sub(settings, "", text)
    folder = DATA / "double_pendulum"
    pendulum = PENDULUM.format(folder=folder)
    kr300 = [DATA / "kr300" / f"traj_{letter}.csv" for letter in "ABC"]
    every_robot = {
        "tx40": Robot(texts["tx40"], DATA / "tx40" / "motor_position.csv"),
        "ur10": Robot(texts["ur10"], DATA / "ur10" / "exciting_measured.csv"),
        "kr300": Robot(texts["kr300"], kr300[0], tuple(kr300[1:])),
        "kr300 B": Robot(texts["kr300"], kr300[1]),
        "kr300 C": Robot(texts["kr300"], kr300[2]),
    }
    for name in ("tx40", "ur10", "kr300"):
        text = texts[f"{name}, README"]
        every_robot[f"{name}, README"] = every_robot[name]._replace(experiment=text)
    for name in PENDULUM_LOGS:
        log = folder / f"{name}.csv"
        every_robot[f"pendulum {name}"] = Robot(pendulum, log, joints=(1,))
    return every_robot


def experiment_of(text, folder):
    """Return the experiment of a text."""
    import jaxid as jid

    return jid.experiment.parse_experiment(text, folder / "e.toml")


def clean_sentences(robot, folder):
    """Return the findings and held-out errors of a clean log."""
    import jaxid as jid

    experiment = experiment_of(robot.experiment, robot.log.parent)
    held_out = None if robot.others else 0.4
    report = jid.identify_logs(
        experiment.setup, [robot.log], experiment.columns, held_out, robot.others
    )
    errors = [f"{x.name} {100 * x.relative:.3g} %" for x in report.verification]
    findings = [*report.judgement.findings, report.verdict]
    return [(str(x.status.name), str(x.text)) for x in findings], errors


def log_of(robot):
    """Return the experiment of a robot, and its log on the joints' side."""
    import numpy as np

    import jaxid as jid

    experiment = experiment_of(robot.experiment, robot.log.parent)
    log = jid.workflow.read_log(experiment.setup, robot.log, experiment.columns)
    drives = experiment.setup.robot.drives
    angles = np.asarray(log.angles)
    forces = np.asarray(log.forces)
    if log.angles_on_motor_side:
        angles = drives.joint_angles(angles)
    if log.forces_on_motor_side:
        forces = drives.joint_forces(forces)
    stride = max(1, round(1.0 / (MAX_RATE * log.sample_time)))
    rows = slice(None, None, stride)
    time = np.asarray(log.time)[rows]
    return experiment, Log(
        time, angles[rows].copy(), forces[rows].copy(), angles[rows].copy()
    )


def gravity_forces(experiment, log):
    """Return the gravity that a fit to the clean log finds along it."""
    import numpy as np

    import jaxid as jid

    setup = experiment.setup
    recording = jid.Recording.of(
        log.angles, log.forces, sample_time=float(np.median(np.diff(log.time)))
    )
    fit = jid.identify(setup.base, setup.observe(recording), setup.least_squares)
    rest = np.zeros_like(log.angles)
    return fit.predict(jid.Motion(log.angles, rest, rest))


def spoilt_sentences(robot, slip, joint, folder):
    """Return the findings of a log with a slip; of the clean one if `slip` is None."""
    import numpy as np
    import slips

    import jaxid as jid

    experiment, log = log_of(robot)
    setup = experiment.setup
    arm = setup.robot
    if slip == "degrees":
        scales = np.where(np.array(arm.revolute), 180 / np.pi, 1.0)
        log.angles = log.angles * scales
    elif slip in LOG_SLIPS:
        slips.SLIPS[slip].change(log, "", joint)
    elif slip == "gravity taken out":
        log.forces = log.forces - gravity_forces(experiment, log)
    elif slip == "gravity sideways":
        gravity = np.linalg.norm(np.asarray(arm.gravity))
        arm = arm.replace(gravity=np.array([gravity, 0.0, 0.0]))
    elif slip == "twist 20":
        rotation = np.array(arm.rotation)
        cosine, sine = np.cos(TWIST), np.sin(TWIST)
        turn = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
        rotation[joint] = rotation[joint] @ turn
        arm = arm.replace(rotation=rotation)
    columns = {"time": log.time}
    for key, values in (("q", log.angles), ("tau", log.forces)):
        columns |= {f"{key}{j + 1}": x for j, x in enumerate(values.T)}
    np.savez(folder / "log.npz", **columns)
    setup = jid.Setup(
        jid.Model(arm, setup.model.terms),
        robot_file=setup.robot_file,
        reading=dataclasses.replace(setup.reading, forces_file=None, largest_gap=3.0),
    )
    names = jid.Columns(angles="q{}", forces="tau{}", time="time")
    report = jid.identify_logs(setup, [folder / "log.npz"], names, 0.4)
    return [(str(x.status.name), str(x.text)) for x in report.judgement.findings]


def marked(sentences):
    """Return the sentences with ✗ or !."""
    return [text for status, text in sentences if status in ("BAD", "DOUBTFUL")]


def kind_of(text):
    """Return a sentence without names and numbers: where it stops, it differs."""
    return re.split(r"[\d`:;]", text, maxsplit=1)[0]


def outcome(sentences, clean, words):
    """Return how a slip is treated: named, another, told or quiet."""
    usual = {(status, kind_of(text)) for status, text in clean}
    marks = [x for x in sentences if x[0] in ("BAD", "DOUBTFUL")]
    specific = [x for x in marks if (x[0], kind_of(x[1])) not in usual]
    seeming = [text for text in marked(sentences) if "seem" in text]
    mistakes = [text for text in seeming if rates.POSSIBLE not in text]
    if any(word in text for text in mistakes for word in words):
        return "named"
    if mistakes:
        return "another"
    return "told" if specific else "quiet"


def planted(every_robot, options, folder):
    """Print what is said of planted slips, and return how often they are named."""
    import slips

    counts = Counter()
    for name, robot in every_robot.items():
        clean = spoilt_sentences(robot, None, 0, folder)
        for slip in options.slip or PLANTED:
            joints = robot.joints[:1] if slip in OF_ALL_JOINTS else robot.joints
            for joint in joints:
                try:
                    sentences = spoilt_sentences(robot, slip, joint, folder)
                except ValueError as refusal:
                    sentences = [("BAD", str(refusal))]
                result = outcome(sentences, clean, slips.SLIPS[slip].words)
                counts[result] += 1
                head = f"{name} | joint {joint + 1} | {slip} | {result}"
                print(head, *marked(sentences), sep="\n    ", flush=True)
    return counts


def main():
    """Print what is said, and the rates."""
    parser: argparse.ArgumentParser = timing.parser(__doc__, "the double pendulum")
    parser.add_argument("--robot", nargs="*")
    parser.add_argument("--slips", action="store_true", help="plant slips")
    parser.add_argument("--slip", nargs="*", help="these slips only")
    options = parser.parse_args()
    timing.pin_to(1)
    every_robot = robots()
    if options.robot:
        every_robot = {name: every_robot[name] for name in options.robot}
    if options.quick:
        every_robot = {"pendulum 143339": every_robot["pendulum 143339"]}
    folder = Path(tempfile.mkdtemp())
    if options.slips or options.slip:
        counts = planted(every_robot, options, folder)
        total = sum(counts.values())
        said = ", ".join(f"{count} {result}" for result, count in counts.items())
        is_good = counts["named"] >= 0.5 * total and counts["another"] == 0
        is_good &= counts["quiet"] <= 0.25 * total
        row = Row(
            "judgement/real slips",
            "slips in real logs that are named",
            f"{total} slips",
            "half named, 75 % told, none called something else",
            said,
            is_good,
        )
    else:
        mistaken = []
        for name, robot in every_robot.items():
            sentences, errors = clean_sentences(robot, folder)
            lines = [f"{status} {text}" for status, text in sentences]
            print(f"{name}: {', '.join(errors)}", *lines, sep="\n    ", flush=True)
            mistaken += [x for x in marked(sentences) if "seem" in x]
        row = Row(
            "judgement/real logs",
            "clean real logs that are called mistaken",
            f"{len(every_robot)} logs",
            "none",
            str(len(mistaken)),
            not mistaken,
        )
    timing.hand_over([row], options.json)


if __name__ == "__main__":
    main()
