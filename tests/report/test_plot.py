"""Figures for notebooks: what they show, for small robots and logs."""

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image
from report_samples import arm_of, errors_of

import jaxid as jid
from jaxid.report.autocorrelation import autocorrelation
from jaxid.report.style import BLUE, GREEN, MEASURED, ORANGE, PREDICTED, plain_number
from jaxid.report.style import save as save_figure

T = np.linspace(0.0, 2.0, 101)


@pytest.fixture(scope="module")
def motion():
    q = np.stack([0.5 * np.sin(3.0 * T), 0.8 * np.cos(2.0 * T)], axis=1)
    qd = np.stack([1.5 * np.cos(3.0 * T), -1.6 * np.sin(2.0 * T)], axis=1)
    qdd = np.stack([-4.5 * np.sin(3.0 * T), -3.2 * np.cos(2.0 * T)], axis=1)
    return jid.Motion(q, qd, qdd)


def planar_tip(q):
    first, both = q[..., 0], q[..., 0] + q[..., 1]
    return np.stack([np.cos(first) + np.cos(both), np.sin(first) + np.sin(both)], axis=-1)


def tip_in_space(robot, motion):
    return np.asarray(jid.tip_motion(robot, motion).position)


def test_the_path_is_that_of_the_tip_and_its_colours_are_speeds(motion):
    robot = arm_of(2)
    figure = jid.plot.path(robot, motion, T)
    (line,) = [c for c in figure.axes[0].collections if c.get_array() is not None]
    reach = np.linalg.norm(tip_in_space(robot, motion), axis=1)
    np.testing.assert_allclose(reach, np.linalg.norm(planar_tip(motion.q), axis=1), atol=1e-12)
    ends = np.array(line._segments3d)[:, 0]
    np.testing.assert_allclose(ends, tip_in_space(robot, motion)[:-1], atol=1e-12)
    numerical = np.linalg.norm(np.gradient(tip_in_space(robot, motion), T, axis=0), axis=1)
    speeds = np.asarray(line.get_array())
    middle = 0.5 * (numerical[1:] + numerical[:-1])
    np.testing.assert_allclose(speeds[2:-2], middle[2:-2], atol=5e-3)
    assert f"up to {np.linalg.norm(jid.tip_motion(robot, motion).velocity, axis=1).max():.3g}" in (
        figure.texts[0].get_text()
    )


@pytest.mark.parametrize("flat", [0.02, 1.0])
def test_a_path_fills_its_figure_and_nothing_is_cut_off(motion, flat):
    robot = arm_of(2)
    q = np.asarray(motion.q) * [flat, 1.0]
    figure = jid.plot.path(robot, jid.Motion(q, motion.qd, motion.qdd), T)
    space, bar = figure.axes
    renderer = figure.canvas.get_renderer()
    figure.draw_without_rendering()
    box = Bbox.union([a.get_tightbbox(renderer) for a in (space.xaxis, space.yaxis, space.zaxis)])
    labels, page = bar.get_tightbbox(renderer), figure.bbox
    assert 0.0 <= box.x0 <= 0.05 * page.width
    assert 0.0 <= box.y0 <= 0.1 * page.height
    assert box.y1 <= page.height
    assert box.x1 < labels.x0
    assert labels.x1 <= page.width
    assert page.height <= page.width, "no room is left empty above and below"
    assert box.height > 0.5 * page.height


def test_poses_show_joints_capsules_and_what_stands_still(motion):
    robot = arm_of(2)
    shapes = (
        jid.Capsule("link", 1, start=(0.0, 0.0, 0.0), end=(1.0, 0.0, 0.0), radius=0.1),
        jid.Capsule("post", -1, start=(0.0, 1.5, 0.0), end=(0.0, 2.5, 0.0), radius=0.2),
    )
    collision = jid.CollisionModel(robot, shapes, pairs=(("link", "post"),))
    figure = jid.plot.poses(robot, motion.q, collision, poses=4)
    (axes,) = figure.axes
    polygons = [c for c in axes.collections if isinstance(c, PolyCollection)]
    bones = [c for c in axes.collections if isinstance(c, LineCollection)][1:]
    assert len(bones) == 4
    assert len(polygons) == 1 + 2 * 4, "what stands still once; capsules and joints in each pose"
    assert [len(p.get_paths()) for p in polygons] == [1, 1, 2, 1, 2, 1, 2, 1, 2]
    strengths = [b.get_alpha() for b in bones]
    assert strengths == sorted(strengths)
    assert strengths[-1] == 1.0
    last = np.array(bones[-1].get_segments())
    assert len(last) == robot.joints + 1
    np.testing.assert_allclose(last[1:, 0], last[:-1, 1], atol=1e-12, err_msg="a chain")
    # The stick figure ends where the drawn path does.
    np.testing.assert_allclose(last[-1, 1], axes.lines[0].get_xydata()[-1], atol=1e-12)
    assert len(jid.plot.poses(robot, motion.q[:1]).axes) == 1


def test_the_moving_picture_has_its_frames_and_its_time(motion, tmp_path):
    path = tmp_path / "arm.gif"
    jid.plot.animation(path, arm_of(2), T, motion.q, frames=5)
    with Image.open(path) as picture:
        assert picture.n_frames == 5
        assert picture.info["duration"] == pytest.approx(500.0, abs=10.0)
    with pytest.raises(ValueError, match="at least two pictures"):
        jid.plot.animation(path, arm_of(2), T[:1], motion.q[:1])


