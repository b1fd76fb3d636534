"""The page: whole, closed in itself, escaped, with the numbers of the result file."""

import dataclasses
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest

import jaxid as jid
from jaxid.report.identification_page import motor_tables
from jaxid.report.joint_estimates import correlation_blocks, joint_table
from jaxid.report.page import code, folded, picture, render_page
from jaxid.result_table import SEVERITIES, Column, Remark, Status, Table
from jaxid.validation.judgement import (
    Report,
    _judge_bounds,
    _judge_offsets,
    judge,
)
from jaxid.validation.torque_errors import joint_errors
from jaxid.workflow.log_identification import errors_of_claims

EVIL = "<script>alert('&\"')</script>"  # as in conftest.py


class Reader(HTMLParser):
    """Follows a page's tags, and keeps identifiers, links and cells of its tables."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.ids, self.links, self.tables = [], [], [], []
        self.scripts, self.text = 0, ""
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in {"meta", "br", "hr", "img", "link", "input"}:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag, attrs):
        self.scripts += tag == "script" and ("type", "application/json") not in attrs
        for key, value in attrs:
            self.ids += [value] if key == "id" else []
            self.links += [value] if key.endswith("href") or key == "src" else []
            self.links += re.findall(r"url\(([^)]*)\)", value or "")

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data


def read(page_text: str) -> Reader:
    """A page that needs nothing else, with unique identifiers, and links that work."""
    found = Reader(page_text)
    assert page_text.startswith("<!DOCTYPE html>")
    assert len(set(found.ids)) == len(found.ids)
    for link in found.links:
        assert link.startswith("#"), link
        assert link[1:] in found.ids, link
    assert "@import" not in page_text
    assert "//" not in page_text.partition("<body>")[0]
    return found


def test_the_page_is_whole_and_needs_nothing_else(written):
    text = (written / "report.html").read_text("utf-8")
    found = read(text)
    assert found.scripts == 4
    assert len(text) < 2_500_000
    assert "urdf = 'a<b'" in found.text
    assert f"a note {EVIL}" in found.text
    assert "the log looks odd." in found.text


def test_every_parameter_stands_there_with_the_numbers_of_the_result(written, fit):
    found = read((written / "report.html").read_text("utf-8"))
    rows = json.loads((written / "result.json").read_text("utf-8"))["base_parameters"]
    (table,) = [t for t in found.tables if "combination" in t[0]]
    assert len(table) == 1 + len(rows)
    for row, shown in zip(rows, table[1:], strict=True):
        cells = dict(zip(table[0], shown, strict=True))
        assert cells["parameter"] == row["name"]
        for title, key in (("estimate", "estimate"), ("95 %\nto", "high_95")):
            shown_digits = cells[title].strip()
            step = 10.0 ** -len(shown_digits.partition(".")[2])
            assert abs(float(shown_digits) - row[key]) <= 0.51 * step, (
                row["name"],
                title,
            )


def test_estimates_of_each_joint_stand_beside_those_of_the_file(fit, validation):
    names = list(fit.base.names)
    claims = np.full(len(names), np.nan)
    claims[names.index("fv2")] = 0.3
    report = Report(fit, validation.errors[:1], (), validation.definiteness)
    report = dataclasses.replace(report, claimed_parameters=claims)
    table = joint_table(report)
    columns = {column.name: column.values for column in table.columns}
    assert columns["joint"][1::2] == ("in the robot's file",) * 2
    friction = columns["viscous friction"]
    assert friction[1::2] == ("–", "0.300")  # noqa: RUF001
    value, width = map(float, friction[2].split(" ± "))
    low, high = fit.intervals()[names.index("fv2")]
    assert (value - width, value + width) == pytest.approx((low, high), abs=width / 10)
    for pairs in correlation_blocks(fit)[1:]:
        assert min(map(abs, pairs.columns[2].values)) >= 0.8


def test_every_block_is_written_and_escaped(errors_of):
    table = Table(EVIL, Column(EVIL, [EVIL]), Column("n", [1.5]), status=[Status.BAD])
    errors, robot = errors_of(2, name=EVIL), jid.robots.planar_arm(2)
    blocks = [
        EVIL,
        code(EVIL),
        Table("", facts=[(EVIL, EVIL)]),
        Remark(EVIL, Status.GOOD),
        [Remark(EVIL, Status.DOUBTFUL, EVIL)],
        table,
        folded(EVIL, table),
        (EVIL, EVIL),
        picture(jid.plot.torques(errors, robot, "a title"), EVIL),
        jid.plot.torques(errors, robot, "another"),
    ]
    found = read(render_page(EVIL, [(EVIL, blocks), ("b", [])], EVIL, EVIL))
    assert found.scripts == 4
    assert found.text.count(EVIL) == 23
    assert found.tables[-1] == [["", EVIL, "n"], ["", EVIL, "1.50"]]
    for word in ("joint2", "measured"):
        assert found.text.count(word) >= 2
    assert EVIL not in "".join(found.links)


def test_texts_of_a_page_have_no_backticks_and_notebooks_show_the_same_tables(
    fit, changed
):
    found = read(
        render_page(
            "a", [("b", ["look at `key`", [Remark("and `name`", detail="`x`")]])]
        )
    )
    assert "`" not in found.text
    assert "look at key" in found.text
    (table,) = Reader(fit._repr_html_()).tables
    assert [row[2] for row in table[1:]] == list(fit.base.expressions)
    assert len(Reader(changed._repr_html_()).tables) == 2
    assert EVIL not in Table("", Column("n", [EVIL]))._repr_html_()


def test_the_verdict_follows_the_most_severe_finding(fit, validation):
    first, second = validation.errors
    good = judge(Report(fit, (first,), (second,), validation.definiteness))
    assert good.verdict.status is Status.GOOD
    assert good.faults == ()
    bad = dataclasses.replace(second, predicted=second.predicted + 20.0)
    found = judge(Report(fit, (first,), (bad,), validation.definiteness))
    assert found.verdict.status is Status.BAD
    assert found.findings[0].status is Status.BAD
    assert "the fit did not use" in found.findings[0].text
    marks = [finding.status for finding in found.findings]
    assert marks == sorted(marks, key=SEVERITIES.index)
    sick = dataclasses.replace(validation.definiteness, smallest=-1.0, indefinite=0.2)
    found = judge(Report(fit, (first,), (second,), sick))
    assert found.verdict.status is Status.BAD


def test_errors_on_the_motion_of_the_fit_are_never_called_good(fit, validation):
    first, _ = validation.errors
    alone = judge(Report(fit, (first,), (), validation.definiteness))
    assert alone.verdict.status is Status.DOUBTFUL
    assert any("--verify" in finding.text for finding in alone.faults)
    (remark,) = (x for x in alone.findings if "motion of the fit" in x.text)
    assert remark.status is Status.NEUTRAL


@pytest.mark.parametrize(
    ("share", "status"),
    [
        (0.05, Status.GOOD),
        (0.2, Status.NEUTRAL),
        (0.35, Status.DOUBTFUL),
        (0.7, Status.BAD),
    ],
)
def test_errors_on_new_motion_are_judged_by_their_share_of_the_forces(
    fit, validation, share, status
):
    first, second = validation.errors
    wave = np.sin(7.0 * np.asarray(second.time))[:, None] * second.force_rms
    predicted = np.asarray(second.measured) + np.sqrt(2.0) * share * wave
    # No other parameters would do better.
    unexplained = predicted - np.asarray(second.measured)
    missed = dataclasses.replace(second, predicted=predicted, unexplained=unexplained)
    found = judge(Report(fit, (first,), (missed,), validation.definiteness))
    (remark,) = (x for x in found.findings if "the fit did not use" in x.text)
    assert remark.status is status
    assert found.verdict.status is status
    percents = [float(x) for x in re.findall(r"([\d.]+) %", remark.text)]
    assert percents[0] == pytest.approx(100 * share, rel=0.1)


def test_a_joint_that_hardly_works_does_not_fail_a_model(errors_of):
    errors = errors_of(2)
    largest = np.array([50.0, 50.0])
    measured = np.asarray(errors.measured) * np.array([1.0, 0.01])
    wrong = measured + np.array([0.0, 1.25])
    log = dataclasses.replace(
        errors, measured=measured, predicted=wrong, max_forces=largest
    )
    np.testing.assert_allclose(joint_errors([log])[1], 1.25 / 10.0, rtol=0.05)


def test_errors_that_other_parameters_would_not_make_are_pointed_out(fit, validation):
    first, second = validation.errors
    missed = dataclasses.replace(second, predicted=1.2 * np.asarray(second.measured))
    found = judge(Report(fit, (first,), (missed,), validation.definiteness))
    (growth,) = (x for x in found.faults if "same model fitted" in x.text)
    assert growth.status is Status.DOUBTFUL


def test_mistakes_come_first_and_decide(fit, validation):
    first, second = validation.errors
    said = {"mistakes": ("a sign is wrong",), "doubts": ("rows are lost",)}
    found = judge(Report(fit, (first,), (second,), validation.definiteness, **said))
    assert [r.text for r in found.findings[:2]] == [
        "a sign is wrong.",
        "rows are lost.",
    ]
    assert [r.status for r in found.faults] == [Status.BAD, Status.DOUBTFUL]
    assert found.verdict.status is Status.BAD


@pytest.mark.parametrize(("size", "is_doubted"), [(11.0, True), (0.1, False)])
def test_forces_far_below_those_of_the_files_bodies_are_doubted(
    fit, validation, size, is_doubted
):
    first, second = validation.errors
    for forces in (first.measured, 0.0 * np.asarray(first.measured)):
        claims = dataclasses.replace(
            first, measured=forces, predicted=size * np.asarray(first.measured)
        )
        errors = (first,), (second,), validation.definiteness
        remarks = judge(Report(fit, *errors, claimed_loads=(claims,))).findings
        doubts = [x for x in remarks if "bodies in the robot's file" in x.text]
        assert bool(doubts) == (is_doubted and bool(np.any(forces)))
        assert all("need 11 times" in doubt.text for doubt in doubts)


def test_friction_that_the_file_states_is_no_load_of_its_bodies(fit):
    """Many files state a friction of 1 in each joint that nobody has measured."""
    values = {"m1": 8.0, "fv1": 100.0, "fc1": 0.0}
    robot_file = SimpleNamespace(claims=lambda: values, bodies=lambda: None)
    q, qd, qdd = np.random.default_rng(0).standard_normal((3, 50, 2))
    log = jid.Observations.of(q, qd, qdd, np.ones((50, 2)), sample_time=0.01)
    claims = errors_of_claims(SimpleNamespace(robot_file=robot_file), fit, [log, log])
    (loads,) = claims.load_errors
    np.testing.assert_allclose(loads.predicted[:, 0], 8.0 * qdd[:, 0])
    with_friction = 8.0 * qdd[:, 0] + 100.0 * qd[:, 0]
    np.testing.assert_allclose(claims.errors[1].predicted[:, 0], with_friction)


def test_a_weight_that_gravity_does_not_explain_is_pointed_out(fit):
    """Numbers in names count driven joints, of which a floating base has none."""
    fixed_robot = fit.base.model.robot
    fields = {"driven": (6, 7), "numbers": (*(0,) * 6, 1, 2)}
    floating_robot = SimpleNamespace(
        **fields,
        joint_names=(*(f"base {k}" for k in range(6)), *fixed_robot.joint_names),
        known_max_forces=np.append(np.full(6, np.inf), fixed_robot.known_max_forces),
        force_unit=lambda j: "N m",
    )
    for robot in (fixed_robot, floating_robot):
        _check_offsets(robot, fixed_robot)


def _check_offsets(robot, fixed_robot):
    base = SimpleNamespace(
        model=SimpleNamespace(robot=robot), names=("m1", "fo1", "fo2")
    )
    limits = np.asarray(fixed_robot.known_max_forces)
    for share, spread, count in ((0.1, 0.0, 0), (-0.8, 0.3, 0), (-0.8, 0.0, 1)):
        p = np.array([1e6, share * limits[0], 0.01 * limits[1]])
        deviations = spread * np.abs(p)
        deviations[1] = spread * limits[0]
        sick = SimpleNamespace(base=base, parameters=p, standard_deviations=deviations)
        found = list(_judge_offsets(sick))
        assert [r.status for r in found] == [Status.DOUBTFUL] * count
    assert f"joint `{fixed_robot.joint_names[0]}`" in found[0].text.lower()


@pytest.mark.parametrize(
    ("price", "status"),
    [(0.05, Status.GOOD), (0.5, Status.DOUBTFUL), (19.0, Status.BAD)],
)
def test_bounds_that_the_log_contradicts_are_not_good(consistent, price, status):
    costly = dataclasses.replace(consistent.consistency, residual_increase=price)
    (found,) = _judge_bounds(dataclasses.replace(consistent, consistency=costly))
    assert found.status is status


def test_motors_are_those_of_driven_joints(tmp_path):
    """A trunk moves in six directions, but no motor moves it."""
    inertial = (
        "<inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='1' ixy='0' ixz='0' "
        "iyz='0'/></inertial>"
    )
    (tmp_path / "dog.urdf").write_text(
        f"<robot name='dog'><link name='trunk'>{inertial}</link><link name='leg'>"
        f"{inertial}</link><joint name='hip' type='continuous'><parent link='trunk'/>"
        "<child link='leg'/><axis xyz='0 1 0'/></joint></robot>"
    )
    robot = jid.load_urdf(tmp_path / "dog.urdf", floating=True)
    ratios = np.array([*np.ones(6), 8.0])
    (table,) = motor_tables(robot.replace(drives=jid.Drives(7, reduction=ratios)))
    assert table.rows == [("1", "8 hip")]
