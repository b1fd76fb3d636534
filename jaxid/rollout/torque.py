r"""Open-loop rollouts: recorded torques in, positions out, by multiple shooting.

Windows of a given horizon start from measured states. The parameters are those for
which their simulated ends lie on the measured positions: unlike a fit of torques at
measured accelerations, it needs no second derivative, and errors that add up over the
horizon count.
"""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Vector, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.terms import HardSign
from jaxid.errors import InputError
from jaxid.identification.identify import identify
from jaxid.identification.run_to_run import Run
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.blocks import block_covariance
from jaxid.least_squares import Minimum, search_squares
from jaxid.measurement.observations import Observations
from jaxid.program.sample_methods import program_of
from jaxid.program.xla import lower
from jaxid.result_table import Column, Summarised, Table, estimate_columns

from .errors import RolloutErrors

MARGIN = 0.05
"""Time before and behind a window for which its torques are known, for delays [s]."""
MAX_DELAY = 0.8 * MARGIN
"""Largest delay of the torques, either way [s]."""
COUNTED_STEP = 5
"""Samples of a window from one that counts to the next."""
SHARES = (0.0, 0.5, 0.5, 1.0)
"""Part of a step at whose end each stage of the Runge-Kutta method is evaluated."""
WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)
"""Weights of the stages in a step."""
MAX_DERIVATIVES = 4_000_000
"""Largest number of derivatives of positions; they take 32 MB."""
MAX_STEPS = 50
"""Largest number of steps of the search."""
BLOCKS = 40
"""Contiguous parts of the logs whose scatter gives the uncertainty."""

Logs = Sequence[Observations] | Observations


class Windows(NamedTuple):
    """Windows of logs, all of one length.

    The windows are the last axis, which makes the loops over them fast.

    Attributes:
        q: Initial positions [joints, windows].
        qd: Initial velocities.
        forces: Torques, with a margin at both ends [samples, joints, windows].
        measured: Measured positions behind the first sample [steps, joints, windows].
        starts: Sample at which each window starts, counted through all logs.
    """

    q: AnyArray
    qd: AnyArray
    forces: AnyArray
    measured: AnyArray
    starts: np.ndarray

    @classmethod
    def of(
        cls, logs: Sequence[Observations], horizon: float, spacing: float
    ) -> "Windows":
        """Return windows of a horizon [s], whose starts are `spacing` [s] apart."""
        dt = logs[0].sample_time
        if any(abs(log.sample_time - dt) > 0.01 * dt for log in logs):
            raise InputError("`observations` must have one sample time.")
        steps = max(1, round(horizon / dt))
        stride = max(1, round(spacing / dt))
        margin = round(MARGIN / dt)
        offsets = np.arange(-margin, steps + margin + 1)[:, None]
        parts = []
        count = 0
        for log in logs:
            edge = log.filter.edge(dt) + margin
            ranges = [
                np.arange(a + edge, b - edge - steps, stride) for a, b in log.segments
            ]
            starts = np.concatenate(ranges)
            q, qd, forces = map(np.asarray, (log.motion.q, log.motion.qd, log.forces))
            samples = starts + offsets
            window_forces = forces[samples].swapaxes(1, 2)
            measured = q[samples[margin + 1 : -margin]].swapaxes(1, 2)
            place = starts + count
            parts.append((q[starts].T, qd[starts].T, window_forces, measured, place))
            count += len(q)
        windows = cls(*(np.concatenate(x, axis=-1) for x in zip(*parts, strict=True)))
        if not windows.starts.size:
            raise InputError(
                f"`observations` hold no window of {horizon:g} s: shorten `horizon`."
            )
        return windows