def test_desired_and_filtered_motion_stand_in_one_panel(motion):
    robot = arm_of(2)
    off = jid.Motion(motion.q, motion.qd + 0.1, motion.qdd - 0.2)
    figure = jid.plot.filtered(robot, T, motion, off, 1)
    for axes, wanted, found, said in (
        (figure.axes[0], motion.qd, off.qd, "0.1 rad/s"),
        (figure.axes[1], motion.qdd, off.qdd, "0.2 rad/s²"),
    ):
        lines = {x.get_color(): x.get_ydata() for x in axes.get_lines()}
        np.testing.assert_array_equal(lines[MEASURED], wanted[:, 1])
        np.testing.assert_array_equal(lines[PREDICTED], found[:, 1])
        assert axes.get_title(loc="right") == f"RMS difference {said}"
    with pytest.raises(ValueError, match="between 0 and 1, but is 2"):
        jid.plot.filtered(robot, T, motion, off, 2)


def test_torques_of_some_joints_beside_another_prediction():
    errors, robot = errors_of(3), arm_of(3)
    worse = dataclasses.replace(errors, predicted=errors.predicted + 7.0)
    figure = jid.plot.torques(errors, robot, joints=(2, 0), beside=(("worse", worse),))
    assert len(figure.axes) == 4
    uppers, lowers = figure.axes[::2], figure.axes[1::2]
    names = [axes.get_title(loc="left") for axes in uppers]
    assert names == [robot.joint_names[2], robot.joint_names[0]]
    for axes, j in zip(uppers, (2, 0), strict=True):
        (line,) = [x for x in axes.get_lines() if x.get_color() == GREEN]
        np.testing.assert_array_equal(line.get_ydata(), worse.predicted[:, j])
    for axes, j in zip(lowers, (2, 0), strict=True):
        assert axes.get_ylim()[1] > np.abs(worse.errors[:, j]).max()
    assert "worse" in [t.get_text() for t in figure.legends[0].get_texts()]
    for wrong in ((), (3,), (-1,)):
        with pytest.raises(ValueError, match="`joints` must hold numbers from 0 to 2"):
            jid.plot.torques(errors, robot, joints=wrong)


def test_bars_of_several_groups():
    robot, first, second = arm_of(3), errors_of(3), errors_of(3, seed=1)
    figure = jid.plot.bars((("LS", (first,)), ("WLS", (second,)), ("CAD", (first,))), robot)
    bars = figure.axes[0].patches
    assert len(bars) == 9
    assert len({to_hex(b.get_facecolor()) for b in bars}) == 3
    spans = sorted((b.get_x(), b.get_x() + b.get_width()) for b in bars)
    assert all(a[1] < b[0] for a, b in itertools.pairwise(spans)), "none hides another"
    with pytest.raises(ValueError, match="1 to 4 groups"):
        jid.plot.bars((), robot)
    colours = {
        to_hex(b.get_facecolor()) for b in jid.plot.errors((first,), (), robot).axes[0].patches
    }
    assert colours == {BLUE.lower()}
    assert ORANGE.lower() not in colours


def test_autocorrelation_is_that_of_the_plain_formula():
    random = np.random.default_rng(0)
    counted = random.uniform(size=(400, 2)) > 0.2
    e = np.zeros((400, 2))
    for k in range(1, 400):
        e[k] = 0.7 * e[k - 1] + random.standard_normal(2)
    whole = errors_of(2, rows=400)
    errors = dataclasses.replace(whole, predicted=whole.measured + e, counted=counted)
    found = autocorrelation(errors, 6)
    for j in range(2):
        kept = np.where(counted[:, j], e[:, j] - e[counted[:, j], j].mean(), np.nan)
        products = [np.nanmean(kept[: 400 - k] * kept[k:]) for k in range(6)]
        np.testing.assert_allclose(found[:, j], np.array(products) / products[0], atol=1e-12)
    assert abs(found[1] - 0.7).max() < 0.12
    figure = jid.plot.autocorrelation(errors, arm_of(2))
    drawn = figure.axes[0].get_lines()[1].get_ydata()
    np.testing.assert_allclose(drawn[:6], found[:, 0], atol=1e-12)
    with pytest.raises(ValueError, match="three rows at least"):
        jid.plot.autocorrelation(errors_of(2, rows=2), arm_of(2))


def test_all_names_exist_and_load_matplotlib_only_when_used():
    for name in jid.plot.__all__:
        assert callable(getattr(jid.plot, name)), name
    with pytest.raises(AttributeError, match="has no `tourques`"):
        getattr(jid.plot, "tour" + "ques")
    script = (
        "import sys, jaxid as jid\n"
        "dir(jid.plot)\n"
        "assert 'matplotlib' not in sys.modules\n"
        "jid.plot.torques\n"
        "assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_files_are_the_same_each_time_and_leave_the_figure_as_it_was(suffix, tmp_path):
    figure = jid.plot.bars((("a", (errors_of(2),)),), arm_of(2))
    assert isinstance(figure, Figure)
    before = (figure.canvas, figure.dpi)
    for name in "ab":
        save_figure(figure, tmp_path / f"{name}{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()
    assert (figure.canvas, figure.dpi) == before


@pytest.mark.parametrize(
    ("value", "label"),
    [(0.01, "0.01"), (1000.0, "1000"), (1e-5, "10⁻⁵"), (2e-7, "2·10⁻⁷"), (1e6, "10⁶")],
)
def test_labels_of_logarithmic_scales_are_plain_letters(value, label):
    assert plain_number(value) == label
