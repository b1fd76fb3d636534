"""Identification axis by axis, also with friction first, against all axes at once.

Axis by axis: the last axis is identified from its own force, its parameters are taken
for known, then comes the axis before it. Friction can be identified first, from motions
of single axes. Errors of the outer axes are passed on to the inner ones.

The robot: the virtual Panda of `jaxid example` (random bodies, friction with a little
Stribeck effect that no model below has, noise of 1 % of the largest torques, 19-bit
encoders), of one seed for each turn. The logs: two periods of 8 s of a random Fourier
series at 500 Hz, and 4 s for each axis in which it alone moves, on its own part of the
same series. The filter: `ZeroPhaseButterworth` at 10 Hz, every 20th row. The model:
rigid bodies, viscous and Coulomb friction, rotor inertias, offsets.

The statistics, means over the turns: the torques of another motion of 8 s without
noise, RMS error in percent of the largest torques (root mean square of the joints); and
the RMS error of viscous and Coulomb friction in percent of their true values.

    python benchmarks/stepwise.py [--quick]       # five turns, or one
"""

import dataclasses

import jax
import numpy as np
import timing

import jaxid as jid

TURNS, PERIOD, ALONE = 5, 8.0, 4.0
FILTER, EVERY = jid.ZeroPhaseButterworth(10.0), 20
DECIDED = 1e-4
"""Least new fraction (0 to 1) of a column whose parameter an axis determines."""

jax.config.update("jax_enable_x64", True)


class Stepwise(jid.estimators.AbstractEstimator):
    """Least squares for one axis after the other, from the tip inward.

    Deviations are not computed.

    Attributes:
        single_axes: Motions of one axis each; from them friction is identified first,
            and kept.
    """

    single_axes: tuple[jid.Observations, ...] = ()

    def __call__(self, problem):
        """Identify the axes from the last to the first."""
        base = problem.base
        p, known = np.zeros(base.size), set()
        for j, observations in enumerate(self.single_axes):
            alone = jid.RegressionProblem(
                base, [observations], divisions=1
            ).factors.joints[j]
            friction = [
                c for c, k in enumerate(alone.columns) if is_friction(base.names[k])
            ]
            # In the motion of one axis most columns are alike: only their span counts.
            R = np.asarray(alone.R) / np.maximum(
                np.linalg.norm(alone.R, axis=0), 1e-300
            )
            others = [c for c in range(len(alone.columns)) if c not in friction]
            U, s, _ = np.linalg.svd(R[:, others], full_matrices=False)
            U = U[:, s > DECIDED * s.max(initial=0.0)]
            rest = R - U @ (U.T @ R)
            found = np.linalg.lstsq(rest[:, friction], rest[:, -1], rcond=DECIDED)[0]
            scale = np.linalg.norm(alone.R, axis=0)
            for c, value in zip(friction, found, strict=True):
                p[alone.columns[c]] = value * scale[-1] / scale[c]
                known.add(alone.columns[c])
        for joint in reversed(problem.factors.joints):
            R = np.asarray(joint.R)
            new = [c for c, k in enumerate(joint.columns) if k not in known]
            rest = R[:, -1] - R[:, :-1] @ p[list(joint.columns)]
            scale = np.maximum(np.linalg.norm(R[:, new], axis=0), 1e-300)
            kept = independent(R[:, new] / scale)
            values = np.linalg.lstsq(R[:, new][:, kept], rest, rcond=None)[0]
            for c, value in zip(kept, values, strict=True):
                p[joint.columns[new[c]]] = value
                known.add(joint.columns[new[c]])
        return dataclasses.replace(jid.estimators.LeastSquares()(problem), parameters=p)


def is_friction(name: str) -> bool:
    """Return whether a base parameter is friction; offsets resemble weight here."""
    return name.startswith(("fv", "fc")) and name[2:].isdigit()


