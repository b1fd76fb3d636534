"""The page: whole, closed in itself, escaped, and with the numbers of the result file."""

import dataclasses
import gc
import json
import re
import weakref
from html.parser import HTMLParser

import pytest
from matplotlib.figure import Figure
from report_samples import arm_of, errors_of

from jaxid.report.blocks import (
    Cell,
    Code,
    Column,
    Facts,
    Folded,
    Headline,
    Picture,
    Prose,
    Remark,
    Remarks,
    Sheet,
    Tone,
    beside_paper,
)
from jaxid.report.page import Page, Section
from jaxid.report.sheets import widened
from jaxid.report.torques import torque_figure
from jaxid.report.vector import drawing
from jaxid.report.verdict import verdict
from jaxid.report.write import write_report

VOID = {"meta", "br", "hr", "img", "link", "input"}
EVIL = "<script>alert('&\"')</script>"


class Reader(HTMLParser):
    """Follows the tags of a page, and keeps identifiers, links and the cells of its tables."""

    def __init__(self, text: str):
        super().__init__()
        self.open, self.ids, self.links, self.tables = [], [], [], []
        self.scripts = 0
        self.text = ""
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        self._note(tag, dict(attrs))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")

    def handle_startendtag(self, tag, attrs):
        self._note(tag, dict(attrs))

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> without a beginning"
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data

    def _note(self, tag, attrs):
        self.scripts += tag == "script"
        self.ids += [attrs["id"]] if "id" in attrs else []
        self.links += [v for k, v in attrs.items() if k.endswith("href") or k == "src"]
        self.links += re.findall(r"url\(([^)]*)\)", " ".join(v or "" for v in attrs.values()))


def read(page_text: str) -> Reader:
    """A page that needs nothing else, whose identifiers are its own and whose links lead there."""
    found = Reader(page_text)
    assert page_text.startswith("<!DOCTYPE html>")
    assert len(set(found.ids)) == len(found.ids)
    for link in found.links:
        assert link.startswith("#"), link
        assert link[1:] in found.ids, link
    assert "@import" not in page_text
    assert "//" not in re.sub(r"</?script>", "", page_text.partition("<body>")[0])
    return found


@pytest.fixture(scope="module")
def written(validated, tmp_path_factory):
    fit, validation = validated
    folder = tmp_path_factory.mktemp("report")
    settings = {"experiment": "cart.toml", "experiment_text": "[robot]\nurdf = 'a<b'\n"}
    write_report(
        folder,
        fit,
        validation.errors[:1],
        validation.errors[1:],
        validation.definiteness,
        settings,
        (f"a note {EVIL}",),
        doubts=("the log looks odd",),
    )
    return folder


def test_the_page_is_whole_and_needs_nothing_else(written):
    text = (written / "report.html").read_text("utf-8")
    found = read(text)
    assert found.scripts == 1, "nothing but the page's own"
    assert len(text) < 1_000_000
    assert "urdf = 'a<b'" in found.text
    assert f"a note {EVIL}" in found.text
    assert "The log looks odd." in found.text


def test_a_drawing_does_not_show_the_last_digits_of_its_layout():
    """The layout's last digits differ from process to process: the same report shall not."""

    def drawn(shift):
        figure = Figure((4.0, 3.0))
        for k in range(2):
            axes = figure.add_axes((0.1 + shift, 0.1 + 0.5 * k, 0.8, 0.35))
            axes.plot([0.0, 1.0, 2.0], [0.0, 1.0, 5.0])
            axes.set_gid(f"panel {k}")
        return [re.sub(r"\bf\d+-", "", panel) for panel in drawing(figure).panels]

    assert drawn(0.0) == drawn(1e-14)


def test_every_parameter_stands_there_with_the_numbers_of_the_result(written, fit):
    found = read((written / "report.html").read_text("utf-8"))
    rows = json.loads((written / "result.json").read_text("utf-8"))["base_parameters"]
    (table,) = [t for t in found.tables if "combination" in t[0]]
    assert len(table) == 1 + len(rows)
    for row, shown in zip(rows, table[1:], strict=True):
        cells = dict(zip(table[0], shown, strict=True))
        assert cells["parameter"] == row["name"]
        assert cells["combination"] == row["expression"]
        assert cells["unit"] == row["unit"]
        for title, key in (
            ("estimate", "estimate"),
            ("±", "standard_deviation"),
            ("95 %\nfrom", "low_95"),
            ("95 %\nto", "high_95"),
        ):
            shown_digits = cells[title].strip()
            step = 10.0 ** -len(shown_digits.partition(".")[2])
            assert abs(float(shown_digits) - row[key]) <= 0.51 * step, (row["name"], title)
    trusts = [dict(zip(table[0], shown, strict=True))["trust"] for shown in table[1:]]
    assert trusts == [t.value for t in fit.trust]


