"""Mistakes in the columns of a robot on legs: signs, scales and orders.

All feet are called standing, whatever their flags: the torques of each leg then act in
the rows of the trunk through $X$ (`robot/contacts.py`), and a leg in the air costs
information only. Under each mistake the log is observed again, and the rows of the
trunk are judged.
"""

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Matrix
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.filters import Subsample, ZeroPhaseButterworth
from jaxid.measurement.floating_base import all_forces, base_of
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.recording import Recording
from jaxid.measurement.samples import joint_side
from jaxid.result_table import percent, significant
from jaxid.robot.contacts import legs_of
from jaxid.robot.robot import Robot

from .filtered_log import BLOCK_TIME, FOLDS, MAX_DURATION
from .row_fits import Judge, Rows
from .suspects import MAX_JOINTS


class LegSearch(NamedTuple):
    """Rows of the search, and from which values on it names a mistake.

    Set on simulated logs of a Go2, an A1 and an ANYmal C.
    """

    rate: float = 50.0  # of the samples [Hz]
    first_cutoff: float = 10.0  # of the channels [Hz]
    cutoff: float = 5.0  # of the rows [Hz]
    step: int = 4  # samples for each row
    misfit: float = 0.2  # errors over median forces, up to which the order is right
    gain: float = 2.0  # fall of the score of a mistake
    share: float = 0.5  # of the misfit that a cure may leave
    rounds: int = 4  # mistakes that are looked for one after another


SEARCH = LegSearch()


class ColumnMistake(NamedTuple):
    """A mistake in the columns of a log.

    Attributes:
        sentence: What seems to be wrong, with the key that mends it.
        angles: Combinations of the columns of the angles that mend it.
        forces: The same of the forces.
    """

    sentence: str
    angles: Matrix
    forces: Matrix


class LegColumns:
    """A log whose feet all stand, and its rows with other columns of the legs.

    Attributes:
        names: Names of the driven joints.
        legs: Driven joints of each leg.
        feet: Names of the feet.
        rows: Rows of the trunk, and of joints of no leg.
        judge: Score of these rows.
    """

    def __init__(self, base: BaseParameters, recording: Recording):
        robot = base.model.robot
        names = [f"`{robot.joint_names[i]}`" for i in robot.driven]
        first_joint = len(robot.virtual)
        self.names = names
        self.feet = [f"`{contact.name}`" for contact in robot.contacts]
        self.legs = [
            [joint - first_joint for joint in leg] for leg in legs_of(robot).own_joints
        ]
        self._base = base
        self._recording = recording
        self._observations = self._observe(recording)
        self._is_used = self._observations.mask.all(axis=0)
        self.rows = self._rows(self._observations)
        row_time = SEARCH.step * recording.sample_time
        blocks = np.arange(len(self.rows.forces)) // round(BLOCK_TIME / row_time)
        self.judge = Judge(np.ones(self.rows.forces.shape, bool), blocks % FOLDS)

    @property
    def identity(self) -> Matrix:
        """Columns as they are."""
        return np.eye(len(self.names))

    def mended(self, mistake: ColumnMistake) -> Recording:
        """Return the log without a mistake."""
        recording = self._recording
        return dataclasses.replace(
            recording,
            angles=recording.angles @ mistake.angles.T,
            forces=recording.forces @ mistake.forces.T,
        )

    def with_mended(self, mistake: ColumnMistake) -> Rows:
        """Return the rows without a mistake."""
        if np.array_equal(mistake.angles, self.identity):
            return self.rows._replace(forces=self._force_rows(mistake.forces))
        return self._rows(self._observe(self.mended(mistake)))

    def factor(self, joint: int) -> float:
        """Return the factor of the torque of a joint with which the model fits best."""
        only_joint = np.diag(self.identity[joint])
        torque = self._force_rows(only_joint)
        columns = np.concatenate([self.rows.columns, -torque[..., None]], axis=2)
        fit = self.judge.fit(Rows(columns, self.rows.forces - torque))
        return float(fit.parameters[-1])

    def misfit(self, rows: Rows) -> float:
        """Return the errors over the median forces.

        Straight knees, which wrong angles may show, make a few forces huge.
        """
        sizes = np.median(np.abs(rows.forces), axis=0)
        ratios = np.sqrt(self.judge.fit(rows).squares) / sizes
        return float(np.sqrt(np.mean(ratios**2)))

    def misfit_without(self, mistake: ColumnMistake) -> float:
        """Return the errors over the median forces without a mistake."""
        return self.misfit(self.with_mended(mistake))

    def _observe(self, recording: Recording) -> Observations:
        low_pass = ZeroPhaseButterworth(SEARCH.cutoff)
        robot = self._base.model.robot
        return observe(recording, robot, low_pass, Subsample(SEARCH.step))

    def _rows(self, observations: Observations) -> Rows:
        """Return the rows that count, of all joints with all columns."""
        joints = np.flatnonzero(self._is_used)
        theta = self._base.regressor_rows(observations.motion)
        forces = observations.reduced_forces[:, joints]
        columns = np.zeros((*forces.shape, self._base.size))
        for row, joint in enumerate(joints):
            indices = list(self._base.acting_columns[joint])
            columns[:, row, indices] = observations.reduce(theta[joint])
        return Rows(columns, forces)

    def _force_rows(self, matrix: Matrix) -> Matrix:
        """Return the forces of the rows with other combinations of the torques."""
        observations = self._observations
        robot = self._base.model.robot
        forces = np.asarray(self._recording.forces) @ matrix.T
        rows = observations.reduce(all_forces(robot, observations.motion, forces))
        return rows[:, self._is_used]


