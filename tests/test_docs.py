"""Code in the documents runs: blocks of Python one after the other, TOML as a file.

The names in `given` are those that a page may use without defining them.
"""

import contextlib
import importlib
import io
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import jax
import numpy as np
import pinocchio as pin
import polars as pl
import pytest
from mechanisms import MECHANISMS
from true_arm import TrueArm, ball_sessions, true_origins

import jaxid as jid
from jaxid.cli import app as cli
from jaxid.dynamics.open_directions import OPEN_SHARES
from jaxid.experiment_file import KEYS
from jaxid.experiment_values import decode_table
from jaxid.program.sample_methods import in_numpy
from jaxid.simulation.virtual import random_bodies
from jaxid.validation.judgement import ERRORS, MAX_CONDITION_NUMBER
from jaxid.validation.mistake_search import (
    GAINS,
    MAX_CURED_MISFIT,
    MAX_MISFIT,
    MIN_POWER,
)
from jaxid.validation.torque_errors import POSES

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TUTORIAL = ROOT / "docs" / "tutorial.md"
SAMPLES, STEP = 8000, 0.001


def _blocks(page: Path, language: str) -> list[str]:
    text = page.read_text(encoding="utf-8")
    return re.findall(rf"^ *```{language}\n(.*?)^ *```", text, re.S | re.M)


def _with(language: str) -> list:
    return [
        pytest.param(page, id=page.name) for page in PAGES if _blocks(page, language)
    ]


def _inertial(body) -> str:
    m, x, y, z = body[0], *(body[1:4] / body[0])
    A, B, C, D, E, F = body[4:] - m * np.array(
        [y * y + z * z, x * x + z * z, x * x + y * y, y * z, x * z, x * y]
    )
    return (
        f'<inertial><origin xyz="{x} {y} {z}"/><mass value="{m}"/>'
        f'<inertia ixx="{A}" iyy="{B}" izz="{C}" iyz="{-D}" ixz="{-E}" ixy="{-F}"/>'
        "</inertial>"
    )


