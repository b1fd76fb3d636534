"""Figures: what they show, on a page and on paper; for small robots and logs."""

import base64
import gzip
import json
import sys

import jax
import matplotlib
import numpy as np
import pytest
from browser import placed_vertices

import jaxid as jid
from jaxid.identification.uncertainty import ResidualSpectra
from jaxid.report.browser_figures import charts, library
from jaxid.report.figure_elements import BLUE, ORANGE, decimate
from jaxid.report.motion_figures import pose_figure
from jaxid.report.parameter_words import in_words
from jaxid.report.payload_gains_states_pages import state_friction_figure
from jaxid.robot.collision import GROUND, Box, Capsule, CollisionModel, HalfSpace

T = np.linspace(0.0, 2.0, 101)


def arm_of(joints):
    return jid.robots.planar_arm(joints)


def curve(panel, name):
    (found,) = [c for c in panel.curves if c.name == name]
    return found


def unpacked(figure):
    """What the browser reads: the content of each chart."""
    return [json.loads(c["content"]) for c in charts(figure)]


def numbers(packed):
    return np.frombuffer(base64.b64decode(packed["floats"]), "<f4")


def texts_of(figure):
    """Titles and names on the axes of a figure on paper."""
    figure.canvas.draw()
    for axes in figure.axes:
        yield axes.get_title(loc="left")
        yield from (label.get_text() for label in axes.get_xticklabels())


def require_everything_inside(shown):
    """On paper no text is cut off, and no panel's title touches another panel."""
    figure = shown.matplotlib()
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
    for j, (unit, word) in enumerate((("N", "force"), ("N m", "torque"))):
        upper, lower = figure.panels[j].parts
        np.testing.assert_array_equal(curve(upper, "measured").y, errors.measured[:, j])
        np.testing.assert_array_equal(
            curve(upper, "predicted").y, errors.predicted[:, j]
        )
        np.testing.assert_array_equal(lower.curves[0].y, errors.errors[:, j])
        assert upper.title == robot.joint_names[j]
        assert (upper.y_label, lower.y_label) == (f"{word} [{unit}]", f"error [{unit}]")
        said = upper.value.split(f" {unit} = ")[1].split(" %")[0]
        assert float(said) == pytest.approx(100 * errors.rms_relative[j], rel=0.06)
    require_everything_inside(figure)
    assert [curve.name for curve in figure.legend] == ["measured", "predicted"]
    for shown, j in zip(unpacked(figure), range(2), strict=True):
        names = [drawn["name"] for drawn in shown["curves"]]
        assert names == ["measured", "predicted", "predicted"]
        y = numbers(shown["curves"][0]["y"])
        np.testing.assert_allclose(y, errors.measured[:, j], rtol=1e-7)
        assert [drawn["panel"] for drawn in shown["curves"]] == [0, 0, 1]


def test_a_page_keeps_the_peaks_of_a_long_log(errors_of):
    errors = errors_of(2, rows=60_000)
    errors.predicted[40_001, 1] = 1e4
    _, second = unpacked(jid.plot.torques(errors, arm_of(2)))
    measured, predicted, difference = (
        numbers(drawn["y"]) for drawn in second["curves"]
    )
    assert len(measured) <= 2400
    assert predicted.max() == pytest.approx(1e4, rel=1e-7)
    assert difference.max() == pytest.approx(errors.errors[:, 1].max(), rel=1e-7)
    assert [second["curves"][k]["x"] for k in (1, 2)] == [0, 0], "the same abscissas"
    times = numbers(second["curves"][0]["x"])
    assert abs(times[np.argmax(predicted)] - errors.time[40_001]) < 600.0 / 600


def test_long_names_fit_on_the_page(errors_of):
    joints = 3
    names = tuple(f"a_long_name_of_the_joint_number_{i}" for i in range(joints))
    robot = arm_of(joints).replace(joint_names=names)
    errors = errors_of(
        joints, name="a recording with a name that goes on and on and on and on"
    )
    f, half = np.linspace(0.0, 20.0, 50), np.full(joints, 0.5)
    density = np.random.default_rng(0).exponential(size=(joints, 50))
    spectra = ResidualSpectra(
        f, density, 1.0 / (1.0 + (f / 10) ** 4), half, 0.1, half, 9.5
    )
    bars = jid.plot.bars(
        {"identification": (errors,), "verification": (errors,)}, robot
    )
    for figure in (
        jid.plot.torques(errors, robot),
        bars,
        jid.plot.residuals(spectra, robot),
    ):
        require_everything_inside(figure)
        drawn = "".join("".join(texts_of(figure.matplotlib())).split())
        assert all(name in drawn for name in names), "folded, not cut"


