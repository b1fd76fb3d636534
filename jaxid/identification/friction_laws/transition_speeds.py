"""Speeds of the transition of dry friction, by a search on the rows of each joint."""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import Joints, Matrix, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, Tanh
from jaxid.dynamics.terms.dry_friction_transitions import (
    USUAL_SPEED,
    has_open_transition,
)
from jaxid.measurement.observations import Observations, ObservedLogs

from ..factors import JointFactor
from ..problem import RegressionProblem

SPEED_SHARES = np.geomspace(0.003, 0.1, 17)
"""Speeds that are tried, as fractions of each joint's own top speed."""
MIN_TRAVEL = 1e-3
"""Travel below which a joint rests, and its speed is noise [rad or m]."""
RANK_TOLERANCE = 1e-10
"""Relative size of singular values below which columns are dependent."""


def identify_transition_speeds(
    base: BaseParameters, observations: ObservedLogs
) -> BaseParameters:
    """Find the speed at which dry friction of each joint changes its direction.

    Fractions of each joint's own top speed are tried. The rows of a joint depend on its
    own speed only, and are fitted alone; one pass over the data makes the columns of
    all trials, filtered like the forces. Where rows hardly tell the speed, it hardly
    changes the other parameters.

    Args:
        base: Base parameters of a model.
        observations: Observations of one recording, or of several that are fitted
            together.

    Returns:
        The same base parameters, with a speed of each joint in every transition `Tanh`
        for which none was given.
    """
    model = base.model
    # Friction with memory follows the path: its speed matters at the first sample only.
    if model.memory is not None or not has_open_transition(model.terms):
        return base
    logs = as_logs(observations)
    max_speeds = top_speeds(logs)
    trial_speeds = np.outer(SPEED_SHARES, max_speeds)
    trial_speeds[:, max_speeds == 0] = USUAL_SPEED

    trials = SpeedTrials.of(base, trial_speeds)
    factors = RegressionProblem(trials.base, logs).factors
    squares = [trials.squares(joint) for joint in factors.joints]
    speeds = best_speeds(squares, SPEED_SHARES, max_speeds)
    speeds = np.where(max_speeds > 0, speeds, USUAL_SPEED)
    return eqx.tree_at(lambda b: b.model, base, model.with_transition_speeds(speeds))


def as_logs(observations: ObservedLogs) -> tuple[Observations, ...]:
    """Return one log or several as a tuple."""
    is_one_log = isinstance(observations, Observations)
    return (observations,) if is_one_log else tuple(observations)


def best_speeds(
    squares: Sequence[Vector], shares: Vector, max_speeds: Joints
) -> Joints:
    """Return the speed of each joint with the least squared error of its own rows.

    Args:
        squares: For each joint the squared error of each trial.
        shares: Speed of each trial, relative to the joint's top speed.
        max_speeds: Top speeds [rad/s or m/s].
    """
    numbers = [minimum_place(values) for values in squares]
    # Between two trials the logarithm of the speed is interpolated.
    trial_numbers = np.arange(len(shares))
    best_shares = np.exp(np.interp(numbers, trial_numbers, np.log(shares)))
    return best_shares * max_speeds


def top_speeds(logs: Sequence[Observations]) -> Joints:
    """Return the top speed of each joint, zero where it rests [rad/s or m/s]."""
    lowest_angles = []
    highest_angles = []
    speeds = []
    for log in logs:
        for chunk in log.chunks(65536):
            motion, _ = log.read(slice(*chunk.samples))
            lowest_angles.append(np.min(motion.q, axis=0))
            highest_angles.append(np.max(motion.q, axis=0))
            speeds.append(np.max(np.abs(motion.qd), axis=0))
    travel = np.max(highest_angles, axis=0) - np.min(lowest_angles, axis=0)
    return np.where(travel < MIN_TRAVEL, 0.0, np.max(speeds, axis=0))


class TrialColumns(AbstractTerm):
    """Columns of dry friction at one trial's speeds after another's.

    Attributes:
        friction: Model of the terms of dry friction, whose speeds are not given.
        speeds: Speeds of each trial [trials, joints].
    """

    friction: Model
    speeds: Matrix

    def parameters(self, robot):
        """Return the terms' names, which a number makes different, and their units."""
        return tuple(
            (f"{number}:{name}", unit)
            for number in range(len(self.speeds))
            for term in self.friction.terms
            for name, unit in term.parameters(robot)
        )

    def columns(self, robot, q, qd, qdd):
        """Return the columns of all terms."""

        def trial_columns(speeds):
            terms = self.friction.with_transition_speeds(speeds).terms
            parts = [term.columns(robot, q, qd, qdd) for term in terms]
            return jnp.concatenate(parts, axis=1)

        # What does not depend on the speeds, as loads, is computed and compiled once.
        columns = jax.vmap(trial_columns, out_axes=1)(self.speeds)
        return columns.reshape(len(columns), -1)