def _urdf(robot: jid.Robot, bodies) -> str:
    """A robot whose frames are parallel, as text."""
    parts = ['<robot name="arm"><link name="ground"/>']
    for j, name in enumerate(robot.joint_names):
        offset, axis = (" ".join(map(str, x[j])) for x in (robot.offset, robot.axis))
        parent = f"link{j}" if j else "ground"
        limits = robot.limits
        parts.append(
            f'<link name="link{j + 1}">{_inertial(bodies[j])}</link>'
            f'<joint name="{name}" type="revolute"><origin xyz="{offset}"/>'
            f'<parent link="{parent}"/><child link="link{j + 1}"/><axis xyz="{axis}"/>'
            f'<limit lower="{limits.position_min[j]}" '
            f'upper="{limits.position_max[j]}" velocity="{limits.velocity[j]}" '
            f'effort="{limits.force[j]}"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def _ordered(body, order: str) -> np.ndarray:
    """Mass, first moments, entries of the tensor about the origin, by other names."""
    m, mx, my, mz, A, B, C, D, E, F = body
    known = {"m": m, "mx": mx, "my": my, "mz": mz, "Ixx": A, "Iyy": B, "Izz": C}
    known |= {"Iyz": -D, "Ixz": -E, "Ixy": -F}
    return np.array([known[name] for name in order.split()])


def _theirs(body) -> dict[str, np.ndarray]:
    """One body as other packages hold it, in the orders of docs/conventions.md."""
    tensor = _ordered(body, "Ixx Ixy Ixz Ixy Iyy Iyz Ixz Iyz Izz").reshape(3, 3)
    m, c = body[0], body[1:4] / body[0]
    central = tensor - m * (c @ c * np.eye(3) - np.outer(c, c))
    return {
        "pinocchio": pin.Inertia(m, c, central).toDynamicParameters(),
        "idyntree": _ordered(body, "m mx my mz Ixx Ixy Ixz Iyy Iyz Izz"),
        "figaroh": _ordered(body, "Ixx Ixy Ixz Iyy Iyz Izz mx my mz m"),
    }


def _table(log: jid.Recording, degrees: bool) -> pl.DataFrame:
    angles = np.rad2deg(log.angles) if degrees else log.angles
    columns = {"t" if not degrees else "time": log.time}
    columns |= {f"q{j + 1}": angles[:, j] for j in range(log.joints)}
    columns |= {f"tau{j + 1}": log.forces[:, j] for j in range(log.joints)}
    return pl.DataFrame(columns)


def _write_lerobot(log: jid.Recording, folder: Path) -> None:
    """Write a log as LeRobot's hub has it: lists of degrees, two episodes."""
    folder.mkdir(parents=True)
    angles = np.rad2deg(log.angles)
    half = SAMPLES // 2
    episodes = np.repeat([0, 1], half)
    columns = {
        "observation.state": angles.tolist(),
        "action": angles.tolist(),
        "timestamp": STEP * np.tile(np.arange(half), 2),
        "episode_index": episodes,
    }
    pl.DataFrame(columns).write_parquet(folder / "file-000.parquet")


def _log(model: jid.Model, p, seed: int, alone: int | None = None) -> jid.Recording:
    """A log of all joints, or of one that moves alone."""
    n = model.robot.joints
    still = np.zeros(n) if alone is None else np.arange(n) != alone
    series = jid.trajectories.random_fourier_series(model.robot, omega=0.9, seed=seed)
    motion = jax.tree.map(
        lambda x: np.asarray(x) * (1 - still), series.motion(STEP * np.arange(SAMPLES))
    )
    forces = in_numpy(model, model.forces, motion.q, motion.qd, motion.qdd, shared=(p,))
    noise = np.random.default_rng(seed).normal(0.0, 0.2, forces.shape)
    return jid.Recording.of(
        motion.q, forces + noise, sample_time=STEP, name=f"log {seed}"
    )


@pytest.fixture(scope="module")
def given(tmp_path_factory):
    """Names and files that pages may use: a robot, its model, logs of it, a fit."""
    folder = tmp_path_factory.mktemp("documents")
    robot = jid.Robot(
        "two joints",
        revolute=(True,) * 2,
        axis=[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)],
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=[(0.0, 0.0, 0.3), (0.1, 0.0, 0.2)],
        tip_offset=(0.0, 0.0, 0.4),
        limits=jid.Limits(
            2,
            position_min=[-2.9, -1.5],
            position_max=[2.9, 1.5],
            velocity=[2.0, 2.0],
            force=[60.0, 80.0],
        ),
    )
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    model = jid.Model(robot, terms)
    bodies = random_bodies(robot, np.array([8.0, 5.0]), np.random.default_rng(0))
    p = np.concatenate(
        [bodies.ravel(), 0.02 * robot.max_forces, 0.03 * robot.max_forces]
    )
    log, second, *single = (
        _log(model, p, k, j) for k, j in enumerate((None, None, 0, 1))
    )
    (folder / "arm.urdf").write_text(_urdf(robot, bodies), encoding="utf-8")
    _table(log, degrees=True).write_csv(folder / "log.csv")
    _table(log, degrees=True).write_parquet(folder / "weeks.parquet")
    (folder / "logs").mkdir()
    for k, one in enumerate((log, second)):
        _table(one, degrees=False).write_parquet(folder / "logs" / f"{k}.parquet")
    _write_lerobot(log, folder / "lerobot" / "data" / "chunk-000")
    jid.simulation.write_example(folder / "example")
    five_bar = MECHANISMS["five-bar"].text
    (folder / "five_bar.xml").write_text(five_bar)
    tree = five_bar.replace("<connect", "<connect active='false'")
    (folder / "five_bar_tree.xml").write_text(tree)
    base = jid.base_parameters(model)
    smooth, every = jid.ZeroPhaseButterworth(10.0), jid.Subsample(40)
    seen = [jid.observe(x, robot, smooth, every) for x in (log, second, *single)]
    observations, other = seen[:2]
    rows, forces = observations.reduced_motion, observations.reduced_forces
    names = {
        "jax": jax,
        "np": np,
        "jid": jid,
        "robot": robot,
        "model": model,
        "base": base,
    }
    names |= {"observations": observations, "log": log}
    columns = jid.Columns(
        time="time", angles="q{}", forces="tau{}", angle_unit=jid.units.DEG
    )
    names["columns"] = columns
    names |= {"recording": log, "motion": rows, "forces": forces, "p": p}
    names |= {"motions": jax.tree.map(lambda x: np.stack([x, x]), rows)}
    names |= {"torques": np.stack([forces, forces]), "single_axes": tuple(seen[2:])}
    names |= {
        "other_observations": other,
        "theirs": _theirs(bodies[0]),
        "mass": bodies[0][0],
    }
    names |= {"centre_of_mass": bodies[0][1:4] / bodies[0][0]}
    names |= {"matlab_inertia": _ordered(bodies[0], "Ixx Iyy Izz Iyz Ixz Ixy")}
    # The wrench of a sensor is linear in what is behind it, as torques are.
    arm = robot.with_sensor()
    still = np.zeros((SAMPLES, 6))
    motion = [np.hstack([x, still]) for x in (log.angles, 0 * log.angles)]
    load = jid.Model(arm, (jid.terms.SensorLoad(),))
    wrench = load.inverse_dynamics(bodies[1], *motion, motion[1])[:, 2:]
    names |= {"wrench": wrench + np.random.default_rng(9).normal(size=wrench.shape)}
    names |= {"deviations": np.array([0.0, 1e-3])[:, None, None] * np.ones((2, 3))}
    names["socket_poses"] = _socket_poses()
    return folder, {**names, "fit": jid.identify(base, observations)}


