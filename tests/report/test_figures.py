"""Figures: what they show and where it stands, not their pixels."""

import dataclasses
import sys

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_hex
from report_samples import arm_of, errors_of

from jaxid.identification.uncertainty.residuals import ResidualSpectra
from jaxid.report.bars import error_figure
from jaxid.report.estimates import parameter_figure
from jaxid.report.residuals import residual_figure
from jaxid.report.style import BLUE, ERROR, GREY, MEASURED, ORANGE, PREDICTED, save
from jaxid.report.torques import torque_figure


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
    with pytest.raises(ValueError, match="must be those of the 3 joints"):
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
    with pytest.raises(ValueError, match="belong to 3 joints"):
        torque_figure(errors_of(3), arm_of(2))
    with pytest.raises(ValueError, match="belong to 3 joints"):
        error_figure((errors_of(3),), (), arm_of(2))
    with pytest.raises(ValueError, match="both are empty"):
        error_figure((), (), arm_of(2))
    nothing = dataclasses.replace(errors_of(2), counted=np.zeros((200, 2), bool))
    with pytest.raises(ValueError, match="no row of `log` counts"):
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


def test_nothing_global_is_touched(tmp_path):
    before = dict(matplotlib.rcParams)
    figure = torque_figure(errors_of(2), arm_of(2))
    save(figure, tmp_path / "a.png")
    assert dict(matplotlib.rcParams) == before
    if "matplotlib.pyplot" in sys.modules:
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []
    save(torque_figure(errors_of(2), arm_of(2)), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
