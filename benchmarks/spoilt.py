"""Logs and descriptions with one mistake each, and what `jaxid identify` says of them.

    python benchmarks/spoilt.py [--quick] [--json FILE] [--robot six] [--kind sign]
        [--show]

Robots and logs: `closed_loop.py` (simulated by Pinocchio). Each robot moves for 10 s
under control; measured are angles (17 bits), velocities and forces (0.3 % white noise).
Then one thing is wrong: the log, its experiment file or the robot's URDF, each in
several joints and amounts. The experiment file is that of `jaxid init`, the log is
split at 60 %.

Counted: cases without any `!` or ✗ in the verdict, although the model misses more than
`MATTERS` of some joint's RMS force (or of 1 % of its largest force, if that is more)
and half more than in the robot's good log, or is wrong by construction of the log (lost
rows, held channels); sentences that name another mistake than the one that was made
(wrong cures); verdicts of good logs that are not good.
"""

import contextlib
import dataclasses
import re
import tempfile
import time
from pathlib import Path

import closed_loop
import numpy as np
import timing
from scipy import signal
from timing import Row, hand_over

MATTERS = 0.02
DT = 1e-3


@dataclasses.dataclass
class Case:
    """A log with its description, which a mistake changes.

    Attributes:
        t: Times [s].
        q: Angles.
        qd: Velocities.
        tau: Forces.
        commands: Commanded angles.
        edits: Patterns in the experiment file and what replaces them.
        urdf: Text of the robot's URDF.
        cure: Words one of which every cure must contain; no cure is right if empty.
    """

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    commands: np.ndarray
    urdf: str
    edits: list = dataclasses.field(default_factory=list)
    cure: tuple = ()

    def key(self, name, value, table=None):
        """Set a key of the experiment file."""
        if table is None:
            self.edits.append((rf"(?m)^(# )?{name} = .*$", f"{name} = {value}"))
        else:
            self.edits.append(
                (rf"(?m)^(# )?\[{table}\]$", f"[{table}]\n{name} = {value}")
            )

    def rows(self, kept):
        """Keep some rows."""
        self.t, self.q, self.qd, self.tau = (
            x[kept] for x in (self.t, self.q, self.qd, self.tau)
        )

    def joint(self, j, pattern, replacement):
        """Change the description of a joint in the URDF."""
        parts = re.split(r"(<joint\b.*?</joint>)", self.urdf, flags=re.S)
        moving = [
            k for k, x in enumerate(parts) if re.search(r'type="(rev|pris|cont)', x)
        ]
        k = moving[j]
        parts[k], count = re.subn(pattern, replacement, parts[k], count=1)
        if not count:
            raise LookupError(pattern)
        self.urdf = "".join(parts)


def sign_force(c, j, _):
    c.tau[:, j] *= -1
    c.cure = (f"sign of the force of joint `{{{j}}}`",)


def sign_angle(c, j, _):
    c.q[:, j] *= -1
    c.qd[:, j] *= -1
    c.cure = (f"sign of the angle of joint `{{{j}}}`",)


def both_signs(c, j, _):
    c.tau[:, j] *= -1
    c.q[:, j] *= -1
    c.qd[:, j] *= -1
    c.cure = (f"axis of joint `{{{j}}}`",)


def swap(*names):
    def change(c, j, _):
        i = (j + 1) % c.q.shape[1]
        for name in names:
            x = getattr(c, name)
            x[:, [i, j]] = x[:, [j, i]]
        c.cure = ("exchanged",)

    return change


def gain(c, j, by):
    c.tau[:, j] *= by
    c.cure = (f"gain of the force of joint `{{{j}}}`",)


def offset(c, j, by):
    c.q[:, j] += by
    c.cure = (f"angle of joint `{{{j}}}` seems to lack",)


def delay_all(c, j, by):
    k = round(by / DT)
    c.tau = np.vstack([np.repeat(c.tau[:1], k, axis=0), c.tau[:-k]])
    c.cure = ("force_delay",)


