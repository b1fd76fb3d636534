"""Errors on unseen logs of the models that `jaxid choose` picks, and its promises.

Simulated: the ten machines of `judgement/machines.py` with friction of five kinds, half
of the fifty pairs. Forces of MuJoCo's inverse dynamics, friction by NumPy: viscous and
dry, and Stribeck's fall, friction by load, presliding (Dahl), the root of speed, or
nothing more. Encoders of 17 bits, noise of 0.3 % of the largest forces, 12 s at 500 Hz.
Two other motions are unseen. Measured (`../shared/data`): the first 60 % of the logs of
TX40 and UR10, log A of the KR300, four logs of the double pendulum; the rest is unseen.

"Best": least error on the unseen logs of the file as it is, the chosen model, that with
the machine's own effect alone, and the three next to the chosen one. "Comes": what
`identify` prints on the unseen logs, over the promise.

    export OPENBLAS_NUM_THREADS=1                 # NumPy's threads share one core
    python benchmarks/held_out.py                 # everything, 20 minutes
    python benchmarks/held_out.py ur10 crane      # only these
    python benchmarks/held_out.py --quick         # five machines
"""

import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import timing
from timing import (
    DATA,
    EXPERIMENTS,
    PENDULUM,
    PENDULUM_LOGS,
    Row,
    hand_over,
)

EFFECTS = {
    "nothing": None,
    "Stribeck": "Stribeck",
    "load": "friction by load",
    "presliding": "presliding",
    "root": "root of speed",
}
LOG = """\
[recording]
time = "t"
angles = "q{}"
forces = "tau{}"
"""
MEASURED = {
    "tx40": ["tx40/motor_position.csv"],
    "ur10": ["ur10/exciting_measured.csv"],
    "kr300": [f"kr300/traj_{name}.csv" for name in "ABC"],
}


class Result(NamedTuple):
    """Figures of one machine."""

    over_best: float
    over_default: float
    over_promise: float
    seconds: float
    words: str


def friction(machine, effect, q, v, force, rng):
    """Return the friction of a machine along a motion."""
    import mujoco

    tops = machine.max_speeds
    direction = np.tanh(v / (0.005 * tops))
    level = machine.coulomb * rng.uniform(0.8, 1.2, len(tops))
    if effect == "Stribeck":
        level = level * (1 + 0.7 * np.exp(-((v / (0.06 * tops)) ** 2)))
    if effect == "load":
        data = mujoco.MjData(machine.model)
        weights = []
        for row in q:
            data.qpos[:] = row
            mujoco.mj_inverse(machine.model, data)
            weights.append(data.qfrc_inverse.copy())
        level = level + rng.uniform(0.08, 0.15, len(tops)) * np.abs(weights)
    if effect == "presliding":
        length = rng.uniform(0.002, 0.01, len(tops)) * machine.model.jnt_range[:, 1]
        state = direction[0]
        for k, step in enumerate(np.diff(q, axis=0), 1):
            side = np.sign(step)
            state = side + (state - side) * np.exp(-np.abs(step) / length)
            direction[k] = state
    extra = 0.0
    if effect == "root":
        extra = 1.5 * machine.coulomb * np.sqrt(np.abs(v) / tops) * direction
    return machine.viscous * v + level * direction + extra


