"""Logs of robots under closed-loop control, simulated by Pinocchio alone.

Nothing of the package takes part: Pinocchio integrates the motion, NumPy adds friction,
servo, disturbances and sensors. `robots` lists robots of many kinds, `simulate` moves
one of them.
"""

import dataclasses
from pathlib import Path

import cmeel
import numpy as np
import pinocchio as pin
from scipy import signal

LINK = """<link name="{name}"><inertial><origin xyz="{x} {y} {z}"/><mass value="{m}"/>
<inertia ixx="{a}" ixy="0.001" ixz="0" iyy="{b}" iyz="0.002" izz="{c}"/>
</inertial></link>"""
JOINT = """<joint name="{name}" type="{kind}">
<parent link="{parent}"/><child link="{child}"/>
<origin xyz="{xyz}"/><axis xyz="{axis}"/>
<limit lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"/></joint>"""
KINDS = {
    "scara": [
        ("revolute", "0 0 0.4", "0 0 1", 12.0),
        ("revolute", "0.4 0 0", "0 0 1", 6.0),
        ("prismatic", "0.35 0 0", "0 0 1", 2.0),
        ("revolute", "0 0 -0.2", "0 0 1", 0.8),
    ],
    "gantry": [
        ("prismatic", "0 0 1", "1 0 0", 40.0),
        ("prismatic", "0 0 0", "0 1 0", 20.0),
        ("prismatic", "0 0 0", "0 0 1", 8.0),
        ("revolute", "0 0 -0.3", "0 1 0", 2.0),
    ],
    "pendulum": [
        ("revolute", "0 0 1", "0 1 0", 3.0),
        ("revolute", "0 0 -0.5", "0 1 0", 2.0),
    ],
    "turntable": [
        ("revolute", "0 0 0.1", "0 0 1", 20.0),
        ("revolute", "0 0 0.3", "1 0 0", 6.0),
    ],
    "planar": [
        ("revolute", "0 0 0", "0 0 1", 5.0),
        ("revolute", "0.5 0 0", "0 0 1", 3.0),
        ("revolute", "0.4 0 0", "0 0 1", 1.5),
    ],
    "four": [
        ("revolute", "0 0 0.4", "0 0 1", 20.0),
        ("revolute", "0.15 0 0", "0 1 0", 12.0),
        ("revolute", "0 0 0.6", "0 1 0", 8.0),
        ("revolute", "0.6 0 0", "1 0 0", 2.0),
    ],
    "five": [
        ("revolute", "0 0 0.2", "0 0 1", 4.0),
        ("revolute", "0 0 0.1", "0 1 0", 2.5),
        ("revolute", "0.3 0 0", "0 1 0", 1.5),
        ("revolute", "0.25 0 0", "0 1 0", 0.7),
        ("revolute", "0.05 0 0", "1 0 0", 0.3),
    ],
    "vertical": [
        ("revolute", "0 0 0.2", "0 0 1", 10.0),
        ("revolute", "0.4 0 0", "0 0 1", 6.0),
        ("revolute", "0.4 0 0.1", "0 0 1", 4.0),
        ("revolute", "0.2 0 0", "0 0 1", 1.0),
    ],
    "six": [
        ("revolute", "0 0 0.3", "0 0 1", 14.0),
        ("revolute", "0.1 0 0", "0 1 0", 10.0),
        ("revolute", "0 0 0.5", "0 1 0", 6.0),
        ("revolute", "0 0 0.4", "0 0 1", 3.0),
        ("revolute", "0 0 0.1", "0 1 0", 1.5),
        ("revolute", "0.1 0 0", "1 0 0", 0.6),
    ],
}


@dataclasses.dataclass(frozen=True)
class Log:
    """Recording of a simulated robot.

    Attributes:
        time: Times [s].
        angles: Measured joint coordinates [rad or m].
        forces: Measured drive forces [N m or N].
        commands: Commanded joint coordinates [rad or m].
        friction: Viscous and Coulomb coefficients of each joint.
    """

    time: np.ndarray
    angles: np.ndarray
    forces: np.ndarray
    commands: np.ndarray
    friction: np.ndarray


