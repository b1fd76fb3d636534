"""Delay of forces in closed loop: coverage of its interval, and false advice.

    python benchmarks/delay.py [--quick] [--json FILE] [--draws 50] [--robot scara ...]

Logs: `closed_loop.py`, 10 s at 1 kHz; the forces are shifted by 0, 3 and 10 ms. With
and without friction; disturbances that move the robot: none, or 3 % of the RMS force
below 5 Hz. The model has the right law of friction; a zero-phase Butterworth filter at
10 Hz, every 25th row. The delay is estimated once by the measured motion alone, once
with the commanded one.

Covered is a draw whose 95 % interval holds the truth; random, one whose interval
without the resolution of a tenth of a sample does. A delay is told if the interval of
99.99 % leaves zero out, as `jaxid inspect` does. False is what is told with an interval
that leaves the truth out.
"""

import tempfile
from pathlib import Path

import closed_loop
import numpy as np
import timing
from timing import Row, hand_over

ROBOTS = ("scara", "six", "pendulum", "xarm7")
DELAYS = (0.0, 0.003, 0.01)


def shifted(forces, seconds, dt):
    """Return forces that stand later."""
    k = round(seconds / dt)
    return (
        forces if k == 0 else np.vstack([np.repeat(forces[:1], k, axis=0), forces[:-k]])
    )


def study(robot, file, friction, disturbance, draws):
    """Return covered, random, told, false: by delay, without and with commands."""
    import jaxid as jid

    arm = jid.load_urdf(file)
    terms = [jid.RigidBodies(), jid.ConstantOffset()]
    if friction:
        terms += [jid.ViscousFriction(), jid.CoulombFriction(jid.terms.Tanh(0.01))]
    base = jid.base_parameters(jid.Model(arm, tuple(terms)))
    levels = {} if friction else {"viscous": 0.0, "coulomb": 0.0}
    found = np.zeros((len(DELAYS), 2, 4))
    for seed in range(draws):
        log = closed_loop.simulate(file, seed=seed, disturbance=disturbance, **levels)
        weights = jid.estimators.GivenWeights(
            1 / np.sqrt(np.mean(log.forces**2, axis=0))
        )
        for k, late in enumerate(DELAYS):
            forces = shifted(log.forces, late, 1e-3)
            both = [
                jid.observe(
                    jid.Recording.of(angles, forces, time=log.time),
                    arm,
                    jid.ZeroPhaseButterworth(10.0),
                    jid.Subsample(25),
                )
                for angles in (log.angles, log.commands)
            ]
            for way, commanded in enumerate((None, both[1])):
                delay = jid.estimate_delay(base, both[0], weights, commanded=commanded)
                low, high = delay.interval()
                held, own = low <= late <= high, delay.resolution
                random = low + own <= late <= high - own
                low, high = delay.interval(0.9999)
                told = not low <= 0 <= high
                found[k, way] += held, random, told, told and not low <= late <= high
    return found


def main():
    """Print the table."""
    parser = timing.parser(__doc__, "two draws of one robot")
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--robot", nargs="*")
    given = parser.parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    draws, robots = given.draws, given.robot or ROBOTS
    if given.quick:
        draws, robots = 2, ["pendulum"]
    files, rows = closed_loop.robots(Path(tempfile.mkdtemp())), []
    ways = "covered | random | told | false"
    print(
        f"| robot | friction | disturbance | delay | {ways} | with commands: {ways} |"
    )
    print("|" + 12 * "---|")
    totals = np.zeros((2, 4))
    for robot in robots:
        for friction in (True, False):
            for disturbance in (0.0, 0.03):
                found = study(robot, files[robot], friction, disturbance, draws)
                totals += found.sum(axis=0)
                for late, ways in zip(DELAYS, found, strict=True):
                    shares = " | ".join(f"{100 * x / draws:.0f}" for x in ways.ravel())
                    case = (
                        f"{robot} | {friction} | {disturbance:.0%} | {1e3 * late:g} ms"
                    )
                    print(f"| {case} | {shares} |", flush=True)
    count = draws * len(robots) * 4 * len(DELAYS)
    for way, (held, random, _, false) in zip(
        ("measured", "commanded"), totals, strict=True
    ):
        covered, random = (f"{100 * x / count:.1f} %" for x in (held, random))
        said = (
            f"{covered} covered, {random} without resolution, {false:.0f} of "
            f"{count} false"
        )
        rows.append(
            Row(
                f"delay/{way}",
                f"delay, {way}",
                f"{count} logs",
                "93-97 %, 0 false",
                said,
            )
        )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
