"""A robot on legs, simulated by MuJoCo: what its logs determine, and how well.

Quadrupeds (Go2 and ANYmal C of example-robot-data) stand on MuJoCo's ground.
Controllers of their joint angles move the base, and lift one foot after another. A
humanoid (G1) balances by whole-body control, shifts its weight and steps in place. The
logs hold angles, torques, gyroscope, accelerometer, and whether each foot touches the
ground: no attitude, no velocity of the base, and no contact force. Every draw has a
motion and a noise of its own; settings are those of `jaxid identify`.

    python benchmarks/floating.py                   # Go2: half an hour
    python benchmarks/floating.py --quick
    python benchmarks/floating.py --lifts           # what each lifted foot tells
    python benchmarks/floating.py --imu             # an IMU that is not as described
    python benchmarks/floating.py --robot G1        # or "ANYmal C"; --all for all
"""

import argparse
import re
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import pinocchio as pin
from balancing import CONTROL_STEPS, Balance
from timing import Row, hand_over

import jaxid as jid

jax.config.update("jax_enable_x64", True)
ROBOTS = Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
STEP = 0.001
PHASE = 8.0  # duration of a phase: all feet stand, or one is lifted [s]
RECORD_STEPS = 4
CONTROL_STEP = 0.005  # cycle of the controllers of the joints [s]
SAMPLE_TIME = RECORD_STEPS * STEP
NOISE = {"angles": 2e-4, "forces": 0.1, "gyro": 0.01, "accelerometer": 0.1}
FILTER = jid.ZeroPhaseButterworth(10.0)


class Legged(NamedTuple):
    """A robot on legs, its drives, and how it stands and moves."""

    path: str
    feet: dict[str, Any]
    pose: dict[str, float]
    armature: float = 0.012
    damping: float = 0.15
    friction: float = 0.2
    stiffness: float = 120.0
    rate_gain: float = 2.5
    torque: float = 40.0
    sway: tuple[float, ...] = (0.01, 0.01, 0.012, 0.06, 0.06, 0.08)
    shift: tuple[float, float] = (0.065, 0.055)
    sole: tuple[float, float, float] | None = None

    def pinned(self) -> pin.Model:
        """Return Pinocchio's free-flyer."""
        text = (ROBOTS / self.path).read_text()
        text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", text)
        return pin.buildModelFromXML(text, pin.JointModelFreeFlyer())

    def load(self) -> jid.Robot:
        """Return the robot as this package reads it."""
        return jid.load_urdf(ROBOTS / self.path, floating=True, contacts=self.feet)

    def truth(self, model: jid.Model) -> np.ndarray:
        """Return the true standard parameters of a model."""
        bodies = np.array(
            jid.robots.urdf_parameters(ROBOTS / self.path, check=False, floating=True)
        )
        values = {"fv": self.damping, "fc": self.friction, "Ia": self.armature}
        rest = [values.get(name[:2], 0.0) for name in model.parameter_names]
        return np.concatenate([bodies, rest[len(bodies) :]])


GO2 = Legged(
    "go2_description/urdf/go2.urdf",
    {f"{leg}_foot": jid.Sphere(0.022) for leg in ("FL", "FR", "RL", "RR")},
    {"hip": 0.0, "thigh": 0.8, "calf": -1.6},
)
ANYMAL = Legged(
    "anymal_c_simple_description/urdf/anymal.urdf",
    {f"{leg}_FOOT": jid.Sphere(0.03) for leg in ("LF", "RF", "LH", "RH")},
    {"F_HFE": 0.7, "F_KFE": -1.2, "H_HFE": -0.7, "H_KFE": 1.2},
    armature=0.1,
    damping=1.0,
    friction=1.5,
    stiffness=600.0,
    rate_gain=15.0,
    torque=150.0,
    sway=(0.02, 0.02, 0.02, 0.06, 0.06, 0.08),
    shift=(0.12, 0.1),
)
G1 = Legged(
    "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    {f"{side}_ankle_roll_link": jid.Sole() for side in ("left", "right")},
    {
        "hip_pitch": -0.45,
        "knee": 0.9,
        "ankle_pitch": -0.45,
        "shoulder_pitch": 0.2,
        "elbow": 0.6,
        "left_shoulder_roll": 0.25,
        "right_shoulder_roll": -0.25,
    },
    armature=0.02,
    damping=0.3,
    friction=0.3,
    stiffness=500.0,
    rate_gain=10.0,
    torque=120.0,
    sole=(0.085, 0.03, 0.01),
)
QUADRUPEDS = {"Go2": GO2, "ANYmal C": ANYMAL}