def _socket_poses() -> dict[str, list[np.ndarray]]:
    """Joint coordinates of a Panda whose ball was in two sockets, by session."""
    panda = jid.robots.panda()
    poses: dict[str, list[np.ndarray]] = {}
    for x in ball_sessions(panda, TrueArm(panda, true_origins(panda)), 3, 10):
        if x.has_poses:
            poses.setdefault(x.session, []).append(x.q)
    return poses


@pytest.mark.parametrize("page", _with("python"))
def test_python_in_a_page_runs(page, given, monkeypatch):
    folder, names = given
    monkeypatch.chdir(folder)
    names = {**names, "__name__": "__main__"}
    for k, block in enumerate(_blocks(page, "python")):
        # These have tests of their own.
        if "report/model.json" in block or "go2.urdf" in block:
            continue
        exec(compile(block, f"{page.name}, block {k + 1}", "exec"), names)


@pytest.mark.parametrize("page", _with("toml"))
def test_keys_in_a_page_exist(page):
    for block in _blocks(page, "toml"):
        for name, table in tomllib.loads(block).items():
            decode_table(table, KEYS[name], name)


def test_other_packages_bodies_become_ours(given):
    _, names = given
    names = dict(names)
    for block in _blocks(ROOT / "docs" / "conventions.md", "python"):
        if "from_pinocchio" in block or "from_matlab" in block:
            exec(block, names)
    body = np.asarray(names["p"])[:10]
    for package in ("pinocchio", "idyntree", "figaroh", "sympybotics", "matlab"):
        np.testing.assert_allclose(
            names[f"from_{package}"], body, atol=1e-12, err_msg=package
        )


