"""Closed chains: MuJoCo's tree without the constraint, projected on the motors."""

import jax
import mujoco
import numpy as np
import pytest
from mechanisms import MECHANISMS, mjcf, projection

import jaxid as jid
from jaxid.errors import InputError
from jaxid.export.bodies_and_joint_dynamics import joint_dynamics
from jaxid.export.mujoco_model import mjcf_text
from jaxid.report.parameter_words import in_words
from jaxid.robot.loop_assembly import with_loops
from jaxid.robot.loop_closing import reachable
from jaxid.robot.urdf import urdf_parameters

SAMPLES = 6


@pytest.fixture(params=MECHANISMS)
def mechanism(request):
    return MECHANISMS[request.param]


@pytest.fixture
def path(mechanism, tmp_path):
    file = tmp_path / "mechanism.xml"
    file.write_text(mechanism.text)
    return file


def motion_of(robot, spread, samples=SAMPLES):
    """Random motion of the motors near the pose of the file."""
    random = np.random.default_rng(3)
    q, qd, qdd = random.uniform(-1.0, 1.0, (3, samples, robot.joints))
    middle = np.asarray(robot.loop_pose)[: robot.joints]
    return jid.Motion(middle + spread * q, 2.0 * qd, 5.0 * qdd)


def projected(mechanism, robot, motion):
    """Yield MuJoCo's projection, forces and mass matrix of each sample."""
    model = mechanism.tree()
    data = mujoco.MjData(model)
    names = [model.joint(k).name for k in range(model.njnt)]
    order = [robot.body_names.index(name) for name in names]
    motors = [names.index(name) for name in robot.joint_names]
    closed = robot.close(motion.q)
    for q, qd, qdd in zip(closed, motion.qd, motion.qdd, strict=True):
        tree = projection(model, data, q[order], motors, qd, qdd)
        data.qacc[:] = tree.qdd
        mujoco.mj_inverse(model, data)
        matrix = np.zeros((model.nv, model.nv))
        for row, unit in zip(matrix, np.eye(model.nv), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        forces = tree.ratios.T @ data.qfrc_inverse
        yield tree, forces, tree.ratios.T @ matrix @ tree.ratios, order


def test_forces_and_mass_matrix_are_projected_ones(mechanism, path):
    robot, p = jid.load_mjcf(path), urdf_parameters(path)
    assert robot.joint_names == mechanism.motors
    model = jid.Model(robot, (jid.RigidBodies(),))
    motion = motion_of(robot, mechanism.spread)
    _, forces, matrices, _ = zip(*projected(mechanism, robot, motion), strict=True)
    tolerance = {"rtol": 0, "atol": 1e-10 * np.abs(forces).max()}
    np.testing.assert_allclose(model.inverse_dynamics(p, motion), forces, **tolerance)
    theta = np.asarray(model.regressor(motion))
    np.testing.assert_allclose(theta @ p, forces, **tolerance)
    np.testing.assert_allclose(model.mass_matrix(p, motion.q), matrices, **tolerance)
    qdd = model.forward_dynamics(p, motion, np.array(forces))
    np.testing.assert_allclose(qdd, motion.qdd, atol=1e-9)
    # The spatial form is what JAX differentiates.
    sample = (robot.close(motion.q)[0], motion.qd[0], motion.qdd[0])
    columns = jax.jit(model.spatial_form.columns)(*sample)
    np.testing.assert_allclose(columns @ p, forces[0], **tolerance)


def test_friction_of_passive_joints_acts_by_the_ratios_of_mujoco(mechanism, path):
    robot = jid.load_mjcf(path)
    term = jid.terms.PassiveFriction()
    model = jid.Model(robot, (term,))
    motion = motion_of(robot, mechanism.spread)
    passive = range(robot.joints, robot.bodies)
    viscous, dry = np.random.default_rng(7).uniform(0.5, 2.0, (2, len(passive)))
    expected = []
    for tree, _, _, order in projected(mechanism, robot, motion):
        joints = [order.index(body) for body in passive]
        rates = tree.qd[joints]
        friction = viscous * rates + dry * np.tanh(rates / 0.01)
        expected.append(tree.ratios[joints].T @ friction)
    p = np.concatenate([viscous, dry])
    np.testing.assert_allclose(model.inverse_dynamics(p, motion), expected, atol=1e-9)
    np.testing.assert_allclose(model.regressor(motion) @ p, expected, atol=1e-9)
    assert (term.lower_bounds(robot) == 0.0).all()
    places = [in_words(name, model)[1] for name in model.parameter_names]
    assert places == 2 * [f"joint {robot.body_names[body]}" for body in passive]


def test_random_coordinates_are_moved_to_where_loops_close(mechanism, path):
    robot = jid.load_mjcf(path)
    start = np.asarray(robot.loop_pose)[: robot.joints]
    q = start + np.random.default_rng(3).uniform(-6.0, 6.0, (2, 100, robot.joints))
    safe = reachable(robot, q)
    assert safe.shape == q.shape
    # `close` refuses samples that stay open.
    robot.close(safe)
    assert (np.abs(safe - start) <= np.abs(q - start) + 1e-12).all()
    assert (np.ptp(safe, axis=(0, 1)) > 0.2).all()


def test_an_arm_has_no_passive_joints():
    arm = jid.robots.planar_arm()
    with pytest.raises(InputError, match="`passive_friction`"):
        _ = jid.Model(arm, (jid.terms.PassiveFriction(),)).parameter_names


def test_base_parameters_are_as_many_as_the_rank_of_the_projected_tree(mechanism, path):
    robot = jid.load_mjcf(path)
    base = jid.base_parameters(jid.Model(robot, (jid.RigidBodies(),)))
    assert base.smallest_independent > 1e6 * base.largest_dependent
    assert not base.notes

    tree_path = path.with_name("tree.xml")
    tree_path.write_text(mechanism.text.replace("<connect", "<connect active='false'"))
    tree = jid.Model(jid.load_mjcf(tree_path), (jid.RigidBodies(),))
    motion = motion_of(robot, mechanism.spread, 40)
    rows = []
    closed = robot.close(motion.q)
    for k, (sample, *_, order) in enumerate(projected(mechanism, robot, motion)):
        theta = tree.regressor(jid.Motion(closed[k, order], sample.qd, sample.qdd))
        rows.append(sample.ratios.T @ np.asarray(theta))
    stacked = np.concatenate(rows)
    norms = np.linalg.norm(stacked, axis=0)
    values = np.linalg.svd(stacked / np.where(norms > 1e-9, norms, 1.0))[1]
    assert base.size == np.count_nonzero(values > 1e-8 * values[0])


@pytest.mark.parametrize("mechanism", [MECHANISMS["slider"]])
def test_derivatives_are_those_of_differences(path):
    robot, p = jid.load_mjcf(path), urdf_parameters(path)
    motion = motion_of(robot, 0.5, 1)

    @jax.jit
    def forces(q, size):
        moved = robot.replace(offset=robot.offset * size)
        model = jid.Model(moved, (jid.RigidBodies(),))
        return model.inverse_dynamics(p, q, motion.qd[0], motion.qdd[0])[0]

    point = np.array([motion.q[0, 0], 1.0])
    slopes = jax.jit(jax.grad(forces, (0, 1)))(point[:1], point[1])
    for direction, slope in zip(1e-5 * np.eye(2), slopes, strict=True):
        after = point + direction
        before = point - direction
        change = forces(after[:1], after[1]) - forces(before[:1], before[1])
        np.testing.assert_allclose(np.ravel(slope), change / 2e-5, rtol=1e-6)


def test_loops_keep_their_branch_and_name_the_sample_that_does_not_close(tmp_path):
    path = tmp_path / "mechanism.xml"
    path.write_text(MECHANISMS["palletiser"].text)
    robot = jid.load_mjcf(path)
    t, u, c = np.random.default_rng(0).uniform(-0.5, 0.5, (3, 50))
    q = np.stack([t, 1.4 + u, 0.1 + c], axis=-1)
    # The other branch of the parallelogram has crossed bars.
    np.testing.assert_allclose(robot.close(q)[:, 3], q[:, 2] - q[:, 1], atol=1e-9)
    compiled = jax.jit(robot.close)
    np.testing.assert_allclose(compiled(q)[:, 3], q[:, 2] - q[:, 1])
    # Turned far, loops are followed on the way, and so are they one by one.
    far = q + np.array([2.5, 0.0, 0.0])
    np.testing.assert_allclose(robot.close(far)[:, 3], q[:, 2] - q[:, 1], atol=1e-9)
    each = jax.jit(jax.vmap(robot.close))(far)
    np.testing.assert_allclose(each, robot.close(far), atol=1e-9)
    slopes = jax.jit(jax.vmap(jax.jacrev(robot.close)))(q)
    np.testing.assert_allclose(slopes[:, 3], np.tile([0.0, -1.0, 1.0], (50, 1)))
    path.write_text(MECHANISMS["five-bar"].text)
    robot = jid.load_mjcf(path)
    q = np.array([[2.2, 0.9], [3.1, 0.0]])
    with pytest.raises(InputError, match=r"do not close at sample 1.*`pin` stay"):
        robot.close(q)
    assert np.isnan(jax.jit(robot.close)(q)[1]).all()


def test_no_step_jumps_over_a_singular_pose(tmp_path):
    path = tmp_path / "mechanism.xml"
    path.write_text(MECHANISMS["palletiser"].text)
    robot = jid.load_mjcf(path)
    start = np.asarray(robot.loop_pose)[:3]
    change = np.random.default_rng(5).uniform(-2.5, 2.5, (400, 3))
    # The bars of the parallelogram lie in a line where this angle is 0 or pi.
    angle = (start + change)[:, 1] - (start + change)[:, 2]
    is_before = (angle > 0.1) & (angle < np.pi - 0.1)
    is_behind = (angle < -0.1) | (angle > np.pi + 0.1)
    closed = np.asarray(jax.jit(robot.close)(start + change))
    assert np.isfinite(closed[is_before]).all()
    np.testing.assert_allclose(closed[is_before, 3], -angle[is_before], atol=1e-9)
    assert np.isnan(closed[is_behind]).all()
    coordinates = robot.close((start + change)[is_before])
    np.testing.assert_allclose(coordinates, closed[is_before], atol=1e-9)
    with pytest.raises(InputError, match="near a singular pose"):
        robot.close((start + change)[is_behind])


def test_loops_of_the_api_are_those_of_the_file(tmp_path):
    mechanism = MECHANISMS["palletiser"]
    path = tmp_path / "mechanism.xml"
    path.write_text(mechanism.text)
    robot = jid.load_mjcf(path)
    path.write_text(mechanism.text.replace("<connect", "<connect active='false'"))
    tree = jid.load_mjcf(path)
    loop = jid.robots.Loop(
        "pin",
        bodies=tuple(tree.body_names.index(x) for x in "fr"),
        points=[[-0.2, 0.0, 0.0], [0.8, 0.0, 0.0]],
    )
    pose = [mechanism.pose[name] for name in tree.body_names]
    closed = with_loops(tree, [loop], mechanism.motors, pose)
    assert closed.body_names == robot.body_names
    q = np.array([0.2, 1.3, 0.2])
    np.testing.assert_allclose(closed.close(q), robot.close(q), atol=1e-12)
    for motors, sentence in (
        (("t", "u", "u"), "names joint `u` twice"),
        (("t", "u", "x"), "but `x` is none of `t`, `u`"),
        (("t", "u"), "2 freedom.* but 1 motor.* at `u`"),
        (("t", "u", "c", "r"), "2 freedom.* but 3 motor"),
    ):
        with pytest.raises(InputError, match=sentence):
            with_loops(tree, [loop], motors, pose)


def test_files_whose_loops_do_not_close_are_one_sentence(tmp_path):
    mechanism = MECHANISMS["five-bar"]
    path = tmp_path / "mechanism.xml"
    path.write_text(mjcf(mechanism, mechanism.pose).replace(".3 0 0", ".02 0 0", 1))
    far = 'pos="4 0 0"><joint name="b1"'
    path.write_text(path.read_text().replace('pos=".1 0 0"><joint name="b1"', far))
    with pytest.raises(InputError, match=r"loop `pin` of .* m apart; give a pose"):
        jid.load_mjcf(path)
    path.write_text(mjcf(mechanism, mechanism.pose, motors=("a1",)))
    with pytest.raises(InputError, match=r"have 2 freedom.* but 1 motor.* at `a1`"):
        jid.load_mjcf(path)


def test_open_loops_are_closed_from_the_nearest_pose_which_a_note_states(tmp_path):
    mechanism = MECHANISMS["five-bar"]
    path = tmp_path / "mechanism.xml"
    path.write_text(mjcf(mechanism, mechanism.pose | {"a2": -1.4, "b1": 0.8}))
    robot = jid.load_mjcf(path)
    model = mechanism.tree()
    data = mujoco.MjData(model)
    for name, value in zip(robot.body_names, robot.loop_pose, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    first_point, second_point = data.site_xpos
    np.testing.assert_allclose(first_point, second_point, atol=1e-12)
    expected = [mechanism.pose[name] for name in robot.body_names]
    np.testing.assert_allclose(robot.loop_pose, expected, atol=0.2)
    assert any("closed from the nearest" in note for note in robot.notes)


PRESS = """<mujoco><worldbody>
<body pos="0 0 0.5"><joint name="crank" axis="0 1 0"/><geom size="0.1"/>
<body pos="0.12 0 0"><joint name="rod" axis="0 1 0"/><geom size="0.1"/>
<site name="a" pos="0.4 0 0"/></body></body>
<body pos="0.35 0 0.2"><joint name="rocker" axis="0 1 0"/><geom size="0.1"/>
<site name="b" pos="0 0 0.3"/>
<body pos="0 0 0.3"><joint name="tool" axis="0 1 0"/><geom size="0.1"/></body></body>
</worldbody><equality><connect site1="a" site2="b"/></equality>
<actuator><motor joint="crank"/><motor joint="tool"/></actuator></mujoco>"""


def test_a_joint_beside_an_open_loop_stays_at_zero_in_the_note(tmp_path):
    path = tmp_path / "press.xml"
    path.write_text(PRESS)
    assert "`tool` 0, `rod`" in jid.load_mjcf(path).notes[-1]


def test_a_body_that_a_weld_joins_is_that_of_a_joint(tmp_path):
    """The rod of the five-bar is cut behind its joint, and welded to its other part."""
    mechanism = MECHANISMS["five-bar"]
    path = tmp_path / "mechanism.xml"
    path.write_text(mechanism.text)
    robot = jid.load_mjcf(path)
    part = (
        '<body name="part" pos=".3 0 0" euler="0 -.5 0"><joint name="part" '
        'axis="0 -1 0"/><geom size=".01" mass="1"/></body>'
    )
    text = mechanism.text.replace('<site name="e1"', f'{part}<site name="e1"')
    weld = (
        '<weld name="pin" body1="b2" body2="part" relpose=".3 0 0 '
        f'{np.cos(0.4)} 0 {np.sin(0.4)} 0"/>'
    )
    text = text.replace('<connect name="pin" site1="e1" site2="e2"/>', weld)
    path.write_text(text[: text.index("<keyframe>")] + "</mujoco>")
    welded = jid.load_mjcf(path)
    assert welded.joint_names == robot.joint_names
    q = np.add(welded.loop_pose[:2], [[0.0, 0.0], [0.02, -0.03]])
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    for pose in welded.close(q):
        for name, value in zip(welded.body_names, pose, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_forward(model, data)
        # The three forces and three turns of the constraint.
        np.testing.assert_allclose(data.efc_pos[:6], 0.0, atol=1e-9)


@pytest.mark.parametrize("mechanism", [MECHANISMS["five-bar"]])
def test_bodies_that_a_loop_pins_together_may_touch(path):
    robot = jid.load_mjcf(path)
    rods = [
        jid.collision.Capsule(name, body, start=(0, 0, 0), end=(0.3, 0, 0), radius=0.02)
        for body, name in enumerate(robot.body_names)
    ]
    model = jid.collision.CollisionModel(robot, rods)
    assert set(model.pair_names) == {"a1 and b1", "a1 and b2", "b1 and a2"}


@pytest.mark.parametrize("mechanism", [MECHANISMS["palletiser"]])
def test_a_written_mjcf_file_closes_the_same_loops(path):
    robot, bodies = jid.load_mjcf(path), urdf_parameters(path)
    text = mjcf_text(robot, bodies.reshape(-1, 10), {})
    path.write_text(text)
    again = jid.load_mjcf(path)
    assert again.body_names == robot.body_names
    np.testing.assert_allclose(urdf_parameters(path), bodies, atol=1e-9)
    q = np.array([0.2, 1.3, 0.2])
    np.testing.assert_allclose(again.close(q), robot.close(q), atol=1e-9)


@pytest.mark.parametrize("mechanism", [MECHANISMS["slider"]])
def test_the_exported_function_takes_the_coordinates_of_the_motors(path):
    robot, p = jid.load_mjcf(path), urdf_parameters(path)
    terms = jid.RigidBodies(), jid.ViscousFriction()
    base = jid.base_parameters(jid.Model(robot, terms))
    motion = motion_of(robot, 0.5, 60)
    forces = base.model.inverse_dynamics(np.append(p, 2.0), motion)
    arrays = motion.q, motion.qd, motion.qdd
    observations = jid.Observations.of(*arrays, forces, sample_time=0.01)
    fit = jid.identify(base, observations)
    exported = jid.export.exported_function(fit)
    np.testing.assert_allclose(exported.call(*arrays), forces, atol=1e-6)
    assert "the closing of its loops" in joint_dynamics(fit).missing_in_urdf


@pytest.mark.parametrize("mechanism", [MECHANISMS["slider"]])
def test_designs_keep_away_from_singular_poses_and_limits_of_passive_joints(path):
    text = path.read_text().replace('type="slide"', 'type="slide" range="-.2 .4"')
    path.write_text(text)
    robot = jid.load_mjcf(path)
    limits = jid.constraints.LoopLimits()
    # At 1.57 the slide would be beyond its range; at 3.3 the loop is open.
    q = np.array([[0.9], [2.4], [3.3]])
    values = limits(robot, jid.Motion(q, 0 * q, 0 * q))
    names = [entry.name for entry in limits.entries(robot)]
    assert values.shape == (3, len(names))
    assert (values[0] <= 0).all()
    slide = robot.close(q[:2])[:, -1]
    lower = names.index("joint `slide`, which loops move,")
    np.testing.assert_allclose(values[:2, lower], (-0.2 - slide) / 0.3, atol=1e-9)
    motion = jid.Motion(q[:2], 0 * q[:2], 0 * q[:2])
    _, slopes = limits.linearisation(robot)(motion, np.full(2, lower))
    slide_change = robot.close(q[:2] + 1e-6) - robot.close(q[:2] - 1e-6)
    np.testing.assert_allclose(slopes[0][:, 0], -slide_change[:, -1] / 0.6e-6, 1e-6)
    problem = jid.ExcitationProblem(
        jid.base_parameters(jid.Model(robot, (jid.RigidBodies(),))), noise=[1.0]
    )
    assert type(problem.constraints[-1]) is jid.constraints.LoopLimits
