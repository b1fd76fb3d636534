"""Six-axis force sensors at the wrist and under the base, simulated with MuJoCo.

    python benchmarks/force_sensor.py [--quick] [--json FILE]

Arms of example-robot-data carry a load behind the sensor along random Fourier series
(20 s, 200 Hz). Half of the variance of the sensor's errors is white, half below 2 Hz.
The pipeline: `jid.ZeroPhaseButterworth(10.0)`, every 10th row, default weights; the
log holds angles and wrench. The panda's load is that of the request; the ur5's has less
than half of its mass, and no rule was set on it.
"""

import re
import tempfile
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import numpy as np
import timing
from scipy import signal
from scipy.spatial.transform import Rotation

RATE, DURATION = 200.0, 20.0
WRENCH_NOISE = np.array([0.25, 0.25, 0.35, 0.012, 0.012, 0.008])
"""Standard deviations of the sensor's errors [N, N m]."""
TORQUE_NOISE = 0.1
"""Standard deviation of the white errors of the torques [N m]."""
BIAS = np.array([3.1, -2.2, 6.0, 0.12, -0.3, 0.05])
TURN = np.deg2rad([1.0, -1.0, 2.0])
"""Mounting rotation of the sensor, of 2.4 degrees, as a vector [rad]."""
SHARE = "cmeel.prefix/share/example-robot-data/robots"


class Load(NamedTuple):
    """Body: mass [kg], centre [m], inertia about it (xx, yy, zz, xy, xz, yz)."""

    mass: float
    centre: tuple
    inertia: tuple

    @property
    def parameters(self):
        """Parameters (m, m c, A, B, C, D, E, F) about the origin."""
        c = np.array(self.centre)
        xx, yy, zz, xy, xz, yz = self.inertia
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        tensor = tensor + self.mass * (c @ c * np.eye(3) - np.outer(c, c))
        products = (-tensor[1, 2], -tensor[0, 2], -tensor[0, 1])
        return np.array([self.mass, *(self.mass * c), *np.diag(tensor), *products])


class Arm(NamedTuple):
    """Arm of example-robot-data, its flange, and what it carries."""

    file: str
    flange: str
    removed: str  # body that is taken off the flange; empty if there is none
    load: Load
    start: tuple  # angles in the middle of the motion [rad]
    noise: tuple  # slow errors of the model of each joint [N m]


LOAD = Load(
    1.35, (0.012, -0.02, 0.09), (0.013, 0.0125, 0.0045, 0.0004, -0.0006, 0.0009)
)
OTHER_LOAD = Load(
    0.62, (-0.03, 0.01, 0.055), (0.0011, 0.0016, 0.0012, -0.0001, 0.0002, 0.0001)
)
GRIPPER = Load(0.73, (-0.01, 0.0, 0.03), (0.001, 0.0025, 0.0017, 0.0, 0.0, 0.0))
ARMS = {
    "panda": Arm(
        "panda_description/urdf/panda.urdf",
        "panda_link8",
        "panda_hand",
        LOAD,
        (0.0, -0.3, 0.0, -1.8, 0.0, 1.6, 0.5),
        (0.5, 0.8, 0.5, 0.6, 0.12, 0.12, 0.1),
    ),
    "ur5": Arm(
        "ur_description/urdf/ur5_robot.urdf",
        "tool0",
        "",
        OTHER_LOAD,
        (0.3, -1.2, 1.4, -1.0, -1.2, 0.4),
        (0.8, 0.8, 0.6, 0.15, 0.15, 0.12),
    ),
}


def urdf_of(arm):
    """Return the path of an arm's file."""
    return (
        Path(str(metadata.distribution("example-robot-data").locate_file(SHARE)))
        / arm.file
    )


