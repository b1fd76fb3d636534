"""The command line: what it writes, what it refuses, and that it leaves nothing half-written."""

import csv
import io
import json
import os
import re
import subprocess
import sys
import time

import numpy as np
import polars as pl
import pytest

from jaxid import cli
from jaxid.experiment.experiment import load_experiment

pytestmark = pytest.mark.usefixtures("blank_figures")

ROOT = os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
EXPERIMENT = """\
[robot]
builtin = "planar_arm"
[limits]
force = [80, 20]
[recording]
angles = "q{}"
forces = "tau{}"
time = "t"
[filter]
kind = "butterworth"
cutoff = 10
[rows]
step = 4
"""
GRAVITY = 9.81
STICK = (
    '<robot name="stick"><link name="a"/><link name="b"/><joint name="hinge" '
    'type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint></robot>'
)


def two_links(q, qd, qdd):
    """A textbook's arm of two rods in the vertical plane, with friction [N m]."""
    (m1, m2), (I1, I2), c = (2.0, 1.5), (0.2, 0.15), 0.5
    q1, q2 = q.T
    a, b, k = I1 + m1 * c**2 + m2 + I2 + m2 * c**2, m2 * c, I2 + m2 * c**2
    g2 = m2 * c * GRAVITY * np.cos(q1 + q2)
    g1 = (m1 * c + m2) * GRAVITY * np.cos(q1) + g2
    t1 = (a + 2 * b * np.cos(q2)) * qdd[:, 0] + (k + b * np.cos(q2)) * qdd[:, 1]
    t1 += -b * np.sin(q2) * (2 * qd[:, 0] * qd[:, 1] + qd[:, 1] ** 2) + g1
    t2 = (k + b * np.cos(q2)) * qdd[:, 0] + k * qdd[:, 1]
    t2 += b * np.sin(q2) * qd[:, 0] ** 2 + g2
    return np.stack([t1, t2], 1) + 0.4 * qd + 0.3 * np.tanh(qd / 0.01)


