"""Rollouts: identification from commands and encoders, without torques.

* so101: the SO-101's log (needs ../shared/data), identified on four motions,
  free-running on six others, beside the linear joint and the copied command; joints 1
  to 5 [mrad]; time with compiling.
* pendulum: the double pendulum's four logs, ends of windows of 0.1 and 0.2 s on two
  others, beside the authors' models with their own friction, cf arctan(100 v), and the
  same torques, and beside other methods; the same on the four logs, each left out in
  turn, and on those of the fit.
* coverage: a simulated servo arm of four axes on MuJoCo, 50 Hz, 12 bits, whose servos
  saturate, feed the velocity forward or integrate, or whose friction grows with the
  load; the truth lies in so many of the 95 % intervals.
* gains: the same arm with servos of 1 and 1.6 times the gain.
* confounded: one joint whose logs tell damping and delay, or armature and gain, only
  together.
* quadruped: twelve hung joints on MuJoCo, 30 s at 200 Hz: time, compiled before.
* go2: the Go2's chirp with known gains (needs ../shared/data), identified on the first
  70 %: the rest, gains and damping in their intervals, legs that agree.
* band: one hundred posterior models on MuJoCo; fraction of a held-out motion within
  their band.
* sysid: the SO-101's joint 2, and joints 1 to 5, identified by mujoco.sysid; fifteen
  minutes.
* evolution: the same joint by CMA-ES with the simulator of this package, given the same
  CPU time.

    python benchmarks/rollout.py so101 coverage gains confounded quadruped go2 band
    python benchmarks/rollout.py --quick
"""

import contextlib
import dataclasses
import itertools
import re
import sys
import tempfile
import time
from pathlib import Path

import jax
import mujoco
import numpy as np
import timing
from timing import Row, hand_over
from torque_methods import parameters_by_method

import jaxid as jid

# Otherwise MuJoCo writes its warnings into a file in the working folder.
mujoco.set_mju_user_warning(print)

try:
    import mujoco.sysid as peer
except ImportError:  # older versions of MuJoCo
    peer = None

jax.config.update("jax_enable_x64", True)
DATA = Path(__file__).resolve().parent.parent.parent / "shared" / "data"
SEEN = ("multisine", "chirp_sweep", "friction_gravity", "step_response")
UNSEEN = (
    "actuator_bandwidth",
    "center_workspace",
    "circular_motion",
    "coupled_joints",
    "frequency_sweep",
    "backlash_detection",
)
COMMANDS = jid.Columns(time="time", angles="position{}", forces="command{}")
STEP, ENCODER = 0.00005, 2 * np.pi / 4096
GO2_GAIN, GO2_DAMPING = 20.0, 1.5


def so101_file() -> str:
    found = Path(sys.prefix).glob(
        "lib/python*/site-packages/cmeel.prefix/share/example-robot-data/robots/"
        "so_arm_description/urdf/so101.urdf"
    )
    return str(next(found))


def so101_logs(names) -> list[jid.Recording]:
    return [
        jid.read_recording(DATA / "so101" / f"{name}.csv", COMMANDS) for name in names
    ]


def so101(quick: bool) -> None:
    path = so101_file()
    model = jid.Model(jid.load_urdf(path), (jid.RigidBodies(),))
    bodies = jid.rollout.Bodies(model, jid.robots.urdf_parameters(path))
    start = time.time()
    fit = jid.identify_rollout(so101_logs(SEEN), bodies)
    elapsed = time.time() - start
    print(fit)
    errors = fit.validate(so101_logs(UNSEEN))
    for kind in ("simulated", "linear", "command"):
        print(
            f"{kind:10s}",
            (1e3 * errors.total(kind)[:5]).round(1),
            "mrad, joints 1 to 5",
        )
    print(f"identified in {elapsed:.0f} s")
    held = np.full((700, 6), 0.3)
    held[:100] *= np.linspace(0.0, 1.0, 100)[:, None]
    (path,) = fit.simulate(jid.Recording.of(0 * held, held, sample_time=0.02))
    print(
        "drift while the command holds for 12 s: "
        f"{np.ptp(path[-550:], axis=0).max():.1e} rad"
    )


def authors(number: str) -> dict[str, float]:
    lines = (DATA / "double_pendulum" / f"model_{number}.yml").read_text().splitlines()
    return {
        k: float(v) for k, v in (line.split(": ") for line in lines if ": " in line)
    }


def authors_errors(y: dict[str, float], logs, horizon: float) -> np.ndarray:
    """Simulate windows by an authors' model with relative angles, hanging at zero."""
    errors = []
    for o in logs:
        dt, steps = o.sample_time, round(horizon / o.sample_time)
        edge = o.filter.edge(dt) + round(0.05 / dt)
        starts = np.arange(edge, len(o.motion.q) - edge - steps, round(0.04 / dt))
        x = np.concatenate([o.motion.q[starts], o.motion.qd[starts]], axis=1).T
        for k in range(steps):
            u = [np.asarray(o.forces)[starts + k + i].T for i in (0, 1)]
            mid = 0.5 * (u[0] + u[1])
            k1 = authors_rate(y, x, u[0])
            k2 = authors_rate(y, x + 0.5 * dt * k1, mid)
            k3 = authors_rate(y, x + 0.5 * dt * k2, mid)
            x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + authors_rate(y, x + dt * k3, u[1]))
        errors.append(x[:2].T - o.motion.q[starts + steps])
    return np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))