def robots(folder):
    """Write robots of many kinds as URDF; return the file of each name."""
    files = {name: Path(folder) / f"{name}.urdf" for name in KINDS}
    for name, joints in KINDS.items():
        files[name].write_text(_urdf(name, joints, [0.0] * len(joints)))
        # Motors are five times as strong as an ideal motion needs, for friction.
        model = pin.buildModelFromUrdf(str(files[name]))
        _, forces, _ = _ideal(model, *reference(model, 10.0, 0.01, 0))
        files[name].write_text(_urdf(name, joints, 5 * np.abs(forces).max(axis=0)))
    data = (
        Path(next(iter(cmeel.__path__))).parent
        / "cmeel.prefix/share/example-robot-data/robots"
    )
    return files | {
        "ur3": data / "ur_description/urdf/ur3_joint_limited_robot.urdf",
        "xarm7": data / "xarm_description/urdf/xarm7.urdf",
    }


def _urdf(name, joints, efforts):
    parts = [f'<robot name="{name}">', '<link name="link0"/>']
    for k, (kind, xyz, axis, m) in enumerate(joints, 1):
        J = 0.02 * m
        turns = kind == "revolute"
        parts += [
            LINK.format(
                name=f"link{k}", x=0.12, y=-0.03, z=0.08, m=m, a=J, b=1.3 * J, c=0.8 * J
            ),
            JOINT.format(
                name=f"joint{k}",
                kind=kind,
                parent=f"link{k - 1}",
                child=f"link{k}",
                xyz=xyz,
                axis=axis,
                low=-2.5 if turns else -0.5,
                high=2.5 if turns else 0.5,
                effort=round(float(efforts[k - 1]), 2),
                speed=3.0 if turns else 1.5,
            ),
        ]
    return "\n".join([*parts, "</robot>"])