def test_the_example_in_the_readme_runs(given, tmp_path):
    folder, names = given
    (block,) = _blocks(ROOT / "README.md", "python")
    (tmp_path / "example.py").write_text(block, encoding="utf-8")
    shutil.copy(folder / "arm.urdf", tmp_path)
    _table(names["log"], degrees=False).rename({"t": "time"}).write_csv(
        tmp_path / "log.csv"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "example.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "14 base parameters" in done.stdout
    made = {path.name for path in tmp_path.iterdir()} - {
        "arm.urdf",
        "log.csv",
        "example.py",
    }
    assert made == {"report"}


THRESHOLDS = {
    "3.": (f"{OPEN_SHARES.doubtful:.0%}",),
    "4.": (f"below {MAX_CONDITION_NUMBER:.0f}",),
    "6.": (
        f"up to {ERRORS.good:.0%} of the RMS forces",
        f"above {ERRORS.doubtful:.0%} ({ERRORS.doubtful_joint:.0%} of a joint)",
        f"above {ERRORS.bad:.0%} ({ERRORS.bad_joint:.0%})",
    ),
    "7.": (f"at most {OPEN_SHARES.doubtful:.0%}", f"up to {OPEN_SHARES.bad:.0%}"),
    "10.": (f"all of {POSES} poses",),
    "11.": (f"{-MIN_POWER:.0%} of RMS force times RMS speed",),
}


@pytest.mark.parametrize("question", THRESHOLDS)
def test_thresholds_are_those_of_the_code(question):
    page = (ROOT / "docs" / "is_my_fit_good.md").read_text(encoding="utf-8")
    (row,) = (line for line in page.splitlines() if line.startswith(f"| {question} "))
    for threshold in THRESHOLDS[question]:
        assert threshold.replace("%", " %") in row


def test_the_limits_of_mistakes_are_the_codes():
    page = (ROOT / "docs" / "is_my_fit_good.md").read_text(encoding="utf-8")
    assert f"gains most and scores {GAINS.named:.1f} or more, both" in page
    assert f"must be less than {GAINS.named_rest:g} of what it was" in page
    assert f"or less than {100 * MAX_CURED_MISFIT:g} % of the forces" in page
    assert f"and less than {GAINS.possible_rest:g} of what it was" in page
    assert f"With a score from {GAINS.possible:g} on it is marked" in page
    assert f"a score of {GAINS.contact:g} is called a contact" in page
    assert f"if the error is more than {100 * MAX_MISFIT:g} % of the forces" in page


def _commands(page: Path) -> dict[str, str]:
    """Return the commands of a page, each with the text that is shown behind it."""
    text = page.read_text(encoding="utf-8")
    pairs = re.findall(
        r"```bash\n\.venv/bin/(jaxid [^\n]+)\n```\n+(?:```text\n(.*?)```)?", text, re.S
    )
    return dict(pairs)


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """Return what the tutorial's commands print, and where they ran."""
    folder = tmp_path_factory.mktemp("tutorial")
    outputs = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("COLUMNS", "80")
        for line in _commands(TUTORIAL):
            words = line.split()
            if words[1] not in ("example", "inspect", "identify"):
                continue  # motions differ from machine to machine
            stream = io.StringIO()
            patch.setattr(sys, "argv", words)
            with contextlib.redirect_stdout(stream), pytest.raises(SystemExit) as end:
                cli.main()
            assert end.value.code == 0, line
            outputs[line] = stream.getvalue()
    return folder, outputs


def test_the_tutorial_shows_what_its_commands_print(printed):
    _, outputs = printed
    shown = {
        line: text for line, text in _commands(TUTORIAL).items() if line in outputs
    }
    assert sum(map(bool, shown.values())) == 3
    for line, text in shown.items():
        there = [row.rstrip() for row in outputs[line].splitlines()]
        missing = [row for row in text.splitlines() if row not in there]
        assert not missing, f"{line} does not print {missing}"


@pytest.mark.parametrize("words", ["truth.json", "load_experiment("])
def test_the_tutorials_python_prints_what_is_shown(words, printed, monkeypatch, capsys):
    folder, _ = printed
    monkeypatch.chdir(folder)
    (block,) = (b for b in _blocks(TUTORIAL, "python") if words in b)
    exec(block, {})
    assert capsys.readouterr().out in TUTORIAL.read_text(encoding="utf-8")


def test_figures_of_the_readme_are_those_of_the_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    measured = json.loads(
        (ROOT / "benchmarks/measured/measured_robots.json").read_text()
    )
    for row in measured["rows"]:
        errors, code, verdict = row["measured"].split("; ", 2)
        (line,) = re.findall(rf"^\| `{row['number']}` \|.*$", text, re.M)
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert ", ".join(c for c in cells[2:4] if "%" in c) == errors
        assert cells[4].removeprefix(cells[4][:2]) == verdict
        assert code == f"exit code {cells[5]}"
        golden = json.loads((ROOT / f"tests/golden/{row['number']}.json").read_text())
        exact = golden["relative_errors"].values()
        texts = (f"{100 * error:#.2g}".removesuffix(".") for error in exact)
        assert errors == ", ".join(f"{text} %" for text in texts)


def test_every_guide_is_in_the_site_and_in_the_readme():
    navigation = (ROOT / "docs" / "mkdocs.yml").read_text(encoding="utf-8")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert f"docs/{page.name}" in navigation
        assert f"](docs/{page.name})" in readme
    for notebook in (ROOT / "notebooks").glob("*.ipynb"):
        assert f"](notebooks/{notebook.name})" in readme


def test_table_of_measured_figures_is_written_from_the_stored_ones(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    tables = importlib.import_module("run").tables()
    written = ROOT / "benchmarks/results/measured.md"
    assert tables == written.read_text(encoding="utf-8")