@dataclasses.dataclass(frozen=True)
class SpeedTrials:
    """Base parameters with the columns of all trials at their end.

    Attributes:
        base: The base parameters.
        friction: Numbers of those that the columns of a trial replace.
        trials: Numbers of those of each trial [trials, friction].
    """

    base: BaseParameters
    friction: np.ndarray
    trials: np.ndarray

    @classmethod
    def of(cls, base: BaseParameters, speeds: Matrix) -> "SpeedTrials":
        """Append the columns of trials with these speeds [trials, joints]."""
        model = base.model
        is_open = [has_open_transition(term) for term in model.terms]
        sizes = [len(term.parameters(model.robot)) for term in model.terms]
        standard_columns = np.flatnonzero(np.repeat(is_open, sizes))
        open_terms = tuple(itertools.compress(model.terms, is_open))
        trial_term = TrialColumns(Model(model.robot, open_terms), speeds)

        # Columns that others replace, like those of an offset, need no trial.
        is_base = np.isin(standard_columns, base.indices)
        friction = np.searchsorted(base.indices, standard_columns[is_base])
        shape = (len(speeds), len(standard_columns))
        trial_columns = model.size + np.arange(np.prod(shape)).reshape(shape)
        trial_columns = trial_columns[:, is_base]
        # No other parameter depends on the trials: their rows of kappa are zero.
        kappa = base.kappa
        trial_kappa = np.zeros((trial_columns.size, kappa.shape[1]))
        extended_base = dataclasses.replace(
            base,
            model=Model(model.robot, (*model.terms, trial_term)),
            indices=(*base.indices, *trial_columns.ravel().tolist()),
            kappa=np.vstack([kappa, trial_kappa]),
        )
        trials = base.size + np.arange(trial_columns.size)
        return cls(extended_base, friction, trials.reshape(trial_columns.shape))

    def squares(self, joint: JointFactor) -> Vector:
        """Return the squared errors of each trial, fitted to the rows of a joint."""
        place = {column: k for k, column in enumerate(joint.columns)}
        trial_columns = {*self.friction.tolist(), *self.trials.ravel().tolist()}
        other_places = [k for c, k in place.items() if c not in trial_columns]
        scale = np.linalg.norm(joint.R, axis=0)
        rows = joint.R / np.where(scale > 0, scale, 1.0)

        # What the other columns leave of those of the trials, and of the forces.
        others = rows[:, other_places]
        solution, *_ = np.linalg.lstsq(others, rows, RANK_TOLERANCE)
        remainder = rows - others @ solution
        forces = remainder[:, -1]
        squares = []
        for trial in self.trials.tolist():
            places = [place[column] for column in trial if column in place]
            friction = remainder[:, places]
            levels, *_ = np.linalg.lstsq(friction, forces, RANK_TOLERANCE)
            squares.append(np.sum((forces - friction @ levels) ** 2))
        return np.array(squares)


def minimum_place(values: Vector) -> float:
    """Return the place of the minimum of a parabola through the least of the values."""
    number = int(np.argmin(values))
    if number in (0, len(values) - 1):
        return float(number)
    before, least, behind = values[number - 1 : number + 2]
    bend = before - 2 * least + behind
    return number + 0.5 * (before - behind) / bend if bend > 0 else float(number)


def transition_note(base: BaseParameters) -> str:
    """Return the speeds of the transitions in words."""
    robot = base.model.robot
    leaves = jax.tree.leaves(base.model.terms, is_leaf=_is_smooth)
    transition = next(x for x in leaves if _is_smooth(x))
    speeds = np.asarray(transition.speed).tolist()
    words = [
        f"{robot.joint_names[joint]} {speeds[joint]:.2g} {robot.joint_unit(joint)}/s"
        for joint in robot.driven
    ]
    return (
        "dry friction changes sign within about these speeds, found from the "
        f"logs (`epsilon`): {', '.join(words)}."
    )


def _is_smooth(part: Any) -> bool:
    """Return whether a part of a term is a transition with a speed of each joint."""
    return isinstance(part, Tanh) and np.ndim(part.speed) == 1
