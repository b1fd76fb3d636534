"""The choice of a model: planted effects are found, and the user's file is kept."""

import re
import time

import numpy as np
import pytest

import jaxid as jid
from jaxid.cli import terminal

PENDULUM = """\
<robot name="pendulum"><link name="base"/><link name="arm"><inertial>
<origin xyz="0.4 0 0"/><mass value="5"/>
<inertia ixx="0.01" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="axis" type="revolute"><parent link="base"/><child link="arm"/>
<axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="60" velocity="6"/></joint>
</robot>
"""
FILE = """\
# Mine.
[robot]
urdf = "pendulum.urdf"
[recording]   # as the logger writes it
time = "t"
angles = "q"
forces = "tau"
[filter]
kind = "butterworth"
cutoff = 10   # [Hz]
"""


def pendulum_log(folder, load=0.0, stribeck=0.0, seed=0):
    """Write a log of a pendulum whose equation of motion fits in a line."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 20.0, 0.005)
    q, v, a = np.zeros((3, len(t)))
    for k in (1, 2, 3, 5):
        w, size, phase = 0.9 * k, rng.uniform(0.4, 0.9) / k, rng.uniform(0, 6)
        q += size * np.sin(w * t + phase)
        v += size * w * np.cos(w * t + phase)
        a -= size * w**2 * np.sin(w * t + phase)
    weight = 5.0 * 9.81 * 0.4 * np.cos(q)
    dry = 1.0 + load * np.abs(weight) + stribeck * np.exp(-((v / 0.15) ** 2))
    tau = (0.2 + 5.0 * 0.4**2) * a - weight + 0.5 * v + dry * np.tanh(v / 0.01)
    table = np.column_stack([t, q, tau + rng.normal(0.0, 0.5, len(t))])
    file = folder / f"log{seed}.csv"
    np.savetxt(file, table, "%.7f", ",", header="t,q,tau", comments="")
    return file


@pytest.fixture
def experiment(tmp_path):
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    (tmp_path / "e.toml").write_text(FILE)
    return jid.experiment.load_experiment(tmp_path / "e.toml")


@pytest.mark.parametrize(
    ("effects", "name"),
    [
        ({}, None),
        ({"load": 0.2}, "friction by load"),
        ({"stribeck": 1.0}, "Stribeck"),
    ],
)
def test_a_planted_effect_is_found_and_its_promise_holds(
    experiment, tmp_path, effects, name
):
    texts = []
    log = pendulum_log(tmp_path, **effects)
    choice = jid.experiment.choose_model(experiment, [log], keep=texts.append)
    assert choice.is_complete
    if name is None:
        assert choice.text == FILE
        assert texts == []
    else:
        assert choice.path[1].changes == (name,)
        assert texts[-1] == choice.text
        assert "[recording]   # as the logger writes it" in choice.text
    other = pendulum_log(tmp_path, **effects, seed=1)
    setup = jid.experiment.parse_experiment(choice.text, experiment.path).setup
    report = jid.identify_logs(setup, [log], experiment.columns, verify=[other])
    assert choice.promise == pytest.approx(report.verification[0].relative, rel=0.15)


def test_the_best_so_far_is_returned_when_time_is_up(experiment, tmp_path):
    log = pendulum_log(tmp_path, load=0.2)
    choice = jid.experiment.choose_model(experiment, [log], seconds=0.0)
    assert not choice.is_complete
    assert choice.text == FILE
    assert "time limit was reached" in str(choice)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("[model] # a\nload = false # b\n", ["[model] # a", "load = true # b"]),
        ("[model]\ncoulomb = true\nviscous = false\n", ["viscous = false"]),
        ("[model.coulomb] # a\nhard = true # b\n", ["hard = true # b"]),
        ("[model]\ncoulomb = { hard = true } # a\n", ["# a"]),
        ("# nothing\n", ["# nothing"]),
    ],
)
def test_keys_are_set_and_all_else_is_kept(text, lines):
    import tomllib

    keys = {"model": {"load": True, "coulomb": {"stribeck": [0.1, 0.2]}}}
    changed = jid.experiment.changed_text(text, keys)
    for line in lines:
        assert line in changed
    model = tomllib.loads(changed)["model"]
    assert model["load"] is True
    assert model["coulomb"]["stribeck"] == [0.1, 0.2]
    if "hard" in text:
        assert model["coulomb"]["hard"] is True


def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(terminal, "LINE_INTERVAL", 0.1)
    with terminal.progress_bar() as progress:
        progress("measuring errors", 0.0)
        progress("measuring errors", 0.3)
        # The stage says nothing for as long as it compiles.
        time.sleep(0.5)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 2
    # Other stages follow: this one is nine tenths of the whole.
    for line in lines:
        assert re.fullmatch(r"measuring errors: 27 %, about \d+ s left", line)
