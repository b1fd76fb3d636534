"""Signs of several columns of a log that are wrong at once."""

import itertools
from typing import NamedTuple

import numpy as np

from .descriptions import DescribedLog
from .row_fits import Judge, Rows, imitations
from .suspects import SuspectedMistakes

MAX_JOINTS = 12
"""Number of joints above which signs are not tried together."""
MIN_GAIN = 0.1
"""Fall of the score from which another sign is worth a step of the search."""


class Signs(NamedTuple):
    """Signs of the columns of a log, +1 or -1.

    Attributes:
        angles: Signs of the angles [joints].
        forces: Signs of the forces [joints].
    """

    angles: np.ndarray
    forces: np.ndarray

    def flipped(self, joint: int, angle: bool, force: bool) -> "Signs":
        """Return the signs with those of a joint reversed."""
        angles = self.angles.copy()
        forces = self.forces.copy()
        angles[joint] *= -1 if angle else 1
        forces[joint] *= -1 if force else 1
        return Signs(angles, forces)


def several_signs(
    described_log: DescribedLog, suspected: SuspectedMistakes
) -> list[Signs]:
    """Return signs with which the model fits best, the best first.

    There are none for more than `MAX_JOINTS` joints. The search starts from the signs
    of the log, and from the signs of the forces that fit best with its angles; each
    step reverses what lowers the errors most. Opposite signs of all forces fit alike,
    but let friction drive the joints.
    """
    joints = described_log.robot.joints
    if joints > MAX_JOINTS:
        return []
    ones = np.ones(joints)
    starts = [Signs(ones, ones)]
    for forces in _force_signs(described_log):
        starts.append(Signs(ones, forces))
    results = [_descent(described_log.judge, suspected, start) for start in starts]
    return [signs for _, signs in sorted(results, key=lambda result: result[0])]


def _descent(
    judge: Judge, suspected: SuspectedMistakes, signs: Signs
) -> tuple[float, Signs]:
    """Return the score and the signs after reversing one joint at a time."""
    score = judge.fit(suspected.rows_of_signs(*signs)).score
    kinds = (True, False), (False, True), (True, True)
    joints = range(len(signs.angles))
    for _ in joints:
        candidates = [
            signs.flipped(joint, *kind)
            for joint, kind in itertools.product(joints, kinds)
        ]
        scores = [judge.fit(suspected.rows_of_signs(*x)).score for x in candidates]
        best = int(np.argmin(scores))
        if score - scores[best] < MIN_GAIN:
            break
        score = scores[best]
        signs = candidates[best]
    return score, signs


def _force_signs(described_log: DescribedLog) -> tuple[np.ndarray, np.ndarray]:
    """Return the signs of the forces that fit best, and their opposites.

    The parameters are linear in the forces: what a fit misses of the forces of each
    joint alone tells what it misses for all signs.
    """
    judge = described_log.judge
    rows = described_log.rows
    joints = rows.forces.shape[1]
    fit = judge.weighted_fit(rows, judge.force_weights(rows))
    weights = judge.mask * fit.weights
    forces_of_joints = _apart(rows, weights)
    errors = forces_of_joints - imitations(rows, weights, fit, forces_of_joints)
    products = errors.T @ errors
    patterns = np.array(list(itertools.product((1.0, -1.0), repeat=joints - 1)))
    patterns = np.column_stack([np.ones(len(patterns)), patterns])
    squares = np.einsum("pi,ij,pj->p", patterns, products, patterns)
    best_pattern = patterns[int(np.argmin(squares))]
    return best_pattern, -best_pattern


def _apart(rows: Rows, weights: np.ndarray) -> np.ndarray:
    """Return the weighted forces of each joint, with zeros for the others."""
    weighted_forces = rows.forces * weights
    row_count, joints = weighted_forces.shape
    apart = np.zeros((row_count, joints, joints))
    diagonal = np.arange(joints)
    apart[:, diagonal, diagonal] = weighted_forces
    return apart.reshape(-1, joints)


def signs_text(described_log: DescribedLog, signs: Signs) -> str:
    """Return a sentence about the signs that seem to be wrong."""
    parts = []
    for name, values in (("force", signs.forces), ("angle", signs.angles)):
        wrong_joints = np.flatnonzero(values < 0)
        if len(wrong_joints):
            names = described_log.robot.joint_names
            words = " and ".join(f"`{names[j]}`" for j in wrong_joints)
            parts.append(f"of the {name} of {words} (`recording.{name}_signs`)")
    return f"the signs {', and '.join(parts)} seem to be wrong"
