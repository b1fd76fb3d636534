"""Figures: what they show and where it stands, not their pixels; for small robots and logs."""

import dataclasses
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from PIL import Image

import jaxid as jid
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.report.estimates_and_residuals import autocorrelation
from jaxid.report.style import BLUE, ERROR, GREY, MEASURED, ORANGE, PREDICTED
from jaxid.report.torques import decimate

T = np.linspace(0.0, 2.0, 101)


def arm_of(joints):
    return jid.robots.planar_arm(joints)


def line(axes, colour):
    (found,) = [x for x in axes.get_lines() if x.get_color() == colour]
    return found


def heights(figure, colour):
    bars = figure.axes[0].patches
    return [p.get_height() for p in bars if to_hex(p.get_facecolor()) == colour.lower()]


def require_everything_inside(figure):
    """No text is cut off by the edge, and no panel's title touches another panel or title."""
    figure.canvas.draw()
    page, to_inches = figure.bbox_inches, figure.dpi_scale_trans.inverted()
    texts = [t.get_window_extent().transformed(to_inches) for t in figure.texts]
    for box in (figure.get_tightbbox(figure.canvas.get_renderer()), *texts):
        assert (box.min >= page.min - 0.01).all()
        assert (box.max <= page.max + 0.01).all()
    for axes in figure.axes:
        others = [o.get_window_extent() for o in figure.axes if o is not axes]
        titles = [t for t in (axes._left_title, axes._right_title) if t.get_text()]
        boxes = [t.get_window_extent() for t in titles]
        assert not any(box.overlaps(o) for box in boxes for o in others)
        assert len(boxes) < 2 or not boxes[0].overlaps(boxes[1])


def test_torques_show_what_was_measured_and_predicted(fit, validation):
    errors, robot = validation.errors[0], fit.base.model.robot
    figure = jid.plot.torques(errors, robot)
    assert len(figure.axes) == 4
    for j, (unit, word) in enumerate((("N", "force"), ("N m", "torque"))):
        upper, lower = figure.axes[2 * j : 2 * j + 2]
        np.testing.assert_array_equal(line(upper, MEASURED).get_ydata(), errors.measured[:, j])
        np.testing.assert_array_equal(line(upper, PREDICTED).get_ydata(), errors.predicted[:, j])
        np.testing.assert_array_equal(line(lower, ERROR).get_ydata(), errors.errors[:, j])
        assert upper.get_title(loc="left") == robot.joint_names[j]
        assert (upper.get_ylabel(), lower.get_ylabel()) == (f"{word} [{unit}]", f"[{unit}]")
        said = upper.get_title(loc="right").split(f" {unit} = ")[1].split(" %")[0]
        assert float(said) == pytest.approx(errors.mean_percent[j], rel=0.06)
    require_everything_inside(figure)


def test_long_names_fit_on_the_page(errors_of):
    joints = 3
    names = tuple(f"a_long_name_of_the_joint_number_{i}" for i in range(joints))
    robot = arm_of(joints).replace(joint_names=names)
    errors = errors_of(joints, name="a recording with a name that goes on and on and on and on")
    f, half = np.linspace(0.0, 20.0, 50), np.full(joints, 0.5)
    density = np.random.default_rng(0).exponential(size=(joints, 50))
    spectra = ResidualSpectra(f, density, 1.0 / (1.0 + (f / 10) ** 4), half, 0.1, half, 9.5)
    require_everything_inside(jid.plot.torques(errors, robot))
    require_everything_inside(jid.plot.errors((errors,), (errors,), robot))
    require_everything_inside(jid.plot.residuals(spectra, robot))


def test_residuals_stand_beside_white_ones(fit):
    spectra = fit.residual_spectra
    figure = jid.plot.residuals(spectra, fit.base.model.robot)
    for j, axes in enumerate(figure.axes):
        own, white = line(axes, BLUE), line(axes, GREY).get_ydata()
        shown = np.isin(np.asarray(spectra.frequency), own.get_xdata())
        np.testing.assert_array_equal(own.get_ydata(), np.asarray(spectra.density)[j][shown])
        np.testing.assert_allclose(white.sum(), own.get_ydata().sum())
        assert axes.get_ylabel() == ("N²/Hz", "(N m)²/Hz")[j]
        assert ("not white" in axes.get_title(loc="right")) != spectra.white[j]
    require_everything_inside(figure)


def test_bars_are_percents_of_the_largest_forces(errors_of):
    first, second = errors_of(3, seed=1), errors_of(3, seed=2)
    figure = jid.plot.errors((first,), (second,), arm_of(3))
    np.testing.assert_allclose(heights(figure, BLUE), first.mean_percent)
    np.testing.assert_allclose(heights(figure, ORANGE), second.mean_percent)
    marks = [x.get_ydata() for x in figure.axes[0].get_lines() if x.get_marker() == "D"]
    np.testing.assert_allclose(marks, [first.rms_percent, second.rms_percent])
    assert figure.axes[0].get_ylabel() == "error [% of the largest force]"
    unknown = dataclasses.replace(first, max_forces=np.array([50.0, np.nan, 50.0]))
    figure = jid.plot.errors((unknown,), (), arm_of(3))
    np.testing.assert_allclose(heights(figure, BLUE), 100 * first.mean / first.force_rms)
    assert figure.axes[0].get_ylabel() == "error [% of RMS force]"
    assert not heights(figure, ORANGE)