def test_residuals_stand_beside_white_ones(fit):
    spectra = fit.residual_spectra
    for j, panel in enumerate(jid.plot.residuals(spectra, fit.base.model.robot).panels):
        own, white = panel.curves
        shown = np.isin(np.asarray(spectra.frequency), own.x)
        np.testing.assert_array_equal(own.y, np.asarray(spectra.density)[j][shown])
        np.testing.assert_allclose(white.y.sum(), own.y.sum())
        assert panel.unit == ("N²/Hz", "(N m)²/Hz")[j]
        assert ("not white" in panel.value) != spectra.white[j]


def test_bars_are_rms_errors_over_rms_forces(errors_of):
    first, second = errors_of(3, seed=1), errors_of(3, seed=2)
    groups = {"identification": (first,), "verification": (second,), "none": ()}
    (panel,) = jid.plot.bars(groups, arm_of(3)).panels
    bars = {c.colour: c.y for c in panel.curves}
    np.testing.assert_allclose(bars[BLUE], 100 * first.rms_relative)
    np.testing.assert_allclose(bars[ORANGE], 100 * second.rms_relative)
    assert panel.unit == "% of RMS force"


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


def test_shapes_are_closed_surfaces_that_move_with_the_bodies():
    robot, q = arm_of(2), np.array([[0.0, 0.0], [0.4, -0.9], [1.1, 0.2]])
    rod = Capsule("rod", 1, start=(0.1, 0.0, 0.0), end=(0.9, 0.0, 0.0), radius=0.1)
    ball, turned = (
        Capsule("ball", 0, start=(0.5, 0.1, 0.0), radius=0.2),
        np.eye(3)[[1, 2, 0]],
    )
    box = Box("table", centre=(0.0, 3.0, 0.0), size=(0.2, 0.4, 0.6), rotation=turned)
    floor = HalfSpace("floor", normal=(0.0, 0.6, 0.8), height=-2.0)
    shapes = CollisionModel(robot, [rod, ball], [box, floor])
    solids = pose_figure(robot, q, shapes=shapes).scene.solids
    placed, ends = (
        placed_vertices(solids),
        np.asarray(jax.vmap(lambda x: shapes.ends(robot, x))(q)),
    )
    for pose in range(3):
        for body, capsule in enumerate(("ball", "rod")):
            (start, end), points = (
                ends[pose, 1 - body],
                placed[pose][solids.bodies == body],
            )
            along = end - start
            t = np.clip((points - start) @ along / max(along @ along, 1e-9), 0.0, 1.0)
            far = np.linalg.norm(points - start - t[:, None] * along, axis=1)
            radius = 0.2 if capsule == "ball" else 0.1
            assert far.max() == pytest.approx(radius, rel=1e-9)
            assert (points.min(0) <= np.minimum(start, end) - 0.9 * radius).all()
    # Corners of the box, and a square in the plane; they stay.
    still = placed[0][solids.bodies == GROUND]
    np.testing.assert_array_equal(still, placed[2][solids.bodies == GROUND])
    corners = (still[:8] - [0.0, 3.0, 0.0]) @ turned
    np.testing.assert_allclose(
        np.abs(corners), np.tile([0.1, 0.2, 0.3], (8, 1)), atol=1e-12
    )
    np.testing.assert_allclose(still[8:] @ [0.0, 0.6, 0.8], -2.0, atol=1e-12)
    # Every edge of a closed surface belongs to two triangles; the square's border to
    # one.
    edges = np.sort(solids.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    assert sorted(counts)[:5] == [1, 1, 1, 1, 2]
    assert counts.max() == 2


@pytest.fixture(scope="module")
def motion():
    q = np.stack([0.5 * np.sin(3.0 * T), 0.8 * np.cos(2.0 * T)], axis=1)
    qd = np.stack([1.5 * np.cos(3.0 * T), -1.6 * np.sin(2.0 * T)], axis=1)
    qdd = np.stack([-4.5 * np.sin(3.0 * T), -3.2 * np.cos(2.0 * T)], axis=1)
    return jid.Motion(q, qd, qdd)


def test_the_robot_in_space_is_a_chain_to_its_tip_coloured_by_values(motion):
    robot, values = arm_of(2), np.stack([T, 2.0 * T], axis=1)
    figure = jid.plot.poses(robot, motion.q, T, values, "load [%]")
    first, both = motion.q[:, 0], motion.q.sum(axis=1)
    elbow = np.hypot(np.cos(first), np.sin(first))
    planar = np.hypot(np.cos(first) + np.cos(both), np.sin(first) + np.sin(both))
    lines = figure.scene.bones
    np.testing.assert_allclose(
        np.linalg.norm(lines[:, 1, 1], axis=1), elbow, atol=1e-12
    )
    np.testing.assert_allclose(
        np.linalg.norm(lines[:, -1, 1], axis=1), planar, atol=1e-12
    )
    np.testing.assert_array_equal(lines[:, 1:, 0], lines[:, :-1, 1], err_msg="a chain")
    (shown,) = unpacked(figure)
    frames = shown["frames"]
    assert len(frames["points"]) == len(frames["time"]) == len(T)
    pose, colours = frames["points"][7], numbers(frames["colours"][7])
    x = numbers(pose["x"]).reshape(-1, 3)
    np.testing.assert_allclose(x[:, :2], lines[7, :, :, 0], atol=2.0 / 65534)
    assert np.isnan(x[:, 2]).all()
    # The line from each joint has that joint's colour; the one from the ground has
    # none.
    np.testing.assert_allclose(colours[::3], [0.0, T[7], 2.0 * T[7]], atol=1e-6)
    np.testing.assert_allclose(numbers(shown["mean"]), 1.5 * T, atol=1e-6)
    require_everything_inside(figure)


def test_motions_are_drawn_between_their_limits(motion):
    robot = arm_of(2)
    limits = jid.Limits(2, velocity=[2.0, np.inf])
    for j, panel in enumerate(jid.plot.joints(robot, limits, T, motion).panels):
        for part, values in zip(
            panel.parts, (motion.q, motion.qd, motion.qdd), strict=True
        ):
            np.testing.assert_array_equal(part.curves[0].y, values[:, j])
        assert [len(part.levels) for part in panel.parts] == [0, 2 - 2 * j, 0]


def test_friction_of_more_states_than_colours_is_shown(fit, validation):
    states = [f"state {k}" for k in range(9)]
    figure = state_friction_figure(
        dict.fromkeys(states, fit), dict.fromkeys(states, validation.errors)
    )
    for panel in figure.panels:
        assert [curve.name for curve in panel.curves[::2]] == states


def test_friction_is_that_of_the_estimates_and_of_the_log(fit, validation):
    estimates = dict(zip(fit.base.names, np.asarray(fit.parameters), strict=True))
    figure = jid.plot.friction(fit, validation.errors)
    assert [panel.x for panel in figure.panels] == ["speed [m/s]", "speed [rad/s]"]
    for j, panel in enumerate(figure.panels, 1):
        model, points = curve(panel, "model"), panel.curves[-1]
        fast = np.abs(model.x) > 0.1
        expected = estimates[f"fv{j}"] * model.x + estimates[f"fc{j}"] * np.sign(
            model.x
        )
        np.testing.assert_allclose(model.y[fast], expected[fast], rtol=1e-6)
        fast = np.abs(points.x) > 0.2 * model.x.max()
        own = np.interp(points.x[fast], model.x, model.y)
        np.testing.assert_allclose(
            points.y[fast], own, atol=0.15 * np.abs(model.y).max()
        )
        band = curve(panel, "95 % band")
        assert (band.low <= model.y).all()
        assert (band.high >= model.y).all()


@pytest.mark.parametrize(
    ("name", "words", "place"),
    [
        ("C1", "moment of inertia about z", "body of joint rail"),
        (
            "my2",
            "mass times y of the centre of mass",
            "body of joint swing_$1_$",
        ),
        ("D2", "product of inertia in y, z", "body of joint swing_$1_$"),
        ("fo1", "constant offset of the sensor or of friction", "joint rail"),
        ("sm2_1", "ripple: sine, 2 times a turn of the motor", "joint rail"),
        ("odd9", "effect of a model of your own", ""),
    ],
)
def test_parameters_are_named_in_words(fit, name, words, place):
    terms = (*fit.base.model.terms, jid.ConstantOffset(), jid.terms.TorqueRipple((2,)))
    assert in_words(name, jid.Model(fit.base.model.robot, terms)) == (words, place)


def test_files_are_the_same_each_time_and_leave_settings_alone(errors_of, tmp_path):
    before = dict(matplotlib.rcParams)
    figure = jid.plot.bars({"a": (errors_of(2),)}, arm_of(2))
    for suffix in (".png", ".pdf", ".svg", ".html"):
        files = [tmp_path / f"{name}{suffix}" for name in "ab"]
        for file in files:
            figure.save(file)
        assert len({file.read_bytes() for file in files}) == 1
    assert figure._repr_png_().startswith(b"\x89PNG")
    assert dict(matplotlib.rcParams) == before
    if "matplotlib.pyplot" in sys.modules:
        assert sys.modules["matplotlib.pyplot"].get_fignums() == []


def test_the_page_holds_the_whole_library():
    code = gzip.decompress(base64.b64decode(library()))
    assert b"plotly.js" in code[:200]
    assert len(library()) < 2_100_000