def column_mistakes(
    base: BaseParameters, recording: Recording, progress: Progress
) -> list[str]:
    """Return a sentence about what is wrong with the columns, if something is.

    Mistakes are looked for one after another, until the model fits.

    Args:
        base: Base parameters of the robot, which has contacts.
        recording: Log of the robot.
        progress: Callback, called with the completed fraction (0 to 1).
    """
    try:
        log = LegColumns(base, standing_log(recording, base.model.robot))
    except InputError:
        # A short log tells nothing.
        return []
    first_misfit = misfit = log.misfit(log.rows)
    sentences = []
    for _ in range(SEARCH.rounds):
        mistake = _largest_mistake(log, progress)
        if mistake is None:
            break
        sentences.append(mistake.sentence)
        log = LegColumns(base, log.mended(mistake))
        misfit = log.misfit(log.rows)
    # Of several mistakes, all must be found.
    limit = SEARCH.misfit
    if len(sentences) == 1:
        limit = max(limit, SEARCH.share * first_misfit)
    if not sentences or misfit > limit:
        return []
    effect = f"{percent(misfit)} % instead of {percent(first_misfit)} %"
    text = "; and ".join(sentences)
    return [f"{text}: the error of the forces on the trunk is then {effect}."]


def standing_log(recording: Recording, robot: Robot) -> Recording:
    """Return few samples of a log, of the joints' side, in which all feet stand."""
    sample_time = recording.sample_time
    a, b = max(recording.segments, key=lambda segment: segment[1] - segment[0])
    samples = slice(a, min(b, a + round(MAX_DURATION / sample_time)))
    step = max(1, int(1.0 / (SEARCH.rate * sample_time)))
    low_pass = ZeroPhaseButterworth(SEARCH.first_cutoff).low_pass(sample_time)

    def thinned(x: AnyArray) -> np.ndarray:
        return np.asarray(low_pass(np.asarray(x)[samples]))[::step]

    signals = base_of(recording, robot)
    angles, _, forces = joint_side(
        robot, recording, recording.angles, None, np.asarray(recording.forces)
    )
    return Recording.of(
        thinned(angles),
        thinned(forces),
        gyro=thinned(signals.rates),
        accelerometer=thinned(signals.accelerations),
        contact=np.ones_like(thinned(signals.contacts)),
        sample_time=step * sample_time,
        name=recording.name,
    )


def _largest_mistake(log: LegColumns, progress: Progress) -> ColumnMistake | None:
    """Return the mistake that explains most: in the torques, else in the angles."""
    mistakes = [_scaled_force(log, joint) for joint in range(len(log.names))]
    if log.misfit(log.rows) < SEARCH.misfit:
        return _best(log, mistakes, progress)
    force_mistake = _best(log, [*mistakes, *_exchanged_forces(log)], progress)
    if force_mistake is not None and log.misfit_without(force_mistake) < SEARCH.misfit:
        return force_mistake
    angle_mistake = _best(log, [*_mistakes_in_angles(log)], progress)
    candidates = [x for x in (force_mistake, angle_mistake) if x is not None]
    return min(candidates, key=log.misfit_without, default=None)


