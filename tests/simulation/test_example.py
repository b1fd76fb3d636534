"""The example: the same for a seed, with possible bodies, and a truth to be found."""

import json

import numpy as np
import pytest

from jaxid.errors import InputError
from jaxid.experiment.experiment import load_experiment
from jaxid.identification.consistency.pseudo_inertia import pseudo_inertia
from jaxid.identification.identify import identify
from jaxid.robot import library
from jaxid.simulation.example import FILES, virtual_panda, write_example
from jaxid.simulation.virtual import random_bodies
from jaxid.validation.torque_errors import validate
from jaxid.workflow.log_loading import read_log


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    folder = tmp_path_factory.mktemp("example")
    write_example(folder)
    return folder


@pytest.mark.parametrize(
    "robot", [library.panda(), library.tx90l_on_rail()], ids=lambda r: r.name
)
def test_random_bodies_could_exist(robot):
    masses = np.linspace(1.0, 5.0, robot.joints)
    bodies = random_bodies(robot, masses, np.random.default_rng(0))
    np.testing.assert_allclose(bodies[:, 0], masses)
    assert (np.linalg.eigvalsh(pseudo_inertia(bodies))[:, 0] > 0).all()


def test_files_are_small_and_the_seed_decides(example, tmp_path):
    assert sorted(p.name for p in example.iterdir()) == sorted(FILES)
    assert sum(p.stat().st_size for p in example.iterdir()) < 3e6
    write_example(tmp_path)
    for file in FILES:
        assert (tmp_path / file).read_bytes() == (example / file).read_bytes()


def test_the_truth_is_found_again(example):
    virtual, experiment = virtual_panda(), load_experiment(example / "experiment.toml")
    setup = experiment.setup
    base = setup.base
    assert base.model.parameter_names == virtual.model.parameter_names
    observations = [
        setup.observe(read_log(setup, example / f"{name}.csv", experiment.columns))
        for name in ("identification", "verification")
    ]
    fit = identify(base, observations[0], setup.estimator)
    truth = json.loads((example / "truth.json").read_text("utf-8"))
    rows = truth["base_parameters"]
    assert [r["name"] for r in rows] == list(base.names)
    values = np.array([r["value"] for r in rows])
    np.testing.assert_allclose(
        values, base.from_standard(virtual.parameters), rtol=1e-12
    )
    # Noise with memory and friction beyond the model make deviations larger than they
    # are said.
    z = (np.asarray(fit.parameters) - values) / fit.standard_deviations
    assert np.abs(z).max() < 8
    assert np.sqrt(np.mean(z**2)) < 2.5
    assert not fit.undetermined
    found = validate(fit, observations)
    assert found.definiteness.positive_definite
    assert max(np.max(e.mean_percent) for e in found.errors) < 0.5


def test_existing_files_are_not_lost(tmp_path):
    (tmp_path / "experiment.toml").write_text("mine")
    with pytest.raises(InputError, match=r"experiment\.toml"):
        write_example(tmp_path)
    assert [p.read_text() for p in tmp_path.iterdir()] == ["mine"]
