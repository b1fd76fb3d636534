"""Which parameters of servos, or combinations of some, logs determine, and how well.

An estimate can differ from the truth by the noise of its own motions (spectral
sandwich), by effects that the model lacks and that differ between motions (their
scatter), and by those that differ between equal joints (their scatter). Each counts.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.identification.uncertainty.spectral import sandwich_of_columns

from .joint_fits import SIZE, JointFit, Pull
from .motion import JointParameters
from .servo import INDEX, PARAMETERS, SCALE

MAX_RELATIVE_DEVIATION = 0.25
"""Relative standard deviation of a parameter above which it is not determined."""


@dataclasses.dataclass(frozen=True)
class Combination:
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
        agrees: Whether motions, and equal joints, agree on it as far as noise lets
            them; otherwise the model lacks an effect that disturbs it.
    """

    joint: int
    name: str
    meaning: str
    unit: str
    coefficients: JointParameters
    value: float
    deviation: float
    dof: float
    agrees: bool

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval."""
        quantile = scipy.special.stdtrit(max(self.dof, 1.0), 0.5 + 0.5 * level)
        half_width = self.deviation * float(quantile)
        return self.value - half_width, self.value + half_width


class Deviations(NamedTuple):
    """Uncertainty of some parameters of a joint.

    Attributes:
        covariance: Covariance; zero for parameters that count as known.
        dof: Degrees of freedom of the deviations.
        agrees: Whether motions agree on each as far as noise lets them.
    """

    covariance: np.ndarray
    dof: np.ndarray
    agrees: np.ndarray


class JointRows(NamedTuple):
    """Sensitivities of one joint, less what initial states can imitate.

    Attributes:
        columns: Sensitivities of each motion [parameters, samples].
        residuals: Errors of each motion [samples].
        roots: Roots of the motions' weights.
        gradients: Half the gradient of each motion [motions, parameters].
        information: Gauss-Newton matrix, with the pull between equal joints.
        counted: Share of the samples of each motion that counts.
        sample_time: Mean time between two samples [s].
    """

    columns: list[np.ndarray]
    residuals: list[np.ndarray]
    roots: np.ndarray
    gradients: np.ndarray
    information: np.ndarray
    counted: np.ndarray
    sample_time: float

    def deviations(self, indices: np.ndarray) -> Deviations:
        """Return the uncertainty if only some parameters are unknown."""
        motions = len(self.columns)
        B = np.zeros_like(self.information)
        place = np.ix_(indices, indices)
        B[place] = _inverse(self.information[place])
        squares = np.diag(B)
        sandwich = sandwich_of_columns(
            np,
            [range(len(B))] * motions,
            self.roots,
            B,
            np.zeros((1, len(B))),
            self.columns,
            [residuals[None] for residuals in self.residuals],
            self.counted,
            self.sample_time,
        )
        variance, dof = (x[0] for x in sandwich)
        # The sandwich is blind where no error can show: there the information alone
        # tells.
        sample_count = max(len(self.residuals[0]) * float(self.counted.max()), 1.0)
        variance = np.maximum(variance, squares / sample_count)

        changes = self.gradients @ B
        motion_dof = max(motions - 1, 1)
        scatter = motions / motion_dof * (changes**2).sum(axis=0)
        limit = scipy.stats.f.ppf(0.95, motion_dof, dof)
        is_scattered = (motions > 1) & (scatter > limit * variance)
        dof = np.where(is_scattered, motion_dof, dof)
        deviation = np.sqrt(np.where(is_scattered, scatter, variance))
        factor = deviation / np.sqrt(np.maximum(squares, 1e-300))
        return Deviations(B * np.outer(factor, factor), dof, ~is_scattered)


def rows_of_joints(fit: JointFit) -> list[JointRows]:
    """Return the sensitivities of all joints to all parameters."""
    r, S = fit.simulator.sensitivities(fit.parameters, fit.start)
    equations = fit.equations
    response = equations.response
    by_parameters = S[..., :SIZE, :] + np.einsum(
        "mjst,mjsp->mjpt", S[..., SIZE:, :], response
    )
    pull = fit.pull.precision(fit.parameters)
    information = equations.information.sum(axis=0) + pull[..., None] * np.eye(SIZE)
    motion = fit.simulator.motion
    counted = motion.counted.mean(axis=-1)
    return [
        JointRows(
            list(by_parameters[:, j]),
            list(r[:, j]),
            np.sqrt(fit.weights[:, j]),
            equations.gradient[:, j],
            information[j],
            counted[:, j],
            float(motion.sample_time.mean()),
        )
        for j in range(r.shape[1])
    ]


def _inverse(H: np.ndarray) -> np.ndarray:
    """Return the inverse of an information matrix, finite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-30))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    scaled_inverse = vectors / np.maximum(values, 1e-12) @ vectors.T
    return scaled_inverse / np.outer(size, size)


