"""Payloads, drive gains and delays of a virtual arm whose truth is known."""

import dataclasses

import numpy as np
import pytest
from virtual import motion, observations, standard_parameters

import jaxid as jid
from jaxid.identification.payload import body_columns
from jaxid.result_table import Status

LOAD = jid.Tool(
    2,
    mass=3.0,
    centre_of_mass=(0.02, -0.03, 0.12),
    inertia=[[0.012, 0.001, 0.0], [0.001, 0.015, -0.0005], [0.0, -0.0005, 0.008]],
)
GAINS = np.array([1.2, 0.85, 1.05])


@pytest.fixture(scope="module")
def base():
    """Three joints, different axes: a last-body load shows all of its parameters."""
    robot = jid.Robot(
        "spatial arm",
        revolute=(True,) * 3,
        axis=[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)],
        rotation=np.tile(np.eye(3), (3, 1, 1)),
        offset=[(0.0, 0.0, 0.3), (0.1, 0.0, 0.2), (0.4, 0.05, 0.0)],
        limits=jid.Limits(3, force=[60.0, 80.0, 20.0]),
    )
    terms = (jid.RigidBodies(), jid.ViscousFriction(), jid.CoulombFriction())
    return jid.base_parameters(jid.Model(robot, terms))


def pair(base, noise=0.0, seed=0, *, friction=1.2, gains=1.0, samples=400):
    """Fits without and with the load, which also brakes more."""
    p = standard_parameters(base.model)
    loaded = p.copy()
    loaded[20:30] += LOAD.parameters
    loaded[30:] *= friction
    fits = []
    options = {"noise": noise, "samples": samples}
    for k, (x, name) in enumerate(((p, "unloaded"), (loaded, "loaded"))):
        o = observations(base.model, x, seed=k + 1, noise_seed=10 * seed + k, **options)
        fits.append(jid.identify(base, o.replace(forces=o.forces / gains), name=name))
    return fits


@pytest.fixture(scope="module")
def exact(base):
    return pair(base)


def test_all_ten_parameters_come_back_without_noise(base, exact):
    found = jid.identify_payload(*exact)
    np.testing.assert_allclose(found.parameters, LOAD.parameters, atol=1e-8)
    np.testing.assert_allclose(found.inertia, LOAD.inertia, atol=1e-8)
    np.testing.assert_allclose(found.centre_of_mass, LOAD.centre_of_mass, atol=1e-8)
    np.testing.assert_allclose(found.tool.parameters, LOAD.parameters, atol=1e-8)


def test_deviations_are_those_of_many_draws_and_carry_both_runs(base):
    noise = np.array([0.05, 0.05, 0.02])
    draws, variances, central = [], [], []
    for seed in range(20):
        found = jid.identify_payload(*pair(base, noise, seed, samples=200))
        # What could exist scatters less than the estimates do.
        values, known = dataclasses.replace(found, parameters=found.estimate).central
        draws.append(np.append(found.estimate, values))
        variances.append(np.diag(found.uncertainty.covariance))
        central.append(np.diag(known.covariance))
    scatter = np.var(draws, axis=0)
    ratio = np.mean(variances, axis=0) / scatter[:10]
    # A variance from 20 draws scatters by sqrt(2 / 20) = 0.32, the mean of ten alike
    # ones less.
    np.testing.assert_allclose(ratio, 1.0, atol=0.9)
    assert abs(ratio.mean() - 1.0) < 0.3
    assert abs(np.mean(np.mean(central, axis=0) / scatter[10:]) - 1.0) < 0.35
    assert np.abs(np.mean(draws, axis=0)[0] - 3.0) < 4 * np.sqrt(scatter[0] / 20)