def authors_rate(y: dict[str, float], x: np.ndarray, u: np.ndarray) -> np.ndarray:
    q1, q2, v1, v2 = x
    c, s, C = np.cos(q2), np.sin(q2), y["m2"] * y["r2"] * y["l1"]
    rotor = y["Ir"]
    m11 = (
        y["I1"]
        + y["I2"]
        + y["m2"] * y["l1"] ** 2
        + 2 * C * c
        + rotor * (1 + y["gr"] ** 2)
    )
    m12, m22 = y["I2"] + C * c - y["gr"] * rotor, y["I2"] + y["gr"] ** 2 * rotor
    weight2 = y["g"] * y["m2"] * y["r2"] * np.sin(q1 + q2)
    weight1 = y["g"] * (y["m1"] * y["r1"] + y["m2"] * y["l1"]) * np.sin(q1) + weight2
    f1, f2 = (
        y[f"b{k}"] * v + y[f"cf{k}"] * np.arctan(100 * v) for k, v in ((1, v1), (2, v2))
    )
    r1 = u[0] - weight1 + C * s * (2 * v1 * v2 + v2**2) - f1
    r2 = u[1] - weight2 - C * s * v1**2 - f2
    det = m11 * m22 - m12**2
    return np.stack([v1, v2, (m22 * r1 - m12 * r2) / det, (m11 * r2 - m12 * r1) / det])


HORIZONS = (0.1, 0.2)


def pendulum(quick: bool) -> None:
    folder = DATA / "double_pendulum"
    robot = jid.load_urdf(folder / "pendubot_model_1.0.urdf")
    friction = jid.ViscousFriction(), jid.CoulombFriction(jid.terms.Tanh(0.1))
    base = jid.base_parameters(
        jid.Model(robot, (jid.RigidBodies(), jid.RotorInertia(), *friction))
    )
    smooth = jid.ZeroPhaseButterworth(12.0)
    for kind in ("con",) if quick else ("con", "meas"):
        columns = jid.Columns(
            time="time", angles="pos_meas{}", forces=f"tau_{kind}{{}}"
        )

        def read(*names, columns=columns):
            logs = [
                jid.read_recording(folder / f"{name}.csv", columns) for name in names
            ]
            return [jid.observe(log, robot, smooth) for log in logs]

        seen, unseen = (
            read("143339", "143524", "143601", "143704"),
            read("143747", "144003"),
        )
        start = time.time()
        plain = jid.rollout.identify_torque_rollout(base, seen)
        print(
            f"tau_{kind}: {time.time() - start:.0f} s; q1 q2 at 0.1 s, at 0.2 s [rad]"
        )
        for n in ("1.0", "1.1", "2.0", "3.0"):
            values = [authors_errors(authors(n), unseen, h) for h in HORIZONS]
            print_errors(f"authors {n}", values)
        bandwidth = 2.0 / plain.horizon
        for word, p in parameters_by_method(base, seen, bandwidth).items():
            print_errors(word, [plain.errors_at(unseen, h, p) for h in HORIZONS])
        print_errors("rollouts", [plain.errors_at(unseen, h) for h in HORIZONS])
        print_errors(
            "rollouts, logs of the fit", [plain.errors_at(seen, h) for h in HORIZONS]
        )
        own = jid.rollout.identify_torque_rollout(base, unseen)
        print_errors(
            "rollouts, fitted to these logs",
            [own.errors_at(unseen, h) for h in HORIZONS],
        )
        squares: dict[str, list] = {}
        for k in range(0 if quick else 4):
            rest = [*seen[:k], *seen[k + 1 :]]
            fit = jid.rollout.identify_torque_rollout(base, rest)
            methods = {**parameters_by_method(base, rest, bandwidth), "rollouts": None}
            for word, p in methods.items():
                errors = [fit.errors_at([seen[k]], h, p) for h in HORIZONS]
                squares.setdefault(word, []).append(np.square(errors))
        for word, values in squares.items():
            print_errors(f"{word}, each left out", np.sqrt(np.mean(values, axis=0)))


def print_errors(word: str, values) -> None:
    print(f"  {word:34s}", np.concatenate(list(values)).round(4), flush=True)


