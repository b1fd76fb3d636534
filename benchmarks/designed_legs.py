"""Designed motions of robots on legs, played on MuJoCo, beside a plan made by hand.

`jaxid excite` designs the motion of a robot from the masses of its file, with default
settings. MuJoCo plays it with controllers of the joints, which add the forces of the
table (`floating.py`: rotors, friction, noise). Does the robot fall, do feet stay, are
the flags as planned? And what does the log of a quadruped tell, compared with the plan
of `floating.py` of the same duration, and that of a humanoid?

    python benchmarks/designed_legs.py                 # Go2, ANYmal C, A1: 10 minutes
    python benchmarks/designed_legs.py --robot G1 --seconds 60
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from floating import (
    ANYMAL,
    COLUMNS,
    G1,
    GO2,
    NOISE,
    ROBOTS,
    SAMPLE_TIME,
    Legged,
    Study,
    recording,
    simulate,
    total_mass_row,
    write,
)
from timing import Row, hand_over

import jaxid as jid

jax.config.update("jax_enable_x64", True)
A1 = GO2._replace(
    path="a1_description/urdf/a1.urdf",
    feet={f"{leg}_foot": jid.Sphere(0.02) for leg in ("FL", "FR", "RL", "RR")},
)
QUADRUPEDS = {"Go2": GO2, "ANYmal C": ANYMAL, "A1": A1}
HAND_MADE_TIME = 40.0  # duration of the plan of `floating.py`: five phases [s]
FLAG_GUARD = 0.2  # time around a planned change of contact that is not judged [s]
SETTLING_TIME = (
    0.5  # time after a change of contact before a place of a foot counts [s]
)


def design(robot: Legged, seconds: float) -> Any:
    """Return the motion that the command designs with an experiment file."""
    joints = len(robot.load().driven)
    quoted_sole = '"sole"'
    contacts = [
        f"{foot} = {getattr(shape, 'radius', quoted_sole)}"
        for foot, shape in robot.feet.items()
    ]
    text = (
        f'[robot]\nurdf = "{ROBOTS / robot.path}"\nfloating = true\n'
        f"contacts = {{ {', '.join(contacts)} }}\n"
        f"[excitation]\nnoise = {[NOISE['forces']] * joints}\n"
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "experiment.toml"
        path.write_text(text)
        experiment = jid.experiment.load_experiment(path)
        task = jid.workflow.prepare_motion(
            experiment.setup, experiment.excitation, experiment.surroundings
        )
        designed = jid.workflow.design_motion(task, seconds=seconds)
    print(designed.verdict.text, f"gain {designed.plan.mean_gain:.2f}", flush=True)
    return designed.plan


def slip(log: dict[str, np.ndarray]) -> float:
    """Return how far feet move along the ground in a stance, in 95 % of the time [m].

    A stance lasts from the time that a foot touches the ground to its next lift.
    """
    stands = log["contact"] > 0.5
    distances = []
    settling = round(SETTLING_TIME / SAMPLE_TIME)
    for foot in range(stands.shape[1]):
        edges = np.flatnonzero(np.diff(np.r_[0, stands[:, foot].astype(int), 0]))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            places = log["feet"][start + settling : stop, foot, :2]
            if len(places):
                middle = np.median(places, axis=0)
                distances.append(np.linalg.norm(places - middle, axis=1))
    return float(np.quantile(np.concatenate(distances), 0.95))


def wrong_flags(log: dict[str, np.ndarray], motion: Any, times: np.ndarray) -> float:
    """Return the share of flags that are not as planned, away from changes."""
    stands = motion.stands(times)
    changes = np.asarray(motion.lifts)
    distances = np.abs(times[:, None, None] - changes).min(axis=2)
    is_judged = distances > FLAG_GUARD
    return float(np.mean((stands != (log["contact"] > 0.5))[is_judged]))


def compare(name: str, seconds: float) -> list[Row]:
    """Play the designed motion and the plan made by hand, and identify."""
    robot = QUADRUPEDS[name]
    plan = design(robot, seconds)
    motion = plan.trajectory
    duration = float(motion.duration)
    study = Study(robot, HAND_MADE_TIME)
    log = simulate(robot, 1, duration, motion=motion)
    times = SAMPLE_TIME * np.arange(len(log["up"]))
    used_torque = float((abs(log["forces"]).max(axis=0) / robot.torque).max())
    recipe = f"designed_legs.py --robot {name}, search of {seconds:g} s"
    lowest = float(log["up"].min())
    flags = wrong_flags(log, motion, times)
    rows = [
        ("upright: least cosine of the tilt", "0.9", f"{lowest:.3f}", lowest > 0.9),
        ("flags not as planned", "2 %", f"{100 * flags:.2f} %", flags < 0.02),
        ("torque, of the largest", "1", f"{used_torque:.2f}", used_torque < 1.0),
    ]
    logs = {"designed": log, "by hand": simulate(robot, 1, HAND_MADE_TIME)}
    shifts = {kind: 1e3 * slip(channels) for kind, channels in logs.items()}
    rows.append(
        (
            "slip of feet: designed, by hand",
            "as by hand",
            f"{shifts['designed']:.0f}, {shifts['by hand']:.0f} mm",
            shifts["designed"] < 1.5 * shifts["by hand"],
        )
    )
    total = study.total @ study.truth
    for kind, channels in logs.items():
        fit = study.fit(recording(channels, np.random.default_rng(1)))
        mass, width = study.mass(fit)
        error = study.torque_error(fit)
        widths = np.log(fit.uncertainty.half_widths())
        values = (
            f"{1e3 * (mass - total):.0f} ± {1e3 * width:.0f} g of {total:.2f} kg; "
            f"{100 * error:.2f} %; {100 * study.coverage(fit):.0f} %; "
            f"{len(plan.undetermined)} predicted, {len(fit.undetermined)}; "
            f"{np.exp(widths.mean()):.5f}"
        )
        what = "mass error; torque error; coverage; open; mean interval"
        rows.append((f"{kind}: {what}", "", values, error < 4e-3))
    return [Row("43", f"{name}: {what}", recipe, *rest) for what, *rest in rows]


def humanoid(seconds: float) -> list[Row]:
    """Play a designed motion of G1, and identify its total mass."""
    plan = design(G1, seconds)
    motion = plan.trajectory
    log = simulate(G1, 1, float(motion.duration), motion=motion)
    lowest = float(log["up"].min())
    flags = wrong_flags(log, motion, SAMPLE_TIME * np.arange(len(log["up"])))
    setup = jid.Setup(G1.load())
    with tempfile.TemporaryDirectory() as folder:
        path = write(log, Path(folder) / "log.csv", 1)
        report = jid.identify_logs(setup, [path], COLUMNS)
    total = total_mass_row(setup.base)
    truth = total @ setup.base.from_standard(G1.truth(setup.base.model))
    fit = report.fit
    mass = float(total @ fit.parameters)
    width = 2.0 * float(np.sqrt(total @ fit.uncertainty.covariance @ total))
    error = abs(mass / truth - 1.0)
    values = [
        ("upright: least cosine of the tilt", "0.9", f"{lowest:.3f}", lowest > 0.9),
        ("flags not as planned", "2 %", f"{100 * flags:.2f} %", flags < 0.02),
        (
            f"total mass of {truth:.2f} kg",
            "0.3 %",
            f"{mass:.3f} ± {width:.3f} kg, {100 * error:.2f} %",
            error < 3e-3,
        ),
        (
            "open: predicted, identified",
            "-",
            f"{len(plan.undetermined)}, {len(fit.undetermined)}",
            None,
        ),
    ]
    recipe = f"designed_legs.py --robot G1, search of {seconds:g} s"
    return [Row("43", f"G1: {what}", recipe, *rest) for what, *rest in values]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--robot", choices=[*QUADRUPEDS, "G1"])
    parser.add_argument("--seconds", type=float, default=60.0, help="for a search")
    parser.add_argument("--json")
    options = parser.parse_args()
    names = [options.robot] if options.robot else [*QUADRUPEDS]
    if options.quick:
        names = ["Go2"]
    rows = []
    for name in names:
        seconds = 10.0 if options.quick else options.seconds
        rows += humanoid(seconds) if name == "G1" else compare(name, seconds)
        for row in rows[-6:]:
            print(row, flush=True)
    hand_over(rows, options.json)