def mjcf(robot: Legged, model: pin.Model) -> str:
    """Return the robot on a floor; drives have rotors, viscous and dry friction."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    drive = (
        f'armature="{robot.armature}" damping="{robot.damping}" '
        f'frictionloss="{robot.friction}"'
    )
    feet = {}
    for number, contact in enumerate(robot.load().contacts):
        frame = model.frames[model.getFrameId(contact.name)]
        feet[frame.parentJoint] = number, np.array(contact.position)

    def text(values) -> str:
        return " ".join(map(str, np.ravel(values)))

    def body(j: int) -> str:
        place, inertia = model.jointPlacements[j], model.inertias[j]
        q = pin.Quaternion(place.rotation)
        J = inertia.inertia
        moments = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
        parts = [
            f'<body name="b{j}" pos="{text(place.translation)}" '
            f'quat="{q.w} {q.x} {q.y} {q.z}">'
        ]
        if j == 1:
            parts.append("<freejoint/>")
        else:
            column = model.joints[j].idx_v
            axis = pin.getJointJacobian(model, data, j, pin.LOCAL)[3:, column]
            parts.append(f'<joint name="j{j}" axis="{text(axis)}" {drive}/>')
        parts.append(
            f'<inertial pos="{text(inertia.lever)}" mass="{inertia.mass}" '
            f'fullinertia="{text(moments)}"/>'
        )
        if j in feet:
            number, point = feet[j]
            shape = [*robot.feet.values()][number]
            kind = f'type="sphere" size="{getattr(shape, "radius", 0)}"'
            if robot.sole is not None:
                kind = f'type="box" size="{text(robot.sole)}"'
                point = point + np.array([0.035, 0.0, -0.025])
            parts.append(f'<geom name="f{number}" {kind} pos="{text(point)}"/>')
        children = [k for k in range(j + 1, model.njoints) if model.parents[k] == j]
        return "".join([*parts, *map(body, children), "</body>"])

    motors = "".join(f'<motor joint="j{j}"/>' for j in range(2, model.njoints))
    return (
        '<mujoco><compiler balanceinertia="false" boundmass="0"/>'
        f'<option timestep="{STEP}" integrator="implicitfast" impratio="10"/>'
        '<default><geom friction="1" condim="4"/></default>'
        f'<worldbody><geom type="plane" size="5 5 .1"/>{body(1)}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>"
    )


class Plan:
    """Reference of the joints: the base sways, and each foot is lifted in its turn."""

    def __init__(
        self, robot: Legged, model: pin.Model, seed: int, lifted_feet: Sequence[int]
    ):
        rng = np.random.default_rng(seed)
        self.robot, self.model, self.data = robot, model, model.createData()
        self.lifted_feet = lifted_feet
        self.q = pin.neutral(model)
        names = [*model.names][2:]
        for word, angle in robot.pose.items():
            for k, name in enumerate(names):
                if word in name:
                    self.q[7 + k] = angle
        self.stand = self.q.copy()
        self.frames = [model.getFrameId(foot) for foot in robot.feet]
        pin.framesForwardKinematics(model, self.data, self.q)
        self.feet = [self.data.oMf[f].copy() for f in self.frames]
        chains = [model.supports[model.frames[f].parentJoint] for f in self.frames]
        self.legs = [
            np.array([model.joints[j].idx_v for j in [*c] if j > 1]) for c in chains
        ]
        self.others = np.setdiff1d(np.arange(6, model.nv), np.concatenate(self.legs))
        self.frequency = rng.uniform(0.2, 1.6, (6, 4))
        self.phase = rng.uniform(0, 6.3, (6, 4))
        self.leg_frequency = rng.uniform(0.5, 2.5, (model.nv, 4))
        self.leg_phase = rng.uniform(0, 6.3, (model.nv, 4))

    def __call__(self, t: float) -> np.ndarray:
        """Return the angles at a time, a multiple of 5 ms."""
        count = len(self.feet)
        phase = int(t // PHASE) % (count + 1)
        lifted = phase - 1 if phase - 1 in self.lifted_feet else None
        rise = np.sin(np.pi * (t % PHASE) / PHASE) ** 2
        waves = np.sin(2 * np.pi * self.frequency * t + self.phase).sum(1)
        sway = min(1.0, t / 2) * np.array(self.robot.sway) * waves / 1.5
        if lifted is not None:
            sway = 0.3 * sway
            away = -np.sign(self.feet[lifted].translation[:2])
            sway[:2] += away * self.robot.shift * np.clip(1.6 * rise, 0, 1)
        pose = pin.SE3(pin.rpy.rpyToMatrix(*sway[3:]), sway[:3])
        for _ in range(2):
            self._step(pose)
        q = self.q.copy()
        swing = np.sin(2 * np.pi * self.leg_frequency * t + self.leg_phase).sum(1) / 2
        q[7 + self.others - 6] = self.stand[7 + self.others - 6]
        q[7 + self.others - 6] += 0.12 * min(1.0, t / 2) * swing[self.others]
        if lifted is not None:
            leg = self.legs[lifted]
            up = np.clip(4 * (rise - 0.6), 0, 1)
            fold = self._fold(leg)
            q[1 + leg] += up * (fold + 0.22 * swing[leg])
        return q[7:]

    def _fold(self, leg: np.ndarray) -> np.ndarray:
        """Return a step of a leg's joints that lifts its foot."""
        # Knees point forwards or backwards.
        side = -np.sign(self.stand[1 + leg[2]])
        return side * np.array([0.0, 0.35, -0.7])

    def torques(self, d: Any, t: float) -> np.ndarray:
        """Return the torques of the drives, which follow the reference."""
        robot = self.robot
        if round(t / STEP) % 5 == 0:
            self.reference = self(t)
        torque = robot.stiffness * (self.reference - d.qpos[7:])
        torque = torque - robot.rate_gain * d.qvel[6:]
        return np.clip(torque, -robot.torque, robot.torque)

    def _step(self, pose: pin.SE3) -> None:
        """Move the legs towards feet that stay on the ground."""
        model, data = self.model, self.data
        pin.computeJointJacobians(model, data, self.q)
        pin.updateFramePlacements(model, data)
        for foot, frame, leg in zip(self.feet, self.frames, self.legs, strict=True):
            wanted = pose.inverse() * foot
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            error = wanted.translation - data.oMf[frame].translation
            J = J[:3, leg]
            damped = J.T @ J + 1e-6 * np.eye(len(leg))
            self.q[1 + leg] += np.linalg.solve(damped, J.T @ error)


