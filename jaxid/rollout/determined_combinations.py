"""Which parameters of servos, or combinations of some, logs determine, and how well."""

from typing import NamedTuple

import numpy as np
from scipy import special, stats

from jaxid.identification.uncertainty.spectral import sandwich_of_columns

from .coupled_refinement import Refinement, weights_of
from .motion import JointParameters
from .servo import PARAMETERS, SCALE

MAX_RELATIVE_DEVIATION = 0.25
"""Relative standard deviation of a parameter above which it is not determined."""


class Combination(NamedTuple):
    """Parameter of a joint, or combination of some, that the logs determine.

    Attributes:
        joint: Index of the joint.
        name: Parameter, with those that are merged into it.
        meaning: Description in words.
        unit: Unit.
        coefficients: Factor of each parameter of all joints.
        value: Estimate.
        deviation: Standard deviation.
        dof: Degrees of freedom of the deviation.
    """

    joint: int
    name: str
    meaning: str
    unit: str
    coefficients: JointParameters
    value: float
    deviation: float
    dof: float

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval."""
        half_width = self.deviation * float(
            special.stdtrit(max(self.dof, 1.0), 0.5 + 0.5 * level)
        )
        return self.value - half_width, self.value + half_width


class _Rows(NamedTuple):
    """Weighted sensitivities of a refinement, less what initial states can imitate.

    Attributes:
        refinement: Refinement.
        weights: Weight of each motion's squared errors [motions, joints].
        imitations: Initial states that imitate each parameter [motions, states,
            parameters].
        scores: Sensitivities times residuals [motions, parameters].
        information: Gauss-Newton matrix.
    """

    refinement: Refinement
    weights: np.ndarray
    imitations: np.ndarray
    scores: np.ndarray
    information: np.ndarray

    @classmethod
    def of(cls, refinement: Refinement) -> "_Rows":
        """Return the rows of a refinement."""
        weights = weights_of(refinement.simulator.motion, refinement.sums)
        size = refinement.simulator.motion.start[0].size
        scores = []
        imitations = []
        information = np.zeros((int(refinement.free.sum()),) * 2)
        certainties = refinement.simulator.motion.certainty
        for w, g, H, certainty in zip(
            weights, *refinement.products, certainties, strict=True
        ):
            motion_g = w @ g
            motion_H = np.tensordot(w, H, 1)
            by_states = motion_H[-size:]
            state_information = by_states[:, -size:] + np.diag(certainty.ravel())
            imitation = np.linalg.solve(state_information, by_states[:, :-size])
            imitations.append(imitation)
            scores.append(motion_g[:-size] - motion_g[-size:] @ imitation)
            by_parameters = motion_H[:-size]
            information += by_parameters[:, :-size]
            information -= by_parameters[:, -size:] @ imitation
        return cls(
            refinement, weights, np.stack(imitations), np.stack(scores), information
        )

    @property
    def columns(self) -> list[np.ndarray]:
        """Sensitivities of each motion and joint [parameters, samples]."""
        columns = []
        for S, start in zip(
            self.refinement.sensitivities, self.imitations, strict=True
        ):
            by_parameters = S[..., : -len(start)]
            by_start = S[..., -len(start) :]
            columns += list(np.swapaxes(by_parameters - by_start @ start, 1, 2))
        return columns

    def covariance(
        self, columns: list, indices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return covariance and degrees of freedom if only some parameters are unknown.

        The spectral sandwich, at least that of independent errors; where motions differ
        more than it explains, their scatter.
        """
        motion = self.refinement.simulator.motion
        motions, joints = self.weights.shape
        channels = motions * joints
        sample_mask = np.asarray(motion.counted)
        B = np.zeros_like(self.information)
        place = np.ix_(indices, indices)
        B[place] = _inverse(self.information[place])
        squares = np.diag(B)
        sandwich = sandwich_of_columns(
            np,
            [range(len(B))] * channels,
            np.sqrt(self.weights).ravel(),
            B,
            np.zeros((1, len(B))),
            columns,
            list(self.refinement.residuals.reshape(channels, 1, -1)),
            sample_mask.mean(axis=-1).ravel(),
            float(motion.sample_time.mean()),
        )
        variance, dof = (x[0] for x in sandwich)
        # The sandwich is blind where no error can show: there the information alone
        # tells.
        sample_count = float(sample_mask.sum(axis=-1).max())
        variance = np.maximum(variance, squares / max(sample_count, 1.0))
        changes = self.scores @ B
        motion_dof = max(motions - 1, 1)
        scatter = motions / motion_dof * (changes**2).sum(axis=0)
        limit = stats.f.ppf(0.95, motion_dof, dof)
        is_scattered = (motions > 1) & (scatter > limit * variance)
        dof = np.where(is_scattered, motion_dof, dof)
        deviation = np.sqrt(np.where(is_scattered, scatter, variance))
        scale = deviation / np.sqrt(np.maximum(squares, 1e-300))
        return B * np.outer(scale, scale), dof


