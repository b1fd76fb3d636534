"""One mistake in a log or in a user's file, and the words that name it."""

import re
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np
from scipy import signal


class Slip(NamedTuple):
    """Mistake in a log or a file.

    Attributes:
        change: Change of a log and the text of the file, for one joint; returns both.
        words: Words one of which a right sentence contains.
        joints: Which joints it is made in: "first", "middle", "last", or "all".
    """

    change: Callable
    words: tuple[str, ...]
    joints: tuple[str, ...] = ("middle",)


def _log(change):
    """Make a change of a log one of log and file."""

    def both(log, file, joint):
        change(log, joint)
        return log, file

    return both


def _file(change):
    """Make a change of a file one of log and file."""

    def both(log, file, joint):
        return log, change(file, joint)

    return both


def _force_sign(log, joint):
    log.forces[:, joint] *= -1


def _angle_sign(log, joint):
    for angles in (log.angles, log.commands):
        angles[:, joint] *= -1


def _swap(*names):
    def change(log, joint):
        other = joint - 1 if joint else 1
        for name in names:
            values = getattr(log, name)
            values[:, [joint, other]] = values[:, [other, joint]]

    return change


def _gain(factor):
    def change(log, joint):
        log.forces[:, joint] *= factor

    return change


def _ratio(factor):
    def change(log, joint):
        for angles in (log.angles, log.commands):
            angles[:, joint] *= factor

    return change


def _offset(amount):
    def change(log, joint):
        span = np.ptp(log.angles[:, joint])
        shift = amount if span > 0.5 else 0.3 * span * np.sign(amount)
        for angles in (log.angles, log.commands):
            angles[:, joint] += shift

    return change


def _late(seconds, every=True):
    def change(log, joint):
        joints = range(log.forces.shape[1]) if every else [joint]
        for j in joints:
            log.forces[:, j] = np.interp(log.time - seconds, log.time, log.forces[:, j])

    return change


def _low_pass(hertz, every=True):
    def change(log, joint):
        rate = 1 / np.median(np.diff(log.time))
        filter_ = signal.butter(1 if every else 2, hertz / (rate / 2))
        joints = range(log.forces.shape[1]) if every else [joint]
        for j in joints:
            first = log.forces[0, j]
            log.forces[:, j] = first + signal.lfilter(
                *filter_, log.forces[:, j] - first
            )

    return change


def _held(count):
    def change(log, joint):
        log.forces[:, joint] = np.repeat(log.forces[::count, joint], count)[
            : len(log.time)
        ]

    return change


def _degrees(log, joint):
    is_turning = log.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    scales = np.where(is_turning, 180 / np.pi, 1.0)
    log.angles = log.angles * scales
    log.commands = log.commands * scales


def _motor_side(log, joint):
    log.angles *= 100.0
    log.commands = log.commands * 100.0


def _commanded(log, joint):
    log.angles, log.commands = log.commands, log.angles


def _jitter(log, joint):
    rng = np.random.default_rng(0)
    shifted = log.time + 2e-3 * rng.normal(size=len(log.time))
    for x in (log.angles, log.forces):
        x[:] = np.array([np.interp(shifted, log.time, c) for c in x.T]).T


def _lost_rows(log, joint):
    rng = np.random.default_rng(0)
    is_kept = rng.uniform(size=len(log.time)) > 0.015
    step = np.median(np.diff(log.time))
    for name in ("angles", "forces", "commands"):
        setattr(log, name, getattr(log, name)[is_kept])
    log.time = step * np.arange(len(log.angles))


def _doubled_rows(log, joint):
    rng = np.random.default_rng(0)
    repeats = 1 + (rng.uniform(size=len(log.time)) < 0.02)
    step = np.median(np.diff(log.time))
    for name in ("angles", "forces", "commands"):
        setattr(log, name, np.repeat(getattr(log, name), repeats, axis=0))
    log.time = step * np.arange(len(log.angles))


def _contact(log, joint):
    start = 0.6 * log.time[-1]
    is_touching = (log.time > start) & (log.time < start + 0.6)
    size = 1.5 * np.std(log.forces, axis=0)
    log.forces[is_touching, : joint + 1] += size[: joint + 1]


def _without(part):
    def change(log, file, joint):
        model = mujoco.MjModel.from_xml_string(file)
        log.forces -= _prediction(model, log, part)
        return log, file

    return change


def _prediction(model, log, part):
    """Return gravity, or all forces, of the file's bodies along a log."""
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    rate = 1 / np.median(np.diff(log.time))
    filter_ = signal.butter(2, 15 / (rate / 2))
    q = signal.filtfilt(*filter_, log.angles, axis=0)
    v = np.gradient(q, log.time, axis=0)
    a = np.gradient(v, log.time, axis=0)
    forces = np.zeros_like(log.forces)
    for k in range(len(q)):
        data.qpos[:] = q[k]
        data.qvel[:] = 0 if part == "gravity" else v[k]
        data.qacc[:] = 0 if part == "gravity" else a[k]
        mujoco.mj_inverse(model, data)
        forces[k] = data.qfrc_inverse
    return forces


