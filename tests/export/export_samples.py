"""Fits with given parameters: the export does not depend on how they were found."""

import numpy as np
import virtual

import jaxid as jid
from jaxid.simulation.virtual import random_bodies


def fit_of(model: jid.Model, p: np.ndarray, *, full: bool = False) -> jid.Fit:
    """A fit whose base parameters, or all, are those of given standard parameters."""
    base = jid.base_parameters(model)
    fields = {"recordings": ("first", "second"), "date": "2026-01-31"}
    full_parameters = p if full else None
    return virtual.fit_of(
        base, base.from_standard(p), full_parameters=full_parameters, **fields
    )


def possible(model: jid.Model, seed: int = 0) -> np.ndarray:
    """Bodies that could exist, and something positive for all else."""
    rng, n = np.random.default_rng(seed), model.robot.bodies
    p = rng.uniform(0.2, 0.9, model.size)
    width = model.terms[0].body_parameters
    bodies = random_bodies(model.robot, rng.uniform(0.5, 4.0, n), rng)
    p[: n * width] = bodies[:, :width].ravel()
    return p


def motion(joints: int, samples: int, seed: int = 0) -> jid.Motion:
    rng = np.random.default_rng(seed)
    return jid.Motion(*(rng.uniform(-s, s, (samples, joints)) for s in (3.0, 2.0, 5.0)))
