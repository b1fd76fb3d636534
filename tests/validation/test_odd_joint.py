"""One column of forces, or several signs, are named when the model does not fit."""

import numpy as np
import pytest
import scipy

from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import CoulombFriction, RigidBodies, ViscousFriction
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Robot
from jaxid.trajectory.fourier import random_fourier_series
from jaxid.validation.descriptions import DescribedLog
from jaxid.validation.filtered_log import FilteredLog
from jaxid.validation.mistake_search import Explanation, _is_cure, find_mistakes
from jaxid.validation.odd_joint import OddJoint, other_cause_text
from jaxid.validation.several_signs import several_signs
from jaxid.validation.suspects import SuspectedMistakes

DT = 0.005
ARM = Robot(
    "arm",
    revolute=(True,) * 4,
    axis=np.array([[0.0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0]]),
    rotation=np.tile(np.eye(3), (4, 1, 1)),
    offset=np.array([[0, 0, 0.3], [0, 0, 0.2], [0.5, 0, 0], [0.4, 0, 0]]),
    joint_names=("base", "shoulder", "elbow", "wrist"),
)
ARM_MODEL = Model(ARM, (RigidBodies(), ViscousFriction(), CoulombFriction()))
SIZES = {"m": 2.0, "mx": 0.1, "my": 0.2, "mz": 0.3, "A": 0.1, "B": 0.1, "C": 0.1}
SIZES |= {"fv": 1.0, "fc": 2.0}


@pytest.fixture(scope="module")
def log():
    """Angles and forces of a noisy log."""
    names = [name.rstrip("0123456789") for name in ARM_MODEL.parameter_names]
    parameters = np.array([SIZES.get(name, 0.0) for name in names])
    times = DT * np.arange(2400)
    motion = random_fourier_series(ARM, omega=0.6, seed=5).motion(times)
    forces = np.asarray(ARM_MODEL.inverse_dynamics(parameters, motion))
    noise = np.random.default_rng(0).normal(0.0, 0.1, forces.shape)
    return np.asarray(motion.q), forces + noise


def mistakes(model, angles, forces):
    return find_mistakes(model, [Recording.of(angles, forces, sample_time=DT)])


@pytest.mark.parametrize("gain", [0.01, 50.0])
def test_a_gear_that_one_joint_lacks_is_named_with_its_ratio(log, gain):
    angles, forces = log
    gains = np.array([1.0, gain, 1.0, 1.0])
    (sentence,) = mistakes(ARM_MODEL, angles, gains * forces).explained
    stated_gain = float(sentence.split("seems to be ")[1].split()[0])
    assert "`shoulder`" in sentence
    assert stated_gain == pytest.approx(gain, rel=0.05)


def test_a_column_of_something_else_is_named_by_its_joint(log):
    angles, forces = log
    others = forces.copy()
    others[:, 1] = np.roll(forces[:, 1], 600)
    (sentence,) = mistakes(ARM_MODEL, angles, others).unexplained
    assert "without the force of joint `shoulder`" in sentence


def test_a_mistake_is_no_cure_if_one_joint_left_out_fits_far_better():
    """Figures of a Kinova arm, one of whose torques was divided by 50."""
    gravity = Explanation(1.55, 0.055, 0.04, 0.01, "no gravity", is_gain=False)
    odd = OddJoint(joint=1, misfit=0.0143, gain=0.02, correlation=0.1)
    assert _is_cure(gravity, 0.31, None)
    assert not _is_cure(gravity, 0.31, odd)
    assert _is_cure(gravity._replace(misfit=0.02), 0.31, odd)


def test_one_odd_joint_stands_beside_a_mistake_of_several(log):
    angles, forces = log
    recording = Recording.of(angles, forces, sample_time=DT)
    described_log = DescribedLog(ARM_MODEL, FilteredLog(ARM, [recording]))
    odd = OddJoint(joint=1, misfit=0.012, gain=0.02, correlation=0.1)
    text = other_cause_text(described_log, odd, "forces of `shoulder` and `elbow`")
    assert "only the force of joint `shoulder` is wrong" in text
    assert other_cause_text(described_log, odd, "the sign of `shoulder`") == ""