def write_log(file, machine, effect, seed):
    """Write a log of a machine."""
    import mujoco
    from judgement.recordings import KINDS, STEPS, reference

    time, *motion = (x[::STEPS] for x in reference(machine, KINDS["plain"], seed))
    data = mujoco.MjData(machine.model)
    machine.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    forces = []
    for q, v, a in zip(*motion, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(machine.model, data)
        forces.append(data.qfrc_inverse.copy())
    q, v, _ = motion
    # The friction of a machine is the same in all logs.
    rng = np.random.default_rng(7)
    forces = np.array(forces)
    forces = forces + friction(machine, effect, q, v, forces, rng)
    noise = np.random.default_rng(seed + 100).normal(size=forces.shape)
    forces += 0.003 * machine.max_forces * noise
    turns = np.where(machine.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE, 6.2832, 1)
    grid = turns / 2**17
    names = [f"{x}{j + 1}" for x in ("q", "tau") for j in range(q.shape[1])]
    table = np.column_stack([time, np.round(q / grid) * grid, forces])
    header = ",".join(["t", *names])
    np.savetxt(file, table, "%.9g", ",", header=header, comments="")


def simulated(name, effect, folder):
    """Return the figures of a simulated machine."""
    from judgement.machines import machine

    import jaxid as jid

    truth = machine(name)
    (folder / "machine.xml").write_text(truth.file)
    text = f'[robot]\nurdf = "machine.xml"\n{LOG}'
    experiment = jid.experiment.parse_experiment(text, folder / "e.toml")
    logs = [folder / f"log{seed}.csv" for seed in range(3)]
    for seed, log in enumerate(logs):
        write_log(log, truth, effect, seed)
    return judge(experiment, logs, 1, EFFECTS[effect])


def measured(name, folder):
    """Return the figures of a measured robot."""
    import jaxid as jid

    if name == "pendulum":
        place = DATA / "double_pendulum"
        text = PENDULUM.format(folder=place)
        experiment = jid.experiment.parse_experiment(text, place / "e.toml")
        logs = [place / f"{x}.csv" for x in PENDULUM_LOGS]
        return judge(experiment, logs, 4, None)
    experiment = jid.experiment.load_experiment(EXPERIMENTS / f"{name}.toml")
    # The default estimator, as a new file has it.
    text = experiment.text.split("[estimator]")[0]
    experiment = jid.experiment.parse_experiment(text, experiment.path)
    logs = [DATA / log for log in MEASURED[name]]
    if len(logs) > 1:
        return judge(experiment, logs, 1, None)
    recording = jid.workflow.read_log(experiment.setup, logs[0], experiment.columns)
    first_part, _ = recording.split(0.6)
    end = first_part.duration
    part = text.replace("[recording]", f"[recording]\nstop = {end}")
    rest = text.replace("[recording]", f"[recording]\nstart = {end}")
    parts = [jid.experiment.parse_experiment(x, experiment.path) for x in (part, rest)]
    return judge(parts[0], logs * 2, 1, None, later=parts[1])


def judge(experiment, logs, count, effect, later=None):
    """Choose with the first logs, and judge models by the others."""
    import jaxid as jid

    later = later or experiment
    start = time.process_time()
    search = jid.experiment.choose_model(experiment, logs[:count])
    seconds = time.process_time() - start

    def rows(text):
        setup = jid.experiment.parse_experiment(text, experiment.path).setup
        observed = []
        for number, log in enumerate(logs):
            source = experiment if number < count else later
            recording = jid.workflow.read_log(source.setup, log, source.columns)
            observed.append(setup.observe(recording))
        return setup, observed

    _, first_rows = rows(experiment.text)

    def errors(text):
        """Return the error in the rows of the first file, and that in its own."""
        setup, own = rows(text)
        fit = setup.fit(jid.RegressionProblem(setup.base, own[:count]))
        same = [
            x.replace(mask=y.mask)
            for x, y in zip(own[count:], first_rows[count:], strict=True)
        ]
        return relative(fit, same), relative(fit, own[count:])

    default, _ = errors(experiment.text)
    chosen, comes = errors(search.text)
    others = [default, chosen]
    neighbours = sorted(search.others, key=lambda x: x.error)[:3]
    names = [x.changes for x in neighbours]
    names += [(effect,)] if effect in search.changes else []
    for changes in names:
        keys = [search.changes[name] for name in changes]
        text = jid.experiment.changed_text(experiment.text, *keys)
        others.append(errors(text)[0])
    words = (
        f"{search.chosen.name}: {100 * chosen:.2f} %, as it is {100 * default:.2f} %"
    )
    return Result(
        chosen / min(others),
        chosen / default,
        comes / search.promise,
        seconds,
        words,
    )


def relative(fit, logs):
    """Return the RMS of the errors over that of the forces."""
    import jaxid as jid

    errors = jid.validate(fit, logs).errors
    squares = sum(np.nansum(x.errors**2) for x in errors)
    forces = sum(
        np.nansum(np.where(x.counted, x.measured, np.nan) ** 2) for x in errors
    )
    return float(np.sqrt(squares / forces))


def main():
    """Measure, and print a table."""
    parser = timing.parser(__doc__, "five machines")
    parser.add_argument("names", nargs="*")
    options = parser.parse_args()
    timing.pin_to(1)
    from judgement.machines import MACHINES

    pairs = []
    for i, name in enumerate(MACHINES):
        for j, effect in enumerate(EFFECTS):
            if (i + j) % 2 == 0:
                pairs.append((name, effect))
    if options.quick:
        pairs = pairs[::5]
    studies = {f"{x}, {y}": (simulated, x, y) for x, y in pairs}
    if DATA.is_dir() and not options.quick:
        studies |= {x: (measured, x) for x in ("tx40", "ur10", "kr300", "pendulum")}
    results = {}
    for name, (study, *arguments) in studies.items():
        if options.names and not name.startswith(tuple(options.names)):
            continue
        with tempfile.TemporaryDirectory() as folder:
            results[name] = study(*arguments, Path(folder))
        print(name, results[name], flush=True)
    values = np.array([x[:4] for x in results.values()])
    best, default, promise, seconds = values.T
    small = np.mean(best <= 1.05)
    in_reach = np.mean((promise >= 0.9) & (promise <= 1.15))
    recipe = f"{len(results)} machines"
    rows = [
        Row(
            "over-best",
            "error over that of the best candidate: share up to 1.05",
            recipe,
            ">= 95 %",
            f"{small:.0%} (largest {best.max():.2f})",
            bool(small >= 0.95),
        ),
        Row(
            "over-default",
            "error over that of the file as it is, largest",
            recipe,
            "<= 1.02",
            f"{default.max():.2f} (median {np.median(default):.2f})",
            bool(default.max() <= 1.02),
        ),
        Row(
            "promise",
            "what comes over the promise, median",
            recipe,
            "0.9 to 1.15",
            f"{np.median(promise):.2f} ({in_reach:.0%} within)",
            bool(0.9 <= np.median(promise) <= 1.15),
        ),
        Row(
            "seconds",
            "CPU seconds of a choice, largest",
            recipe,
            "<= 40",
            f"{seconds.max():.0f} (median {np.median(seconds):.0f})",
            bool(seconds.max() <= 40),
        ),
    ]
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
