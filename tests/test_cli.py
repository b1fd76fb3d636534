"""The command line: what it writes and refuses, and that it leaves no partial files."""

import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import patience
import polars as pl
import pytest

from jaxid.cli import app as cli, terminal
from jaxid.experiment.experiment import load_experiment

ROOT = Path(__file__).resolve().parent.parent
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
    'type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 '
    '0"/></joint></robot>'
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


def write_log(path, seed, seconds=6.0, still=False, sign=1.0, viscous=0.0):
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
    tau[:, 0] += viscous * qd[:, 0]
    with open(path, "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "q1", "q2", "tau1", "tau2"])
        writer.writerows(np.column_stack([t, q, tau]).round(7).tolist())


def call(*args):
    """Run a command line in this process; return its exit code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["jaxid", *map(str, args)])
        # Busy machines would print progress.
        patch.setattr("jaxid.cli.terminal.LINE_INTERVAL", 600.0)
        with pytest.raises(SystemExit) as stopped:
            cli.main()
    return stopped.value.code


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    """An experiment file, three logs, and a report on the first of them in `first`."""
    place = tmp_path_factory.mktemp("material")
    (place / "experiment.toml").write_text(EXPERIMENT)
    for seed, name in enumerate("abc"):
        write_log(place / f"{name}.csv", seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert call("identify", "experiment.toml", "a.csv", "-o", "first") == 0
    return place


@pytest.fixture
def folder(material, tmp_path, monkeypatch):
    """A copy of the material, without the report."""
    for path in material.glob("*.*"):
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    return tmp_path


@pytest.fixture
def first(material, folder):
    """The report on the first log, in the folder."""
    return shutil.copytree(material / "first", folder / "first")


@pytest.fixture
def run(capsys):
    """Runs a command line in this process: exit code, stdout and stderr."""
    return lambda *args: (call(*args), *capsys.readouterr())


@pytest.fixture
def words(run):
    """Runs a command, returns all it prints in one line; code 3: an unusable model."""

    def words(*args, ends=0):
        detail = () if args[0] == "export" else ("-v",)
        code, out, err = run(*args, *detail)
        assert (code, err) == (ends, "")
        return " ".join(out.split())

    return words


def refused(result, *expected):
    code, out, err = result
    assert (code, out) == (2, "")
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
    logs = ("a.csv", "b.csv", "--verify", "c.csv")
    code, out, err = run("identify", "experiment.toml", *logs, "--force")
    assert (code, err) == (0, "")
    found = result(folder)
    by_name = {p["name"]: p for p in found["base_parameters"]}
    truth = {
        "fv1": 0.4,
        "fv2": 0.4,
        "fc1": 0.3,
        "fc2": 0.3,
        "mx2": 0.75,
        "C2": 0.15 + 0.375,
    }
    for name, value in truth.items():
        assert abs(by_name[name]["estimate"] - value) < 0.02, name
    assert found["errors"]["verification"][0]["relative"] < 0.01
    assert [e["recording"] for e in found["errors"]["identification"]] == ["a", "b"]
    assert found["mass_matrix"]["positive_definite"]
    settings = found["settings"]
    assert settings["command"] == f"jaxid identify experiment.toml {' '.join(logs)}"
    page = (folder / "report" / "report.html").read_text(encoding="utf-8")
    assert settings["command"] in page
    for text in (
        *(
            "planar arm, 2 joints",
            "base parameters",
            "torque errors (RMS) over torques (RMS)",
        ),
        *("all joints", "positive definite in all"),
        "wrote report: report.html, result.json, parameters.csv",
    ):
        assert text in out
    assert set(os.listdir("report")) == set(found["files"])


def test_logs_of_one_name_are_told_apart_by_their_folders(folder, run):
    for name in ("monday", "friday"):
        (folder / name).mkdir()
        write_log(folder / name / "run.csv", len(name))
    logs = ("monday/run.csv", "--verify", "friday/run.csv")
    assert run("identify", "experiment.toml", *logs)[0] == 0
    assert result(folder)["fit"]["recordings"] == ["monday/run"]


def test_what_is_not_determined_is_said_with_a_cure(folder, words):
    write_log(folder / "still.csv", 5, still=True)
    said = words("identify", "experiment.toml", "still.csv", ends=3)
    for text in (
        "NOT DETERMINED by these logs",
        "must not be used individually",
        "Record a motion",
    ):
        assert text in said
    assert '`ridge = "cross_validated"`' in said
    (folder / "ridge.toml").write_text(
        EXPERIMENT + "[estimator]\nridge = 'cross_validated'\n"
    )
    said = words("identify", "ridge.toml", "still.csv", "-o", "ridge", ends=3)
    assert "NOT DETERMINED" in said
    assert "`ridge =" not in said


def test_a_single_slip_that_explains_a_bad_fit_is_named(folder, run, words):
    pl.read_csv("a.csv").with_columns(-pl.col("tau2")).write_csv("turned.csv")
    slip = (
        "the sign of the force of joint `joint2` seems to be wrong "
        "(`recording.force_sig"
    )
    assert "!" not in words("inspect", "experiment.toml", "a.csv")
    assert slip in words("inspect", "experiment.toml", "turned.csv")
    said = words("identify", "experiment.toml", "turned.csv", ends=3)
    assert f"✗ turned: {slip}" in said
    assert "Do not rely on this model yet" in said
    found = json.loads((folder / "report" / "result.json").read_text("utf-8"))[
        "verdict"
    ]
    assert [r["status"] for r in found[:2]] == ["bad", "bad"]
    command = ("export", "report", "--to", "json", "-o", "arm.json")
    assert refused(run(*command), "must not be used", slip, "`--force`")
    assert run(*command, "--force")[0] == 0
    said = words("states", "experiment.toml", "b.csv", "turned.csv")
    assert f"turned: {slip[:50]}" in said
    assert "b: " not in said


def separate(folder, *args, out=subprocess.PIPE):
    """Run a command in a process of its own."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_ENABLE_X64"}
    environment["PYTHONPATH"] = str(ROOT)
    command = [sys.executable, "-m", "jaxid", *args]
    return subprocess.run(
        command,
        cwd=folder,
        stdout=out,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def test_init_writes_a_file_that_loads(tmp_path):
    limit = '<limit lower="0" upper="0" velocity="0" effort="0"/></joint>'
    (tmp_path / "arm.urdf").write_text(STICK.replace("</joint>", limit))
    with open(tmp_path / "experiment.toml", "w") as file:
        done = separate(tmp_path, "init", "arm.urdf", out=file)
    assert done.returncode == 0
    for words in ("velocity 0 is taken", "effort 0 is taken", "the body has no mass"):
        assert words in " ".join(done.stderr.split())
    assert load_experiment(tmp_path / "experiment.toml").setup.robot.joint_names == (
        "hinge",
    )


def test_a_process_of_its_own_has_double_precision(folder):
    done = separate(folder, "inspect", "experiment.toml")
    assert done.returncode == 0, done.stderr
    assert "base parameters" in done.stdout


def test_help_needs_no_jax(run):
    script = "import sys; import jaxid.cli.app; sys.exit('jax' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    assert (
        subprocess.run([sys.executable, "-c", script], env=environment).returncode == 0
    )
    code, out, _ = run("--version")
    assert code == 0
    assert out.startswith("jaxid ")
    code, out, _ = run("identify", "--help")
    assert code == 0
    for option in ("--verify", "--split", "--output", "--force"):
        assert option in out


