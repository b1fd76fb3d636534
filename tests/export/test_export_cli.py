"""`jaxid export`: what it writes, and that it refuses in one sentence."""

import sys

import pytest
from export_samples import fit_of, possible

import jaxid as jid
from jaxid.cli import app as cli

URDF = """<robot name="stick"><link name="a"/><link name="b"/><joint name="hinge"
 type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
</joint></robot>"""


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
    # A URDF file holds no rotor inertias.
    assert ("!  `arm.urdf` cannot hold Ia1: " in out) == (target == "urdf")
    code, _, err = run("report", "--to", target)
    assert code == 2
    assert "already exists" in err
    assert run("report/model.json", "--to", target, "--force")[0] == 0
    if target == "json":
        assert jid.load_fit("arm.json").checksum == report.checksum


def test_files_hold_the_model(report, run, tmp_path):
    assert run("report", "--to", "json", "-o", "new/b.json")[0] == 0
    assert jid.load_fit(tmp_path / "new/b.json").checksum == report.checksum
    assert run("report", "--to", "c", "-o", "c/my_arm.c", "--float")[0] == 0
    header = (tmp_path / "c/my_arm.h").read_text("ascii")
    assert "void my_arm_torque(const float *q" in header


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere", "--to", "c"), "`nowhere` does not exist"),
        (("empty", "--to", "c"), "`empty` must be a folder"),
        (("report", "--to", "c", "-o", "arm.h"), "must be a C file like arm.c"),
        (("report", "--to", "c", "-o", "7arm.c"), "names in C code"),
        (("report", "--to", "json", "-o", "empty"), "`empty` is a folder"),
        (
            ("report", "--to", "urdf", "--urdf", "other.urdf"),
            "`other.urdf` does not exist",
        ),
        (("built_in.json", "--to", "urdf"), "name it with `--urdf`"),
        (("built_in.json", "--to", "mjcf"), 'kind = "consistent"'),
    ],
)
@pytest.mark.usefixtures("report")
def test_refusals_are_one_sentence(run, tmp_path, arguments, message):
    (tmp_path / "empty").mkdir()
    model = jid.Model(jid.robots.planar_arm(1, 0.4))
    fit_of(model, possible(model)).save("built_in.json")
    before = sorted(p.name for p in tmp_path.rglob("*"))
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert len(err.strip().splitlines()) == 1
    assert sorted(p.name for p in tmp_path.rglob("*")) == before
