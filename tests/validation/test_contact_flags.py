"""A log of a robot on four legs: wrong flags and signals of the IMU are named."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation

import jaxid as jid
from jaxid.measurement.imu_offset import identify_imu_offset, without_imu_offset
from jaxid.result_table import Status
from jaxid.validation.contact_flags import (
    check_contacts,
    imu_remarks,
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
    """Return a log by Pinocchio: feet that stand do not move, and carry the trunk."""
    model = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    data = model.createData()
    frames = [model.getFrameId(foot) for foot in FEET]
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 5 * PHASE, STEP)
    rate = 2 * np.pi * rng.uniform(0.3, 1.3, (18, 3, 1))
    phase = rng.uniform(0, 6.3, (18, 3, 1))
    size = np.r_[np.full(3, 0.02), np.full(3, 0.06)][:, None]
    angle = rate[:6] * t + phase[:6]
    x = (size * np.sin(angle).sum(1)).T
    xd = (size * (rate[:6] * np.cos(angle)).sum(1)).T
    xdd = (size * (-(rate[:6] ** 2) * np.sin(angle)).sum(1)).T
    number = (t // PHASE).astype(int)[:, None] - 1
    stands = number != np.arange(4)

    def swing(times):
        """Return what a leg in the air moves beside standing."""
        waves = 0.15 * np.sin(rate[6:] * times + phase[6:]).sum(1).T
        window = np.sin(np.pi * times / PHASE) ** 2
        return waves * window[:, None] * np.repeat(~stands, 3, axis=1)

    h = 1e-4
    before, lift, after = swing(t - h), swing(t), swing(t + h)
    lift_rate = (after - before) / (2 * h)
    lift_change = (after - 2 * lift + before) / h**2
    legs = np.tile([0.0, 0.8, -1.6], 4)
    pin.framesForwardKinematics(model, data, np.r_[np.zeros(6), 1.0, legs])
    targets = [data.oMf[frame].translation.copy() for frame in frames]
    rows = {"angles": [], "forces": [], "gyro": [], "accelerometer": []}

    def jacobian(frame):
        return pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]

    for k in range(len(t)):
        rpy, rpyd, rpydd = x[k, 3:], xd[k, 3:], xdd[k, 3:]
        R = pin.rpy.rpyToMatrix(rpy)
        J = pin.rpy.computeRpyJacobian(rpy)
        w = J @ rpyd
        wd = J @ rpydd + pin.rpy.computeRpyJacobianTimeDerivative(rpy, rpyd) @ rpyd
        pose = np.r_[x[k, :3], pin.Quaternion(R).coeffs()]
        v = np.r_[R.T @ xd[k, :3], w, np.zeros(12)]
        a = np.r_[R.T @ xdd[k, :3] - np.cross(w, v[:3]), wd, np.zeros(12)]
        for _ in range(3):
            pin.computeJointJacobians(model, data, np.r_[pose, legs])
            pin.updateFramePlacements(model, data)
            for leg, (frame, target) in enumerate(zip(frames, targets, strict=True)):
                own = slice(3 * leg, 3 * leg + 3)
                error = target - data.oMf[frame].translation
                J = jacobian(frame)[:, 6:][:, own]
                legs[own] += np.linalg.solve(J, error)
        q = np.r_[pose, legs]
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        J = np.concatenate([jacobian(frame) for frame in frames])
        v[6:] = -np.linalg.solve(J[:, 6:], J[:, :6] @ v[:6])
        pin.forwardKinematics(model, data, q, v, a)
        pin.updateFramePlacements(model, data)
        drift = [
            pin.getFrameClassicalAcceleration(
                model, data, frame, pin.LOCAL_WORLD_ALIGNED
            ).linear
            for frame in frames
        ]
        a[6:] = -np.linalg.solve(J[:, 6:], np.concatenate(drift))
        q[7:] += lift[k]
        v[6:] += lift_rate[k]
        a[6:] += lift_change[k]
        forces = pin.rnea(model, data, q, v, a)
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        J_feet = np.concatenate(
            [
                jacobian(frame)
                for frame, is_on in zip(frames, stands[k], strict=True)
                if is_on
            ]
        )
        # Three or four feet carry the trunk, with the smallest forces that do.
        f = np.linalg.pinv(J_feet[:, :6].T) @ forces[:6]
        rows["angles"].append(q[7:])
        rows["forces"].append(forces[6:] - J_feet[:, 6:].T @ f)
        rows["gyro"].append(w)
        rows["accelerometer"].append(R.T @ (xdd[k, :3] + [0, 0, 9.81]))
    log = {"contact": stands.astype(float)}
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
    log["contact"][320:450, 2] = 0.0
    checked = findings(base, log)
    (text,) = checked.findings
    assert "`cfoot`" in text
    assert "from 3.2 s to 4.5 s" in text
    assert np.array_equal(checked.recording.base.contacts, dog[1]["contact"])


def scaled(joint, factor):
    return lambda x: x * np.where(np.arange(12) == joint, factor, 1.0)


def exchanged(first, second):
    """Return a change of the order of columns."""

    def change(x):
        x = x.copy()
        x[:, [*first, *second]] = x[:, [*second, *first]]
        return x

    return change


@pytest.mark.parametrize(
    ("keys", "change", "words"),
    [
        (["forces"], scaled(4, -1.0), ("sign of the force", "`b2`", "force_signs")),
        (["forces"], scaled(7, 1e3), ("`c2`", "1000 times", "`recording.force_gains`")),
        (["forces"], scaled(8, 1 / 9), ("`c3`", "`recording.force_gains` of 9.0")),
        (["forces"], exchanged([1], [11]), ("forces of joints `a2` and `d3`",)),
        (["angles"], exchanged([0, 1, 2], [9, 10, 11]), ("`afoot` and `dfoot`",)),
        (["angles"], scaled(5, -1.0), ("sign of the angle", "`b3`", "angle_signs")),
        (["contact"], lambda x: 1.0 - x, ("`recording.contact_inverted = true`",)),
        (["contact"], exchanged([0], [1]), ("`afoot` and `bfoot` are exchanged",)),
    ],
)
def test_wrong_columns_are_named_and_nothing_that_they_spoil(
    dog, base, keys, change, words
):
    log = dog[1] | {key: change(dog[1][key]) for key in keys}
    checked = findings(base, log)
    assert checked.findings == ()
    (text,) = checked.mistakes
    assert all(word in text for word in words)


def test_inverted_flags_are_read_as_they_are(dog):
    columns = jid.Columns("q{}", "tau{}", contact="c{}", contact_inverted=True)
    channels = {"angles": dog[1]["angles"], "contact": 1.0 - dog[1]["contact"]}
    assert np.array_equal(columns.to_si(channels)["contact"], dog[1]["contact"])


@pytest.mark.parametrize(
    ("key", "change", "words"),
    [
        ("gyro", np.rad2deg, "gyro_unit"),
        ("accelerometer", lambda x: x - [0, 0, 9.81], "gravity is not subtracted"),
        ("accelerometer", lambda x: x[:, [2, 0, 1]], "signs and order"),
    ],
)
def test_wrong_signals_of_the_imu_are_named(dog, base, key, change, words):
    log = dog[1] | {key: change(dog[1][key])}
    recording = jid.Recording.of(**log, sample_time=STEP)
    (remark,) = imu_remarks(base.model.robot, recording, jid.ZeroPhaseButterworth(10.0))
    assert words in remark.text
    assert remark.status is Status.BAD


def turned_imu(log, turn, place, rate_bias, acceleration_bias):
    """Return a log whose IMU is elsewhere, by the motion of a rigid body."""
    rates, accelerations = log["gyro"], log["accelerometer"]
    changes = np.gradient(rates, STEP, axis=0)
    accelerations = accelerations + np.cross(changes, place)
    accelerations = accelerations + np.cross(rates, np.cross(rates, place))
    R = Rotation.from_rotvec(turn).as_matrix()
    gyro = rates @ R + rate_bias
    return log | {"gyro": gyro, "accelerometer": accelerations @ R + acceleration_bias}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({}, ""),
        ({"turn": (0.03, -0.02, 0.02)}, "turned by 2.4 degrees"),
        ({"turn": (0.0, 0.0, np.pi)}, "turned by 180 degrees"),
        ({"place": (0.03, -0.03, 0.026)}, "displaced by 5"),
        ({"acceleration_bias": (0.0, 0.0, 0.045)}, "all masses wrong by 0.5 %"),
        ({"rate_bias": (0.03, 0.04, 0.0)}, "gyroscope with a bias of 0.05"),
        ({"acceleration_bias": (0.2, 0.1, -0.2)}, "accelerometer with a bias of 0.3"),
    ],
)
def test_the_legs_tell_how_the_imu_is_mounted(dog, base, change, words):
    robot = base.model.robot
    smooth = jid.ZeroPhaseButterworth(10.0)
    zero = (0.0, 0.0, 0.0)
    true = dict.fromkeys(("turn", "place", "rate_bias", "acceleration_bias"), zero)
    true |= change
    log = turned_imu(dog[1], **true)
    recording = jid.Recording.of(**log, sample_time=STEP)
    remarks = imu_remarks(robot, recording, smooth)
    assert len(remarks) == bool(words)
    for remark in remarks:
        assert words in remark.text
        # Only a large turn spoils any fit.
        assert (remark.status is Status.BAD) == ("180 degrees" in words)
    offset = identify_imu_offset(recording, robot, smooth)
    errors = np.abs(offset.values - list(true.values()))
    # Rotation [rad], place [m], biases [rad/s, m/s²].
    assert (errors.max(axis=1) < [0.004, 0.004, 0.001, 0.04]).all()
    # What is corrected is what the IMU of the description measures.
    corrected = without_imu_offset(recording, robot, smooth)
    assert imu_remarks(robot, corrected, smooth) == []
    inner = slice(50, -50)
    for name, size in (("rates", 0.005), ("accelerations", 0.06)):
        channel = {"rates": "gyro", "accelerations": "accelerometer"}[name]
        found = np.asarray(getattr(corrected.base, name))[inner]
        assert np.abs(found - dog[1][channel][inner]).max() < size
    assert "bias of the gyroscope" in corrected.notes[-1]


def test_an_imu_offset_needs_all_feet_on_the_ground(dog, base):
    log = {key: x[round(PHASE / STEP) :] for key, x in dog[1].items()}
    recording = jid.Recording.of(**log, sample_time=STEP)
    with pytest.raises(jid.InputError, match="`imu_offset`"):
        without_imu_offset(recording, base.model.robot, jid.ZeroPhaseButterworth(10.0))


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

    # A gyroscope in degrees is the only fault: what it spoils needs no cure of its own.
    first_gyro = names.index("gyro1") + 1
    table[:, first_gyro : first_gyro + 3] *= 180.0 / np.pi
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    report = jid.identify_logs(jid.Setup(base), [path], decoded.columns)
    (fault,) = report.judgement.faults
    assert fault.status is Status.BAD
    assert "gyro_unit" in fault.text

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


def test_speeds_in_a_list_are_those_of_the_driven_joints(dog):
    """Joints of the base are none of them, and all rows of the base count."""
    folder, log = dog
    speeds = [0.02 * number for number in range(1, 13)]
    path = folder / "speeds.toml"
    path.write_text(FILE + f"[model.coulomb]\nepsilon = {speeds}\n")
    setup = jid.experiment.load_experiment(path).setup
    recording = jid.Recording.of(**log, sample_time=STEP)
    observations = setup.observe(recording)
    motion = observations.reduced_motion
    qd = np.asarray(motion.qd)[:, 6:]
    regressor = np.asarray(setup.model.regressor(motion))
    names = setup.model.parameter_names
    for joint, speed in enumerate(speeds):
        column = regressor[:, 6 + joint, names.index(f"fc{joint + 1}")]
        np.testing.assert_allclose(column, np.tanh(qd[:, joint] / speed), rtol=1e-9)
    for min_speed in (speeds, 0.1):
        path.write_text(FILE + f"[rows]\nmin_speed = {min_speed}\n")
        slow_setup = jid.experiment.load_experiment(path).setup
        mask = slow_setup.observe(recording).mask
        np.testing.assert_array_equal(mask[:, :6], observations.mask[:, :6])
        is_fast = np.abs(qd) >= min_speed
        np.testing.assert_array_equal(mask[:, 6:], observations.mask[:, 6:] & is_fast)
        assert not is_fast[observations.mask[:, 6:]].all()


def test_feet_need_a_floating_base(dog):
    folder, _ = dog
    path = folder / "fixed.toml"
    path.write_text(FILE.replace("floating = true", ""))
    with pytest.raises(jid.InputError, match="floating"):
        jid.experiment.load_experiment(path)