class Designed:
    """Reference of the joints from a designed motion, as a controller takes it."""

    def __init__(self, robot: Legged, motion: Any):
        names = [*robot.pinned().names][2:]
        order = [robot.load().joint_names[6:].index(name) for name in names]
        times = np.arange(0.0, float(motion.duration) + CONTROL_STEP, CONTROL_STEP)
        samples = motion.motion(times)
        self.robot = robot
        self.angles = np.asarray(samples.q)[:, order]
        self.rates = np.asarray(samples.qd)[:, order]
        self.forces = np.asarray(motion.feed_forward(times))[:, order]
        self.stand = np.r_[np.zeros(7), self.angles[0]]

    def torques(self, d: Any, t: float) -> np.ndarray:
        """Return the torques of the drives: forces of the table, and corrections."""
        robot = self.robot
        k = min(int(t / CONTROL_STEP + 1e-6), len(self.angles) - 1)
        torque = self.forces[k] + robot.stiffness * (self.angles[k] - d.qpos[7:])
        torque += robot.rate_gain * (self.rates[k] - d.qvel[6:])
        return np.clip(torque, -robot.torque, robot.torque)


def simulate(
    robot: Legged,
    seed: int,
    seconds: float = 40.0,
    *,
    load: pin.Inertia | None = None,
    lifted_feet: Sequence[int] = range(4),
    motion: Any = None,
) -> dict[str, np.ndarray]:
    """Return the channels of a log without noise, attitude of the base, and feet.

    Torques are those that MuJoCo's actuators applied, at the instants of the angles. A
    `motion` is followed in place of the plan of a seed.
    """
    pinned = robot.pinned()
    if load is not None:
        pinned.inertias[1] = pinned.inertias[1] + load
    plan: Any = None
    if motion is None:
        plan = Plan(robot, robot.pinned(), seed, lifted_feet)
    else:
        plan = Designed(robot, motion)
    m = mujoco.MjModel.from_xml_string(mjcf(robot, pinned))
    d = mujoco.MjData(m)
    feet = [m.geom(f"f{number}").id for number in range(len(robot.feet))]
    d.qpos[7:] = plan.stand[7:]
    mujoco.mj_forward(m, d)
    half_height = m.geom_size[feet[0], 2 if robot.sole else 0]
    d.qpos[2] -= min(d.geom_xpos[g, 2] for g in feet) - half_height
    if robot.sole is not None and motion is None:
        mujoco.mj_forward(m, d)
        plan = Balance(m, d, feet, seed)
    keys = ("angles", "forces", "gyro", "accelerometer", "contact", "up", "feet")
    log: dict[str, Any] = {key: [] for key in keys}
    force = np.zeros(6)
    for k in range(round(seconds / STEP)):
        if k % CONTROL_STEPS == 0 or robot.sole is None:
            d.ctrl[:] = plan.torques(d, k * STEP)
        angles, rates = d.qpos[7:].copy(), d.qvel[3:6].copy()
        mujoco.mj_step(m, d)
        if k % RECORD_STEPS:
            continue
        # Accelerations and forces are those at the begin of the step.
        R = d.xmat[1].reshape(3, 3)
        loads = np.zeros(len(feet))
        for number in range(d.ncon):
            for geom in (d.contact[number].geom1, d.contact[number].geom2):
                if geom in feet:
                    mujoco.mj_contactForce(m, d, number, force)
                    loads[feet.index(geom)] += force[0]
        log["angles"].append(angles)
        log["forces"].append(d.ctrl.copy())
        log["gyro"].append(rates)
        log["accelerometer"].append(R.T @ (d.qacc[:3] - m.opt.gravity))
        log["contact"].append((loads > 2.0).astype(float))
        log["up"].append(R[2, 2])
        log["feet"].append(d.geom_xpos[feet].copy())
    log = {key: np.array(values) for key, values in log.items()}
    # The order of this package's joints.
    names = [*pinned.names][2:]
    order = [names.index(name) for name in robot.load().joint_names[6:]]
    for key in ("angles", "forces"):
        log[key] = log[key][:, order]
    return log