def arm_text(gain: float, stribeck: bool, axes: int = 6, mass: float = 0.15) -> str:
    """Return an arm with links in a row, axes by turns upright and level, as MJCF."""
    text, end = "", ""
    for j in range(axes):
        axis = ("0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")[j % 6]
        loss = 0.0 if stribeck else 0.1 + 0.02 * j
        text += (
            f'<body name="b{j}" pos="{0.12 * (j > 0)} 0 0"><inertial pos="0.06 0 0" '
            f'mass="{mass}" '
            f'diaginertia="2e-4 2e-4 2e-4"/><joint name="j{j}" axis="{axis}" '
            f'armature="{0.04 + 0.004 * j}" damping="{0.6 + 0.05 * j}" '
            f'frictionloss="{loss}" '
            f'solreffriction="{2 * STEP} 1" solimpfriction="0.99 0.9999 0.001"/>'
        )
        end += "</body>"
    servos = "".join(
        f'<position name="j{j}" joint="j{j}" kp="{gain * (12 - j)}"/>'
        for j in range(axes)
    )
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" '
        'integrator="implicitfast"/>'
        f"<worldbody>{text}{end}</worldbody><actuator>{servos}</actuator></mujoco>"
    )


def commanded(seed: int, axes: int, duration: float, rate: float) -> np.ndarray:
    random, t = np.random.default_rng(seed), np.arange(round(duration * rate)) / rate
    q = np.zeros((len(t), axes))
    for f in (0.11, 0.29, 0.63, 1.1, 1.9):
        q += (
            0.25
            / (1 + 2 * f)
            * np.sin(2 * np.pi * (f * t[:, None] + random.uniform(size=axes)))
        )
    return np.clip(t, 0.0, 1.0)[:, None] * q


def drive(
    model, sent: np.ndarray, rate: float, stribeck=False, late=0.01, rounding=ENCODER
):
    """Return the encoders' positions; with Stribeck friction of a narrow smooth sign.

    Each joint may have its own delay: in the step in which a command comes, it counts
    in part.
    """
    data, every = mujoco.MjData(model), round(1 / rate / STEP)
    measured, late = np.zeros_like(sent), np.broadcast_to(late, sent.shape[1:]) / STEP
    samples, steps = np.divmod(late, every)
    edges = np.unique(
        [0, every, *np.floor(steps), *np.minimum(np.floor(steps) + 1, every)]
    )
    joints = np.arange(sent.shape[1])
    old = [np.clip(steps - a, 0.0, 1.0) for a in edges[:-1]]
    for k in range(len(sent)):
        measured[k] = data.qpos
        now, before = (
            sent[np.maximum(0, k - samples.astype(int) - i), joints] for i in (0, 1)
        )
        for share, count in zip(old, np.diff(edges).astype(int), strict=True):
            data.ctrl[:] = share * before + (1.0 - share) * now
            for _ in range(count if stribeck else 0):
                v = data.qvel
                drag = 0.1 + 0.15 * np.exp(-((v / 0.1) ** 2))
                data.qfrc_applied[:] = -np.tanh(v / 5e-4) * drag
                mujoco.mj_step(model, data)
            if not stribeck:
                mujoco.mj_step(model, data, count)
    return rounding * np.round(measured / rounding)


def arm_bodies(text: str) -> jid.rollout.Bodies:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.xml"
        path.write_text(text)
        model = jid.Model(jid.load_mjcf(path), (jid.RigidBodies(),))
        return jid.rollout.Bodies(model, jid.robots.urdf_parameters(path), coupled=True)


def arm_logs(
    seed: int, gain: float = 1.0, stribeck: bool = False, duration: float = 20.0
):
    model = mujoco.MjModel.from_xml_string(arm_text(gain, stribeck))
    sent = [commanded(10 * seed + k, 6, duration, 50.0) for k in range(3)]
    return [
        jid.Recording.of(
            drive(model, x, 50.0, stribeck), x, sample_time=0.02, name=f"log {k}"
        )
        for k, x in enumerate(sent)
    ]


def truth(gain: float, stribeck: bool = False) -> np.ndarray:
    j = np.arange(6)
    K = gain * (12.0 - j)
    symbols = [p.symbol for p in jid.rollout.PARAMETERS]
    x = np.zeros((6, len(symbols)))
    B = (0.6 + 0.05 * j) / K
    # MuJoCo takes damping at the end of its steps: half a step of it acts as inertia.
    values = {"J": (0.04 + 0.004 * j) / K + B * STEP / 2, "B": B, "a": 1 / K}
    values |= {"F": (0.1 + 0.02 * j) / K, "d": np.full(6, 0.01 - STEP / 2)}
    if stribeck:
        values |= {"F": 0.1 / K, "Fs": 0.15 / K, "vs": np.full(6, 0.1)}
    for symbol, value in values.items():
        x[:, symbols.index(symbol)] = value
    return x


def inside(fit, x: np.ndarray) -> list[bool]:
    ends = [
        (c.interval(), float(c.coefficients @ x[c.joint])) for c in fit.combinations
    ]
    return [low <= value <= high for (low, high), value in ends]


SERVO_STEP, SERVO_DELAY, SERVO_MASS = 0.0001, 0.012, 0.25
EFFECTS = {
    "plain": {},
    "saturation": {"um": 0.16},
    "load friction": {"mu": 0.3},
    "feed-forward": {"f": 0.03},
    "PID": {"ki": 2.0},
}
"""Effects of the servos of an arm, by name."""


