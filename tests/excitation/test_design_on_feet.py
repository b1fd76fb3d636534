"""Motions of robots on their feet: Pinocchio's forces and places, MuJoCo's falls."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest

import jaxid as jid
from jaxid.excitation.checks_on_feet import ChecksOnFeet
from jaxid.excitation.design_result import DesignStatus
from jaxid.excitation.ground_forces import ground_forces, measured_motion
from jaxid.excitation.motions_on_feet import MotionsOnFeet
from jaxid.robot.leg_kinematics import (
    FootPlaces,
    find_legs,
    foot_places,
    place_feet,
    standing_pose,
)
from jaxid.trajectory.files import load_trajectory

pin = pytest.importorskip("pinocchio")
ROBOTS = Path(pin.__file__).parents[4] / "share/example-robot-data/robots"
GO2 = ROBOTS / "go2_description/urdf/go2.urdf"
G1 = ROBOTS / "g1_description/urdf/g1_29dof_rev_1_0.urdf"
FEET = {f"{leg}_foot": jid.Sphere(0.022) for leg in ("FL", "FR", "RL", "RR")}
SOLES = {f"{side}_ankle_roll_link": jid.Sole() for side in ("left", "right")}
HAND_POSE = {"thigh": 0.8, "calf": -1.6}
EXPERIMENT = f"""
[robot]
urdf = "{GO2}"
floating = true
contacts = {{ {", ".join(f"{foot} = 0.022" for foot in FEET)} }}
[excitation]
starts = 5
generations = 1
omega = 1.2
harmonics = 12
"""
pytestmark = pytest.mark.skipif(
    not GO2.exists(), reason="the robots of example-robot-data are not installed"
)


def free_flyer(path):
    text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", path.read_text())
    model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
    return model, model.createData()


def pin_states(model, robot, motion):
    """The states of Pinocchio's free-flyer: attitude, and rates along the trunk."""
    names = [*model.names][2:]
    order = [robot.joint_names.index(name) for name in names]
    trunk = measured_motion(robot, motion)
    gravity = np.array([0.0, 0.0, -9.81])
    velocities = np.asarray(motion.qd)
    for k in range(len(motion.q)):
        R = trunk.rotation[k]
        q = np.r_[motion.q[k, :3], pin.Quaternion(R).coeffs(), motion.q[k, order]]
        w = np.asarray(trunk.motion.qd)[k, 3:6]
        v = np.r_[R.T @ velocities[k, :3], w, velocities[k, order]]
        # The spatial acceleration of Pinocchio is that of the moving point.
        linear = R.T @ (np.asarray(motion.qdd)[k, :3]) - np.cross(w, v[:3])
        assert np.allclose(trunk.motion.qdd[k, :3], R.T @ (motion.qdd[k, :3] - gravity))
        yield q, v, linear, order


@pytest.fixture(scope="module")
def experiment(tmp_path_factory):
    path = tmp_path_factory.mktemp("legs") / "go2.toml"
    path.write_text(EXPERIMENT)
    return jid.experiment.load_experiment(path)


@pytest.fixture(scope="module")
def task(experiment):
    return jid.workflow.prepare_motion(
        experiment.setup, experiment.excitation, experiment.surroundings
    )


@pytest.fixture(scope="module")
def designed(task):
    return jid.workflow.design_motion(task)


@pytest.fixture(scope="module")
def motions(task):
    standing = task.family["standing"]
    return MotionsOnFeet(task.setup.base, standing, 12, 1.2)


def test_forces_and_balance_are_those_of_pinocchio(task, motions):
    """Forces on the feet follow from the torques, by Pinocchio's Jacobians."""
    robot = motions.robot
    base = task.setup.base
    random = np.random.default_rng(3)
    phase = motions.phase(2, motions.random(2, random))
    times = np.linspace(0.0, motions.duration, 9)
    motion = phase.motion(times)
    stands = phase.stands(times, 4)
    trunk = measured_motion(robot, motion)
    parameters = motions.standing.parameters
    forces = ground_forces(base, parameters, trunk, stands)
    model, data = free_flyer(GO2)
    feet = [model.getFrameId(foot) for foot in FEET]
    for k, (q, v, linear, order) in enumerate(pin_states(model, robot, motion)):
        turning = np.asarray(trunk.motion.qdd)[k, 3:6]
        w = v[3:6]
        turning = turning + np.array([w[1] * w[2], -w[0] * w[2], w[0] * w[1]])
        a = np.r_[linear, turning, np.asarray(motion.qdd)[k, order]]
        torques = pin.rnea(model, data, q, v, a)
        left = torques.copy()
        left[6:] -= forces.joint_forces[k, order]
        # What the torques leave is the work of forces on the feet that stand.
        pin.computeJointJacobians(model, data, q)
        pin.updateFramePlacements(model, data)
        total, moment = np.zeros((2, 3))
        for foot, frame in enumerate(feet):
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            arm = np.array([0.0, 0.0, -0.022])
            linear_part = J[:3] - pin.skew(arm) @ J[3:]
            leg = np.flatnonzero(np.abs(J[:, 6:]).max(axis=0) > 0) + 6
            force = np.linalg.solve(linear_part[:, leg].T, left[leg])
            if not stands[k, foot]:
                assert np.abs(force).max() < 1e-6
            total += force
            place = data.oMf[frame].translation + arm
            moment += np.cross(place, force)
            left -= linear_part.T @ force
        assert np.abs(left).max() < 1e-6
        point = np.array([-moment[1], moment[0]]) / total[2]
        assert np.allclose(point, forces.zero_moment_point[k], atol=1e-6)
        friction = np.linalg.norm(total[:2]) / total[2]
        assert np.isclose(friction, forces.friction[k], atol=1e-8)


