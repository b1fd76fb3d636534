"""Many data sets for any estimator: one after the other, on all cores."""

import os
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Bool, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.identification.estimators import AbstractEstimator
from jaxid.identification.fit import Fit
from jaxid.identification.identify import identify
from jaxid.identification.normal_equations import BatchFit
from jaxid.identification.uncertainty import IndependentRows, SpectralSandwich
from jaxid.measurement.observations import Observations

AS_IT_IS = 0.4
"""Cut-off of a filter that is not used, in units of the sampling rate."""


def estimate_each(
    base: BaseParameters,
    motion: Motion,
    forces: Float[AnyArray, "datasets *draws samples joints"],
    mask: Bool[AnyArray, "datasets samples joints"] | None,
    estimator: AbstractEstimator,
    row_time: float | None,
) -> BatchFit:
    """The estimates of `identify` for each data set and draw; see `identify_batch`.

    Args:
        base: What can be identified.
        motion: Motion of each data set, already filtered and decimated.
        forces: Forces of each data set and draw.
        mask: Which rows count.
        estimator: How; each data set for itself.
        row_time: Between two rows [s]; None if rows are taken for independent.
    """
    q, qd, qdd, Q = (np.asarray(x) for x in (motion.q, motion.qd, motion.qdd, forces))
    draws = Q.shape[1:-2]
    Q = Q.reshape(len(Q), -1, *Q.shape[-2:])
    if mask is None:
        counted = np.ones((len(Q), *Q.shape[-2:]), bool)
    else:
        counted = np.asarray(mask) > 0
        Q = np.where(counted[:, None], Q, 0.0)
    uncertainty = IndependentRows() if row_time is None else SpectralSandwich()
    dt = 1.0 if row_time is None else row_time

    def one(case: tuple[int, int]) -> Fit:
        k, draw = case
        o = Observations.of(
            *(q[k], qd[k], qdd[k], Q[k, draw]),
            sample_time=dt,
            mask=counted[k],
            name=f"data set {k + 1}",
        )
        return identify(base, o, estimator, uncertainty=uncertainty)

    cases = [(k, draw) for k in range(len(Q)) for draw in range(Q.shape[1])]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        fits = list(pool.map(one, cases))

    def stacked(name: str) -> jnp.ndarray:
        found = np.stack([np.asarray(getattr(fit, name)) for fit in fits])
        return jnp.asarray(found.reshape(len(Q), *draws, -1))

    first = fits[:: Q.shape[1]]
    return BatchFit(
        stacked("parameters"),
        stacked("standard_deviations"),
        stacked("residual_rms"),
        jnp.asarray([fit.condition_numbers.scaled for fit in first]),
        jnp.asarray([bool(np.isfinite(fit.naive_standard_deviations).all()) for fit in first]),
        stacked("naive_standard_deviations"),
        jnp.asarray(
            np.stack([np.asarray(fit.uncertainty.dof) for fit in fits]).reshape(len(Q), *draws, -1)
        ),
    )
