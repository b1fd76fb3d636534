"""Observations of virtual arms whose parameters are known."""

import math

import numpy as np

import jaxid as jid
from jaxid.identification.factors import Blocks
from jaxid.identification.fit_result import ConditionNumbers
from jaxid.identification.uncertainty import Uncertainty
from jaxid.program.sample_methods import in_numpy


def standard_parameters(model: jid.Model, seed: int = 0) -> np.ndarray:
    """Any parameters do: the equations are linear in them."""
    return np.random.default_rng(seed).uniform(0.2, 2.0, model.size)


def motion(
    joints: int, samples: int, *, seed: int = 0, still: tuple[int, ...] = ()
) -> jid.Motion:
    """A few sinusoids for each joint; some joints can be kept still."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 10.0, samples)[:, None]
    q, qd, qdd = (np.zeros((samples, joints)) for _ in range(3))
    for k in (1, 2, 3):
        w = 2 * math.pi * 0.1 * k
        a, phase = rng.uniform(0.3, 1.0, joints), rng.uniform(0, 6, joints)
        a[list(still)] = 0.0
        q += a * np.sin(w * t + phase)
        qd += a * w * np.cos(w * t + phase)
        qdd -= a * w**2 * np.sin(w * t + phase)
    return jid.Motion(q, qd, qdd)


def observations(
    model: jid.Model,
    p: np.ndarray,
    *,
    samples: int = 400,
    noise: np.ndarray | float = 0.0,
    seed: int = 0,
    noise_seed: int = 0,
    still: tuple[int, ...] = (),
    filter: jid.filters.AbstractFilter | None = None,
    every: int = 1,
    mask: np.ndarray | None = None,
) -> jid.Observations:
    """Exact motion, forces of the model with white noise; filtered only on request."""
    n = model.robot.joints
    m = motion(n, samples, seed=seed, still=still)
    forces = in_numpy(model, model.forces, m.q, m.qd, m.qdd, shared=(p,))
    forces = forces + in_numpy(model, model.known_forces, m.q, m.qd, m.qdd)
    forces = forces + noise * np.random.default_rng(noise_seed).normal(
        size=forces.shape
    )
    dt = 10.0 / (samples - 1)
    if filter is None:
        filter = jid.ZeroPhaseButterworth(0.4 / dt, force_cutoff=math.inf, margin=0.0)
    return jid.Observations.of(
        *(m.q, m.qd, m.qdd, forces),
        filter=filter,
        decimation=jid.Subsample(every),
        mask=mask,
        sample_time=dt,
    )


def dense(
    base: jid.BaseParameters, o: jid.Observations
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observation matrix, forces and joint of each counted row, in the obvious way."""
    m, model = o.motion, base.model
    theta = in_numpy(model, model.columns, m.q, m.qd, m.qdd)[:, :, list(base.indices)]
    rows = o.reduce(theta)
    forces = o.reduce(
        np.asarray(o.forces) - in_numpy(model, model.known_forces, m.q, m.qd, m.qdd)
    )
    keep = np.asarray(o.mask)
    joint = np.broadcast_to(np.arange(keep.shape[1]), keep.shape)
    return rows[keep], forces[keep], joint[keep]


def left_out_in_turn(blocks: Blocks, weights: np.ndarray) -> np.ndarray:
    """Least squares without one block of time each."""
    count = len(blocks.parts)
    rest = (blocks.select(k for k in range(count) if k != out) for out in range(count))
    parts = (blocks.total.weighted(weights) for blocks in rest)
    return np.array([np.linalg.lstsq(R, z, rcond=None)[0] for R, z in parts])


def planar_base(joints: int = 2) -> jid.BaseParameters:
    """Base parameters of a planar arm with friction, offsets: twelve of two joints."""
    terms = (
        jid.RigidBodies(),
        jid.ViscousFriction(),
        jid.CoulombFriction(),
        jid.ConstantOffset(),
    )
    limits = jid.Limits(joints, force=[40.0, 5.0, 2.0][:joints])
    return jid.base_parameters(
        jid.Model(jid.robots.planar_arm(joints, 0.4).replace(limits=limits), terms)
    )


def fit_of(base: jid.BaseParameters, parameters: np.ndarray, **fields) -> jid.Fit:
    """A fit with given base parameters: most functions ignore how they were found."""
    n, joints = base.size, base.model.robot.joints
    values = {
        "base": base,
        "parameters": np.asarray(parameters),
        "uncertainty": uncertainty(np.eye(n)),
        "weights": np.ones(joints),
        "condition_numbers": ConditionNumbers(1.0, 1.0, 1.0),
        "rows": (1,) * joints,
        "residual_rms": np.ones(joints),
        "residual": 0.0,
        "undetermined": (),
        "estimator": jid.estimators.LeastSquares(),
        "solution": jid.estimators.Complete(),
        "recordings": (),
        "notes": (),
    }
    return jid.Fit(**{**values, **fields})


def uncertainty(covariance: np.ndarray, dof: float = math.inf) -> Uncertainty:
    """A covariance with the same degrees of freedom everywhere."""
    return Uncertainty(covariance, np.full(len(covariance), float(dof)), covariance)
