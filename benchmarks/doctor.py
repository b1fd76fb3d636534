"""Mistakes in logs that `jid.diagnose` names: measured logs, changed in the usual ways.

    python benchmarks/doctor.py [--quick] [--json FILE] [--robot tx40] [--class sign] [--show]

Data: the published logs of a Stäubli TX40 (motor side, 5 kHz) and a Universal Robots UR10 (joint
side, 125 Hz) in `../shared/data`, with the experiment files of `tests/real_data` (their filters,
models and weights). Of each log random stretches are taken, at least 60 % of it, and changed in one
way, of random joint and amount: the numbers are the log's, the experiment file is wrong about them.

units: angles in degrees that are taken for radians, or the other way round; forces in N mm or kN m
that are taken for N m (a factor of 2 pi is not among them: the TX40's model fits revolutions that
are taken for radians as well). sign: of one joint's forces or angles. order: forces or angles of
two joints exchanged. side: motors' angles, forces, or both, that are taken for the joints' (the
UR10 gets its gear ratio of 101). saturation: one joint's forces cut off so that 2 to 10 % of the
samples lie at the limit. delay: forces late or early by 4 to 40 ms, on the UR10 by 20 to 80 ms: its
log, at 125 Hz, tells delays to about ±9 ms. milliseconds: a time in milliseconds taken for seconds.
good: nothing is wrong.

Named is a log of which a sentence names the mistake, its joints and its key; the next column
counts those for which no sentence names a mistake of another class. A good log is right if there
are no findings.
"""

import dataclasses
import time

import timing
from timing import DATA, EXPERIMENTS, Row, hand_over

ASKED = 0.9
GEARS = 101.0
CLASSES = ("good", "units", "sign", "order", "side", "saturation", "delay", "milliseconds")
ROBOTS = ("tx40", "ur10")
DELAYS = {"tx40": (0.004, 0.04), "ur10": (0.02, 0.08)}
LOGS = {"tx40": "tx40/motor_position.csv", "ur10": "ur10/exciting_measured.csv"}
SIGNS = {
    "units": ("angle_unit", "force_unit"),
    "sign": ("the sign of", "signs"),
    "order": ("exchanged",),
    "side": ("side",),
    "saturation": ("stay at",),
    "delay": ("force_delay",),
    "milliseconds": ("time_unit",),
}


def stretch(recording, random):
    """Return a part of a log, at least 60 % of it."""
    share = random.uniform(0.6, 1.0)
    first = random.uniform(0.0, 1.0 - share)
    length, start = recording.duration, float(recording.time[0])
    return recording.crop(start + first * length, start + (first + share) * length)


def changed(kind, recording, robot, random):
    """Return the log as a wrong experiment file reads it, and what a sentence must name."""
    import numpy as np

    angles, forces = np.array(recording.angles), np.array(recording.forces)
    speeds = None if recording.velocities is None else np.array(recording.velocities)
    n = forces.shape[1]
    names = [f"`{name}`" for name in robot.joint_names]
    j = int(random.integers(n))
    told = ()
    change = {}
    if kind == "units":
        which = int(random.integers(4))
        if which > 1:
            forces *= (1e3, 1e-3)[which - 2]
            told = ("force_unit",)
        else:
            factor = (180 / np.pi, np.pi / 180)[which]
            angles *= factor
            speeds = None if speeds is None else speeds * factor
            told = ("angle_unit",)
    elif kind == "sign":
        if random.random() < 0.5:
            forces[:, j] *= -1
            told = ("force", names[j])
        else:
            angles[:, j] *= -1
            if speeds is not None:
                speeds[:, j] *= -1
            told = ("angle", names[j])
    elif kind == "order":
        i = int(random.choice([k for k in range(n) if k != j]))
        order = np.arange(n)
        order[[i, j]] = j, i
        told = (names[i], names[j])
        if random.random() < 0.5:
            forces = forces[:, order]
        else:
            angles = angles[:, order]
            speeds = None if speeds is None else speeds[:, order]
    elif kind == "side":
        told = ("side",)
        which = int(random.integers(3))
        drives, motor = robot.drives, recording.angles_on_motor_side
        if which != 1 and motor:
            change["angles_on_motor_side"] = False
        elif which != 1:
            angles = np.asarray(drives.motor_angles(angles))
            still = np.asarray(drives.motor_angles(np.zeros(n)))
            speeds = None if speeds is None else np.asarray(drives.motor_angles(speeds)) - still
        if which != 0 and recording.forces_on_motor_side:
            change["forces_on_motor_side"] = False
        elif which != 0:
            forces = forces / np.diag(np.asarray(drives.reduction))
    elif kind == "saturation":
        top = np.quantile(np.abs(forces[:, j]), random.uniform(0.9, 0.98))
        forces[:, j] = np.clip(forces[:, j], -top, top)
        told = (names[j],)
    elif kind == "delay":
        late = random.uniform(*DELAYS[robot.name.split()[-1].lower()]) * random.choice([-1, 1])
        shift = round(late / recording.sample_time) or 1
        keep = len(forces) - abs(shift)
        a, b = max(shift, 0), max(-shift, 0)
        angles, forces = angles[a : a + keep], forces[b : b + keep]
        speeds = None if speeds is None else speeds[a : a + keep]
    elif kind == "milliseconds":
        change = {
            "sample_time": 1e3 * recording.sample_time,
            "time": 1e3 * np.asarray(recording.time),
        }
    change.setdefault("time", np.asarray(recording.time))
    change["time"] = change["time"][: len(forces)]
    segments = ((0, len(forces)),)
    log = dataclasses.replace(
        recording, angles=angles, forces=forces, velocities=speeds, segments=segments, **change
    )
    return log, told


