"""The compiled pass over long logs agrees with NumPy's QR, whatever the chunks."""

import equinox as eqx
import numpy as np
import pytest
from virtual import dense, motion, observations, standard_parameters

import jaxid as jid
from jaxid.identification import long_logs
from jaxid.identification.factors import Blocks
from jaxid.identification.identify import fit_problem

SMOOTH = jid.ZeroPhaseButterworth(100.0, margin=0.01)


@pytest.fixture(scope="module")
def base():
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(jid.robots.planar_arm(2, 0.4), terms))


def observed(base, samples=6000, noise=0.3, **options) -> jid.Observations:
    p = standard_parameters(base.model)
    return observations(base.model, p, samples=samples, noise=noise, **options)


def changed(o: jid.Observations, **fields) -> jid.Observations:
    """Other observations of the same samples; four fifths of their rows count."""
    o = o.replace(**fields)
    mask = np.random.default_rng(1).random((len(o.instants), o.joints)) < 0.8
    return eqx.tree_at(lambda x: x.mask, o, mask)


def fast(base, o, blocks=4) -> Blocks:
    counted = np.flatnonzero(np.asarray(o.mask).any(axis=1))
    edges = [int(part[0]) for part in np.array_split(counted, blocks)]
    return Blocks(tuple(long_logs.stream_blocks(base, o, [0, *edges[1:], o.rows])))


def distance(a, b) -> float:
    """Largest difference of the information, with columns of length one."""
    A, B = (np.column_stack(x.weighted(np.array([0.3, 2.0]))) for x in (a, b))
    norms = np.linalg.norm(B, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return float(np.abs((A.T @ A - B.T @ B) / norms / norms[:, None]).max())


def agree(base, o, blocks=4) -> None:
    got = fast(base, o, blocks)
    expected = jid.RegressionProblem(base, [o], divisions=blocks).blocks
    np.testing.assert_array_equal(got.total.rows, expected.total.rows)
    for a, b in zip(
        (got.total, *got.parts), (expected.total, *expected.parts), strict=True
    ):
        assert distance(a, b) < 1e-12
    problems = (jid.RegressionProblem(base, blocks=x) for x in (got, expected))
    p, q = (fit_problem(x, jid.estimators.LeastSquares()).parameters for x in problems)
    norms = np.linalg.norm(expected.total.weighted(np.ones(2))[0], axis=0)
    assert np.linalg.norm(norms * (p - q)) <= 1e-12 * np.linalg.norm(norms * q)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"mask": np.random.default_rng(3).random((6000, 2)) < 0.7},
        {"every": 7},
        {"still": (0,)},
        {"still": (1,)},
    ],
)
def test_unfiltered(base, options):
    agree(base, observed(base, **options))


def test_a_joint_that_moves_late(base):
    o = observed(base)
    late = (np.arange(6000) > 5000)[:, None]
    m = motion(2, 6000)
    q = np.where(late, m.q, m.q[5001])
    agree(base, changed(o, motion=jid.Motion(q, late * m.qd, late * m.qdd)), blocks=1)


def test_a_known_tool(base):
    robot = base.model.robot
    tool = jid.Tool(1, mass=2.5, centre_of_mass=(0.1, 0.0, 0.05))
    loaded = jid.base_parameters(jid.Model(robot.replace(tool=tool), base.model.terms))
    o = observed(loaded)
    agree(loaded, o)
    assert distance(fast(loaded, o).total, fast(base, o).total) > 1e-3


def test_filtered(base):
    segments = ((0, 900), (900, 25000), (25000, 26500), (26500, 60000))
    o = observed(base, samples=60000, filter=SMOOTH, every=7)
    agree(base, changed(o, segments=segments))


def test_nothing_depends_on_the_length_of_chunks(base, monkeypatch):
    o = observed(base, samples=30000, filter=SMOOTH, every=7)
    a = fast(base, o).total
    monkeypatch.setattr(long_logs, "CHUNK", 500)
    assert distance(a, fast(base, o).total) < 1e-13


def test_a_prismatic_arm_against_a_dense_matrix():
    robot = jid.robots.planar_arm(3, 0.4)
    base = jid.base_parameters(jid.Model(robot.replace(revolute=(False, True, True))))
    o, weights = observed(base, samples=5000, noise=1.0), np.linspace(0.5, 2.0, 3)
    theta, forces, joint = dense(base, o)
    W = weights[joint]
    R, z = fast(base, o).total.weighted(weights)
    norms = np.linalg.norm(R, axis=0)
    expected = np.linalg.lstsq(W[:, None] * theta / norms, W * forces)[0]
    got = np.linalg.lstsq(R / norms, z)[0]
    assert np.linalg.norm(got - expected) < 1e-12 * np.linalg.norm(expected)


def test_long_logs_take_the_compiled_pass_by_themselves(base, monkeypatch):
    o = observed(base, mask=np.random.default_rng(3).random((6000, 2)) < 0.7)
    slow = jid.RegressionProblem(base, [o, o], divisions=5).blocks
    monkeypatch.setattr(jid.RegressionProblem, "compiled_samples", 5000)
    quick = jid.RegressionProblem(base, [o, o], divisions=5).blocks
    distances = [distance(a, b) for a, b in zip(slow.parts, quick.parts, strict=True)]
    assert 0.0 < max(distances) < 1e-12


def test_filters_with_a_long_memory_stay_in_numpy(base):
    assert not long_logs.suits(observed(base, samples=100_000, filter=SMOOTH))
    assert long_logs.suits(observed(base, samples=100_000, filter=SMOOTH, every=20))