def _best(
    log: LegColumns, mistakes: Sequence[ColumnMistake], progress: Progress
) -> ColumnMistake | None:
    """Return the mistake that explains most, if it explains enough of unseen rows."""
    judge = log.judge
    scores = []
    for number, mistake in enumerate(mistakes):
        progress(number / len(mistakes))
        scores.append(judge.fit(log.with_mended(mistake)).score)
    best = mistakes[int(np.argmin(scores))]
    squares = judge.unseen_squares(log.rows)
    remaining_squares = judge.unseen_squares(log.with_mended(best))
    gain = judge.score(squares) - judge.score(remaining_squares)
    share = np.sqrt(np.min(remaining_squares / squares))
    return best if gain > SEARCH.gain and share < SEARCH.share else None


def _exchanged_forces(log: LegColumns) -> Iterator[ColumnMistake]:
    """Yield that the torques of two joints, or of two legs, are exchanged."""
    identity = log.identity
    pairs = itertools.combinations(range(len(identity)), 2)
    # The number of pairs grows with the square.
    for i, j in pairs if len(identity) <= MAX_JOINTS else ():
        exchange = _exchange(identity, [i], [j])
        yield ColumnMistake(
            f"the forces of joints {log.names[i]} and {log.names[j]} seem to be "
            "exchanged (`recording.forces`)",
            identity,
            exchange,
        )
    for words, exchange in _exchanged_legs(log):
        sentence = f"the forces {words} (`recording.forces`)"
        yield ColumnMistake(sentence, identity, exchange)


def _mistakes_in_angles(log: LegColumns) -> Iterator[ColumnMistake]:
    """Yield wrong signs of angles, and exchanged legs."""
    identity = log.identity
    for joint, name in enumerate(log.names):
        signs = np.diag(1.0 - 2.0 * identity[joint])
        yield ColumnMistake(
            f"the sign of the angle of joint {name} seems to be wrong "
            "(`recording.angle_signs`)",
            signs,
            identity,
        )
        yield ColumnMistake(
            f"the axis of joint {name} seems to be reversed in the robot, or in the "
            "log both its angle and its force (`recording.angle_signs`, `force_signs`)",
            signs,
            signs,
        )
    for words, exchange in _exchanged_legs(log):
        sentence = f"the angles {words} (`recording.angles`)"
        yield ColumnMistake(sentence, exchange, identity)
        sentence = f"angles and forces {words} (`recording.angles`, `forces`)"
        yield ColumnMistake(sentence, exchange, exchange)


def _exchanged_legs(log: LegColumns) -> Iterator[tuple[str, Matrix]]:
    """Yield that two equal legs are exchanged, and the matrix that mends it."""
    for i, j in itertools.combinations(range(len(log.legs)), 2):
        if len(log.legs[i]) == len(log.legs[j]):
            exchange = _exchange(log.identity, log.legs[i], log.legs[j])
            feet = f"{log.feet[i]} and {log.feet[j]}"
            yield f"of the legs of {feet} seem to be exchanged", exchange


def _exchange(identity: Matrix, first: Sequence[int], second: Sequence[int]) -> Matrix:
    """Return the matrix that exchanges columns."""
    exchange = identity.copy()
    exchange[[*first, *second]] = exchange[[*second, *first]]
    return exchange


def _scaled_force(log: LegColumns, joint: int) -> ColumnMistake:
    """Return that a torque has the wrong sign or scale, as the others tell it."""
    factor = log.factor(joint)
    name = log.names[joint]
    size = significant(1.0 / factor, 3)
    sentence = (
        f"the force of joint {name} in the log seems to be {size} times the true one "
        f"(`recording.force_gains` of {significant(factor, 3)})"
    )
    if factor < 0.0:
        # Another wrong column spoils the size of this one, which is tried afterwards.
        factor = -1.0
        sentence = (
            f"the sign of the force of joint {name} seems to be wrong "
            "(`recording.force_signs`)"
        )
    scales = 1.0 + (factor - 1.0) * log.identity[joint]
    return ColumnMistake(sentence, log.identity, np.diag(scales))