def _true_gravity(log, file, joint):
    """Take the true gravity out: the drive knows its robot."""
    log.forces -= _prediction(log.model, log, "gravity")
    return log, file


def _axis(file, joint):
    def rolled(found):
        x, y, z = found[2].split()
        return f'{found[1]}axis="{z} {x} {y}"'

    name = f'name="joint{joint + 1}"'
    return re.sub(rf'({name}[^>]*?)axis="([^"]*)"', rolled, file)


def _twist(file, joint):
    return re.sub(
        rf'<body name="body{joint + 1}" pos=',
        f'<body name="body{joint + 1}" euler="0.35 0 0" pos=',
        file,
    )


def _longer(file, joint):
    def moved(found):
        x, y, z = map(float, found[1].split())
        size = 0.25 * max(abs(x), abs(y), abs(z))
        return f'<body name="body{joint + 1}" pos="{x + size} {y + size} {z}"'

    return re.sub(rf'<body name="body{joint + 1}" pos="([^"]*)"', moved, file)


def _gravity(vector):
    def change(file, joint):
        option = f'<option gravity="{vector}"/>'
        return file.replace("<worldbody>", f"{option}<worldbody>")

    return change


SLIPS = {
    "force sign": Slip(_log(_force_sign), ("sign of the force", "axis of joint")),
    "force sign, last": Slip(
        _log(_force_sign), ("sign of the force", "axis of joint"), ("last",)
    ),
    "angle sign": Slip(
        _log(_angle_sign),
        ("sign of the angle", "sign of the force or angle", "axis of joint"),
    ),
    "forces exchanged": Slip(_log(_swap("forces")), ("exchanged",)),
    "angles exchanged": Slip(_log(_swap("angles", "commands")), ("exchanged",)),
    "joints exchanged": Slip(
        _log(_swap("angles", "commands", "forces")), ("exchanged",)
    ),
    "gain 1.4": Slip(_log(_gain(1.4)), ("gain",)),
    "gain 2, last": Slip(_log(_gain(2.0)), ("gain",), ("last",)),
    "gain 0.6": Slip(_log(_gain(0.6)), ("gain",)),
    "ratio 1.25": Slip(_log(_ratio(1.25)), ("gear ratio",)),
    "offset 0.2": Slip(_log(_offset(0.2)), ("angle of joint", "turned")),
    "offset 90": Slip(_log(_offset(np.pi / 2)), ("angle of joint", "turned")),
    "late 20 ms": Slip(_log(_late(0.02)), ("late", "low-pass"), ("all",)),
    "late 10 ms": Slip(_log(_late(0.01)), ("late", "low-pass"), ("all",)),
    "one late 20 ms": Slip(_log(_late(0.02, False)), ("later", "low-pass")),
    "low-pass 5 Hz": Slip(_log(_low_pass(5.0)), ("low-pass", "late"), ("all",)),
    "one low-pass 3 Hz": Slip(_log(_low_pass(3.0, False)), ("low-pass", "later")),
    "held 40": Slip(_log(_held(40)), ("low-pass", "later", "held")),
    "degrees": Slip(_log(_degrees), ("deg",), ("all",)),
    "motor side": Slip(_log(_motor_side), ("gears",), ("all",)),
    "commanded": Slip(_log(_commanded), ("`recording.commands` seem",), ("all",)),
    "jitter 2 ms": Slip(_log(_jitter), ("clock", "stamps"), ("all",)),
    "lost rows": Slip(_log(_lost_rows), ("rows",), ("all",)),
    "doubled rows": Slip(_log(_doubled_rows), ("rows",), ("all",)),
    "contact": Slip(_log(_contact), ("touch", "contact", "moment")),
    "gravity taken out": Slip(_true_gravity, ("gravity",), ("all",)),
    "file's gravity taken out": Slip(_without("gravity"), ("gravity",), ("all",)),
    "file's forces taken out": Slip(_without("all"), ("subtracted",), ("all",)),
    "axis": Slip(_file(_axis), ("axis of joint",)),
    "twist 20": Slip(_file(_twist), ("turned", "angle of joint")),
    "length": Slip(_file(_longer), ("place of joint",)),
    "gravity up": Slip(_file(_gravity("0 0 9.81")), ("gravity",), ("all",)),
    "gravity sideways": Slip(_file(_gravity("9.81 0 0")), ("gravity",), ("all",)),
}


def affected_joint(slip, joints):
    """Return the joint in which a slip is made."""
    return {"first": 0, "middle": joints // 2, "last": joints - 1, "all": 0}[
        slip.joints[0]
    ]