@pytest.mark.parametrize(
    ("path", "feet", "size"), [(GO2, FEET, 0.05), (G1, SOLES, 0.03)]
)
def test_feet_stay_where_they_are_under_a_trunk_that_moves(path, feet, size):
    robot = jid.load_urdf(path, floating=True, contacts=feet)
    legs = find_legs(robot)
    pose = standing_pose(robot, legs)
    home = foot_places(legs, pose[None])
    q = np.tile(pose, (5, 1))
    q[:, :6] += np.random.default_rng(0).normal(scale=size, size=(5, 6))
    q = place_feet(legs, q, FootPlaces(*(np.repeat(x, 5, axis=0) for x in home)))
    zero = np.zeros_like(q)
    model, data = free_flyer(path)
    for state, *_ in pin_states(model, robot, jid.Motion(q, zero, zero)):
        pin.framesForwardKinematics(model, data, state)
        for foot, name in enumerate(feet):
            place = data.oMf[model.getFrameId(name)]
            assert np.allclose(place.translation, home.positions[0, foot], atol=1e-7)
            if feet is SOLES:
                assert np.allclose(place.rotation, home.rotations[0, foot], atol=1e-7)


def test_points_inside_the_polygon_of_the_feet():
    from jaxid.excitation.ground_forces import distance_inside

    feet = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    points = np.array([[1.0, 1.0], [1.5, -0.5], [3.0, 4.0]])
    distances = distance_inside(points, feet)
    assert np.allclose(distances[:2], [1.0, -0.5])
    assert np.isclose(distances[2], -2.4)
    assert np.isclose(distance_inside(np.array([[1.0, 0.0]]), feet[:2])[0], 0.0)


def test_a_designed_motion_starts_and_ends_at_rest_and_keeps_its_limits(designed):
    plan = designed.plan
    motion = plan.trajectory
    duration = float(motion.duration)
    assert duration == pytest.approx(5 * 2 * np.pi / 1.2)
    ends = motion.motion(np.array([0.0, duration]))
    assert np.allclose(ends.q[0], ends.q[1], atol=1e-9)
    assert max(np.abs(ends.qd).max(), np.abs(ends.qdd).max()) < 1e-6
    # Positions, velocities and accelerations are continuous, also between phases.
    times = np.linspace(0.0, duration, 40001)
    samples = motion.motion(times)
    step = times[1]
    for x, rate in ((samples.q, samples.qd), (samples.qd, samples.qdd)):
        change = np.diff(x, axis=0) / step
        assert np.abs(change - 0.5 * (rate[1:] + rate[:-1])).max() < 0.02
    assert plan.feasible
    assert plan.use.max() <= 1.0
    assert not plan.undetermined
    limits = plan.robot.limits
    assert (np.asarray(samples.q) <= limits.position_max).all()
    assert (np.asarray(samples.q) >= limits.position_min).all()


def test_the_search_improves_on_random_motions(designed):
    (criterion,) = (x for x in designed.plan.criteria if x.name.startswith("D:"))
    assert criterion.after < criterion.before
    assert designed.plan.mean_gain > 1.1
    assert (np.diff(designed.plan.history) <= 0.0).all()


def test_files_say_which_feet_stand(task, designed, tmp_path):
    files = jid.workflow.write_design(task, designed, tmp_path / "motion.csv")
    assert [file.suffix for file in files] == [".csv", ".yaml", ".json", ".html"]
    table = pl.read_csv(tmp_path / "motion.csv")
    flags = table.select(pl.selectors.starts_with("contact_")).to_numpy()
    assert table.columns[-4:] == [f"contact_{foot}" for foot in FEET]
    assert (flags.sum(axis=1) >= 3).all()
    assert (flags.min(axis=0) == 0).all()
    motion = load_trajectory(tmp_path / "motion.json")
    planned = motion.stands(table["time [s]"].to_numpy())
    assert (planned == flags).all()
    page = (tmp_path / "motion" / "report.html").read_text()
    assert "FL_foot" in page


def test_ctrl_c_keeps_the_best_motion_and_begin_goes_on(task, designed):
    def stop(progress):
        raise KeyboardInterrupt

    settings = {**task.family, "constraints": task.constraints}
    motion = designed.plan.trajectory
    plan = jid.design_excitation(
        task.setup.base, **settings, begin=motion, progress=stop
    )
    assert plan.status is DesignStatus.STOPPED
    assert np.allclose(plan.trajectory.coefficients, motion.coefficients)
    assert plan.history[-1] <= designed.plan.history[-1] * 1.000001


