"""Torque errors and arms of any size."""

import numpy as np

from jaxid.robot import library
from jaxid.robot.robot import Robot
from jaxid.validation import TorqueErrors


def errors_of(joints: int, rows: int = 200, *, name: str = "log", seed: int = 0) -> TorqueErrors:
    random = np.random.default_rng(seed)
    measured = 10.0 * random.standard_normal((rows, joints))
    return TorqueErrors(
        name=name,
        time=np.arange(rows) * 0.01,
        measured=measured,
        predicted=measured + random.standard_normal((rows, joints)),
        counted=np.ones((rows, joints), bool),
        max_forces=np.full(joints, 50.0),
    )


def arm_of(joints: int) -> Robot:
    return library.planar_arm(joints)
