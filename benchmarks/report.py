"""Report of a log of 60 s at 1 kHz: time to write its page, and the page's size.

    python benchmarks/report.py [--quick] [--json FILE]

A Panda with random bodies follows two random Fourier series; every sample is a row, one
log is of the fit and one verifies it. The report is saved twice; the second time
counts, and includes all files. Whether the page can be read in a browser is tested in
`tests/report/test_browser.py`.
"""

import tempfile
import time
from pathlib import Path

import numpy as np
import timing
from timing import Row, hand_over


def logs(jid, robot, model, duration):
    """Return observations of two motions with noise of 2 % of the largest forces."""
    random, t, found = np.random.default_rng(0), np.arange(0.0, duration, 1e-3), []
    masses = np.linspace(6.0, 1.0, robot.joints)
    bodies = jid.simulation.random_bodies(robot, masses, random).ravel()
    p = np.concatenate([bodies, np.ones(model.size - len(bodies))])
    for seed in (1, 2):
        motion = jid.trajectories.random_fourier_series(
            robot, omega=0.5, seed=seed
        ).motion(t)
        forces = np.array(model.inverse_dynamics(p, motion))
        noise = 0.02 * np.abs(forces).max(axis=0) * random.standard_normal(forces.shape)
        arrays = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd))
        found.append(jid.Observations.of(*arrays, forces + noise, sample_time=1e-3))
    return found


def main():
    """Print the row."""
    given = timing.parser(__doc__, "6 s").parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxid as jid

    robot = jid.robots.panda()
    model = jid.Model(robot)
    observations = logs(jid, robot, model, 6.0 if given.quick else 60.0)
    fit = jid.identify(jid.base_parameters(model), observations[0])
    found = jid.validate(fit, observations)
    report = jid.workflow.IdentificationReport(
        fit, found.errors[:1], found.errors[1:], found.definiteness
    )
    folder = Path(tempfile.mkdtemp())
    for _ in range(2):
        begin = time.perf_counter()
        report.save(folder)
        seconds = time.perf_counter() - begin
    size = (folder / "report.html").stat().st_size / 1e6
    recipe = "benchmarks/report.py: Panda, two logs, every sample a row"
    said, holds = f"{seconds:.1f} s, {size:.1f} MB", seconds <= 5.0 and size <= 4.0
    what = "page of a log of 60 s at 1 kHz: time to write, size"
    hand_over([Row("report", what, recipe, "≤ 5 s, ≤ 4 MB", said, holds)], given.json)


if __name__ == "__main__":
    main()
