"""A robot on legs, simulated by MuJoCo: what its logs determine, and how well.

A quadruped (Go2 of example-robot-data) stands on MuJoCo's ground. Controllers of its
joint angles move the base, and lift one foot after another. The logs hold angles,
torques, gyroscope, accelerometer, and whether each foot touches the ground: no
attitude, no velocity of the base, and no contact force.

    python benchmarks/floating.py               # some minutes
    python benchmarks/floating.py --quick
"""

import argparse
import re
from pathlib import Path
from typing import Any, NamedTuple

import jax
import mujoco
import numpy as np
import pinocchio as pin
from timing import Row, hand_over

import jaxid as jid

jax.config.update("jax_enable_x64", True)
ROBOTS = Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
STEP = 0.001
PHASE = 8.0  # duration of a phase: all feet stand, or one is lifted [s]
SAMPLE_TIME = 2 * STEP
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
        bodies = np.array(jid.robots.urdf_parameters(ROBOTS / self.path, floating=True))
        values = {"fv": self.damping, "fc": self.friction, "Ia": self.armature}
        rest = [values.get(name[:2], 0.0) for name in model.parameter_names]
        return np.concatenate([bodies, rest[len(bodies) :]])


GO2 = Legged(
    "go2_description/urdf/go2.urdf",
    {f"{leg}_foot": jid.Sphere(0.022) for leg in ("FL", "FR", "RL", "RR")},
    {"hip": 0.0, "thigh": 0.8, "calf": -1.6},
)


def mjcf(robot: Legged, model: pin.Model) -> str:
    """Return the robot on a floor; drives have rotors, viscous and dry friction."""
    data = model.createData()
    pin.computeJointJacobians(model, data, pin.neutral(model))
    drive = (
        f'armature="{robot.armature}" damping="{robot.damping}" '
        f'frictionloss="{robot.friction}"'
    )
    feet = {}
    for number, foot in enumerate(robot.feet):
        frame = model.frames[model.getFrameId(foot)]
        feet[frame.parentJoint] = number, frame.placement.translation

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

    def __init__(self, robot: Legged, model: pin.Model, seed: int, lifts: bool):
        rng = np.random.default_rng(seed)
        self.robot, self.model, self.data = robot, model, model.createData()
        self.lifts = lifts
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
        lifted = phase - 1 if phase and self.lifts else None
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
        if len(leg) == 3:
            return np.array([0.0, 0.35, -0.7])
        return np.array([-0.25, 0.0, 0.0, 0.5, -0.25, 0.0])

    def _step(self, pose: pin.SE3) -> None:
        """Move the legs towards feet that stay on the ground."""
        model, data = self.model, self.data
        pin.computeJointJacobians(model, data, self.q)
        pin.updateFramePlacements(model, data)
        for foot, frame, leg in zip(self.feet, self.frames, self.legs, strict=True):
            wanted = pose.inverse() * foot
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            error = wanted.translation - data.oMf[frame].translation
            J = J[:, leg]
            if len(leg) < 6:
                J = J[:3]
            else:
                R = wanted.rotation @ data.oMf[frame].rotation.T
                error = np.concatenate([error, pin.log3(R)])
            damped = J.T @ J + 1e-6 * np.eye(len(leg))
            self.q[1 + leg] += np.linalg.solve(damped, J.T @ error)


def simulate(
    robot: Legged,
    seed: int,
    seconds: float = 40.0,
    *,
    load: pin.Inertia | None = None,
    lifts: bool = True,
) -> dict[str, np.ndarray]:
    """Return the channels of a log without noise, and how upright the base was."""
    pinned = robot.pinned()
    if load is not None:
        pinned.inertias[1] = pinned.inertias[1] + load
    plan = Plan(robot, robot.pinned(), seed, lifts)
    m = mujoco.MjModel.from_xml_string(mjcf(robot, pinned))
    d = mujoco.MjData(m)
    feet = [m.geom(f"f{number}").id for number in range(len(robot.feet))]
    d.qpos[7:] = plan.stand[7:]
    mujoco.mj_forward(m, d)
    half_height = 0.01 if robot.sole else 0.022
    d.qpos[2] -= min(d.geom_xpos[g, 2] for g in feet) - half_height
    keys = ("angles", "forces", "gyro", "accelerometer", "contact", "up")
    log: dict[str, Any] = {key: [] for key in keys}
    force = np.zeros(6)
    for k in range(round(seconds / STEP)):
        if k % 5 == 0:
            reference = plan(k * STEP)
        torque = (
            robot.stiffness * (reference - d.qpos[7:]) - robot.rate_gain * d.qvel[6:]
        )
        d.ctrl[:] = np.clip(torque, -robot.torque, robot.torque)
        mujoco.mj_step(m, d)
        if k % 2:
            continue
        mujoco.mj_forward(m, d)
        R = d.xmat[1].reshape(3, 3)
        loads = np.zeros(len(feet))
        for number in range(d.ncon):
            for geom in (d.contact[number].geom1, d.contact[number].geom2):
                if geom in feet:
                    mujoco.mj_contactForce(m, d, number, force)
                    loads[feet.index(geom)] += force[0]
        log["angles"].append(d.qpos[7:].copy())
        log["forces"].append(d.ctrl.copy())
        log["gyro"].append(d.qvel[3:6].copy())
        log["accelerometer"].append(R.T @ (d.qacc[:3] - m.opt.gravity))
        log["contact"].append((loads > 2.0).astype(float))
        log["up"].append(R[2, 2])
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
    channels = {key: values for key, values in log.items() if key != "up"}
    if rng is not None:
        for key, size in NOISE.items():
            channels[key] = channels[key] + size * rng.normal(size=log[key].shape)
    return jid.Recording.of(**channels, sample_time=SAMPLE_TIME, name=name)


