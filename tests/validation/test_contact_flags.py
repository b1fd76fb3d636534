"""A log of a robot on four legs: wrong flags and signals of the IMU are named."""

import numpy as np
import pinocchio as pin
import pytest

import jaxid as jid
from jaxid.validation.contact_flags import (
    check_contacts,
    imu_findings,
    standing_feet_findings,
)

INERTIAL = """<inertial><mass value="{mass}"/><origin xyz="0.01 0.02 {z}"/>
<inertia ixx="{i}" iyy="{i}" izz="{j}" ixy="0" ixz="0" iyz="0"/></inertial>"""
JOINT = """<joint name="{s}{n}" type="revolute"><parent link="{parent}"/>
<child link="{s}{n}"/><origin xyz="{place}"/><axis xyz="{axis}"/>
<limit lower="-3" upper="3" effort="50" velocity="9"/></joint>
<link name="{s}{n}">{body}</link>"""
FOOT = """<joint name="{s}f" type="fixed"><parent link="{s}3"/><child link="{s}foot"/>
<origin xyz="0 0 -0.2"/></joint><link name="{s}foot"/>"""
LEGS = {"a": "0.2 0.1 0", "b": "0.2 -0.1 0", "c": "-0.2 0.1 0", "d": "-0.2 -0.1 0"}
FEET = [f"{leg}foot" for leg in LEGS]
STEP = 0.01
PHASE = 3.0  # all feet stand, then each is lifted in its turn [s]
FILE = f"""
[robot]
urdf = "dog.urdf"
floating = true
contacts = {{ {", ".join(f"{foot} = 0.0" for foot in FEET)} }}
[recording]
time = "t"
angles = "q{{}}"
forces = "tau{{}}"
gyro = "gyro{{}}"
accelerometer = "acc{{}}"
contact = "contact{{}}"
"""


def urdf() -> str:
    body = INERTIAL.format(mass=0.6, z=-0.08, i=0.004, j=0.001)
    trunk = INERTIAL.format(mass=5, z=0.03, i=0.05, j=0.07)
    parts = [f'<robot name="dog"><link name="trunk">{trunk}</link>']
    for leg, place in LEGS.items():
        parent = "trunk"
        places = (place, "0 0 -0.05", "0 0 -0.2")
        for n, (at, axis) in enumerate(
            zip(places, ("1 0 0", "0 1 0", "0 1 0"), strict=True), 1
        ):
            parts.append(
                JOINT.format(s=leg, n=n, parent=parent, place=at, axis=axis, body=body)
            )
            parent = f"{leg}{n}"
        parts.append(FOOT.format(s=leg))
    return "".join([*parts, "</robot>"])


def log_of(path, seed):
    """Return a log by Pinocchio: any motion, and forces of feet that carry it."""
    model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    data = model.createData()
    frames = [model.getFrameId(foot) for foot in FEET]
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 5 * PHASE, STEP)
    rate = 2 * np.pi * rng.uniform(0.3, 1.3, (18, 3, 1))
    angle = rate * t + rng.uniform(0, 6.3, (18, 3, 1))
    size = np.r_[np.full(3, 0.03), np.full(3, 0.08), np.full(12, 0.15)][:, None]
    x = (size * np.sin(angle).sum(1)).T
    xd = (size * (rate * np.cos(angle)).sum(1)).T
    xdd = (size * (-(rate**2) * np.sin(angle)).sum(1)).T
    x[:, 6:] += np.tile([0.0, 0.8, -1.6], 4)
    lifted = (t // PHASE).astype(int)[:, None] - 1
    stands = lifted != np.arange(4)
    log = {"angles": x[:, 6:], "contact": stands.astype(float)}
    rows = {"forces": [], "gyro": [], "accelerometer": []}
    for k in range(len(t)):
        rpy, rpyd, rpydd = x[k, 3:6], xd[k, 3:6], xdd[k, 3:6]
        R = pin.rpy.rpyToMatrix(rpy)
        J = pin.rpy.computeRpyJacobian(rpy)
        w = J @ rpyd
        wd = J @ rpydd + pin.rpy.computeRpyJacobianTimeDerivative(rpy, rpyd) @ rpyd
        q = np.r_[x[k, :3], pin.Quaternion(R).coeffs(), x[k, 6:]]
        v = np.r_[R.T @ xd[k, :3], w, xd[k, 6:]]
        a = np.r_[R.T @ xdd[k, :3] - np.cross(w, v[:3]), wd, xdd[k, 6:]]
        forces = pin.rnea(model, data, q, v, a)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        J_feet = np.concatenate(
            [
                pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
                for frame, is_on in zip(frames, stands[k], strict=True)
                if is_on
            ]
        )
        # Three or four feet carry the trunk, with the smallest forces that do.
        f = np.linalg.pinv(J_feet[:, :6].T) @ forces[:6]
        rows["forces"].append(forces[6:] - J_feet[:, 6:].T @ f)
        rows["gyro"].append(w)
        rows["accelerometer"].append(R.T @ (xdd[k, :3] + [0, 0, 9.81]))
    log |= {key: np.array(values) for key, values in rows.items()}
    log["forces"] += 0.01 * rng.normal(size=log["forces"].shape)
    return log


@pytest.fixture(scope="module")
def dog(tmp_path_factory):
    """Folder of the robot and its experiment, and a log."""
    folder = tmp_path_factory.mktemp("dog")
    (folder / "dog.urdf").write_text(urdf())
    (folder / "dog.toml").write_text(FILE)
    return folder, log_of(folder / "dog.urdf", 0)


@pytest.fixture(scope="module")
def base(dog):
    return jid.experiment.load_experiment(dog[0] / "dog.toml").setup.base


def findings(base, log):
    recording = jid.Recording.of(**log, sample_time=STEP)
    return check_contacts(base, recording, jid.ZeroPhaseButterworth(10.0))


def test_right_flags_cause_no_finding(dog, base):
    checked = findings(base, dog[1])
    assert checked.findings == ()
    assert np.array_equal(checked.recording.base.contacts, dog[1]["contact"])


def test_right_flags_of_a_short_log_cause_no_finding(dog, base):
    """While all feet stand, three seconds tell too little of a leg in the air."""
    log = {key: x[:600] for key, x in dog[1].items()}
    assert findings(base, log).findings == ()


def test_a_stance_called_swing_is_named_with_its_time(dog, base):
    log = dict(dog[1])
    log["contact"] = log["contact"].copy()
    # While the foot `a` is in the air, `c` stands, but its flag hangs.
    log["contact"][320:550, 2] = 0.0
    checked = findings(base, log)
    (text,) = checked.findings
    assert "`cfoot`" in text
    assert "from 3.2 s to 5.5 s" in text
    assert np.array_equal(checked.recording.base.contacts, dog[1]["contact"])


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("gyro", np.rad2deg, "gyro_unit"),
        ("accelerometer", lambda x: x - [0, 0, 9.81], "gravity is not subtracted"),
        ("accelerometer", lambda x: x[:, [2, 0, 1]], "robot.imu"),
    ],
)
def test_wrong_signals_of_the_imu_are_named(dog, base, key, change, words):
    log = dog[1] | {key: change(dog[1][key])}
    recording = jid.Recording.of(**log, sample_time=STEP)
    (text,) = imu_findings(base.model.robot, recording)
    assert words in text


