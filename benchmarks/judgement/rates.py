"""What `jaxid identify` says of clean and of spoilt logs of ten machines.

    python benchmarks/judgement/rates.py [--quick] [--json FILE] [--machine wall]
        [--slip clean] [--seed 1] [--lines FILE]

MuJoCo records the machines (`machines.py`, `recordings.py`); a user writes the
experiment with `jaxid init`, names columns and commands, and identifies with the first
60 % of the log. Clean: each kind of log of each machine. Spoilt: each slip of
`slips.py` on one kind of log of each machine. The limits of the search were set on the
machines in `SETTING_KINDS`.

A slip is named if a sentence with ✗ or ! says what it is, and possible if it adds
"possible, but not sure"; it is told if any other sentence with ✗ or ! says more than
what clean logs get.
"""

import argparse
import json
import re
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import timing
from timing import Row

SPOILT_KINDS = "plain", "Stribeck", "heavy friction", "pauses", "load friction"
"""Kinds of logs that are spoilt, one machine after the other."""
USUAL = (
    "NOT DETERMINED",
    "cannot be distinguished",
    "physically consistent",
)
"""Parts of sentences that tell how good a model is and what it determines."""
POSSIBLE = "possible, but not sure"
"""What a mistake is called that explains only a part of what the model misses."""


def recorded(name, kind, seed, slip):
    """Return the log and the file of a machine, spoilt or clean."""
    import machines
    import recordings
    import slips

    machine = machines.machine(name)
    log = recordings.record(machine, recordings.KINDS[kind], seed)
    log.model = machine.model
    if slip == "clean":
        return log, machine.file
    made = slips.SLIPS[slip]
    return made.change(log, machine.file, slips.affected_joint(made, machine.model.nv))


def judged(log, file, folder):
    """Return the sentences of a report, each with its status."""
    import numpy as np

    import jaxid as jid

    (folder / "machine.xml").write_text(file)
    text = jid.experiment.write_template(folder / "machine.xml", folder=folder)
    text = re.sub(r"(?m)^# commands = .*$", 'commands = "cmd{}"', text)
    (folder / "e.toml").write_text(text)
    columns = {"time": log.time}
    for key, values in (("q", log.angles), ("tau", log.forces), ("cmd", log.commands)):
        columns |= {f"{key}{j + 1}": x for j, x in enumerate(values.T)}
    np.savez(folder / "log.npz", **columns)
    experiment = jid.experiment.load_experiment(folder / "e.toml")
    report = jid.identify_logs(
        experiment.setup, [folder / "log.npz"], experiment.columns, 0.4
    )
    return [(str(x.status.name), str(x.text)) for x in report.judgement.findings]


def outcome(sentences, words):
    """Return how a slip is treated: named, another, possible, told or quiet."""
    marked = specific(sentences)
    right_texts = [x for x in marked if any(word in x for word in words)]
    if any(POSSIBLE not in text for text in right_texts):
        return "named"
    if any(POSSIBLE not in text for text in named_mistakes(sentences)):
        return "another"
    if right_texts:
        return "possible"
    return "told" if marked else "quiet"


def specific(sentences):
    """Return the sentences with ✗ or ! that say more than how good a model is."""
    return [
        text
        for status, text in sentences
        if status in ("BAD", "DOUBTFUL") and not any(part in text for part in USUAL)
    ]


def named_mistakes(sentences):
    """Return the sentences with ✗ or ! that name a mistake."""
    return [text for text in specific(sentences) if "seem" in text]


def tasks(options):
    """Yield machine, kind of log and slip of each log."""
    import machines
    import recordings
    import slips

    names = options.machine or list(machines.MACHINES)
    for number, name in enumerate(names):
        if options.slip in (None, "clean"):
            for kind in recordings.KINDS:
                yield name, kind, "clean"
        kind = SPOILT_KINDS[number % len(SPOILT_KINDS)]
        for slip in slips.SLIPS:
            if options.slip in (None, slip, "all"):
                yield name, kind, slip


def main():
    """Print what is said, and the rates."""
    parser: argparse.ArgumentParser = timing.parser(__doc__, "two logs of one machine")
    parser.add_argument("--machine", nargs="*")
    parser.add_argument("--slip", help="one slip, `clean`, or `all` slips")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--lines", type=Path, help="file for a JSON line of each log")
    options = parser.parse_args()
    timing.pin_to(1)
    import slips

    folder = Path(tempfile.mkdtemp())
    every_task = list(tasks(options))
    if options.quick:
        every_task = [("hobby", "plain", "clean"), ("hobby", "plain", "force sign")]
    clean = Counter()
    spoilt = Counter()
    for name, kind, slip in every_task:
        log, file = recorded(name, kind, options.seed, slip)
        try:
            sentences = judged(log, file, folder)
        except ValueError as refusal:
            sentences = [("BAD", str(refusal))]
        if slip == "clean":
            statuses = {status for status, _ in sentences}
            result = "✗" if "BAD" in statuses else "!" if "DOUBTFUL" in statuses else ""
            mistakes = named_mistakes(sentences)
            clean["logs"] += 1
            clean["alarms"] += bool(mistakes)
            clean["any ! or ✗"] += bool(result)
        else:
            result = outcome(sentences, slips.SLIPS[slip].words)
            spoilt[result] += 1
        marked = [x for status, x in sentences if status in ("BAD", "DOUBTFUL")]
        print(f"{name} | {kind} | {slip} | {result}", *marked, sep="\n    ")
        if options.lines:
            line = {"machine": name, "kind": kind, "slip": slip, "result": result}
            with options.lines.open("a") as file_of_lines:
                file_of_lines.write(json.dumps(line | {"marked": marked}) + "\n")
    rows = [
        Row(
            "judgement/alarms",
            "clean logs that are called mistaken",
            f"{clean['logs']} logs",
            "at most 1 %",
            str(clean["alarms"]),
            clean["alarms"] <= 0.01 * clean["logs"],
        ),
        Row(
            "judgement/slips",
            "slips that are named",
            f"{sum(spoilt.values())} slips",
            "at least 75 %",
            ", ".join(f"{count} {result}" for result, count in spoilt.items()),
            spoilt["named"] >= 0.75 * sum(spoilt.values()),
        ),
    ]
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
