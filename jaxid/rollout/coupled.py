"""Joints that load each other: one simulation of all, and its exact sensitivities.

In each step the bodies have the mass matrix and the bias forces of its predicted
middle, and the servos take two implicit stages. Velocities are solved for until they
agree with the joints that dry friction holds, or whose direction it changes.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, double_precision, on_cores
from jaxid.program import evaluate
from jaxid.program.xla import lower

from .body_loads import Bodies, Programs
from .motion import FreeParameters, MotionSamples, ServoMotion
from .servo import (
    GAMMA,
    INDEX,
    SHARES,
    VELOCITY_FACTORS,
    Forces,
    Partials,
    Stages,
    State,
    advance_state,
    commands_of_stages,
    partials,
    steps_of,
)

MAX_ATTEMPTS = 15
"""Largest number of solutions in a stage."""
DIRECTION_TOLERANCE = 1e-9
"""Change of the mean direction of a joint at which velocities and friction agree."""
MIN_COMPLIANCE = 1e-9
"""Least inverse stiffness by which equations are scaled [rad/(N m) or m/N]."""
DERIVATIVE_FLOOR = 1e-30
"""Derivatives that count as zero: denormal numbers would be slow."""
BLOCK_SIZE = 1024
"""Samples whose derivatives are found at once: fewer cost time, more fill the cache."""


class Path(NamedTuple):
    """Simulation of several motions; the last axis is that of the motions.

    Attributes:
        states: States before each stage [steps, stages, joints, motions].
        velocities: Velocities in the stages, zero where friction holds a joint.
        positions: Positions behind each step [steps, joints, motions].
        load: Bias forces of the bodies in each step; None without bodies.
        M: Mass matrix of the bodies in each step [steps, joints, joints, motions]; None
            if they are not coupled.
    """

    states: State
    velocities: AnyArray
    positions: AnyArray
    load: AnyArray | None = None
    M: AnyArray | None = None


@functools.partial(jax.jit, static_argnums=(0, 1))
def _simulate(
    programs: Programs | None,
    steps: int,
    theta: Array,
    motion: ServoMotion,
    hold: AnyArray,
) -> Path:
    """Simulate all motions from their initial states, each with its own parameters."""
    h = jnp.asarray(motion.sample_time)[None] / steps
    shares = jnp.array(SHARES)
    velocity_factors = jnp.array(VELOCITY_FACTORS)

    def step(states: tuple[State, Array], commands: Array):
        start_state, last_velocity = states
        zero_torque = jnp.zeros_like(last_velocity)
        M = None
        load = None
        if programs is not None:
            middle_state = middle_of(start_state.q, start_state.w, last_velocity, h)
            M, load = lower(programs.bodies).dense(*middle_state)
            # Joints that are not coupled need no mass matrix.
            M = None if programs.solve is None else M

        def stage(state: State, stage_inputs: tuple[Array, ...]):
            inputs = Stages(
                stage_inputs[0],
                zero_torque if load is None else load,
                zero_torque,
                *stage_inputs[1:],
            )
            x = Forces.of(state, joint_parameters, inputs, h)
            u = _solve_velocities(programs, x, state.w, joint_parameters, inputs, M, h)
            return advance_state(state, u, x, inputs, h), (state, u)

        end_state, stages = jax.lax.scan(
            stage, start_state, (commands, shares, velocity_factors)
        )
        # Results are computed once; otherwise XLA computes `load` and `M` again for
        # each joint.
        return (end_state, start_state.w), (*stages, end_state.q, load, M)

    start = State(*jnp.moveaxis(jnp.asarray(motion.start), 0, -1))
    commands_of_motions = jax.vmap(
        lambda x, y: commands_of_stages(x.T, y, steps, hold)[0], (-1, 0), -1
    )
    commands = commands_of_motions(theta, motion)
    step_commands = commands.reshape(-1, 2, *commands.shape[1:])
    joint_parameters = tuple(theta)
    _, path = jax.lax.scan(step, (start, start.w), step_commands)
    return Path(*path)


def middle_of(q: Any, v: Any, last_velocity: Any, h: Any) -> tuple[Any, Any]:
    """Return predicted position and velocity in the middle of a step.

    Args:
        q: Position before the step.
        v: Velocity before it.
        last_velocity: Velocity before the last step.
        h: Time of a step [s].
    """
    return q + 0.5 * h * v, 1.5 * v - 0.5 * last_velocity


def _solve_velocities(
    programs: Programs | None,
    x: Forces,
    w: Array,
    theta: tuple[Array, ...],
    stage: Stages,
    M: Array | None,
    h: AnyArray,
) -> Array:
    """Return the velocities in a stage [joints, motions]."""
    if programs is None or programs.solve is None or M is None:
        return x.velocity(w, stage)
    scale = jnp.sqrt(jnp.maximum(theta[INDEX["a"]], MIN_COMPLIANCE)) + jnp.zeros_like(w)
    M = M * (scale[:, None] * scale[None]) / (GAMMA * h[None])
    terms = x.force, x.inertia, x.friction, x.resistance, scale, w, stage.ahead
    solve = lower(programs.solve)

    def improve(state: tuple[Any, ...]) -> tuple[Any, ...]:
        _, free_joints, direction, *_, count = state
        return (
            *solve.dense(M, *terms, free_joints, direction),
            free_joints,
            direction,
            count + 1,
        )

    def has_changed(state: tuple[Any, ...]) -> Array:
        _, free_joints, direction, previous_joints, previous_direction, count = state
        change = free_joints * jnp.abs(direction - previous_direction)
        has_difference = jnp.any(
            (free_joints != previous_joints) | (change > DIRECTION_TOLERANCE)
        )
        return (count == 0) | has_difference & (count < MAX_ATTEMPTS)

    slip = x.slip(w, stage, x.force)
    start: tuple[Any, ...] = w, slip.free, slip.direction, slip.free, slip.direction, 0
    return jax.lax.while_loop(has_changed, improve, start)[0]


@functools.partial(jax.jit, static_argnums=5)
def _partials(
    theta: Array,
    motion: ServoMotion,
    hold: AnyArray,
    path: Path,
    other_torques: Array,
    steps: int,
) -> Partials:
    """Return derivatives of the balance of forces in all stages of a motion.

    They are arrays [stages, ...].
    """
    terms = path.states, path.velocities, other_torques
    state, u, other_torques = jax.tree.map(
        lambda x: jnp.reshape(x, (-1, len(theta))), terms
    )
    stages, by_delay = Stages.of(theta, motion, steps, hold)
    return partials(
        state, u, theta, stages, by_delay, motion.sample_time / steps, other_torques
    )


class _BodyTerms(NamedTuple):
    """Terms of the bodies in the middle of steps, and their derivatives, steps first.

    Attributes:
        M: Mass matrix.
        M_by_q: Derivatives of the mass matrix by the positions, on the last axis.
        load_by_q: Derivatives of the bias forces by the positions.
        load_by_v: Derivatives of the bias forces by the velocities.
    """

    M: np.ndarray
    M_by_q: np.ndarray
    load_by_q: np.ndarray
    load_by_v: np.ndarray


@dataclasses.dataclass(frozen=True)
class CoupledSimulator:
    """Motions of all joints of a robot together.

    Attributes:
        motion: Motions.
        time_step: Longest step, 5 % more if that makes them fewer [s].
        hold: Whether commands are held until the next one, instead of interpolated.
        bodies: Bodies that load the joints; None without.
    """

    motion: ServoMotion
    time_step: float
    hold: bool
    bodies: Bodies | None

    @property
    def steps(self) -> int:
        """Steps in each sample time: at least two, which reveal held commands."""
        return steps_of(self.motion, self.time_step, 2)

    def simulate(self, theta: AnyArray) -> Path:
        """Simulate the motions from their initial states.

        Args:
            theta: Parameters, or some for each of several equal parts of the motions.
        """
        motion = self.motion.replace(lengths=(), names=())
        programs = None if self.bodies is None else self.bodies.programs
        theta = np.asarray(theta).reshape(-1, *np.shape(theta)[-2:])
        theta = np.repeat(theta.T, self.motion.motions // len(theta), axis=-1)
        with double_precision():
            path = _simulate(
                programs, self.steps, jnp.asarray(theta), motion, np.array(self.hold)
            )
            return jax.tree.map(np.asarray, path)

    def positions(self, path: Path) -> MotionSamples:
        """Return the positions of all samples."""
        start_positions = np.asarray(self.motion.start)[:, 0, :, None]
        later_positions = path.positions[self.steps - 1 :: self.steps]
        return np.concatenate(
            [start_positions, later_positions.transpose(2, 1, 0)], axis=-1
        )

    def sensitivities(
        self, theta: np.ndarray, path: Path, free_mask: FreeParameters
    ) -> np.ndarray:
        """Return derivatives of the positions.

        They are those by the free parameters, joint by joint, and then by the motion's
        initial states.
        """
        motions = self.motion.motions
        n = len(theta)
        samples = self.motion.positions.shape[-1]
        transitions = [
            self.transitions(k, np.asarray(theta), path, free_mask)
            for k in range(motions)
        ]
        size = self.motion.start[0].size
        state = np.zeros((motions, size + n, free_mask.sum() + size))
        state[:, :size, -size:] = np.eye(size)
        # The velocity before is that of the start, too.
        state[:, size:] = state[:, n : 2 * n]
        S = np.zeros((motions, n, samples, state.shape[-1]))
        S[:, :, 0] = state[:, :n]
        blocks = [
            slice(k, min(k + BLOCK_SIZE, samples - 1))
            for k in range(0, samples - 1, BLOCK_SIZE)
        ]
        places = ((k, rows) for rows in blocks for k in range(motions))
        parts = on_cores(
            lambda place: transitions[place[0]](place[1]), places, ahead=2 * motions
        )
        for rows in blocks:
            block_parts = [next(parts) for _ in range(motions)]
            T, C = (np.stack(x, axis=1) for x in zip(*block_parts, strict=True))
            for k in range(rows.stop - rows.start):
                state = T[k] @ state
                state[..., :-size] += C[k]
                state *= np.abs(state) > DERIVATIVE_FLOOR
                S[:, :, rows.start + k + 1] = state[:, :n]
        return S

    def transitions(
        self, motion: int, theta: np.ndarray, path: Path, free_mask: np.ndarray
    ) -> Callable[[slice], tuple[np.ndarray, np.ndarray]]:
        """Return a function of samples: derivatives of the state a sample time later.

        By the state before, with the velocities a step before, and by the free
        parameters.
        """
        part = self.motion.part(motion)
        motion_path = jax.tree.map(lambda x: x[..., motion], path)
        part = dataclasses.replace(part, lengths=(), names=())
        steps = self.steps
        h = float(part.sample_time) / self.steps
        slope = (motion_path.states.w - motion_path.velocities) / (GAMMA * h)
        M, load, step_middles = _body_terms(motion_path, h)
        inertia = np.diagonal(M, axis1=1, axis2=2)
        other_torques = np.einsum("tij,tsj->tsi", M, slope) - inertia[:, None] * slope
        motion_terms = (np.concatenate([x, x[-1:]]).T for x in (load, inertia))
        part = part.replace(**dict(zip(("load", "inertia"), motion_terms, strict=True)))
        with double_precision():
            stage_partials = _partials(
                theta, part, np.array(self.hold), motion_path, other_torques, steps
            )

        def by_sample(x) -> np.ndarray:
            return np.asarray(x).reshape(-1, steps, *np.shape(x)[1:])

        sample_partials = jax.tree.map(
            lambda x: by_sample(x).reshape(-1, steps, 2, x.shape[-1]), stage_partials
        )
        velocities = by_sample(motion_path.velocities)
        slope = by_sample(slope)
        size = part.start.size

        def block_transitions(rows: slice):
            block_partials = jax.tree.map(lambda x: x[rows], sample_partials)
            terms = None
            if self.bodies is not None:
                middle_states = [
                    x[rows.start * steps : rows.stop * steps].T for x in step_middles
                ]
                derivatives = evaluate(self.bodies.programs.derivatives, *middle_states)
                derivatives = (by_sample(np.moveaxis(x, -1, 0)) for x in derivatives)
                terms = _BodyTerms(by_sample(M)[rows], *derivatives)
            return _compose(
                theta,
                block_partials,
                velocities[rows],
                slope[rows],
                terms,
                free_mask,
                h,
                size,
            )

        return block_transitions


def _body_terms(path: Path, h: float):
    """Return mass matrices and bias forces of a motion's steps, and their places."""
    v = path.states.w[:, 0]
    last_velocities = np.concatenate([v[:1], v[:-1]])
    middle_states = middle_of(path.states.q[:, 0], v, last_velocities, h)
    M = np.zeros((*v.shape, v.shape[1])) if path.M is None else path.M
    load = np.zeros_like(v) if path.load is None else path.load
    return M, load, middle_states


