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

from jaxid.arrays import AnyArray, Array, Matrix, Vector, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.sample_methods import program_of
from jaxid.dynamics.terms import HardSign
from jaxid.errors import InputError
from jaxid.identification.identify import identify
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.least_squares import minimise_squares
from jaxid.measurement.observations import Observations
from jaxid.program.xla import lower
from jaxid.result_table import Column, Summarised, Table, with_deviations

from .torque_windows import MARGIN, SLIDING_SPEED, Windows

COUNTED_STEP = 5
"""Samples of a window from one that counts to the next."""


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

    def errors(self, x: Array, windows: Windows) -> Array:
        """Return simulated less measured positions [steps, joints, windows]."""
        forces = jnp.asarray(windows.forces)
        _, delay, _, _ = self._parts(x)
        margin = round(MARGIN / self.sample_time)
        steps = jnp.arange(len(forces) - 2.0 * margin)
        samples = margin + steps - delay / self.sample_time
        delayed_forces = _interpolate(
            forces, jnp.clip(samples, 0.0, len(forces) - 1.001)
        )
        return self._positions(x, windows, delayed_forces) - windows.measured

    def _parts(self, x: Array) -> list[Array]:
        """Return base parameters, delay, gains, and friction by torque."""
        n = self.base.model.robot.joints
        return jnp.split(x, np.cumsum([self.base.size, 1, n]))

    def _positions(self, x: Array, windows: Windows, forces: Array) -> Array:
        """Return simulated positions, by the Runge-Kutta method of order four.

        They are an array [steps, joints, windows].
        """
        step_size = self.sample_time
        base_parameters, _, gains, load_friction = self._parts(x)
        p = self.base.to_standard(base_parameters)[:, None]
        acceleration = self._acceleration

        def rate(state, measured_forces):
            q, qd = state
            driving_torques = gains[:, None] * measured_forces
            # Gear friction grows with the torque that it carries.
            friction = load_friction[:, None] * jnp.abs(driving_torques)
            forces = driving_torques - friction * jnp.tanh(qd / SLIDING_SPEED)
            return qd, jnp.stack(acceleration(p, q, qd, forces))

        def advance(state, rate, time):
            return jax.tree.map(lambda y, r: y + time * r, state, rate)

        def step(state, end_forces):
            first_forces, last_forces = end_forces
            middle_forces = 0.5 * (first_forces + last_forces)
            k1 = rate(state, first_forces)
            k2 = rate(advance(state, k1, 0.5 * step_size), middle_forces)
            k3 = rate(advance(state, k2, 0.5 * step_size), middle_forces)
            k4 = rate(advance(state, k3, step_size), last_forces)
            mean_rate = jax.tree.map(
                lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4
            )
            state = advance(state, mean_rate, step_size)
            return state, state[0]

        start = jnp.asarray(windows.q), jnp.asarray(windows.qd)
        _, positions = jax.lax.scan(step, start, (forces[:-1], forces[1:]))
        return positions

    @functools.cached_property
    def _acceleration(self) -> Callable:
        """Accelerations of samples by scalar operations; JAX differentiates them."""
        model = self.base.model
        joints = (model.robot.joints,)
        return lower(
            program_of(model, model.acceleration, (model.size,), *[joints] * 3), False
        )


