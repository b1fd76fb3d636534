"""What `jaxid demo` costs and what it finds, as one table.

The command runs in processes of its own, on the virtual TX90L on its rail, seed 0 (others with
`--seeds`): first with an empty cache of compiled functions, then with the cache that the first run
has left. Wall time and peak memory (largest resident set) are those of the processes; the rest is
what `demo.json` says, the median over the seeds and the worst of them:

* average errors (Eq. 37): worst axis, percent of the largest torque, on identification and
  verification, by least squares without weights, with weights, of bodies that could exist, and
  by the true parameters, whose errors are what disturbs;
* share of 2000 random poses in which the mass matrix has an eigenvalue that is not positive;
* six base parameters cold and warm (Sec. 6), less the paper's, in percent of the paper's;
* share of estimates within their 95 % intervals where noise and encoders alone disturb;
* distance of the end-effector from the path of ISO 9283, three feed-forwards;
* speed and acceleration of the end-effector along the designed motion;
* time of a feed-forward torque in C (median of 21 timings of 4096 calls).

    python benchmarks/demo.py [--seeds 0 1 2] [--quick] [--friction FILE]

`--quick` runs once, with the user's cache. `--friction demo.json` asks, with the motion of an
earlier run, whether another friction law would help: average errors (Eq. 37) by axis in percent of
the largest torque, on the identification motion and on the path of ISO 9283, of the weighted
estimates and of the true parameters, with Coulomb friction as in the demo, with its epsilons found
(`NonlinearFriction`), with Stribeck's law whose speeds are known (as the virtual robot has them) or
found; over the rows at which an axis is faster than 0.02 rad/s or m/s; then what the true
parameters leave without ripple, without stiction and Stribeck's part, and without both; and
estimates of Stribeck's part where its speeds are known.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ESTIMATORS = ("without weights", "weighted", "consistent", "true parameters")


def run(folder, seed, cache):
    """Wall time [s], peak memory [MB] and results of one run."""
    environment = dict(os.environ)
    if cache is not None:
        environment["JAXID_CACHE_DIR"] = str(cache)
    begin = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "jaxid", "demo", "--seed", str(seed), "-o", str(folder)],
        stdout=subprocess.DEVNULL,
        env=environment,
    )
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - begin
    if status:
        raise SystemExit(f"`jaxid demo --seed {seed}` ended with status {status}")
    return wall, usage.ru_maxrss / 1e3, json.loads((folder / "demo.json").read_text())


def figures(record):
    """Names and numbers of one run."""
    found = {}
    for name in ESTIMATORS:
        estimate = record["estimates"][name]
        for k, role in enumerate(("identification", "verification")):
            found[f"average error, {role}, {name} [%]"] = max(estimate[f"mean_percent_{role}"])
            moving = max(estimate["mean_percent_moving"][k])
            found[f"average error, {role}, {name}, moving [%]"] = moving
        found[f"poses with an indefinite mass matrix, {name} [%]"] = (
            100 * estimate["indefinite_share"]
        )
    for one in record["temperature"]:
        for k, state in enumerate(("cold", "warm")):
            paper = one["paper"][k]
            found[f"p_B({one['number']}) {state}, off the paper's [%]"] = (
                100 * (one["estimates"][k] - paper) / paper
            )
    for one in record["coverage"]:
        found[f"within 95 % intervals, {one['filter'].split(',')[0]} [%]"] = 100 * one["share"]
    for one in record["following"]:
        found[f"end-effector off the path, RMS, {one['fed_forward']} [mm]"] = 1e3 * one["tip_rms"]
        found[f"end-effector off the path, largest, {one['fed_forward']} [mm]"] = (
            1e3 * one["tip_largest"]
        )
    excitation = record["excitation"]
    timed = record["feed_forward"]
    if not isinstance(timed, str):
        for key in ("eq_39", "eq_39_factored", "eq_38"):
            found[f"feed-forward in C, {key} [µs]"] = 1e6 * timed[key]
    found["end-effector, speed up to [m/s]"] = excitation["tip_speed"]
    found["end-effector, acceleration up to [m/s²]"] = excitation["tip_acceleration"]
    for design in excitation["designs"]:
        name = design["criterion"]
        for criterion, value in design["criteria"].items():
            found[f"designed by {name}: {criterion}"] = value
    return found


def friction(record):
    """Whether another friction law would help."""
    import equinox as eqx
    import jax

    jax.config.update("jax_enable_x64", True)
    import jaxid as jid
    from jaxid.experiment.demo.study import (
        AT_REST,
        POSTURE,
        SAMPLE_TIME,
        observed,
        verification_path,
    )

    virtual = jid.virtual_tx90l_on_rail()
    robot, model = virtual.robot, virtual.model
    series = record["excitation"]["series"]
    fourier = jid.FourierSeries(**{k: np.asarray(v) for k, v in series.items()})
    led = jid.with_leads(fourier, robot, periods=2)
    path = jid.joint_path(robot, verification_path(), posture=POSTURE)

    def logs(machine):
        runs = (machine.track(t, sample_time=SAMPLE_TIME, seed=s) for t, s in ((led, 0), (path, 2)))
        return [observed(run.recording, robot) for run in runs]

    def line(name, fit, seen, moving=False):
        for role, log, errors in zip(
            ("identification", "ISO 9283"), seen, jid.validate(fit, seen).errors, strict=True
        ):
            sizes = np.abs(np.asarray(errors.errors))
            counted = np.abs(np.asarray(log.reduced_motion.qd)) > (AT_REST if moving else -1.0)
            mean = (sizes * counted).sum(axis=0) / counted.sum(axis=0)
            shown = " | ".join(f"{x:.2f}" for x in 100 * mean / np.asarray(robot.max_forces))
            print(f"| {name}, {role} | {shown} |")

    def given(fit, p):
        return eqx.tree_at(lambda f: f.parameters, fit, np.asarray(p))

    print("| friction | " + " | ".join(robot.joint_names) + " |\n" + "|---" * 8 + "|")
    seen, base = logs(virtual), jid.base_parameters(model)
    coulomb = jid.identify(base, seen[0])
    true = given(coulomb, base.from_standard(virtual.parameters))
    law = jid.StribeckFriction(virtual.friction.stribeck_speed, transition=jid.Tanh(0.01))
    terms = (model.terms[0], model.terms[1], law, *model.terms[3:])
    wider = jid.base_parameters(jid.Model(robot, terms))
    found = jid.NonlinearFriction(free=lambda terms: [terms[2].speed])
    parts = {}
    for name, own, estimator in (
        ("Coulomb", base, None),
        ("Coulomb, epsilons found", base, jid.NonlinearFriction()),
        ("Stribeck, speeds known", wider, None),
        ("Stribeck, speeds found", wider, found),
    ):
        fit = jid.identify(own, seen[0], estimator)
        line(name, fit, seen)
        if "known" in name:
            parts = {n: x for n, x in zip(own.names, fit.parameters, strict=True) if n[:2] == "fs"}
    line("Coulomb, true", true, seen)
    line("Coulomb, moving", coulomb, seen, moving=True)
    smooth = virtual.undisturbed().friction
    for name, machine in (
        ("no ripple", virtual.replace(disturbances=())),
        ("no stiction", virtual.replace(friction=smooth)),
        ("neither", virtual.undisturbed()),
    ):
        line(f"Coulomb, true, {name}", true, logs(machine))
    found = ", ".join(f"{n} {x:.3g}" for n, x in parts.items())
    true = np.asarray(virtual.friction.breakaway) - np.asarray(virtual.friction.coulomb)
    print(f"\nStribeck's part, speeds known [N; N m]: {found}; true: {np.round(true, 3)}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--friction", type=Path, metavar="FILE")
    options = parser.parse_args()
    if options.friction is not None:
        friction(json.loads(options.friction.read_text()))
        return
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        if options.quick:
            runs = [run(root / "demo", options.seeds[0], None)]
            print(f"wall time {runs[0][0]:.0f} s, peak memory {runs[0][1]:.0f} MB")
        else:
            cache = root / "cache"
            cold = run(root / "cold", options.seeds[0], cache)
            runs = [run(root / f"warm{seed}", seed, cache) for seed in options.seeds]
            warm = float(np.median([wall for wall, _, _ in runs]))
            print(f"wall time, cold cache {cold[0]:.0f} s, warm {warm:.0f} s (median)")
            print(f"peak memory, cold {cold[1]:.0f} MB, warm {max(r[1] for r in runs):.0f} MB")
        found = [figures(record) for _, _, record in runs]
    print("\n| figure | median | worst |\n|---|---|---|")
    for name in found[0]:
        values = np.array([one[name] for one in found])
        print(f"| {name} | {np.median(values):.4g} | {values[np.abs(values).argmax()]:.4g} |")


if __name__ == "__main__":
    main()
