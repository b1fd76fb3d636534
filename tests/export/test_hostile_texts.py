"""No name, date or note leaves its place in C, XML, TOML, HTML, YAML or a terminal."""

import dataclasses
import io
import json
import re
import tomllib

import equinox as eqx
import lxml.html
import numpy as np
import pytest
import yaml
from export_samples import possible
from lxml import etree
from rich.text import Text

import jaxid as jid
from jaxid.cli.terminal import Terminal
from jaxid.errors import InputError
from jaxid.experiment.template import toml_text
from jaxid.export import c_code
from jaxid.identification.fit_result import checksum_of
from jaxid.identification.model_file import load_fit
from jaxid.program.c_writer import CWriter
from jaxid.report.page import render_page
from jaxid.result_table import Column, Remark, Table, printable
from jaxid.trajectory.files import write_ros

PARTS = [
    *(
        '"',
        "'",
        "\\",
        "*/",
        "/*",
        "//",
        "??/",
        "?",
        "\n",
        "\r",
        "\t",
        "\0",
        "#",
        "{}",
        "{{",
        "%",
    ),
    *(
        "<script>",
        "</td>",
        "&lt;",
        "]]>",
        "-->",
        "--",
        "<!--",
        "[red]",
        "]",
        "=",
        ": ",
        "- ",
        "`",
    ),
    *(
        "\x1b[2J",
        "\x1b]0;t\x07",
        "\x9b31m",
        "\u202e",
        "\x7f",
        "\ud800",
        "é",
        "²",
        "日",
        "a b",
        "x",
    ),
    *(
        "#include <",
        "#define X system(1)",
        "$(id)",
        "$%s",
        "1e9",
        "&x",
        "*x",
        "!tag",
        "@",
    ),
]


def hostile(number, keep=lambda _: True):
    """Return random texts of dangerous parts."""
    random = np.random.default_rng(number)
    texts = (
        "".join(random.choice(PARTS, random.integers(1, 6))) for _ in range(10 * number)
    )
    return [text for text in texts if keep(text)][:number]


@pytest.fixture(scope="module")
def fit():
    """A fit of a small arm."""
    base = jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4)))
    p = possible(base.model)
    random = np.random.default_rng(0)
    motion = jid.Motion(*random.uniform(-2, 2, (3, 300, 2)))
    forces = base.model.inverse_dynamics(p, motion) + 0.1 * random.normal(size=(300, 2))
    o = jid.Observations.of(motion.q, motion.qd, motion.qdd, forces, sample_time=0.01)
    return jid.identify(base, o, jid.estimators.LeastSquares())


def named(fit, name):
    """Return a fit whose robot and joints have hostile names."""
    robot = fit.base.model.robot.replace(name=name, joint_names=(name, f"{name}2"))
    return eqx.tree_at(lambda x: x.base.model.robot, fit, robot)


def code_of(text):
    """Return C without comments and strings, as a compiler with trigraphs reads it."""
    text = text.replace("??/", "\\").replace("\\\n", "")
    comments_and_strings = r'/\*.*?\*/|"(?:\\.|[^"\\\n])*"'
    return re.sub(comments_and_strings, lambda m: m[0][0] * 2, text, flags=re.DOTALL)


def test_c(fit):
    functions = c_code.c_functions(fit)
    writer = CWriter(True, "arm", [x.program for x in functions])

    def written(fit):
        texts = c_code.c_texts(fit, writer, functions).values()
        assert all(text.isascii() for text in texts)
        return [code_of(text.replace(fit.checksum, "")) for text in texts]

    expected = written(fit)
    for a, b in zip(hostile(80), hostile(80, str.isprintable), strict=True):
        changed = dataclasses.replace(named(fit, b), recordings=(a,), date=a, name=a)
        assert written(changed) == expected, (a, b)


def test_html():
    def read(text):
        table = Table(text, Column(text, [text]), facts=[(text, text)], remarks=[text])
        blocks = [text, table, Remark(text), [Remark(text)]]
        return lxml.html.fromstring(render_page(text, [(text, blocks)], text))

    expected = [x.tag for x in read("x").iter()]
    for text in hostile(300, lambda x: printable(x).split()):
        page = read(text)
        # Names between backticks stand in an element without anything else.
        found = [x for x in page.iter() if dict(x.attrib) != {"class": "key"}]
        assert [x.tag for x in found] == expected, text
        assert "".join(printable(text).split()) in "".join(page.text_content().split())


def test_toml_and_yaml(fit, tmp_path):
    robot, path = fit.base.model.robot, tmp_path / "motion.yaml"
    motion = jid.trajectories.random_fourier_series(robot, omega=1.0, harmonics=1)
    for text in hostile(300, lambda x: "\ud800" not in x):
        assert tomllib.loads(f"a = {toml_text(text)}\nb = 1") == {"a": text, "b": 1}
    for text in hostile(80, str.isprintable):
        named = robot.replace(joint_names=(text, "b"))
        write_ros(motion, named, path, sample_time=1.0)
        assert yaml.safe_load(path.read_text())["joint_names"] == [text, "b"]


def test_xml(fit, tmp_path):
    consistent = dataclasses.replace(fit, full_parameters=possible(fit.base.model))
    for text in hostile(80, str.isprintable):
        path = tmp_path / "arm.xml"
        jid.export.export_mjcf(
            dataclasses.replace(named(consistent, text), date=text), path
        )
        root = etree.parse(path).getroot()
        assert [x.get("name") for x in root.iter("joint")] == [text, f"{text}2"]


def test_terminal():
    for text in hostile(300):
        file = io.StringIO()
        Terminal(file=file).print(Text(text))
        shown = file.getvalue() + str(Table(text, Column(text, [text]), remarks=[text]))
        assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u202e\ud800]", shown), text


def test_names_of_robots_and_texts_of_model_files(fit, tmp_path):
    path = fit.save(tmp_path / "model.json")
    document = json.loads(path.read_text())
    for key in ("date", "name", "recordings", "notes"):
        for text in hostile(20, lambda x: not x.isprintable()):
            own = [text] if key in ("recordings", "notes") else text
            content = {**document["model"], key: own}
            lying = {**document, "model": content, "checksum": checksum_of(content)}
            path.write_text(json.dumps(lying))
            with pytest.raises(InputError, match=r"printable|date"):
                load_fit(path)
    for text in hostile(100, lambda x: not x.isprintable()):
        with pytest.raises(InputError, match="must be printable"):
            fit.base.model.robot.replace(name=text)