def test_it_does_not_fall_in_mujoco(designed):
    mujoco = pytest.importorskip("mujoco")
    motion = designed.plan.trajectory
    text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", GO2.read_text())
    spec = mujoco.MjSpec.from_string(text)
    spec.compiler.fusestatic = False
    spec.option.timestep = 0.002
    spec.option.impratio = 10
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1])
    spec.body("base").add_freejoint()
    for foot in FEET:
        spec.body(foot).add_geom(name=foot, size=[0.022, 0, 0], mass=0, condim=4)
    model = spec.compile()
    model.dof_armature[6:] = 0.012
    model.dof_damping[6:] = 0.15
    data = mujoco.MjData(model)
    names = [model.joint(j).name for j in range(1, model.njnt)]
    order = [designed.plan.robot.joint_names.index(name) for name in names]
    times = np.arange(0.0, float(motion.duration), 0.002)
    samples = motion.motion(times)
    q, qd = np.asarray(samples.q)[:, order], np.asarray(samples.qd)[:, order]
    stands = motion.stands(times)
    data.qpos[7:] = q[0]
    mujoco.mj_kinematics(model, data)
    feet = [model.geom(foot).id for foot in FEET]
    data.qpos[2] -= data.geom_xpos[feet, 2].min() - 0.022
    heights = []
    for k in range(len(times)):
        torques = 120.0 * (q[k] - data.qpos[7:]) + 2.5 * (qd[k] - data.qvel[6:])
        data.qfrc_applied[6:] = np.clip(torques, -40.0, 40.0)
        mujoco.mj_step(model, data)
        assert data.xmat[1].reshape(3, 3)[2, 2] > 0.9, times[k]
        heights.append(data.geom_xpos[feet, 2] - 0.022)
    # Each foot is lifted in its turn, and only then.
    heights = np.array(heights)
    for foot, (start, stop) in enumerate(np.asarray(motion.lifts)):
        middle = (times > start + 0.6) & (times < stop - 0.6)
        assert heights[middle, foot].min() > 0.01
    assert np.quantile(heights[stands], 0.98) < 0.005


def test_what_cannot_work_is_refused(task, monkeypatch):
    monkeypatch.setattr("jaxid.excitation.design_on_feet.MAX_SHRINKAGES", 0)
    base = task.setup.base
    standing = task.family["standing"]
    with pytest.raises(jid.InputError, match="`standing`"):
        jid.design_excitation(base)
    bare = base.model.robot.replace(contacts=())
    with pytest.raises(jid.InputError, match="`contacts`"):
        find_legs(bare)
    with pytest.raises(jid.InputError, match="must have 4 feet"):
        find_legs(bare.replace(contacts=base.model.robot.contacts[:3]))
    soles = {foot: jid.Sole() for foot in FEET}
    with pytest.raises(jid.InputError, match="3 for a ball foot"):
        find_legs(jid.load_urdf(GO2, floating=True, contacts=soles))
    robot = base.model.robot
    legs = find_legs(robot)
    for pose, words in (
        ({"knee": 1.0}, "no joint"),
        ({**HAND_POSE, "FL_calf": -2.0}, "one plane"),
    ):
        with pytest.raises(jid.InputError, match=words):
            standing_pose(robot, legs, pose)
    straight = standing._replace(pose={"thigh": 0.0, "calf": 0.0})
    with pytest.raises(jid.InputError, match="lean so far"):
        MotionsOnFeet(base, straight, 4, 1.5)
    heavy = standing._replace(parameters=20.0 * np.asarray(standing.parameters))
    with pytest.raises(jid.InputError, match="the force of joint"):
        jid.design_excitation(base, standing=heavy)
    no_masses = dataclasses.replace(task.setup, robot_file=None)
    with pytest.raises(jid.InputError, match="nothing is known of its masses"):
        jid.workflow.prepare_motion(no_masses, task.excitation, task.surroundings)


def test_a_pose_of_the_user_is_where_the_motion_begins(task):
    standing = task.family["standing"]._replace(pose=HAND_POSE)
    motions = MotionsOnFeet(task.setup.base, standing, 4, 1.5)
    angles = motions.phase(0, np.zeros(motions.shape)).motion(np.zeros(1)).q[0, 6:]
    assert np.allclose(angles, np.tile([0.0, 0.8, -1.6], 4), atol=1e-6)


def test_a_slippery_ground_makes_motions_smaller(motions):
    phase = motions.phase(0, motions.random(0, np.random.default_rng(0)))
    motion = phase.motion(motions.times)
    stands = phase.stands(motions.times, 4)

    def friction(coefficient):
        motions.standing = motions.standing._replace(friction=coefficient)
        limits = motions.robot.limits
        joints = jid.Limits(12, position_min=limits.position_min[6:])
        checks = ChecksOnFeet(motions, joints, ())
        _, finding, *_ = checks._falling(motion, stands)
        return finding

    assert friction(0.5).reached == pytest.approx(friction(0.1).reached)
    assert friction(0.1).value > friction(0.5).value
