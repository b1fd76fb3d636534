"""Laws of friction, trajectories and filters, and files that come back, by Hypothesis."""

import json
import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxid as jid
from jaxid.errors import InputError
from jaxid.experiment.experiment import load_experiment

ARM = jid.robots.planar_arm(2, 0.4)
ODD = (
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.CoulombFriction(jid.terms.HardSign(dead_zone=0.01)),
    jid.terms.StribeckFriction(),
    jid.terms.StribeckFriction(0.3, exponent=1.3),
    jid.terms.TemperatureScaled(jid.ViscousFriction(), rate=0.02, temperature=40.0),
)
# With a tanh the second of these is an offset as well, which pushes near standstill.
ASYMMETRIC = (
    jid.terms.AsymmetricViscousFriction(),
    jid.terms.AsymmetricCoulombFriction(jid.terms.HardSign(dead_zone=0.01)),
)
few = settings(max_examples=10)
seeds = st.integers(0, 1000)
speeds = st.lists(st.floats(-20.0, 20.0), min_size=2, max_size=2).map(np.array)


def friction(term, seed, qd):
    """Forces of a law with random coefficients that none of its kind has below zero."""
    p = np.random.default_rng(seed).uniform(0.0, 3.0, len(term.parameters(ARM)))
    zero = jnp.zeros(2)
    return np.asarray(term.columns(ARM, zero, jnp.asarray(qd), zero)) @ p


