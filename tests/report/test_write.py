"""The report on disk: exact numbers, valid JSON, whole or not at all."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from report_samples import errors_of

from jaxid.report import write
from jaxid.report.content import plain
from jaxid.report.page import Page
from jaxid.report.write import safe_name, write_report


@pytest.fixture
def quick(monkeypatch):
    """Figures are tested elsewhere."""
    monkeypatch.setattr(write, "save", lambda figure, path: path.write_bytes(b"figure"))
    monkeypatch.setattr(write, "identification_page", lambda *_: Page("page", ()))


def report(folder, fit, validation, **changes):
    arguments = {
        "identification": validation.errors[:1],
        "verification": validation.errors[1:],
        "definiteness": validation.definiteness,
        "settings": {"split": 0.6, "slow": np.array([0.1, np.inf])},
        "notes": ("a note",),
    }
    return write_report(folder, fit, **{**arguments, **changes})


def load(folder):
    def refuse(token):
        raise AssertionError(f"{token} is no JSON")

    return json.loads((folder / "result.json").read_text("utf-8"), parse_constant=refuse)


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_writes_all_files_with_their_parents(tmp_path, fit, validation):
    folder = tmp_path / "a" / "b" / "report"
    files = report(folder, fit, validation)
    assert sorted(p.name for p in files) == names(folder)
    assert names(folder) == [
        "autocorrelation.png",
        "errors.png",
        "model.json",
        "parameters.csv",
        "parameters.png",
        "report.html",
        "residuals.png",
        "result.json",
        "torque_first-run.png",
        "torque_second.png",
    ]
    for path in files:
        if path.suffix == ".png":
            assert path.read_bytes().startswith(b"\x89PNG")
    assert names(tmp_path) == ["a"]


def test_numbers_come_back_exactly(tmp_path, fit, validation, quick):
    report(tmp_path, fit, validation)
    found = load(tmp_path)
    assert found["schema"] == "jaxid-result/1"
    rows = found["base_parameters"]
    assert [r["estimate"] for r in rows] == np.asarray(fit.parameters).tolist()
    assert [r["standard_deviation"] for r in rows] == fit.standard_deviations.tolist()
    assert [r["naive_standard_deviation"] for r in rows] == fit.naive_standard_deviations.tolist()
    assert [r["ratio_to_naive"] for r in rows] == fit.uncertainty.ratios.tolist()
    intervals = [[r["low_95"], r["high_95"]] for r in rows]
    assert intervals == fit.intervals(0.95).tolist()
    assert [r["degrees_of_freedom"] for r in rows] == fit.uncertainty.freedom.tolist()
    residuals = found["fit"]["residuals"]
    assert residuals["white"] == list(fit.residual_spectra.white)
    assert np.shape(residuals["density"]) == (2, len(residuals["frequency"]))
    assert [r["name"] for r in rows] == list(fit.base.names)
    assert [r["expression"] for r in rows] == list(fit.base.expressions)
    assert [r["unit"] for r in rows] == list(fit.base.units)
    assert found["fit"]["covariance"] == np.asarray(fit.covariance).tolist()
    assert found["fit"]["condition_numbers"]["scaled"] == fit.condition_numbers.scaled
    assert found["mass_matrix"]["positive_definite"] is True
    joints = found["errors"]["verification"][0]["joints"]
    assert [j["mean"] for j in joints] == validation.errors[1].mean.tolist()
    assert [j["unit"] for j in joints] == ["N", "N m"]
    assert found["notes"][-1] == "a note"
    assert set(found["made"]["versions"]) == {"jaxid", "jax", "numpy", "python"}
    with (tmp_path / "parameters.csv").open(encoding="utf-8", newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(r["estimate"]) for r in table] == np.asarray(fit.parameters).tolist()
    assert [r["unit"] for r in table] == list(fit.base.units)


def test_what_is_not_finite_is_null(tmp_path, fit, validation, quick):
    covariance = np.array(fit.covariance)
    covariance[0, 0] = np.inf
    unknown = dataclasses.replace(fit.uncertainty, covariance=covariance)
    report(tmp_path, dataclasses.replace(fit, uncertainty=unknown), validation)
    found = load(tmp_path)
    assert found["base_parameters"][0]["standard_deviation"] is None
    assert found["settings"]["slow"] == [0.1, None]
    assert found["robot"]["joints"][0]["position_max"] is None
    assert plain({"a": (float("nan"), np.float64(np.inf), np.int64(3), None, True)}) == {
        "a": [None, None, 3, None, True]
    }


def test_the_model_can_be_used_again(tmp_path, fit, validation, quick):
    report(tmp_path, fit, validation)
    model = load(tmp_path)["model"]
    p = np.random.default_rng(0).standard_normal(fit.base.model.size)
    kappa = np.array(model["kappa"])
    again = p[model["independent"]] + kappa @ p[model["dependent"]]
    np.testing.assert_allclose(again, fit.base.from_standard(p), rtol=1e-14)
    assert model["standard_names"] == list(fit.base.model.parameter_names)


@pytest.mark.parametrize("present", [False, True])
def test_a_failure_in_the_middle_leaves_nothing(tmp_path, fit, validation, monkeypatch, present):
    folder = tmp_path / "new" / "report"
    if present:
        folder.mkdir(parents=True)
        (folder / "result.json").write_text("old")
    calls = []

    def fail(*arguments):
        calls.append(arguments)
        if len(calls) == 2:
            raise RuntimeError("no ink")
        return real(*arguments)

    real = write.torque_figure
    monkeypatch.setattr(write, "torque_figure", fail)
    with pytest.raises(RuntimeError, match="no ink"):
        report(folder, fit, validation)
    if present:
        assert names(folder) == ["result.json"]
        assert (folder / "result.json").read_text() == "old"
    else:
        assert names(tmp_path) == []


def test_a_new_report_takes_the_place_of_the_old_one(tmp_path, fit, validation, quick):
    (tmp_path / "log.csv").write_text("mine")
    (tmp_path / "torque_mine.png").write_text("mine")
    report(tmp_path, fit, validation)
    report(tmp_path, fit, validation, verification=())
    assert "torque_second.png" not in names(tmp_path)
    assert "torque_first-run.png" in names(tmp_path)
    assert (tmp_path / "log.csv").read_text() == "mine"
    assert (tmp_path / "torque_mine.png").read_text() == "mine"


def test_figures_come_as_pdf_too_if_asked(tmp_path, fit, validation):
    report(tmp_path, fit, validation, pdf=True)
    pictures = {n for n in names(tmp_path) if n.endswith(".png")}
    assert {n.removesuffix(".pdf") for n in names(tmp_path) if n.endswith(".pdf")} == {
        n.removesuffix(".png") for n in pictures
    }
    assert (tmp_path / "errors.pdf").read_bytes().startswith(b"%PDF")
    report(tmp_path, fit, validation)
    assert not [n for n in names(tmp_path) if n.endswith(".pdf")]


def test_recordings_of_one_name_keep_their_figures_apart(tmp_path, fit, validation, quick):
    same = tuple(dataclasses.replace(errors_of(2), name=name) for name in ("Run", "run", "run"))
    report(tmp_path, fit, validation, identification=same[:1], verification=same[1:])
    figures = [n for n in names(tmp_path) if n.startswith("torque")]
    assert len({n.lower() for n in figures}) == 3
    assert "torque_run_verification.png" in figures


def test_a_file_in_the_way_is_refused(tmp_path, fit, validation, quick):
    (tmp_path / "report").write_text("a file")
    for folder in (tmp_path / "report", tmp_path / "report" / "inner"):
        with pytest.raises(ValueError, match="must be a folder, but is a file"):
            report(folder, fit, validation)
    assert names(tmp_path) == ["report"]


@pytest.mark.parametrize(
    ("name", "safe"),
    [
        ("log_1", "log_1"),
        ("../../etc/passwd", "etc-passwd"),
        ("Prüfstand 3: kalt", "Prufstand-3-kalt"),
        ("日本", "recording"),
        ("..", "recording"),
        ("a" * 300, "a" * 80),
    ],
)
def test_names_become_safe(name, safe):
    assert safe_name(name) == safe