def _interpolate(series: Array, instants: Array) -> Array:
    """Return a series at fractions of its samples along the first axis."""
    floors = jnp.floor(instants)
    k = floors.astype(int)
    fractions = (instants - floors).reshape(-1, *[1] * (series.ndim - 1))
    return series[k] + fractions * (series[k + 1] - series[k])


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
    """

    rollout: TorqueRollout
    unknowns: Vector
    free: np.ndarray
    uncertainty: Uncertainty
    horizon: float
    rms: Vector
    start: Vector

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints."""
        return self.rollout.base.model.robot.joint_names

    @property
    def parameters(self) -> Vector:
        """Base parameters."""
        return self.unknowns[: self.rollout.base.size]

    def errors_at(
        self,
        observations: Sequence[Observations] | Observations,
        horizon: float,
        parameters: AnyArray | None = None,
    ) -> Vector:
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
        Vector,
        Matrix,
        Matrix,
    ]:
        """Return times, measured and simulated positions of consecutive windows.

        Behind each window a sample of the simulation is NaN.
        """
        windows = Windows.of([log], self.horizon, self.horizon)
        with double_precision():
            errors = jax.jit(self.rollout.errors)(jnp.asarray(self.unknowns), windows)
        start = windows.q[None]
        gap = np.full(start.shape, np.nan)
        measured_positions = np.concatenate(
            [start, windows.measured, windows.measured[-1:]]
        )
        simulated_positions = np.concatenate(
            [start, windows.measured + np.asarray(errors), gap]
        )
        # The gap has the time of the last sample.
        count = len(measured_positions)
        steps = np.minimum(np.arange(count), count - 2)
        time = log.time[windows.starts + steps[:, None]].T.ravel()
        measured_positions, simulated_positions = (
            x.transpose(2, 0, 1).reshape(len(time), -1)
            for x in (measured_positions, simulated_positions)
        )
        return time, measured_positions, simulated_positions

    def summary(self) -> Table:
        """Return a table of the estimates with 95 % intervals."""
        names = [
            name
            for name, is_free in zip(self.rollout.names, self.free, strict=True)
            if is_free
        ]
        deviations = self.uncertainty.standard_deviations
        values, deviation_texts = with_deviations(self.unknowns[self.free], deviations)
        half_widths = self.uncertainty.half_widths()
        ends = [
            with_deviations(self.unknowns[self.free] + s * half_widths, deviations)[0]
            for s in (-1, 1)
        ]
        errors = "  ".join(f"{1e3 * x:.3g}" for x in self.rms)
        return Table(
            "open-loop rollouts",
            Column("parameter", names),
            Column("estimate", values, kind="number"),
            Column("±", deviation_texts, kind="number"),
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
) -> TorqueRolloutFit:
    """Identify a robot whose simulation under recorded torques follows the positions.

    The search starts from the fit of torques. Windows overlap by four fifths.

    Args:
        base: Base parameters of the model; dry friction must be smooth.
        observations: Filtered logs with torques.
        horizon: Length of the windows [s].
        gains: Whether the gains of the other joints' torques, relative to the first
            joint's, are estimated. A gain common to all scales all parameters, and no
            log tells it.
        load_friction: Whether friction that grows with the torque is estimated.

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
    joints = base.model.robot.joints
    torque_fit = np.asarray(identify(base, logs).parameters)
    start = rollout.start(torque_fit)
    free_mask = np.repeat([True, gains, load_friction], [base.size + 1, joints, joints])
    # All torques, masses and friction can be scaled together: the first gain is 1.
    free_mask[base.size + 1] = False
    free_unknowns = np.flatnonzero(free_mask)

    # Constants of the compiled program, the same for all logs of a robot.
    fixed_unknowns = rollout.start(np.zeros_like(torque_fit))

    def residuals(values, windows):
        unknowns = jnp.asarray(fixed_unknowns).at[free_unknowns].set(values)
        return rollout.errors(unknowns, windows)[
            COUNTED_STEP - 1 :: COUNTED_STEP
        ].ravel()

    lower, upper = _limits(rollout)
    with double_precision():
        minimum = minimise_squares(
            residuals,
            start[free_mask],
            lower[free_mask],
            upper[free_mask],
            args=windows,
            rtol=1e-5,
            max_steps=50,
        )
    unknowns = start.copy()
    unknowns[free_mask] = minimum.x
    errors = np.asarray(minimum.residuals).reshape(-1, joints, windows.q.shape[1])
    rms = np.sqrt(np.mean(errors**2, axis=(0, 2)))
    if not np.isfinite(rms).all():
        raise InputError(
            "`observations`: the simulation diverges from the fit of torques: shorten "
            "`horizon`, or choose terms of the model that these logs determine."
        )
    blocks = np.broadcast_to(windows.blocks, errors.shape).ravel()
    jacobian = np.asarray(minimum.jacobian)
    uncertainty = _uncertainty(errors.ravel(), jacobian, blocks)
    return TorqueRolloutFit(
        rollout, unknowns, free_mask, uncertainty, horizon, rms, torque_fit
    )


def _require_simulation(base: BaseParameters) -> None:
    """Check that the model's accelerations are smooth in states and torques."""
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
            "as part of the body that carries it."
        )


def _uncertainty(
    residuals: np.ndarray, jacobian: np.ndarray, block_numbers: np.ndarray
) -> Uncertainty:
    """Return the uncertainty from residuals, their derivatives, parts of the logs."""
    blocks = [
        (jacobian[block_numbers == k], residuals[block_numbers == k])
        for k in np.unique(block_numbers)
    ]
    information = jacobian.T @ jacobian
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    covariance, degrees_of_freedom = block_covariance(blocks, inverse)
    naive_covariance = inverse * float(np.mean(residuals**2))
    return Uncertainty(
        covariance, np.full(len(inverse), degrees_of_freedom), naive_covariance
    )


def _limits(rollout: TorqueRollout) -> tuple[np.ndarray, np.ndarray]:
    """Return limits of the unknowns: delays within the margin, positive gains."""
    delay = rollout.base.size
    lower_limits = np.full(len(rollout.names), -np.inf)
    upper_limits = np.full(len(rollout.names), np.inf)
    lower_limits[delay] = -0.8 * MARGIN
    upper_limits[delay] = 0.8 * MARGIN
    lower_limits[delay + 1 :] = 0.0
    return lower_limits, upper_limits