def _compose(
    theta: np.ndarray,
    sample_partials: Partials,
    velocities: np.ndarray,
    slope: np.ndarray,
    terms: _BodyTerms | None,
    free_mask: np.ndarray,
    h: float,
    size: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives of states a sample time later by earlier ones and parameters.

    Args:
        theta: Parameters.
        sample_partials: Derivatives of the forces in the stages [samples, steps,
            stages, ...].
        velocities: Velocities in the stages [samples, steps, stages, joints].
        slope: Velocities before less those in the stages, over the time of a stage.
        terms: Terms of the bodies [samples, steps, ...].
        free_mask: Whether each parameter is estimated.
        h: Time of a step [s].
        size: Size of the state of all joints.
    """
    count, steps, _, n = velocities.shape
    joint, symbol = np.nonzero(free_mask)
    rows = size + n
    columns = rows + np.arange(len(joint))
    # From here on variables of the state are their derivatives [samples, joints,
    # columns]: by the state a sample time before, then by the estimated parameters.
    state = np.tile(np.eye(rows, rows + len(joint)), (count, 1, 1))
    q, w, *integral, last_velocity = np.split(state, 1 + size // n, axis=1)
    middle_state = q, w
    for k, s in np.ndindex(steps, 2):
        if s == 0:
            middle_state = middle_of(q, w, last_velocity, h)
            last_velocity = w
        balance = jax.tree.map(lambda x, k=k, s=s: x[:, k, s], sample_partials)
        is_moving = (velocities[:, k, s] != 0.0)[..., None]
        force = balance.by_q[..., None] * q
        force += balance.by_w[..., None] * w
        for x in integral:
            force += balance.by_integral[..., None] * x
        by_theta = np.stack(balance.by_theta, axis=1)
        force[:, joint, columns] += by_theta[:, symbol, joint]
        A = balance.resistance[..., None] * np.eye(n)
        if terms is not None:
            step_terms = _BodyTerms(*(x[:, k] for x in terms))
            by_q, by_v, by_w = _derivatives_of_bodies(
                theta, balance, step_terms, slope[:, k, s], h
            )
            are_both_moving = is_moving & is_moving.swapaxes(1, 2)
            A += by_w * are_both_moving
            force += by_w @ w + by_q @ middle_state[0] + by_v @ middle_state[1]
        # Derivatives of the velocities in the stage; friction holds joints at rest.
        change = np.linalg.solve(A, force * is_moving)
        share = SHARES[s]
        for x in integral:
            growth = -balance.rate[..., None] * (q + GAMMA * h * change)
            growth_by_theta = np.stack(balance.growth, axis=1)
            growth[:, joint, columns] += growth_by_theta[:, symbol, joint]
            integral = [x + share * h * growth]
        q = q + share * h * change
        w = (w + VELOCITY_FACTORS[s] * (change - w)) * is_moving
    state = np.concatenate([q, w, *integral, last_velocity], axis=1)
    return state[..., :rows], state[..., rows:]


def _derivatives_of_bodies(
    theta: np.ndarray,
    balance: Partials,
    terms: _BodyTerms,
    slope: np.ndarray,
    h: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return derivatives of the forces' balance by other joints.

    They are arrays [samples, joints, joints]: by positions and velocities in the middle
    of the step, and by velocities before the stage, less those by velocities in it.
    """
    a = theta[:, INDEX["a"], None]
    diagonal = np.eye(len(theta), dtype=bool)
    by_force, by_load = (
        np.asarray(x)[..., None] for x in (balance.by_force, balance.by_load)
    )
    by_inertia = np.asarray(balance.by_inertia)[..., None] / (GAMMA * h)
    by_matrix = a * np.where(diagonal, by_inertia, by_force * slope[:, None])
    by_q = (
        np.einsum("tijl,tij->til", terms.M_by_q, by_matrix) + by_load * terms.load_by_q
    )
    by_w = a * by_force * terms.M * ~diagonal / (GAMMA * h)
    return by_q, by_load * terms.load_by_v, by_w
