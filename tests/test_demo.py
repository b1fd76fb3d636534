"""The demo in a short form: the paper's findings must come out, and be written whole."""

import io
import json
import shutil

import numpy as np
import pytest
from rich.console import Console
from test_cli import refused, run  # noqa: F401

from jaxid.experiment.demo.feed_forward import Timing, timing
from jaxid.experiment.demo.show import show_study
from jaxid.experiment.demo.study import STAGES, Effort, study
from jaxid.experiment.demo.tables import (
    average_errors,
    beside_paper,
    errors,
    moving_errors,
    temperature,
)
from jaxid.experiment.demo.write import write_study
from jaxid.experiment.progress import Stages
from jaxid.identification.runs.comparison import Verdict
from jaxid.robot import library
from jaxid.trajectory.fourier import random_fourier_series


class Told(Stages):
    """What a progress bar would show."""

    def __init__(self):
        self.names = []

    def __call__(self, name):
        self.names.append(name)

    def part(self):
        return lambda share: None


@pytest.fixture(scope="module")
def told():
    return Told()


@pytest.fixture(scope="module")
def found(told):
    robot = library.tx90l_on_rail()
    motion = random_fourier_series(robot, omega=0.8, reach=0.7, seed=1)
    return study(0, told, Effort(draws=1, periods=1), motion)


def test_base_parameters_are_those_of_the_paper(found):
    assert (found.base.model.size, found.base.size) == (70, 44)
    assert found.base.expressions[0] == "m1 + m2 + m3 - mz4/l3z + Ia1"
    assert found.base.expressions[1] == "mx2 + l2x*m3 - l2x*mz4/l3z"
    assert found.base.names[26] == "fv1"
    assert found.base.names[33] == "fc1"


def test_weights_help_the_wrist_and_consistent_bodies_have_a_definite_mass_matrix(found):
    for recording in (0, 1):
        plain, weighted = (errors(x, recording) for x in (found.unweighted, found.weighted))
        assert weighted[6] < 0.5 * plain[6]
        assert max(weighted) < 0.5 * max(plain)
        assert max(errors(found.consistent, recording)) < 1.2 * max(weighted)
    assert found.consistent.validation.definiteness.positive_definite


def test_friction_falls_with_temperature_and_masses_stay(found):
    cold, warm = np.asarray(found.weighted.fit.parameters), np.asarray(found.warm.parameters)
    for k in (26, 27, 33, 34):
        assert warm[k] < 0.95 * cold[k]
        assert found.temperature.verdicts[k] is Verdict.CHANGED
    assert warm[0] == pytest.approx(cold[0], rel=0.03)
    np.testing.assert_allclose(cold[[26, 27, 33, 34]], found.truth[[26, 27, 33, 34]], rtol=0.15)


def test_the_better_the_model_the_closer_the_path(found):
    none, cad, identified = found.followed
    assert identified.rms < 0.5 * cad.rms
    assert cad.rms < none.rms
    assert all(one.run.saturated.max() == 0.0 for one in found.followed)
    # The end-effector went round the whole path.
    assert np.ptp(np.asarray(none.run.desired.q), axis=0).min() > 0.0


def test_resting_axes_are_what_the_verification_path_adds(found):
    for judged in (found.weighted, found.true):
        moving, all_rows = (f(found, judged, 1) for f in (moving_errors, by_row))
        assert all(a < b for a, b in zip(moving, all_rows, strict=True))
        np.testing.assert_allclose(all_rows, errors(judged, 1))


def by_row(found, judged, recording):
    """The plain formula."""
    seen = judged.validation.errors[recording]
    return 100 * np.abs(seen.errors).mean(axis=0) / np.asarray(seen.max_forces)


def test_feed_forward_is_timed_in_c_or_said_not_to_be(found, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    said = timing(found.consistent.fit, found.verification)
    assert "not timed" in said
    assert "no-such-compiler" in said
    if shutil.which("cc") is not None:
        assert isinstance(found.timing, Timing)
        assert min(found.timing[1:]) > 0.0
        assert found.timing.ratio == found.timing.literal / found.timing.full


def test_tables_files_and_terminal_say_the_same(found, told, tmp_path):
    rows = {row[0]: row[1:] for row in beside_paper(found).rows}
    assert rows["base parameters"] == ("44", "44")
    assert average_errors(found, 1).rows[-1][0] == "worst"
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "mine.txt").write_text("stays")
    files = write_study(tmp_path / "demo", found)
    assert all(file.is_file() for file in files)
    record = json.loads((tmp_path / "demo" / "demo.json").read_text())
    assert record["base_parameters"]["count"] == 44
    assert (record["feed_forward"] == found.timing) == isinstance(found.timing, str)
    assert record["estimates"]["weighted"]["mean_percent_moving"][1] == moving_errors(
        found, found.weighted, 1
    )
    first = temperature(found).rows[0][0]
    assert first == "p_B(1) = m1 + m2 + m3 - mz4/l3z + Ia1 [kg]"
    assert record["following"][2]["tip_rms"] == found.followed[2].rms
    assert record["estimates"]["weighted"]["mean_percent_verification"] == errors(found.weighted, 1)
    assert (tmp_path / "demo" / "mine.txt").read_text() == "stays"
    console = Console(file=io.StringIO(), width=120)
    show_study(console, found)
    said = console.file.getvalue()
    assert "mx2 + l2x*m3 - l2x*mz4/l3z" in said
    assert "following the path of ISO 9283" in said
    # A given motion needs no design: two stages less.
    assert len(told.names) == STAGES - 2


def test_refuses_a_file_in_place_of_its_folder(run, tmp_path):  # noqa: F811
    (tmp_path / "taken").write_text("a file")
    assert refused(run("demo", "-o", tmp_path / "taken"), "is a file", "needs a folder")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "thesis.tex").write_text("years of work")
    assert refused(run("demo", "-o", tmp_path / "foreign"), "holds files but no report", "--force")
    assert [p.name for p in (tmp_path / "foreign").iterdir()] == ["thesis.tex"]
