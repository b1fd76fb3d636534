"""Logs of a robot on legs: contact forces drop out of the rows that count."""

import numpy as np
import pinocchio as pin
import pytest

import jaxid as jid
from jaxid.identification.uncertainty.slow_rows import acting_friction
from jaxid.measurement.floating_base import vertical
from jaxid.robot.contacts import legs_of

# A trunk on two legs of three joints, whose feet are balls.
URDF = """<robot name="biped"><link name="trunk"><inertial><mass value="4"/>
<origin xyz="0.02 0.01 0.03"/><inertia ixx="0.03" iyy="0.05" izz="0.06" ixy="0.001"
ixz="0.002" iyz="0.003"/></inertial></link>{legs}</robot>"""
LEG = """<joint name="{s}1" type="revolute"><parent link="trunk"/><child link="{s}hip"/>
<origin xyz="0 {y} 0"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="50"
velocity="9"/></joint><link name="{s}hip">{body}</link>
<joint name="{s}2" type="revolute"><parent link="{s}hip"/><child link="{s}thigh"/>
<origin xyz="0 0 -0.05"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50"
velocity="9"/></joint><link name="{s}thigh">{body}</link>
<joint name="{s}3" type="revolute"><parent link="{s}thigh"/><child link="{s}shank"/>
<origin xyz="0 0 -0.2"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="50"
velocity="9"/></joint><link name="{s}shank">{body}</link>
<joint name="{s}f" type="fixed"><parent link="{s}shank"/><child link="{s}foot"/>
<origin xyz="0 0 -0.2"/></joint><link name="{s}foot"/>"""
BODY = """<inertial><mass value="0.7"/><origin xyz="0.01 0.02 -0.08"/><inertia
ixx="0.004" iyy="0.004" izz="0.001" ixy="0" ixz="0.0002" iyz="0"/></inertial>"""
RADIUS = 0.03


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    sides = (("l", 0.1), ("r", -0.1))
    legs = "".join(LEG.format(s=side, y=y, body=BODY) for side, y in sides)
    path = tmp_path_factory.mktemp("biped") / "biped.urdf"
    path.write_text(URDF.format(legs=legs))
    feet = {"lfoot": jid.Sphere(RADIUS), "rfoot": jid.Sphere(RADIUS)}
    return jid.load_urdf(path, floating=True, contacts=feet), path


def test_a_ball_is_where_the_file_has_its_sphere(robot):
    path = robot[1].with_name("balls.urdf")
    ball = """<collision><origin xyz="0.01 0 0.02"/><geometry><sphere radius="0.03"/>
        </geometry></collision>"""
    text = robot[1].read_text()
    one_ball = f'<link name="lfoot">{ball}</link>'
    two_balls = f'<link name="rfoot">{ball}{ball}</link>'
    text = text.replace('<link name="lfoot"/>', one_ball)
    path.write_text(text.replace('<link name="rfoot"/>', two_balls))
    feet = {"lfoot": jid.Sphere(RADIUS), "rfoot": jid.Sphere(RADIUS)}
    left, right = jid.load_urdf(path, floating=True, contacts=feet).contacts
    np.testing.assert_allclose(left.position, [0.01, 0.0, -0.18], atol=1e-15)
    # Of two spheres none is known to be the foot.
    np.testing.assert_allclose(right.position, [0.0, 0.0, -0.2], atol=1e-15)


def truth_of(robot, path):
    return np.array(jid.robots.urdf_parameters(path, floating=True))


def log_of(robot, path, seconds=12.0, dt=0.005):
    """Return a log by Pinocchio: any motion, and contact forces that belong to it."""
    pinned = pin.buildModelFromUrdf(str(path), pin.JointModelFreeFlyer())
    data = pinned.createData()
    frames = [pinned.getFrameId(name) for name in ("lfoot", "rfoot")]
    rng = np.random.default_rng(0)
    t = np.arange(0.0, seconds, dt)
    frequency = rng.uniform(0.3, 1.2, (12, 3))
    phase = rng.uniform(0, 6.3, (12, 3))
    size = 0.25 * np.ones(12)
    size[:3] = 0.05
    angle = 2 * np.pi * frequency[:, :, None] * t + phase[:, :, None]
    rate = 2 * np.pi * frequency[:, :, None]
    x = (size[:, None] * np.sin(angle).sum(1)).T
    x[:, 6:] += np.tile([0.0, 0.8, -1.6], 2)
    xd = (size[:, None] * (rate * np.cos(angle)).sum(1)).T
    xdd = (size[:, None] * (-(rate**2) * np.sin(angle)).sum(1)).T
    stands = np.ones((len(t), 2))
    stands[t > 4.0, 0] = 0.0
    stands[t > 8.0] = (1.0, 0.0)
    log = {key: [] for key in ("angles", "forces", "gyro", "accelerometer")}
    for k in range(len(t)):
        # Attitudes by roll, pitch and yaw, and their derivatives.
        rpy, rpyd, rpydd = x[k, 3:6], xd[k, 3:6], xdd[k, 3:6]
        R = pin.rpy.rpyToMatrix(rpy)
        J = pin.rpy.computeRpyJacobian(rpy)
        Jd = pin.rpy.computeRpyJacobianTimeDerivative(rpy, rpyd)
        w, wd = J @ rpyd, J @ rpydd + Jd @ rpyd
        q = np.r_[x[k, :3], pin.Quaternion(R).coeffs(), x[k, 6:]]
        v = np.r_[R.T @ xd[k, :3], w, xd[k, 6:]]
        a = np.r_[R.T @ xdd[k, :3] - np.cross(w, v[:3]), wd, xdd[k, 6:]]
        forces = pin.rnea(pinned, data, q, v, a)
        feet = [f for f, is_on in zip(frames, stands[k], strict=True) if is_on]
        pin.computeJointJacobians(pinned, data, q)
        pin.updateFramePlacements(pinned, data)
        down = np.array([0.0, 0.0, -RADIUS])
        jacobians = []
        for frame in feet:
            J6 = pin.getFrameJacobian(pinned, data, frame, pin.LOCAL_WORLD_ALIGNED)
            jacobians.append(J6[:3] - pin.skew(down) @ J6[3:])
        J_feet = np.concatenate(jacobians)
        # Two point feet cannot carry all of it: what is left acts on the trunk. So the
        # trunk's rows count only where the test adds that wrench back.
        f, *_ = np.linalg.lstsq(J_feet[:, :6].T, forces[:6], rcond=None)
        log["angles"].append(x[k, 6:])
        log["forces"].append(forces[6:] - J_feet[:, 6:].T @ f)
        log["gyro"].append(w)
        log["accelerometer"].append(R.T @ (xdd[k, :3] + [0, 0, 9.81]))
        log.setdefault("missing", []).append(forces[:6] - J_feet[:, :6].T @ f)
    log = {key: np.array(values) for key, values in log.items()}
    return log | {"contact": stands, "time": t}


