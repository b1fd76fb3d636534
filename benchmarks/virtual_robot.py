"""The virtual robot: comparison with MuJoCo, recovery of its parameters, run time.

    python benchmarks/virtual_robot.py [--quick]

Robot: the TX90L on its rail, cold, with seven parameters for each body, viscous and
Coulomb friction and rotors: 70 columns, 44 base parameters, the published ones as
published. Motion: random Fourier series of 0.8 rad/s with five harmonics that use 50 %
of the limits; seed 1 to identify with, seed 3 to verify with; one period (7.85 s; 3 s
with --quick) each. Servo: 1 kHz, 8 Hz, the true model fed forward. Sensors: encoders of
17 bits on the motors, noise of the torques of 1 % of the largest (seeds 1 and 3).
Filter: zero-phase Butterworth at 15 Hz, columns too, 50 rows/s; weighted with the
largest forces; intervals of 95 %.

Table 1: forces by our inverse dynamics less those of MuJoCo along the same motion,
largest difference over the largest force of each joint (no dry friction); then RMS
difference of the torques in the same servo experiment, over the largest force, and the
largest one of the positions. MuJoCo's dry friction is a constraint that holds a joint,
ours here a tanh of 0.01 rad/s.

Table 2: base parameters identified from the logs of MuJoCo, of our robot as its model
has it (`undisturbed`), and of our robot with stiction, Stribeck friction and torque
ripple: intervals that hold the truth in this one draw of the noise, mean torque error
(Eq. 37) by axis against the log, in percent of the largest force, and RMS error against
the noise-free torques of the verification motion.

Table 3: intervals of 95 % over 40 draws of the noise (2 with --quick; seeds 0, 1, ...):
of the identification motion followed exactly (`measure`), and by the servo (`track`,
the robot as its model has it); share of all that hold, median and least number of one
draw, median over the parameters of the reported standard deviation over the scatter,
and of the mean error over it.

Table 4: bias of the estimates by the paper's filter (Eq. 25), without any noise or
encoder step: error of each estimate in standard deviations (of one log with noise, seed
0), and the fraction of 95 % intervals that can hold with such a bias. Motions: the
identification motion, and two periods of it as the demo runs them, from rest to rest.

Table 5: processor time of one second of the experiment.
"""

import dataclasses
import time

import jax
import numpy as np
import timing
from references.mujoco_robot import MujocoRobot
from scipy.stats import norm

import jaxid as jid

QUICK = timing.parser(__doc__, "3 s of motion, two draws").parse_args().quick
DURATION = 3.0 if QUICK else 2 * np.pi / 0.8
DRAWS = 2 if QUICK else 40
AXES = range(1, 8)
SMOOTH = jid.ZeroPhaseButterworth(15.0)

jax.config.update("jax_enable_x64", True)


def line(name, values, digits=3):
    """Return a row of a table."""
    return f"| {name} | " + " | ".join(f"{x:.{digits}f}" for x in values) + " |"


def header(first, names):
    """Return the head of a table."""
    names = [str(n) for n in names]
    return f"| {first} | " + " | ".join(names) + " |\n|" + "---|" * (len(names) + 1)


def rms(x):
    """Return the root of the mean square of each joint."""
    return np.sqrt(np.mean(np.square(np.asarray(x)), axis=0))


def without_dry_friction(virtual):
    """Return the same robot with viscous friction only."""
    ones = np.ones(virtual.robot.joints)
    return virtual.replace(friction=virtual.friction.scaled(ones, 0.0 * ones))


def tracked(machine, virtual, which, seed=None, **how):
    """Run an experiment with the true model fed forward."""
    trajectory = jid.trajectories.random_fourier_series(
        virtual.robot, omega=0.8, reach=0.5, seed=which
    )

    def known(motion):
        return virtual.model.inverse_dynamics(virtual.parameters, motion)

    return machine.track(
        trajectory,
        feed_forward=known,
        duration=DURATION,
        seed=which if seed is None else seed,
        **how,
    )


def agreement(virtual):
    """Print the first table."""
    most = np.asarray(virtual.robot.max_forces)
    smooth = without_dry_friction(virtual)
    trajectory = jid.trajectories.random_fourier_series(
        virtual.robot, omega=0.8, reach=0.5, seed=1
    )
    motion = trajectory.motion(np.linspace(0.0, DURATION, 500))
    apart = np.abs(smooth.forces(motion) - MujocoRobot(smooth).forces(motion)).max(
        axis=0
    )
    print(header("ours less MuJoCo's", AXES))
    print(line("inverse dynamics [1e-15 of the largest force]", 1e15 * apart / most))
    for name, robot in (("without dry friction", smooth), ("with it", virtual)):
        ours, theirs = (
            tracked(machine, robot, 1, substeps=4)
            for machine in (robot, MujocoRobot(robot))
        )
        difference = 100 * rms(ours.forces - theirs.forces) / most
        print(line(f"torques in the servo experiment, {name} [%]", difference))
        moved = np.abs(np.asarray(ours.actual.q) - np.asarray(theirs.actual.q)).max(
            axis=0
        )
        print(line(f"positions there, {name} [1e-3 rad, mm]", 1e3 * moved))


