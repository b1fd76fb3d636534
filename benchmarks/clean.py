"""Alarms on clean logs of many kinds of robots, and slips that are named.

    python benchmarks/clean.py [--quick] [--json FILE] [--robot six] [--log slow] [--slip gain]

Robots and logs: `closed_loop.py` (simulated by Pinocchio), each kind of log with two seeds. What
`jaxid identify` and `jaxid inspect` say of a clean log is an alarm if it is a finding, a likely
mistake, a doubt about a sign or about gravity, or advice on a delay that the log does not have.
Slips: those of `spoilt.py` in ordinary logs, in the first, the middle and the last joint. A slip
cannot be told if the model with it explains the forces as well as in the log without it.
"""

import contextlib
import re
import tempfile
import time
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
            settings |= {"friction": first["friction"], "seconds": 5.0, "seed": seed + 100}
        cases += [spoilt.recorded(file, folder / f"{robot}-second-{seed}.npz", **settings)]
        cases[0].rows(slice(None, None, 10))
    if robot == "ceiling":
        cases[0].key("gravity", "[0.0, 0.0, 9.81]")
    return cases


def said(cases, folder):
    """Return the marked remarks of `jaxid identify`, and the findings of `jaxid inspect`."""
    from jaxid.experiment import identify_logs  # private: what the command line runs

    remarks, r, missed = spoilt.judged(cases, folder)
    verdict = [x for x in remarks[1:] if x.status.name in ("DOUBTFUL", "BAD")]
    sentences, found = [str(x.text) for x in verdict], []
    for path in sorted(folder.glob("log*.npz"))[: len(cases)]:
        _, observations, diagnosis = identify_logs.load_log(r.experiment, path, lambda *_: None)
        import jaxid as jid

        fit = jid.identify(r.experiment.base, observations, r.experiment.estimation.plain)
        found += diagnosis.with_fit(fit).findings
    return remarks[0].status.name, sentences, found, list(r.mistakes), missed, r


def is_alarm(text, log):
    """Return whether a sentence would send a user to look for a mistake that is not there."""
    if "effect is not in the model" in text or "effect of" in text:
        return "sign" in text
    late = re.search(r"stand between (\S+) and (\S+) ms later", text)
    if late and log in LATE:
        return not float(late[1]) <= LATE[log] <= float(late[2])
    words = "seem", "check", "wrong", "is it the right", "is `gravity` right", "later in the log"
    words += "at its limit", "held the last", "remove", "departs", "does not fit", "negative"
    return any(word in text for word in words)


def main():
    """Print what is said of clean logs and of slips."""
    parser = timing.parser(__doc__, "one robot, two logs, one slip")
    parser.add_argument("--robot", nargs="*")
    parser.add_argument("--log", nargs="*")
    parser.add_argument("--slip", nargs="*")
    parser.add_argument("--folder", type=Path, help="where simulated logs are kept")
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(exist_ok=True)
    files = closed_loop.robots(folder)
    files["ceiling"] = files["six"]
    robots = given.robot or (["pendulum"] if given.quick else list(files))
    logs = given.log if given.log is not None else (["slow", "two rates"] if given.quick else LOGS)
    slips = given.slip if given.slip is not None else (["sign"] if given.quick else SLIPS)
    seeds, alarms, count = SEEDS[: 1 if given.quick else 2], [], 0
    named = {slip: [0, 0, 0] for slip in slips}
    work = Path(tempfile.mkdtemp())
    began = time.perf_counter()
    for robot in robots:
        file = files[robot]
        names = re.findall(r'<joint name="([^"]*)" type="(?:rev|pris|cont)', file.read_text())
        clean = {}
        for log in logs:
            for seed in seeds:
                cases = recorded(robot, file, log, seed, folder)
                status, verdict, found, mistakes, missed, _ = said(cases, work)
                clean[log, seed] = missed
                bad = [x for x in (*verdict, *found) if is_alarm(x, log)]
                count += 1
                alarms += [(robot, log, seed, x) for x in dict.fromkeys(bad)]
                if given.show:
                    print(f"{robot}: {log}, {seed}: {status} {missed:.3f}")
                    for x in dict.fromkeys((*verdict, *found)):
                        print("    ", "ALARM" if x in bad else "", x, flush=True)
        for slip in slips:
            change, joints, amounts = SLIPS[slip]
            n = len(names)
            for j in dict.fromkeys({"f": 0, "m": n // 2, "l": n - 1}[x] for x in joints):
                for seed in seeds:
                    case = recorded(robot, file, "ordinary", seed, folder)[0]
                    with contextlib.suppress(LookupError):
                        change(case, j, amounts[0])
                        try:
                            status, verdict, found, mistakes, missed, _ = said([case], work)
                        except ValueError as refusal:
                            status, verdict, found, mistakes, missed = (
                                "refused", [str(refusal)], [], [], np.nan
                            )
                        print(f"{robot}: {slip}, joint {names[j]}, {seed}: {status} {missed:.3f}")
                        for x in dict.fromkeys((*verdict, *found)):
                            print("    ", x, flush=True)
    print(f"{count} logs, {time.perf_counter() - began:.0f} s")
    for alarm in alarms:
        print(*alarm, sep=" | ")


if __name__ == "__main__":
    main()
