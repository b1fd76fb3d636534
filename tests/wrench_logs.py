"""Wrenches of a load on a moving arm by Newton and Euler alone, in NumPy."""

import numpy as np
from scipy.spatial.transform import Rotation

import jaxid as jid

RATE = 100.0
BIAS = np.array([3.0, -2.0, 6.0, 0.1, -0.3, 0.05])
TURN = np.deg2rad([1.0, -1.0, 2.0])
LOAD = jid.Tool(
    0,
    mass=1.35,
    centre_of_mass=(0.012, -0.02, 0.09),
    inertia=np.diag([0.013, 0.0125, 0.0045]),
)
ROBOT = jid.Robot(
    "spatial arm",
    revolute=(True,) * 3,
    axis=[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)],
    rotation=np.tile(np.eye(3), (3, 1, 1)),
    offset=[(0.0, 0.0, 0.3), (0.1, 0.0, 0.2), (0.4, 0.05, 0.0)],
)


def poses(t, speed):
    """Angles of a smooth motion; its wrench follows from differences in time."""
    w = speed * np.array([0.9, 1.3, 1.7])
    return np.sin(w * t[:, None] + [0.0, 1.0, 2.0]) * [1.2, 1.0, 1.4]


def wrench(t, speed=1.0, turn=TURN, load=LOAD):
    """Force and moment on the load at the flange, along turned axes: m (a - g), ..."""
    h = 1e-4
    frames = []
    for shift in (-h, 0.0, h):
        q = poses(t + shift, speed)
        R = np.eye(3)[None]
        r = np.zeros((1, 3))
        for i, angle in enumerate(q.T):
            r = r + np.einsum("nij,j->ni", R, ROBOT.offset[i])
            R = R @ Rotation.from_rotvec(np.outer(angle, ROBOT.axis[i])).as_matrix()
        frames.append((R, r + R @ load.centre_of_mass))
    (before, c_before), (R, c), (after, c_after) = frames
    rate = (
        Rotation.from_matrix(after) * Rotation.from_matrix(before).inv()
    ).as_rotvec() / (2 * h)
    spin = np.einsum("nij,jk,nlk,nl->ni", R, load.inertia, R, rate)
    first = (Rotation.from_matrix(R) * Rotation.from_matrix(before).inv()).as_rotvec()
    second = (Rotation.from_matrix(after) * Rotation.from_matrix(R).inv()).as_rotvec()
    rate_of_rate = (second - first) / h**2
    change = np.einsum("nij,jk,nlk,nl->ni", R, load.inertia, R, rate_of_rate)
    force = load.mass * ((c_after - 2 * c + c_before) / h**2 + [0.0, 0.0, 9.81])
    moment = change + np.cross(rate, spin)
    force, moment = (np.einsum("nji,nj->ni", R, x) for x in (force, moment))
    moment = moment + np.cross(load.centre_of_mass, force)
    axes = Rotation.from_rotvec(turn).as_matrix()
    return np.hstack([force @ axes, moment @ axes])


def noisy(values, seed):
    noise = np.random.default_rng(seed).normal(size=values.shape)
    return values + BIAS + noise * [0.3, 0.3, 0.3, 0.01, 0.01, 0.01]