def reference(model, seconds, dt, seed, amplitude=0.5, pace=1.0):
    """Return a commanded motion of five harmonics that starts and ends at rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, dt)
    low, high = (
        np.clip(x, -2.5, 2.5)
        for x in (model.lowerPositionLimit, model.upperPositionLimit)
    )
    phases = rng.uniform(0, 2 * np.pi, (model.nv, 5))
    sizes = rng.uniform(0.3, 1.0, (model.nv, 5)) / np.arange(1, 6)
    waves = 0.2 * np.pi * pace * np.arange(1, 6) * (1 + 0.2 * rng.random((model.nv, 1)))
    q = np.einsum("jk,tjk->tj", sizes, np.sin(t[:, None, None] * waves + phases))
    q = q / np.abs(q).max(axis=0) * amplitude * (high - low) / 2 * 0.6
    ramp = np.clip(np.minimum(t, seconds - t) / 0.5, 0, 1)[:, None]
    smooth = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    q = smooth * q
    fastest = np.abs(np.gradient(q, dt, axis=0)).max(axis=0) / (
        0.8 * model.velocityLimit
    )
    return t, (low + high) / 2 + q / np.maximum(fastest, 1.0)


def _ideal(model, t, r):
    """Return velocities and forces of a motion without friction, and accelerations."""
    rd = np.gradient(r, t, axis=0)
    rdd, data = np.gradient(rd, t, axis=0), model.createData()
    forces = [pin.rnea(model, data, *x) for x in zip(r, rd, rdd, strict=True)]
    return rd, np.array(forces), rdd


def simulate(
    urdf,
    *,
    seconds=10.0,
    dt=1e-3,
    seed=0,
    viscous=0.05,
    coulomb=0.04,
    stribeck=0.0,
    epsilon=0.01,
    bandwidth=6.0,
    disturbance=0.0,
    disturbance_hz=5.0,
    noise=0.003,
    bits=17,
    gravity=(0.0, 0.0, -9.81),
    amplitude=0.5,
    pace=1.0,
    friction=None,
    steps=8,
):
    """Simulate a robot that follows a reference by feed-forward and PD control.

    Args:
        urdf: File of the robot.
        seconds: Duration [s].
        dt: Sampling time of controller and log [s].
        seed: Seed of motion and noise.
        viscous: Viscous friction over the RMS force, at the RMS velocity.
        coulomb: Coulomb friction over the RMS force.
        stribeck: Additional friction at low speed, over the RMS force.
        epsilon: Speed at which Coulomb friction is at 76 % [rad/s or m/s].
        bandwidth: Natural frequency of the servo [Hz].
        disturbance: RMS of unknown forces that move the robot, over the RMS force.
        disturbance_hz: Corner frequency of these forces [Hz].
        noise: RMS of white noise of the logged forces, over the RMS force.
        bits: Resolution of the encoders per turn (or metre); None is exact.
        gravity: Gravity that acts on the robot [m/s²].
        amplitude: Used part of the ranges of the joints.
        pace: Frequencies of the motion over those of five harmonics of 10 s.
        friction: Viscous and Coulomb coefficients of each joint, in place of their
            fractions.
        steps: Steps of integration in each sample.
    """
    model = pin.buildModelFromUrdf(str(urdf))
    model.gravity.linear = np.array(gravity)
    data, n = model.createData(), model.nv
    t, r = reference(model, seconds, dt, seed, amplitude, pace)
    rd, ideal, _ = _ideal(model, t, r)
    size = np.sqrt(np.mean(ideal**2, axis=0)) + 1e-3 * np.abs(ideal).max()
    fv, fc, fs = (
        viscous * size / np.sqrt(np.mean(rd**2, axis=0)),
        coulomb * size,
        stribeck * size,
    )
    fv, fc = (fv, fc) if friction is None else friction
    rng = np.random.default_rng(seed + 10**6)
    low = signal.butter(1, disturbance_hz, fs=1 / dt, output="sos")
    unknown = signal.sosfilt(low, rng.standard_normal((len(t), n)), axis=0)
    unknown *= disturbance * size / unknown.std(axis=0)
    w = 2 * np.pi * bandwidth
    q, v, h = r[0].copy(), np.zeros(n), dt / steps
    angles, forces = np.zeros((2, len(t), n))
    for k in range(len(t)):
        angles[k] = q
        M = pin.crba(model, data, r[k])
        servo = M @ (w**2 * (r[k] - q) + 1.4 * w * (rd[k] - v))
        forces[k] = servo + 0.9 * ideal[k] + fc * np.tanh(rd[k] / epsilon)
        for _ in range(steps):
            brake = (fc + fs * np.exp(-((v / 0.05) ** 2))) * np.tanh(
                v / epsilon
            ) + fv * v
            v = v + h * pin.aba(model, data, q, v, forces[k] - brake + unknown[k])
            q = q + h * v
    # The drive holds a force for one sample: the mean around a sample belongs to its
    # angles. The steps of a sample act at their beginnings.
    own = 0.5 + 0.5 / steps
    held = own * forces + (1 - own) * np.vstack([forces[:1], forces[:-1]])
    held = held + noise * size * rng.standard_normal(held.shape)
    if bits is not None:
        turn = np.array(
            [2 * np.pi if "R" in j.shortname() else 1.0 for j in model.joints[1:]]
        )
        angles = np.round(angles / turn * 2**bits) * turn / 2**bits
    return Log(t, angles, held, r, np.array([fv, fc]))


def write_csv(path, log, **columns):
    """Write a log as CSV: `t`, `q1…`, `tau1…`, `cmd1…`, and further columns."""
    named = {"q": log.angles, "tau": log.forces, "cmd": log.commands, **columns}
    header = [
        "t",
        *(f"{k}{j + 1}" for k, x in named.items() for j in range(x.shape[1])),
    ]
    table = np.column_stack([log.time, *named.values()])
    np.savetxt(
        path, table, delimiter=",", header=",".join(header), comments="", fmt="%.9g"
    )