def test_long_lines_keep_every_peak_and_their_ends_and_short_ones_all_points():
    random = np.random.default_rng(0)
    t, y = np.arange(100_000) * 1e-3, random.standard_normal(100_000)
    y[12_345], y[77_777] = 9.0, -9.0
    times, values = decimate(t, y, 300)
    assert len(times) <= 600
    assert (values.max(), values.min()) == (9.0, -9.0)
    assert abs(times[np.argmax(values)] - t[12_345]) < 100.0 / 300
    assert (times[0], times[-1]) == (t[0], t[-1])
    assert (np.diff(times) >= 0).all()
    np.testing.assert_array_equal(decimate(t[:100], y[:100], 100), (t[:100], y[:100]))


@pytest.mark.parametrize("rows", [100, 50_000])
def test_gaps_in_time_break_the_line_and_missing_values_stay_out(rows):
    t, y = np.arange(rows) / rows, np.ones(rows)
    t[rows // 2 :] += 1.0
    times, values = decimate(t, y, 200)
    (jump,) = np.flatnonzero(np.diff(times[np.isfinite(times)]) > 0.9)
    assert np.isnan(times[jump + 1])
    assert np.isnan(values[jump + 1])
    y[: rows // 4] = np.nan
    times, values = decimate(t, y, 200)
    assert np.isnan(values[times < 0.24]).all()
    assert (values[(times > 0.26) & (times < 0.5)] == 1.0).all()


@pytest.fixture(scope="module")
def motion():
    q = np.stack([0.5 * np.sin(3.0 * T), 0.8 * np.cos(2.0 * T)], axis=1)
    qd = np.stack([1.5 * np.cos(3.0 * T), -1.6 * np.sin(2.0 * T)], axis=1)
    qdd = np.stack([-4.5 * np.sin(3.0 * T), -3.2 * np.cos(2.0 * T)], axis=1)
    return jid.Motion(q, qd, qdd)


def test_the_path_is_that_of_the_tip_and_its_colours_are_speeds(motion):
    robot = arm_of(2)
    tip, speed, _ = (np.asarray(x) for x in jid.constraints.tip_motion(robot, motion))
    first, both = motion.q[:, 0], motion.q.sum(axis=1)
    planar = np.hypot(np.cos(first) + np.cos(both), np.sin(first) + np.sin(both))
    np.testing.assert_allclose(np.linalg.norm(tip, axis=1), planar, atol=1e-12)
    figure = jid.plot.path(robot, motion, T)
    (line,) = [c for c in figure.axes[0].collections if c.get_array() is not None]
    np.testing.assert_allclose(np.array(line._segments3d)[:, 0], tip[:-1], atol=1e-12)
    numerical = np.linalg.norm(np.gradient(tip, T, axis=0), axis=1)
    middle = 0.5 * (numerical[1:] + numerical[:-1])
    np.testing.assert_allclose(np.asarray(line.get_array())[2:-2], middle[2:-2], atol=5e-3)
    fastest = np.linalg.norm(speed, axis=1).max()
    assert f"up to {fastest:.3g}" in figure.texts[0].get_text()


def test_poses_show_joints_capsules_and_what_stands_still(motion):
    robot = arm_of(2)
    shapes = (
        jid.collision.Capsule("link", 1, start=(0.0, 0.0, 0.0), end=(1.0, 0.0, 0.0), radius=0.1),
        jid.collision.Capsule("post", -1, start=(0.0, 1.5, 0.0), end=(0.0, 2.5, 0.0), radius=0.2),
    )
    collision = jid.collision.CollisionModel(robot, shapes, pairs=(("link", "post"),))
    (axes,) = jid.plot.poses(robot, motion.q, collision, poses=4).axes
    polygons = [c for c in axes.collections if isinstance(c, PolyCollection)]
    bones = [c for c in axes.collections if isinstance(c, LineCollection)][1:]
    # What stands still once; capsules and joints in each pose.
    assert [len(p.get_paths()) for p in polygons] == [1, 1, 2, 1, 2, 1, 2, 1, 2]
    strengths = [b.get_alpha() for b in bones]
    assert strengths == sorted(strengths)
    last = np.array(bones[-1].get_segments())
    np.testing.assert_allclose(last[1:, 0], last[:-1, 1], atol=1e-12, err_msg="a chain")
    # The stick figure ends where the drawn path does.
    np.testing.assert_allclose(last[-1, 1], axes.lines[0].get_xydata()[-1], atol=1e-12)


def test_the_animation_has_its_frames_and_its_time(motion, tmp_path):
    jid.plot.animation(tmp_path / "arm.gif", arm_of(2), T, motion.q, frames=5)
    with Image.open(tmp_path / "arm.gif") as picture:
        assert picture.n_frames == 5
        assert picture.info["duration"] == pytest.approx(500.0, abs=10.0)


def test_autocorrelation_is_that_of_the_plain_formula(errors_of):
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


def test_files_are_the_same_each_time_and_leave_figure_and_settings_alone(errors_of, tmp_path):
    before = dict(matplotlib.rcParams)
    figures = [jid.plot.bars((("a", (errors_of(2),)),), arm_of(2)) for _ in range(2)]
    canvas, dpi = figures[0].canvas, figures[0].dpi
    for suffix in (".png", ".pdf", ".svg"):
        files = [tmp_path / f"{name}{suffix}" for name in "abc"]
        for file, figure in zip(files, (*figures, figures[0]), strict=True):
            jid.plot.save(figure, file)
        assert len({file.read_bytes() for file in files}) == 1
    assert (figures[0].canvas, figures[0].dpi) == (canvas, dpi)
    assert dict(matplotlib.rcParams) == before
    if "matplotlib.pyplot" in sys.modules:
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []
