"""Figures: what they show and where it stands, not their pixels; for small robots and logs."""

import dataclasses
import itertools
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image
from report_samples import arm_of, errors_of

import jaxid as jid
from jaxid.identification.comparison import compare
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.report.errors import error_figure
from jaxid.report.parameters import comparison_figure, parameter_figure
from jaxid.report.residuals import autocorrelation, residual_figure
from jaxid.report.style import (
    BLUE,
    ERROR,
    GREEN,
    GREY,
    MEASURED,
    ORANGE,
    PREDICTED,
    plain_number,
    save,
)
from jaxid.report.torques import decimate, torque_figure

T = np.linspace(0.0, 2.0, 101)


def line(axes, colour):
    (found,) = [x for x in axes.get_lines() if x.get_color() == colour]
    return found


def require_everything_inside(figure):
    """No text is cut off by the edge, and no panel's title touches another panel."""
    figure.canvas.draw()
    page = figure.bbox_inches
    drawn = figure.get_tightbbox(figure.canvas.get_renderer())
    boxes = [
        drawn,
        *(
            t.get_window_extent().transformed(figure.dpi_scale_trans.inverted())
            for t in figure.texts
        ),
    ]
    for box in boxes:
        assert box.x0 >= page.x0 - 0.01
        assert box.y0 >= page.y0 - 0.01
        assert box.x1 <= page.x1 + 0.01
        assert box.y1 <= page.y1 + 0.01
    for axes in figure.axes:
        others = [o.get_window_extent() for o in figure.axes if o is not axes]
        for place in ("left", "right"):
            title = axes.get_title(loc=place)
            if title:
                artist = axes._left_title if place == "left" else axes._right_title
                box = artist.get_window_extent()
                assert not any(box.overlaps(o) for o in others), title
    for axes in figure.axes:
        left, right = axes._left_title, axes._right_title
        if left.get_text() and right.get_text():
            assert not left.get_window_extent().overlaps(right.get_window_extent())


def test_torques_show_what_was_measured_and_predicted(fit, validation):
    errors, robot = validation.errors[0], fit.base.model.robot
    figure = torque_figure(errors, robot)
    assert len(figure.axes) == 4
    for j, (unit, word) in enumerate((("N", "force"), ("N m", "torque"))):
        upper, lower = figure.axes[2 * j : 2 * j + 2]
        np.testing.assert_array_equal(line(upper, MEASURED).get_ydata(), errors.measured[:, j])
        np.testing.assert_array_equal(line(upper, PREDICTED).get_ydata(), errors.predicted[:, j])
        np.testing.assert_array_equal(line(lower, ERROR).get_ydata(), errors.errors[:, j])
        np.testing.assert_array_equal(line(lower, ERROR).get_xdata(), errors.time)
        assert upper.get_title(loc="left") == robot.joint_names[j]
        assert upper.get_ylabel() == f"{word} [{unit}]"
        assert lower.get_ylabel() == f"[{unit}]"
        said = upper.get_title(loc="right")
        assert f" {unit} = " in said
        assert float(said.split(" = ")[1].split(" %")[0]) == pytest.approx(
            errors.mean_percent[j], rel=0.06
        )
    assert [axes.get_xlabel() for axes in figure.axes] == ["", "", "", "time [s]"]
    assert [t.get_text() for t in figure.legends[0].get_texts()][:2] == ["measured", "predicted"]
    assert "first/run" in figure.texts[0].get_text()
    require_everything_inside(figure)


def test_rows_that_do_not_count_are_left_out():
    errors = errors_of(1)
    counted = np.ones((200, 1), bool)
    counted[:30] = counted[190:] = counted[100:120] = False
    errors = dataclasses.replace(errors, counted=counted)
    upper, lower = torque_figure(errors, arm_of(1)).axes
    np.testing.assert_array_equal(line(upper, MEASURED).get_xdata(), errors.time[30:190])
    drawn = np.isfinite(line(lower, ERROR).get_ydata())
    np.testing.assert_array_equal(drawn, counted[30:190, 0])


def test_unknown_largest_forces_give_no_percents():
    errors = dataclasses.replace(errors_of(2), max_forces=np.array([np.nan, 50.0]))
    uppers = torque_figure(errors, arm_of(2)).axes[::2]
    assert "%" not in uppers[0].get_title(loc="right")
    assert "% of max" in uppers[1].get_title(loc="right")


@pytest.mark.parametrize("joints", [1, 2, 3, 7, 17])
def test_any_number_of_joints_fits_on_the_page(joints):
    robot = arm_of(joints)
    names = tuple(f"a_long_name_of_the_joint_number_{i}" for i in range(joints))
    errors = errors_of(joints, name="a recording with a name that goes on and on and on and on")
    robot = robot.replace(joint_names=names)
    figure = torque_figure(errors, robot)
    assert len(figure.axes) == 2 * joints
    require_everything_inside(figure)
    bars = error_figure((errors,), (errors,), robot)
    require_everything_inside(bars)


def test_residuals_stand_beside_white_ones(fit):
    spectra, robot = fit.residual_spectra, fit.base.model.robot
    figure = residual_figure(spectra, robot)
    for j, axes in enumerate(figure.axes):
        own = line(axes, BLUE)
        shown = np.isin(np.asarray(spectra.frequency), own.get_xdata())
        np.testing.assert_array_equal(own.get_ydata(), np.asarray(spectra.density)[j][shown])
        white = line(axes, GREY).get_ydata()
        np.testing.assert_allclose(white.sum(), own.get_ydata().sum())
        assert axes.get_ylabel() == ("N²/Hz", "(N m)²/Hz")[j]
        assert ("not white" in axes.get_title(loc="right")) != spectra.white[j]
    require_everything_inside(figure)
    with pytest.raises(ValueError, match="`spectra`"):
        residual_figure(spectra, arm_of(3))


@pytest.mark.parametrize("joints", [1, 2, 7, 17])
def test_residuals_of_any_number_of_joints_fit_on_the_page(joints):
    frequency = np.linspace(0.0, 20.0, 50)
    density = np.random.default_rng(0).exponential(size=(joints, 50))
    spectra = ResidualSpectra(
        frequency,
        density,
        1.0 / (1.0 + (frequency / 10.0) ** 4),
        np.full(joints, 0.5),
        0.1,
        np.full(joints, 0.314),
        9.5,
    )
    names = tuple(f"a_long_name_of_the_joint_number_{i}" for i in range(joints))
    require_everything_inside(residual_figure(spectra, arm_of(joints).replace(joint_names=names)))


def test_a_single_row_can_be_drawn():
    torque_figure(errors_of(2, rows=1), arm_of(2)).canvas.draw()


def test_refuses_other_robots_and_nothing():
    with pytest.raises(ValueError, match="`errors`"):
        torque_figure(errors_of(3), arm_of(2))
    with pytest.raises(ValueError, match="`errors`"):
        error_figure((errors_of(3),), (), arm_of(2))
    with pytest.raises(ValueError, match="`identification`"):
        error_figure((), (), arm_of(2))
    nothing = dataclasses.replace(errors_of(2), counted=np.zeros((200, 2), bool))
    with pytest.raises(ValueError, match="`log`"):
        torque_figure(nothing, arm_of(2))


def heights(figure, colour):
    return [p.get_height() for p in figure.axes[0].patches if to_hex(p.get_facecolor()) == colour]


def test_bars_are_percents_of_the_largest_forces():
    first, second = errors_of(3, seed=1), errors_of(3, seed=2)
    figure = error_figure((first,), (second,), arm_of(3))
    np.testing.assert_allclose(heights(figure, BLUE.lower()), first.mean_percent)
    np.testing.assert_allclose(heights(figure, ORANGE.lower()), second.mean_percent)
    marks = [x.get_ydata() for x in figure.axes[0].get_lines() if x.get_marker() == "D"]
    np.testing.assert_allclose(marks, [first.rms_percent, second.rms_percent])
    assert figure.axes[0].get_ylabel() == "error [% of the largest force]"
    labels = [t.get_text() for t in figure.axes[0].get_xticklabels()]
    assert labels == ["joint1", "joint2", "joint3"]


def test_several_recordings_count_by_their_rows():
    long, short = errors_of(2, rows=300, seed=1), errors_of(2, rows=100, seed=2)
    counted = np.ones((300, 2), bool)
    counted[:200, 0] = False
    long = dataclasses.replace(long, counted=counted)
    figure = error_figure((long, short), (), arm_of(2))
    expected = [
        (100 * long.mean[0] + 100 * short.mean[0]) / 200 * 2.0,
        (300 * long.mean[1] + 100 * short.mean[1]) / 400 * 2.0,
    ]
    np.testing.assert_allclose(heights(figure, BLUE.lower()), expected)


def test_bars_fall_back_to_the_forces_themselves():
    errors = dataclasses.replace(errors_of(2), max_forces=np.array([50.0, np.nan]))
    figure = error_figure((errors,), (), arm_of(2))
    np.testing.assert_allclose(
        heights(figure, BLUE.lower()), 100 * errors.mean / errors.force_rms, rtol=1e-12
    )
    assert figure.axes[0].get_ylabel() == "error [% of RMS force]"


def test_parameters_are_sorted_by_what_is_known_of_them(fit):
    figure = parameter_figure(fit)
    names = [t.get_text() for axes in figure.axes for t in axes.get_yticklabels()]
    order = np.argsort(fit.relative_standard_deviations, kind="stable")
    assert names == [fit.base.names[k] for k in order]
    assert all(axes.get_xlabel().endswith("[%]") for axes in figure.axes)
    beside = figure.axes[0].texts[0].get_text()
    assert beside.endswith(fit.base.units[order[0]])
    require_everything_inside(figure)


