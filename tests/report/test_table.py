"""Tables: numbers as text, alignment, units, widths; and those of results."""

import io

import numpy as np
import pytest
from rich.console import Console

import jaxid as jid
from jaxid.cli.terminal import show
from jaxid.report.identification_page import body_table
from jaxid.result_table import (
    MISSING,
    Column,
    Remark,
    Status,
    Table,
    percent,
    significant,
    with_deviation,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.2345, "1.23"),
        (-0.012345, "-0.0123"),
        (123.456, "123"),
        (9.999, "10.0"),
        (0.9951, "0.995"),
        (1.5e-12, "1.50e-12"),
        (0.0, "0"),
        (float("inf"), "∞"),
        (float("nan"), MISSING),
    ],
)
def test_significant_digits(value, text):
    assert significant(value) == text


@pytest.mark.parametrize(
    ("value", "deviation", "texts"),
    [
        (1.23456, 0.0123, ("1.235", "0.012")),
        (1.23456, 0.00996, ("1.235", "0.010")),
        (1234.56, 12.3, ("1235", "12")),
        (0.5, float("inf"), ("0.5000", "∞")),
    ],
)
def test_estimates_have_the_digits_of_their_deviation(value, deviation, texts):
    assert with_deviation(value, deviation) == texts


def table():
    return Table(
        "errors",
        Column("joint", ["rail", "a joint with a name that goes on and on"]),
        Column("RMS", np.array([1.25, 100.0]), "N m"),
        Column("fraction", [0.5, np.nan], "%", percent),
        facts=[("rows", 799)],
        remarks=[Remark("a sentence " * 12, Status.BAD), "another"],
        status=[Status.GOOD, Status.DOUBTFUL],
        rules=[1],
    )


def test_text_is_aligned_marked_and_no_wider_than_asked():
    text = table().text(60).splitlines()
    assert text[:2] == ["errors", "rows  799"]
    header, units, first, rule, second = text[3:8]
    assert header.split() == ["RMS", "fraction"]
    assert units.split() == ["joint", "[N", "m]", "[%]"]
    assert first.startswith("✓  rail")
    assert second.startswith("!  a joint with")
    assert set(rule) == {"─", " "}
    assert first.index(".") == second.index("100") + 3, "points stand below each other"
    assert second.endswith(MISSING)
    assert text[9].startswith("✗  a sentence")
    assert text[-1] == "·  another."
    assert max(map(len, text)) <= 60
    narrow = table().text(40).splitlines()
    assert max(map(len, narrow)) <= 40
    head, tail = narrow[7:9]
    assert f"{head[3:22].strip()} {tail.strip()}" == table().rows[1][0]


def test_numbers_are_never_cut():
    numbers = [f"{k}.0123456789" for k in range(10)]
    wide = Table("", *(Column("n", [x], kind="number") for x in numbers))
    assert [x for x in wide.text(40).split() if x in numbers[1:]] == numbers[1:]
    assert max(map(len, wide.text(40).splitlines())) <= 40
    small = Table("", Column("n", [1.5]), Column("n", [2.5]))
    assert small.text(40).splitlines()[-1] == "1.50  2.50"
    assert wide.text(8).split().count(numbers[0]) == 9, "once in each block"


EXPRESSION = "A2 - B2 - (l2x^2 - l2y^2)*(m3 + m4 + m5) + 0.0825*(m4 + m5 - mz6)"


@pytest.mark.parametrize("width", [30, 40, 60, 80, 100])
def test_names_are_folded_and_never_cut(width):
    """Two joints may differ in the middle of their names only, expressions too."""
    names = ["left_arm_shoulder_pan_joint", "left_arm_shoulder_lift_joint"]
    expressions = [EXPRESSION, EXPRESSION.replace("l2y", "l3y")]
    numbers = [Column(f"number {k}", [1.5, 10.5], "N m") for k in range(3)]
    folded = Table(
        "",
        Column("joint", names),
        Column("parameter", expressions, kind="code"),
        *numbers,
        status=[Status.GOOD, Status.BAD],
    )
    assert "…" not in folded.text(width)
    blocks = [block.splitlines() for block in folded.text(width).split("\n\n")]
    lines = next(block for block in blocks if "parameter" in " ".join(block))
    header = next(line for line in lines if line.split()[:1] == ["joint"])
    first, last = header.index("joint"), header.index("parameter")
    end = None
    if "[N m]" in header:
        end = max(header.index("[N m]"), last + 12)
    starts = [k for k, line in enumerate(lines) if line[:1] in ("✓", "✗")]
    for k, start in enumerate(starts):
        rows = lines[start : [*starts, None][k + 1]]
        assert "".join(row[first:last].strip() for row in rows) == names[k]
        code = "".join(row[last:end] for row in rows)
        assert "1.50" not in code
        assert "".join(code.split()) == expressions[k].replace(" ", "")
    assert all(text in folded.text(width) for text in ("1.50", "10.5"))


@pytest.mark.parametrize("width", [60, 70, 80])
@pytest.mark.parametrize("numbers", [1, 8])
def test_names_are_never_folded_inside(width, numbers):
    """Tables go on below instead, with the names in each block."""
    names = ["shoulder_pan_joint", "left_arm_shoulder_lift_joint"]
    columns = [Column(f"number {k}", [1.5, 10.5], "N m") for k in range(numbers)]
    verdicts = Column("verdict", ["no change seen", "changed"])
    text = Table("", Column("joint", names), *columns, verdicts).text(width)
    blocks = text.split("\n\n")
    for block in blocks:
        assert set(names) <= set(block.split())
    assert (len(blocks) > 1) == (numbers > 1)
    assert max(map(len, text.splitlines())) <= width


@pytest.mark.parametrize("robot", [jid.robots.panda(), jid.robots.tx90l_on_rail()])
def test_numbers_of_the_joints_have_a_unit_each(robot):
    header = [column.header for column in robot.summary().columns]
    assert len({tuple(lines) for lines in header}) == len(header)
    is_number = [column.kind == "number" for column in robot.summary().columns]
    units = [lines[-1].strip("[]") for lines in np.array(header, object)[is_number]]
    if robot.revolute[0]:
        assert units == ["rad", "rad", "rad/s", "rad/s²", "N m"]
    else:
        assert units == ["unit", "unit", "unit/s", "unit/s²", "force unit"]
        assert ["unit"] in header
        assert ["force unit"] in header


def test_numbers_that_are_rounded_to_zero_have_no_sign():
    assert with_deviation(-0.0004, 0.12) == ("0.00", "0.12")
    assert with_deviation(-0.006, 0.12) == ("-0.01", "0.12")


def test_the_terminal_shows_the_same_letters_in_colour():
    plain, coloured = io.StringIO(), io.StringIO()
    show(Console(file=plain, width=60), table())
    show(Console(file=coloured, width=60, force_terminal=True), table())
    lines = [line.rstrip() for line in plain.getvalue().splitlines()]
    assert lines == ["", *table().text(60).splitlines()]
    assert "\x1b[32m✓" in coloured.getvalue()


def test_bodies_show_their_margins_and_the_active_bounds(consistent):
    robot = consistent.base.model.robot
    table = body_table(consistent.consistency, robot.joint_names)
    assert [row[0] for row in table.rows] == list(robot.joint_names)
    assert table.status == (Status.DOUBTFUL, Status.DOUBTFUL)
    assert "fv2 at 0" in str(table)
