"""Reports on disk: exact numbers, valid JSON, whole or not at all."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from jaxid.identification.parameter_changes import Verdict, compare
from jaxid.report import result_files
from jaxid.report.comparison_page import ComparisonReport
from jaxid.report.figure import Figure
from jaxid.report.result_files import (
    _earlier_figures,
    read_faults,
    read_fit,
    safe_name,
    write_report,
)
from jaxid.report.result_records import SCHEMAS, consistency_record, plain
from jaxid.validation.judgement import Report


@pytest.fixture
def quick(monkeypatch):
    """Figures and pages are tested elsewhere."""
    monkeypatch.setattr(
        Figure, "save", lambda figure, path: path.write_bytes(b"figure")
    )
    monkeypatch.setattr(result_files, "identification_page", lambda *_: "page")


def report(folder, fit, validation, suffix="", **changes):
    arguments = {
        "identification": validation.errors[:1],
        "verification": validation.errors[1:],
        "definiteness": validation.definiteness,
        "settings": {"split": 0.6, "min_speed": np.array([0.1, np.inf])},
        "notes": ("a note",),
    }
    return write_report(folder, Report(fit, **{**arguments, **changes}), suffix)


def load(folder):
    def refuse(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads(
        (folder / "result.json").read_text("utf-8"), parse_constant=refuse
    )


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_writes_all_files_with_their_parents(written):
    figures = (
        "errors",
        "friction",
        "residuals",
    )
    figures += ("robot",)
    figures += ("torque_4_first-run", "torque_5_second")
    expected = ["model.json", "parameters.csv", "report.html", "result.json"]
    expected += [f"{name}.png" for name in figures]
    assert names(written) == sorted(load(written)["files"]) == sorted(expected)
    for path in written.glob("*.png"):
        assert path.read_bytes()[:4] == b"\x89PNG"
    assert names(written.parent) == ["report"]


def test_numbers_come_back_exactly(written, fit, validation):
    found = load(written)
    assert found["schema"] == "jaxid-result/1"
    rows = found["base_parameters"]
    for key, values in {
        "estimate": np.asarray(fit.parameters).tolist(),
        "standard_deviation": fit.standard_deviations.tolist(),
        "naive_standard_deviation": fit.naive_standard_deviations.tolist(),
        "ratio_to_naive": fit.uncertainty.ratios.tolist(),
        "degrees_of_freedom": fit.uncertainty.dof.tolist(),
        "name": list(fit.base.names),
    }.items():
        assert [r[key] for r in rows] == values, key
    assert [[r["low_95"], r["high_95"]] for r in rows] == fit.intervals(0.95).tolist()
    assert found["fit"]["covariance"] == np.asarray(fit.covariance).tolist()
    assert found["fit"]["condition_numbers"]["scaled"] == fit.condition_numbers.scaled
    joints = found["errors"]["verification"][0]["joints"]
    assert [j["mean"] for j in joints] == validation.errors[1].mean.tolist()
    assert [j["unit"] for j in joints] == ["N", "N m"]
    with (written / "parameters.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(r["estimate"]) for r in table] == np.asarray(fit.parameters).tolist()


def test_the_result_file_holds_complete_bodies(consistent, fit):
    assert consistency_record(fit) is None
    text = json.dumps(plain(consistency_record(consistent)), allow_nan=False)
    found = json.loads(text)
    values = [p["estimate"] for p in found["standard_parameters"]]
    np.testing.assert_array_equal(values, consistent.full_parameters)
    assert found["standard_parameters"][1]["unit"] == "kg m"
    assert found["certified"]
    assert found["residual_increase"] > 0.1
    assert found["masses_from_bounds"] == [0, 1]
    assert "fv2 at 0" in " ".join(found["active"])


def test_values_that_are_not_finite_are_null(tmp_path, fit, validation, quick):
    covariance = np.array(fit.covariance)
    covariance[0, 0] = np.inf
    unknown = dataclasses.replace(fit.uncertainty, covariance=covariance)
    fit = dataclasses.replace(fit, uncertainty=unknown)
    report(tmp_path, fit, validation)
    found = load(tmp_path)
    assert found["base_parameters"][0]["standard_deviation"] is None
    assert found["settings"]["min_speed"] == [0.1, None]
    mixed = (float("nan"), np.float64(np.inf), np.int64(3), None, True)
    assert plain({"a": mixed}) == {"a": [None, None, 3, None, True]}
    # The model file knows better: a comparison reads that.
    again = read_fit(tmp_path)
    np.testing.assert_array_equal(again.covariance, covariance)
    same = compare(again, again)
    assert set(same.verdicts) == {Verdict.UNKNOWN, Verdict.UNCHANGED}


def test_a_new_report_takes_the_place_of_the_old_one(tmp_path, fit, validation, quick):
    for name in ("log.csv", "torque_mine.svg"):
        (tmp_path / name).write_text("mine")
    report(tmp_path, fit, validation, suffix="pdf")
    report(tmp_path, fit, validation, suffix="svg", verification=())
    assert "torque_5_second.svg" not in names(tmp_path)
    assert "torque_4_first-run.svg" in names(tmp_path)
    assert not [name for name in names(tmp_path) if name.endswith(".pdf")]
    for name in ("log.csv", "torque_mine.svg"):
        assert (tmp_path / name).read_text() == "mine"


def test_recordings_of_one_name_keep_their_figures_apart(
    tmp_path, fit, validation, quick, errors_of
):
    same = tuple(
        dataclasses.replace(errors_of(2), name=name) for name in ("Run", "run", "run")
    )
    report(
        tmp_path, fit, validation, "svg", identification=same[:1], verification=same[1:]
    )
    figures = [n for n in names(tmp_path) if n.startswith("torque")]
    assert len({n.lower() for n in figures}) == 3


def test_comparisons_hold_the_numbers_exactly(tmp_path, changed):
    robot = changed.first.base.model.robot
    report = ComparisonReport(robot, changed, {}, ())
    files = report.save(tmp_path / "out")
    assert [p.name for p in files] == [
        "report.html",
        "comparison.json",
        "comparison.csv",
    ]
    content = json.loads(files[1].read_text(encoding="utf-8"))
    assert content["schema"] == "jaxid-comparison/1"
    assert [
        r["difference"] for r in content["parameters"]
    ] == changed.difference.tolist()
    assert content["groups"][1]["changed"] is True
    with files[2].open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["half_width"]) for r in rows] == changed.half_widths.tolist()
    assert all(name in files[0].read_text(encoding="utf-8") for name in changed.names)


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("../../etc/passwd", "etc-passwd"),
        ("Prüfstand 3: kalt", "Prufstand-3-kalt"),
        ("日本", "recording"),
    ],
)
def test_names_become_safe(name, safe):
    assert safe_name(name) == safe


@pytest.mark.parametrize(
    "content",
    [
        {"verdict": "bad", "files": 3},
        {"verdict": {"status": "bad"}, "files": {"torques.svg": 1}},
        {"verdict": [{}, {"status": "bad"}], "files": [1, None]},
        {"verdict": None, "files": "torques.svg"},
    ],
)
def test_damaged_results_are_named(tmp_path, content):
    path = tmp_path / "result.json"
    path.write_text(json.dumps({"schema": SCHEMAS["result.json"], **content}))
    with pytest.raises(ValueError, match=r"result\.json` is damaged"):
        read_faults(tmp_path)
    assert not _earlier_figures(tmp_path)
