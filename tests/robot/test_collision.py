"""Distances of capsules, planes, boxes against Coal and points; derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forward_kinematics import body_transforms, random_configuration

from jaxid.robot import library
from jaxid.robot.collision import Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.shapes import ROUNDING, segment_distance

ALONG = np.linspace(0.0, 1.0, 401)[:, None]


def segments(seed, count=200, scale=1.0):
    return scale * np.random.default_rng(seed).uniform(-1.0, 1.0, (4, count, 3))


def brute_force(a, b, c, d):
    """Least distance between points of two segments."""
    x, y = a + ALONG * (b - a), c + ALONG * (d - c)
    return np.linalg.norm(x[:, None] - y[None], axis=2).min()


@pytest.mark.parametrize("scale", [1.0, 1e-6])
def test_segments_agree_with_points_on_them_and_are_never_too_far(scale):
    ends = segments(0, 50, scale)
    distances = np.asarray(segment_distance(*ends))
    expected = np.array([brute_force(*ends[:, k]) for k in range(50)])
    assert (distances <= expected + 1e-15).all()
    assert (distances >= expected - 6e-3 * scale - 2 * ROUNDING).all()


SPECIAL = {
    "parallel side by side": [(0, 0, 0), (1, 0, 0), (0.3, 0.5, 0), (0.8, 0.5, 0), 0.5],
    "parallel apart": [(0, 0, 0), (1, 0, 0), (6, 0, 0), (5, 0, 0), 4.0],
    "collinear overlap": [(0, 0, 0), (1, 0, 0), (0.5, 0, 0), (2, 0, 0), 0.0],
    "crossing": [(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), 0.0],
    "touching ends": [(0, 0, 0), (1, 0, 0), (1, 0, 0), (1, 1, 0), 0.0],
    "point and segment": [(0.5, 2, 0), (0.5, 2, 0), (0, 0, 0), (1, 0, 0), 2.0],
    "two points": [(0, 0, 0), (0, 0, 0), (0, 3, 4), (0, 3, 4), 5.0],
    "the same segment": [(0, 0, 0), (1, 1, 1), (0, 0, 0), (1, 1, 1), 0.0],
    "nearly parallel": [(0, 0, 0), (1, 0, 0), (0, 0.5, 0), (1, 0.5 + 1e-9, 0), 0.5],
}


GRADIENT = jax.jit(jax.grad(segment_distance, argnums=(0, 1, 2, 3)))


@pytest.mark.parametrize("name", SPECIAL)
def test_special_segments_have_a_distance_and_a_derivative(name):
    *ends, expected = SPECIAL[name]
    ends = [np.array(x, float) for x in ends]
    assert float(segment_distance(*ends)) == pytest.approx(expected, abs=2 * ROUNDING)
    gradient = GRADIENT(*ends)
    assert np.isfinite(gradient).all()
    assert np.linalg.norm(np.asarray(gradient).reshape(-1)) <= 2.0 + 1e-9


def coal_capsule(coal, start, end, radius):
    """Coal's capsule about its own z axis, and its pose."""
    length = np.linalg.norm(end - start)
    z = (end - start) / length
    x = np.cross(z, [1.0, 0, 0] if abs(z[0]) < 0.9 else [0, 1.0, 0])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1)
    return coal.Capsule(radius, length), coal.Transform3s(R, 0.5 * (start + end))


def a_box():
    R = library.tx90l_on_rail().rotation[2]
    turn = np.array(
        [[np.cos(0.4), -np.sin(0.4), 0], [np.sin(0.4), np.cos(0.4), 0], [0, 0, 1]]
    )
    return Box("box", centre=(0.2, -0.1, 0.3), size=(0.6, 0.4, 0.8), rotation=turn @ R)


def test_boxes_agree_with_coal():
    coal = pytest.importorskip("coal")
    box, ends = a_box(), segments(5, 80)[:2] * 1.5
    distances = np.asarray(box.distance(*map(jnp.asarray, ends)))
    place = coal.Transform3s(np.ascontiguousarray(box.rotation), box.centre)
    compared = 0
    for k in range(80):
        capsule = coal_capsule(coal, ends[0, k], ends[1, k], 1e-9)
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        expected = coal.distance(*capsule, coal.Box(*box.size), place, request, result)
        if expected > 1e-3:
            compared += 1
            assert distances[k] == pytest.approx(expected, abs=3e-6)
        else:
            assert distances[k] < 2e-3
    assert compared > 20


def test_the_depth_in_a_box_is_that_to_the_nearest_face():
    box = Box("box", centre=(0, 0, 0), size=(2, 2, 2))
    starts = np.array([[0.0, 0.0, 0.9], [0.0, 0.7, 0.0], [-3.0, 0.2, 0.1]])
    ends = np.array([*starts[:2], [3.0, 0.2, 0.1]])
    distances = jax.jit(lambda *x: box.distance(*x))(starts, ends)
    np.testing.assert_allclose(distances, [-0.1, -0.3, -0.8], atol=2e-6)


def test_ends_are_where_plain_numpy_puts_them():
    robot, model = library.tx90l_on_rail(), library.tx90l_on_rail_collision()
    q = random_configuration(robot, 3)
    poses = body_transforms(robot, q)
    ends = np.asarray(model.ends(robot, q))
    for capsule, (start, end) in zip(model.capsules, ends, strict=True):
        T = poses[capsule.body] if capsule.body >= 0 else np.eye(4)
        np.testing.assert_allclose(
            start, T[:3, :3] @ capsule.start + T[:3, 3], atol=1e-13
        )
        np.testing.assert_allclose(end, T[:3, :3] @ capsule.end + T[:3, 3], atol=1e-13)


def test_pairs_are_found_where_none_are_named():
    robot = library.planar_arm(3)
    links = [
        Capsule(f"link {i}", i, start=(0, 0, 0), end=(1, 0, 0), radius=0.05)
        for i in range(3)
    ]
    hub = Capsule("hub", -1, start=(0, 0, 0), radius=0.1)
    floor = HalfSpace("floor", normal=(0, 1, 0), height=-9.0)
    names = CollisionModel(robot, [*links, hub], [floor]).pair_names
    assert {"link 0 and link 2", "link 1 and hub", "link 2 and floor"} <= set(names)
    assert not {"link 0 and link 1", "link 0 and hub"} & set(names)  # neighbours
    fat = Capsule("link 2", 2, start=(0, 0, 0), end=(1, 0, 0), radius=8.0)
    model = CollisionModel(robot, [*links[:2], fat, hub], [floor])
    assert "link 0 and link 2" not in model.pair_names
    assert any("link 0 and link 2" in note for note in model.notes)


@pytest.mark.parametrize(
    ("distance", "ends"),
    [
        (segment_distance, segments(2)),
        (a_box().distance, segments(6)[:2] * 1.5),
        (
            HalfSpace("wall", normal=(1.0, 2.0, 0.5), height=0.3).distance,
            segments(6)[:2] * 1.5,
        ),
    ],
)
def test_derivatives_are_difference_quotients(distance, ends):
    compiled = jax.jit(lambda x: distance(*x))
    gradient = jax.jit(jax.grad(lambda x: jnp.sum(compiled(x))))(ends)
    h, direction = 1e-6, np.random.default_rng(3).standard_normal(ends.shape)
    up, down = (np.asarray(compiled(ends + s * h * direction)) for s in (1, -1))
    along = np.sum(np.asarray(gradient) * direction, axis=(0, 2))
    np.testing.assert_allclose(along, (up - down) / (2 * h), atol=1e-6)