def test_unknown_parameters_are_arrows_at_the_edge(fit):
    parameters = np.array(fit.parameters)
    parameters[2] = 0.0
    fit = dataclasses.replace(fit, parameters=parameters)
    figure = parameter_figure(fit)
    points, arrows = (c.get_offsets() for c in figure.axes[0].collections[1:3])
    assert len(points) == fit.base.size - 1
    assert len(arrows) == 1
    assert arrows[0][0] == figure.axes[0].get_xlim()[1]
    last = figure.axes[0].get_yticklabels()[-1].get_text()
    assert last == fit.base.names[2]


def test_the_comparison_shows_both_intervals(fit, warm):
    figure = comparison_figure(compare(fit, warm))
    require_everything_inside(figure)
    (axes,) = figure.axes
    bold = [t.get_text() for t in axes.get_yticklabels() if t.get_fontweight() == "bold"]
    assert bold == ["fv1"]
    k = fit.base.names.index("fv1")
    points = [c.get_offsets()[k, 0] for c in axes.collections if len(c.get_offsets()) > 1]
    np.testing.assert_allclose(points[1] / points[0], 1 / 3, rtol=1e-12)
    assert max(points) < 1.0


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
    for a, b in zip(decimate(t[:100], y[:100], 100), (t[:100], y[:100]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("rows", [100, 50_000])
def test_gaps_in_time_break_the_line_and_missing_values_stay_out(rows):
    t, y = np.arange(rows) / rows, np.ones(rows)
    t[rows // 2 :] += 1.0
    times, values = decimate(t, y, 200)
    assert np.count_nonzero(np.isnan(values)) >= 1
    finite = np.isfinite(times)
    (jump,) = np.flatnonzero(np.diff(times[finite]) > 0.9)
    assert np.isnan(times[jump + 1])
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


def planar_tip(q):
    first, both = q[..., 0], q[..., 0] + q[..., 1]
    return np.stack([np.cos(first) + np.cos(both), np.sin(first) + np.sin(both)], axis=-1)


def tip_in_space(robot, motion):
    return np.asarray(jid.constraints.tip_motion(robot, motion).position)


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
    fastest = np.linalg.norm(jid.constraints.tip_motion(robot, motion).velocity, axis=1).max()
    assert f"up to {fastest:.3g}" in figure.texts[0].get_text()


def test_poses_show_joints_capsules_and_what_stands_still(motion):
    robot = arm_of(2)
    shapes = (
        jid.collision.Capsule("link", 1, start=(0.0, 0.0, 0.0), end=(1.0, 0.0, 0.0), radius=0.1),
        jid.collision.Capsule("post", -1, start=(0.0, 1.5, 0.0), end=(0.0, 2.5, 0.0), radius=0.2),
    )
    collision = jid.collision.CollisionModel(robot, shapes, pairs=(("link", "post"),))
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
    with pytest.raises(ValueError, match="`frames`"):
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
    with pytest.raises(ValueError, match="`joint`"):
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
        with pytest.raises(ValueError, match="`joints`"):
            jid.plot.torques(errors, robot, joints=wrong)


def test_bars_of_several_groups():
    robot, first, second = arm_of(3), errors_of(3), errors_of(3, seed=1)
    figure = jid.plot.bars((("LS", (first,)), ("WLS", (second,)), ("CAD", (first,))), robot)
    bars = figure.axes[0].patches
    assert len(bars) == 9
    assert len({to_hex(b.get_facecolor()) for b in bars}) == 3
    spans = sorted((b.get_x(), b.get_x() + b.get_width()) for b in bars)
    assert all(a[1] < b[0] for a, b in itertools.pairwise(spans)), "none hides another"
    with pytest.raises(ValueError, match="`groups`"):
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
    with pytest.raises(ValueError, match="three rows"):
        jid.plot.autocorrelation(errors_of(2, rows=2), arm_of(2))


def test_matplotlib_is_loaded_only_when_figures_are_used():
    script = (
        "import sys, jaxid as jid\n"
        "assert 'matplotlib' not in sys.modules\n"
        "jid.plot.torques\n"
        "assert 'matplotlib' in sys.modules and 'matplotlib.pyplot' not in sys.modules\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("suffix", [".png", ".pdf", ".svg"])
def test_files_are_the_same_each_time_and_leave_figure_and_settings_alone(suffix, tmp_path):
    before = dict(matplotlib.rcParams)
    figures = [jid.plot.bars((("a", (errors_of(2),)),), arm_of(2)) for _ in range(2)]
    canvas, dpi = figures[0].canvas, figures[0].dpi
    assert isinstance(figures[0], Figure)
    for name, figure in zip("abc", (*figures, figures[0]), strict=True):
        save(figure, tmp_path / f"{name}{suffix}")
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1
    assert (figures[0].canvas, figures[0].dpi) == (canvas, dpi)
    assert dict(matplotlib.rcParams) == before
    if "matplotlib.pyplot" in sys.modules:
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []


@pytest.mark.parametrize(
    ("value", "label"),
    [(0.01, "0.01"), (1000.0, "1000"), (1e-5, "10⁻⁵"), (2e-7, "2·10⁻⁷"), (1e6, "10⁶")],
)
def test_labels_of_logarithmic_scales_are_plain_letters(value, label):
    assert plain_number(value) == label