def test_gains_come_back(base):
    found = jid.identify_drive_gains(*pair(base, gains=GAINS), LOAD)
    np.testing.assert_allclose(found.gains, GAINS, rtol=1e-7)
    p = np.asarray(base.from_standard(standard_parameters(base.model)))
    np.testing.assert_allclose(found.parameters, p, rtol=1e-6, atol=1e-6)
    errors, sizes = [], []
    for seed in range(16):
        noisy = pair(base, np.array([0.5, 0.5, 0.2]), seed, gains=GAINS, samples=300)
        found = jid.identify_drive_gains(*noisy, LOAD)
        errors.append(found.gains - GAINS)
        sizes.append(found.uncertainty.standard_deviations)
    scatter = np.std(errors, axis=0)
    assert (np.abs(np.mean(errors, axis=0)) < 4 * scatter / np.sqrt(16)).all(), (
        "no shrinking"
    )
    np.testing.assert_allclose(np.mean(sizes, axis=0) / scatter, 1.0, atol=0.6)


def test_the_mass_of_a_load_is_enough_for_gains(base):
    """Its centre and inertia come out beside; noise only makes the intervals wider."""
    found = jid.identify_drive_gains(*pair(base, gains=GAINS), 3.0)
    np.testing.assert_allclose(found.gains, GAINS, rtol=1e-6)
    noisy = pair(base, np.array([0.01, 0.01, 0.004]), 1, gains=GAINS)
    found, known = (jid.identify_drive_gains(*noisy, load) for load in (3.0, LOAD))
    deviations = found.uncertainty.standard_deviations
    assert (np.abs(found.gains - GAINS) < 4 * deviations).all()
    assert (deviations > known.uncertainty.standard_deviations).all()
    noisy = pair(base, np.array([0.5, 0.5, 0.2]), 1, gains=GAINS)
    with pytest.raises(ValueError, match=r"no gain.*centre of mass and inertia"):
        jid.identify_drive_gains(*noisy, 3.0)


def test_a_known_mass_makes_the_rest_of_a_payload_better_known(base):
    noisy = pair(base, np.array([0.5, 0.5, 0.2]), 2)
    found, weighed = (jid.identify_payload(*noisy, mass=mass) for mass in (None, 3.0))
    assert abs(weighed.estimate[0] - 3.0) < 0.01
    s, t = (x.uncertainty.standard_deviations for x in (found, weighed))
    assert (t <= s * (1 + 1e-9)).all()
    assert t[3] < 0.99 * s[3]
    assert (np.abs(weighed.estimate - LOAD.parameters) < 4 * t).all()


@pytest.mark.parametrize("mass", [None, 3.0])
def test_a_load_that_was_taken_off_is_no_payload(base, exact, mass):
    """Logs that are exchanged look the same, whether the mass is known or not."""
    unloaded, loaded = exact
    found = jid.identify_payload(loaded, unloaded, mass=mass)
    assert found.is_lighter
    np.testing.assert_allclose(found.estimate, -LOAD.parameters, atol=1e-8)
    assert "lighter by 3.0 kg" in str(found)
    assert "are the logs exchanged" in " ".join(str(found).split())
    with pytest.raises(ValueError, match="mass"):
        _ = found.tool
    assert not jid.identify_payload(unloaded, loaded, mass=mass).is_lighter


def test_a_load_whose_weight_the_controller_takes_out_is_no_payload(base):
    robot = base.model.robot.replace(
        axis=np.array([(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0)]),
        offset=np.array([(0.0, 0.0, 0.3), (0.0, 0.05, 0.2), (0.0, 0.0, 0.4)]),
    )
    base = jid.base_parameters(jid.Model(robot, base.model.terms))
    noise = np.array([0.02, 0.02, 0.01])
    unloaded, loaded = pair(base, noise, 1)
    assert (
        jid.identify_payload(unloaded, loaded).summary().remarks[0].status
        is Status.GOOD
    )
    p = standard_parameters(base.model)
    load = np.zeros_like(p)
    load[20:30] = LOAD.parameters
    o = observations(base.model, p + load, seed=2, noise_seed=3, noise=noise)
    q = motion(3, 400, seed=2).q
    rest = jid.Motion(q, np.zeros_like(q), np.zeros_like(q))
    weight = np.asarray(base.model.inverse_dynamics(load, rest))
    compensated = jid.identify(base, o.replace(forces=o.forces - weight))
    (remark,) = jid.identify_payload(unloaded, compensated).summary().remarks
    assert remark.status is Status.BAD
    assert "set in the robot's controller" in remark.text


