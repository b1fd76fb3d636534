"""Delay of forces: its interval, the sentence, and coverage of viscous friction.

    python benchmarks/delay.py [--quick] [--json FILE] [--machine wall ...]
        [--kind plain ...] [--seed 1 ...] [--search]

Logs: MuJoCo in closed loop (`judgement/recordings.py`), whose forces then stand 0, 2, 5
and 10 ms later. A user writes the experiment with `jaxid init`; the first 60 % of the
log are fitted with the defaults, the delay is that of the whole log, as in `jaxid
identify`. Limits were set on the machines in `SETTING_KINDS`.

Held: 95 % intervals of the delay. Named: `Delay.is_certain`; with `--search`, sentences
of the search for mistakes with `force_delay` instead. Widening: the median, over the
parameters of a log, of the ratio of intervals with and without the delay in them.
Covered: 95 % intervals of viscous friction, without and with the delay, that hold
MuJoCo's damping. It is the truth only where dry friction has the model's law: these
are other logs of the same motions, whose friction has the transition of the model.
"""

import argparse
import dataclasses
import re
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent / "judgement"))

import numpy as np
import timing
from timing import Row

DELAYS = 0.0, 0.002, 0.005, 0.01
TRANSITION = 0.02
"""Speed of the transition of dry friction, over the largest, where the model has it."""
COVERED_KINDS = "plain", "long", "noisy", "disturbed", "chirp", "saturated", "100 Hz"
"""Kinds of logs of which viscous friction is compared with the truth."""


def setup_of(machine, folder):
    """Return the setup that a user of a machine's file gets by default."""
    import jaxid as jid

    (folder / "machine.xml").write_text(machine.file)
    text = jid.experiment.write_template(folder / "machine.xml", folder=folder)
    (folder / "e.toml").write_text(text)
    return jid.experiment.load_experiment(folder / "e.toml").setup


def late(log, seconds):
    """Return a recording whose forces stand later."""
    import jaxid as jid

    forces = log.forces
    if seconds:
        columns = [np.interp(log.time - seconds, log.time, x) for x in forces.T]
        forces = np.stack(columns, axis=1)
    return jid.Recording.of(log.angles, forces, time=log.time)


def with_transition(setup, machine):
    """Return the setup with the transition of dry friction in the recording."""
    import jaxid as jid

    transition = jid.terms.Tanh(tuple(TRANSITION * machine.max_speeds))
    terms = [
        jid.CoulombFriction(transition) if isinstance(x, jid.CoulombFriction) else x
        for x in setup.model.terms
    ]
    model = jid.Model(setup.robot, tuple(terms))
    return dataclasses.replace(setup, unknowns=model)


def fits(setup, recording, delay):
    """Return the fit of the first part of a log, without and with its delay."""
    import jaxid as jid

    training_log, _ = setup.observe(recording).split(0.6)
    fit = jid.identify(setup.base, training_log, setup.estimator)
    return fit, jid.with_unknown_delay(fit, training_log, delay)


def findings(setup, recording, seconds, has_search):
    """Return what is found in a log."""
    import jaxid as jid

    delay = jid.estimate_delay(setup.model, recording)
    fit, wider_fit = fits(setup, recording, delay)
    is_named = delay.is_certain
    if has_search:
        diagnosis = jid.diagnose(recording, setup.robot, fit)
        is_named = any("`force_delay" in text for text in diagnosis.findings)
    ratios = wider_fit.uncertainty.half_widths() / fit.uncertainty.half_widths()
    low, high = delay.interval()
    return {
        "held": [low <= seconds <= high],
        "named": [is_named],
        "widening": [float(np.nanmedian(ratios))],
    }


def coverage(setup, recording, damping):
    """Return whether intervals of viscous friction hold, without and with delay."""
    import jaxid as jid

    delay = jid.estimate_delay(setup.model, recording)
    both = fits(setup, recording, delay)
    is_viscous = [bool(re.match(r"fv\d", name)) for name in both[0].base.names]
    errors = np.abs(both[0].parameters[is_viscous] - damping)
    holds = [errors <= x.uncertainty.half_widths()[is_viscous] for x in both]
    return {"before": holds[0].tolist(), "after": holds[1].tolist()}


def results(name, kind, seed, setup, has_search):
    """Yield each delay with what is found in the logs of a motion."""
    import machines
    import recordings

    machine = machines.machine(name)
    setting = recordings.KINDS[kind]
    log = recordings.record(machines.machine(name), setting, seed)
    for seconds in DELAYS:
        yield seconds, findings(setup, late(log, seconds), seconds, has_search)
    if kind in COVERED_KINDS:
        smooth_setting = setting._replace(presliding=TRANSITION)
        smooth_log = recordings.record(machines.machine(name), smooth_setting, seed)
        smooth_setup = with_transition(setup, machine)
        damping = setting.friction * machine.viscous
        for seconds in DELAYS:
            recording = late(smooth_log, seconds)
            yield seconds, coverage(smooth_setup, recording, damping)


def main():
    """Print the tables."""
    import machines
    import recordings

    parser: argparse.ArgumentParser = timing.parser(__doc__, "one log of one machine")
    parser.add_argument("--machine", nargs="*", default=list(machines.MACHINES))
    parser.add_argument("--kind", nargs="*", default=list(recordings.KINDS))
    parser.add_argument("--seed", nargs="*", type=int, default=[1])
    parser.add_argument("--search", action="store_true", help="search for mistakes")
    options = parser.parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    if options.quick:
        options.machine = ["hobby"]
        options.kind = ["plain"]
    folder = Path(tempfile.mkdtemp())
    totals = defaultdict(lambda: defaultdict(list))
    for name in options.machine:
        machine = machines.machine(name)
        setup = setup_of(machine, folder)
        is_setting = name in machines.SETTING_KINDS
        for kind in options.kind:
            for seed in options.seed:
                for seconds, result in results(name, kind, seed, setup, options.search):
                    for key, values in result.items():
                        totals[is_setting, seconds][key] += values
                        totals[kind, seconds][key] += values
    rows = []
    print("| logs | delay | held | named | fv before | fv after | widening |")
    print("|---|---|---|---|---|---|---|")
    words = {True: "setting machines", False: "other machines"}
    for (group, seconds), result in totals.items():
        shares = [
            f"{100 * np.mean(result[key]):.1f} %" if result[key] else "-"
            for key in ("held", "named", "before", "after")
        ]
        widening = f"{np.median(result['widening']):.3f}"
        case = f"{words.get(group, group)} ({len(result['held'])})"
        line = " | ".join((case, f"{1e3 * seconds:g} ms", *shares, widening))
        print(f"| {line} |", flush=True)
        if group is False:
            named = 100 * np.mean(result["named"])
            rows.append(
                Row(
                    f"delay/{1e3 * seconds:g}",
                    f"forces late by {1e3 * seconds:g} ms: named",
                    f"{len(result['named'])} logs",
                    {0.0: "at most 1 %", 0.01: "at least 90 %"}.get(seconds, ""),
                    f"{named:.1f} %, viscous friction covered {shares[3]}",
                    {0.0: named <= 1, 0.01: named >= 90}.get(seconds),
                )
            )
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
