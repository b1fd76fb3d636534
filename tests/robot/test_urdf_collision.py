"""Capsules around a URDF's geometry: nothing sticks out, nothing is much too large."""

import numpy as np
import pytest
import trimesh
from forward_kinematics import body_transforms
from scipy.spatial.transform import Rotation
from urdf_text import joint, link, robot

from jaxid.report.motion_figures import surface_points
from jaxid.robot.capsule_fit import enclose, fit_capsules
from jaxid.robot.collision import CollisionModel
from jaxid.robot.urdf import load_urdf
from jaxid.workflow.robot_file import RobotFile


def collision(geometry, origin=""):
    return f"<collision>{origin}<geometry>{geometry}</geometry></collision>"


def written(tmp_path, tool='<sphere radius="0.03"/>'):
    turned = '<origin xyz="0.3 0 0" rpy="0 1.5707963267948966 0"/>'
    upper = collision('<cylinder radius="0.05" length="0.6"/>', turned)
    upper += collision('<sphere radius="0.08"/>', '<origin xyz="0 0 0.1"/>')
    path = tmp_path / "arm.urdf"
    path.write_text(
        robot(
            link("base", collision('<cylinder radius="0.2" length="0.4"/>')),
            link("upper", upper),
            link("plate", collision('<box size="0.1 0.3 0.02"/>')),
            link("tool", collision(tool)),
            joint("j1", "base", "upper", xyz="0 0 0.4"),
            joint("flange", "upper", "plate", "fixed", xyz="0.6 0 0", rpy="0 0 0.3"),
            joint("j2", "plate", "tool", xyz="0 0 0.1", axis="0 1 0"),
        )
    )
    return path


def outside(points, start, end, radius):
    """How far points stick out of a capsule [m]."""
    axis = np.asarray(end) - start
    length = axis @ axis
    along = np.clip((points - start) @ axis / (length if length > 0 else 1.0), 0.0, 1.0)
    return np.linalg.norm(points - start - along[:, None] * axis, axis=1) - radius


def volume(start, end, radius):
    return np.pi * radius**2 * (np.linalg.norm(end - start) + 4 / 3 * radius)


@pytest.mark.parametrize("seed", range(2))
def test_all_points_are_inside_and_the_capsule_is_small(seed):
    random = np.random.default_rng(seed)
    shape = random.standard_normal((400, 3)) * random.uniform(0.05, 1.0, 3)
    rotation = np.linalg.qr(random.standard_normal((3, 3)))[0]
    points = shape @ rotation + random.standard_normal(3)
    capsule = enclose(points)
    assert outside(points, *capsule).max() <= 1e-12
    # Not larger than the sphere about the box of the points, and tight somewhere.
    centre = 0.5 * (points.max(0) + points.min(0))
    sphere = np.linalg.norm(points - centre, axis=1).max()
    assert volume(*capsule) <= 4 / 3 * np.pi * sphere**3 * (1 + 1e-6)
    assert outside(points, *capsule).max() >= -1e-6