class Cell:
    """An arm in MuJoCo with a load behind a sensor, and a sensor under its base.

    Wrenches are those that the sensor's arm side exerts on the load side, as MuJoCo
    has them: at rest the force points up.
    """

    def __init__(self, arm, loads, turn=(0.0, 0.0, 0.0)):
        import mujoco

        self.mujoco = mujoco
        text = re.sub(
            r"<(visual|collision)\b.*?</\1>", "", urdf_of(arm).read_text(), flags=re.S
        )
        compiler = (
            '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
        )
        spec = mujoco.MjSpec.from_string(
            text.replace("</robot>", compiler + "</robot>")
        )
        if arm.removed:
            spec.delete(spec.body(arm.removed))
        flange = spec.body(arm.flange)
        quaternion = Rotation.from_rotvec(turn).as_quat(scalar_first=True)
        tool = flange.add_body(name="tool")
        tool.add_site(name="wrist", quat=quaternion)
        for k, load in enumerate(loads):
            body = tool.add_body(name=f"load{k}")
            body.mass, body.ipos, body.fullinertia = (
                load.mass,
                load.centre,
                load.inertia,
            )
            body.explicitinertial = True
        base = spec.worldbody.first_body()
        base.add_site(name="ground")
        for site in ("wrist", "ground"):
            for kind in ("FORCE", "TORQUE"):
                spec.add_sensor(
                    type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
                    objtype=mujoco.mjtObj.mjOBJ_SITE,
                    objname=site,
                    name=f"{site} {kind}",
                )
        self.model = spec.compile()
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
        self.data = mujoco.MjData(self.model)

    def run(self, q, qd, qdd):
        """Return joint torques, and the wrenches at wrist and base."""
        torques, wrenches = np.empty(q.shape), np.empty((len(q), 12))
        data = self.data
        for k in range(len(q)):
            data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
            self.mujoco.mj_inverse(self.model, data)
            torques[k], wrenches[k] = data.qfrc_inverse, data.sensordata
        return torques, wrenches[:, :6], wrenches[:, 6:]


