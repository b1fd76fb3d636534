"""Alarms on clean logs of many kinds of robots, and slips that are named.

    python benchmarks/clean.py [--quick] [--json FILE] [--robot six] [--log slow]
        [--slip gain]

Robots and logs: `closed_loop.py` (simulated by Pinocchio), each kind of log with two
seeds. What `jaxid identify` and `jaxid inspect` say of a clean log is an alarm if it is
a finding, a likely mistake, a doubt about a sign or about gravity, or advice on a delay
that the log does not have. Slips: those of `spoilt.py` in ordinary logs, in the first,
the middle and the last joint. A slip is named if a finding, or a note on a delay, says
what it is, alone or beside others of the same effect.
"""

import itertools
import re
import tempfile
from pathlib import Path

import closed_loop
import numpy as np
import spoilt
import timing
from scipy import signal
from timing import Row, hand_over

SEEDS = (11, 12)
SLIPS = {
    "delay": (spoilt.delay_all, "f", (0.02,)),
    "degrees": (spoilt.degrees, "f", (1,)),
    "sign": (spoilt.sign_force, "fml", (1,)),
    "mirrored": (spoilt.mirrored, "fml", (1,)),
    "exchange": (spoilt.swap("q", "qd", "tau"), "fml", (1,)),
    "offset": (spoilt.offset, "fml", (0.3,)),
    "gain": (spoilt.gain, "fml", (1.3,)),
}


def filtered(c):
    """Low-pass the forces without a lag, as a logger may."""
    c.tau = spoilt.signal_smooth(c.tau)


def drive_filter(c):
    """Low-pass the forces as drives do: they are 1.6 ms late."""
    first, drive = c.tau[0].copy(), signal.butter(1, 100.0, fs=1 / spoilt.DT)
    c.tau = signal.lfilter(*drive, c.tau - first, axis=0) + first


def interpolated(c):
    """Interpolate forces that were logged at 100 Hz."""
    c.tau = np.stack([np.interp(c.t, c.t[::10], x[::10]) for x in c.tau.T], axis=1)


def held(c):
    """Hold forces that were logged at 100 Hz: they are 4.5 ms late."""
    c.tau = np.repeat(c.tau[::10], 10, axis=0)[: len(c.t)]


LOGS = {
    "ordinary": ({}, None),
    "slow": ({"pace": 0.2, "seconds": 20.0}, None),
    "short": ({"seconds": 3.0}, None),
    "little excitation": ({"amplitude": 0.05}, None),
    "heavy friction": ({"coulomb": 0.6, "viscous": 0.5}, None),
    "Stribeck": ({"coulomb": 0.15, "stribeck": 0.1}, None),
    "14 bits": ({"noise": 0.0, "bits": 14}, None),
    "filtered": ({}, filtered),
    "drive filter": ({}, drive_filter),
    "interpolated": ({}, interpolated),
    "held": ({}, held),
    "two rates": ({}, None),
}
WAYS = "named", "missed"
LATE = {"drive filter": 1.6, "held": 4.5}
"""Delays of forces that logs have by their kind [ms]."""


def recorded(robot, file, log, seed, folder):
    """Return the clean logs of a robot."""
    settings, change = LOGS[log]
    settings = {**settings, "seed": seed}
    if robot == "ceiling":
        settings["gravity"] = (0.0, 0.0, 9.81)
    name = log if LOGS[log][0] else "ordinary"
    cache = folder / f"{robot}-{name}-{seed}.npz"
    cases = [spoilt.recorded(file, cache, **settings)]
    if change is not None:
        change(cases[0])
    if log == "two rates":
        with np.load(cache) as first:
            settings |= {
                "friction": first["friction"],
                "seconds": 5.0,
                "seed": seed + 100,
            }
        cases += [
            spoilt.recorded(file, folder / f"{robot}-second-{seed}.npz", **settings)
        ]
        cases[0].rows(slice(None, None, 10))
    if robot == "ceiling":
        cases[0].key("gravity", "[0.0, 0.0, 9.81]")
    return cases


def said(cases, folder):
    """Return the verdict, marked remarks, findings of `jaxid inspect`, and notes."""
    import jaxid as jid

    remarks, report, _ = spoilt.judged(cases, folder)
    marked = [str(x.text) for x in remarks[1:] if x.status.name in ("DOUBTFUL", "BAD")]
    notes = list(report.notes)
    experiment = jid.experiment.load_experiment(folder / "e.toml")
    paths = sorted(folder.glob("log*.npz"))[: len(cases)]
    inspection = jid.workflow.inspect_logs(experiment.setup, paths, experiment.columns)
    for log in inspection.logs:
        marked += log.diagnosis.findings
        notes += log.diagnosis.notes
    return remarks[0].status.name, list(dict.fromkeys(marked)), notes


