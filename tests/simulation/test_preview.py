"""Preview in MuJoCo: its shapes are where this package computes them; what it refuses."""

import sys
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.robot import library
from jaxid.robot.collision import Box, Capsule, CollisionModel, HalfSpace
from jaxid.robot.rotations import rpy_rotation
from jaxid.simulation import preview
from jaxid.trajectory import random_fourier_series

PANDA = library.panda()
TURNED = rpy_rotation(np.array([0.3, -0.2, 0.5]))


@pytest.fixture(scope="module")
def shapes():
    capsules = [Capsule("stand", -1, start=(0, 0, 0), end=(0, 0, 0.2), radius=0.1)]
    for body in range(7):
        start, end = (0.1, 0.0, -0.05), (0.0, 0.1, 0.05 * body)
        capsules.append(
            Capsule(f"link {body}", body, start=start, end=end, radius=0.05)
        )
    capsules.append(Capsule("<ball> & 'tool'", 6, start=(0.0, 0.0, 0.3), radius=0.08))
    box = Box("table", centre=(0.6, 0.0, 0.2), size=(0.8, 1.2, 0.4), rotation=TURNED)
    floor = HalfSpace("floor", normal=(0.1, 0.0, 1.0), height=-0.2)
    return CollisionModel(PANDA, capsules, [box, floor])


def test_shapes_are_where_they_are_checked(shapes):
    model = mujoco.MjModel.from_xml_string(preview.preview_mjcf(PANDA, shapes))
    data = mujoco.MjData(model)
    rows = preview.positions(random_fourier_series(PANDA, omega=0.8, seed=0))
    for q in rows[::100]:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        assert data.ncon == 0  # shapes are seen, and push nothing
        expected = np.asarray(shapes.ends(PANDA, q))
        for capsule, (start, end) in zip(shapes.capsules, expected, strict=True):
            geom = data.geom(capsule.name)
            axis = geom.xmat.reshape(3, 3)[:, 2] * model.geom(capsule.name).size[1]
            np.testing.assert_allclose(geom.xpos, 0.5 * (start + end), atol=1e-12)
            half = 0.5 * (end - start)
            half *= np.sign(half @ axis) or 1.0  # both ends of a capsule are alike
            np.testing.assert_allclose(
                axis if half.any() else 0.0 * axis, half, atol=1e-12
            )
            assert model.geom(capsule.name).size[0] == pytest.approx(
                float(capsule.radius)
            )
    box, floor = data.geom("table"), data.geom("floor")
    np.testing.assert_allclose(box.xpos, [0.6, 0.0, 0.2], atol=1e-12)
    np.testing.assert_allclose(box.xmat.reshape(3, 3), TURNED, atol=1e-12)
    np.testing.assert_allclose(model.geom("table").size, [0.4, 0.6, 0.2])
    normal = np.array([0.1, 0.0, 1.0]) / np.hypot(0.1, 1.0)
    np.testing.assert_allclose(floor.xmat.reshape(3, 3)[:, 2], normal, atol=1e-12)
    assert floor.xpos @ normal == pytest.approx(-0.2)


class Window:
    """MuJoCo's viewer without a display: records poses."""

    def __init__(self, model, data, **settings):
        self.data, self.poses = data, []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def is_running(self):
        return len(self.poses) < 8

    def sync(self):
        self.poses.append(self.data.qpos.copy())


def test_the_viewer_shows_the_motion_in_time(shapes, monkeypatch):
    windows, now = [], iter(np.arange(100) * 1.5)

    def launch_passive(*args, **settings):
        windows.append(Window(*args, **settings))
        return windows[0]

    viewer = SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", viewer)
    monkeypatch.setitem(sys.modules, "glfw", SimpleNamespace(init=lambda: True))
    clock = SimpleNamespace(monotonic=lambda: next(now), sleep=lambda _: None)
    monkeypatch.setattr(preview, "time", clock)
    motion = random_fourier_series(PANDA, omega=0.8, seed=0)
    preview.play(PANDA, shapes, motion)
    # One look at the clock begins; after 7.85 s and a pause of 1 s the motion begins
    # again.
    times = np.array([1.5, 3.0, 4.5, 6.0, 7.5, 9.0, 10.5, 12.0])
    times = np.minimum(times % (float(motion.duration) + 1.0), float(motion.duration))
    speed = np.abs(np.asarray(motion.motion(np.linspace(0, 7, 99)).qd)).max()
    expected = np.asarray(motion.motion(times).q)
    np.testing.assert_allclose(
        windows[0].poses, expected, rtol=0, atol=2 * speed / preview.RATE
    )


@pytest.mark.parametrize(
    ("module", "found", "said"),
    [
        ("mujoco", None, r'the package `mujoco`: install it \(`pip install "jaxid-rob'),
        (
            "glfw",
            SimpleNamespace(init=lambda: False),
            "a preview needs a display, and none",
        ),
    ],
)
def test_without_mujoco_or_display_one_sentence_says_so(
    monkeypatch, module, found, said
):
    monkeypatch.setitem(sys.modules, module, found)
    monkeypatch.setitem(sys.modules, "mujoco.viewer", SimpleNamespace())
    with pytest.raises(InputError, match=said):
        preview.play(PANDA, None, random_fourier_series(PANDA, omega=0.8, seed=0))