def delay_one(c, j, by):
    k = round(by / DT)
    c.tau[:, j] = np.concatenate([np.repeat(c.tau[0, j], k), c.tau[:-k, j]])


def lost_rows(c, j, share):
    kept = np.random.default_rng(j).random(len(c.t)) > share
    c.rows(kept)
    c.edits.append((r'(?m)^time = "t".*$', f"sample_time = {DT}"))
    c.cure = ("rows",)


def lost_stretch(c, j, count):
    at = len(c.t) // (3 + j)
    c.rows(np.r_[0:at, at + int(count) : len(c.t)])
    c.edits.append((r'(?m)^time = "t".*$', f"sample_time = {DT}"))
    c.cure = ("rows",)


def repeated_rows(c, j, share):
    at = np.flatnonzero(np.random.default_rng(j).random(len(c.t)) < share)
    for k in at:
        c.q[k], c.qd[k], c.tau[k] = c.q[k - 1], c.qd[k - 1], c.tau[k - 1]
    c.cure = ("rows",)


def compensated(c, j, _):
    import pinocchio as pin

    model = pin.buildModelFromXML(c.urdf)
    data = model.createData()
    c.tau -= np.array([pin.computeGeneralizedGravity(model, data, q) for q in c.q])
    c.cure = ("gravity",)


def filtered(c, j, hz):
    c.tau = (
        signal.lfilter(*signal.butter(1, hz, fs=1 / DT), c.tau - c.tau[0], axis=0)
        + c.tau[0]
    )
    c.cure = ("delay",)


def commanded(c, j, _):
    c.q = c.commands.copy()
    c.qd = np.gradient(c.q, DT, axis=0)


def late_velocities(c, j, by):
    k = round(by / DT)
    c.qd = np.vstack([np.zeros((k, c.q.shape[1])), c.qd[:-k]])
    c.key("velocities", '"dq{}"')
    c.cure = ()


def wrong_velocities(c, j, by):
    c.qd[:, j] *= by
    c.key("velocities", '"dq{}"')
    c.cure = ()


def degrees(c, j, _):
    c.q = np.rad2deg(c.q)
    c.cure = ("angle_unit",)


def millimetre_forces(c, j, by):
    c.tau *= by
    c.cure = ("force_unit",)


def sample_time(c, j, by):
    c.edits.append((r'(?m)^time = "t".*$', f"sample_time = {DT * by}"))


def held_channel(c, j, length):
    a = len(c.t) // 3
    c.q[a : a + int(length), j] = c.q[a, j]
    c.cure = ("held",)


def held_force(c, j, length):
    a = len(c.t) // 3
    c.tau[a : a + int(length), j] = c.tau[a, j]
    c.cure = ("held",)