def recording(
    log: dict[str, np.ndarray], rng: Any = None, name: str = "log"
) -> jid.Recording:
    """Return a log as a recording, with noise."""
    channels = {key: values for key, values in log.items() if key not in ("up", "feet")}
    if rng is not None:
        for key, size in NOISE.items():
            channels[key] = channels[key] + size * rng.normal(size=log[key].shape)
    return jid.Recording.of(**channels, sample_time=SAMPLE_TIME, name=name)


DOUBTS = (jid.result_table.Status.BAD, jid.result_table.Status.DOUBTFUL)
COLUMNS = jid.Columns(
    angles="q{}",
    forces="tau{}",
    gyro="gyro{}",
    accelerometer="acc{}",
    contact="contact{}",
    sample_time=SAMPLE_TIME,
)


def write(log: dict[str, np.ndarray], path: Path, seed: int) -> Path:
    """Write a log with noise as a CSV file."""
    noisy = recording(log, np.random.default_rng(seed))
    channels = {
        "q": noisy.angles,
        "tau": noisy.forces,
        "gyro": noisy.base.rates,
        "acc": noisy.base.accelerations,
        "contact": noisy.base.contacts,
    }
    names = [f"{key}{k + 1}" for key, x in channels.items() for k in range(x.shape[1])]
    table = np.column_stack([np.asarray(x) for x in channels.values()])
    np.savetxt(path, table, delimiter=",", header=",".join(names), comments="")
    return path


