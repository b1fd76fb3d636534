"""Whether motions that leave parameters open are called so, and no others.

    python benchmarks/judgement/undetermined.py [--quick] [--json FILE]
        [--machine wall]

Ten machines (`machines.py`) are recorded by MuJoCo while a joint rests, two joints move
in step, all move too slowly or too little, for one second, or not at all; and with each
kind of clean log. A log leaves something open if plain least squares, fitted to it,
predict another motion of the machine with errors above 10 % (root of the mean square
over joints of error over force). Clean kinds that do so have noise in their columns,
not a poor motion: they are counted apart. The limit was set on the machines in
`SETTING_KINDS`.
"""

import argparse
import sys
import tempfile
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import timing
from timing import Row

MAX_ERROR = 0.1
"""Error on another motion, up to which a log determines all that matters."""
SEED = 1
OTHER_SEED = 7
"""Seeds of the log and of the other motion."""


def poor_kinds():
    """Return the kinds of recordings that leave something open."""
    from recordings import Kind

    return {
        "one joint still": Kind(motion="one still"),
        "two joints in step": Kind(motion="in step"),
        "too slow": Kind(pace=0.05, amplitude=0.5),
        "tiny amplitude": Kind(amplitude=0.01),
        "short": Kind(seconds=1.0),
        "one pose": Kind(motion="pose"),
    }


def same_machine(kind):
    """Return a rich motion of a machine with the friction of a kind of recording."""
    from recordings import Kind

    return Kind(
        stribeck=kind.stribeck,
        friction=kind.friction,
        load_friction=kind.load_friction,
        presliding=kind.presliding,
    )


def observed(experiment, log, folder):
    """Return the observations of a log, by the settings of an experiment."""
    import numpy as np

    import jaxid as jid

    columns = {"time": log.time}
    for key, values in (("q", log.angles), ("tau", log.forces)):
        columns |= {f"{key}{j + 1}": x for j, x in enumerate(values.T)}
    np.savez(folder / "log.npz", **columns)
    setup = experiment.setup
    recording = jid.workflow.read_log(setup, folder / "log.npz", experiment.columns)
    return setup.observe(recording)


def joint_error(fit, observations):
    """Return the error of a fit on other observations, as the joints have it alike."""
    import numpy as np

    import jaxid as jid

    (errors,) = jid.validate(fit, observations).errors
    ratios = np.asarray(errors.rms) / np.asarray(errors.force_rms)
    return float(np.sqrt(np.mean(ratios**2)))


def main():
    """Print each log with its error on another motion, and the rates."""
    parser: argparse.ArgumentParser = timing.parser(__doc__, "one machine")
    parser.add_argument("--machine", nargs="*")
    options = parser.parse_args()
    timing.pin_to(1)
    import machines
    import recordings

    import jaxid as jid

    names = options.machine or list(machines.MACHINES)
    names = ["hobby"] if options.quick else names
    kinds = poor_kinds() | recordings.KINDS
    counts = Counter()
    for name in names:
        machine = machines.machine(name)
        folder = Path(tempfile.mkdtemp())
        (folder / "machine.xml").write_text(machine.file)
        text = jid.experiment.write_template(folder / "machine.xml", folder=folder)
        (folder / "e.toml").write_text(text)
        experiment = jid.experiment.load_experiment(folder / "e.toml")
        base = experiment.setup.base
        others = {}
        for kind, settings in kinds.items():
            log = recordings.record(machine, settings, SEED)
            observations = observed(experiment, log, folder)
            fit = jid.identify(base, observations, experiment.setup.least_squares)
            other_kind = same_machine(settings)
            if other_kind not in others:
                other_log = recordings.record(machine, other_kind, OTHER_SEED)
                others[other_kind] = observed(experiment, other_log, folder)
            error = joint_error(fit, others[other_kind])
            truth = "open" if error > MAX_ERROR else "determined"
            if truth == "open" and kind in recordings.KINDS:
                # The same motion determines all with a finer encoder, or less noise.
                truth = "biased"
            counts[truth, bool(fit.undetermined)] += 1
            print(
                f"{name} | {kind} | error {100 * error:.3g} % | {truth} | "
                f"{len(fit.undetermined)} combinations | {dict(fit.facts)['estimates']}"
            )
    open_logs = counts["open", True] + counts["open", False]
    good_logs = counts["determined", True] + counts["determined", False]
    rows = [
        Row(
            "judgement/undetermined",
            "logs that leave something open are called so",
            f"{open_logs} logs",
            "at least 98 %",
            str(counts["open", True]),
            counts["open", True] >= 0.98 * open_logs,
        ),
        Row(
            "judgement/determined",
            "logs that determine all are called undetermined",
            f"{good_logs} logs",
            "at most 1 %",
            str(counts["determined", True]),
            counts["determined", True] <= 0.01 * good_logs,
        ),
    ]
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