def _inverse(H: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, finite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-30))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    scaled_inverse = vectors / np.maximum(values, 1e-12) @ vectors.T
    return scaled_inverse / np.outer(size, size)


def determined_combinations(
    refinement: Refinement, joint_names: tuple[str, ...]
) -> tuple[tuple[Combination, ...], np.ndarray, np.ndarray]:
    """Return the determined combinations, and covariance and dof of all parameters."""
    rows = _Rows.of(refinement)
    x = refinement.parameters[refinement.free]
    joints, symbols = np.nonzero(refinement.free)
    columns = rows.columns
    covariance, parameter_dof = rows.covariance(columns, np.arange(len(x)))
    size = np.maximum(np.abs(x), 0.1 * SCALE[symbols])
    interval_factors = (
        special.stdtrit(parameter_dof, 0.975) / special.ndtri(0.975) / size
    )
    indices, kappa = _merge(
        covariance * np.outer(interval_factors, interval_factors),
        np.maximum(np.abs(x), SCALE[symbols]) / size,
    )
    kappa = kappa * size[indices][:, None] / size[None, :]
    combination_covariance, dof = rows.covariance(columns, indices)
    combinations = []
    for k, i in enumerate(indices):
        coefficients = np.zeros(refinement.parameters.shape)
        coefficients[refinement.free] = kappa[k]
        name = PARAMETERS[symbols[i]].symbol
        meaning = PARAMETERS[symbols[i]].meaning
        merged_meanings = []
        for m in np.flatnonzero(kappa[k]):
            if m != i:
                is_elsewhere = joints[m] != joints[i]
                owner = f" of {joint_names[joints[m]]}" if is_elsewhere else ""
                name += f" {kappa[k, m]:+.3g} {PARAMETERS[symbols[m]].symbol}{owner}"
                merged_meanings.append(PARAMETERS[symbols[m]].meaning + owner)
        if merged_meanings:
            meaning = f"{meaning} and {', '.join(merged_meanings)} only together"
        numbers = (
            float(kappa[k] @ x),
            float(np.sqrt(combination_covariance[i, i])),
            float(dof[i]),
        )
        unit = PARAMETERS[symbols[i]].unit
        place = int(joints[i]), name, meaning, unit, coefficients
        combinations.append(Combination(*place, *numbers))
    return tuple(combinations), covariance, parameter_dof


def _merge(covariance: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which relative parameters are determined, and how others merge into them.

    Args:
        covariance: Covariance of the relative parameters.
        reach: Usual size of each, to which it may change if it is not determined.

    A parameter is not determined if, with those before it known only by the logs, its
    deviation exceeds `MAX_RELATIVE_DEVIATION`: its column of the information's root
    adds almost nothing.
    """
    n = len(covariance)
    information = _inverse(covariance)
    values, vectors = np.linalg.eigh(information)
    W = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    indices: list[int] = []
    Q = np.zeros((n, 0))
    for k in range(n):
        column = W[:, k]
        remainder = column - Q @ (Q.T @ column)
        length = np.linalg.norm(remainder)
        if length > 1.0 / MAX_RELATIVE_DEVIATION:
            indices.append(k)
            Q = np.column_stack([Q, remainder / length])
    kappa = np.zeros((len(indices), n))
    if indices:
        columns = W[:, indices]
        kappa = np.linalg.lstsq(columns, W, rcond=None)[0]
        kappa[:, indices] = np.eye(len(indices))
        # What changes a combination by less than its deviation is left out.
        deviation = np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
        min_change = np.minimum(0.02, deviation)[:, None]
        kappa[np.abs(kappa) * reach < min_change] = 0.0
    return np.array(indices, int), kappa
