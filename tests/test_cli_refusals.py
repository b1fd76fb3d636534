"""What no experiment file, log or report may hold: one sentence each, never a traceback."""

import json

import pytest
from test_cli import EXPERIMENT, folder, refused, run  # noqa: F401

KEYS = [
    ("[limits]\nforce = [80, 20]", "[limits]\nforce = [1e-300, 20]", "`force` must be above"),
    ("[limits]\nforce = [80, 20]", "[limits]\nforce = [80, 1e300]", "`force` must be below"),
    ("[robot]", "[robot]\ngravity = [0, 0, nan]", "`robot.gravity` must hold three finite"),
    ("[robot]", "[[robot]]", "but is a list of tables (`[[…]]`)"),
    ("[limits]", "[drives]\ngear_ratios = [nan, 1]\n[limits]", "`gear_ratios` must be finite nu"),
    ("[limits]", "[drives]\nzero = [inf, 1]\n[limits]", "`zero` must hold finite numbers"),
    ("[limits]", "[drives]\nmax_torques = [0, 1]\n[limits]", "`drives.max_torques[0]` must be pos"),
    ('time = "t"', 'time = "t"\ntime_unit = "ns"', "has 2e+11 samples in a second: check"),
    ('time = "t"', 'time = "t"\nforce_delay = inf', "the delay must be a finite time [s]"),
    ('time = "t"', 'time = "t"\nforce_delay = 100', "but the longest segment of `a` lasts 6 s"),
    ('time = "t"', 'time = "t"\nlargest_gap = 0.5', "`recording.largest_gap` must be above 1"),
    (
        'time = "t"',
        'time = "t"\nforce_unit = "A"\ntorque_constants = [0, 1]',
        "`torque_constants` must be numbers other than zero",
    ),
    (
        "[rows]",
        "[excitation]\nharmonics = 1000\n[rows]",
        "`excitation.harmonics` must be at most 50",
    ),
    ("[rows]", "[excitation]\nomega = 1e9\n[rows]", "`excitation.omega` must be at most 1000"),
    ("cutoff = 10", "cutoff = 99", "take one of 1 samples at most"),
]


@pytest.mark.parametrize(("key", "wrong", "sentence"), KEYS, ids=range(len(KEYS)))
def test_keys(folder, run, key, wrong, sentence):  # noqa: F811
    assert key in EXPERIMENT
    (folder / "e.toml").write_text(EXPERIMENT.replace(key, wrong))
    assert refused(run("inspect", "e.toml", "a.csv"), sentence)


def test_logs(folder, run):  # noqa: F811
    text = (folder / "a.csv").read_text()
    lines = text.splitlines()

    def log(content, *sentences, name="x.csv"):
        encoded = content.encode() if isinstance(content, str) else content
        (folder / name).write_bytes(encoded)
        return refused(run("inspect", "experiment.toml", name), *sentences)

    assert log(lines[0] + "\n", "`x.csv` has a header, but no rows")
    assert log("\n".join([*lines[:9], "1,2,3,4,5,6"]), "with 5 columns in every line: repair")
    assert log(text.encode("utf-16"), "`x.csv` is text in UTF-16: save it again in UTF-8")
    assert log(b"PK\3\4abc", "`x.npz` is no NPZ file", name="x.npz")


def test_logs_that_are_named_twice(folder, run):  # noqa: F811
    said = "`a.csv` is given twice"
    assert refused(run("identify", "experiment.toml", "a.csv", "./a.csv"), said)


def test_a_motion_is_not_written_over_other_files(folder, run):  # noqa: F811
    said = "`a.csv` is there already, and no motion of `jaxid excite`"
    assert refused(run("excite", "experiment.toml", "-o", "a.csv"), said)
    assert refused(run("excite", "experiment.toml", "-o", "motion"), "`motion` must end in .csv")
    (folder / "truth.json").write_text("{}")
    assert refused(run("excite", "experiment.toml", "-o", "truth.csv"), "`truth.json` is there al")


def test_damaged_results(folder, run):  # noqa: F811
    for name in "ab":
        assert run("identify", "experiment.toml", f"{name}.csv", "-o", name)[0] == 0
    path = folder / "b" / "result.json"
    whole = json.loads(path.read_text(encoding="utf-8"))

    def damaged(change, *sentences):
        content = json.loads(json.dumps(whole))
        change(content)
        path.write_text(json.dumps(content), encoding="utf-8")
        return refused(run("compare", "a", "b"), "result.json", *sentences)

    assert damaged(lambda c: c.update(fit=None), "has no `covariance`")
    assert damaged(lambda c: c["fit"]["covariance"][0].pop(), "`fit.covariance` must hold numbers")
    first = whole["base_parameters"][0]
    assert first["name"]
    assert damaged(lambda c: c["base_parameters"][0].update(estimate="x"), "must hold numbers")
