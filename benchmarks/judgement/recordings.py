"""Logs of a machine under closed-loop control, simulated by MuJoCo.

Dry friction is MuJoCo's own constraint, so that joints stick. The servo knows the
bodies of the user's file only. Encoders have a resolution, forces have noise, and
forces that nobody measures move the machine a little.
"""

import dataclasses
from typing import NamedTuple

import mujoco
import numpy as np
from scipy import signal

SAMPLE_TIME = 2e-3
STEPS = 4
"""Steps of integration in each sample."""


@dataclasses.dataclass
class Log:
    """Recording of a machine.

    Attributes:
        time: Times [s].
        angles: Measured joint coordinates [rad or m].
        forces: Measured drive forces [N m or N].
        commands: Commanded joint coordinates [rad or m].
    """

    time: np.ndarray
    angles: np.ndarray
    forces: np.ndarray
    commands: np.ndarray


class Kind(NamedTuple):
    """Kind of recording.

    Attributes:
        motion: "waves", "stops" (from point to point, with pauses), "chirp", "pose"
            (at rest), "one still" (waves, the middle joint at rest) or "in step"
            (waves, the middle joint and the next one move alike).
        seconds: Duration [s].
        pace: Frequencies over the usual ones.
        amplitude: Used share of speeds and ranges.
        stribeck: Further dry friction near rest, over the dry friction.
        friction: Friction over the machine's own.
        load_friction: Dry friction over the force of gravity and inertia.
        presliding: Speed at which dry friction is at 76 %, over the largest speed; zero
            where it is a constraint that sticks.
        bits: Resolution of the encoders per turn or metre.
        noise: RMS of the noise of the forces over their largest ones.
        disturbance: RMS of the unmeasured forces over the largest ones.
        saturation: Largest force of the drives over what the motion needs; zero where
            it is no limit.
        rate: Rows in a second.
    """

    motion: str = "waves"
    seconds: float = 12.0
    pace: float = 1.0
    amplitude: float = 0.8
    stribeck: float = 0.0
    friction: float = 1.0
    load_friction: float = 0.0
    presliding: float = 0.0
    bits: int = 17
    noise: float = 0.003
    disturbance: float = 0.002
    saturation: float = 0.0
    rate: float = 500.0


KINDS = {
    "plain": Kind(),
    "long": Kind(seconds=24.0),
    "slow": Kind(pace=0.4, amplitude=0.6, seconds=24.0),
    "Stribeck": Kind(stribeck=0.5),
    "heavy friction": Kind(friction=4.0),
    "load friction": Kind(load_friction=0.06),
    "smooth friction": Kind(presliding=0.02),
    "pauses": Kind(motion="stops", seconds=20.0),
    "chirp": Kind(motion="chirp", seconds=20.0),
    "13 bits": Kind(bits=13),
    "noisy": Kind(noise=0.02),
    "disturbed": Kind(disturbance=0.01),
    "saturated": Kind(saturation=0.85),
    "100 Hz": Kind(rate=100.0),
}


