r"""Open-loop rollouts: recorded torques in, positions out, by multiple shooting.

Windows of a given horizon start from measured states. The parameters are those for
which their simulated ends lie on the measured positions: unlike a fit of torques at
measured accelerations, it needs no second derivative, and errors that add up over the
horizon count.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.terms import HardSign
from jaxid.errors import InputError
from jaxid.identification.identify import identify
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.measurement.observations import Observations, joined
from jaxid.program.xla import lower
from jaxid.result_table import Column, Summarised, Table, with_deviations

from .least_squares import minimise
from .torque_windows import MARGIN, SLIDING, TorqueRows, Windows


@dataclasses.dataclass(frozen=True)
class TorqueRollout:
    """Robot whose recorded torques are applied, and the unknowns of its simulation.

    The unknowns: base parameters, delay of the torques [s], gain of each joint's
    torque, friction of each joint per torque.

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

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the unknowns."""
        return (*self.base.units, "s", *["1"] * (2 * self.base.model.robot.joints))

    def start(self, p: AnyArray) -> np.ndarray:
        """Return the unknowns without delay, with gains of 1."""
        n = self.base.model.robot.joints
        return np.concatenate([np.asarray(p), np.zeros(1), np.ones(n), np.zeros(n)])

    def errors(
        self, x: Array, windows: Windows
    ) -> Float[Array, "steps joints windows"]:
        """Return simulated less measured positions, by the Runge-Kutta method of order four."""
        forces, h = jnp.asarray(windows.forces), self.sample_time
        margin = round(MARGIN / h)
        at = margin + jnp.arange(len(forces) - 2.0 * margin) - self._parts(x)[1] / h
        late = _between(forces, jnp.clip(at, 0.0, len(forces) - 1.001))
        start = jnp.asarray(windows.q), jnp.asarray(windows.qd)
        return self._integrate(x, start, (late,))[0] - windows.measured

    def torque_errors(self, x: Array, rows: TorqueRows) -> Float[Array, "rows joints"]:
        """Return predicted less measured torques at the measured motion; zero if not counted."""
        p, delay, gains, load = self._parts(x)
        count = len(rows.forces)
        at = jnp.clip(
            jnp.arange(1.0 * count) - delay / rows.row_time, 0.0, count - 1.001
        )
        forces, friction = (
            _between(jnp.asarray(y), at) for y in (rows.forces, rows.load)
        )
        torques = gains[None] * forces - load[None] * friction
        return jnp.where(rows.counted, jnp.asarray(rows.columns) @ p - torques, 0.0)

    def follow(
        self, p: AnyArray, logs: Sequence[Observations], bandwidth: float
    ) -> tuple[Motion, ...]:
        """Return simulations of whole logs, which a controller keeps near the measured motions.

        Args:
            p: Base parameters.
            logs: Filtered logs with torques.
            bandwidth: Double pole of the closed loop [rad/s].
        """

        def simulated(o: Observations, a: int, b: int) -> Motion:
            m, forces = o.read(slice(a, b))
            inputs = (np.asarray(y)[..., None] for y in (m.q, m.qd, forces))
            found = _follow(self, jnp.asarray(self.start(p)), *inputs, float(bandwidth))
            return Motion(*(np.asarray(y)[..., 0] for y in found))

        with double_precision():
            return tuple(
                joined(simulated(o, *span) for span in o.segments) for o in logs
            )

    def _parts(self, x: Array) -> list[Array]:
        """Return base parameters, delay, gains, and friction by torque."""
        n = self.base.model.robot.joints
        return jnp.split(x, np.cumsum([self.base.size, 1, n]))

    def _integrate(
        self,
        x: Array,
        start: tuple[Array, Array],
        inputs: tuple[Array, ...],
        bandwidth: Array | float = 0.0,
    ) -> Sequence[Array]:
        """Return positions and velocities behind each step, and accelerations before it.

        Args:
            x: Unknowns.
            start: Initial positions and velocities [joints, windows].
            inputs: Torques, and positions and velocities to follow, if any.
            bandwidth: Double pole of the controller that follows [rad/s].
        """
        h, acceleration = self.sample_time, self._acceleration
        p, _, gains, load = self._parts(x)
        p, gains, load = (
            self.base.to_standard(p)[:, None],
            gains[:, None],
            load[:, None],
        )

        def rate(state, inputs):
            q, qd = state
            u, *measured = inputs
            # Gear friction grows with the torque that it carries.
            u = gains * u - load * jnp.abs(u) * jnp.tanh(qd / SLIDING)
            pulls = zip((bandwidth**2, 2.0 * bandwidth), measured, state, strict=False)
            return qd, jnp.stack(acceleration(p, q, qd, u)) + sum(
                k * (m - y) for k, m, y in pulls
            )

        def moved(state, rate, time):
            return jax.tree.map(lambda y, r: y + time * r, state, rate)

        def step(state, inputs):
            first, last = inputs
            middle = jax.tree.map(lambda a, b: 0.5 * (a + b), first, last)
            k1 = rate(state, first)
            k2 = rate(moved(state, k1, 0.5 * h), middle)
            k3 = rate(moved(state, k2, 0.5 * h), middle)
            k4 = rate(moved(state, k3, h), last)
            mean = jax.tree.map(
                lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4
            )
            state = moved(state, mean, h)
            return state, (*state, k1[1])

        ends = ([y[part] for y in inputs] for part in (slice(-1), slice(1, None)))
        return jax.lax.scan(step, start, tuple(ends))[1]

    @functools.cached_property
    def _acceleration(self) -> Callable:
        """Accelerations of many samples in scalar operations, which JAX differentiates."""
        model = self.base.model
        joints = (model.robot.joints,)
        return lower(
            program_of(model, model.acceleration, (model.size,), *[joints] * 3), False
        )


def _between(series: Array, at: Array) -> Array:
    """Return a series at fractions of its samples along the first axis."""
    whole = jnp.floor(at)
    k, part = whole.astype(int), (at - whole).reshape(-1, *[1] * (series.ndim - 1))
    return series[k] + part * (series[k + 1] - series[k])


@functools.partial(jax.jit, static_argnums=0)
def _follow(
    rollout: TorqueRollout,
    x: Array,
    q: Array,
    qd: Array,
    forces: Array,
    bandwidth: Array | float,
) -> Sequence[Array]:
    """Return simulated positions, velocities and accelerations [samples, joints, segments]."""
    after = rollout._integrate(x, (q[0], qd[0]), (forces, q, qd), bandwidth)
    begun = (jnp.concatenate([y[:1], z]) for y, z in zip((q, qd), after, strict=False))
    return (*begun, jnp.concatenate([after[2], after[2][-1:]]))


@dataclasses.dataclass(frozen=True)
class TorqueRolloutFit(Summarised):
    """Parameters for which open-loop simulations follow the measured positions.

    Attributes:
        rollout: Robot and unknowns.
        unknowns: Estimates, in the order of `rollout.names`.
        free: Unknowns that were estimated.
        uncertainty: Uncertainty of these, from the scatter of parts of the logs.
        horizon: Horizon of the windows [s].
        rms: Errors of the identification over the windows [rad or m].
        start: Base parameters of the fit of torques from which the search started.
        torque_rows: Whether errors of torques counted as well.
    """

    rollout: TorqueRollout
    unknowns: Float[np.ndarray, " unknowns"]
    free: np.ndarray
    uncertainty: Uncertainty
    horizon: float
    rms: Float[np.ndarray, " joints"]
    start: Float[np.ndarray, " base"]
    torque_rows: bool = False

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
            parameters: Other base parameters, without delay and gains, such as those of
                a fit of torques; those of this fit if None.
        """
        logs = (
            [observations] if isinstance(observations, Observations) else observations
        )
        windows = Windows.of(logs, horizon, 0.04)
        x = self.unknowns if parameters is None else self.rollout.start(parameters)
        with double_precision():
            errors = jax.jit(self.rollout.errors)(jnp.asarray(x), windows)
        return np.sqrt(np.mean(np.asarray(errors)[-1] ** 2, axis=-1))

    def simulate(
        self, log: Observations
    ) -> tuple[
        Float[np.ndarray, " samples"],
        Float[np.ndarray, "samples joints"],
        Float[np.ndarray, "samples joints"],
    ]:
        """Return times, measured and simulated positions of windows that follow each other.

        Behind each window a sample of the simulation is NaN.
        """
        windows = Windows.of([log], self.horizon, self.horizon)
        with double_precision():
            errors = jax.jit(self.rollout.errors)(jnp.asarray(self.unknowns), windows)
        start, gap = windows.q[None], np.full((1, *windows.q.shape), np.nan)
        measured = np.concatenate([start, windows.measured, windows.measured[-1:]])
        simulated = np.concatenate([start, windows.measured + np.asarray(errors), gap])
        steps = np.minimum(np.arange(len(measured)), len(measured) - 2)
        time = log.time[windows.starts + steps[:, None]].T.ravel()
        measured, simulated = (
            x.transpose(2, 0, 1).reshape(len(time), -1) for x in (measured, simulated)
        )
        return time, measured, simulated

    def torque_errors(
        self,
        observations: Sequence[Observations] | Observations,
        parameters: AnyArray | None = None,
    ) -> Float[np.ndarray, " joints"]:
        """Return the root mean square error of torques at the measured motion [N m or N].

        The arguments are those of `errors_at`.
        """
        logs = (
            [observations] if isinstance(observations, Observations) else observations
        )
        x = self.unknowns if parameters is None else self.rollout.start(parameters)
        rows = TorqueRows.of(self.rollout.base, logs)
        with double_precision():
            errors = np.asarray(self.rollout.torque_errors(jnp.asarray(x), rows))
            gains = np.asarray(self.rollout._parts(jnp.asarray(x))[2])
        return np.sqrt(np.sum(errors**2, axis=0) / rows.counted.sum(axis=0)) / gains

    def summary(self) -> Table:
        """Return a table of the estimates with 95 % intervals."""
        names = [
            name
            for name, free in zip(self.rollout.names, self.free, strict=True)
            if free
        ]
        deviations = self.uncertainty.standard_deviations
        values, shown = with_deviations(self.unknowns[self.free], deviations)
        half = self.uncertainty.half_widths()
        ends = [
            with_deviations(self.unknowns[self.free] + s * half, deviations)[0]
            for s in (-1, 1)
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


def identify_torque_rollout(
    base: BaseParameters,
    observations: Sequence[Observations] | Observations,
    *,
    horizon: float = 0.2,
    gains: bool = False,
    load_friction: bool = False,
    torque_rows: bool = False,
    every: int = 5,
) -> TorqueRolloutFit:
    """Identify a robot so that its simulation under recorded torques follows the positions.

    The search starts from the fit of torques. Windows overlap by four fifths.

    Args:
        base: Base parameters of the model; dry friction must be smooth.
        observations: Filtered logs with torques.
        horizon: Length of the windows [s].
        gains: Whether the gains of the other joints' torques, relative to the first
            joint's, are estimated. A gain common to all scales all parameters, and no
            log tells it.
        load_friction: Whether friction that grows with the torque is estimated.
        torque_rows: Whether errors of the torques at the measured motion count as well.
            Positions and torques of each joint are divided by the standard deviation of
            their errors.
        every: Number of samples from one that counts to the next.

    Raises:
        InputError: If there is no window of the horizon, or the model cannot be
            simulated.
    """
    logs = (
        [observations] if isinstance(observations, Observations) else list(observations)
    )
    _require_simulation(base)
    rollout = TorqueRollout(base, logs[0].sample_time)
    windows = Windows.of(logs, horizon, 0.2 * horizon)
    rows = TorqueRows.of(base, logs) if torque_rows else None
    first, n = np.asarray(identify(base, logs).parameters), base.model.robot.joints
    free = np.concatenate(
        [np.ones(base.size + 1), np.full(n, gains), np.full(n, load_friction)]
    ).astype(bool)
    # All torques, masses and friction can be scaled together: the first gain is 1.
    free[base.size + 1] = False
    objective = _Objective(rollout, windows, rows, free, every)
    x, limits = rollout.start(first), _limits(rollout.start(first), base.size)
    # At first positions count alone.
    weights = objective.weights(np.repeat([1.0, np.inf], n))
    with double_precision():
        x = objective.minimum(x, weights, free, limits)
        for _ in range(2 if torque_rows else 0):
            weights = objective.weights(objective.sizes(x))
            x = objective.minimum(x, weights, free, limits)
        sizes = objective.sizes(x)
        r, J = objective.linearised(x, weights)
    if not np.isfinite(sizes).all():
        raise InputError(
            "`observations`: the simulation diverges from the fit of torques: shorten "
            "`horizon`, "
            "or choose terms of the model that these logs determine."
        )
    uncertainty = _uncertainty(r, J[free], objective.blocks)
    return TorqueRolloutFit(
        rollout, x, free, uncertainty, horizon, sizes[:n], first, torque_rows
    )


def _require_simulation(base: BaseParameters) -> None:
    """Check that the model has accelerations that are smooth functions of state and torques."""
    model = base.model
    leaves = jax.tree.leaves(model.terms, is_leaf=lambda x: isinstance(x, HardSign))
    if model.memory is not None or any(isinstance(x, HardSign) for x in leaves):
        raise InputError(
            "`base`: dry friction must be smooth in a simulation: use `Tanh(0.1)` "
            "(`[model.coulomb] epsilon = 0.1` in an experiment file), no sign and no "
            "presliding."
        )
    if model.robot.tool is not None:
        raise InputError(
            "`base`: a known tool is not simulated: leave `tool` out, and it counts "
            "as part of the "
            "body that carries it."
        )


def _uncertainty(r: np.ndarray, J: np.ndarray, part: np.ndarray) -> Uncertainty:
    """Return the uncertainty from residuals, their derivatives, and parts of the logs."""
    blocks = [(J[:, part == k].T, r[part == k]) for k in np.unique(part)]
    inverse = np.linalg.pinv(J @ J.T, rcond=1e-12, hermitian=True)
    covariance, dof = block_covariance(blocks, inverse)
    return Uncertainty(covariance, np.full(len(J), dof), inverse * float(np.mean(r**2)))


def _limits(start: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of the unknowns: delays within the margin, positive gains."""
    wide = np.full(len(start), np.inf)
    low, high = -wide, wide.copy()
    low[size], high[size] = -0.8 * MARGIN, 0.8 * MARGIN
    low[size + 1 :] = 0.0
    return low, high


class _Objective:
    """Errors of positions in windows, and of torques if their rows are given, in one vector.

    Attributes:
        kinds: Kind of each error: the joint of a position, joints + the joint of a
            torque; one more if it does not count.
        blocks: Part of the logs to which each error belongs.
    """

    def __init__(
        self,
        rollout: TorqueRollout,
        windows: Windows,
        rows: TorqueRows | None,
        free: np.ndarray,
        every: int,
    ):
        index, self._data = np.flatnonzero(free), (windows, rows)
        shape, n = windows.measured[every - 1 :: every].shape, len(windows.q)
        parts = [
            np.broadcast_arrays(np.arange(n)[:, None], windows.blocks, np.zeros(shape))
        ]
        if rows is not None:
            kinds = np.where(rows.counted, n + np.arange(n), 2 * n)
            parts.append(np.broadcast_arrays(kinds, rows.blocks[:, None], kinds))
        self.kinds, self.blocks, _ = (
            np.concatenate([x.ravel() for x in each])
            for each in zip(*parts, strict=True)
        )

        def residuals(x, data, weights):
            windows, rows = data
            found = [rollout.errors(x, windows)[every - 1 :: every].ravel()]
            if rows is not None:
                found.append(rollout.torque_errors(x, rows).ravel())
            return weights * jnp.concatenate(found)

        def derivatives(x, *inputs):
            def along(direction):
                return jax.jvp(lambda x: residuals(x, *inputs), (x,), (direction,))

            r, found = jax.vmap(along, out_axes=(None, 0))(jnp.eye(len(x))[index])
            return r, jnp.zeros((len(x), len(r))).at[index].set(found)

        self._residuals, self._derivatives = jax.jit(residuals), jax.jit(derivatives)

    def weights(self, sizes: np.ndarray) -> np.ndarray:
        """Return the reciprocal size of each error; zero if it does not count."""
        return np.append(1.0 / np.maximum(sizes, 1e-12), 0.0)[self.kinds]

    def sizes(self, x: np.ndarray) -> np.ndarray:
        """Return root mean squares of the errors of all joints' positions, then of torques."""
        r = np.asarray(
            self._residuals(jnp.asarray(x), self._data, np.ones(len(self.kinds)))
        )
        count = 2 * len(self._data[0].q) + 1
        squares, counts = (
            np.bincount(self.kinds, y, count) for y in (r**2, np.ones(len(r)))
        )
        return np.sqrt(squares / np.maximum(counts, 1.0))[:-1]

    def linearised(
        self, x: np.ndarray, weights: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return weighted errors, and their derivatives by all unknowns [unknowns, errors]."""
        r, J = self._derivatives(jnp.asarray(x), self._data, weights)
        return np.asarray(r), np.asarray(J)

    def minimum(
        self, x: np.ndarray, weights: np.ndarray, free: np.ndarray, limits: tuple
    ):
        """Return the unknowns with the least sum of squares."""

        def moments(x, _):
            r, J = self.linearised(x[0], weights)
            return np.array([np.sum(r**2)]), (J @ r)[None], (J @ J.T)[None]

        def costs(x, _):
            r = np.asarray(self._residuals(jnp.asarray(x[0]), self._data, weights))
            return np.nan_to_num(np.array([np.sum(r**2)]), nan=np.inf)

        return minimise(moments, costs, x[None], free[None], limits, 25, 1e-5).x[0]