@pytest.mark.parametrize("term", ODD, ids=lambda t: type(t).__name__)
@few
@given(seed=seeds, qd=speeds)
def test_symmetric_friction_is_odd(term, seed, qd):
    there, back = friction(term, seed, qd), friction(term, seed, -qd)
    np.testing.assert_allclose(back, -there, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("term", [*ODD, *ASYMMETRIC], ids=lambda t: type(t).__name__)
@few
@given(seed=seeds, qd=speeds)
def test_friction_takes_energy_on_every_joint(term, seed, qd):
    assert (friction(term, seed, qd) * qd >= 0.0).all()
    assert (friction(term, seed, 0.0 * qd) == 0.0).all()


@few
@given(
    seed=seeds, harmonics=st.integers(2, 5), omega=st.floats(0.2, 3.0), periods=st.integers(1, 3)
)
def test_derivatives_belong_to_their_motion_and_files_keep_it(seed, harmonics, omega, periods):
    series = jid.random_fourier_series(ARM, omega=omega, harmonics=harmonics, seed=seed)
    for trajectory in (
        series,
        jid.trajectories.RestToRestBasis(harmonics, omega, periods).nearest(series),
    ):
        t = np.linspace(0.05, 0.95, 11) * float(trajectory.duration)
        h = 1e-4 / omega
        ahead, now, behind = (trajectory.motion(x) for x in (t + h, t, t - h))
        for x, derivative in (("q", now.qd), ("qd", now.qdd), ("qdd", trajectory.jerk(t))):
            slope = (getattr(ahead, x) - getattr(behind, x)) / (2 * h)
            size = np.abs(derivative).max()
            np.testing.assert_allclose(slope, derivative, rtol=0, atol=1e-6 * size)
        with tempfile.TemporaryDirectory() as folder:
            jid.trajectories.save_trajectory(trajectory, Path(folder) / "t.json")
            again = jid.trajectories.load_trajectory(Path(folder) / "t.json").motion(t)
        for a, b in zip((now.q, now.qd, now.qdd), (again.q, again.qd, again.qdd), strict=True):
            np.testing.assert_array_equal(a, b)


@few
@given(
    seed=seeds,
    cutoff=st.floats(5.0, 60.0),
    order=st.integers(1, 4),
    shift=st.floats(-10.0, 10.0),
)
def test_a_zero_phase_filter_knows_no_direction_of_time(seed, cutoff, order, shift):
    filter = jid.ZeroPhaseButterworth(cutoff, order=order)
    x = np.random.default_rng(seed).standard_normal((900, 2))
    there, back = filter.smooth(x, 1e-3), filter.smooth(x[::-1], 1e-3)[::-1]
    edge = filter.memory(1e-3) + filter.edge(1e-3)
    inner = slice(min(edge, 430), -min(edge, 430))
    np.testing.assert_allclose(back[inner], there[inner], atol=1e-3)
    moved = filter.smooth(x + shift, 1e-3)
    np.testing.assert_allclose(moved, there + shift, atol=1e-9 * (1 + abs(shift)))


KEYS = {
    "robot": ("builtin", "gravity"),
    "limits": ("position_min", "position_max", "velocity", "acceleration", "force"),
    "recording": ("angles", "forces", "time", "angle_unit", "force_unit"),
    "filter": ("kind", "cutoff"),
    "rows": ("min_speed",),
    "excitation": ("harmonics", "omega", "samples", "starts"),
}
VALUES = {
    "robot": 'builtin = "planar_arm"\n',
    "limits": "velocity = [1, 1]\n",
    "recording": 'angles = "q{}"\nforces = "f{}"\ntime = "t"\n',
    "filter": 'kind = "butterworth"\ncutoff = 10\n',
    "rows": "step = 2\n",
    "excitation": "harmonics = 3\n",
}


@settings(max_examples=15)
@given(data=st.data())
def test_a_misspelt_key_is_refused_with_its_name(data):
    table = data.draw(st.sampled_from(sorted(KEYS)))
    key = data.draw(st.sampled_from([k for k in KEYS[table] if len(k) > 4]))
    place = data.draw(st.integers(1, len(key) - 1))
    wrong = key[:place] + data.draw(st.sampled_from(["", key[place] * 2, "x"])) + key[place + 1 :]
    text = "".join(
        f"[{name}]\n{value}" + (f"{wrong} = 1\n" if name == table else "")
        for name, value in VALUES.items()
    )
    if wrong == key:
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e.toml"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=wrong) as refused:
            load_experiment(path)
    assert key in str(refused.value)
    assert "e.toml" in str(refused.value)


@settings(max_examples=5)
@given(
    low=st.lists(st.floats(-170.0, -1.0), min_size=2, max_size=2),
    high=st.lists(st.floats(1.0, 170.0), min_size=2, max_size=2),
    velocity=st.floats(0.1, 1e4),
)
def test_limits_in_degrees_are_read_as_they_are_written(low, high, velocity):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "e.toml"
        path.write_text(
            f'[robot]\nbuiltin = "planar_arm"\n[limits]\nangle_unit = "deg"\nposition_min = {low}\n'
            f"position_max = {high}\nvelocity = {[velocity] * 2}\n"
        )
        limits = load_experiment(path).robot.limits
    np.testing.assert_allclose(limits.position_min, np.deg2rad(low), rtol=1e-15)
    np.testing.assert_allclose(limits.position_max, np.deg2rad(high), rtol=1e-15)
    np.testing.assert_allclose(limits.velocity, np.deg2rad(velocity), rtol=1e-15)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    base = jid.base_parameters(jid.Model(ARM, (jid.RigidBodies(), jid.ViscousFriction())))
    series = jid.random_fourier_series(ARM, omega=0.8, harmonics=2, seed=0)
    motion = series.motion(0.01 * np.arange(300))
    forces = base.model.inverse_dynamics(np.ones(base.model.size), motion)
    log = jid.Recording.of(motion.q, forces, sample_time=0.01)
    o = jid.observe(log, ARM, jid.ZeroPhaseButterworth(10.0))
    return jid.identify(base, o, jid.estimators.LeastSquares()).save(
        tmp_path_factory.mktemp("model") / "arm.json"
    )


@settings(max_examples=40)
@given(place=st.floats(0.0, 1.0), length=st.integers(0, 8), put=st.binary(max_size=8))
def test_a_model_file_is_the_one_that_was_written_or_refused(model_file, place, length, put):
    good = model_file.read_bytes()
    start = int(place * len(good))
    data = good[:start] + put + good[start + length :]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "arm.json"
        path.write_bytes(data)
        try:
            fit, refused = jid.load(path), None
        except ValueError as error:
            fit, refused = None, error
    if fit is None:
        assert isinstance(refused, InputError | OSError)
        assert "arm.json" in str(refused)
        return
    # Spaces between values mean nothing.
    assert json.loads(data) == json.loads(good)
    np.testing.assert_array_equal(fit.parameters, jid.load(model_file).parameters)