def test_logs_of_legs_are_identified_and_equal_legs_compared(dog, base, tmp_path):
    """The mass is right; a joint of larger friction and a leg that stands are named."""
    folder, log = dog
    speeds = np.gradient(log["angles"], STEP, axis=0)
    friction = np.full(12, 0.3)
    friction[4] = 1.0
    tables = [
        log["angles"],
        log["forces"] + friction * speeds,
        log["gyro"],
        log["accelerometer"],
        log["contact"],
    ]
    widths = {"q": 12, "tau": 12, "gyro": 3, "acc": 3, "contact": 4}
    names = [f"{key}{k + 1}" for key, width in widths.items() for k in range(width)]
    path = tmp_path / "walk.csv"
    header = ",".join(["t", *names])
    times = STEP * np.arange(len(speeds))
    table = np.column_stack([times, *tables])
    np.savetxt(path, table, delimiter=",", header=header, comments="")

    decoded = jid.experiment.load_experiment(folder / "dog.toml")
    report = jid.identify_logs(jid.Setup(base), [path], decoded.columns)
    bodies = np.array(jid.robots.urdf_parameters(folder / "dog.urdf", floating=True))
    total_mass = bodies[::10].sum()
    masses = np.zeros(base.model.size)
    masses[: len(bodies) : 10] = 1.0
    row = masses[list(base.indices)]
    assert np.isclose(row @ report.fit.parameters, total_mass, rtol=3e-3)
    assert report.identification[0].relative < 0.05
    texts = [x.text for x in report.judgement.findings]
    (difference,) = [text for text in texts if "other legs" in text]
    assert "`b2`" in difference
    assert "1.0 and not 0.30" in difference
    assert not any("lift these feet" in text for text in texts)

    # Without its last phase the log never lifts the foot `d`.
    part = {key: x[: -round(PHASE / STEP)] for key, x in log.items()}
    recording = jid.Recording.of(**part, sample_time=STEP)
    smooth = jid.ZeroPhaseButterworth(10.0)
    fit = jid.identify(base, jid.observe(recording, base.model.robot, smooth))
    (sentence,) = standing_feet_findings(fit)
    assert [foot for foot in FEET if f"`{foot}`" in sentence] == ["dfoot"]


def test_no_motion_is_designed_for_a_floating_base(base):
    with pytest.raises(jid.InputError, match="contacts"):
        jid.ExcitationProblem(base)


def test_feet_need_a_floating_base(dog):
    folder, _ = dog
    path = folder / "fixed.toml"
    path.write_text(FILE.replace("floating = true", ""))
    with pytest.raises(jid.InputError, match="floating"):
        jid.experiment.load_experiment(path)
