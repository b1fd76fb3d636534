"""Motions of robots on their feet: Pinocchio's forces and places, MuJoCo's falls."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml

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
from jaxid.robot.virtual_joints import with_moving_base
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


def on_ground(path):
    """Pinocchio's robot, whose trunk slides along and then turns about x, y, z."""
    text = re.sub(r"(?s)<(visual|collision)\b.*?</\1>", "", path.read_text())
    root = pin.JointModelComposite()
    for joint in (pin.JointModelTranslation, pin.JointModelRX, pin.JointModelRY):
        root.addJoint(joint())
    root.addJoint(pin.JointModelRZ())
    model = pin.buildModelFromXML(text, root)
    return model, model.createData()


def joint_order(model, robot):
    names = [*model.names][2:]
    return [*range(6), *(robot.joint_names.index(name) for name in names)]


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
    phase = motions.phase(2, motions.random(random))
    times = np.linspace(0.0, motions.duration, 9)
    motion = phase.motion(times)
    loads = motions.loads(2, times)
    parameters = motions.standing.parameters
    trunk = measured_motion(robot, motion)
    forces = ground_forces(base, parameters, trunk, loads, motions.feet)
    model, data = on_ground(GO2)
    order = joint_order(model, robot)
    feet = [model.getFrameId(foot) for foot in FEET]
    q, qd, qdd = (np.asarray(x)[:, order] for x in (motion.q, motion.qd, motion.qdd))
    for k in range(len(times)):
        left = pin.rnea(model, data, q[k], qd[k], qdd[k])
        left[6:] -= forces.joint_forces[k, order[6:]]
        # What the torques leave is the work of forces on the feet that stand.
        pin.computeJointJacobians(model, data, q[k])
        pin.updateFramePlacements(model, data)
        total, moment = np.zeros((2, 3))
        for foot, frame in enumerate(feet):
            J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)
            arm = np.array([0.0, 0.0, -0.022])
            linear_part = J[:3] - pin.skew(arm) @ J[3:]
            leg = np.flatnonzero(np.abs(J[:, 6:]).max(axis=0) > 0) + 6
            force = np.linalg.solve(linear_part[:, leg].T, left[leg])
            if loads[k, foot] == 0.0:
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
    model, data = on_ground(path)
    for coordinates in q[:, joint_order(model, robot)]:
        pin.framesForwardKinematics(model, data, coordinates)
        for foot, name in enumerate(feet):
            place = data.oMf[model.getFrameId(name)]
            assert np.allclose(place.translation, home.positions[0, foot], atol=1e-7)
            if feet is SOLES:
                assert np.allclose(place.rotation, home.rotations[0, foot], atol=1e-7)


def test_links_have_room_where_the_robot_stands(task, motions):
    (clearance,) = task.constraints
    robot = with_moving_base(motions.robot)
    for number in range(motions.phases):
        still_phase = motions.phase(number, np.zeros(motions.shape))
        q = still_phase.motion(motions.times).q
        gaps = np.asarray(clearance.model.clearance(robot, q)).min(axis=0)
        assert (gaps > 1.99 * clearance.distances).all()
    assert clearance.distances.max() == pytest.approx(0.03)
    assert 0.015 <= clearance.distances.min() < 0.03


def test_the_zero_moment_point_follows_its_path(task):
    """The check is that of the forces, between the instants of the search, too."""
    motions = MotionsOnFeet(task.setup.base, task.family["standing"], 20, 0.8)
    random = np.random.default_rng(1)
    times = np.linspace(0.0, motions.duration, 1001)
    for number in (0, 3):
        waves = 0.5 * motions.random(random)
        phase = motions.phase(number, waves)
        loads = motions.loads(number, times)
        forces = motions.forces(phase.motion(times), loads)
        path = motions._path(motions.loads(number, motions.times))
        shares = (motions.rows @ waves.T)[:, :2]
        path = path + motions._largest(number)[:2] * shares
        for axis in range(2):
            planned = np.interp(times, motions.times, path[:, axis])
            assert np.abs(forces.zero_moment_point[:, axis] - planned).max() < 0.005
        # The load moves smoothly: torques of a lifted leg do not jump.
        steps = np.abs(np.diff(forces.joint_forces, axis=0)).max()
        assert steps < 0.1 * np.abs(forces.joint_forces).max()


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
    forces = table.select(pl.selectors.starts_with("tau_")).to_numpy()
    times = table["time [s]"].to_numpy()
    assert np.allclose(forces, designed.plan.trajectory.feed_forward(times), atol=1e-6)
    message = yaml.safe_load((tmp_path / "motion.ros.yaml").read_text())
    assert np.allclose(message["points"][7]["effort"], forces[7], atol=1e-6)
    assert (flags.sum(axis=1) >= 3).all()
    assert (flags.min(axis=0) == 0).all()
    motion = load_trajectory(tmp_path / "motion.json")
    planned = motion.stands(table["time [s]"].to_numpy())
    assert (planned == flags).all()
    page = (tmp_path / "motion" / "report.html").read_text()
    assert "FL_foot" in page


def test_ctrl_c_keeps_the_best_motion_and_begin_goes_on(task, designed):
    def stop(progress):
        if progress.feasible:
            raise KeyboardInterrupt

    settings = {**task.family, "constraints": task.constraints}
    motion = designed.plan.trajectory
    plan = jid.design_excitation(
        task.setup.base,
        **settings,
        begin=motion,
        progress=stop,
        samples=designed.plan.samples,
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
    forces = motion.feed_forward(times)[:, order]
    stands = motion.stands(times)
    data.qpos[7:] = q[0]
    mujoco.mj_kinematics(model, data)
    feet = [model.geom(foot).id for foot in FEET]
    data.qpos[2] -= data.geom_xpos[feet, 2].min() - 0.022
    heights = []
    for k in range(len(times)):
        # With so soft controllers it falls without the forces.
        torques = 60.0 * (q[k] - data.qpos[7:]) + 2.0 * (qd[k] - data.qvel[6:])
        data.qfrc_applied[6:] = np.clip(torques + forces[k], -40.0, 40.0)
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
    with pytest.raises(jid.InputError, match="knees bent more"):
        jid.design_excitation(base, standing=straight)
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
    phase = motions.phase(0, motions.random(np.random.default_rng(0)))
    loads = motions.loads(0, motions.times)
    forces = motions.forces(phase.motion(motions.times), loads)

    def friction(coefficient):
        motions.standing = motions.standing._replace(friction=coefficient)
        return ChecksOnFeet(motions, motions.robot.limits, ())._friction(forces)

    assert friction(0.5).reached == pytest.approx(friction(0.1).reached)
    assert friction(0.1).value > friction(0.5).value