def humanoid(seconds: float) -> list[Row]:
    """G1: a log of weight shifts and steps, another one for validation."""
    setup = jid.Setup(G1.load())
    with tempfile.TemporaryDirectory() as folder:
        log = write(simulate(G1, 1, seconds), Path(folder) / "log.csv", 1)
        other = write(simulate(G1, 2, seconds / 2), Path(folder) / "other.csv", 2)
        report = jid.identify_logs(setup, [log], COLUMNS, verify=[other])
    print(report, flush=True)
    base, fit = setup.base, report.fit
    total = total_mass_row(base)
    truth = total @ base.from_standard(G1.truth(base.model))
    mass = float(total @ fit.parameters)
    width = 2.0 * float(np.sqrt(total @ fit.uncertainty.covariance @ total))
    error = abs(mass / truth - 1.0)
    worst = max(errors.relative for errors in report.verification)
    recipe = f"floating.py --robot G1, one log of {seconds:g} s"
    return [
        Row(
            "43",
            f"G1: total mass of {truth:.2f} kg",
            recipe,
            "0.3 %",
            f"{mass:.3f} ± {width:.3f} kg, {100 * error:.2f} %",
            error < 3e-3,
        ),
        Row(
            "43",
            "G1: verdict; torque error on another motion",
            recipe,
            "right",
            f"{report.verdict.status.name}; {100 * worst:.1f} %",
            worst < 0.1,
        ),
    ]


def total_mass_row(base: jid.BaseParameters) -> np.ndarray:
    """Return the row that adds up the masses of all bodies."""
    total = np.zeros(base.model.size)
    total[: 10 * len(base.model.robot.solid_bodies) : 10] = 1.0
    return total[np.array(base.indices)]