class Study:
    """Draws of noise on one log, and how well the truth is found."""

    def __init__(self, robot: Legged, log: dict[str, Any], other: dict[str, Any]):
        self.robot, self.log = robot, log
        self.described = robot.load()
        self.base = jid.base_parameters(jid.Model(self.described))
        self.truth = self.base.from_standard(robot.truth(self.base.model))
        total = np.zeros(self.base.model.size)
        total[: 10 * len(self.described.solid_bodies) : 10] = 1.0
        self.total = total[np.array(self.base.indices)]
        unseen = self.observe(recording(other))
        self.unseen = [*jid.RegressionProblem(self.base, [unseen]).chunks()]

    def observe(self, log: jid.Recording) -> jid.Observations:
        """Return the rows of a log, eight for each period of the cut-off."""
        return jid.observe(log, self.described, FILTER, jid.Subsample(6))

    def fit(self, log: jid.Recording) -> jid.Fit:
        """Identify with a log; intervals by leaving out one of sixty blocks."""
        rows = jid.RegressionProblem(self.base, [self.observe(log)], divisions=60)
        return jid.identify(
            self.base, rows, uncertainty=jid.uncertainty.BlockJackknife()
        )

    def draw(self, seed: int) -> jid.Fit:
        """Identify with noise of its own."""
        return self.fit(recording(self.log, np.random.default_rng(seed)))

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
    start = starts[longest] + 500
    flags = log["contact"].copy()
    flags[start : start + 1150, foot] = 0.0
    return log | {"contact": flags}


def quadruped(draws: int, seconds: float) -> list[Row]:
    """Go2: draws of noise, a load on its back, and wrong flags."""
    log, other = simulate(GO2, 1, seconds), simulate(GO2, 2, seconds / 2)
    study = Study(GO2, log, other)
    fits = [study.draw(seed) for seed in range(draws)]
    true_mass = study.total @ study.truth
    masses = np.array([study.mass(fit)[0] for fit in fits])
    errors = [study.torque_error(fit) for fit in fits]
    covers = [
        np.mean(abs(f.parameters - study.truth) < f.uncertainty.half_widths())
        for f in fits
    ]
    agree = [study.legs_agree(fit) for fit in fits]
    print(masses - true_mass, errors, covers, agree, flush=True)

    load = pin.Inertia(0.5, np.array([0.1, 0.02, 0.09]), np.diag([1e-3] * 3))
    loaded = simulate(GO2, 1, seconds, load=load)
    empty, full = fits[0], study.fit(recording(loaded, np.random.default_rng(50)))
    payload = study.mass(full)[0] - study.mass(empty)[0]
    width = np.hypot(study.mass(full)[1], study.mass(empty)[1])
    print("payload", payload, width, flush=True)

    shifted = study.fit(recording(late(log, 0.06), np.random.default_rng(0)))
    ratio = study.torque_error(shifted) / errors[0]
    wrong = recording(in_the_air(log, 0), np.random.default_rng(0))
    spoiled = study.torque_error(study.fit(wrong))
    checked = jid.workflow.check_contacts(study.base, wrong, FILTER)
    repaired = study.torque_error(study.fit(checked.recording))
    named = [text for text in checked.findings if "FL_foot" in text]
    print(ratio, spoiled / errors[0], repaired / errors[0], named, flush=True)
    mass_error = np.abs(masses / true_mass - 1).max()
    torque_error, cover, agreement = np.mean(errors), np.mean(covers), np.mean(agree)
    before, after = spoiled / errors[0], repaired / errors[0]
    values = (
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
            f"{named[:1]}; {before:.1f}, checked {after:.2f}",
            bool(named),
        ),
    )
    recipe = f"floating.py, {draws} draws of {seconds:g} s"
    return [Row("43", f"Go2: {what}", recipe, *rest) for what, *rest in values]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--json")
    options = parser.parse_args()
    draws, seconds = (2, 24.0) if options.quick else (options.draws, 40.0)
    rows = quadruped(draws, seconds)
    hand_over(rows, options.json)
