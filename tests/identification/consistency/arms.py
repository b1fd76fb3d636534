"""Simulated arms with noise, reduced to triangular factors."""

import numpy as np

import jaxid as jid
from jaxid.identification.consistency.scaled_rows import ScaledRows, scaled_rows
from jaxid.program.sample_methods import in_numpy
from jaxid.simulation.virtual import random_bodies

TERMS = (
    jid.RigidBodies(),
    jid.ViscousFriction(),
    jid.CoulombFriction(),
    jid.RotorInertia(),
    jid.ConstantOffset(),
)


def truth(model: jid.Model, seed: int) -> np.ndarray:
    """Bodies that could exist, and drives that brake, of any ten-parameter model."""
    rng = np.random.default_rng(seed)
    robot = model.robot
    p = rng.uniform(0.2, 0.6, model.size)
    bodies = random_bodies(robot, rng.uniform(0.5, 4.0, robot.joints), rng)
    p[: bodies.size] = bodies.ravel()
    for k, name in enumerate(model.parameter_names):
        if name.startswith(("Iam", "fvm")):
            p[k] = 0.05
    return p


def factor(base, seed, noise=0.05, samples=200) -> tuple[np.ndarray, np.ndarray, int]:
    """Triangle, right-hand side and number of rows."""
    model, rng = base.model, np.random.default_rng(seed)
    n = model.robot.joints
    q, qd, qdd = (rng.uniform(-s, s, (samples, n)) for s in (3.0, 2.0, 4.0))
    theta = in_numpy(model, model.columns, q, qd, qdd)
    forces = theta @ truth(model, seed)
    scale = np.sqrt(np.mean(forces**2, axis=0))
    forces = (forces + noise * scale * rng.normal(size=forces.shape)) / scale
    rows = (theta / scale[:, None])[:, :, list(base.indices)].reshape(-1, base.size)
    R = np.linalg.qr(np.column_stack([rows, forces.ravel()]), mode="r")
    return R[:, :-1], R[:, -1], len(rows)


def data(base, seed, noise=0.05) -> ScaledRows:
    return scaled_rows(base, *factor(base, seed, noise))