class Study:
    """Fits with default settings, and how well they find the truth."""

    def __init__(self, robot: Legged, seconds: float):
        self.robot, self.seconds = robot, seconds
        self.setup = jid.Setup(robot.load())
        self.base = self.setup.base
        self.truth = self.base.from_standard(robot.truth(self.base.model))
        self.total = total_mass_row(self.base)
        other = recording(simulate(robot, 1000, seconds / 2))
        unseen = self.setup.observe(other)
        self.unseen = [*jid.RegressionProblem(self.base, [unseen]).chunks()]

    def fit(self, log: jid.Recording) -> jid.Fit:
        """Identify with a log."""
        rows = jid.RegressionProblem(self.base, [self.setup.observe(log)])
        return self.setup.fit(rows)

    def log(self, seed: int, **changes: Any) -> dict[str, np.ndarray]:
        """Return the log of a motion."""
        return simulate(self.robot, seed, self.seconds, **changes)

    def draw(self, seed: int) -> jid.Fit:
        """Identify with a motion and noise of its own."""
        return self.fit(recording(self.log(seed), np.random.default_rng(seed)))

    def coverage(self, fit: jid.Fit) -> float:
        """Return the share of 95 % intervals that hold the truth."""
        errors = abs(fit.parameters - self.truth)
        return float(np.mean(errors < fit.uncertainty.half_widths()))

    def torque_error(self, fit: jid.Fit) -> float:
        """Return the error of the forces of another motion, relative to them (RMS)."""
        errors = forces = 0.0
        for chunk in self.unseen:
            wrong = chunk.residuals(fit.parameters) - chunk.residuals(self.truth)
            errors += np.sum(wrong[chunk.mask] ** 2)
            forces += np.sum(chunk.forces[chunk.mask] ** 2)
        return float(np.sqrt(errors / forces))

    def mass(self, fit: jid.Fit) -> tuple[float, float]:
        """Return the total mass and half its interval [kg]."""
        widths = self.total @ fit.uncertainty.covariance @ self.total
        return float(self.total @ fit.parameters), float(2.0 * np.sqrt(widths))

    def legs_agree(self, fit: jid.Fit) -> float:
        """Return the share of equal parameters of legs that differ within intervals."""
        names, widths = [*self.base.names], fit.uncertainty.half_widths()
        agreements = []
        for symbol in ("fv", "fc", "Ia"):
            for joint in range(3):
                places = [
                    names.index(f"{symbol}{3 * leg + joint + 1}")
                    for leg in range(4)
                    if f"{symbol}{3 * leg + joint + 1}" in names
                ]
                for a in places:
                    for b in places:
                        if a < b:
                            difference = fit.parameters[a] - fit.parameters[b]
                            truth = self.truth[a] - self.truth[b]
                            width = np.hypot(widths[a], widths[b])
                            agreements.append(abs(difference - truth) < width)
        return float(np.mean(agreements))


def lifted_feet_table(name: str, draws: int, seconds: float) -> None:
    """Print which estimates of each leg can be trusted, by the feet that are lifted."""
    study = Study(QUADRUPEDS[name], seconds)
    body_numbers = [int(re.findall(r"[0-9]+", x)[-1]) for x in study.base.names]
    legs = (np.array(body_numbers) + 2) // 3  # the trunk is 0
    print("lifted feet; trusted estimates of trunk and legs; open; total mass")
    for count in range(5):
        for seed in range(1, draws + 1):
            log = study.log(seed, lifted_feet=range(count))
            fit = study.fit(recording(log, np.random.default_rng(seed)))
            is_trusted = np.array([x.name == "GOOD" for x in fit.trust])
            shares = [
                f"{np.sum(is_trusted[legs == leg])}/{np.sum(legs == leg)}"
                for leg in range(5)
            ]
            mass, width = study.mass(fit)
            print(
                f"{count}; {' '.join(shares)}; {len(fit.undetermined)}; "
                f"{mass:.2f} ± {width:.2f} kg",
                flush=True,
            )


def late(log: dict[str, np.ndarray], seconds: float) -> dict[str, np.ndarray]:
    """Return a log whose flags of contact are late."""
    steps = round(seconds / SAMPLE_TIME)
    flags = np.concatenate([log["contact"][:1].repeat(steps, 0), log["contact"]])
    return log | {"contact": flags[: len(log["contact"])]}


def in_the_air(log: dict[str, np.ndarray], foot: int) -> dict[str, np.ndarray]:
    """Return a log in which the longest stance of a foot is called in the air."""
    stands = log["contact"][:, foot] > 0.5
    edges = np.flatnonzero(np.diff(np.r_[0, stands.astype(int), 0]))
    starts, stops = edges[::2], edges[1::2]
    # A part of a stance, as a flag that hangs.
    longest = int(np.argmax(stops - starts))
    start = starts[longest] + round(1.0 / SAMPLE_TIME)
    flags = log["contact"].copy()
    flags[start : start + round(2.3 / SAMPLE_TIME), foot] = 0.0
    return log | {"contact": flags}