def motion(arm, seed, duration=DURATION, scale=1.0):
    """Return time, angles, velocities and accelerations of a random Fourier series."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1 / RATE)
    w = 2 * np.pi / DURATION * np.arange(1, 8)[:, None]
    a, b = (
        scale * 0.22 * random.normal(size=(2, 7, len(arm.start))) / w**0.5 * w[0] ** 0.5
    )
    s, c = np.sin(w * t[:, None, None]), np.cos(w * t[:, None, None])
    q = arm.start + (a * s + b * (c - 1)).sum(1)
    qd = ((a * c - b * s) * w).sum(1)
    return t, q, qd, (-(a * s + b * c) * w**2).sum(1)


def slow(random, shape):
    """Return noise below 2 Hz of unit size."""
    filter = signal.butter(2, 2.0 / (RATE / 2), output="sos")
    noise = signal.sosfilt(filter, random.normal(size=shape), axis=0)
    return noise / noise.std(0)


def sensor_errors(random, samples):
    """Return errors of a sensor, half of their variance white, half below 2 Hz."""
    shape = (samples, 6)
    return (
        np.sqrt(0.5) * WRENCH_NOISE * (random.normal(size=shape) + slow(random, shape))
    )


def torque_errors(random, arm, samples):
    """Return white errors of the torques and slow ones of the model."""
    shape = (samples, len(arm.start))
    return TORQUE_NOISE * random.normal(size=shape) + arm.noise * slow(random, shape)


class Study:
    """Logs of one arm with its load, fitted many times with new errors."""

    def __init__(self, name, seed=1):
        import jaxid as jid

        terms = jid.terms
        self.arm = ARMS[name]
        file = urdf_of(self.arm)
        self.robot = jid.load_urdf(file, tip=self.arm.flange).with_sensor()
        wrench = (terms.SensorLoad(), terms.SensorBias(), terms.SensorRotation())
        self.base = jid.base_parameters(jid.Model(self.robot, wrench))
        self.plain_base = jid.base_parameters(jid.Model(self.robot, wrench[:2]))
        self.t, *self.motion = motion(self.arm, seed)
        self.torques, self.wrench, _ = Cell(self.arm, [self.arm.load]).run(*self.motion)
        _, self.turned, _ = Cell(self.arm, [self.arm.load], TURN).run(*self.motion)

    def payload(self, base, wrench, random, find_rotation=True):
        """Return the payload of one log."""
        import jaxid as jid

        errors = sensor_errors(random, len(wrench))
        log = jid.Recording.of(
            self.motion[0], None, wrench=wrench + BIAS + errors, time=self.t
        )
        observations = jid.observe(
            log, self.robot, jid.ZeroPhaseButterworth(10.0), jid.Subsample(10)
        )
        if find_rotation:
            base = jid.identify_sensor_rotation(base, observations)
        return jid.identify_payload(None, jid.identify(base, observations))


def figures(study, base, wrench, draws, find_rotation=True):
    """Return errors of many draws: mass, centre, angles; and the coverage."""
    truth = study.arm.load.parameters
    masses, centres, angles, held = [], [], [], []
    for seed in range(draws):
        random = np.random.default_rng(seed)
        payload = study.payload(base, wrench, random, find_rotation)
        masses.append(payload.mass / truth[0] - 1.0)
        centres.append(payload.centre_of_mass - truth[1:4] / truth[0])
        errors = payload.estimate - truth
        held.append(np.abs(errors) <= payload.uncertainty.half_widths())
        sensor = payload.sensor
        true_sensor = np.append(BIAS, TURN)[: len(sensor.values)]
        if find_rotation:
            angles.append(np.rad2deg(sensor.rotation - TURN))
        within = np.abs(sensor.values - true_sensor) <= sensor.uncertainty.half_widths()
        held[-1] = np.append(held[-1], within)
    return {
        "mass": 100 * np.sqrt(np.mean(np.square(masses))),
        "centre": 1e3 * np.sqrt(np.mean(np.square(centres))),
        "angle": np.sqrt(np.mean(np.square(angles))) if angles else np.nan,
        "coverage": 100 * np.mean(held),
    }


def rows_of(name, draws):
    """Return the rows of one arm."""
    study = Study(name)
    load = study.arm.load
    asked = name == "panda"
    plain = figures(study, study.plain_base, study.wrench, draws, False)
    blind = figures(study, study.plain_base, study.turned, max(2, draws // 10), False)
    turned = figures(study, study.base, study.turned, draws)
    recipe = f"{name}, {load.mass} kg, {DURATION:g} s, {draws} draws"
    rows = []
    for key, found in (("straight", plain), ("turned 2.4 degrees", turned)):
        text = (
            f"mass {found['mass']:.2f} %, centre {found['centre']:.2f} mm, coverage "
            f"{found['coverage']:.1f} %"
        )
        if np.isfinite(found["angle"]):
            text += f", rotation {found['angle']:.2f} degrees"
            text += f"; not modelled: centre {blind['centre']:.2f} mm"
        holds = found["mass"] <= 0.4 and found["centre"] <= 0.4
        holds = holds and not found["angle"] > 0.3
        rows.append(
            timing.Row(
                f"wrist {name} {key}",
                f"payload by a wrist sensor, {key} (RMS errors)",
                recipe,
                "<= 0.4 %; <= 0.4 mm; 93 to 97 %; <= 0.3 degrees" if asked else "-",
                text,
                bool(holds and 93 <= found["coverage"] <= 97) if asked else None,
            )
        )
        print(rows[-1].what, recipe, rows[-1].measured, flush=True)
    return rows


def cable_row(name):
    """Return the row of an arm whose cable pulls at the load by 0.1 N m for each rad.

    As `jaxid payload` says it, of one log.
    """
    import jaxid as jid

    study = Study(name)
    pull = 0.1 * np.array([0.7, -0.3, 0.65])
    turns = study.motion[0][:, -1] - study.motion[0][0, -1]
    wrench = study.wrench + BIAS + sensor_errors(np.random.default_rng(0), len(turns))
    wrench[:, 3:] += np.outer(turns, pull)
    with tempfile.TemporaryDirectory() as folder:
        file, log = Path(folder, "e.toml"), Path(folder, "log.csv")
        text = BASE_FILE.format(path=urdf_of(study.arm), tip=study.arm.flange)
        file.write_text(text.replace("under_base = true", ""))
        angles = [f"q{k + 1}" for k in range(len(study.arm.start))]
        header = ",".join(["t", *angles, "fx", "fy", "fz", "tx", "ty", "tz"])
        table = np.column_stack([study.t, study.motion[0], wrench])
        np.savetxt(log, table, delimiter=",", header=header, comments="")
        experiment = jid.experiment.load_experiment(file)
        report = jid.workflow.identify_payload_from_logs(
            experiment.setup, [], [log], experiment.columns, sensor=experiment.sensor
        )
    shift = report.result.centre_of_mass - np.array(study.arm.load.centre)
    words = [x.text.partition(": ")[2] for x in report.findings if "cable" in x.text]
    row = timing.Row(
        f"wrist {name} cable",
        "cable of 0.1 N m for each rad of the last joint: error of the centre",
        f"{name}, {DURATION:g} s, one log",
        "named",
        f"{1e3 * np.linalg.norm(shift):.1f} mm; said: {words or 'nothing'}",
        bool(words),
    )
    print(row.what, row.recipe, row.measured, flush=True)
    return row


BASE_FILE = """
[robot]
urdf = "{path}"
tip = "{tip}"
[recording]
time = "t"
angles = "q{{}}"
[sensor]
wrench = ["fx", "fy", "fz", "tx", "ty", "tz"]
under_base = true
"""


def base_mistakes():
    """Return matrices that turn the wrench under the base into a wrong one, by name."""
    axis = np.array([0.6, -0.5, 0.62]) / np.linalg.norm([0.6, -0.5, 0.62])
    turns = {
        "turned by 2 degrees": Rotation.from_rotvec(np.deg2rad(2.0) * axis),
        "turned by 5 degrees": Rotation.from_rotvec(np.deg2rad(5.0) * axis),
        "turned by 90 degrees": Rotation.from_euler("z", 90.0, degrees=True),
    }
    both = np.eye(2)
    mistakes = {k: np.kron(both, x.as_matrix().T) for k, x in turns.items()}
    mistakes["of opposite sign"] = -np.eye(6)
    mistakes["moments before forces"] = np.kron([[0, 1], [1, 0]], np.eye(3))
    # The origin is 3 cm to the side and 4 cm higher than described.
    mistakes["origin wrong by 5 cm"] = np.eye(6)
    mistakes["origin wrong by 5 cm"][3:, :3] = [
        [0.0, -0.04, 0.03],
        [0.04, 0.0, 0.0],
        [-0.03, 0.0, 0.0],
    ]
    return {"as described": np.eye(6)} | mistakes


def base_rows(name, quick):
    """Return rows of an arm that a sensor under its base identifies, no torques."""
    import jaxid as jid

    arm = ARMS[name]
    cell = Cell(arm, [arm.load])
    t, *known = motion(arm, 1)
    _, _, wrench = cell.run(*known)
    _, *other = motion(arm, 2)
    torques, _, _ = cell.run(*other)
    unseen = jid.Motion(*(np.hstack([np.zeros((len(t), 6)), x]) for x in other))
    noise = sensor_errors(np.random.default_rng(0), len(t))
    angles = [f"q{k + 1}" for k in range(len(arm.start))]
    header = ",".join(["t", *angles, "fx", "fy", "fz", "tx", "ty", "tz"])
    rows = []
    mistakes = list(base_mistakes().items())
    for key, matrix in mistakes[:2] if quick else mistakes:
        with tempfile.TemporaryDirectory() as folder:
            file, log = Path(folder, "e.toml"), Path(folder, "log.csv")
            file.write_text(BASE_FILE.format(path=urdf_of(arm), tip=arm.flange))
            table = [t, known[0], (wrench + BIAS + noise) @ matrix.T]
            np.savetxt(
                log, np.column_stack(table), delimiter=",", header=header, comments=""
            )
            experiment = jid.experiment.load_experiment(file)
            setup, columns = experiment.identification([log])
            report = jid.identify_logs(setup, [log], columns)
        predicted = report.fit.predict(unseen)[:, 6:]
        error = np.sqrt(np.sum((predicted - torques) ** 2) / np.sum(torques**2))
        found = [*report.mistakes, *report.doubts]
        words = "; ".join(x.partition(": ")[2].split(":")[0] for x in found)
        row = timing.Row(
            f"base {name} {key}",
            "torques of another motion by a sensor under the base, error "
            "(RMS over RMS)",
            f"{name}, {DURATION:g} s, no torques in the log, wrench {key}",
            "-",
            f"{100 * error:.2f} %; said: {words or 'nothing'}",
        )
        print(row.what, row.recipe, row.measured, flush=True)
        rows.append(row)
    return rows


def main():
    """Measure both arms."""
    options = timing.parser(__doc__, "3 draws").parse_args()
    timing.pin_to(1)
    draws = 3 if options.quick else 30
    rows = [row for name in ARMS for row in rows_of(name, draws)]
    rows += [cable_row(name) for name in ARMS]
    rows += [row for name in ARMS for row in base_rows(name, options.quick)]
    timing.hand_over(rows, options.json)


if __name__ == "__main__":
    main()
