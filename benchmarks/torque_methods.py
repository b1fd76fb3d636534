"""Methods that identify from torques and positions, for the same model and logs.

Least squares at the measured motion (`jid.identify`); instrumental variables, whose
instruments are the columns at a simulated motion (Janot, Vandanjon, Gautier 2014);
least squares at the simulated motion (DIDIM: Gautier, Janot, Vandanjon 2013).

The torques of the log drive this simulation, and a controller keeps it near the
measured motion: without it, in windows, the simulated motion fits the torques with any
parameters.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

import jaxid as jid

MAX_SIMULATIONS = 8
"""Largest number of simulations with the parameters of the one before."""
MAX_CHANGE = 1e-3
"""Relative change of the parameters below which they have settled."""


def parameters_by_method(
    base: jid.BaseParameters, logs: Sequence[jid.Observations], bandwidth: float
) -> dict[str, np.ndarray]:
    """Return the base parameters of each method.

    Args:
        base: Base parameters of the model; dry friction must be smooth.
        logs: Filtered logs with torques.
        bandwidth: Double pole of the controller of the simulations [rad/s].
    """
    least_squares = np.asarray(jid.identify(base, logs).parameters)

    def instruments(motions):
        estimator = jid.estimators.InstrumentalVariables(motions)
        return np.asarray(jid.identify(base, logs, estimator).parameters)

    def didim(motions):
        pairs = zip(logs, motions, strict=True)
        simulated = [log.replace(motion=motion) for log, motion in pairs]
        return np.asarray(jid.identify(base, simulated).parameters)

    return {
        "least squares": least_squares,
        "instrumental variables": settle(
            instruments, base, least_squares, logs, bandwidth
        ),
        "DIDIM": settle(didim, base, least_squares, logs, bandwidth),
    }


def settle(
    estimate: Callable[[tuple[jid.Motion, ...]], np.ndarray],
    base: jid.BaseParameters,
    start: np.ndarray,
    logs: Sequence[jid.Observations],
    bandwidth: float,
) -> np.ndarray:
    """Return estimates from motions simulated with the estimates themselves."""
    parameters = start
    for _ in range(MAX_SIMULATIONS):
        motions = tuple(follow(base, parameters, log, bandwidth) for log in logs)
        if not all(np.isfinite(motion.qdd).all() for motion in motions):
            return np.full_like(start, np.nan)
        estimates = estimate(motions)
        change = np.linalg.norm(estimates - parameters) / np.linalg.norm(estimates)
        parameters = estimates
        if change < MAX_CHANGE:
            break
    return parameters


def follow(
    base: jid.BaseParameters,
    parameters: np.ndarray,
    log: jid.Observations,
    bandwidth: float,
) -> jid.Motion:
    """Return the motion that torques cause, kept near the measured one."""
    p = jnp.asarray(base.to_standard(parameters))
    simulate = _simulation(base.model, float(log.sample_time))
    motions = []
    for first, end in log.segments:
        measured = log.motion[first:end]
        forces = jnp.asarray(log.forces[first:end])
        motions.append(simulate(p, measured.q, measured.qd, forces, bandwidth))
    parts = zip(*motions, strict=True)
    return jid.Motion(*(np.concatenate(part) for part in parts))


@functools.cache
def _simulation(model: jid.Model, step_size: float) -> Callable:
    """Return the simulation of one segment, by the Runge-Kutta method of order four."""

    def simulate(p, q, qd, forces, bandwidth):
        def rate(state, inputs):
            q, qd = state
            force, measured_q, measured_qd = inputs
            control = bandwidth**2 * (measured_q - q)
            control += 2.0 * bandwidth * (measured_qd - qd)
            return qd, model.forward_dynamics(p, q, qd, force) + control

        def advance(state, rate, time):
            return jax.tree.map(lambda y, r: y + time * r, state, rate)

        def step(state, inputs):
            first, last = inputs
            middle = jax.tree.map(lambda a, b: 0.5 * (a + b), first, last)
            k1 = rate(state, first)
            k2 = rate(advance(state, k1, 0.5 * step_size), middle)
            k3 = rate(advance(state, k2, 0.5 * step_size), middle)
            k4 = rate(advance(state, k3, step_size), last)
            mean = jax.tree.map(
                lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4
            )
            end = advance(state, mean, step_size)
            return end, (*end, k1[1])

        inputs = (forces, jnp.asarray(q), jnp.asarray(qd))
        starts = tuple(x[:-1] for x in inputs)
        ends = tuple(x[1:] for x in inputs)
        _, (q, qd, qdd) = jax.lax.scan(
            step, (inputs[1][0], inputs[2][0]), (starts, ends)
        )
        q = jnp.concatenate([inputs[1][:1], q])
        qd = jnp.concatenate([inputs[2][:1], qd])
        return q, qd, jnp.concatenate([qdd, qdd[-1:]])

    return jax.jit(simulate)