def servo_positions(sent: np.ndarray, effects: dict[str, float]) -> np.ndarray:
    """Return the encoders' positions of an arm whose servos have effects.

    Servos with a feed-forward get interpolated commands; the others hold them.
    """
    axes = sent.shape[1]
    text = arm_text(1.0, False, axes, SERVO_MASS)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = SERVO_STEP
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    data = mujoco.MjData(model)
    dry_friction = model.dof_frictionloss.copy()
    K = 12.0 - np.arange(axes)
    largest = effects.get("um", 1e3)
    load_friction = effects.get("mu", 0.0)
    feed = effects.get("f", 0.0)
    integral_gain = effects.get("ki", 0.0)

    stride = round(0.02 / SERVO_STEP)
    delay_steps = round(SERVO_DELAY / SERVO_STEP)
    changes = np.vstack([np.diff(sent, axis=0), np.zeros((1, axes))])
    measured = np.zeros_like(sent)
    integral = np.zeros(axes)
    product = np.zeros(axes)
    M = np.zeros((axes, axes))
    for k in range(stride * len(sent)):
        sample, rest = divmod(k, stride)
        if rest == 0:
            measured[sample] = data.qpos
        sample, rest = divmod(max(0, k - delay_steps), stride)
        command = sent[sample]
        rate = np.zeros(axes)
        if feed > 0.0 and k >= delay_steps:
            # Its mean over the step, as that of a held command.
            command = command + (rest + 0.5) / stride * changes[sample]
            rate = changes[sample] / 0.02
        error = command - data.qpos
        # Half of the step's growth before the force, half behind it: the mean.
        half_growth = 0.5 * SERVO_STEP * integral_gain * error
        integral += half_growth
        drive_force = np.clip(error + integral + feed * rate, -largest, largest)
        integral += half_growth
        if load_friction > 0.0:
            mujoco.mj_mulM(model, data, product, data.qacc)
            mujoco.mj_fullM(model, data, M)
            load = data.qfrc_bias + product - np.diag(M) * data.qacc
            model.dof_frictionloss[:] = dry_friction + load_friction * np.abs(load)
        data.qfrc_applied[:] = K * drive_force
        mujoco.mj_step(model, data)
    return ENCODER * np.round(measured / ENCODER)


def servo_truth(effects: dict[str, float]) -> np.ndarray:
    """Return the parameters of the arm whose servos have effects."""
    x = truth(1.0)[:4]
    x[:, INDEX["J"]] += 0.5 * (SERVO_STEP - STEP) * x[:, INDEX["B"]]
    # The last link turns around its own axis: no weight tells its stiffness.
    x[3, INDEX["J"]] += 2e-4 * x[3, INDEX["a"]]
    x[:, INDEX["d"]] = SERVO_DELAY - 0.5 * SERVO_STEP
    for symbol, value in effects.items():
        x[:, INDEX[symbol]] = value
    return x


def coverage(quick: bool) -> None:
    """Count intervals that hold the truth, for each effect of the servos."""
    for name in EFFECTS:
        coverage_with(name, range(2 if quick else 20))


def coverage_with(name: str, seeds) -> None:
    """Count intervals that hold the truth with an effect of the servos."""
    effects = EFFECTS[name]
    bodies = arm_bodies(arm_text(1.0, False, 4, SERVO_MASS))
    x = servo_truth(effects)
    hits: dict[str, list[bool]] = {}
    found = warned = 0
    for seed in seeds:
        sent = [commanded(10 * seed + k, 4, 20.0, 50.0) for k in range(3)]
        logs = [
            jid.Recording.of(
                servo_positions(c, effects), c, sample_time=0.02, name=f"log {k}"
            )
            for k, c in enumerate(sent)
        ]
        fit = jid.identify_rollout(logs, bodies)
        for c, holds in zip(fit.combinations, inside(fit, x), strict=True):
            hits.setdefault(c.name.split()[0], []).append(holds)
        warned += bool(fit.notes)
        found += int(fit.free[:, [INDEX[symbol] for symbol in effects]].sum())
    counts = {symbol: f"{sum(x)} of {len(x)}" for symbol, x in hits.items()}
    everything = [x for values in hits.values() for x in values]
    print(
        f"{name}, draws {min(seeds)} to {max(seeds)}: "
        f"{100 * np.mean(everything):.1f} % "
        f"of {len(everything)} intervals hold ({counts}); the effect is found on "
        f"{found} joints, {warned} draws warn",
        flush=True,
    )


def gains(quick: bool) -> None:
    """Compare armature, damping, friction, delay of two gains, whose ratio is known."""
    agree, bodies = [], arm_bodies(arm_text(1.0, False))
    for seed in range(1 if quick else 8):
        one, other = (
            jid.identify_rollout(arm_logs(seed, g), bodies) for g in (1.0, 1.6)
        )
        second = {(c.joint, c.name): c for c in other.combinations}
        for c in one.combinations:
            if (d := second.get((c.joint, c.name))) is None:
                continue
            ratio = 1.0 if c.name == "d" else 1.6
            spread = np.hypot(c.deviation, ratio * d.deviation)
            agree.append(abs(c.value - ratio * d.value) < 2.0 * spread)
    print(f"two gains: {100 * np.mean(agree):.1f} % of {len(agree)} parameters agree")