def test_results_are_short_and_more_or_less_is_asked_for(folder, run):
    command = ("identify", "experiment.toml", "a.csv", "--verify", "b.csv")
    _, short, _ = run(*command)
    _, long, _ = run(*command, "--verbose")
    _, verdict, _ = run(*command, "-q")
    assert len(short.splitlines()) < 25
    assert "fv1" not in short
    assert "fv1" in long
    assert verdict.startswith("✓  A good model")
    assert verdict.strip() in short
    assert "wrote" not in verdict


def test_help_names_arguments_for_people_and_exit_codes(run):
    for name in ("identify", "compare", "excite", "payload", "rollout", "init"):
        _, out, _ = run(name, "--help")
        assert "Exit codes: 0 done; 2 wrong input" in out
        usage = out.splitlines()[0]
        assert usage.startswith(f"Usage: jaxid {name} [OPTIONS] ")
        assert not re.search(r"[{}<]", usage)
        assert "<path>" not in out
        assert "list[" not in out
    _, out, _ = run("--help")
    assert "--install-completion" in out
    assert "..." not in out.replace("[ARGS]...", "")


def test_progress_of_all_stages_only_grows(capsys, monkeypatch):
    stages = [("reading", 0.0), ("factorising", 0.5), ("factorising", 1.0)]
    stages += [("predicting", 0.0), ("predicting", 1.0), ("writing", 0.0)]
    for interval, has_lines in ((0.01, True), (600.0, False)):
        monkeypatch.setattr(terminal, "LINE_INTERVAL", interval)
        with terminal.progress_bar() as progress:
            for stage, fraction in stages:
                progress(stage, fraction)
                time.sleep(5 * min(interval, 0.02))
        lines = capsys.readouterr().err.splitlines()
        assert bool(lines) == has_lines
        shares = [int(re.search(r": (\d+) %", line)[1]) for line in lines]
        # The first tenth tells too little of the rest.
        times = [", about " in line for line in lines]
        assert times == [share >= 10 for share in shares]
        assert shares == sorted(shares)
        assert max(shares, default=50) < 100