def identified(virtual, disturbed):
    """Print the second table."""
    base = jid.base_parameters(virtual.model)
    truth = np.asarray(base.from_standard(virtual.parameters))
    most = np.asarray(virtual.robot.max_forces)
    print()
    print(header("logs of", ["intervals that hold", *(f"axis {k} [%]" for k in AXES)]))
    for name, machine in (
        ("MuJoCo", MujocoRobot(virtual)),
        ("ours, as the model", virtual),
        ("ours, disturbed", disturbed),
    ):
        runs = [tracked(machine, virtual, which) for which in (1, 3)]
        seen, unseen = (
            jid.observe(r.recording, virtual.robot, SMOOTH, jid.Subsample(20))
            for r in runs
        )
        fit = jid.identify(base, seen)
        low, high = fit.intervals(0.95).T
        hold = f"{np.sum((low <= truth) & (truth <= high))} of {base.size}"
        check = jid.validate(fit, [seen, unseen])
        for motion, errors in zip(
            ("identification", "verification"), check.errors, strict=True
        ):
            shown = " | ".join(f"{x:.2f}" for x in errors.mean_percent)
            print(f"| {name}: {motion}, mean | {hold} | {shown} |")
        wrong = 100 * rms(fit.predict(runs[1].actual) - runs[1].forces) / most
        print(f"| {name}: verification, RMS, no noise | {hold} | ", end="")
        print(" | ".join(f"{x:.2f}" for x in wrong), "|")


def fitted(base, robot, log, filter):
    """Identify from one log."""
    return jid.identify(base, jid.observe(log, robot, filter, jid.Subsample(20)))


def calibration(virtual):
    """Print the third table."""
    base = jid.base_parameters(virtual.model)
    truth = np.asarray(base.from_standard(virtual.parameters))
    trajectory = jid.trajectories.random_fourier_series(
        virtual.robot, omega=0.8, reach=0.5, seed=1
    )

    def followed(seed):
        return virtual.measure(
            trajectory, duration=DURATION, sample_time=1e-3, seed=seed
        )

    def by_servo(seed):
        return tracked(virtual, virtual, 1, seed).recording

    columns = (
        "hold [%]",
        "median",
        "least",
        "reported / scatter",
        "mean error / scatter",
    )
    print()
    print(header(f"{DRAWS} draws, of 44", columns))
    for name, log in (("followed exactly", followed), ("by the servo", by_servo)):
        fits = [fitted(base, virtual.robot, log(k), SMOOTH) for k in range(DRAWS)]
        ends = np.array([f.intervals(0.95) for f in fits])
        inside = (ends[..., 0] <= truth) & (truth <= ends[..., 1])
        found = np.array([f.parameters for f in fits])
        scatter = found.std(axis=0, ddof=1)
        reported = np.mean([f.standard_deviations for f in fits], axis=0)
        held = inside.sum(axis=1)
        bias = np.abs(found.mean(axis=0) - truth) / scatter
        print(
            f"| {name} | {100 * inside.mean():.1f} | {np.median(held):.0f} | "
            f"{held.min()} | {np.median(reported / scatter):.2f} | "
            f"{np.median(bias):.2f} |"
        )


def filters(virtual):
    """Print the fourth table."""
    base = jid.base_parameters(virtual.model)
    truth = np.asarray(base.from_standard(virtual.parameters))
    most = virtual.sensors.white_noise
    perfect = dataclasses.replace(
        virtual.sensors, encoder_step=1e-11, white_noise=0.0 * most
    )
    quiet = virtual.replace(sensors=perfect)
    series = jid.trajectories.random_fourier_series(
        virtual.robot, omega=0.8, reach=0.5, seed=1
    )
    led = jid.trajectories.with_leads(series, virtual.robot, periods=2)
    columns = (
        "median error [sd]",
        "largest [sd]",
        "worst",
        "beyond 1.96",
        "can hold [%]",
    )
    print()
    print(header("filter; motion", columns))
    for motion, trajectory, duration in (
        ("one period", series, DURATION),
        ("two, from rest to rest", led, DURATION if QUICK else float(led.duration)),
    ):
        noisy, exact = (
            robot.measure(trajectory, duration=duration, sample_time=1e-3, seed=0)
            for robot in (virtual, quiet)
        )
        for name, filter in (
            ("`ZeroPhaseButterworth(15)`", SMOOTH),
            ("`PaperFilter()`", jid.filters.PaperFilter()),
        ):
            deviations = fitted(base, virtual.robot, noisy, filter).standard_deviations
            wrong = fitted(base, virtual.robot, exact, filter).parameters - truth
            bias = np.asarray(wrong) / deviations
            hold = norm.cdf(1.96 - bias) - norm.cdf(-1.96 - bias)
            worst = int(np.argmax(np.abs(bias)))
            print(
                f"| {name}; {motion} | {np.median(np.abs(bias)):.2f} | "
                f"{abs(bias[worst]):.1f} | {base.names[worst]} | "
                f"{np.sum(np.abs(bias) > 1.96)} | {100 * hold.mean():.0f} |"
            )


def speed(disturbed):
    """Print the fifth table."""
    print()
    print("| one second of the experiment at 1 kHz | processor time [s] |\n|---|---|")
    for name, machine in (
        ("ours, everything on", disturbed),
        ("MuJoCo", MujocoRobot(disturbed)),
    ):
        tracked(machine, disturbed, 1)
        start = time.process_time()
        tracked(machine, disturbed, 1)
        print(f"| {name} | {(time.process_time() - start) / DURATION:.3f} |")


def main():
    """Print the tables."""
    virtual = jid.simulation.virtual_tx90l_on_rail(disturbed=False)
    disturbed = jid.simulation.virtual_tx90l_on_rail()
    agreement(virtual)
    identified(virtual, disturbed)
    calibration(virtual)
    filters(virtual)
    speed(disturbed)


if __name__ == "__main__":
    main()