def confounded(quick: bool) -> None:
    """Check that the summary merges two parameters that logs tell only together."""
    t, draws = np.arange(500) / 50.0, 5 if quick else 100
    bodies = arm_bodies(arm_text(1.0, False, 1))
    for first, second in (("B", "d"), ("J", "a")):
        named, hits = 0, 0
        for seed in range(draws):
            random, logs = np.random.default_rng(seed), []
            model = mujoco.MjModel.from_xml_string(arm_text(1.0, False, 1))
            for k in range(4):
                # Slow ramps tell one lag; an upright axis has one inertia, no weight.
                sent = (-1) ** k * random.uniform(0.02, 0.05) * t[:, None]
                if second == "a":
                    sent = commanded(10 * seed + k, 1, 10.0, 50.0)
                log = jid.Recording.of(drive(model, sent, 50.0), sent, sample_time=0.02)
                logs.append(log.crop(2.0, 10.0))
            fit = jid.identify_rollout(logs, bodies if second == "a" else None)
            x = truth(1.0)[:1]
            x[:, [p.symbol for p in jid.rollout.PARAMETERS].index("d")] += (
                0.0 if fit.hold else 0.01
            )
            both = [INDEX[first], INDEX[second]]
            for c, holds in zip(fit.combinations, inside(fit, x), strict=True):
                if (c.coefficients[both] != 0.0).all():
                    named, hits = named + 1, hits + holds
                    break
        print(
            f"{first} and {second} merged in {named} of {draws}, intervals hold in "
            f"{hits}"
        )


def quadruped(quick: bool) -> None:
    leg = (
        '<body name="h{k}" pos="0 {k} 0"><inertial pos="0 0 0" mass="0.7" '
        'diaginertia="2e-3 2e-3 '
        '2e-3"/><joint name="h{k}" axis="1 0 0" {j}/><body name="t{k}" pos="0 0.08 '
        '0"><inertial '
        'pos="0 0 -0.1" mass="1" diaginertia="5e-3 5e-3 1e-3"/><joint name="t{k}" '
        'axis="0 1 0" '
        '{j}/><body name="s{k}" pos="0 0 -0.2"><inertial pos="0 0 -0.1" mass="0.2" '
        "diaginertia="
        '"2e-3 2e-3 1e-4"/><joint name="s{k}" axis="0 1 0" {j}/></body></body></body>'
    )
    joint = 'armature="0.01" damping="1" frictionloss="0.3" solreffriction="0.004 1"'
    legs = "".join(leg.format(k=k, j=joint) for k in range(4))
    names = [f"{part}{k}" for k in range(4) for part in "hts"]
    servos = "".join(f'<position joint="{name}" kp="30"/>' for name in names)
    text = (
        f'<mujoco><compiler angle="radian"/><option timestep="{STEP}" '
        'integrator="implicitfast"/>'
        f"<worldbody>{legs}</worldbody><actuator>{servos}</actuator></mujoco>"
    )
    model = mujoco.MjModel.from_xml_string(text)
    sent = commanded(0, 12, 30.0, 200.0)
    log = jid.Recording.of(drive(model, sent, 200.0), sent, sample_time=0.005)
    for word in ("first", "again"):
        start = time.time()
        fit = jid.identify_rollout(log, arm_bodies(text))
        print(f"12 joints, 30 s at 200 Hz, {word}: {time.time() - start:.0f} s")
    print(f"errors {1e3 * fit.validate(log).total().max():.2f} mrad at most")


def go2(quick: bool) -> None:
    """Identify legs whose servos' gains are known from their program."""
    text = (DATA / "go2" / "go2.xml").read_text()
    text = re.sub(r'<mesh [^>]*/>|<geom [^>]*mesh="[^>]*/>', "", text)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "go2.xml"
        path.write_text(text)
        robot = jid.load_mjcf(path, base="base")
        p = jid.robots.urdf_parameters(path, base="base")
    bodies = jid.rollout.Bodies(jid.Model(robot, (jid.RigidBodies(),)), p)
    log = jid.read_recording(DATA / "go2" / "chirp.csv", COMMANDS)
    seen, unseen = log.split(0.7)
    fit, wall, cpu = seconds(lambda: jid.identify_rollout(seen, bodies))
    print(fit)
    print(f"{cpu:.0f} s of the CPU, {wall:.0f} s")
    for kind in ("simulated", "linear", "command"):
        print(f"{kind:10s}", (1e3 * fit.validate(unseen).total(kind)).round(1), "mrad")
    print("windows   ", (1e3 * fit.window_errors(unseen)).round(1), "mrad in 1 s")
    for symbol, value in (("a", 1 / GO2_GAIN), ("B", GO2_DAMPING / GO2_GAIN)):
        # What is merged into the parameter counts with its estimate.
        x = fit.parameters.copy()
        x[:, INDEX[symbol]] = value
        holds = [
            holds
            for c, holds in zip(fit.combinations, inside(fit, x), strict=True)
            if c.name.split()[0] == symbol
        ]
        print(f"{symbol} = {value:g} in {sum(holds)} of {len(holds)} intervals")
    kinds: dict[tuple, list] = {}
    for c in fit.combinations:
        kind = fit.joint_names[c.joint].split("_", 1)[1]
        symbols = tuple(np.flatnonzero(c.coefficients))
        if c.name.split()[0] != "b":
            kinds.setdefault((kind, *symbols), []).append(c)
    agree = []
    for rows in kinds.values():
        for one, other in itertools.combinations(rows, 2):
            half = [0.5 * float(np.ptp(c.interval())) for c in (one, other)]
            change = fit.parameters[one.joint] - fit.parameters[other.joint]
            difference = one.coefficients @ change
            agree.append(abs(difference) <= np.hypot(*half))
    print(f"legs agree in {100 * np.mean(agree):.0f} % of {len(agree)} pairs")