def is_alarm(text, log):
    """Return whether a sentence reports a mistake that is not there."""
    if "effect is not in the model" in text or "effect of" in text:
        return "sign" in text
    if log == "Stribeck" and "friction seems to have another shape" in text:
        return False  # it has
    late = re.search(r"force_delay = ([\d.]+)", text)
    if late and log in LATE:
        # To half a sample of the log.
        return abs(1e3 * float(late[1]) - LATE[log]) > 0.5e3 * spoilt.DT
    words = (
        "seem",
        "check",
        "wrong",
        "is it the right",
        "is `gravity` right",
        "later in the log",
    )
    words += (
        "at its limit",
        "held the last",
        "remove",
        "departs",
        "does not fit",
        "negative",
    )
    return any(word in text for word in words)


def slip(robot, file, name, j, seed, folder, work):
    """Return whether a slip is named or missed, and what is said."""
    change, _, (amount,) = SLIPS[name]
    case = recorded(robot, file, "ordinary", seed, folder)[0]
    names = re.findall(r'<joint name="([^"]*)" type="(?:rev|pris|cont)', case.urdf)
    change(case, j, amount)
    cures = [x.format(*names) for x in case.cure]
    try:
        _, marked, notes = said([case], work)
    except ValueError as refusal:
        marked, notes = [str(refusal)], []
    if any(cure in x for cure in cures for x in (*marked, *notes)):
        return "named", marked
    return "missed", marked


def main():
    """Print what is said of clean logs and of slips."""
    parser = timing.parser(__doc__, "one robot, two logs, one slip")
    parser.add_argument("--robot", nargs="*")
    parser.add_argument("--log", nargs="*")
    parser.add_argument("--slip", nargs="*")
    parser.add_argument("--seeds", type=int, default=len(SEEDS))
    parser.add_argument("--folder", type=Path, help="where simulated logs are kept")
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    work = Path(tempfile.mkdtemp())
    folder = given.folder or work
    files = closed_loop.robots(folder)
    files["ceiling"] = files["six"]
    if given.quick:
        given.robot, given.log, given.slip, given.seeds = (
            ["pendulum"],
            ["slow"],
            ["sign"],
            1,
        )
    robots, seeds = given.robot or list(files), SEEDS[: given.seeds]
    logs = list(LOGS) if given.log is None else given.log
    slips = list(SLIPS) if given.slip is None else given.slip
    alarmed, alarms, counts = (
        set(),
        [],
        {name: dict.fromkeys(WAYS, 0) for name in slips},
    )
    for robot, log, seed in itertools.product(robots, logs, seeds):
        status, marked, _ = said(recorded(robot, files[robot], log, seed, folder), work)
        bad = [x for x in marked if is_alarm(x, log)]
        alarms += [f"{robot} | {log} | {x}" for x in bad]
        alarmed |= {(robot, log, seed)} if bad else set()
        if given.show:
            print(
                f"{robot}, {log}, {seed}: {status}", *marked, sep="\n    ", flush=True
            )
    for robot, name, seed in itertools.product(robots, slips, seeds):
        n = len(re.findall(r'type="(?:rev|pris|cont)', files[robot].read_text()))
        for j in dict.fromkeys(
            {"f": 0, "m": n // 2, "l": n - 1}[x] for x in SLIPS[name][1]
        ):
            way, marked = slip(robot, files[robot], name, j, seed, folder, work)
            counts[name][way] += 1
            if given.show or way == "missed":
                print(
                    f"{robot}, {name}, joint {j + 1}: {way}",
                    *marked,
                    sep="\n    ",
                    flush=True,
                )
    print("alarms:", *alarms, sep="\n")
    count = len(robots) * len(logs) * len(seeds)
    share = len(alarmed) / max(count, 1)
    said_of = f"{len(alarmed)} of {count}"
    rows = [
        Row(
            "clean/alarms",
            "alarms",
            f"{count} logs",
            "at most 3 %",
            said_of,
            share <= 0.03,
        )
    ]
    for name, ways in counts.items():
        text = ", ".join(f"{number} {way}" for way, number in ways.items())
        shown = ways["named"] + ways["missed"]
        good = ways["named"] >= 0.9 * shown
        rows.append(
            Row(
                f"clean/{name}", name, f"{sum(ways.values())} slips", "90 %", text, good
            )
        )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