def test_a_capsule_is_found_again():
    random = np.random.default_rng(9)
    start, end, radius = np.array([0.1, 0.2, 0.3]), np.array([0.5, -0.1, 0.9]), 0.15
    direction = random.standard_normal((4000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    along = random.uniform(size=(4000, 1)).round(1)
    points = start + along * (end - start) + radius * direction
    capsule = enclose(points)
    assert volume(*capsule) <= 1.03 * volume(start, end, radius)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_few_or_flat_points(count):
    points = np.random.default_rng(count).standard_normal((count, 3))
    points[:, 2] = 0.5
    assert outside(points, *enclose(points)).max() <= 1e-12


def test_capsules_hold_the_geometry_on_its_bodies(tmp_path):
    path = written(tmp_path)
    arm = load_urdf(path, base_position=(0.0, 0.0, 1.0))
    capsules = fit_capsules(path, base_position=(0.0, 0.0, 1.0))
    names = [c.name for c in capsules]
    assert names == ["base", "upper", "upper 2", "plate", "tool"]
    assert [c.body for c in capsules] == [-1, 0, 0, 0, 1]
    ground, upper, ball, plate, tool = capsules
    np.testing.assert_allclose(
        [ground.start, ground.end], [[0, 0, 0.8], [0, 0, 1.2]], atol=1e-12
    )
    np.testing.assert_allclose(
        sorted([upper.start[0], upper.end[0]]), [0.0, 0.6], atol=1e-12
    )
    np.testing.assert_allclose(ball.start, [0, 0, 0.1], atol=1e-12)
    assert float(ball.radius) == 0.08
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = signs * [0.05, 0.15, 0.01]
    turn = np.array(
        [[np.cos(0.3), -np.sin(0.3), 0], [np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]]
    )
    placed = corners @ turn.T + [0.6, 0, 0]
    assert outside(placed, plate.start, plate.end, plate.radius).max() <= 1e-9
    assert float(plate.radius) < 0.06
    np.testing.assert_allclose(tool.start, 0.0, atol=1e-12)
    model = CollisionModel(arm, capsules)
    assert "base and tool" in model.pair_names
    # The frames are those of the robot: the upright cylinder is where its joint is.
    pose = body_transforms(arm, np.zeros(2))
    np.testing.assert_allclose(pose[0][:3, 3], [0, 0, 1.4], atol=1e-12)


def test_a_mesh_is_held_whole(tmp_path):
    meshes = tmp_path / "arm_description" / "meshes"
    meshes.mkdir(parents=True)
    mesh = trimesh.creation.cylinder(radius=30.0, height=200.0)
    mesh.export(meshes / "tool.stl")
    path = written(
        tmp_path,
        '<mesh filename="package://arm_description/meshes/tool.stl" scale="0.001 '
        '0.001 0.001"/>',
    )
    tool = fit_capsules(path)[-1]
    points = 0.001 * np.asarray(mesh.vertices)
    assert outside(points, tool.start, tool.end, tool.radius).max() <= 1e-7
    assert float(tool.radius) < 0.034
    (meshes / "tool.stl").rename(meshes / "other.stl")
    with pytest.raises(FileNotFoundError, match=r"line 6: the mesh .* `packages`"):
        fit_capsules(path)


def test_a_picture_has_the_shapes_of_the_file_on_their_bodies(tmp_path):
    file = RobotFile(written(tmp_path), base_position=(0.0, 0.0, 1.0))
    clouds = [(body, surface_points(shape)) for body, shape in file.shapes()]
    assert sorted(body for body, _ in clouds) == [-1, 0, 0, 0, 1]
    ((_, base),) = [cloud for cloud in clouds if cloud[0] == -1]
    np.testing.assert_allclose(base[:, 2].mean(), 1.0, atol=0.02)
    assert np.linalg.norm(base[:, :2], axis=1).max() == pytest.approx(0.2, rel=0.01)
    # The plate, a box, has its corners on the body that it is fixed to.
    plate = next(points for _, points in clouds if len(points) == 8)
    turned = Rotation.from_euler("z", 0.3).inv().apply(plate - [0.6, 0.0, 0.0])
    np.testing.assert_allclose(np.abs(turned), np.tile([0.05, 0.15, 0.01], (8, 1)))


def test_grippers_that_the_chain_leaves_out_count_as_bodies_that_collide(tmp_path):
    fingers = "".join(
        f'<link name="{name}"><collision><geometry><sphere radius="0.01"/></geometry>'
        f'</collision></link><joint name="j{name}" type="prismatic">'
        f'<parent link="tool"/><child link="{name}"/><origin xyz="0 {y} 0.1"/>'
        '<axis xyz="0 1 0"/><limit lower="0.02" upper="0.04"/></joint>'
        for name, y in (("left", 0.1), ("right", -0.1))
    )
    path = written(tmp_path)
    path.write_text(path.read_text().replace("</robot>", f"{fingers}</robot>"))
    arm = load_urdf(path, tip="tool")
    capsules = {c.name: c for c in fit_capsules(path, tip="tool")}
    assert (
        capsules["left"].body
        == capsules["right"].body
        == capsules["tool"].body
        == arm.joints - 1
    )
    # They are held as near to zero as they can be.
    shift = np.array(capsules["left"].start) - capsules["tool"].start
    np.testing.assert_allclose(np.linalg.norm(shift), np.hypot(0.12, 0.1), atol=1e-9)


def test_shapes_of_mjcf_files_are_held(tmp_path):
    mujoco = pytest.importorskip("mujoco")
    path = tmp_path / "arm.xml"
    path.write_text("""<mujoco><worldbody>
    <geom type="plane" size="3 3 1"/>
    <body name="one" pos="0 0 0.3"><joint axis="0 1 0"/>
      <geom type="capsule" size="0.05" fromto="0 0 0 0.4 0 0"/>
      <geom type="box" size="1 1 1" contype="0" conaffinity="0"/>
      <body name="two" pos="0.5 0 0" euler="0 0 30"><joint axis="0 1 0"/>
        <geom type="box" size="0.1 0.05 0.02" pos="0.1 0 0" euler="0 20 0"/>
        <body name="three" pos="0.3 0 0"><geom type="sphere" size="0.03"/></body>
    </body></body></worldbody></mujoco>""")
    one, two, three = fit_capsules(path)
    assert [c.name for c in (one, two, three)] == ["one", "two", "three"]
    assert [c.body for c in (one, two, three)] == [0, 1, 1]
    assert float(one.radius) == pytest.approx(0.05)
    assert np.linalg.norm(one.end - one.start) == pytest.approx(0.4)
    # No larger than the capsule through the corners along the box's longest edge.
    along = volume(np.zeros(3), np.array([0.2, 0.0, 0.0]), np.hypot(0.05, 0.02))
    assert volume(two.start, two.end, float(two.radius)) <= along
    model = mujoco.MjModel.from_xml_path(str(path))
    R = Rotation.from_quat(model.geom_quat[3], scalar_first=True).as_matrix()
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = (signs * [0.1, 0.05, 0.02]) @ R.T + [0.1, 0, 0]
    assert outside(corners, two.start, two.end, two.radius).max() <= 1e-9
    np.testing.assert_allclose(three.start, [0.3, 0, 0], atol=1e-9)
