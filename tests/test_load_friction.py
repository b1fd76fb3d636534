"""Friction by load in an experiment file: its bodies are those that are identified."""

import numpy as np
import pytest
from arm_files import HALF_PI, urdf_of_arm

import jaxid as jid
from jaxid.experiment.experiment import load_experiment
from jaxid.identification.problem import RegressionProblem
from jaxid.program.sample_methods import in_numpy

ARM_FILE = urdf_of_arm(
    (0.0, 0.0, 0.3, 0.0), (0.1, 0.0, 0.0, -HALF_PI), (0.4, 0.0, 0.1, 0.0)
)
ARM = """\
[robot]
urdf = "arm.urdf"
[limits]
force = [60, 80, 20]
[model]
load = true
"""


@pytest.fixture
def experiment(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM_FILE)
    (tmp_path / "e.toml").write_text(ARM)
    return load_experiment(tmp_path / "e.toml")


@pytest.mark.parametrize("seed", range(4))
def test_coefficients_are_found(experiment, seed):
    robot, rng = experiment.setup.robot, np.random.default_rng(seed)
    mass, r, inertia = [6.0, 4.0, 2.0], rng.uniform(-0.1, 0.2, (3, 3)), 0.02
    bodies = []
    for m, c in zip(mass, r, strict=True):
        J = inertia * np.eye(3) + m * (c @ c * np.eye(3) - np.outer(c, c))
        bodies.append([m, *(m * c), *np.diag(J), -J[1, 2], -J[0, 2], -J[0, 1]])
    truth = jid.Model(
        robot, (*experiment.setup.model.terms, jid.terms.LoadFriction(np.array(bodies)))
    ).with_transition_speeds(0.04)
    rest = rng.uniform(0.3, 1.0, truth.size - 33)
    coefficients = np.array([0.1, 0.15, 0.25])
    p = np.concatenate([np.ravel(bodies), rest, coefficients])
    t = np.arange(0.0, 20.0, 0.01)
    motion = jid.trajectories.random_fourier_series(robot, omega=0.6, seed=seed).motion(
        t
    )
    forces = in_numpy(truth, truth.forces, motion.q, motion.qd, motion.qdd, shared=(p,))
    forces = forces + rng.normal(0.0, [0.1, 0.2, 0.1], forces.shape)
    o = jid.Observations.of(motion.q, motion.qd, motion.qdd, forces, sample_time=0.01)
    fit = experiment.setup.fit(RegressionProblem(experiment.setup.base, [o]))
    # Gravity puts no load on the first joint, which turns about it.
    assert [name for name in fit.base.names if name.startswith("fl")] == ["fl2", "fl3"]
    for name, value in zip(("fl2", "fl3"), coefficients[1:], strict=True):
        k = fit.base.names.index(name)
        assert abs(fit.parameters[k] / value - 1) < 0.05
        assert abs(fit.parameters[k] - value) < 4 * fit.standard_deviations[k]
    assert not any("has not converged" in note for note in fit.notes)
    # Both kinds of dry friction change their direction at the speed that is planted.
    *_, load_friction = fit.base.model.terms
    np.testing.assert_allclose(load_friction.transition.speed[1:], 0.04, rtol=0.15)


def test_what_it_needs_is_said(tmp_path):
    (tmp_path / "arm.urdf").write_text(ARM_FILE)
    (tmp_path / "e.toml").write_text(ARM + "principal_axes = true\n")
    with pytest.raises(ValueError, match="`load` needs complete bodies"):
        load_experiment(tmp_path / "e.toml")
