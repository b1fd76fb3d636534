"""Xacro files with arguments, which a small program in place of `xacro` expands."""

import sys
import tomllib

import pytest

import jaxid as jid
from jaxid.cli import app as cli
from jaxid.errors import InputError
from jaxid.experiment.experiment import load_experiment
from jaxid.robot import xacro

ARM = """<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:include filename="prefix.xacro"/>
  <xacro:arg default="continuous" name="kind"/>
  <link name="base"/><link name="$(arg prefix)arm"><inertial><mass value="1"/>
  <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="hinge" type="$(arg kind)"><parent link="base"/>
  <child link="$(arg prefix)arm"/><axis xyz="0 1 0"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""
PREFIX = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name='prefix' default="my_"/></robot>
"""
PROGRAM = """import pathlib, re, sys
path, *words = sys.argv[1:]
folder = pathlib.Path(path).parent
if "--deps" in words:
    print(folder / "prefix.xacro")
    raise SystemExit
text = pathlib.Path(path).read_text()
values = {"kind": "continuous", "prefix": "my_"}
values |= dict(word.split(":=") for word in words)
text = re.sub(r"<xacro[^>]*>", "", text)
for name in re.findall(r"[(]arg ([^)]*)", text):
    if name not in values:
        sys.exit("error: Undefined substitution argument " + name)
    text = text.replace(f"$(arg {name})", values[name])
print(text)
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Write the robot's file, and a program that stands in for `xacro`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    (tmp_path / "arm.urdf.xacro").write_text(ARM)
    (tmp_path / "prefix.xacro").write_text(PREFIX)
    (tmp_path / "bin").mkdir()

    def write_program(text):
        program = tmp_path / "bin" / "xacro"
        program.write_text(f"#!{sys.executable} -S\n{text}")
        program.chmod(0o755)

    write_program(PROGRAM)
    return write_program


def init(monkeypatch, capfdbinary, *words):
    """Return exit code, template and errors of `jaxid init`."""
    monkeypatch.setattr(sys, "argv", ["jaxid", "init", "arm.urdf.xacro", *words])
    code = 0
    try:
        cli.main()
    except SystemExit as stop:
        code = stop.code or 0
    out, err = capfdbinary.readouterr()
    return code, out.decode(), err.decode()


def test_arguments_are_remembered_by_template_and_model(
    install, monkeypatch, capfdbinary, tmp_path
):
    words = ["--xacro", "kind:=prismatic", "--xacro", "prefix:=a b"]
    code, text, _ = init(monkeypatch, capfdbinary, *words)
    assert code == 0
    arguments = {"kind": "prismatic", "prefix": "a b"}
    assert tomllib.loads(text)["robot"]["xacro_arguments"] == arguments

    path = tmp_path / "experiment.toml"
    path.write_text(text, encoding="utf-8")
    setup = load_experiment(path).setup
    assert setup.robot.revolute == (False,)
    assert dict(setup.robot.source_arguments) == arguments
    assert setup.robot_file.claims()["m1"] == 1.0


def test_numbers_and_truth_values_of_the_experiment_file_are_texts(install, tmp_path):
    path = tmp_path / "experiment.toml"
    path.write_text(
        '[robot]\nurdf = "arm.urdf.xacro"\n'
        "xacro_arguments = { prefix = 6, kind = true }\n"
    )
    with pytest.raises(InputError, match=r"joint `hinge` has the type `true`"):
        load_experiment(path)
    path.write_text(path.read_text().replace("kind = true", 'kind = "revolute"'))
    robot = load_experiment(path).setup.robot
    assert dict(robot.source_arguments) == {"prefix": "6", "kind": "revolute"}
    path.write_text(path.read_text().replace("= 6", "= [6]"))
    with pytest.raises(InputError, match=r"`robot.xacro_arguments.prefix` must be"):
        load_experiment(path)


def test_an_unknown_argument_is_named(install, monkeypatch, capfdbinary):
    with pytest.raises(
        InputError, match=r"no xacro argument `dof`; it has `kind`, `pr"
    ):
        jid.load_urdf("arm.urdf.xacro", xacro_arguments={"dof": "6"})
    code, _, err = init(monkeypatch, capfdbinary, "--xacro", "dof=6")
    assert (code, err) == (2, "jaxid: `--xacro` must be like dof:=6, but is `dof=6`.\n")


def test_a_missing_argument_is_named_with_its_cure(install, tmp_path):
    (tmp_path / "arm.urdf.xacro").write_text(ARM.replace("arg kind", "arg sort"))
    cure = "argument sort: .*`xacro_arguments` in `.robot.`"
    with pytest.raises(InputError, match=cure):
        jid.load_urdf("arm.urdf.xacro")


def test_only_xacro_files_have_arguments(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text("<robot/>")
    with pytest.raises(InputError, match=r"not a xacro file.*remove `xacro_arguments`"):
        jid.load_urdf(path, xacro_arguments={"dof": "6"})


def test_a_program_that_does_not_end_is_stopped(install, monkeypatch):
    install("import time\ntime.sleep(9)")
    monkeypatch.setattr(xacro, "MAX_SECONDS", 0.2)
    with pytest.raises(
        InputError, match=r"has not ended after 0.2 s: give the expanded file"
    ):
        jid.load_urdf("arm.urdf.xacro")