def spike_angle(c, j, by):
    c.q[len(c.t) // 2, j] += by
    c.cure = ("remove",)


def spike_force(c, j, by):
    a = len(c.t) // 2
    c.tau[a : a + 20, j] += by * np.abs(c.tau[:, j]).max()
    c.cure = ("remove",)


def saturated(c, j, share):
    top = np.quantile(np.abs(c.tau[:, j]), share)
    c.tau[:, j] = np.clip(c.tau[:, j], -top, top)
    c.cure = ("limit",)


def without(term):
    def change(c, j, _):
        c.key(term, "false")
        if term == "coulomb":
            c.edits.append((r"(?m)^\[model.coulomb\]$(?s:.*?)(?=^\[)", ""))

    return change


def gravity(*g):
    def change(c, j, _):
        c.key("gravity", str(list(g)))
        c.cure = ("gravity",)

    return change


def axis(c, j, _):
    c.joint(j, r'axis xyz="([^ ]+) ([^ ]+) ([^ ]+)"', r'axis xyz="\3 \1 \2"')
    c.cure = (f"axis of joint `{{{j}}}`",)


def mirrored(c, j, _):
    def turned(found):
        return 'axis xyz="{}"'.format(
            " ".join(f"{-float(x):g}" for x in found[1].split())
        )

    c.joint(j, r'axis xyz="([^"]*)"', turned)
    c.cure = (f"axis of joint `{{{j}}}`",)


def longer(c, j, by):
    def moved(found):
        x, y, z = map(float, found[1].split())
        return f'xyz="{x + by:g} {y:g} {z:g}"'

    c.joint(j, r'(?<=origin )xyz="([^"]*)"|(?<=")xyz="([^"]*)"', moved)


def other_kind(c, j, _):
    kind = "prismatic" if 'type="revolute"' in c.urdf else "revolute"
    c.joint(j, r'type="(revolute|prismatic|continuous)"', f'type="{kind}"')
    c.cure = (f"joint `{{{j}}}` seems to",)


def total_mass(c, j, mass):
    c.key("kind", '"consistent"', "estimator")
    c.edits.append((r'(?m)^kind = "weighted".*$', ""))
    c.edits.append((r"(?m)^nonlinear_friction = .*$", ""))
    c.edits.append((r"(?m)^# total_mass = .*$", f"total_mass = {mass}"))


def mass_max(c, j, mass):
    total_mass(c, j, 1.0)
    c.edits[-1] = (r"(?m)^# mass_max = .*$", f"mass_max = {mass}")


def payload(c, j, mass):
    """Let somebody put a load on the last link in the middle of the log."""
    import pinocchio as pin

    model = pin.buildModelFromXML(c.urdf)
    loaded = model.copy()
    last = loaded.inertias[loaded.njoints - 1]
    loaded.inertias[loaded.njoints - 1] = last + pin.Inertia.FromSphere(mass, 0.05)
    acceleration = np.gradient(c.qd, DT, axis=0)
    for k in range(len(c.t) // 3, len(c.t)):
        motion = c.q[k], c.qd[k], signal_smooth(acceleration)[k]
        c.tau[k] += pin.rnea(loaded, loaded.createData(), *motion)
        c.tau[k] -= pin.rnea(model, model.createData(), *motion)


def signal_smooth(x, hz=20.0):
    """Return a signal without what is fast."""
    return signal.sosfiltfilt(signal.butter(2, hz, fs=1 / DT, output="sos"), x, axis=0)


def contact(c, j, force):
    a = len(c.t) // 3
    c.tau[a : a + 1000] += force * np.abs(c.tau).max(axis=0) * np.hanning(1000)[:, None]


def drift(c, j, by):
    c.tau += by * np.abs(c.tau).max(axis=0) * np.linspace(0, 1, len(c.t))[:, None]


def broad_friction(c, j, epsilon):
    c.key("epsilon", epsilon)


KINDS = {
    "sign of force": (sign_force, "fml", (1,)),
    "sign of angle": (sign_angle, "fml", (1,)),
    "both signs": (both_signs, "fml", (1,)),
    "forces exchanged": (swap("tau"), "fml", (1,)),
    "angles exchanged": (swap("q", "qd"), "fml", (1,)),
    "joints exchanged": (swap("q", "qd", "tau"), "fml", (1,)),
    "gain": (gain, "fml", (2.0, 1.3, 0.5)),
    "offset of angle": (offset, "fml", (1.5708, 0.3, 0.1)),
    "delay of forces": (delay_all, "f", (0.01, 0.02, 0.032)),
    "delay of one force": (delay_one, "fml", (0.02,)),
    "lost rows": (lost_rows, "fm", (0.01, 0.002)),
    "lost stretch": (lost_stretch, "fm", (20, 200)),
    "repeated rows": (repeated_rows, "fm", (0.01, 0.2)),
    "compensated": (compensated, "f", (1,)),
    "filtered": (filtered, "f", (5.0, 15.0)),
    "commanded": (commanded, "f", (1,)),
    "late velocities": (late_velocities, "f", (0.01, 0.03)),
    "wrong velocities": (wrong_velocities, "fl", (2.0, -1.0)),
    "degrees": (degrees, "f", (1,)),
    "unit of force": (millimetre_forces, "f", (1e3, 1e-3)),
    "sample time": (sample_time, "f", (2.0, 1.1, 1e3)),
    "held angle": (held_channel, "fml", (300,)),
    "held force": (held_force, "fml", (300,)),
    "spike of angle": (spike_angle, "fl", (0.05,)),
    "spike of force": (spike_force, "fl", (5.0,)),
    "saturated": (saturated, "fml", (0.9,)),
    "no viscous": (without("viscous"), "f", (1,)),
    "no Coulomb": (without("coulomb"), "f", (1,)),
    "ceiling": (gravity(0.0, 0.0, 9.81), "f", (1,)),
    "wall": (gravity(9.81, 0.0, 0.0), "f", (1,)),
    "other wall": (gravity(0.0, -9.81, 0.0), "f", (1,)),
    "axis": (axis, "fml", (1,)),
    "mirrored axis": (mirrored, "fml", (1,)),
    "longer": (longer, "ml", (0.1, 0.03)),
    "other joint type": (other_kind, "fml", (1,)),
    "total mass": (total_mass, "f", (1.0,)),
    "mass_max": (mass_max, "f", (1e-9,)),
    "payload": (payload, "f", (2.0,)),
    "contact": (contact, "f", (0.2,)),
    "drift": (drift, "f", (0.1,)),
    "epsilon": (broad_friction, "f", (1.0,)),
}
CHANNEL = {
    x
    for x in KINDS
    if x.split()[0] in ("lost", "repeated", "held", "spike", "saturated")
}
"""Kinds that the channels themselves show."""


def cases(n):
    """Yield names, changes, joints and amounts of all mistakes for n joints."""
    for kind, (change, joints, amounts) in KINDS.items():
        for j in dict.fromkeys({"f": 0, "m": n // 2, "l": n - 1}[x] for x in joints):
            for amount in amounts:
                yield kind, change, j, amount


def recorded(urdf, cache, **settings):
    """Return a clean log with measured velocities."""
    if not cache.exists():
        log = closed_loop.simulate(urdf, **settings)
        np.savez(cache, **vars(log))
    with np.load(cache) as log:
        log = {key: log[key] for key in log}
    rate = np.random.default_rng(1).normal(size=log["angles"].shape) * 1e-4
    rate = rate + np.gradient(signal_smooth(log["angles"], 60.0), DT, axis=0)
    return Case(
        log["time"],
        log["angles"],
        rate,
        log["forces"],
        log["commands"],
        urdf.read_text(),
    )


def written(cases, folder):
    """Write the logs of cases; return them and the first case's experiment."""
    import jaxid as jid

    case, paths = cases[0], []
    (folder / "arm.urdf").write_text(case.urdf)
    text = jid.experiment.write_template(folder / "arm.urdf", folder=folder).replace(
        '"time"', '"t"'
    )
    for pattern, replacement in case.edits:
        text, count = re.subn(pattern, replacement, text, count=1)
        if not count:
            raise LookupError(pattern)
    (folder / "e.toml").write_text(text)
    for k, c in enumerate(cases):
        table = {"q": c.q, "dq": c.qd, "tau": c.tau}
        columns = {
            f"{k}{j + 1}": x[:, j] for k, x in table.items() for j in range(x.shape[1])
        }
        paths.append(folder / (f"log{k + 1}.npz" if k else "log.npz"))
        np.savez(paths[-1], t=c.t, **columns)
    return jid.experiment.load_experiment(folder / "e.toml"), paths


def judged(cases, folder):
    """Return the verdict, likely mistakes, and the largest share of missed forces."""
    import jaxid as jid

    experiment, paths = written(cases, folder)
    report = jid.identify_logs(experiment.setup, paths, experiment.columns, 0.4)
    fitted = report.identification
    size = np.fmax(fitted[0].force_rms, 0.01 * np.nan_to_num(fitted[0].max_forces))
    return report.judgement, report, float(np.nanmax(fitted[0].rms / size))


def one(robot, urdf, change, j, amount, folder):
    """Return a case's status, whether a cure is wrong, missed forces and sentences."""
    case = recorded(urdf, folder / f"{robot}.npz")
    names = re.findall(r'<joint name="([^"]*)" type="(?:rev|pris|cont)', case.urdf)
    with contextlib.suppress(LookupError) as _:
        if change is not None:
            change(case, j, amount)
        try:
            remarks, r, missed = judged([case], folder)
        except ValueError as refusal:
            return "refused", False, np.nan, [str(refusal)]
        said = [str(x.text) for x in remarks if x.status.name in ("DOUBTFUL", "BAD")]
        status = remarks[0].status.name
        cures = [x for x in (*r.mistakes,) if "seem" in x]
        cure = [x.format(*names) for x in case.cure]
        wrong = [x for x in cures if not any(word in x for word in cure)]
        return status, bool(wrong), missed, said
    return None


def main():
    """Spoil the logs and print what is said."""
    parser = timing.parser(__doc__, "one robot, one case of each kind")
    parser.add_argument("--robot", nargs="*")
    parser.add_argument("--kind", nargs="*")
    parser.add_argument("--folder", type=Path, help="where simulated logs are kept")
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    timing.pin_to(1)
    import jax

    jax.config.update("jax_enable_x64", True)
    folder = given.folder or Path(tempfile.mkdtemp())
    folder.mkdir(exist_ok=True)
    files = closed_loop.robots(folder)
    chosen = given.robot or (["six"] if given.quick else list(files))
    silent, equal, wrong, alarms = [], [], [], []
    count, began = 0, time.perf_counter()
    for robot in chosen:
        n = len(re.findall(r'type="(?:rev|pris|cont)', files[robot].read_text()))
        every = [("good", None, 0, 1), *cases(n)]
        if given.kind:
            every = [
                x for x in every if x[1] is None or any(k in x[0] for k in given.kind)
            ]
        matters = MATTERS
        for kind, change, j, amount in every:
            found = one(robot, files[robot], change, j, amount, folder)
            if found is None:
                continue
            status, bad_cure, missed, said = found
            label = f"{robot}: {kind}, joint {j + 1}, {amount:g}"
            count += change is not None
            if change is None:
                matters = max(MATTERS, 1.5 * missed)
                if status != "GOOD":
                    alarms.append(label)
            if change is not None and status == "GOOD":
                (silent if missed > matters or CHANNEL & {kind} else equal).append(
                    label
                )
            if bad_cure:
                wrong.append(label)
            if given.show:
                mark = "WRONG CURE" if bad_cure else ""
                print(
                    f"{label:45} {status:9} {missed:.3f} {mark} "
                    f"{' | '.join(said)[:230]}",
                    flush=True,
                )
    print(f"{count} cases, {time.perf_counter() - began:.0f} s")
    print("good logs with a doubt:", *alarms, sep="\n  ")
    print("without a word:", *silent, sep="\n  ")
    print("without a word, and the forces are explained:", *equal, sep="\n  ")
    print("wrong cure:", *wrong, sep="\n  ")
    hand_over(
        [
            Row(
                "spoilt/cures",
                "wrong cures",
                f"{count} cases",
                "0",
                str(len(wrong)),
                not wrong,
            ),
            Row(
                "spoilt/silent",
                "without a word",
                f"{count} cases",
                "0",
                str(len(silent)),
                not silent,
            ),
            Row(
                "spoilt/good",
                "good logs with a doubt",
                "",
                "0",
                str(len(alarms)),
                not alarms,
            ),
        ],
        given.json,
    )


if __name__ == "__main__":
    main()