def quadruped(name: str, draws: int, seconds: float) -> list[Row]:
    """Draws of motion and noise of a quadruped, a load on its back, and wrong flags."""
    study = Study(QUADRUPEDS[name], seconds)
    fits = [study.draw(seed) for seed in range(1, draws + 1)]
    true_mass = study.total @ study.truth
    masses = np.array([study.mass(fit)[0] for fit in fits])
    errors = [study.torque_error(fit) for fit in fits]
    covers = [study.coverage(fit) for fit in fits]
    agree = [study.legs_agree(fit) for fit in fits]
    print(name, masses - true_mass, errors, covers, agree, flush=True)

    mass_error = np.abs(masses / true_mass - 1).max()
    torque_error, cover, agreement = np.mean(errors), np.mean(covers), np.mean(agree)
    values = [
        (
            "total mass, worst draw",
            "0.1 %",
            f"{100 * mass_error:.2f} %",
            mass_error < 1e-3,
        ),
        (
            "torque error on another motion",
            "0.4 %",
            f"{100 * torque_error:.2f} %",
            torque_error < 4e-3,
        ),
        (
            "coverage of 95 % intervals",
            "92 to 97 %",
            f"{100 * cover:.1f} %",
            0.92 < cover < 0.97,
        ),
        (
            "equal parameters of legs agree",
            "90 %",
            f"{100 * agreement:.0f} %",
            agreement > 0.9,
        ),
    ]
    if name == "Go2":
        values += load_and_flags(study, fits[0], errors[0])
    recipe = f"floating.py, {draws} draws of {seconds:g} s"
    return [Row("43", f"{name}: {what}", recipe, *rest) for what, *rest in values]


