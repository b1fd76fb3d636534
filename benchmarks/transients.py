"""Coverage of 95 % intervals on ordinary and slow motions, and on those with pauses.

    python benchmarks/transients.py [--quick] [--seeds 1 2] [--machine wall tree]
        [--json FILE]

MuJoCo records the machines (`judgement/`). The model has the effects of an experiment
file without `[model]`, the filter 10 Hz; transition speeds are found, and all else is
`jid.identify` by default. The statistic: share of the base parameters, of all machines
and seeds, whose interval holds the truth. Joints stick at rest: MuJoCo's dry friction
is a constraint, which no smooth transition is.
"""

import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent / "judgement"))

import machines
import numpy as np
import recordings
import timing
from timing import Row, hand_over

KINDS = "plain", "pauses", "slow"
GOAL = 0.92
"""Smallest share of the intervals that must hold the truth."""


def truth(base, machine, folder):
    """Return the base parameters of a machine."""
    import jaxid as jid

    file = folder / "true.xml"
    file.write_text(machine.true_file)
    bodies = jid.workflow.RobotFile(str(file)).bodies()
    names = base.model.parameter_names
    values = dict.fromkeys(names, 0.0)
    values |= dict(zip(names, np.ravel(bodies), strict=False))
    for j in range(machine.model.nv):
        values[f"fv{j + 1}"] = machine.viscous[j]
        values[f"fc{j + 1}"] = machine.coulomb[j]
        values[f"Ia{j + 1}"] = machine.model.dof_armature[j]
    return np.asarray(base.from_standard(np.array([values[x] for x in names])))


def held(machine, kind, seed, folder):
    """Return which intervals of one log hold the truth."""
    import jaxid as jid

    log = recordings.record(machine, recordings.KINDS[kind], seed)
    file = folder / "machine.xml"
    file.write_text(machine.file)
    setup = jid.Setup(jid.load_urdf(file), filter=jid.ZeroPhaseButterworth(10.0))
    recording = jid.Recording.of(log.angles, log.forces, time=log.time)
    rows = setup.observe(recording)
    base = jid.identify_transition_speeds(setup.base, rows)
    fit = jid.identify(base, rows)
    errors = np.abs(np.asarray(fit.parameters) - truth(base, machine, folder))
    return errors <= np.asarray(fit.uncertainty.half_widths())


def main():
    """Measure each kind of log."""
    parser = timing.parser(__doc__, "one machine, one seed")
    names = [x for x in machines.MACHINES if x not in machines.SETTING_KINDS]
    parser.add_argument("--seeds", type=int, nargs="*", default=[7, 8])
    parser.add_argument("--machine", nargs="*", default=names)
    options = parser.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = Path(tempfile.mkdtemp())
    seeds = [7] if options.quick else options.seeds
    names = ["hobby"] if options.quick else options.machine
    rows = []
    for kind in KINDS:
        parts = []
        for name in names:
            machine = machines.machine(name)
            parts += [held(machine, kind, seed, folder) for seed in seeds]
        is_held = np.concatenate(parts)
        share = float(np.mean(is_held))
        rows.append(
            Row(
                f"transients/{kind}",
                f"intervals of {kind} logs",
                f"{len(is_held)} parameters of {', '.join(names)}, seeds {seeds}",
                f"at least {GOAL:.0%}",
                f"{share:.1%}",
                share >= GOAL,
            )
        )
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
