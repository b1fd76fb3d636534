"""Comparisons on paper and on disk: what is read is what was written, and nothing is cut off."""

import csv
import dataclasses
import json

import numpy as np
import pytest
from rich.console import Console
from test_figures import require_everything_inside

from jaxid.identification.runs.comparison import Comparison, Verdict, compare
from jaxid.report.compared import chance, comparison_figure, comparison_table, group_table
from jaxid.report.compared_files import read_estimates, write_comparison
from jaxid.report.write import write_report


@pytest.fixture
def warm(fit):
    """The same robot with a third of the rail's friction."""
    p = np.array(fit.parameters)
    p[fit.base.names.index("fv1")] /= 3.0
    return dataclasses.replace(fit, parameters=p, recordings=("warm",))


def text(table, width=100):
    console = Console(width=width)
    with console.capture() as capture:
        console.print(table)
    return capture.get()


def test_the_table_names_what_has_changed(fit, warm):
    found = compare(fit, warm)
    shown = text(comparison_table(found))
    (line,) = [x for x in shown.splitlines() if " fv1 " in x]
    assert "N s/m" in line
    assert line.rstrip().endswith("changed")
    assert shown.count(" no change seen") == fit.base.size - 1
    kinds = text(group_table(found))
    assert [x.rstrip().endswith(" changed") for x in kinds.splitlines()[-3:]] == [0, 1, 0]


def test_the_figure_shows_both_intervals(fit, warm):
    found = compare(fit, warm)
    figure = comparison_figure(found)
    require_everything_inside(figure)
    (axes,) = figure.axes
    bold = [t.get_text() for t in axes.get_yticklabels() if t.get_fontweight() == "bold"]
    assert bold == ["fv1"]
    k = fit.base.names.index("fv1")
    points = [c.get_offsets()[k, 0] for c in axes.collections if len(c.get_offsets()) > 1]
    np.testing.assert_allclose(points[1] / points[0], 1 / 3, rtol=1e-12)
    assert max(points) < 1.0


def test_what_a_report_holds_is_read_back(tmp_path, fit, validation):
    covariance = np.array(fit.covariance)
    covariance[0, 0] = np.inf
    unknown = dataclasses.replace(fit.uncertainty, covariance=covariance)
    fit = dataclasses.replace(fit, uncertainty=unknown)
    write_report(tmp_path / "cold", fit, validation.errors[:1], (), validation.definiteness, {})
    found = read_estimates(tmp_path / "cold")
    assert found.label == "cold"
    np.testing.assert_array_equal(found.parameters, fit.parameters)
    np.testing.assert_array_equal(found.covariance, covariance)
    assert found.names == fit.base.names
    assert found.expressions == fit.base.expressions
    assert set(found.groups) == {"rigid bodies", "viscous friction", "coulomb friction"}
    same = Comparison.of(found, dataclasses.replace(found, label="again"))
    assert set(same.verdicts) == {Verdict.UNKNOWN, Verdict.UNCHANGED}


def test_files_hold_the_numbers_exactly(tmp_path, fit, warm):
    found = compare(fit, warm)
    files = write_comparison(tmp_path / "out", found)
    assert [p.name for p in files] == ["comparison.json", "comparison.csv", "comparison.png"]
    content = json.loads(files[0].read_text(encoding="utf-8"))
    assert content["schema"] == "jaxid-comparison/1"
    assert [r["difference"] for r in content["parameters"]] == found.difference.tolist()
    assert content["groups"][1]["changed"] is True
    with files[1].open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(r["half_width"]) for r in rows] == found.half_widths.tolist()
    assert files[2].read_bytes().startswith(b"\x89PNG")


def test_files_that_are_no_results_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"holds no `result.json`"):
        read_estimates(tmp_path)
    path = tmp_path / "result.json"
    path.write_text("{")
    with pytest.raises(ValueError, match=r"result.json` is no JSON file"):
        read_estimates(tmp_path)
    path.write_text('{"schema": "other/1"}')
    with pytest.raises(ValueError, match="must be the result of an identification"):
        read_estimates(tmp_path)
    row = {"name": "m1", "expression": "m1", "estimate": 1.0, "unit": "kg"}
    content = {"schema": "jaxid-result/1", "base_parameters": [row, {"name": "m2"}]}
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"`base_parameters\[1\]` has no `expression`"):
        read_estimates(tmp_path)
    content["base_parameters"] = [row]
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="has no `covariance`"):
        read_estimates(tmp_path)
    content["fit"] = {"covariance": [[1.0, 0.0]]}
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match="must be 1 x 1"):
        read_estimates(tmp_path)


def test_chances_are_short():
    assert chance(1e-30) == "< 1e-6"
    assert chance(0.0312) == "0.031"