def write_log(path, seed, seconds=6.0, still=False, sign=1.0):
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.005)
    w = 1.3 * np.arange(1, 5)[:, None]
    a, b = rng.uniform(-0.25, 0.25, (2, 4, 2))
    s, c = np.sin(w * t), np.cos(w * t)
    q = s.T @ a + c.T @ b
    qd = (w * c).T @ a - (w * s).T @ b
    qdd = -(w**2 * s).T @ a - (w**2 * c).T @ b
    if still:
        q[:, 1], qd[:, 1], qdd[:, 1] = 0.3, 0.0, 0.0
    tau = two_links(q, qd, qdd) * np.array([1.0, sign]) + rng.normal(0, 0.02, q.shape)
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "q1", "q2", "tau1", "tau2"])
        writer.writerows(np.column_stack([t, q, tau]).round(7).tolist())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with an experiment file and three logs."""
    (tmp_path / "experiment.toml").write_text(EXPERIMENT)
    for seed, name in enumerate("abc"):
        write_log(tmp_path / f"{name}.csv", seed)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


@pytest.fixture
def run(monkeypatch, capsys):
    """Runs a command line in this process: exit code, stdout and stderr."""

    def run(*args):
        monkeypatch.setattr(sys, "argv", ["jaxid", *map(str, args)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        out, err = capsys.readouterr()
        return stopped.value.code, out, err

    return run


def refused(result, *expected):
    code, out, err = result
    assert code == 2
    assert out == ""
    assert "Traceback" not in err
    assert err.count("\n") == 1
    assert err.startswith("jaxid: ")
    for text in expected:
        assert text in err
    return True


def result(folder, name="report"):
    return json.loads((folder / name / "result.json").read_text(encoding="utf-8"))


def listing(folder):
    return sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*"))


def test_identify_finds_a_textbook_arm(folder, run):
    code, out, err = run("identify", "experiment.toml", "a.csv", "b.csv", "--verify", "c.csv")
    assert code == 0, err
    assert err == ""
    found = result(folder)
    by_name = {p["name"]: p for p in found["base_parameters"]}
    truth = {"fv1": 0.4, "fv2": 0.4, "fc1": 0.3, "fc2": 0.3, "mx2": 0.75, "C2": 0.15 + 0.375}
    for name, value in truth.items():
        assert abs(by_name[name]["estimate"] - value) < 0.02, name
    assert found["errors"]["verification"][0]["relative"] < 0.01
    assert [e["recording"] for e in found["errors"]["identification"]] == ["a", "b"]
    assert found["mass_matrix"]["positive_definite"]
    assert found["settings"]["experiment_text"] == EXPERIMENT
    assert found["settings"]["verification"] == ["c.csv"]
    command = "jaxid identify experiment.toml a.csv b.csv --verify c.csv -o report"
    assert found["settings"]["command"] == command
    assert command in (folder / "report" / "report.html").read_text(encoding="utf-8")
    for text in (
        "planar arm, 2 joints",
        "condition number",
        "base parameters",
        "Validation",
        "% of the forces",
        "positive definite in all",
        "wrote report: report.html, result.json, parameters.csv",
        "N m",
    ):
        assert text in out
    assert max(map(len, out.splitlines())) <= 100
    assert set(os.listdir("report")) == set(found["files"])


@pytest.mark.parametrize("width", [80])
def test_output_keeps_to_the_width_of_the_terminal(folder, run, monkeypatch, width):
    monkeypatch.setenv("COLUMNS", str(width))
    code, out, _ = run("inspect", "experiment.toml", "a.csv")
    assert code == 0
    assert max(map(len, out.splitlines())) <= width
    assert " rad " in out
    code, out, _ = run("identify", "experiment.toml", "a.csv")
    assert code == 0
    assert max(map(len, out.splitlines())) <= width
    lines = [line for line in out.splitlines() if " kg m" in line]
    assert len(lines) >= 3
    assert not any("…" in line.split("  ", 2)[-1][-30:] for line in lines)


def test_verify_is_repeated_for_each_log(folder, run):
    verify = ("--verify", "b.csv", "--verify=c.csv")
    code, _, _ = run("identify", "experiment.toml", "a.csv", *verify, "-o", "r")
    assert code == 0
    found = result(folder, "r")
    assert found["fit"]["recordings"] == ["a"]
    assert [e["recording"] for e in found["errors"]["verification"]] == ["b", "c"]
    for old in (("--verify", "b.csv", "c.csv"), ("--verify=b.csv", "c.csv")):
        assert refused(run("identify", "experiment.toml", "a.csv", *old), "`--verify`", "`c.csv`")


def test_a_split_in_time(folder, run):
    code, out, _ = run("identify", "experiment.toml", "a.csv", "--split", "0.6")
    assert code == 0
    found = result(folder)
    first, rest = (found["errors"][k][0] for k in ("identification", "verification"))
    assert first["recording"] == "a, first 60 %"
    assert rest["recording"] == "a, rest"
    total = len(
        load_experiment("experiment.toml")
        .observe(load_experiment("experiment.toml").read("a.csv"))
        .reduced_time
    )
    rows = [e["joints"][0]["rows"] for e in (first, rest)]
    assert sum(rows) == total
    assert abs(rows[0] / total - 0.6) < 0.02
    assert "first 60 %" in out


def test_logs_of_one_name_are_told_apart_by_their_folders(folder, run):
    for name in ("monday", "friday"):
        (folder / name).mkdir()
        write_log(folder / name / "run.csv", len(name))
    assert (
        run("identify", "experiment.toml", "monday/run.csv", "--verify", "friday/run.csv")[0] == 0
    )
    assert result(folder)["fit"]["recordings"] == ["monday/run"]


def test_what_is_not_determined_is_said_with_a_cure(folder, run):
    write_log(folder / "still.csv", 5, still=True)
    code, out, _ = run("identify", "experiment.toml", "still.csv")
    assert code == 0
    assert "NOT DETERMINED by these logs" in out
    assert "mean nothing one by one" in out
    assert "Record a motion" in out
    assert '`ridge = "cross_validated"`' in " ".join(out.split())
    (folder / "ridge.toml").write_text(EXPERIMENT + "[estimator]\nridge = 'cross_validated'\n")
    code, out, _ = run("identify", "ridge.toml", "still.csv", "-o", "ridge")
    assert code == 0
    assert "NOT DETERMINED" in out
    assert "`ridge =" not in out


def test_inspect_without_a_log(folder, run):
    code, out, _ = run("inspect", "experiment.toml")
    assert code == 0
    for text in ("force", "base parameters of", "only in combination", "not identifiable"):
        assert text in out
    assert listing(folder) == ["a.csv", "b.csv", "c.csv", "experiment.toml"]


def test_inspect_doubts_wrong_units_and_signs(folder, run):
    def words(text, log="a.csv"):
        (folder / "e.toml").write_text(text)
        code, out, err = run("inspect", "e.toml", log)
        assert code == 0, err
        return " ".join(out.split())

    limits = "[limits]\nposition_min = [-2, -2]\nposition_max = [2, 2]\nvelocity = [6, 6]\n"
    good = EXPERIMENT.replace("[limits]\n", limits)
    sane = words(good)
    assert "!" not in sane
    assert "hese logs determine all" in sane
    wrong = words(good.replace('time = "t"', 'time = "t"\nangle_unit = "rev"'))
    assert "would not if those in the log were" in wrong
    assert 'radians (`recording.angle_unit` is "rev")' in wrong
    shifted = words(good.replace('time = "t"', 'time = "t"\nangle_offsets = [3, 0]'))
    assert "outside its range from -2 to 2 rad: check" in shifted
    assert "but its limit is 6" in wrong
    small = words(good.replace('time = "t"', 'time = "t"\nangle_unit = "deg"'))
    assert "is it the right column and unit?" in small
    forces = words(good.replace("force = [80, 20]", "force = [3, 1]"))
    assert "all joints need more than their largest forces" in forces
    assert "check `recording.force_unit`, `forces_side` and `torque_constants`" in forces
    one = words(good.replace("force = [80, 20]", "force = [3, 20]"))
    assert "N m, but its limit is 3 N m: check `recording.force_unit` and `forces_side`" in one
    write_log(folder / "signs.csv", 3, sign=-1.0)
    signs = words(good, "signs.csv")
    assert "the sign of the force of joint `joint2` seems to be wrong" in signs


def exchanged(path, log, *columns):
    """A copy of a log in which two columns have each other's names."""
    header, rest = log.read_text().split("\n", 1)
    names = header.strip().split(",")
    i, j = (names.index(c) for c in columns)
    names[i], names[j] = names[j], names[i]
    path.write_text(",".join(names) + "\n" + rest)