def reference(machine, kind, seed):
    """Return times and commanded coordinates, velocities and accelerations."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, kind.seconds, SAMPLE_TIME / STEPS)
    spans = machine.model.jnt_range[:, 1]
    joints = len(spans)
    if kind.motion in ("waves", "pose", "one still", "in step"):
        base = 2 * np.pi * 0.1 * kind.pace
        phases = rng.uniform(0, 2 * np.pi, (5, joints))
        sizes = rng.uniform(0.3, 1.0, (5, joints)) / np.arange(1, 6)[:, None]
        angles = np.arange(1, 6)[:, None, None] * base * time[:, None] + phases[:, None]
        q = np.einsum("kj,ktj->tj", sizes, np.sin(angles))
    elif kind.motion == "chirp":
        rates = rng.uniform(0.8, 1.2, joints) * kind.pace
        phase = 2 * np.pi * (0.05 * time + 0.5 * 0.035 * time**2)[:, None] * rates
        q = np.sin(phase + rng.uniform(0, 2 * np.pi, joints))
    else:
        targets = rng.uniform(-1, 1, (int(kind.seconds / 1.5) + 1, joints))
        q = np.zeros((len(time), joints))
        for k, target in enumerate(targets[1:]):
            share = np.clip((time - 1.5 * k) / 1.0, 0, 1)[:, None]
            smooth = share**3 * (10 - 15 * share + 6 * share**2)
            q += (target - targets[k]) * smooth
        q += targets[0]
    q = q - (q.max(axis=0) + q.min(axis=0)) / 2
    ramp = np.clip(time / 1.0, 0, 1)[:, None]
    if kind.motion == "chirp":
        q = q * ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    step = SAMPLE_TIME / STEPS
    speeds = np.abs(np.gradient(q, step, axis=0)).max(axis=0)
    scale = np.minimum(spans / np.abs(q).max(axis=0), machine.max_speeds / speeds)
    acceleration = np.abs(np.gradient(np.gradient(q, step, axis=0), step, axis=0))
    scale = np.minimum(scale, 4.5 * machine.max_speeds / acceleration.max(axis=0))
    q = q * kind.amplitude * scale
    middle = joints // 2
    if kind.motion == "pose":
        q = 0 * q + 0.5 * spans * rng.uniform(-1, 1, joints)
    elif kind.motion == "one still":
        q[:, middle] = q[0, middle]
    elif kind.motion == "in step":
        # The slower of both leads, so that the other one keeps its limits.
        follower = middle - 1
        q[:, follower] = q[:, middle] * min(1.0, spans[follower] / spans[middle])
    velocities = np.gradient(q, step, axis=0)
    return time, q, velocities, np.gradient(velocities, step, axis=0)


def record(machine, kind, seed=0):
    """Record a machine."""
    time, q_ref, v_ref, a_ref = reference(machine, kind, seed)
    rng = np.random.default_rng(seed + 1000)
    model = machine.model
    model.opt.timestep = SAMPLE_TIME / STEPS
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    known = mujoco.MjModel.from_xml_string(machine.file)
    known.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    known_data = mujoco.MjData(known)
    joints = model.nv
    coulomb = kind.friction * machine.coulomb
    viscous = kind.friction * machine.viscous
    model.dof_damping[:] = viscous
    model.dof_frictionloss[:] = 0 if kind.presliding else coulomb
    limits = np.full(joints, np.inf)
    if kind.saturation:
        limits = kind.saturation * _needed(machine, q_ref, v_ref, a_ref)
        limits = limits + coulomb
    inertias = _inertias(known, known_data, q_ref)
    rate = 2 * np.pi * 6.0
    low_pass = signal.butter(1, 5.0, fs=1 / SAMPLE_TIME, output="sos")
    samples = len(time) // STEPS
    unknown = signal.sosfilt(low_pass, rng.normal(size=(samples, joints)), axis=0)
    unknown *= kind.disturbance * machine.max_forces / unknown.std(axis=0)
    angles = np.zeros((samples, joints))
    forces = np.zeros((samples, joints))
    data.qpos[:] = q_ref[0]
    data.qvel[:] = v_ref[0]
    turns = np.where(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE, 2 * np.pi, 1.0)
    lsb = turns / 2**kind.bits
    seen = np.round(data.qpos / lsb) * lsb
    speed = data.qvel.copy()
    for k in range(samples):
        row = k * STEPS
        now = np.round(data.qpos / lsb) * lsb
        angles[k] = now
        # The servo sees the speed through a low-pass of 80 Hz.
        speed += 0.63 * ((now - seen) / SAMPLE_TIME - speed) if k else 0.0
        seen = now
        known_data.qpos[:] = q_ref[row]
        known_data.qvel[:] = v_ref[row]
        known_data.qacc[:] = a_ref[row]
        mujoco.mj_inverse(known, known_data)
        servo = inertias * (
            rate**2 * (q_ref[row] - now) + 1.4 * rate * (v_ref[row] - speed)
        )
        force = known_data.qfrc_inverse + servo
        force += coulomb * np.tanh(v_ref[row] / (0.02 * machine.max_speeds))
        force = np.clip(force, -limits, limits)
        mean_force = np.zeros(joints)
        for _ in range(STEPS):
            applied = force + unknown[k]
            if kind.presliding:
                width = kind.presliding * machine.max_speeds
                applied = applied - coulomb * np.tanh(data.qvel / width)
            else:
                model.dof_frictionloss[:] = coulomb * (
                    1
                    + kind.stribeck
                    * np.exp(-((data.qvel / (0.05 * machine.max_speeds)) ** 2))
                ) + kind.load_friction * np.abs(force)
            data.qfrc_applied[:] = applied
            mujoco.mj_step(model, data)
            mean_force += force / STEPS
        forces[k] = mean_force
    # A force is held during a sample: the mean around a sample belongs to its angles.
    forces = 0.5 * forces + 0.5 * np.vstack([forces[:1], forces[:-1]])
    forces = forces + kind.noise * machine.max_forces * rng.normal(size=forces.shape)
    stride = round(1 / (SAMPLE_TIME * kind.rate))
    rows = slice(0, None, stride)
    times = (time[::STEPS])[:samples]
    commands = q_ref[::STEPS][:samples]
    return Log(times[rows], angles[rows], forces[rows], commands[rows])


def _needed(machine, q, v, a):
    """Return the largest forces that a motion needs without friction."""
    data = mujoco.MjData(machine.model)
    forces = []
    for k in range(0, len(q), 40):
        data.qpos[:] = q[k]
        data.qvel[:] = v[k]
        data.qacc[:] = a[k]
        mujoco.mj_inverse(machine.model, data)
        forces.append(np.abs(data.qfrc_inverse))
    return np.max(forces, axis=0)


def _inertias(model, data, q):
    """Return the largest inertia of each joint over a motion."""
    diagonals = []
    for row in q[:: len(q) // 50]:
        data.qpos[:] = row
        data.qvel[:] = 0
        mujoco.mj_forward(model, data)
        matrix = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, matrix)
        diagonals.append(np.diag(matrix))
    return 1.3 * np.max(diagonals, axis=0)
