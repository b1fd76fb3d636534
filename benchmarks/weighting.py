"""What weights and physical bounds do to the mass matrix and to torques (paper, Figs. 6 and 7).

    python benchmarks/weighting.py [--quick] [--json FILE] [--figure FILE.png]

Robot: the TX90L on its rail with ten parameters per body, viscous and Coulomb friction and rotors,
no offsets, as in the paper: 91 columns. Truth: bodies that are clouds of points along the links,
20 % about masses of 80 to 1 kg; friction, rotors and errors in shares of the largest forces. What
the model lacks: Stribeck friction (2 % of the largest forces, fading at 0.1 rad/s), a constant
offset (1 %), white noise (2 %) and noise with a memory of 0.1 s (1 %).

Data: each trial draws a truth and two random Fourier motions of 20 s at 100 Hz within the limits,
one to identify with and one to verify with. Filter: zero-phase Butterworth at 8 Hz, for columns
too; 20 rows/s. Keys: [trial, 0] truth, 2 trial and 2 trial + 1 motions and noise.

Estimators: unweighted (W = I, Fig. 6), weighted with the largest forces (Eq. 30, Fig. 7), and
physically consistent with the same weights, default bounds and no margin. Statistic: share of the
trials whose mass matrix is positive definite in 2000 random poses of the joints' ranges; RMS error
over RMS force on the other motion, by axis, median of the trials. The figure shows torques of the
first trial on the identification motion, axes 1, 5 and 7.
"""

import argparse

import timing
from timing import Row, hand_over

SAMPLE_TIME, DURATION, EVERY, CUTOFF = 0.01, 20.0, 5, 8.0
MASSES = (80.0, 40.0, 25.0, 20.0, 8.0, 4.0, 1.0)
AXES = (0, 4, 6)


def virtual(robot, trial):
    """The robot of one trial, whose parameters are known."""
    import numpy as np

    from jaxid import ConstantOffset, RigidBodies, RotorInertia
    from jaxid.simulation.gear_friction import SmoothFriction
    from jaxid.simulation.sensors import Sensors
    from jaxid.simulation.virtual import VirtualRobot, random_bodies

    rng = np.random.default_rng([trial, 0])
    most = np.asarray(robot.max_forces)

    def about(values):
        return values * rng.uniform(0.8, 1.2, robot.joints)

    bodies = random_bodies(robot, about(np.array(MASSES)), rng)
    viscous, coulomb, rotors = (about(share * most) for share in (0.02, 0.03, 0.005))
    offsets = 0.01 * most * rng.uniform(-1.0, 1.0, robot.joints)
    return VirtualRobot(
        robot=robot,
        terms=(RigidBodies(), RotorInertia(), ConstantOffset()),
        values=np.concatenate([bodies.ravel(), rotors, offsets]),
        friction=SmoothFriction(viscous, coulomb, stribeck=0.02 * most, stribeck_speed=0.1),
        sensors=Sensors(
            encoder_step=2 * np.pi / 2**19,
            white_noise=0.02 * most,
            coloured_noise=0.01 * most,
            memory=0.1,
        ),
    )


def recorded(robot, arm, trial, which):
    """Observations of one of the two motions of a trial."""
    import jaxid as jid

    trajectory = jid.random_fourier_series(robot, omega=0.6, reach=0.9, seed=2 * trial + which)
    log = arm.measure(
        trajectory,
        duration=DURATION,
        sample_time=SAMPLE_TIME,
        seed=2 * trial + which,
        name=("identification", "verification")[which],
    )
    return jid.observe(log, robot, jid.ZeroPhaseButterworth(CUTOFF), jid.Subsample(EVERY))


def trials(count):
    """Definiteness and errors of each trial by estimator, and the first trial's torques."""
    import numpy as np

    import jaxid as jid

    robot = jid.robots.tx90l_on_rail()
    terms = jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(), jid.RotorInertia()
    base = jid.base_parameters(jid.Model(robot, terms))
    estimators = {
        "unweighted": jid.LeastSquares(),
        "weighted": jid.WeightedLeastSquares(),
        "physically consistent": jid.PhysicallyConsistent(),
    }
    indefinite = {name: [] for name in estimators}
    errors = {name: [] for name in estimators}
    shown = {}
    for trial in range(count):
        arm = virtual(robot, trial)
        seen, unseen = (recorded(robot, arm, trial, which) for which in (0, 1))
        blocks = jid.factorise(base, (seen,))
        for name, estimator in estimators.items():
            fit = jid.fit_blocks(base, blocks, estimator)
            check = jid.validate(fit, [seen, unseen] if trial == 0 else [unseen])
            indefinite[name].append(check.definiteness.indefinite)
            errors[name].append(np.asarray(check.errors[-1].rms_relative))
            if trial == 0:
                shown[name] = check.errors[0], check.definiteness
    return robot, indefinite, errors, shown


def figure(robot, shown, path):
    """Measured and predicted forces of the axes 1, 5 and 7, a column for each estimator."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    fig, panels = plt.subplots(
        len(AXES), len(shown), figsize=(12, 7), sharex=True, sharey="row", layout="constrained"
    )
    for column, (name, (errors, found)) in zip(panels.T, shown.items(), strict=True):
        share = 100 * (1.0 - found.indefinite)
        column[0].set_title(f"{name}\nM positive definite in {share:.0f} % of {found.poses} poses")
        for panel, axis in zip(column, AXES, strict=True):
            t = np.asarray(errors.time) - errors.time[0]
            panel.plot(t, errors.measured[:, axis], color="0.55", lw=2.0, label="measured")
            panel.plot(t, errors.predicted[:, axis], color="tab:red", lw=0.9, label="model")
            panel.set_xlim(0.0, 10.0)
            panel.grid(alpha=0.3)
        column[-1].set_xlabel("time [s]")
    for row, axis in zip(panels, AXES, strict=True):
        unit = robot.force_unit(axis)
        row[0].set_ylabel(f"axis {axis + 1} [{unit}]")
    panels[0, 0].legend(loc="upper right", fontsize=8)
    fig.savefig(path, dpi=110)
    plt.close(fig)


def main():
    """Measures, and draws if told where."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one trial")
    parser.add_argument("--json", help="where to write the rows")
    parser.add_argument("--figure", help="where to draw the torques of the axes 1, 5 and 7")
    options = parser.parse_args()
    timing.pin_to(2)
    import numpy as np

    count = 1 if options.quick else 100
    robot, indefinite, errors, shown = trials(count)
    if options.figure is not None:
        figure(robot, shown, options.figure)
    rows = []
    for name, shares in indefinite.items():
        good = sum(share == 0.0 for share in shares)
        typical = 100 * np.median(errors[name], axis=0)
        said = ", ".join(f"{typical[axis]:.0f} % (axis {axis + 1})" for axis in AXES)
        consistent = name == "physically consistent"
        rows.append(
            Row(
                "W",
                f"M positive definite, {name}",
                f"TX90L on its rail, {count} trials, 2000 poses each; errors on another motion",
                "all" if consistent else "-",
                f"{good} of {count} trials; bad poses in the others "
                f"{100 * np.mean([s for s in shares if s > 0] or [0]):.0f} %; errors {said}",
                good == count if consistent else None,
            )
        )
    hand_over(rows, options.json)


if __name__ == "__main__":
    main()