def test_one_joint_in_degrees_is_named(log):
    angles, forces = log
    units = np.array([1.0, 1.0, 180 / np.pi, 1.0])
    (sentence,) = mistakes(ARM_MODEL, units * angles, forces).explained
    assert "the angle of joint `elbow`, and not of all, seems to be in deg" in sentence


def test_several_wrong_signs_are_named_together_and_the_search_tells_how_far_it_is(log):
    angles, forces = log
    signs = np.array([-1.0, 1.0, -1.0, 1.0])
    recording = Recording.of(angles, signs * forces, sample_time=DT)
    fractions = []
    (sentence,) = find_mistakes(
        ARM_MODEL, [recording], progress=fractions.append
    ).explained
    assert "of the force of `base` and `elbow` (`recording.force_signs`)" in sentence
    assert fractions == sorted(fractions)
    assert fractions[0] == 0.0
    assert fractions[-1] > 0.9


def test_signs_of_angles_and_forces_are_found_together(log):
    angles, forces = log
    signs = np.array([-1.0, 1.0, -1.0, 1.0])
    recording = Recording.of(signs * angles, signs * forces, sample_time=DT)
    described_log = DescribedLog(ARM_MODEL, FilteredLog(ARM, [recording]))
    best_signs = several_signs(
        described_log, SuspectedMistakes(described_log, recording)
    )
    assert np.array_equal(best_signs[0].angles, signs)
    assert np.array_equal(best_signs[0].forces, signs)


def test_a_column_of_zeros_is_named_if_the_joint_carries_a_load(log):
    angles, forces = log
    forces = forces * np.array([1.0, 1.0, 0.0, 1.0])
    (sentence,) = mistakes(ARM_MODEL, angles, forces).explained
    assert "of joint `elbow` are 0 throughout, but by those of the other" in sentence


def test_a_passive_joint_has_no_force_and_is_not_called_wrong():
    """The second joint of a double pendulum of two point masses swings freely."""
    pendulum = Robot(
        "pendulum",
        revolute=(True, True),
        axis=np.array([[0.0, -1, 0], [0, -1, 0]]),
        rotation=np.tile(np.eye(3), (2, 1, 1)),
        offset=np.array([[0.0, 0, 0], [0.4, 0, 0]]),
    )
    masses = 2.0, 1.0
    lengths = 0.4, 0.3

    def accelerations(state, torque):
        q1, q2, v1, v2 = state
        m1, m2 = masses
        l1, l2 = lengths
        inertia = m2 * l2 * (l2 + l1 * np.cos(q2))
        matrix = np.array(
            [
                [(m1 + m2) * l1**2 + m2 * l2 * (l2 + 2 * l1 * np.cos(q2)), inertia],
                [inertia, m2 * l2**2],
            ]
        )
        coupling = m2 * l1 * l2 * np.sin(q2)
        outer_load = 9.81 * m2 * l2 * np.cos(q1 + q2)
        inner_load = 9.81 * (m1 + m2) * l1 * np.cos(q1) + outer_load
        rates = coupling * np.array([-v2 * (2 * v1 + v2), v1**2])
        forces = np.array([torque, 0.0])
        return np.linalg.solve(
            matrix, forces - rates - np.array([inner_load, outer_load])
        )

    def drive(time, state):
        target = -1.5 + 0.8 * np.sin(1.9 * time) + 0.5 * np.sin(3.1 * time)
        return 40.0 * (target - state[0]) - 4.0 * state[2]

    def rate(time, state):
        return np.concatenate([state[2:], accelerations(state, drive(time, state))])

    times = DT * np.arange(2400)
    solution = scipy.integrate.solve_ivp(
        rate, (0, times[-1]), [-1.5, 0.3, 0, 0], t_eval=times, rtol=1e-8, atol=1e-9
    )
    torques = [drive(t, state) for t, state in zip(times, solution.y.T, strict=True)]
    forces = np.column_stack([torques, np.zeros_like(times)])
    result = mistakes(Model(pendulum, (RigidBodies(),)), solution.y[:2].T, forces)
    assert not result.explained
    assert not result.unexplained