def test_a_shell_completes_commands_and_options(monkeypatch, run):
    monkeypatch.setenv("_JAXID_COMPLETE", "complete_bash")
    for line, expected in (("jaxid iden", "identify"), ("jaxid export --t", "--to")):
        monkeypatch.setenv("COMP_WORDS", line)
        monkeypatch.setenv("COMP_CWORD", str(line.count(" ")))
        assert expected in run()[1].split()


def test_an_earlier_report_is_replaced_and_foreign_files_are_kept(folder, first, run):
    (first / "notes.txt").write_text("mine")
    figures = ("--figures", "svg")
    assert run("identify", "experiment.toml", "a.csv", "-o", "first", *figures)[0] == 0
    assert "torque_4_a.svg" in os.listdir("first")
    assert run("identify", "experiment.toml", "b.csv", "-o", "first", *figures)[0] == 0
    assert result(folder, "first")["fit"]["recordings"] == ["b"]
    assert {"torque_4_b.svg", "notes.txt"} <= set(os.listdir("first"))
    assert "torque_4_a.svg" not in os.listdir("first")
    (folder / "data").mkdir()
    (folder / "data" / "precious.txt").write_text("mine")
    arguments = ("identify", "experiment.toml", "a.csv", "-o")
    assert refused(run(*arguments, "data"), "`data` holds files but no repor")
    assert refused(run(*arguments, "a.csv"), "`a.csv` is a file")
    assert listing(folder / "data") == ["precious.txt"]
    assert run(*arguments, "data", "--force")[0] == 0
    assert (folder / "data" / "precious.txt").read_text() == "mine"


def test_after_a_failure_nothing_is_half_written(folder, first, run, monkeypatch):
    before = {
        p: (folder / p).read_bytes() for p in listing(folder) if (folder / p).is_file()
    }

    def full_disk(*args, **kwargs):
        raise OSError(28, "No space left on device", "torque_b.svg")

    monkeypatch.setattr("jaxid.report.result_files.torque_figure", full_disk)
    for output in ("first", "new"):
        assert refused(
            run("identify", "experiment.toml", "b.csv", "-o", output),
            "`torque_b.svg`: No space left on device: nothing was written; make room",
        )
    after = {
        p: (folder / p).read_bytes() for p in listing(folder) if (folder / p).is_file()
    }
    assert after == before
    assert not (folder / "new").exists()


def test_errors_that_are_not_the_users_keep_their_traceback(folder, monkeypatch):
    monkeypatch.setattr(
        "jaxid.workflow.log_identification.validate",
        lambda *_, **__: np.zeros(3) + np.zeros(4),
    )
    monkeypatch.setattr(sys, "argv", ["jaxid", "identify", "experiment.toml", "a.csv"])
    with pytest.raises(ValueError, match="broadcast"):
        cli.main()