def right(kind, told, said):
    """Return whether the sentences name this mistake, and no mistake of another class."""
    named = {k for k, marks in SIGNS.items() for s in said if any(m in s for m in marks)}
    hit = any(any(m in s for m in SIGNS[kind]) and all(t in s for t in told) for s in said)
    return hit, named == {kind}


def findings(experiment, log):
    """Return the findings of a log and of the fit to it."""
    import jaxid as jid

    observations = experiment.observe(log)
    fit = jid.identify(experiment.base, observations)
    minimum = experiment.min_speed
    found = jid.diagnose(log, experiment.robot, fit, observations=observations, min_speed=minimum)
    return found.findings


def trials(robot_name, kind, count, show):
    """Return how many are named, named alone, and the duration of one."""
    import zlib

    import numpy as np

    import jaxid as jid
    from jaxid.experiment.experiment import load_experiment  # private: experiment files

    experiment = load_experiment(EXPERIMENTS / f"{robot_name}.toml")
    if robot_name == "ur10":
        drives = jid.Drives(6, reduction=[GEARS] * 6)
        robot = experiment.robot.replace(drives=drives)
        model = jid.Model(robot, experiment.model.terms)
        experiment = dataclasses.replace(experiment, robot=robot, model=model)
    whole = experiment.read(DATA / LOGS[robot_name])
    random = np.random.default_rng([2026, zlib.crc32(f"{robot_name}{kind}".encode())])
    hits = alone = 0
    began = time.perf_counter()
    for _ in range(count):
        log, told = changed(kind, stretch(whole, random), experiment.robot, random)
        try:
            said = findings(experiment, log)
        except ValueError as error:
            said = (str(error),)
        if kind == "good":
            hit = only = not said
        else:
            hit, only = right(kind, told, said)
        hits, alone = hits + hit, alone + (hit and only)
        if show and not (hit and only):
            print(f"-- {robot_name} {kind} {told}: {'named' if hit else 'NOT named'}")
            for sentence in said:
                print(f"   {sentence}")
    return hits, alone, (time.perf_counter() - began) / count


def main():
    """Change the logs and print which mistakes are named."""
    parser = timing.parser(__doc__, "one log of each class")
    parser.add_argument("--count", type=int)
    parser.add_argument("--robot", nargs="*", default=ROBOTS)
    parser.add_argument("--class", nargs="*", default=CLASSES, dest="classes")
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    timing.pin_to(1)
    if not DATA.is_dir():
        print("the measured logs (../shared/data) are not here: skipped")
        return
    import jax

    jax.config.update("jax_enable_x64", True)
    count = given.count or (1 if given.quick else 24)
    rows = []
    print(
        "| robot | changed | logs | named | and nothing else | seconds |\n|---|---|---|---|---|---|"
    )
    for robot in given.robot:
        for kind in given.classes:
            hits, alone, seconds = trials(robot, kind, count, given.show)
            print(f"| {robot} | {kind} | {count} | {hits} | {alone} | {seconds:.1f} |", flush=True)
            asked = "no false alarm" if kind == "good" else f"named in {100 * ASKED:.0f} %"
            share = hits / count
            holds = hits == count if kind == "good" else share >= ASKED
            rows.append(
                Row(
                    f"{robot}/{kind}",
                    f"{robot}: {kind}",
                    f"{count} stretches of the measured log, each changed once",
                    asked,
                    f"{100 * share:.0f} % ({100 * alone / count:.0f} % with no other sentence)",
                    None if given.quick else holds,
                )
            )
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