def independent(R: np.ndarray) -> list[int]:
    """Return the columns of length one that are not combinations of earlier ones."""
    Q, kept = np.zeros((len(R), 0)), []
    for k in range(R.shape[1]):
        rest = R[:, k]
        for _ in range(2):
            rest = rest - Q @ (Q.T @ rest)
        if np.linalg.norm(rest) > DECIDED:
            Q = np.column_stack([Q, rest / np.linalg.norm(rest)])
            kept.append(k)
    return kept


def observed(robot: jid.Robot, recording: jid.Recording) -> jid.Observations:
    """Return the rows of a log."""
    return jid.observe(recording, robot, FILTER, jid.Subsample(EVERY))


def random_log(virtual, name: str, periods: int, key: tuple[int, int]) -> jid.Recording:
    """Return a log of all axes, as `jaxid example` writes it for this key."""
    motion_seed, noise_seed = np.random.SeedSequence(key).generate_state(2).tolist()
    motion = jid.trajectories.random_fourier_series(
        virtual.model.robot, omega=2 * np.pi / PERIOD, reach=0.9, seed=motion_seed
    )
    return virtual.measure(
        motion,
        duration=periods * PERIOD,
        sample_time=0.002,
        seed=noise_seed,
        name=name,
    )


def single_axes(virtual, seed: int) -> tuple[jid.Observations, ...]:
    """Return a log of each axis alone."""
    robot = virtual.model.robot
    whole = jid.trajectories.random_fourier_series(
        robot, omega=2 * np.pi / ALONE, reach=0.9, seed=seed
    )
    logs = []
    for j in range(robot.joints):
        alone = np.arange(robot.joints) == j
        kept = alone[:, None] | (np.arange(whole.coefficients.shape[1]) == 0)
        series = dataclasses.replace(
            whole, coefficients=np.where(kept, whole.coefficients, 0.0)
        )
        recording = virtual.measure(
            series,
            duration=ALONE,
            sample_time=0.002,
            seed=seed + j,
            name=f"axis {j + 1}",
        )
        logs.append(observed(robot, recording))
    return tuple(logs)


def turn(seed: int) -> dict[str, tuple[float, float]]:
    """Return errors of the torques and of friction [%], by method."""
    virtual = jid.simulation.virtual_panda(seed)
    robot, model = virtual.model.robot, virtual.model
    base = jid.base_parameters(model)
    seen = observed(robot, random_log(virtual, "seen", 2, (seed, 1)))
    unseen = observed(robot, random_log(virtual, "unseen", 1, (seed, 2)))
    alone = single_axes(virtual, 100 * seed)
    found = {
        "at once": jid.identify(base, seen),
        "at once, with the single axes' logs": jid.identify(base, [seen, *alone]),
        "axis by axis": jid.identify(base, seen, Stepwise()),
        "axis by axis, friction first": jid.identify(base, seen, Stepwise(alone)),
    }
    motion = unseen.reduced_motion
    truth, largest = virtual.forces(motion), np.asarray(robot.max_forces)
    names = [n for n in base.names if n.startswith(("fv", "fc"))]
    values = dict(zip(model.parameter_names, virtual.parameters, strict=True))
    errors = {}
    for name, fit in found.items():
        wrong = (fit.predict(motion) - truth) / largest
        friction = [fit.parameters[base.names.index(n)] / values[n] - 1 for n in names]
        errors[name] = tuple(
            100 * float(np.sqrt(np.mean(np.square(e)))) for e in (wrong, friction)
        )
    return errors


def main() -> None:
    """Print the table."""
    options = timing.parser(__doc__, "one turn").parse_args()
    turns = [turn(seed) for seed in range(1 if options.quick else TURNS)]
    print("| virtual Panda | torques of an unseen motion | friction |\n|---|---|---|")
    for name in turns[0]:
        torques, friction = np.mean([t[name] for t in turns], axis=0)
        print(f"| {name} | {torques:.3f} % | {friction:.2f} % |")


if __name__ == "__main__":
    main()
