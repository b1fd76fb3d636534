"""Pages in a real browser: nothing is cut off or overlaps; zoom and legends work."""

import dataclasses
import re
import shutil
import subprocess

import numpy as np
import pytest
from browser import CHROMIUM, Browser, placed_vertices

import jaxid as jid
from jaxid.report.comparison_page import ComparisonReport
from jaxid.report.motion_figures import pose_figure
from jaxid.report.result_files import write_report
from jaxid.robot import library
from jaxid.robot.collision import Capsule, CollisionModel, HalfSpace
from jaxid.validation.judgement import Report

pytest.importorskip("websockets.sync.client")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here")


@pytest.fixture(scope="module")
def browser():
    browser = Browser()
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def pages(written, changed, tmp_path_factory):
    """An identification, and a comparison."""
    folder = tmp_path_factory.mktemp("comparison") / "out"
    robot = changed.first.base.model.robot
    page, *_ = ComparisonReport(robot, changed, {}, ()).save(folder)
    return {"identification": written / "report.html", "comparison": page}


@pytest.mark.parametrize("name", ["identification", "comparison"])
@pytest.mark.parametrize("width", [390, 768, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_cut_off(browser, pages, name, width, scheme):
    browser.look(width, scheme)
    browser.open(pages[name])
    assert browser.evaluate("drawAll()") == 0
    assert browser.evaluate("faults()") == []
    assert browser.errors == []


def test_shapes_move_with_the_robot(browser, tmp_path):
    robot, q = library.panda(), np.linspace(-0.5, 0.5, 30)[:, None] * np.arange(1, 8)
    ball = Capsule("ball", 6, start=(0.0, 0.0, 0.1), radius=0.1)
    shapes = CollisionModel(robot, [ball], [HalfSpace("floor")])
    figure = pose_figure(robot, q, values=np.abs(q), label="load [%]", shapes=shapes)
    figure.save(tmp_path / "a.html")
    browser.look(1280)
    browser.open(tmp_path / "a.html")
    assert browser.evaluate("drawAll()") == 0
    browser.evaluate(
        "{ const s = document.querySelector('.player input'); s.value = 12;"
        " s.dispatchEvent(new Event('input')); }"
    )
    shown = (
        "((d) => [d.x, d.y, d.z].map((a) => [...a]))"
        "(document.querySelector('.chart').data[2])"
    )
    found = np.transpose(browser.evaluate(shown))
    np.testing.assert_allclose(
        found, placed_vertices(figure.scene.solids)[12], atol=4e-4
    )
    assert browser.evaluate("faults()") == []
    assert browser.errors == []


def test_dark_pages_are_dark(browser, pages):
    ink, light = "getComputedStyle(document.querySelector('.xtick text')).fill", []
    inks = set()
    for scheme in ("light", "dark"):
        browser.look(1280, scheme)
        browser.open(pages["comparison"])
        browser.evaluate("drawAll()")
        ground = browser.evaluate("getComputedStyle(document.body).backgroundColor")
        light.append(sum(map(int, ground[4:-1].split(","))) > 382)
        inks.add(browser.evaluate(ink))
    assert light == [True, False]
    assert len(inks) == 2


@pytest.fixture
def opened(browser, pages):
    browser.look(1280)
    browser.open(pages["identification"])
    browser.evaluate("drawAll()")
    return browser


def test_zooming_one_joint_with_the_mouse_zooms_all(opened):
    first, second = opened.evaluate("ranges()")
    assert first == second
    left, right, height = opened.evaluate("firstPanel()")
    middle = 0.5 * (left + right)
    steps = [
        ("Moved", left, 0),
        ("Pressed", left, 1),
        ("Moved", middle, 1),
        ("Moved", right, 1),
    ]
    for kind, x, buttons in (*steps, ("Released", right, 0)):
        button = "none" if kind == "Moved" else "left"
        event = {
            "x": x,
            "y": height,
            "button": button,
            "buttons": buttons,
            "clickCount": 1,
        }
        opened.call("Input.dispatchMouseEvent", type=f"mouse{kind}", **event)
    opened.wait(
        f"ranges().every((range) => range[0] > {first[0]} && range[1] < {first[1]})"
    )
    expected = [0.75 * first[0] + 0.25 * first[1], 0.25 * first[0] + 0.75 * first[1]]
    for zoomed in opened.evaluate("ranges()"):
        assert zoomed == pytest.approx(expected, abs=0.02)


def test_legends_switch_curves_and_come_back(opened):
    press = "torques().querySelector('[data-curve=measured]').click()"
    assert opened.evaluate("shown()") == [3, 3]
    opened.evaluate(press)
    assert opened.evaluate("shown()") == [2, 2]
    opened.evaluate(press)
    assert opened.evaluate("shown()") == [3, 3]


def test_the_robot_moves_with_the_slider(opened):
    assert opened.evaluate("slide(3)") != opened.evaluate("slide(70)")


def test_paper_has_every_figure_and_what_was_folded(browser, pages, tmp_path):
    browser.look(1280)
    browser.open(pages["identification"])
    folded = browser.evaluate("document.querySelectorAll('details:not([open])').length")
    assert folded > 3
    browser.pdf(tmp_path / "page.pdf")
    assert browser.errors == []
    # After printing the page is as it was.
    assert (
        browser.evaluate("document.querySelectorAll('details:not([open])').length")
        == folded
    )
    browser.look(690, media="print")
    assert browser.evaluate("paperFaults()") == []
    if shutil.which("pdftotext"):
        command = ["pdftotext", "-layout", tmp_path / "page.pdf", "-"]
        text = subprocess.run(
            command, capture_output=True, text=True, check=True
        ).stdout
        assert "Residuals" in text
        assert "frequency [Hz]" in text


@pytest.fixture(scope="module")
def arm_page(tmp_path_factory):
    """The report of an arm with seven joints, two logs and 69 parameters."""
    robot = library.panda()
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    model = jid.Model(robot, (*terms, jid.RotorInertia(), jid.ConstantOffset()))
    base = jid.base_parameters(model)
    random = np.random.default_rng(0)
    observations = []
    for seed in (1, 2):
        times = np.arange(0.0, 10.0, 0.01)
        path = jid.trajectories.random_fourier_series(robot, omega=0.6, seed=seed)
        motion = path.motion(times)
        torques = np.asarray(model.inverse_dynamics(np.full(model.size, 0.1), motion))
        torques = torques + random.normal(0.0, 0.1, torques.shape)
        log = jid.Recording.of(np.asarray(motion.q), torques, time=times)
        log = dataclasses.replace(log, name=f"log {seed}")
        observations.append(jid.observe(log, robot, jid.ZeroPhaseButterworth(10.0)))
    fit = jid.identify(base, observations[0], jid.estimators.LeastSquares())
    validation = jid.validate(fit, observations)
    errors = validation.errors
    report = Report(fit, errors[:1], errors[1:], validation.definiteness)
    folder = tmp_path_factory.mktemp("arm") / "report"
    return write_report(folder, report)[0]


def test_a_report_printed_at_once_has_few_pages_and_all_figures(
    browser, arm_page, tmp_path
):
    browser.look(1280)
    browser.call("Page.navigate", url=arm_page.as_uri())
    # Before the library is unpacked.
    browser.wait(
        "location.protocol === 'file:' && document.readyState !== 'loading'"
        " && document.body.dataset.sketched === ''"
    )
    browser.pdf(tmp_path / "early.pdf")
    content = (tmp_path / "early.pdf").read_bytes()
    assert 4 <= len(re.findall(rb"/Type\s*/Page\b", content)) <= 8
    browser.open(arm_page)
    browser.look(690, media="print")
    assert browser.evaluate("paperFaults()") == []
    assert browser.errors == []


def test_the_page_scrolls_under_the_robot_which_is_inside_its_frame(browser, arm_page):
    browser.look(1280)
    browser.open(arm_page)
    browser.evaluate("drawAll()")
    x, y, width, height = browser.evaluate("frameOfTheRobot()")
    wheel = {"type": "mouseWheel", "x": x + width / 2, "y": y + height / 2}
    top = browser.evaluate("scrollY")
    browser.call("Input.dispatchMouseEvent", **wheel, deltaX=0, deltaY=300)
    browser.wait(f"scrollY >= {top} + 250")
    assert browser.evaluate("colouredBorderPixels()") == [0, 0, 0, 0]
