"""Fits with given parameters: what is exported does not depend on how it was found."""

import dataclasses

import numpy as np

import jaxid as jid
from jaxid.identification.fit import ConditionNumbers, Fit
from jaxid.identification.uncertainty import Uncertainty
from jaxid.simulation.virtual import random_bodies


def fit_of(model: jid.Model, p: np.ndarray, *, full: bool = False) -> Fit:
    """A fit whose base parameters, or all, are those of given standard parameters."""
    base, n = jid.base_parameters(model), model.robot.joints
    return Fit(
        base=base,
        parameters=np.asarray(base.from_standard(p)),
        uncertainty=Uncertainty(np.eye(base.size), np.full(base.size, np.inf), np.eye(base.size)),
        weights=np.ones(n),
        condition_numbers=ConditionNumbers(1.0, 1.0, 1.0),
        rows=(1,) * n,
        residual_rms=np.zeros(n),
        residual=0.0,
        undetermined=(),
        estimator=jid.estimators.LeastSquares(),
        solution=jid.estimators.Complete(),
        recordings=("first", "second"),
        notes=(),
        full_parameters=p if full else None,
        date="2026-01-31",
    )


def possible(model: jid.Model, seed: int = 0) -> np.ndarray:
    """Bodies that could exist, and something positive for all else."""
    rng, n = np.random.default_rng(seed), model.robot.joints
    p = rng.uniform(0.2, 0.9, model.size)
    width = model.terms[0].body_parameters
    bodies = random_bodies(model.robot, rng.uniform(0.5, 4.0, n), rng)
    p[: n * width] = bodies[:, :width].ravel()
    return p


def motion(joints: int, samples: int, seed: int = 0) -> jid.Motion:
    rng = np.random.default_rng(seed)
    return jid.Motion(*(rng.uniform(-s, s, (samples, joints)) for s in (3.0, 2.0, 5.0)))


def changed(fit: Fit, **fields) -> Fit:
    return dataclasses.replace(fit, **fields)