def test_no_load_at_all_is_not_lighter(base):
    """The mass is zero within its scatter: sometimes below, but by little."""
    noise = np.array([0.05, 0.05, 0.02])
    unloaded, _ = pair(base, noise, 1)
    for seed in range(2, 6):
        again, _ = pair(base, noise, seed)
        assert not jid.identify_payload(unloaded, again).is_lighter


@pytest.mark.parametrize("joint", [0, 2])
def test_a_gain_that_the_load_does_not_tell_stays_one(base, joint):
    """A brake carries the load of a joint: its motor only makes noise."""
    noise = np.array([0.1, 0.1, 0.04])
    fits = []
    for seed, fit_mass in enumerate((0.0, 1.0)):
        parameters = standard_parameters(base.model)
        parameters[20:30] += fit_mass * LOAD.parameters
        o = observations(base.model, parameters, noise=noise, seed=seed)
        forces = o.forces / GAINS
        random = np.random.default_rng(seed)
        forces[:, joint] = random.normal(0.0, noise[joint], len(forces))
        fits.append(jid.identify(base, o.replace(forces=forces), name=str(seed)))
    found = jid.identify_drive_gains(*fits, LOAD)
    others = np.arange(3) != joint
    assert found.gains[joint] == 1.0
    assert f"do not determine the gain of `joint{joint + 1}`" in found.remarks[0].text
    np.testing.assert_allclose(found.gains[others], GAINS[others], rtol=0.02)


WRONG_CENTRES = [(0.02, -0.03, 0.02), (0.12, -0.03, 0.02), (0.02, -0.03, -0.12)]


@pytest.mark.parametrize("centre", WRONG_CENTRES)
def test_a_load_in_a_wrong_frame_is_doubted(base, centre):
    noisy = pair(base, np.array([0.1, 0.1, 0.04]), 3, gains=GAINS)
    moved = jid.Tool(2, mass=3.0, centre_of_mass=centre, inertia=LOAD.inertia)
    found = jid.identify_drive_gains(*noisy, moved)
    assert "The load does not fit" in str(found)
    cured = jid.identify_drive_gains(*noisy, LOAD)
    assert cured.remarks == []
    np.testing.assert_allclose(cured.gains, GAINS, rtol=0.02)


def test_removing_a_delay_undoes_it():
    t = 0.01 * np.arange(400)
    angles = np.sin(np.outer(t, [3.0, 5.0]))
    shifted = np.sin(np.outer(t - 0.0234, [3.0, 5.0]))
    log = jid.Recording.of(angles, shifted, velocities=angles, sample_time=0.01)
    back = jid.remove_delay(log, 0.0234)
    np.testing.assert_allclose(back.time, t[3:])
    np.testing.assert_allclose(back.velocities, back.angles)
    early = jid.remove_delay(
        jid.Recording.of(shifted, angles, sample_time=0.01), -0.0234
    )
    for log in (back, early):
        assert log.samples == 397
        np.testing.assert_allclose(log.angles[3:-3], log.forces[3:-3], atol=2e-6)
    assert "23.4 ms was removed" in back.notes[-1]
    with pytest.raises(ValueError, match="`recording` lasts"):
        jid.remove_delay(early, 10.0)


def test_refusals(base, exact):
    with pytest.raises(ValueError, match="`body`"):
        jid.identify_payload(*exact, body=7)
    seven = jid.Model(base.model.robot, (jid.RigidBodies(principal_axes=True),))
    with pytest.raises(ValueError, match="the model lacks `D3`"):
        body_columns(jid.base_parameters(seven), 2)
    drives = jid.Drives(3, reduction=[[9, 0, 0], [0, 9, 0], [0, 5, 9]])
    coupled = jid.Model(base.model.robot.replace(drives=drives), base.model.terms)
    fits = [dataclasses.replace(f, base=jid.base_parameters(coupled)) for f in exact]
    with pytest.raises(
        ValueError, match="motors of `spatial arm` turn more than one axis"
    ):
        jid.identify_drive_gains(*fits, LOAD)
