"""The simplest model that predicts unseen data as well as any, with honest promises."""

import numpy as np
import pytest
import virtual

import jaxid as jid

PLAIN = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
MODELS = {
    "plain": PLAIN,
    "root": (*PLAIN, jid.terms.SquareRootFriction()),
    "springs": (*PLAIN, jid.terms.LinearSpring()),
}
ROBOT = jid.robots.planar_arm(2, 0.5).replace(limits=jid.Limits(force=[50.0, 8.0]))


@pytest.fixture(scope="module")
def candidates():
    bases = {
        name: jid.base_parameters(jid.Model(ROBOT, terms))
        for name, terms in MODELS.items()
    }
    return [jid.ModelCandidate(name, base) for name, base in bases.items()]


def logs(truth, count=1, samples=1500, noise=0.3, seed=0):
    model = jid.Model(ROBOT, MODELS[truth])
    p = virtual.standard_parameters(model)
    options = {"samples": samples, "noise": noise}
    return [
        virtual.observations(model, p, seed=seed + k, noise_seed=seed + k, **options)
        for k in range(count)
    ]


@pytest.mark.parametrize("truth", MODELS)
def test_the_true_model_is_found(candidates, truth):
    choice = jid.choose_model(candidates, logs(truth))
    assert choice.chosen.name == truth
    assert f"`{truth}` is the simplest" in str(choice)
    assert choice.parts == "5 parts of time"


def test_whole_logs_are_left_out_where_there_are_enough(candidates):
    choice = jid.choose_model(candidates, logs("root", 4, samples=500))
    assert choice.chosen.name == "root"
    assert choice.parts == "4 logs"
    assert np.shape(choice.errors) == (3, 4)


def test_errors_are_those_of_fits_without_the_part(candidates):
    several = logs("plain", 4, samples=300)
    choice = jid.choose_model(candidates, several)
    weights = 1.0 / np.asarray(ROBOT.max_forces)
    forces = [np.sum((np.asarray(o.reduced_forces) * weights) ** 2) for o in several]
    for row, candidate in zip(choice.errors, candidates, strict=True):
        for k, left in enumerate(several):
            fit = jid.identify(candidate.base, [o for o in several if o is not left])
            errors = jid.validate(fit, left).errors[0].errors * weights
            np.testing.assert_allclose(
                row[k] ** 2, np.sum(errors**2) / np.mean(forces), rtol=1e-8
            )


def test_the_promise_is_what_comes(candidates):
    ratios = []
    for seed in range(100, 112):
        train, later = (
            logs("plain", 1, 400, 1.0, seed),
            logs("plain", 2, 400, 1.0, seed + 500),
        )
        choice = jid.choose_model(candidates, train)
        fit = jid.identify(choice.chosen.base, train)
        weights = 1.0 / np.asarray(ROBOT.max_forces)
        found = [e.errors * weights for e in jid.validate(fit, later).errors]
        forces = [np.asarray(o.reduced_forces) * weights for o in train]
        # Relative to the same forces: motions differ.
        noise = np.sqrt(np.mean(np.square(found)) / np.mean(np.square(forces)))
        ratios.append(noise / choice.promise)
    assert 0.9 < np.median(ratios) < 1.15


@pytest.mark.parametrize("memory", [0, 1])
def test_of_equally_good_models_that_with_memory_is_chosen(memory):
    laws = [jid.terms.Tanh(), jid.terms.Presliding(0.01)][:: 1 - 2 * memory]
    terms = [
        (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction(x)) for x in laws
    ]
    models = [jid.Model(ROBOT, x) for x in terms]
    names, p = models[0].parameter_names, virtual.standard_parameters(models[0])
    p[[names.index(x) for x in ("fc1", "fc2")]] = 0.0
    log = virtual.observations(models[0], p, samples=1500, noise=0.3)
    choice = jid.choose_model(
        [jid.ModelCandidate("", jid.base_parameters(x)) for x in models], log
    )
    assert choice.chosen.base.model.memory is not None


def test_nothing_to_choose_from_is_refused(candidates):
    with pytest.raises(ValueError, match="at least one model"):
        jid.choose_model([], logs("plain"))
