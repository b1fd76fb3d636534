"""Fleets of runs of one simulated robot: odd runs named, pooled intervals that hold.

    python benchmarks/agreement.py [--quick] [--json FILE]

The robots: UR5 and Panda of `example-robot-data`; Pinocchio computes the forces, not
this package. Each run has its own random motion (20 s at 100 Hz, five harmonics of 0.1
Hz), rotor inertia, viscous and dry friction (tanh, 0.01 rad/s), and noise of 2 % of
each joint's forces, a third of whose variance is white and the rest of which has a
memory of 0.1 s. `jid.identify` with default settings, then `jid.agreement`.

Odd runs: a fleet has ten runs; one carries 0.5 kg at the end-effector, one has a gain
that is 5 % too large in a random joint, and one is warm (viscous friction -25 %, dry
friction -5 %). False alarms are runs of these fleets that are called odd although
nothing is wrong with them, and fleets without odd runs in which any is called so. Rules
were set on the UR5; nothing was changed for the Panda.

Pooled intervals: friction of every joint varies from run to run by a normal factor with
the deviation given; the truth is its mean.
"""

import dataclasses
from importlib.metadata import distribution
from pathlib import Path

import jax
import numpy as np
import timing
from scipy.signal import lfilter
from timing import Row, hand_over

import jaxid as jid

jax.config.update("jax_enable_x64", True)

SHARE = "cmeel.prefix/share/example-robot-data/robots"
FILES = {
    "UR5": "ur_description/urdf/ur5_robot.urdf",
    "Panda": "panda_description/urdf/panda.urdf",
}
RATE = 100.0
DURATION = 20.0
FREQUENCY = 0.1
HARMONICS = 5
NOISE = 0.02
LOAD = 0.5
GAIN = 1.05
WARM_VISCOUS = 0.75
WARM_COULOMB = 0.95
RUNS = 10
CAUSES = ("load", "gain", "friction")


class Arm:
    """A robot in Pinocchio with friction and rotors, and its base parameters here."""

    def __init__(self, name):
        import pinocchio

        path = Path(str(distribution("example-robot-data").locate_file(SHARE)))
        text = (path / FILES[name]).read_text(encoding="utf-8")
        self.pinocchio = pinocchio
        robot = jid.load_urdf(path / FILES[name])
        model = pinocchio.buildModelFromXML(text)
        moving = set(robot.joint_names)
        others = [k for k in range(1, model.njoints) if model.names[k] not in moving]
        neutral = pinocchio.neutral(model)
        self.model = pinocchio.buildReducedModel(model, others, neutral)
        self.joints = robot.joints
        self.base = jid.base_parameters(jid.Model(robot))
        sizes = np.linspace(1.0, 0.2, self.joints)
        self.viscous = 8.0 * sizes
        self.coulomb = 6.0 * sizes
        self.rotors = 0.5 * sizes

    def motion(self, rng):
        """Return a random motion."""
        time = np.arange(0.0, DURATION, 1.0 / RATE)
        rates = 2 * np.pi * FREQUENCY * np.arange(1, HARMONICS + 1)
        sizes = 0.35 / np.sqrt(np.arange(1, HARMONICS + 1))
        a, b = rng.normal(size=(2, self.joints, HARMONICS)) * sizes
        sines = np.sin(time[:, None, None] * rates)
        cosines = np.cos(time[:, None, None] * rates)
        q = np.sum(a * sines + b * cosines, axis=2) + rng.uniform(-1, 1, self.joints)
        qd = np.sum(rates * (a * cosines - b * sines), axis=2)
        qdd = -np.sum(rates**2 * (a * sines + b * cosines), axis=2)
        return q, qd, qdd

    def run(self, rng, name, load=0.0, gains=1.0, viscous=1.0, coulomb=1.0):
        """Return the fit of one run, whose friction is multiplied by factors."""
        q, qd, qdd = self.motion(rng)
        forces = self.forces(q, qd, qdd, load, viscous, coulomb)
        white = rng.normal(size=q.shape)
        slow = lfilter([np.sqrt(1 - 0.81)], [1, -0.9], rng.normal(size=q.shape), axis=0)
        noise = np.sqrt(1 / 3) * white + np.sqrt(2 / 3) * slow
        measured = gains * (forces + NOISE * forces.std(axis=0) * noise)
        observations = jid.Observations.of(
            q,
            qd,
            qdd,
            measured,
            sample_time=1.0 / RATE,
            decimation=jid.Subsample(4),
            name=name,
        )
        return dataclasses.replace(jid.identify(self.base, observations), name=name)

    def forces(self, q, qd, qdd, load=0.0, viscous=1.0, coulomb=1.0):
        """Return the joint torques of a motion."""
        model = self.model.copy()
        if load:
            inertia = self.pinocchio.Inertia(
                load, np.array([0.03, 0.02, 0.08]), 0.002 * load * np.eye(3)
            )
            place = self.pinocchio.SE3.Identity()
            model.appendBodyToJoint(model.njoints - 1, inertia, place)
        data = model.createData()
        rigid = [
            self.pinocchio.rnea(model, data, *x) for x in zip(q, qd, qdd, strict=True)
        ]
        friction = viscous * self.viscous * qd
        friction = friction + coulomb * self.coulomb * np.tanh(qd / 0.01)
        return np.array(rigid) + self.rotors * qdd + friction

    def truth(self, rng):
        """Return the base parameters that noiseless forces give."""
        q, qd, qdd = self.motion(rng)
        observations = jid.Observations.of(
            q, qd, qdd, self.forces(q, qd, qdd), sample_time=1.0 / RATE
        )
        return np.asarray(jid.identify(self.base, observations).parameters)