def test_a_missing_extra_is_one_sentence_with_the_command(folder, run, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    (folder / "arm.xml").write_text("<mujoco><worldbody/></mujoco>")
    code, out, err = run("init", "arm.xml")
    assert (code, out) == (2, "")
    assert len(err.strip().splitlines()) == 1
    assert '`pip install "jaxid-robotics[mujoco]"`' in err


def test_what_has_changed_between_two_runs_is_told(folder, first, run):
    write_log(folder / "d.csv", 2, viscous=-0.25)
    assert run("identify", "experiment.toml", "d.csv", "-o", "warm")[0] == 0
    code, out, err = run("compare", "first", "warm/")
    assert (code, err) == (0, "")
    changed = [line for line in out.splitlines() if line.rstrip().endswith("  changed")]
    assert len(changed) == 1
    assert "Changed: fv1." in out
    assert "viscous friction" in changed[0]
    content = json.loads(
        (folder / "comparison" / "comparison.json").read_text(encoding="utf-8")
    )
    rows = {r["name"]: r for r in content["parameters"]}
    assert abs(rows["fv1"]["difference"] + 0.25) < 0.02
    assert (content["first"], content["second"]) == ("first", "warm")
    assert run("compare", "warm", "first")[0] == 0, "an earlier comparison may go"
    shutil.copytree("first", "again")
    code, out, _ = run("compare", "first", "again")
    assert "were made from one log, `a.csv`, or from parts of it" in " ".join(
        out.split()
    )
    assert refused(run("compare", "first", "first/"), "`first` is given twice")
    assert refused(run("compare", "first", "none"), "`none` does not exist")


def test_two_models_are_laid_over_one_log(folder, first, run):
    (folder / "own.toml").write_text(EXPERIMENT + "[model]\noffset = false\n")
    assert run("identify", "own.toml", "a.csv", "-o", "own")[0] == 0
    asked = "different base parameters"
    assert refused(run("compare", "first", "own"), asked, "Or add `--log`")
    code, out, err = run("compare", "first", "own", "--log", "a.csv")
    assert (code, err) == (0, "")
    said = " ".join(out.split())
    for name in ("first", "own"):
        assert f"`{name}` was fitted to `a.csv`, or to a part of it" in said
    path = folder / "comparison" / "comparison.json"
    errors = json.loads(path.read_text(encoding="utf-8"))["errors"]
    for name in ("first", "own"):
        (expected,) = result(folder, name)["errors"]["identification"]
        assert errors[name]["relative"] == pytest.approx(expected["relative"], rel=1e-9)
    page = (folder / "comparison" / "report.html").read_text(encoding="utf-8")
    assert "predicts a better than the other model" in page
    assert "Both models on one log" in page
    assert "parameters have changed" not in page


SLOW = EXPERIMENT.replace("step = 4", "step = 4\nmin_speed = 0.05")
SLOW = SLOW.replace('time = "t"', 'time = "t"\nstart = 0.5\nstop = 5.5')


@pytest.mark.parametrize(("kind", "compiled_rows"), [("csv", True), ("parquet", False)])
def test_long_logs_give_what_short_ones_give(
    folder, words, monkeypatch, kind, compiled_rows
):
    if kind == "parquet":
        for name in "ab":
            pl.read_csv(f"{name}.csv").write_parquet(f"{name}.parquet")
    (folder / "slow.toml").write_text(SLOW)
    arguments = ("slow.toml", f"a.{kind}", "--verify", f"b.{kind}", "--split", "0.6")
    words("identify", *arguments, "-o", "short")
    expected = words("inspect", "slow.toml", f"a.{kind}")
    monkeypatch.setattr("jaxid.workflow.log_loading.LONG_LOG_ROWS", 500)
    monkeypatch.setattr("jaxid.workflow.log_loading.read_recording", None)
    if compiled_rows:
        monkeypatch.setattr("jaxid.RegressionProblem.compiled_samples", 500)
    words("identify", *arguments, "-o", "long")
    short, long = (result(folder, name) for name in ("short", "long"))
    for key in ("rows", "recordings"):
        assert short["fit"][key] == long["fit"][key]
    for a, b in zip(short["base_parameters"], long["base_parameters"], strict=True):
        assert abs(a["estimate"] - b["estimate"]) < 1e-7 * a["standard_deviation"]
        assert b["standard_deviation"] == pytest.approx(
            a["standard_deviation"], rel=1e-9
        )
    for role in ("identification", "verification"):
        for a, b in zip(short["errors"][role], long["errors"][role], strict=True):
            assert b["relative"] == pytest.approx(a["relative"], rel=1e-9)
            assert [j["rows"] for j in a["joints"]] == [j["rows"] for j in b["joints"]]
    assert short["notes"] == long["notes"]
    assert words("inspect", "slow.toml", f"a.{kind}") == expected


def test_slips_are_found_in_a_part_of_a_long_log(folder, words, monkeypatch):
    monkeypatch.setattr("jaxid.workflow.log_loading.LONG_LOG_ROWS", 500)
    monkeypatch.setattr("jaxid.validation.diagnosis.MAX_SAMPLES", 800)
    pl.read_csv("a.csv").with_columns(-pl.col("tau2")).write_csv("turned.csv")
    said = words("inspect", "experiment.toml", "turned.csv")
    assert "800 of the 1200 samples were examined for mistakes" in said
    assert "the sign of the force of joint `joint2` seems to be wrong" in said


def test_errors_of_many_rows_are_of_every_nth(folder, first, words, monkeypatch):
    monkeypatch.setattr("jaxid.workflow.log_loading.LONG_LOG_ROWS", 500)
    monkeypatch.setattr("jaxid.validation.torque_errors.MAX_ROWS", 100)
    said = words("identify", "experiment.toml", "a.csv", "-o", "long")
    assert "torque errors and figures use one of every 3 of its 2" in said
    short, long = (
        result(folder, n)["errors"]["identification"][0] for n in ("first", "long")
    )
    assert long["joints"][0]["rows"] == -(-short["joints"][0]["rows"] // 3)
    assert long["relative"] == pytest.approx(short["relative"], rel=0.1)


def test_a_long_log_that_must_be_mended_is_read_as_a_whole(
    folder, run, words, monkeypatch
):
    monkeypatch.setattr("jaxid.workflow.log_loading.LONG_LOG_ROWS", 500)
    lines = (folder / "a.csv").read_text().splitlines()
    lines.insert(700, lines[700])
    (folder / "twins.csv").write_text("\n".join(lines))
    said = words("identify", "experiment.toml", "twins.csv")
    assert "twins.csv is long, but had to be read as a whole: rows of" in said
    lines[900:903] = 3 * ["1,2,x,4,5"]
    (folder / "bad.csv").write_text("\n".join(lines))
    assert refused(run("identify", "experiment.toml", "bad.csv"), "bad.csv")


def test_a_filter_is_chosen_from_a_list_and_the_report_shows_why(folder, words):
    text = EXPERIMENT.replace("cutoff = 10", "cutoff = [2.0, 10.0, 20.0]")
    (folder / "experiment.toml").write_text(text)
    said = words("identify", "experiment.toml", "a.csv", "--verify", "c.csv")
    assert re.search(r"the logs are filtered at (10|20) Hz", said)
    assert re.search(r"all in a band of [\d.]+ Hz: .*20 Hz", said)
    page = (folder / "report" / "report.html").read_text("utf-8")
    assert "the logs are filtered at" in page


def test_a_filter_is_chosen_by_default_also_for_a_log_on_disk(
    folder, words, monkeypatch
):
    text = EXPERIMENT.replace("cutoff = 10", "")
    (folder / "experiment.toml").write_text(text)
    in_memory = words("identify", "experiment.toml", "a.csv", "--split", "0.6")
    monkeypatch.setattr("jaxid.workflow.log_loading.LONG_LOG_ROWS", 500)
    on_disk = words("identify", "experiment.toml", "a.csv", "--split", "0.6")
    choice = re.search(r"the logs are filtered at .*?%", in_memory)
    assert choice is not None
    assert choice[0] in on_disk


@pytest.mark.parametrize(
    ("moment", "number"), [(1.0, signal.SIGTERM), (4.0, signal.SIGINT)]
)
def test_a_signal_ends_a_command_at_once_and_leaves_nothing(folder, moment, number):
    command = [
        sys.executable,
        "-m",
        "jaxid",
        "excite",
        "experiment.toml",
        "-o",
        "new/motion.csv",
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stderr=subprocess.PIPE, text=True
    )
    time.sleep(moment)
    process.send_signal(number)
    said = process.communicate(timeout=patience.SECONDS)[1]
    assert process.returncode == 128 + number, said
    # Before it stand the checks that cannot be made.
    assert said.splitlines()[-1].startswith("jaxid: stopped")
    assert not list(folder.rglob(".jaxid-*"))