def band(quick: bool) -> None:
    """Compare motions without encoders, whose rounding is wider than the band."""
    text, count = arm_text(1.0, False), 10 if quick else 100
    bodies, sent = arm_bodies(text), commanded(999, 6, 5.0, 50.0)
    true = drive(mujoco.MjModel.from_xml_string(text), sent, 50.0, rounding=1e-12)
    held = []
    for seed in range(1 if quick else 8):
        fit = jid.identify_rollout(arm_logs(seed), bodies)
        options = {"samples": count, "timestep": STEP}
        with tempfile.TemporaryDirectory() as folder:
            files = jid.export.export_servo_mjcf(
                fit, Path(folder) / "arm.xml", **options
            )
            models = [mujoco.MjModel.from_xml_path(str(p)) for p in files[1:]]
        paths = []
        for model in models:
            late, offset = (model.numeric(x).data for x in ("delay", "offset"))
            # Positions follow from a command in MuJoCo's next step: half a step late.
            commands = sent + offset
            paths.append(
                drive(model, commands, 50.0, late=late + STEP / 2, rounding=1e-12)
            )
        low, high = np.quantile(paths, [0.05, 0.95], axis=0)
        held.append(100 * ((low <= true) & (true <= high))[25:].mean())
        print(
            f"a band of {count} models holds {held[-1]:.0f} % of a motion", flush=True
        )
    print(f"in the mean {np.mean(held):.0f} % (90 wanted)")


UNKNOWNS = ("J", "B", "d", "F", "b")
INDEX = {parameter.symbol: k for k, parameter in enumerate(jid.rollout.PARAMETERS)}
START, LOWER, UPPER, SCALE = (
    np.array([getattr(parameter, key) for parameter in jid.rollout.PARAMETERS])
    for key in ("start", "lower", "upper", "scale")
)
LIGHT = 0.02
"""Load, relative to the most loaded joint's, below which a stiffness is frozen."""
STIFF = 'solimpfriction="0.9999 0.9999 0.001"'
PEERS = {
    "its defaults": ("", {}),
    "stiff friction, scaled": (STIFF, {"x_scale": "jac"}),
}
"""Settings of MuJoCo's dry friction and optimiser: its defaults, and the best."""


def seconds(work) -> tuple:
    """Return the result of a call, its wall time and its CPU time [s]."""
    wall, processor = time.perf_counter(), time.process_time()
    found = work()
    return found, time.perf_counter() - wall, time.process_time() - processor


def both_sets(quick: bool, joints=slice(None)) -> list[list[jid.Recording]]:
    """Return the logs of some joints to identify with, and those to judge by."""
    sets = [so101_logs(names) for names in (SEEN, UNSEEN)]
    sets = [[o.crop(0.0, 20.0) for o in logs] if quick else logs for logs in sets]

    def part(o: jid.Recording) -> jid.Recording:
        q, sent = o.angles[:, joints], o.forces[:, joints]
        return jid.Recording.of(q, sent, sample_time=o.sample_time, name=o.name)

    return [[part(o) for o in logs] for logs in sets]


def write(spec, p) -> None:
    """Write an unknown, over the stiffness, into MJCF; the sensor has the delay."""
    value, joint = float(p.value[0]), spec.joint("q")
    if p.name == "B":
        joint.damping = np.array([value, 0.0, 0.0])
    elif p.name == "b":
        spec.actuator("servo").biasprm[0] = value
    elif p.name == "a":
        spec.actuator("load").gainprm[0] = -value
    elif p.name != "d":
        setattr(joint, {"J": "armature", "F": "frictionloss"}[p.name], value)


