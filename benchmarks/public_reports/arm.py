"""An arm of three axes, its logs by Pinocchio, and what `jaxid` makes of a log.

Nothing of the package takes part in the simulation: Pinocchio gives the torques of the
links, NumPy adds friction, rotors and noise. `identified` does what a user does: write
the experiment file of `jaxid init`, set some of its keys, inspect the log, identify.
"""

import dataclasses
import re
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

DT = 0.01
SECONDS = 28.0
VISCOUS, COULOMB, ROTORS, NOISE = 0.5, 0.8, 0.1, 0.05
MIN_SPEED = 0.05
"""Speed below which dry friction is no part of the comparison [rad/s]."""
LINK = """<link name="link{n}"><inertial><origin xyz="{centre}" rpy="{turn}"/>
<mass value="{mass}"/><inertia ixx="{a}" iyy="{b}" izz="{c}" ixy="{d}" ixz="{e}"
iyz="{f}"/></inertial></link>
<joint name="joint{n}" type="revolute"><parent link="{parent}"/>
<child link="link{n}"/><origin xyz="{place}"/><axis xyz="{axis}"/>
<limit lower="-2.6" upper="2.6" velocity="4" effort="90"/></joint>"""
LINKS = (
    ("5.0", "0.02 -0.01 0.1", "0.1 -0.2 0.3", "0 0 0.35", "0 0 1"),
    ("3.5", "0.03 0.02 0.2", "0 0.2 0.1", "0 0.06 0.2", "0 1 0"),
    ("1.8", "0.09 0.01 0.06", "0.3 0 -0.4", "0 0 0.42", "0 1 0"),
)
"""Mass, centre and orientation of each link; place and axis of its joint."""
TENSORS = (
    (0.06, 0.05, 0.03, 0.002, -0.002, 0.004),
    (0.05, 0.06, 0.02, -0.003, 0.002, 0.001),
    (0.008, 0.014, 0.011, 0.001, 0.0005, 0.0),
)


@dataclasses.dataclass
class Log:
    """Samples of a motion: times, angles, velocities, accelerations and torques."""

    t: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    qdd: np.ndarray
    tau: np.ndarray

    def rows(self, rows):
        """Return some of the samples."""
        return Log(*(x[rows] for x in vars(self).values()))

    def table(self, angle="q{}", force="tau{}", time="time"):
        """Return the columns of times, angles and torques by their names."""
        columns = {time: self.t}
        for name, values in ((angle, self.q), (force, self.tau)):
            columns |= {name.format(j + 1): x for j, x in enumerate(values.T)}
        return columns


def urdf():
    """Return the description of the arm."""
    parts = ['<robot name="arm">', '<link name="link0"/>']
    for n, (link, tensor) in enumerate(zip(LINKS, TENSORS, strict=True), 1):
        words = dict(
            zip(("mass", "centre", "turn", "place", "axis"), link, strict=True)
        )
        words |= dict(zip("abcdef", tensor, strict=True))
        parts.append(LINK.format(n=n, parent=f"link{n - 1}", **words))
    return "\n".join([*parts, "</robot>"])


def motion(seed, seconds=SECONDS, dt=DT):
    """Return times, angles, velocities and accelerations of a sum of five sines."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, dt)
    w = 0.55 * np.arange(1, 6) * (1 + 0.2 * random.random((3, 5)))
    sizes = random.uniform(0.4, 1.0, (3, 5)) / np.arange(1, 6)
    phase = t[:, None, None] * w + random.uniform(0, 2 * np.pi, (3, 5))
    q = np.sum(sizes * np.sin(phase), axis=-1)
    scale = 1.4 / np.abs(q).max(axis=0)
    qd = np.sum(sizes * w * np.cos(phase), axis=-1)
    qdd = np.sum(-sizes * w**2 * np.sin(phase), axis=-1)
    return t, scale * q, scale * qd, scale * qdd


def simulate(seed=0, noise=NOISE, draw=0, **settings):
    """Return a log of the arm: torques of Pinocchio, friction, rotors and noise.

    The `seed` is that of the motion, `draw` that of the noise.
    """
    t, q, qd, qdd = motion(seed, **settings)
    model = pin.buildModelFromXML(urdf())
    data = model.createData()
    tau = np.array([pin.rnea(model, data, *x) for x in zip(q, qd, qdd, strict=True)])
    tau += VISCOUS * qd + COULOMB * np.tanh(qd / 0.01) + ROTORS * qdd
    tau += noise * np.random.default_rng(seed + 1000 + draw).normal(size=tau.shape)
    return Log(t, q, qd, qdd, tau)


class Outcome(NamedTuple):
    """What a user gets.

    Attributes:
        error: Relative error of the torques on another motion, RMS of the joints; None
            if the log is refused.
        words: The refusal; or all doubts about the log and the model, and the notes.
        is_doubted: Whether the log is refused, or there is any doubt.
    """

    error: float | None
    words: list[str]
    is_doubted: bool


def experiment_text(folder, keys):
    """Return the experiment file of `jaxid init` with some keys set; None: left out."""
    import jaxid as jid

    (folder / "arm.urdf").write_text(urdf())
    text = jid.experiment.write_template(folder / "arm.urdf", folder=folder)
    # Keys that several tables have are those of `[recording]`.
    head, mark, tail = text.partition("[recording]")
    for key, value in keys.items():
        line = f"# {key} = 0" if value is None else f"{key} = {value}"
        pattern = re.compile(rf"(?m)^(# )?{key} = .*$")
        if pattern.search(tail):
            tail = pattern.sub(line, tail, count=1)
        elif pattern.search(head):
            head = pattern.sub(line, head, count=1)
        else:
            raise LookupError(key)
    return head + mark + tail


def identified(logs, keys, folder=None):
    """Inspect and identify logs (functions that write a file in a folder, or paths)."""
    import jaxid as jid

    folder = Path(tempfile.mkdtemp()) if folder is None else folder
    (folder / "e.toml").write_text(experiment_text(folder, keys))
    try:
        experiment = jid.experiment.load_experiment(folder / "e.toml")
        columns = experiment.require_columns(logs)
        inspection = jid.workflow.inspect_logs(experiment.setup, logs, columns)
        report = jid.identify_logs(experiment.setup, logs, columns)
    except jid.InputError as refusal:
        return Outcome(None, [str(refusal)], True)
    findings = [x for log, _ in inspection.logs for x in log.findings]
    notes = [x for log, _ in inspection.logs for x in (*log.log.notes, *log.notes)]
    doubts = [
        str(x.text)
        for x in report.judgement.findings
        if x.status.name in ("DOUBTFUL", "BAD") and "not validated" not in str(x.text)
    ]
    doubts += [text for text in findings if text not in doubts]
    notes += [text for text in report.fit.notes if text not in notes]
    return Outcome(error(report.fit), [*doubts, *notes], bool(doubts))


def error(fit):
    """Return the relative error of a model's torques on another motion."""
    import jaxid as jid

    unseen = simulate(seed=7, noise=0.0)
    is_moving = np.all(np.abs(unseen.qd) > MIN_SPEED, axis=1)
    unseen = unseen.rows(is_moving)
    predicted = np.asarray(fit.predict(jid.Motion(unseen.q, unseen.qd, unseen.qdd)))
    size = np.linalg.norm(unseen.tau, axis=0)
    errors = np.linalg.norm(predicted - unseen.tau, axis=0) / size
    return float(np.sqrt(np.mean(errors**2)))
