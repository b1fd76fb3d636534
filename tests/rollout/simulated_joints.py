"""Joints behind position servos, with encoders, as the package simulates them."""

import numpy as np

import jaxid as jid
from jaxid.rollout import PARAMETERS, ServoMotion, ServoSimulator

ENCODER = 2 * np.pi / 4096
START = [parameter.start for parameter in PARAMETERS]
INDEX = {parameter.symbol: k for k, parameter in enumerate(PARAMETERS)}


def parameter_rows(joints, **values):
    """Return start values [joints, parameters], but for these."""
    rows = np.tile(START, (joints, 1))
    for symbol, value in values.items():
        rows[:, INDEX[symbol]] = value
    return rows


def motion_of(commands, dt=0.02):
    """Return the motion of joints that are sent commands [samples, joints]."""
    still = np.tile(commands[0], (len(commands), 1))
    return ServoMotion.of([jid.Recording.of(still, commands, sample_time=dt)])


def path_of(commands, dt=0.02, **values):
    """Return simulated positions [samples, joints]."""
    commands = np.asarray(commands, float)
    motion = motion_of(commands, dt)
    rows = parameter_rows(commands.shape[1], **values)
    return ServoSimulator(motion).positions(rows, motion.start)[0].T


def log(commands, dt=0.02, encoder=ENCODER, **values):
    """Return a recording of simulated joints."""
    path = path_of(commands, dt, **values)
    measured = encoder * np.round(path / encoder)
    return jid.Recording.of(measured, commands, sample_time=dt)


def commands(seed, amplitudes, samples=400):
    """Return sums of three sines at 50 Hz [samples, joints]."""
    t = 0.02 * np.arange(samples)[:, None]
    phase = np.random.default_rng(seed).uniform(0.0, 2 * np.pi, (3, len(amplitudes)))
    slow = np.sin(2.0 * t + phase[0]) + 0.5 * np.sin(5.0 * t + phase[1])
    fast = 0.15 * np.sin(16.0 * t + phase[2])
    return np.array(amplitudes) * (slow + fast) * np.clip(t, 0.0, 1.0)