@pytest.mark.parametrize("command", ["inspect", "identify"])
def test_a_single_slip_that_explains_a_bad_fit_is_named(folder, run, command):
    def words(log):
        code, out, err = run(command, "experiment.toml", log)
        assert code == 0, err
        return " ".join(out.split())

    assert "instead of" not in words("a.csv")
    exchanged(folder / "forces.csv", folder / "a.csv", "tau1", "tau2")
    said = "the forces of joints `joint1` and `joint2` seem to be exchanged (`recording.forces`)"
    assert said in words("forces.csv")
    exchanged(folder / "angles.csv", folder / "a.csv", "q1", "q2")
    said = "the angles of joints `joint1` and `joint2` seem to be exchanged (`recording.angles`)"
    assert said in words("angles.csv")
    write_log(folder / "signs.csv", 3, sign=-1.0)
    said = "the sign of the force of joint `joint2` seems to be wrong (`recording.force_signs`)"
    assert said in words("signs.csv")


def test_wrapped_angles_are_doubted_by_both_commands(folder, run):
    lines = (folder / "a.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows[600:]:
        row[1] = f"{float(row[1]) - 6.283185:.7f}"
    (folder / "wrapped.csv").write_text("\n".join(",".join(row) for row in rows))
    sentence = "the angle of joint `joint1` jumps by a full turn (6.283) once, first at 2.99"
    for command in ("inspect", "identify"):
        code, out, err = run(command, "experiment.toml", "wrapped.csv")
        assert code == 0, err
        assert sentence in " ".join(out.split())
    assert any(sentence in note for note in result(folder)["notes"])
    out = " ".join(run("identify", "experiment.toml", "a.csv")[1].split())
    assert "jumps" not in out


def test_run_as_a_module_mistakes_are_sentences_too(folder):
    command = [sys.executable, "-m", "jaxid", "identify", "experiment.toml", "a.csv"]
    environment = {**os.environ, "PYTHONPATH": ROOT}
    done = subprocess.run(
        [*command, "--split", "2"], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 2
    assert done.stderr == "jaxid: `--split` must lie between 0 and 1, like 0.6, but is 2.\n"


def test_init_writes_a_file_that_loads(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "arm.urdf").write_text(STICK)
    code, out, err = run("init", "arm.urdf")
    assert (code, err) == (0, "")
    (tmp_path / "experiment.toml").write_text(out)
    assert load_experiment("experiment.toml").robot.joint_names == ("hinge",)


@pytest.mark.parametrize("target", ["experiment.toml", "sub/experiment.toml", "link/one.toml"])
def test_init_into_a_folder_finds_its_robot(tmp_path, target):
    """The shell opens the file; its path is not told, but where it lies can be seen."""
    (tmp_path / "arm.urdf").write_text(STICK)
    (tmp_path / "sub").mkdir()
    (tmp_path / "link").symlink_to("sub")
    (tmp_path / "dangling").symlink_to("nowhere")
    command = [sys.executable, "-m", "jaxid", "init", "arm.urdf"]
    with open(tmp_path / target, "w") as file:
        environment = {**os.environ, "PYTHONPATH": ROOT}
        subprocess.run(command, cwd=tmp_path, stdout=file, check=True, env=environment)
    text = (tmp_path / target).read_text()
    assert load_experiment(tmp_path / target).robot.joint_names == ("hinge",)
    assert ('urdf = "arm.urdf" ' in text) == (target == "experiment.toml")


def test_the_example_runs(tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, out, err = run("example", "here")
    assert code == 0, err
    command = out.strip().splitlines()[-1].removeprefix("now: jaxid ").split()
    assert run(*command)[0] == 0
    assert result(tmp_path / "here")["errors"]["verification"][0]["relative"] < 0.05


def test_version_and_help(run):
    code, out, _ = run("--version")
    assert code == 0
    assert out.startswith("jaxid ")
    code, out, _ = run("identify", "--help")
    assert code == 0
    for option in ("--verify", "--split", "--output", "--force"):
        assert option in out


def test_double_precision_is_turned_on(folder):
    """In a process of its own, where nobody else has done it."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    environment["PYTHONPATH"] = ROOT
    command = [sys.executable, "-m", "jaxid", "inspect", "experiment.toml"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "base parameters" in done.stdout


def test_refusals(folder, run):
    assert refused(run("inspect", "none.toml"), "`none.toml` is no file")
    assert refused(run("identify", "experiment.toml", "none.csv"), "`none.csv` is no file")
    assert refused(run("init", "none.urdf"), "none.urdf")
    assert refused(
        run("identify", "experiment.toml", "a.csv", "--split", "1.5"), "between 0 and 1", "is 1.5"
    )
    (folder / "wrong.toml").write_text(EXPERIMENT.replace("cutoff = 10", "cutoff = -3"))
    assert refused(
        run("identify", "wrong.toml", "a.csv"),
        "wrong.toml: `filter`: `cutoff`",
    )
    (folder / "cut.csv").write_text("t,q1,q2,tau1,tau2\n0,0,0,0,0\n0.1,0,x,0,0\n")
    assert refused(run("inspect", "experiment.toml", "cut.csv"), "`cut.csv`", "line 3", "`x`")
    (folder / "other.csv").write_text(
        (folder / "a.csv").read_text().replace("q2", "q_2").replace("tau2", "tau_2")
    )
    assert refused(run("inspect", "experiment.toml", "other.csv"), "`recording.angles` names 1")
    assert listing(folder) == [
        "a.csv",
        "b.csv",
        "c.csv",
        "cut.csv",
        "experiment.toml",
        "other.csv",
        "wrong.toml",
    ]


def test_words_that_no_command_knows(folder, run):
    for args in (("identify", "experiment.toml"), ("idntify",), ("identify", "a", "b", "--splt")):
        code, _, err = run(*args)
        assert code == 2
        assert "Traceback" not in err


def test_foreign_folders_are_left_alone(folder, run):
    (folder / "data").mkdir()
    (folder / "data" / "precious.txt").write_text("mine")
    (folder / "file").write_text("mine")
    assert refused(
        run("identify", "experiment.toml", "a.csv", "-o", "data"), "`data` holds files but no repor"
    )
    assert refused(run("identify", "experiment.toml", "a.csv", "-o", "file"), "`file` is a file")
    assert listing(folder / "data") == ["precious.txt"]
    code, _, _ = run("identify", "experiment.toml", "a.csv", "-o", "data", "--force")
    assert code == 0
    assert (folder / "data" / "precious.txt").read_text() == "mine"
    assert (folder / "data" / "result.json").is_file()


def test_an_earlier_report_is_replaced_and_notes_beside_it_are_kept(folder, run):
    assert run("identify", "experiment.toml", "a.csv")[0] == 0
    (folder / "report" / "notes.txt").write_text("mine")
    assert run("identify", "experiment.toml", "b.csv")[0] == 0
    assert result(folder)["fit"]["recordings"] == ["b"]
    names = os.listdir("report")
    assert "torque_b.png" in names
    assert "torque_a.png" not in names
    assert "notes.txt" in names


def test_after_a_failure_nothing_is_half_written(folder, run, monkeypatch):
    assert run("identify", "experiment.toml", "a.csv")[0] == 0
    before = {p: (folder / p).read_bytes() for p in listing(folder) if (folder / p).is_file()}

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device", "torque_b.png")

    monkeypatch.setattr("jaxid.report.result_files.torque_figure", full_disk)
    for output in ("report", "new"):
        assert refused(
            run("identify", "experiment.toml", "b.csv", "-o", output),
            "`torque_b.png`: No space left on device: nothing was written; make room",
        )
    after = {p: (folder / p).read_bytes() for p in listing(folder) if (folder / p).is_file()}
    assert after == before
    assert not (folder / "new").exists()


def test_errors_that_are_not_the_users_keep_their_traceback(folder, monkeypatch):
    def shapes(*args, **kwargs):
        return np.zeros(3) + np.zeros(4)

    monkeypatch.setattr("jaxid.experiment.session.validate", shapes)
    monkeypatch.setattr(sys, "argv", ["jaxid", "identify", "experiment.toml", "a.csv"])
    with pytest.raises(ValueError, match="broadcast"):
        cli.main()


def test_a_log_does_not_verify_what_has_seen_it(run, folder):
    code, _, err = run(
        "identify", "experiment.toml", "a.csv", "--verify", "../" + folder.name + "/a.csv"
    )
    assert code == 2
    assert "`a.csv` is given both to identify and to verify with" in err
    assert not (folder / "report").exists()


def test_what_has_changed_between_two_runs_is_told(folder, run):
    for name, logs in (("cold", "ab"), ("warm", "c")):
        for log in logs:
            lines = np.loadtxt(folder / f"{log}.csv", delimiter=",", skiprows=1)
            if name == "warm":
                lines[:, 3] -= 0.25 * np.gradient(lines[:, 1], lines[:, 0])
            header = "t,q1,q2,tau1,tau2"
            np.savetxt(folder / f"{log}.csv", lines, "%.7f", ",", header=header, comments="")
        files = [f"{log}.csv" for log in logs]
        assert run("identify", "experiment.toml", *files, "-o", f"{name}")[0] == 0
    code, out, err = run("compare", "cold", "warm/")
    assert code == 0, err
    assert err == ""
    changed = [line for line in out.splitlines() if line.rstrip().endswith("  changed")]
    assert len(changed) == 2, "one parameter and its kind"
    assert " fv1 " in changed[0]
    assert "viscous friction" in changed[1]
    assert max(map(len, out.splitlines())) <= 100
    content = json.loads((folder / "comparison" / "comparison.json").read_text(encoding="utf-8"))
    rows = {r["name"]: r for r in content["parameters"]}
    assert abs(rows["fv1"]["difference"] + 0.25) < 0.02
    assert rows["fv1"]["verdict"] == "changed"
    assert content["sources"] == ["cold", "warm"]
    assert set(os.listdir("comparison")) == {
        "comparison.json",
        "comparison.csv",
        "comparison.png",
    }
    assert run("compare", "warm", "cold")[0] == 0, "an earlier comparison may go"
    assert refused(run("compare", "cold", "cold/"), "`cold` is given twice")
    assert refused(run("compare", "cold", "none"), "`none` must be a folder", "`jaxid identify`")
    assert refused(run("compare", "cold", "warm", "-o", "."), "`.` holds files but no report")


SLOW = EXPERIMENT.replace("step = 4", "step = 4\nmin_speed = 0.05")
SLOW = SLOW.replace('time = "t"', 'time = "t"\nstart = 0.5\nstop = 5.5')


@pytest.mark.parametrize(("kind", "compiled"), [("csv", True), ("parquet", False)])
def test_long_logs_give_what_short_ones_give(folder, run, monkeypatch, kind, compiled):
    if kind == "parquet":
        for name in "ab":
            pl.read_csv(f"{name}.csv").write_parquet(f"{name}.parquet")
    (folder / "slow.toml").write_text(SLOW)
    logs = (f"a.{kind}", "--verify", f"b.{kind}", "--split", "0.6")
    assert run("identify", "slow.toml", *logs, "-o", "short")[0] == 0
    monkeypatch.setattr("jaxid.experiment.experiment.LONG", 500)
    monkeypatch.setattr("jaxid.experiment.experiment.read_recording", None)
    if compiled:
        monkeypatch.setattr("jaxid.identification.streaming.LONG", 500)
    code, out, err = run("identify", "slow.toml", *logs, "-o", "long")
    assert code == 0, err
    short, long = (result(folder, name) for name in ("short", "long"))
    for key in ("rows", "recordings"):
        assert short["fit"][key] == long["fit"][key]
    for a, b in zip(short["base_parameters"], long["base_parameters"], strict=True):
        assert abs(a["estimate"] - b["estimate"]) < 1e-7 * a["standard_deviation"]
        assert b["standard_deviation"] == pytest.approx(a["standard_deviation"], rel=1e-9)
    for role in ("identification", "verification"):
        for a, b in zip(short["errors"][role], long["errors"][role], strict=True):
            assert b["relative"] == pytest.approx(a["relative"], rel=1e-9)
            assert [j["rows"] for j in a["joints"]] == [j["rows"] for j in b["joints"]]
    assert short["notes"] == long["notes"]
    code, out, err = run("inspect", "slow.toml", f"a.{kind}")
    assert code == 0, err
    monkeypatch.undo()
    assert_same_words(out, run("inspect", folder / "slow.toml", folder / f"a.{kind}")[1])


def test_slips_are_found_in_a_part_of_a_long_log(folder, run, monkeypatch):
    monkeypatch.setattr("jaxid.experiment.experiment.LONG", 500)
    monkeypatch.setattr("jaxid.diagnosis.diagnosis._EXAMINED", 800)
    log = pl.read_csv("a.csv")
    log.with_columns(-pl.col("tau2")).write_csv("turned.csv")
    code, out, _ = run("inspect", "experiment.toml", "turned.csv")
    said = " ".join(out.split())
    assert code == 0
    assert f"800 of the {len(log)} samples were examined for mistakes" in said
    assert "the sign of the force of joint `joint2` seems to be wrong" in said
    held = pl.when(pl.col("t") < 2.0).then(pl.col("q2")).otherwise(0.1)
    log.with_columns(held.alias("q2")).write_csv("held.csv")
    said = " ".join(run("inspect", "experiment.toml", "held.csv")[1].split())
    assert "the angle of joint `joint2` stays at 0.1 from" in said
    assert "seem" not in said


def test_states_and_the_like_doubt_their_logs_too(folder, run):
    pl.read_csv("a.csv").with_columns(-pl.col("tau2")).write_csv("turned.csv")
    said = " ".join(run("states", "experiment.toml", "b.csv", "turned.csv")[1].split())
    assert "turned: the sign of the force of joint `joint2` seems to be wrong" in said
    assert "b: " not in said


def assert_same_words(a, b):
    """The same up to the last digit of a rounded number."""
    for x, y in zip(a.split(), b.split(), strict=True):
        assert x == y, (x, y)


def test_errors_of_many_rows_are_of_every_nth(folder, run, monkeypatch):
    assert run("identify", "experiment.toml", "a.csv", "-o", "short")[0] == 0
    monkeypatch.setattr("jaxid.experiment.experiment.LONG", 500)
    monkeypatch.setattr("jaxid.validation.ROWS", 100)
    code, out, _ = run("identify", "experiment.toml", "a.csv", "-o", "long")
    assert code == 0
    assert "torque errors and figures take one of every 3 of its 2" in " ".join(out.split())
    short, long = (result(folder, n)["errors"]["identification"][0] for n in ("short", "long"))
    rows = short["joints"][0]["rows"]
    assert long["joints"][0]["rows"] == -(-rows // 3)
    assert long["relative"] == pytest.approx(short["relative"], rel=0.1)


def test_a_long_log_that_must_be_mended_is_read_as_a_whole(folder, run, monkeypatch):
    monkeypatch.setattr("jaxid.experiment.experiment.LONG", 500)
    lines = (folder / "a.csv").read_text().splitlines()
    lines.insert(700, lines[700])
    (folder / "twins.csv").write_text("\n".join(lines))
    code, out, err = run("identify", "experiment.toml", "twins.csv")
    assert code == 0, err
    assert "twins.csv is long, but was read as a whole: rows of" in " ".join(out.split())
    (folder / "bad.csv").write_text("\n".join([*lines[:900], "1,2,x,4,5", *lines[901:]]))
    assert refused(run("identify", "experiment.toml", "bad.csv"), "bad.csv")


def test_a_bar_says_how_fast_and_how_long_still():
    from rich.console import Console

    from jaxid.experiment.progress import stages

    console = Console(force_terminal=True, width=120, file=io.StringIO())
    with stages(console, 2) as stage:
        stage("factorising")
        told = stage.through(4_000_000)
        for share in (0.1, 0.2, 0.5):
            time.sleep(0.05)
            told(share)
        stage._bar.refresh()
    shown = console.file.getvalue()
    assert re.search(r"50 %, [\d.]+ million rows/s, \d+:\d\d left", shown)
    assert "factorising" in shown


def test_a_filter_is_chosen_from_a_list_and_the_report_shows_why(folder, run):
    text = EXPERIMENT.replace("cutoff = 10", "cutoff = [2.0, 10.0, 20.0]")
    (folder / "experiment.toml").write_text(text)
    code, out, err = run("identify", "experiment.toml", "a.csv", "--verify", "c.csv")
    assert code == 0, err
    said = " ".join(out.split())
    assert re.search(r"a cut-off of (10|20) Hz predicts held-out parts", said)
    assert "2 Hz" in said
    assert "filter.png" in result(folder)["files"]
    assert (folder / "report" / "filter.png").stat().st_size > 5000


def test_nonlinear_friction_is_kept_where_it_pays(folder, run):
    """The logs have an epsilon of 0.01 rad/s; a file that says 0.2 is put right."""
    extra = "[model.coulomb]\nepsilon = 0.2\n[estimator]\nnonlinear_friction = true\n"
    (folder / "experiment.toml").write_text(EXPERIMENT + extra)
    code, out, err = run("identify", "experiment.toml", "a.csv", "b.csv", "--verify", "c.csv")
    assert code == 0, err
    said = " ".join(out.split())
    assert "nonlinear friction pays" in said
    assert re.search(r"eps2 = 0.01\d* ±", said)
    assert result(folder)["errors"]["verification"][0]["relative"] < 0.01