def peer_sequences(
    simulator: jid.rollout.ServoSimulator, j: int, friction: str
) -> list:
    """Return a joint's motions for the peer; the second control is the load."""
    motion = simulator.motion
    text = (
        '<mujoco><option timestep="0.01" gravity="0 0 0" '
        'integrator="implicitfast"/><worldbody>'
        '<body><inertial pos="0 0 0" mass="1e-3" diaginertia="1e-9 1e-9 1e-9"/><joint '
        'name="q" '
        f'armature="1" {friction}/></body></worldbody><actuator><position '
        'name="servo" joint="q" '
        'kp="1"/><general name="load" joint="q" gainprm="0"/></actuator>'
        '<sensor><jointpos name="q" joint="q"/></sensor></mujoco>'
    )
    spec, found = mujoco.MjSpec.from_string(text), []
    model = spec.compile()
    for k, n in enumerate(motion.lengths):
        t, name = np.arange(n) * float(motion.sample_time[k]), motion.names[k]
        load = sample_loads(simulator)
        sent = np.stack([x[k, j, :n] for x in (motion.sent, load)], axis=1)
        q = np.array(motion.positions[k, j, :n, None])
        first = peer.create_initial_state(
            model, q[0], motion.start[k, j, [1]], np.zeros(0)
        )
        control, sensor = (
            peer.TimeSeries(t, sent),
            peer.TimeSeries.from_names(t, q, model),
        )
        found.append(peer.ModelSequences(name, spec, name, first, control, sensor))
    return found


def sample_loads(simulator: jid.rollout.ServoSimulator) -> np.ndarray:
    """Return the bodies' torques at all samples [motions, joints, samples]."""
    loads = simulator.loads[0][..., :: simulator.steps]
    return np.concatenate([loads, loads[..., -1:]], axis=-1)


def peer_fit(
    simulator: jid.rollout.ServoSimulator, j: int, friction: str, options: dict
):
    """Identify a joint by `mujoco.sysid`: our starts and limits, its objective."""
    p, load = peer.ParameterDict(), np.abs(simulator.loads[0]).max(axis=(0, 2))
    for key in (*UNKNOWNS, "a"):
        start, low, high = (float(x[INDEX[key]]) for x in (START, LOWER, UPPER))
        frozen = key == "a" and not load[j] > LIGHT * load.max()
        start = 0.02 / load[j] if key == "a" and not frozen else start
        p.add(peer.Parameter(key, start, low, high, frozen, write))
    late = peer.SignalTransform()
    late.delay("*", p["d"])
    sequences = peer_sequences(simulator, j, friction)
    residual = peer.build_residual_fn(
        models_sequences=sequences, modify_residual=late.apply
    )
    with contextlib.redirect_stdout(None):
        return peer.optimize(p, residual, verbose=False, **options)[0]


def peer_error(
    p, simulator: jid.rollout.ServoSimulator, j: int, friction: str
) -> float:
    """Return the peer's free-running RMS error over all samples."""
    motion = simulator.motion
    function = peer.build_residual_fn(
        models_sequences=peer_sequences(simulator, j, friction)
    )
    squares = []
    for k, (y,) in enumerate(function(p.as_vector(), p)[1]):
        n = motion.lengths[k]
        t = np.arange(n) * float(motion.sample_time[k]) - p["d"].value[0]
        errors = np.interp(t, y.times, y.data[:, 0]) - motion.positions[k, j, :n]
        squares.append(errors**2)
    return float(np.sqrt(np.concatenate(squares).mean()))


def peer_result(simulators, joints: list[int], friction: str, options: dict) -> tuple:
    """Return the peer's errors [seen or unseen, joints], and its times."""
    errors, times = [], []
    for j in joints:
        p, *own = seconds(lambda j=j: peer_fit(simulators[0], j, friction, options))
        errors.append([peer_error(p, x, j, friction) for x in simulators])
        times.append(own)
    return np.array(errors).T, *np.sum(times, axis=0)


def sysid(quick: bool) -> list[Row]:
    """Compare joint 2 alone; then joints 1 to 5, with the weight of the bodies."""
    if not hasattr(peer, "optimize"):
        print("`mujoco[sysid]` is not installed: skipped")
        return []
    rows = [sysid_row("joint 2", both_sets(quick, [1]))]
    if not quick:
        model = jid.Model(jid.load_urdf(so101_file()), (jid.RigidBodies(),))
        bodies = jid.rollout.Bodies(model, jid.robots.urdf_parameters(so101_file()))
        rows.append(sysid_row("joints 1 to 5", both_sets(quick), bodies))
    return rows


def sysid_row(what: str, sets, bodies=None) -> Row:
    """Compare errors and times; the last of the peer's settings decide."""
    jax.clear_caches()
    joints = list(range(5)) if bodies else [0]
    turns = [seconds(lambda: jid.identify_rollout(sets[0], bodies)) for _ in range(2)]
    (_, *cold), (fit, *warm) = turns
    ours = np.array([fit.validate(x).total()[joints] for x in sets])
    motions = [jid.rollout.ServoMotion.of(x) for x in sets]
    simulators = [jid.rollout.ServoSimulator(x, bodies=bodies) for x in motions]
    seen, unseen = 1e3 * ours.round(5)
    said = f"ours {unseen} mrad (seen {seen}), {warm[0]:.1f} s (CPU {warm[1]:.1f}), "
    said += f"with compiling {cold[0]:.1f} (CPU {cold[1]:.1f})"
    for name, settings in PEERS.items():
        errors, wall, cpu = peer_result(simulators, joints, *settings)
        seen, unseen = 1e3 * errors.round(5)
        said += (
            f"; its, {name}: {unseen} mrad (seen {seen}), {wall:.0f} s (CPU {cpu:.0f}: "
        )
        said += f"{cpu / warm[1]:.1f} times ours, {cpu / cold[1]:.1f} with compiling)"
    recipe = (
        "identified on four motions, free-running on six others; inertia, damping, "
        f"delay, friction, bias{', stiffness by the weight' if bodies else ''}; ours "
        "also tries all other effects; its start that of our table; its steps 10 ms"
    )
    holds = bool((ours[1] <= errors[1]).all() and 10 * warm[1] <= cpu)
    asked = "error <= its, time <= 1/10 of its"
    return Row(
        "sysid", f"SO-101, {what}, against mujoco.sysid", recipe, asked, said, holds
    )