def test_contact_forces_drop_out(robot):
    """Rows that count hold for the true parameters, though no force is known."""
    robot, path = robot
    log = log_of(robot, path)
    missing = log.pop("missing")
    recording = jid.Recording.of(**log)
    filter = jid.ZeroPhaseButterworth(20.0, order=4)
    observations = jid.observe(recording, robot, filter)
    # The wrench that holds the trunk up is known here.
    starts = [round(t / 0.005) for t in observations.start_times]
    parts = [
        missing[start : start + b - a]
        for start, (a, b) in zip(starts, observations.segments, strict=True)
    ]
    forces = np.array(observations.forces)
    forces[:, :6] += np.concatenate(parts)
    model = jid.Model(robot, (jid.RigidBodies(),))
    p = truth_of(robot, path)
    predicted = np.asarray(model.regressor(observations.motion) @ p)
    rows = observations.reduce(predicted - forces)
    counted = np.asarray(observations.mask)
    size = np.abs(observations.reduce(forces)).max(axis=0)
    errors = np.abs(np.where(counted, rows, 0.0)).max(axis=0)
    # The vertical is known to some hundredths, which moves the lowest points a little.
    assert (errors[:3] < 0.01 * size[:3].max()).all()
    assert (errors[3:6] < 0.001 * size[:3].max()).all()
    assert (errors[6:] < 0.005 * size[6:]).all()
    # Rows of standing legs do not hold: they carry the force.
    assert np.abs(rows[:, 6:][~counted[:, 6:]]).max() > 5.0
    assert counted[:, :6].all()
    # Three patterns of contact, with guards around the changes.
    assert len(observations.segments) == 3
    assert legs_of(robot).own_joints == ((6, 7, 8), (9, 10, 11))


def test_friction_of_a_leg_acts_on_the_base_as_the_model_says(robot):
    robot, path = robot
    log = log_of(robot, path, seconds=6.0)
    del log["missing"]
    filter = jid.ZeroPhaseButterworth(20.0, order=4)
    motion = jid.observe(jid.Recording.of(**log), robot, filter).reduced_motion
    model = jid.Model(robot, (jid.terms.ViscousFriction(),))
    theta = np.asarray(model.regressor(motion))
    for joint in range(robot.joints):
        columns = acting_friction(legs_of(robot), motion, motion.qd, joint)
        assert np.allclose(columns[:, list(robot.driven)], theta[:, joint])


def test_vertical_follows_gravity_while_the_base_turns():
    rng = np.random.default_rng(2)
    dt = 0.002
    t = np.arange(0.0, 20.0, dt)
    angle = 0.4 * np.sin(1.5 * t)
    rates = np.zeros((len(t), 3))
    rates[:, 1] = np.gradient(angle, dt)
    up = np.stack([-np.sin(angle), 0 * t, np.cos(angle)], axis=1)
    shaking = np.stack([2.0 * np.sin(4.0 * t + k) for k in range(3)], axis=1)
    accelerations = 9.81 * up + shaking + 0.1 * rng.normal(size=up.shape)
    error = vertical(rates, accelerations, dt) - up
    # Half of the time over which it is averaged lies outside of the log at its ends.
    assert np.abs(error[1000:-1000]).max() < 0.03


def test_missing_or_wrong_signals_are_refused(robot):
    robot, path = robot
    log = log_of(robot, path, seconds=1.0)
    del log["missing"]
    filter = jid.ZeroPhaseButterworth(20.0)
    with pytest.raises(jid.InputError, match="accelerometer"):
        jid.Recording.of(**{k: x for k, x in log.items() if k != "accelerometer"})
    bare = jid.Recording.of(log["angles"], log["forces"], time=log["time"])
    with pytest.raises(jid.InputError, match="gyro"):
        jid.observe(bare, robot, filter)
    one_flag = jid.Recording.of(**(log | {"contact": log["contact"][:, :1]}))
    with pytest.raises(jid.InputError, match="contact"):
        jid.observe(one_flag, robot, filter)
    shared = robot.replace(contacts=(robot.contacts[0],) * 2)
    with pytest.raises(jid.InputError, match="Sole"):
        legs_of(shared)