class Mounting(NamedTuple):
    """An IMU that is mounted otherwise than described, in the frame of the base."""

    turn: tuple[float, ...] = (0.0, 0.0, 0.0)  # roll, pitch and yaw [deg]
    place: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m]
    gyro_bias: tuple[float, ...] = (0.0, 0.0, 0.0)  # [rad/s]
    accelerometer_bias: tuple[float, ...] = (0.0, 0.0, 0.0)  # [m/s²]

    def measured(self, log: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return a log without noise as this IMU measures it."""
        R = pin.rpy.rpyToMatrix(np.deg2rad(self.turn))
        rates, place = log["gyro"], np.array(self.place)
        changes = np.gradient(rates, SAMPLE_TIME, axis=0)
        accelerations = log["accelerometer"] + np.cross(changes, place)
        accelerations = accelerations + np.cross(rates, np.cross(rates, place))
        gyro = rates @ R + self.gyro_bias
        accelerometer = accelerations @ R + self.accelerometer_bias
        return log | {"gyro": gyro, "accelerometer": accelerometer}


MOUNTINGS = {
    "as described": Mounting(),
    "gyroscope, bias of 0.01 rad/s": Mounting(gyro_bias=(0.006, -0.006, 0.0055)),
    "gyroscope, bias of 0.05 rad/s": Mounting(gyro_bias=(0.03, -0.03, 0.026)),
    "accelerometer, bias of 0.1 m/s²": Mounting(
        accelerometer_bias=(0.06, -0.06, 0.053)
    ),
    "accelerometer, horizontal bias of 0.1 m/s²": Mounting(
        accelerometer_bias=(0.07, -0.07, 0.0)
    ),
    "accelerometer, bias of 0.3 m/s²": Mounting(accelerometer_bias=(0.18, -0.17, 0.17)),
    "turned by 2 degrees": Mounting(turn=(1.2, -1.2, 1.1)),
    "turned by 90 degrees about z": Mounting(turn=(0.0, 0.0, 90.0)),
    "turned by 180 degrees about z": Mounting(turn=(0.0, 0.0, 180.0)),
    "turned by 90 degrees about x": Mounting(turn=(90.0, 0.0, 0.0)),
    "displaced by 5 cm": Mounting(place=(0.03, 0.03, 0.026)),
}


def imu_rows(name: str, seconds: float) -> list[Row]:
    """Return what an IMU costs that is not as described, and what its estimate leaves.

    The estimate is that of `imu_offset = true`.
    """
    study = Study(QUADRUPEDS[name], seconds)
    log = study.log(1)
    rows = []
    for what, mounting in MOUNTINGS.items():
        texts = []
        for imu_offset in (False, True):
            reading = jid.workflow.LogReading(imu_offset=imu_offset)
            setup = jid.Setup(study.base, reading=reading)
            with tempfile.TemporaryDirectory() as folder:
                path = write(mounting.measured(log), Path(folder) / "log.csv", 5)
                report = jid.identify_logs(setup, [path], COLUMNS)
            doubts = [x for x in report.judgement.findings if x.status in DOUBTS]
            named = [x for x in doubts if "IMU" in x.text or "accelerometer" in x.text]
            mass, error = study.mass(report.fit)[0], study.torque_error(report.fit)
            word = "named" if named else "not named"
            texts.append(f"{mass:.3f} kg, {100 * error:.2f} %, {word}")
        recipe = f"floating.py --imu, one log of {seconds:g} s"
        text = f"{texts[0]}; estimated: {texts[1]}"
        print(what, text, flush=True)
        rows.append(
            Row("43", f"{name}: IMU {what}: total mass, error", recipe, "-", text)
        )
    return rows


def load_and_flags(study: Study, empty: jid.Fit, error: float) -> list[tuple]:
    """Return what a load on the back weighs, and what wrong flags do."""
    load = pin.Inertia(0.5, np.array([0.1, 0.02, 0.09]), np.diag([1e-3] * 3))
    loaded = study.log(1, load=load)
    full = study.fit(recording(loaded, np.random.default_rng(50)))
    payload = study.mass(full)[0] - study.mass(empty)[0]
    width = np.hypot(study.mass(full)[1], study.mass(empty)[1])
    print("payload", payload, width, flush=True)

    log = study.log(1)
    shifted = study.fit(recording(late(log, 0.06), np.random.default_rng(1)))
    ratio = study.torque_error(shifted) / error
    wrong = recording(in_the_air(log, 0), np.random.default_rng(1))
    before = study.torque_error(study.fit(wrong)) / error
    checked = jid.workflow.check_contacts(study.base, wrong, study.setup.filter)
    after = study.torque_error(study.fit(checked.recording)) / error
    named = [text for text in checked.findings if "FL_foot" in text]
    print(ratio, before, after, named, flush=True)
    return [
        (
            "0.5 kg on the back, two logs",
            "2 %, covered",
            f"{payload:.3f} ± {width:.3f} kg",
            abs(payload - 0.5) < min(0.01, width),
        ),
        ("flags 60 ms late: ratio of errors", "1.5", f"{ratio:.2f}", ratio < 1.5),
        (
            "a stance called swing: named; ratio of errors",
            "named",
            f"{len(named)} finding; {before:.1f}, checked {after:.2f}",
            bool(named),
        ),
    ]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--robot", default="Go2", choices=[*QUADRUPEDS, "G1"])
    parser.add_argument("--all", action="store_true", help="all robots")
    parser.add_argument("--lifts", action="store_true", help="what each foot tells")
    parser.add_argument("--imu", action="store_true", help="an IMU not as described")
    parser.add_argument("--json")
    options = parser.parse_args()
    draws, seconds = (2, 24.0) if options.quick else (options.draws, 40.0)
    if options.lifts:
        lifted_feet_table(options.robot, min(draws, 2), seconds)
        raise SystemExit
    rows = []
    for name in [*QUADRUPEDS, "G1"] if options.all else [options.robot]:
        if options.imu and name != "G1":
            rows += imu_rows(name, seconds)
        elif name == "G1":
            rows += humanoid(seconds)
        else:
            rows += quadruped(name, draws, seconds)
    hand_over(rows, options.json)
