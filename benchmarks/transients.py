"""Coverage of 95 % intervals on logs with transients, from robots of many kinds.

    python benchmarks/transients.py [--quick] [--seeds 11 12] [--robot scara four]
        [--json FILE]

Robots and logs: `closed_loop.py` (simulated by Pinocchio, 17-bit encoders, force noise
of 0.3 %). The model is that of the simulation, the filter 10 Hz, all else by default.
The statistic: share of the base parameters, of all robots and seeds, whose interval
holds the truth. Ordinary logs are 10 s of five harmonics; slow ones move at a fifth of
that pace for 20 s, short ones last 3 s. All start with a quick ramp from rest, in which
errors are larger than later.
"""

import tempfile
from pathlib import Path

import closed_loop
import numpy as np
import timing
from timing import Row, hand_over

LOGS = {
    "ordinary": {},
    "slow": {"pace": 0.2, "seconds": 20.0},
    "short": {"seconds": 3.0},
}


def truth(base, file, friction):
    """Return the base parameters of a simulated robot."""
    import jaxid as jid

    model, bodies = (
        base.model,
        np.asarray(jid.robots.urdf_parameters(str(file))).ravel(),
    )
    p = dict.fromkeys(model.parameter_names, 0.0)
    p |= dict(zip(model.parameter_names, bodies, strict=False))
    for j, (viscous, dry) in enumerate(np.asarray(friction).T, 1):
        p |= {f"fv{j}": viscous, f"fc{j}": dry}
    return np.asarray(
        base.from_standard(np.array([p[x] for x in model.parameter_names]))
    )


def held(file, settings, seed):
    """Return which intervals of one log hold the truth."""
    import jaxid as jid

    log = closed_loop.simulate(file, seed=seed, **settings)
    robot = jid.load_urdf(str(file))
    base = jid.base_parameters(jid.Model(robot))
    recording = jid.Recording.of(log.angles, log.forces, sample_time=1e-3)
    fit = jid.identify(
        base, jid.observe(recording, robot, jid.ZeroPhaseButterworth(10.0))
    )
    errors = np.abs(np.asarray(fit.parameters) - truth(base, file, log.friction))
    return errors <= np.asarray(fit.uncertainty.half_widths())


def main():
    """Measure each kind of log."""
    parser = timing.parser(__doc__, "one robot, one seed")
    parser.add_argument("--seeds", type=int, nargs="*", default=[11, 12])
    parser.add_argument(
        "--robot", nargs="*", default=["scara", "four", "gantry", "planar"]
    )
    given = parser.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    files = closed_loop.robots(Path(tempfile.mkdtemp()))
    robots, seeds = (["planar"], [11]) if given.quick else (given.robot, given.seeds)
    rows = []
    for name, settings in LOGS.items():
        found = np.concatenate(
            [held(files[x], settings, s) for x in robots for s in seeds]
        )
        recipe = f"{len(found)} parameters of {', '.join(robots)}, seeds {seeds}"
        said = f"{np.mean(found):.1%}"
        good = 0.93 <= np.mean(found) <= 0.97
        rows.append(
            Row(f"transients/{name}", f"{name} logs", recipe, "93 to 97 %", said, good)
        )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