POPULATION = 8
"""Candidates of the strategy, which are simulated as joints of one robot."""


def population_simulator(logs) -> jid.rollout.ServoSimulator:
    """Return a simulator of one joint that moves as often as there are candidates."""
    motion = jid.rollout.ServoMotion.of(logs)
    fields = ("commands", "positions", "counted", "start", "spread")
    copies = {
        name: np.repeat(getattr(motion, name), POPULATION, axis=1) for name in fields
    }
    return jid.rollout.ServoSimulator(dataclasses.replace(motion, **copies), 0.01)


def evolution(quick: bool) -> list[Row]:
    """Compare joint 2 with CMA-ES: its errors after our time and at its end."""
    if (lacking := timing.missing("cma")) is not None:
        print(lacking)
        return []
    sets = both_sets(quick, [1])
    simulators = [population_simulator(logs) for logs in sets]

    def costs(x: np.ndarray, simulator=simulators[0]) -> np.ndarray:
        """Return the mean square error of each candidate."""
        motion = simulator.motion
        path = simulator.positions(x[:, 0], motion.start)
        squares = ((path - motion.positions) * motion.counted) ** 2
        return squares.sum(axis=(0, 2)) / motion.counted[:, 0].sum()

    def errors(x: np.ndarray) -> list[float]:
        candidates = np.tile(x[None, None], (POPULATION, 1, 1))
        return [1e3 * float(np.sqrt(costs(candidates, s)[0])) for s in simulators]

    costs(np.tile(START, (POPULATION, 1, 1)))
    for _ in range(2):  # the first call compiles
        fit, _, budget = seconds(lambda: jid.identify_rollout(sets[0]))
    ours = 1e3 * float(fit.validate(sets[1]).total()[0])
    runs = [strategy(costs, seed, budget) for seed in range(1, 2 if quick else 6)]
    found = np.median([[errors(x) for x in run[0]] for run in runs], axis=0)
    longest = np.median([run[1] for run in runs])
    said = (
        f"unseen: identify_rollout {ours:.2f} mrad in {budget:.1f} s of the CPU, "
        f"CMA-ES then {found[0, 1]:.2f}, at its end {found[1, 1]:.2f} in "
        f"{longest:.0f} s"
    )
    recipe = (
        f"{len(runs)} seeds, medians; same simulator, start, limits, scales; "
        "cma's defaults"
    )
    holds = bool(ours <= found[0, 1])
    what, asked = "SO-101, joint 2, against CMA-ES", "error <= its in our CPU time"
    return [Row("evolution", what, recipe, asked, said, holds)]


def strategy(costs, seed: int, budget: float) -> tuple[list[np.ndarray], float]:
    """Return the best after a CPU time [s] and at the end, and the whole CPU time."""
    import cma

    index = [INDEX[key] for key in UNKNOWNS]
    ends = [((x - START) / SCALE)[index].tolist() for x in (LOWER, UPPER)]
    options = {"seed": seed, "verbose": -9, "bounds": ends, "popsize": POPULATION}
    search = cma.CMAEvolutionStrategy(np.zeros(len(index)), 0.5, options)

    def parameters(z) -> np.ndarray:
        x = np.tile(START, (len(z), 1, 1))
        x[:, 0, index] += SCALE[index] * np.asarray(z)
        return x

    start, best = time.process_time(), []
    while not search.stop():
        candidates = search.ask()
        search.tell(candidates, costs(parameters(candidates)).tolist())
        # The population that ends after the budget still counts.
        if not best and time.process_time() - start > budget:
            best.append(parameters([search.result.xbest])[0, 0])
    final = parameters([search.result.xbest])[0, 0]
    return [*best, final] if best else [final, final], time.process_time() - start


BENCHMARKS = (
    so101,
    pendulum,
    coverage,
    gains,
    confounded,
    quadruped,
    go2,
    band,
    sysid,
    evolution,
)


def main() -> None:
    """Run the parts named, or all."""
    parser = timing.parser(__doc__, "small parts, short logs")
    parser.add_argument(
        "parts", nargs="*", help=", ".join(x.__name__ for x in BENCHMARKS)
    )
    options, rows = parser.parse_args(), []
    for benchmark in BENCHMARKS:
        if not options.parts or benchmark.__name__ in options.parts:
            rows += benchmark(options.quick) or []
    if rows:
        hand_over(rows, options.json)


if __name__ == "__main__":
    main()