def odd_runs(name, fleets, seed):
    """Return the row of fleets with three odd runs."""
    rng = np.random.default_rng(seed)
    arm = Arm(name)
    names = arm.base.model.robot.joint_names
    named = dict.fromkeys(CAUSES, 0)
    false_alarms = 0
    for _ in range(fleets):
        odd = rng.choice(RUNS, len(CAUSES), replace=False)
        joint = int(rng.integers(arm.joints))
        gains = np.where(np.arange(arm.joints) == joint, GAIN, 1.0)
        changes = {
            int(odd[0]): {"load": LOAD},
            int(odd[1]): {"gains": gains},
            int(odd[2]): {"viscous": WARM_VISCOUS, "coulomb": WARM_COULOMB},
        }
        fits = [arm.run(rng, f"run{k}", **changes.get(k, {})) for k in range(RUNS)]
        causes = {x.run: x.cause.name for x in jid.agreement(fits).odd}
        expected = ("load", f"gain of `{names[joint]}`", "friction")
        for cause, number, word in zip(CAUSES, odd, expected, strict=True):
            named[cause] += causes.pop(f"run{number}", "") == word
        false_alarms += len(causes)
    sizes = ", ".join(f"{cause} {count}" for cause, count in named.items())
    measured = (
        f"{sizes} of {fleets}; {false_alarms} of {7 * fleets} good runs called odd"
    )
    return Row(
        f"{name}: odd runs",
        "named with their cause; false alarms",
        f"{fleets} fleets of {RUNS} runs",
        "95 %; 5 %",
        measured,
    )


def clean_fleets(name, fleets, seed):
    """Return the row of fleets in which nothing differs."""
    rng = np.random.default_rng(seed)
    arm = Arm(name)
    alarms = 0
    for _ in range(fleets):
        fits = [arm.run(rng, f"run{k}") for k in range(RUNS)]
        result = jid.agreement(fits)
        alarms += bool(result.odd) or bool(result.drifts)
    measured = f"{alarms} of {fleets} fleets with any finding"
    return Row(
        f"{name}: equal runs",
        "fleets with any finding",
        f"{fleets} fleets of {RUNS} runs",
        "5 %",
        measured,
    )


def pooled_intervals(name, fleets, runs, spread, seed):
    """Return the row of pooled intervals where friction varies between runs."""
    rng = np.random.default_rng(seed)
    arm = Arm(name)
    truth = arm.truth(rng)
    inside = []
    alarms = 0
    for _ in range(fleets):
        fits = []
        for k in range(runs):
            viscous, coulomb = 1.0 + spread * rng.normal(size=(2, arm.joints))
            fits.append(arm.run(rng, f"run{k}", viscous=viscous, coulomb=coulomb))
        result = jid.agreement(fits)
        low, high = result.intervals().T
        inside.append((low < truth) & (truth < high))
        alarms += len(result.odd)
    share = 100 * np.mean(inside)
    return Row(
        f"{name}: {runs} runs, friction varies by {100 * spread:g} %",
        "pooled 95 % intervals that hold the truth",
        f"{fleets} fleets",
        "93 to 97 %",
        f"{share:.1f} %; {alarms} of {runs * fleets} runs called odd",
    )


def main():
    """Print the rows."""
    given = timing.parser(__doc__, "two fleets of each kind").parse_args()
    fleets = 2 if given.quick else 40
    rows = []
    for name in FILES:
        rows.append(odd_runs(name, fleets, seed=1))
        rows.append(clean_fleets(name, fleets, seed=2))
        for runs in (2, 4, 10):
            rows.append(pooled_intervals(name, fleets // 2, runs, 0.1, seed=3))
        rows.append(pooled_intervals(name, fleets // 2, 4, 0.0, seed=4))
    hand_over(rows, given.json)


if __name__ == "__main__":
    main()