def test_names_that_are_markup_stay_text(validated, tmp_path):
    fit, validation = validated
    model = fit.base.model
    robot = dataclasses.replace(model.robot, joint_names=(EVIL, "b"), name=EVIL)
    model = dataclasses.replace(model, robot=robot)
    fit = dataclasses.replace(fit, base=dataclasses.replace(fit.base, model=model))
    errors = tuple(dataclasses.replace(e, name=EVIL) for e in validation.errors)
    write_report(tmp_path, fit, errors[:1], errors[1:], validation.definiteness, {"filter": EVIL})
    found = read((tmp_path / "report.html").read_text("utf-8"))
    assert found.scripts == 1
    assert found.text.count(EVIL) > 5


def test_every_block_is_written_and_escaped():
    sheet = Sheet((Column(EVIL), Column("n", number=True)), (("a", Cell(EVIL, Tone.BAD)),), EVIL)
    blocks = (
        Prose(EVIL),
        Code(EVIL),
        Facts(((EVIL, EVIL),)),
        Headline(Remark(Tone.GOOD, EVIL)),
        Remarks((Remark(Tone.DOUBTFUL, EVIL, EVIL),)),
        sheet,
        Folded(EVIL, (sheet,)),
        beside_paper(((EVIL, "1.0", "1.1"), ("b", "2", "2", EVIL))),
    )
    found = read(Page(EVIL, (Section(EVIL, blocks), Section("b", ())), EVIL, EVIL).html())
    assert found.scripts == 1
    assert found.text.count(EVIL) == 22
    assert found.tables[-1][0] == ["quantity", "paper", "here", "remark"]
    assert found.tables[-1][1:] == [[EVIL, "1.0", "1.1", ""], ["b", "2", "2", EVIL]]


def test_a_table_whose_rows_do_not_fit_is_refused():
    with pytest.raises(ValueError, match="2 cells, but one has 1"):
        Sheet((Column("a"), Column("b")), (("1",),))


def test_figures_are_cut_into_the_panels_that_they_name():
    several = Picture(torque_figure(errors_of(3), arm_of(3)), "caption")
    assert len(several.drawing.panels) == 3
    assert [e.label for e in several.drawing.legend][:2] == ["measured", "predicted"]
    widths = {p.split('viewBox="')[1].split('"')[0].split()[2] for p in several.drawing.panels}
    assert len(widths) == 1, "panels of one figure have one scale"
    plain = Figure()
    plain.subplots(2, 2)
    single = Picture(plain)
    assert len(single.drawing.panels) == 1
    assert "max-width" in single.drawing.panels[0], "a small figure does not grow to a whole page"
    assert "max-width" not in several.drawing.panels[0]
    found = read(Page("two", (Section("one", (several, single)),)).html())
    assert found.text.count("joint") >= 3


def test_a_figure_that_was_drawn_is_forgotten():
    figure = torque_figure(errors_of(2), arm_of(2))
    assert drawing(figure).legend
    held = weakref.ref(figure)
    del figure
    gc.collect()
    assert held() is None


def test_images_in_figures_stay_whole():
    figure = Figure()
    figure.subplots().imshow([[0.0, 1.0], [1.0, 0.0]])
    (panel,) = drawing(figure).panels
    (source,) = re.findall(r'<image[^>]* href="([^"]{22})', panel)
    assert source == "data:image/png;base64,"


def test_blanks_stand_for_digits_and_points():
    assert widened("1.25") == "1.25"
    assert widened("12   ") == "12\N{PUNCTUATION SPACE}\N{FIGURE SPACE}\N{FIGURE SPACE}"
    assert widened("1.2 ") == "1.2\N{FIGURE SPACE}"


def test_the_verdict_follows_what_was_found(fit, validation):
    first, second = validation.errors
    good = verdict(fit, (first,), (second,), validation.definiteness)
    assert Tone.BAD not in [remark.tone for remark in good]
    assert good[0].tone is max(
        (r.tone for r in good[1:] if r.tone is not Tone.PLAIN), key=list(Tone).index
    )
    bad = dataclasses.replace(second, predicted=second.predicted + 20.0)
    found = verdict(fit, (first,), (bad,), validation.definiteness)
    assert found[0].tone is Tone.BAD
    assert found[1].tone is Tone.BAD
    assert "has not seen" in found[1].text
    alone = verdict(fit, (first,), (), validation.definiteness)
    assert any("--verify" in remark.text for remark in alone)
    sick = dataclasses.replace(validation.definiteness, smallest=-1.0, indefinite=0.2)
    assert verdict(fit, (first,), (second,), sick)[0].tone is Tone.BAD
