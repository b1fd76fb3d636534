r"""Open-loop rollouts: recorded torques in, positions out, by multiple shooting.

Windows of a given horizon start from measured states. The parameters are those for which their
simulated ends lie on the measured positions: unlike a fit of torques at measured accelerations,
it needs no second derivative, and errors that add up over the horizon count.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.errors import InputError
from jaxid.identification.identify import identify
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.measurement.observations import Observations
from jaxid.program.xla import lower
from jaxid.result_table import Column, Table, with_deviations

from .least_squares import minimise

MARGIN = 0.05
"""Time before and behind a window for which its torques are known, for delays [s]."""
SLIDING = 0.05
"""Speed at which friction by torque has about its full size [rad/s or m/s]."""
BLOCKS = 40
"""Contiguous parts of the logs whose scatter gives the uncertainty."""


class Windows(NamedTuple):
    """Windows of logs, all of one length.

    The windows are the last axis, which makes the loops over them fast.

    Attributes:
        q: Initial positions [joints, windows].
        qd: Initial velocities.
        forces: Torques, with a margin at both ends [samples, joints, windows].
        measured: Measured positions behind the first sample [steps, joints, windows].
        blocks: Part of the logs to which each window belongs.
    """

    q: Float[AnyArray, "joints windows"]
    qd: Float[AnyArray, "joints windows"]
    forces: Float[AnyArray, "samples joints windows"]
    measured: Float[AnyArray, "steps joints windows"]
    blocks: np.ndarray

    @classmethod
    def of(cls, logs: Sequence[Observations], horizon: float, spacing: float) -> "Windows":
        """Return windows of a horizon [s], whose starts are `spacing` [s] apart."""
        dt = logs[0].sample_time
        if any(abs(o.sample_time - dt) > 0.01 * dt for o in logs):
            raise InputError("`observations` must have one sample time.")
        steps, margin = max(1, round(horizon / dt)), round(MARGIN / dt)
        parts, count = [], 0
        for o in logs:
            q, qd, forces = (np.asarray(x) for x in (o.motion.q, o.motion.qd, o.forces))
            edge = o.filter.edge(dt) + margin
            for a, b in o.segments:
                starts = np.arange(a + edge, b - edge - steps, max(1, round(spacing / dt)))
                parts += [
                    (
                        q[k],
                        qd[k],
                        forces[k - margin : k + steps + margin + 1],
                        q[k + 1 : k + steps + 1],
                        count + k - a,
                    )
                    for k in starts
                ]
                count += b - a
        if not parts:
            raise InputError(f"`observations` hold no window of {horizon:g} s: shorten `horizon`.")
        q0, qd0, u, measured, place = (np.stack(x, axis=-1) for x in zip(*parts, strict=True))
        return cls(q0, qd0, u, measured, place * BLOCKS // max(count, 1))


@dataclasses.dataclass(frozen=True)
class TorqueRollout:
    """Robot whose recorded torques are applied, and the unknowns of its simulation.

    The unknowns: base parameters, delay of the torques [s], gain of each joint's torque, friction
    of each joint per torque.

    Attributes:
        base: Base parameters of the model.
        sample_time: Time between two samples [s].
    """

    base: BaseParameters
    sample_time: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        joints = range(1, self.base.model.robot.joints + 1)
        gains = (f"{kind}{j}" for kind in ("gain", "load friction") for j in joints)
        return (*self.base.names, "delay", *gains)

    def start(self, p: AnyArray) -> np.ndarray:
        """Return the unknowns without delay, with gains of 1."""
        n = self.base.model.robot.joints
        return np.concatenate([p, np.zeros(1), np.ones(n), np.zeros(n)])

    def errors(self, x: Array, windows: Windows) -> Float[Array, "steps joints windows"]:
        """Return simulated less measured positions, by the Runge-Kutta method of order four."""
        n, h = self.base.model.robot.joints, self.sample_time
        p, delay, gains, load = jnp.split(x, np.cumsum([self.base.size, 1, n]))
        p, gains, load = self.base.to_standard(p)[:, None], gains[:, None], load[:, None]
        forces, margin = jnp.asarray(windows.forces), round(MARGIN / h)
        steps = len(forces) - 2 * margin - 1
        at = jnp.clip(
            margin + jnp.asarray(np.arange(steps + 1.0)) - delay / h, 0.0, len(forces) - 1.001
        )
        whole = jnp.floor(at)
        k = whole.astype(int)
        late = forces[k] + (at - whole)[:, None, None] * (forces[k + 1] - forces[k])
        acceleration = self._acceleration

        def rate(state, u):
            q, qd = state
            # Gear friction grows with the torque that it carries.
            u = gains * u - load * jnp.abs(u) * jnp.tanh(qd / SLIDING)
            return qd, jnp.stack(acceleration(p, q, qd, u))

        def moved(state, rate, time):
            return jax.tree.map(lambda y, r: y + time * r, state, rate)

        def step(state, inputs):
            u0, u1 = inputs
            middle = 0.5 * (u0 + u1)
            k1 = rate(state, u0)
            k2 = rate(moved(state, k1, 0.5 * h), middle)
            k3 = rate(moved(state, k2, 0.5 * h), middle)
            k4 = rate(moved(state, k3, h), u1)
            mean = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
            state = moved(state, mean, h)
            return state, state[0]

        start = jnp.asarray(windows.q), jnp.asarray(windows.qd)
        return jax.lax.scan(step, start, (late[:-1], late[1:]))[1] - windows.measured

    @functools.cached_property
    def _acceleration(self) -> Callable:
        """Accelerations of many samples in scalar operations, which JAX differentiates."""
        model = self.base.model
        joints = (model.robot.joints,)
        return lower(program_of(model, model.acceleration, (model.size,), *[joints] * 3), False)


@dataclasses.dataclass(frozen=True)
class TorqueRolloutFit:
    """Parameters for which open-loop simulations follow the measured positions.

    Attributes:
        rollout: Robot and unknowns.
        unknowns: Estimates, in the order of `rollout.names`.
        free: Unknowns that were estimated.
        uncertainty: Uncertainty of these, from the scatter of parts of the logs.
        horizon: Horizon of the windows [s].
        rms: Errors of the identification over the windows [rad or m].
        start: Base parameters of the fit of torques from which the search started.
    """

    rollout: TorqueRollout
    unknowns: Float[np.ndarray, " unknowns"]
    free: np.ndarray
    uncertainty: Uncertainty
    horizon: float
    rms: Float[np.ndarray, " joints"]
    start: Float[np.ndarray, " base"]

    @property
    def parameters(self) -> Float[np.ndarray, " base"]:
        """Base parameters."""
        return self.unknowns[: self.rollout.base.size]

    def errors_at(
        self,
        observations: Sequence[Observations] | Observations,
        horizon: float,
        parameters: AnyArray | None = None,
    ) -> Float[np.ndarray, " joints"]:
        """Return the root mean square error at the ends of windows [rad or m].

        Args:
            observations: Logs, which the fit need not have seen.
            horizon: Length of the windows [s].
            parameters: Other base parameters, without delay and gains, such as those of a fit of
                torques; those of this fit if None.
        """
        logs = [observations] if isinstance(observations, Observations) else observations
        windows = Windows.of(logs, horizon, 0.04)
        x = self.unknowns if parameters is None else self.rollout.start(parameters)
        with double_precision():
            errors = jax.jit(self.rollout.errors)(jnp.asarray(x), windows._replace(blocks=None))
        return np.sqrt(np.mean(np.asarray(errors)[-1] ** 2, axis=-1))

    def summary(self) -> Table:
        """Return a table of the estimates with 95 % intervals."""
        names = [name for name, free in zip(self.rollout.names, self.free, strict=True) if free]
        deviations = self.uncertainty.standard_deviations
        values, shown = with_deviations(self.unknowns[self.free], deviations)
        half = self.uncertainty.half_widths()
        ends = [
            with_deviations(self.unknowns[self.free] + s * half, deviations)[0] for s in (-1, 1)
        ]
        errors = "  ".join(f"{1e3 * x:.3g}" for x in self.rms)
        return Table(
            "open-loop rollouts",
            Column("parameter", names),
            Column("estimate", values, kind="number"),
            Column("±", shown, kind="number"),
            Column("95 %\nfrom", ends[0], kind="number"),
            Column("95 %\nto", ends[1], kind="number"),
            facts=[(f"errors within {self.horizon:g} s", f"{errors} mrad or mm RMS")],
        )

    def __str__(self) -> str:
        return self.summary().text()


def identify_torque_rollout(
    base: BaseParameters,
    observations: Sequence[Observations] | Observations,
    *,
    horizon: float = 0.2,
    gains: bool = False,
    load_friction: bool = False,
    every: int = 5,
) -> TorqueRolloutFit:
    """Identify a robot so that its simulation under recorded torques follows the positions.

    The search starts from the fit of torques. Windows overlap by four fifths.

    Args:
        base: Base parameters of the model; dry friction must be smooth.
        observations: Filtered logs with torques.
        horizon: Length of the windows [s].
        gains: Whether the gains of the other joints' torques, relative to the first joint's, are
            estimated. A gain common to all scales all parameters, and no log tells it.
        load_friction: Whether friction that grows with the torque is estimated.
        every: Number of samples from one that counts to the next.

    Raises:
        InputError: If there is no window of the horizon, or the model is not that of a robot with a
            positive mass matrix.
    """
    logs = [observations] if isinstance(observations, Observations) else list(observations)
    rollout = TorqueRollout(base, logs[0].sample_time)
    windows = Windows.of(logs, horizon, 0.2 * horizon)
    first, n = np.asarray(identify(base, logs).parameters), base.model.robot.joints
    free = np.concatenate(
        [np.ones(base.size + 1), np.full(n, gains), np.full(n, load_friction)]
    ).astype(bool)
    # All torques, masses and friction can be scaled together: the first gain is 1.
    free[base.size + 1] = False
    start = rollout.start(first)
    functions = _compiled(rollout, windows, free, every)
    with double_precision():
        limits = _limits(start, base.size)
        found = minimise(*functions[:2], start[None], free[None], limits, 25, 1e-5)
        x = found.x[0]
        r, J = functions[2](x)
    if not np.isfinite(r).all():
        raise InputError(
            "`observations`: the simulation diverges from the fit of torques: shorten `horizon`, "
            "or choose terms of the model that these logs determine."
        )
    uncertainty = _uncertainty(r, J[free], windows.blocks)
    rms = np.sqrt(np.mean(r**2, axis=(0, 2)))
    return TorqueRolloutFit(rollout, x, free, uncertainty, horizon, rms, first)


def _uncertainty(r: np.ndarray, J: np.ndarray, part: np.ndarray) -> Uncertainty:
    """Return the uncertainty from residuals and their derivatives, windows on the last axis."""
    blocks = [
        (J[..., part == k].reshape(len(J), -1).T, r[..., part == k].ravel())
        for k in np.unique(part)
    ]
    flat = J.reshape(len(J), -1)
    inverse = np.linalg.pinv(flat @ flat.T, rcond=1e-12, hermitian=True)
    covariance, dof = block_covariance(blocks, inverse)
    return Uncertainty(covariance, np.full(len(J), dof), inverse * float(np.mean(r**2)))


def _limits(start: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of the unknowns: delays within the margin, positive gains."""
    wide = np.full(len(start), np.inf)
    low, high = -wide, wide.copy()
    low[size], high[size] = -0.8 * MARGIN, 0.8 * MARGIN
    low[size + 1 :] = 0.0
    return low, high


def _compiled(
    rollout: TorqueRollout, windows: Windows, free: np.ndarray, every: int
) -> tuple[Callable, Callable, Callable]:
    """Return moments, costs, and residuals with their derivatives, for a batch of one."""
    data, index = windows._replace(blocks=None), np.flatnonzero(free)

    def residuals(x, data):
        return rollout.errors(x, data)[every - 1 :: every]

    @jax.jit
    def derivatives(x, data):
        def along(direction):
            return jax.jvp(lambda x: residuals(x, data), (x,), (direction,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(x))[index])

    cost = jax.jit(lambda x, data: jnp.sum(residuals(x, data) ** 2))

    def linearised(x):
        r, found = (np.asarray(y) for y in derivatives(jnp.asarray(x), data))
        J = np.zeros((len(x), *r.shape))
        J[index] = found
        return r, J

    def moments(x, _):
        r, J = linearised(x[0])
        flat = J.reshape(len(J), -1)
        return np.array([np.sum(r**2)]), (flat @ r.ravel())[None], (flat @ flat.T)[None]

    def costs(x, _):
        found = float(cost(jnp.asarray(x[0]), data))
        return np.array([found if np.isfinite(found) else np.inf])

    return moments, costs, linearised