class Determination(NamedTuple):
    """Parameters and combinations that the logs determine, with their uncertainty.

    Attributes:
        combinations: Parameters and combinations that the logs determine.
        covariance: Covariance of all free parameters, joint by joint.
        dof: Degrees of freedom of their deviations.
    """

    combinations: tuple[Combination, ...]
    covariance: np.ndarray
    dof: np.ndarray


def determined_combinations(
    fit: JointFit, groups: Sequence[Sequence[int]]
) -> Determination:
    """Return what the logs determine, and the uncertainty of all parameters.

    Args:
        fit: Fit.
        groups: Joints of each kind.
    """
    rows = rows_of_joints(fit)
    scatter = _scatter_of_equal_joints(fit, groups)
    kind_sizes = np.ones(len(rows))
    for group in groups:
        kind_sizes[list(group)] = len(group)
    combinations = []
    size = int(fit.free.sum())
    covariance = np.zeros((size, size))
    all_dof = np.zeros(size)
    end = 0
    for j, joint_rows in enumerate(rows):
        symbols = np.flatnonzero(fit.free[j])
        deviations = joint_rows.deviations(symbols)
        place = slice(end, end + len(symbols))
        end += len(symbols)
        covariance[place, place] = deviations.covariance[np.ix_(symbols, symbols)]
        all_dof[place] = deviations.dof[symbols]
        joint = _Joint(fit, j, joint_rows, scatter[j], max(kind_sizes[j] - 1.0, 1.0))
        combinations += joint.combinations(deviations, symbols)
    return Determination(tuple(combinations), covariance, all_dof)


def _scatter_of_equal_joints(
    fit: JointFit, groups: Sequence[Sequence[int]]
) -> np.ndarray:
    """Return the deviations of parameters between equal joints [joints, parameters].

    Of estimates without the pull that makes them alike. Biases are each joint's own.
    Two joints tell no scatter.
    """
    parameters, _ = dataclasses.replace(fit, pull=Pull()).step(
        np.full(len(fit.parameters), 1e-6)
    )
    scatter = np.zeros_like(parameters)
    for group in groups:
        members = list(group)
        if len(members) > 2:
            scatter[members] = np.std(parameters[members], axis=0, ddof=1)
    scatter[:, INDEX["b"]] = 0.0
    return np.where(fit.free, scatter, 0.0)


class _Joint(NamedTuple):
    """One joint of a fit, with the scatter of joints of its kind and its dof."""

    fit: JointFit
    number: int
    rows: JointRows
    scatter: np.ndarray
    scatter_dof: float

    def combinations(
        self, deviations: Deviations, symbols: np.ndarray
    ) -> list[Combination]:
        """Return what the logs determine of the joint."""
        x = self.fit.parameters[self.number]
        sizes = np.maximum(np.abs(x), 0.1 * SCALE)[symbols]
        place = np.ix_(symbols, symbols)
        quantiles = scipy.special.stdtrit(deviations.dof[symbols], 0.975)
        factors = quantiles / scipy.special.ndtri(0.975) / sizes
        reach = np.maximum(np.abs(x[symbols]), SCALE[symbols]) / sizes
        indices, kappa = _merge(
            deviations.covariance[place] * np.outer(factors, factors), reach
        )
        kappa = kappa * sizes[indices][:, None] / sizes[None, :]
        remaining = self.rows.deviations(symbols[indices])
        combinations = []
        for k, i in enumerate(symbols[indices]):
            coefficients = np.zeros(SIZE)
            coefficients[symbols] = kappa[k]
            combinations.append(self._combination(int(i), coefficients, remaining))
        return combinations

    def _combination(
        self, symbol: int, coefficients: np.ndarray, deviations: Deviations
    ) -> Combination:
        """Return a combination, wider where equal joints differ."""
        merged = [m for m in np.flatnonzero(coefficients) if m != symbol]
        name = PARAMETERS[symbol].symbol
        meaning = PARAMETERS[symbol].meaning
        if merged:
            terms = (f"{coefficients[m]:+.3g} {PARAMETERS[m].symbol}" for m in merged)
            meanings = (PARAMETERS[m].meaning for m in merged)
            name = " ".join((name, *terms))
            meaning = f"{meaning} and {', '.join(meanings)} only together"
        noise = float(deviations.covariance[symbol, symbol])
        scatter = float(np.sum((coefficients * self.scatter) ** 2))
        difference = max(scatter - noise, 0.0)
        dof = float(deviations.dof[symbol])
        agrees = bool(deviations.agrees[symbol])
        if difference > noise:
            dof = min(dof, self.scatter_dof)
            agrees = False
        all_coefficients = np.zeros_like(self.fit.parameters)
        all_coefficients[self.number] = coefficients
        return Combination(
            self.number,
            name,
            meaning,
            PARAMETERS[symbol].unit,
            all_coefficients,
            float(coefficients @ self.fit.parameters[self.number]),
            float(np.sqrt(noise + difference)),
            dof,
            agrees,
        )


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
