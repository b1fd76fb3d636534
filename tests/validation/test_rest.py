"""Friction at rest: what the model misses there, and the speed that leaves it out."""

import dataclasses

import numpy as np
import pytest

import jaxid as jid
from jaxid.validation.diagnosis import mistakes_in_logs

SLIDE = """<mujoco><worldbody><body><joint name="rail" type="slide" axis="1 0 0"/>
<inertial mass="3" pos="0 0 0" diaginertia="0.1 0.1 0.1"/></body></worldbody></mujoco>
"""
STEP = 0.005
MASS = 3.0
FRICTION = 2.0


def record(held):
    """Return a log of moves of a second and pauses, with forces held in these."""
    time = STEP * np.arange(round(24.0 / STEP))
    number = (time // 2.0).astype(int)
    phase = 2 * np.pi * np.minimum(time - 2.0 * number, 1.0)
    direction = np.where(number % 2 == 0, 0.3, -0.3)
    starts = np.where(number % 2 == 0, 0.0, 0.3)
    angles = starts + direction * (phase - np.sin(phase)) / (2 * np.pi)
    speeds = direction * (1 - np.cos(phase))
    accelerations = direction * 2 * np.pi * np.sin(phase)
    is_moving = phase < 2 * np.pi
    forces = MASS * accelerations + FRICTION * np.sign(direction)
    forces = np.where(is_moving, forces, held[number])
    forces += 0.01 * np.random.default_rng(1).normal(size=len(time))
    assert np.abs(speeds[~is_moving]).max() < 1e-9
    return jid.Recording.of(angles[:, None], forces[:, None], time=time)


@pytest.fixture(scope="module")
def setup(tmp_path_factory):
    """Return the setup of the slide."""
    path = tmp_path_factory.mktemp("slide") / "slide.xml"
    path.write_text(SLIDE)
    return jid.Setup(jid.load_mjcf(path))


HELD = FRICTION * np.random.default_rng(0).uniform(-1, 1, 12)


@pytest.mark.parametrize(
    ("held", "min_speed", "is_told"),
    [(HELD, None, True), (HELD, [0.01], False), (0 * HELD, None, False)],
)
def test_rows_at_rest_are_told_with_their_cure(setup, held, min_speed, is_told):
    log = record(held)
    observations = dataclasses.replace(setup, min_speed=min_speed).observe(log)
    fit = jid.identify(setup.base, observations, setup.least_squares)
    diagnosis = jid.diagnose(log, setup.robot, observations=observations)
    mistakes = mistakes_in_logs([diagnosis], fit)
    assert not mistakes.certain
    remarks = [x for x in mistakes.remarks if "friction at rest" in x]
    assert len(remarks) == is_told
    if is_told:
        # A fiftieth of the largest speed.
        assert "`rail`" in remarks[0]
        assert "`min_speed = [0.012]` in `[rows]`" in remarks[0]
