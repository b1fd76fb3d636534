"""A model file returns the same fit, bit for bit; others are refused in a sentence."""

import copy
import dataclasses
import json
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from virtual import observations, planar_base, standard_parameters

import jaxid as jid
from jaxid.identification.fit_result import checksum_of
from jaxid.io import from_json, to_json


@pytest.fixture(scope="module")
def fit():
    robot = jid.robots.planar_arm(2, 0.4).replace(
        limits=jid.Limits(2, force=[40.0, 5.0])
    )
    terms = (
        jid.RigidBodies(),
        jid.ViscousFriction(),
        jid.terms.StribeckFriction(speed=[0.1, 0.2], transition=jid.terms.Tanh(1e-3)),
        jid.terms.TemperatureScaled(jid.ConstantOffset(), rate=0.02),
    )
    model = jid.Model(robot.with_tool(mass=0.7, centre_of_mass=(0.0, 0.1, 0.0)), terms)
    log = observations(model, standard_parameters(model), noise=np.array([0.5, 0.1]))
    return jid.identify(jid.base_parameters(model), log)


@pytest.fixture
def path(fit, tmp_path):
    return fit.save(tmp_path / "folder" / "arm.json")


def same(a, b):
    """The same structure, classes, static fields; numbers to the last bit, also NaN."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    for x, y in (map(np.asarray, pair) for pair in pairs):
        assert (x.dtype, x.shape, x.tobytes()) == (y.dtype, y.shape, y.tobytes())


def test_everything_comes_back_bit_for_bit(fit, path):
    loaded = jid.load_fit(path)
    same(loaded, fit)
    assert loaded.checksum == fit.checksum
    assert loaded.date == fit.date != ""
    before = path.read_bytes()
    copy.deepcopy(fit).save(path)
    assert path.read_bytes() == before


def test_a_consistent_fit_keeps_bodies_and_verdict(tmp_path):
    base = planar_base()
    log = observations(base.model, standard_parameters(base.model), noise=0.1)
    fit = jid.identify(base, log, jid.PhysicallyConsistent())
    loaded = jid.load_fit(fit.save(tmp_path / "arm.json"))
    same(loaded, fit)
    assert loaded.consistency.certified == fit.consistency.certified


@pytest.mark.parametrize(
    "number", [0.1, -0.0, 5e-324, 1.7976931348623157e308, np.inf, np.nan]
)
def test_every_number_survives(number):
    for value, kind in (
        (np.array([[number, 1.0]]), np.ndarray),
        (float(number), float),
    ):
        again = from_json(json.loads(json.dumps(to_json(value), allow_nan=False)), kind)
        assert np.array(again).tobytes() == np.array(value).tobytes()


class TermOfOnesOwn(jid.terms.AbstractTerm):
    power: float = 3.0

    def parameters(self, robot):
        return tuple((f"fq{i + 1}", "N m s³") for i in range(robot.joints))

    def columns(self, robot, q, qd, qdd):
        return jnp.diag(qd**3)


class EstimatorOfOnesOwn(jid.estimators.LeastSquares):
    rule: Callable = np.median


def test_only_known_classes_of_the_family_are_looked_up():
    values = to_json(TermOfOnesOwn(2.0))
    assert from_json(values, jid.terms.AbstractTerm) == TermOfOnesOwn(2.0)
    for kind in ("Cubic", "WeightedLeastSquares"):
        with pytest.raises(ValueError, match=f"is a `{kind}`, which is not known"):
            from_json({**values, "kind": kind}, jid.terms.AbstractTerm)


def test_an_estimator_with_functions_is_kept_in_words(fit, tmp_path):
    log = observations(fit.base.model, standard_parameters(fit.base.model))
    fit = dataclasses.replace(fit, estimator=EstimatorOfOnesOwn())
    loaded = jid.load_fit(fit.save(tmp_path / "arm.json"))
    assert str(loaded.estimator) == str(fit.estimator)
    assert loaded.checksum == fit.checksum
    with pytest.raises(ValueError, match="`estimator`"):
        jid.identify(loaded.base, log, loaded.estimator)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(version=2), "version 2, but this jaxid reads version 1"),
        (lambda d: d.update(format="arm"), "is not a model file"),
        (lambda d: d.pop("model"), "damaged"),
        (lambda d: d.update(checksum="sha256:0"), "changed by hand"),
        (lambda d: d["model"]["parameters"]["float64"].append(1.0), "shape"),
        (
            lambda d: d["model"].update(parameters={"float64": ["inf"] * 14}),
            "`parameters`",
        ),
        (lambda d: d["model"].update(extra=1), "other keys: .*'extra'"),
        (lambda d: d["model"].pop("base"), "other keys: .*'base'"),
        (lambda d: d["model"].update(kind="BaseParameters"), "not known"),
        (lambda d: d["model"].update(weights=None), "`weights` holds None"),
        (
            lambda d: d["model"].update(weights={"float64": ["one", 1.0]}),
            "`weights` is not an array",
        ),
        (lambda d: d["model"].update(weights={"object": []}), "has the keys object"),
        (lambda d: d["model"].update(rows=[1.5, 2]), r"`rows\[0\]` holds 1.5"),
        (
            lambda d: d["model"]["base"]["model"]["robot"].update(parent=[3, 0]),
            "`parent`",
        ),
    ],
)
def test_a_wrong_model_file_is_refused_in_one_sentence(path, change, message):
    document = json.loads(path.read_text("utf-8"))
    document["checksum"] = None
    change(document)
    if document["checksum"] is None and "model" in document:
        document["checksum"] = checksum_of(document["model"])
    path.write_text(json.dumps(document), encoding="utf-8")
    with pytest.raises(ValueError, match=message) as error:
        jid.load_fit(path)
    assert str(path) in str(error.value)


@pytest.mark.parametrize("text", ["", "[1]", "[" * 100_000, "\0"])
def test_other_documents_are_refused(tmp_path, text):
    path = tmp_path / "arm.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="is not a model file"):
        jid.load_fit(path)
