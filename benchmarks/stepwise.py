"""Axis by axis, with and without friction first, beside identification at once.

The robot: the virtual Panda of `jaxid example` (random bodies, friction with a little Stribeck
effect that no model below has, noise of 1 % of the largest torques, 19-bit encoders), of one seed
for each turn. The logs: two periods of 8 s of a random Fourier series at 500 Hz, and 4 s for each
axis in which it alone moves, on its own part of the same series. The filter: `ZeroPhaseButterworth`
at 10 Hz, every 20th row. The model: rigid bodies, viscous and Coulomb friction, rotor inertias,
offsets.

The statistics, means over the turns: the torques of another motion of 8 s without noise, RMS error
in percent of the largest torques (root mean square of the joints); and the RMS error of viscous and
Coulomb friction in percent of their true values.

    python benchmarks/stepwise.py [--quick]       # five turns, or one
"""

import sys

import equinox as eqx
import jax
import numpy as np

import jaxid as jid
from jaxid.simulation.example import virtual_log, virtual_panda

TURNS, ALONE, FILTER, EVERY = 5, 4.0, jid.ZeroPhaseButterworth(10.0), 20

jax.config.update("jax_enable_x64", True)


def observed(robot: jid.Robot, recording: jid.Recording) -> jid.Observations:
    """The rows of a log."""
    return jid.observe(recording, robot, FILTER, jid.Subsample(EVERY))


def single_axes(virtual, seed: int) -> tuple[jid.Observations, ...]:
    """Each axis alone."""
    robot = virtual.model.robot
    whole = jid.random_fourier_series(robot, omega=2 * np.pi / ALONE, reach=0.9, seed=seed)
    logs = []
    for j in range(robot.joints):
        alone = np.arange(robot.joints) == j
        series = eqx.tree_at(
            lambda s: (s.a, s.b),
            whole,
            (np.where(alone[:, None], whole.a, 0.0), np.where(alone[:, None], whole.b, 0.0)),
        )
        recording = virtual.measure(
            series, duration=ALONE, sample_time=0.002, seed=seed + j, name=f"axis {j + 1}"
        )
        logs.append(observed(robot, recording))
    return tuple(logs)


def turn(seed: int) -> dict[str, tuple[float, float]]:
    """Errors of the torques and of friction [%], by method."""
    virtual = virtual_panda(seed)
    robot, model = virtual.model.robot, virtual.model
    base = jid.base_parameters(model)
    seen = observed(robot, virtual_log(virtual, "seen", 2, (seed, 1)))
    unseen = observed(robot, virtual_log(virtual, "unseen", 1, (seed, 2)))
    alone = single_axes(virtual, 100 * seed)
    found = {
        "at once": jid.identify(base, seen),
        "at once, with the single axes' logs": jid.identify(base, [seen, *alone]),
        "axis by axis": jid.identify(base, seen, jid.Stepwise()),
        "axis by axis, friction first": jid.identify(base, seen, jid.Stepwise(alone)),
    }
    motion = unseen.reduced_motion
    truth, largest = virtual.forces(motion), np.asarray(robot.max_forces)
    names = [n for n in base.names if n.startswith(("fv", "fc"))]
    values = dict(zip(model.parameter_names, virtual.parameters, strict=True))
    errors = {}
    for name, fit in found.items():
        wrong = (fit.predict(motion) - truth) / largest
        friction = [fit.parameters[base.names.index(n)] / values[n] - 1 for n in names]
        errors[name] = tuple(100 * float(np.sqrt(np.mean(np.square(e)))) for e in (wrong, friction))
    return errors


def main() -> None:
    """Prints the table."""
    turns = [turn(seed) for seed in range(1 if "--quick" in sys.argv else TURNS)]
    print("| virtual Panda | torques of an unseen motion | friction |\n|---|---|---|")
    for name in turns[0]:
        torques, friction = np.mean([t[name] for t in turns], axis=0)
        print(f"| {name} | {torques:.3f} % | {friction:.2f} % |")


if __name__ == "__main__":
    main()
