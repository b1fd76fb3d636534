"""`jaxid export`: what it writes, and that it refuses in one sentence."""

import json
import sys

import numpy as np
import pytest
from export_samples import fit_of, motion, possible

import jaxid as jid
from jaxid import cli

URDF = """<robot name="stick"><link name="a"/><link name="b"/><joint name="hinge"
 type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>"""


@pytest.fixture
def report(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stick.urdf").write_text(URDF, "utf-8")
    model = jid.Model(jid.load_urdf("stick.urdf"))
    fit = fit_of(model, possible(model), full=True)
    fit.save("report/model.json")
    return fit


@pytest.fixture
def run(monkeypatch, capsys):
    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["jaxid", "export", *map(str, arguments)])
        try:
            cli.main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.mark.parametrize(
    ("target", "files"),
    [
        ("c", {"arm.c", "arm.h"}),
        ("urdf", {"arm.urdf"}),
        ("mjcf", {"arm.xml"}),
        ("json", {"arm.json"}),
        ("pinocchio", {"arm_pinocchio.json"}),
        ("jax", {"arm.jax"}),
    ],
)
def test_every_target_is_written_from_a_report(report, run, tmp_path, target, files):
    if target == "jax":
        pytest.importorskip("flatbuffers")
    before = {p.name for p in tmp_path.iterdir()}
    code, out, err = run("report", "--to", target)
    assert (code, err) == (0, "")
    assert {p.name for p in tmp_path.iterdir()} - before == files
    assert all(name in out for name in files)
    code, _, err = run("report", "--to", target)
    assert code == 2
    assert "is there already" in err
    assert run("report/model.json", "--to", target, "--force")[0] == 0


def test_files_hold_the_model(report, run):
    assert run("report", "--to", "json", "-o", "new/b.json")[0] == 0
    loaded, m = jid.load("new/b.json"), motion(1, 5)
    np.testing.assert_array_equal(loaded.predict(m), report.predict(m))
    assert run("report", "--to", "pinocchio", "-o", "b.json")[0] == 0
    with open("b.json", encoding="utf-8") as file:
        content = json.load(file)
    rows = [joint["parameters"] for joint in content["joints"]]
    np.testing.assert_array_equal(rows, jid.export.pinocchio_parameters(report))
    assert content["model"] == report.checksum
    assert run("report", "--to", "c", "-o", "c/my_arm.c", "--float")[0] == 0
    with open("c/my_arm.h", encoding="ascii") as file:
        assert "void my_arm_torque(const float *q" in file.read()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere", "--to", "c"), "`nowhere` is not there: give a folder"),
        (("empty", "--to", "c"), "`empty` holds no `model.json`"),
        (("stick.urdf", "--to", "c"), "is no model file"),
        (("report", "--to", "c", "-o", "arm.h"), "must be a C file like arm.c"),
        (("report", "--to", "c", "-o", "7arm.c"), "names in C code"),
        (("report", "--to", "json", "-o", "empty"), "`empty` is a folder"),
        (("report", "--to", "urdf", "--urdf", "other.urdf"), "`other.urdf` does not exist"),
    ],
)
@pytest.mark.usefixtures("report")
def test_refusals_are_one_sentence(run, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    before = sorted(p.name for p in tmp_path.rglob("*"))
    code, out, err = run(*arguments)
    assert code == 2
    assert out == ""
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("target", "full", "message"),
    [("urdf", True, "name it with `--urdf`"), ("mjcf", False, 'kind = "consistent"')],
)
def test_what_is_missing_is_named(run, tmp_path, monkeypatch, target, full, message):
    monkeypatch.chdir(tmp_path)
    model = jid.Model(jid.robots.planar_arm(1, 0.4))
    fit_of(model, possible(model), full=full).save("arm.json")
    code, _, err = run("arm.json", "--to", target)
    assert code == 2
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["arm.json"]