@dataclasses.dataclass(frozen=True)
class TorqueRollout:
    """Robot whose recorded torques are applied.

    Unknowns of its simulation are the base parameters, and the delay of the torques
    [s].

    Attributes:
        base: Base parameters of the model.
        sample_time: Time between two samples [s].
    """

    base: BaseParameters
    sample_time: float

    def errors(self, unknowns: Array, windows: Windows) -> Array:
        """Return simulated less measured positions [steps, joints, windows]."""
        forces = jnp.asarray(windows.forces)
        margin = round(MARGIN / self.sample_time)
        steps = jnp.arange(len(forces) - 2.0 * margin)
        instants = margin + steps - unknowns[-1] / self.sample_time
        floors = jnp.floor(instants)
        shares = (instants - floors)[:, None, None]
        k = floors.astype(int)
        delayed_forces = (1.0 - shares) * forces[k] + shares * forces[k + 1]
        positions = self._positions(unknowns[:-1], windows, delayed_forces)
        return positions - windows.measured

    def _positions(
        self, base_parameters: Array, windows: Windows, forces: Array
    ) -> Array:
        """Return simulated positions, by the Runge-Kutta method of order four.

        They are an array [steps, joints, windows].
        """
        h = self.sample_time
        p = self.base.to_standard(base_parameters)[:, None]
        acceleration = self._acceleration

        def rate(state: Array, torques: Array) -> Array:
            q, qd = state
            return jnp.stack([qd, acceleration(p, q, qd, torques)])

        def step(state: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            first_forces, last_forces = ends
            middle_forces = 0.5 * (first_forces + last_forces)
            stage_forces = (first_forces, middle_forces, middle_forces, last_forces)

            # A loop: the dynamics of a robot are long, and are compiled once.
            def advance(carry: tuple[Array, Array], inputs: Any) -> Any:
                slope, change = carry
                torques, share, weight = inputs
                slope = rate(state + share * h * slope, torques)
                return (slope, change + weight * h * slope), None

            start = jnp.zeros_like(state), jnp.zeros_like(state)
            inputs = jnp.stack(stage_forces), jnp.array(SHARES), jnp.array(WEIGHTS)
            (_, change), _ = jax.lax.scan(advance, start, inputs)
            state = state + change
            return state, state[0]

        start = jnp.stack([windows.q, windows.qd])
        _, positions = jax.lax.scan(step, start, (forces[:-1], forces[1:]))
        return positions

    @functools.cached_property
    def _acceleration(self) -> Callable:
        """Accelerations of samples that forces cause, by scalar operations.

        A change of the acceleration is that of the forces which the motion needs, over
        the mass matrix: so the matrix and its factors need no derivatives.
        """
        model = self.base.model
        size = (model.size,)
        joints = (model.robot.joints,)
        forces = program_of(model, model.forces, size, *[joints] * 3)
        forces_of = lower(forces, False).dense
        inertia_of = lower(program_of(model, model.inertia, size, joints), False).dense

        @jax.custom_jvp
        def acceleration(p: Array, q: Array, qd: Array, torques: Array) -> Any:
            bias = forces_of(p, q, qd, jnp.zeros_like(q))
            return _solve_mass_matrix(inertia_of(p, q), torques - bias)

        @acceleration.defjvp
        def derivative(primals: Any, tangents: Any) -> Any:
            p, q, qd, _ = primals
            qdd = acceleration(*primals)
            _, change = jax.jvp(
                lambda *x: forces_of(*x, qdd), (p, q, qd), tuple(tangents[:3])
            )
            return qdd, _solve_mass_matrix(inertia_of(p, q), tangents[3] - change)

        return acceleration


def _solve_mass_matrix(inertia: Array, forces: Array) -> Array:
    """Return the accelerations by forces [joints, windows].

    Args:
        inertia: Mass matrices [joints, joints, windows].
        forces: Forces [joints, windows].
    """
    # Written out for its entries, XLA would compute the factors again for each use.
    factor = jnp.linalg.cholesky(jnp.moveaxis(inertia, -1, 0))
    columns = forces.T[..., None]
    return jax.scipy.linalg.cho_solve((factor, True), columns)[..., 0].T


@dataclasses.dataclass(frozen=True)
class TorqueRolloutFit(Summarised):
    """Parameters for which open-loop simulations follow the measured positions.

    Attributes:
        rollout: Robot and unknowns.
        unknowns: Base parameters, and the delay of the torques [s].
        uncertainty: Uncertainty of these, from the scatter of parts of the logs.
        horizon: Horizon of the windows [s].
        start: Base parameters of the fit of torques from which the search started.
        converged: Whether the search ended by itself; Ctrl-C ends it before.
    """

    rollout: TorqueRollout
    unknowns: Vector
    uncertainty: Uncertainty
    horizon: float
    start: Vector
    converged: bool

    @property
    def run(self) -> Run:
        """Estimates, as `jid.agreement` takes them."""
        base = self.rollout.base
        return Run(
            name=base.model.robot.name,
            names=(*base.names, "delay"),
            units=(*base.units, "s"),
            kinds=(*base.kinds, "delay"),
            parameters=self.unknowns,
            covariance=self.uncertainty.covariance,
            dof=float(np.median(self.uncertainty.dof)),
        )

    @property
    def parameters(self) -> Vector:
        """Base parameters."""
        return self.unknowns[:-1]

    def errors_at(
        self, observations: Logs, horizon: float, parameters: AnyArray | None = None
    ) -> Vector:
        """Return the root mean square error at the ends of windows [rad or m].

        Args:
            observations: Logs, which the fit need not have seen.
            horizon: Length of the windows [s].
            parameters: Other base parameters, without delay, such as those of a fit of
                torques; those of this fit if None.
        """
        windows = Windows.of(_listed(observations), horizon, 0.04)
        errors = self._errors(windows, parameters)
        return np.sqrt(np.mean(errors[-1] ** 2, axis=-1))

    def _errors(self, windows: Windows, parameters: AnyArray | None) -> np.ndarray:
        """Return errors in windows with these base parameters, or those of the fit."""
        unknowns = self.unknowns
        if parameters is not None:
            unknowns = np.append(np.asarray(parameters), 0.0)
        with double_precision():
            return np.asarray(jax.jit(self.rollout.errors)(unknowns, windows))

    def validate(self, observations: Logs) -> RolloutErrors:
        """Compare simulations with logs, in consecutive windows from measured states.

        Args:
            observations: Logs, which the fit need not have seen.
        """
        logs = _listed(observations)
        times = []
        paths = []
        for log in logs:
            windows = Windows.of([log], self.horizon, self.horizon)
            measured = windows.measured
            errors = [self._errors(windows, p) for p in (None, self.start)]
            # Windows follow each other along one axis of samples.
            paths.append(
                [
                    path.transpose(1, 2, 0).reshape(path.shape[1], -1)
                    for path in (measured, *(measured + x for x in errors))
                ]
            )
            steps = np.arange(1, len(measured) + 1)
            times.append(log.time[windows.starts[:, None] + steps].ravel())
        measured, simulated, torque_fit = zip(*paths, strict=True)
        return RolloutErrors(
            self.rollout.base.model.robot.joint_names,
            tuple(log.name for log in logs),
            tuple(times),
            measured,
            simulated,
            tuple(map(np.ones_like, measured)),
            {"fit_of_torques": torque_fit},
            f"in windows of {self.horizon:g} s",
        )

    def summary(self) -> Table:
        """Return a table of the estimates with 95 % intervals."""
        half_widths = self.uncertainty.half_widths()
        ends = [self.unknowns - half_widths, self.unknowns + half_widths]
        deviations = self.uncertainty.standard_deviations
        return Table(
            "open-loop rollouts",
            Column("parameter", self.run.names),
            *estimate_columns(self.unknowns, deviations, ends, self.run.units),
        )


def identify_torque_rollout(
    base: BaseParameters,
    observations: Logs,
    *,
    horizon: float = 0.2,
    progress: Callable[[str, float], None] | None = None,
) -> TorqueRolloutFit:
    """Identify a robot whose simulation under recorded torques follows the positions.

    The search starts from the fit of torques. Windows overlap, by four fifths if the
    robot is small. A gain common to all torques scales all parameters, and no log tells
    it. Ctrl-C ends the search with the best so far.

    Args:
        base: Base parameters of the model; dry friction must be smooth.
        observations: Filtered logs with torques.
        horizon: Length of the windows [s].
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Raises:
        InputError: If there is no window of the horizon, or the model cannot be
            simulated.
    """
    logs = _listed(observations)
    _require_simulation(base)
    rollout = TorqueRollout(base, logs[0].sample_time)
    windows = Windows.of(logs, horizon, 0.2 * horizon)
    torque_fit = np.asarray(identify(base, logs).parameters)
    start = np.append(torque_fit, 0.0)
    # Large robots are simulated in fewer windows.
    stride = math.ceil(windows.measured.size * len(start) / MAX_DERIVATIVES)
    windows = Windows.of(logs, horizon, 0.2 * horizon * stride)
    _require_stable_simulation(rollout, start, windows, horizon)
    limits = np.full(len(start), np.inf)
    limits[-1] = MAX_DELAY

    def residuals(unknowns: Array, windows: Windows) -> Array:
        errors = rollout.errors(unknowns, windows)
        return errors[COUNTED_STEP - 1 :: COUNTED_STEP].ravel()

    search = search_squares(residuals, start, (-limits, limits), windows, 1e-5)
    with double_precision():
        steps = itertools.islice(search, MAX_STEPS)
        minimum = next(steps)
        # From here on a stop keeps the best so far.
        with contextlib.suppress(KeyboardInterrupt):
            for count, step in enumerate(itertools.chain([minimum], steps), 1):
                minimum = step
                if progress is not None:
                    progress("best so far of a search", count / MAX_STEPS)
    errors = np.asarray(minimum.residuals).reshape(-1, *windows.q.shape)
    blocks = windows.starts * BLOCKS // (windows.starts.max() + 1)
    uncertainty = _uncertainty(minimum, np.broadcast_to(blocks, errors.shape).ravel())
    unknowns = np.asarray(minimum.x)
    converged = bool(minimum.converged)
    return TorqueRolloutFit(
        rollout, unknowns, uncertainty, horizon, torque_fit, converged
    )


def _require_stable_simulation(
    rollout: TorqueRollout, start: Vector, windows: Windows, horizon: float
) -> None:
    """Check that the search can start: the simulation is closer than standing still.

    Light links whose inertia the logs leave open make it diverge; a search from there
    takes minutes and ends nowhere.
    """
    with double_precision():
        errors = np.asarray(jax.jit(rollout.errors)(start, windows))
    motion = np.asarray(windows.measured) - windows.q
    gains = np.mean(motion**2 - errors**2, axis=(0, 2))
    # A simulation that diverges may end without numbers.
    is_wrong = ~(gains > 0)
    if is_wrong.any():
        names = np.array(rollout.base.model.robot.joint_names)[is_wrong]
        raise InputError(
            "`observations`: with the recorded torques, a simulation of "
            f"{', '.join(names)} has larger errors after {horizon:g} s than a joint at "
            "rest would have: use these logs for a model of torques (`jaxid "
            "identify`), not for a simulation. Robots whose logs hold commanded "
            "positions need `recording.commands`."
        )


def _listed(logs: Logs) -> list[Observations]:
    """Return one or several logs as a list."""
    return [logs] if isinstance(logs, Observations) else list(logs)


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


def _uncertainty(minimum: Minimum, block_numbers: np.ndarray) -> Uncertainty:
    """Return the uncertainty by the scatter of parts of the logs.

    Args:
        minimum: Estimates, with the residuals there and their derivatives.
        block_numbers: Part to which each residual belongs.
    """
    jacobian = np.asarray(minimum.jacobian)
    residuals = np.asarray(minimum.residuals)
    blocks = [
        (jacobian[block_numbers == k], residuals[block_numbers == k])
        for k in np.unique(block_numbers)
    ]
    information = jacobian.T @ jacobian
    inverse = np.linalg.pinv(information, rcond=1e-12, hermitian=True)
    covariance, degrees_of_freedom = block_covariance(blocks, inverse)
    dof = np.full(len(inverse), degrees_of_freedom)
    return Uncertainty(covariance, dof, covariance)
