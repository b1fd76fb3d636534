"""Which parameters of servos, or combinations of some, logs determine, and how well.

An estimate can differ from the truth by the noise of its own motions (spectral
sandwich, or sums over stretches between reversals), by effects that the model lacks and
that differ between motions (their scatter), and by those that differ between equal
joints (their scatter). Each counts.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxid.arrays import Matrix, Vector
from jaxid.identification.uncertainty import Uncertainty
from jaxid.identification.uncertainty.spectral import sandwich_of_columns

from .body_loads import Bodies
from .joint_fits import SIZE, JointFit, Pull
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
        coefficients: Factor of each parameter of the joint.
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
    coefficients: Vector
    value: float
    deviation: float
    dof: float
    agrees: bool

    @property
    def is_determined(self) -> bool:
        """Whether its deviation is a small part of it."""
        return self.deviation < MAX_RELATIVE_DEVIATION * abs(self.value)

    def interval(self, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval."""
        quantile = float(scipy.special.stdtrit(self.dof, 0.5 + 0.5 * level))
        half_width = self.deviation * quantile
        return self.value - half_width, self.value + half_width


class Determination(NamedTuple):
    """Parameters and combinations that the logs determine, with their uncertainty.

    Attributes:
        combinations: Parameters and combinations that the logs determine.
        uncertainty: Uncertainty of all free parameters, joint by joint.
    """

    combinations: tuple[Combination, ...]
    uncertainty: Uncertainty


def determined_combinations(
    fit: JointFit, groups: Sequence[Sequence[int]]
) -> Determination:
    """Return what the logs determine, and the uncertainty of all parameters.

    Args:
        fit: Fit.
        groups: Joints of each kind.
    """
    errors, sensitivities = fit.simulator.sensitivities(fit.parameters, fit.start)
    # Initial states follow the parameters.
    by_start = np.einsum(
        "mjst,mjsp->mjpt", sensitivities[..., SIZE:, :], fit.equations.response
    )
    columns = sensitivities[..., :SIZE, :] + by_start
    scatter = _scatter_of_equal_joints(fit, groups)
    kind_sizes = {j: len(group) for group in groups for j in group}
    combinations = []
    covariances = []
    dof = []
    for j, mask in enumerate(fit.free):
        scatter_dof = max(kind_sizes[j] - 1, 1)
        joint = _Joint(fit, j, errors[:, j], columns[:, j], scatter[j], scatter_dof)
        symbols = np.flatnonzero(mask)
        deviations = joint.deviations(symbols)
        covariances.append(deviations.covariance)
        dof.append(deviations.dof)
        combinations += joint.combinations(symbols, deviations)
    covariance = scipy.linalg.block_diag(*covariances)
    uncertainty = Uncertainty(covariance, np.concatenate(dof), covariance)
    return Determination(tuple(combinations), uncertainty)


def _scatter_of_equal_joints(fit: JointFit, groups: Sequence[Sequence[int]]) -> Matrix:
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


class Deviations(NamedTuple):
    """Uncertainty of some parameters of a joint, if the others are known.

    Attributes:
        covariance: Covariance.
        dof: Degrees of freedom of the deviations.
        agrees: Whether motions agree on each as far as noise lets them.
    """

    covariance: np.ndarray
    dof: np.ndarray
    agrees: np.ndarray


class _Joint(NamedTuple):
    """One joint of a fit.

    Attributes:
        fit: Fit of all joints.
        number: Index of the joint.
        errors: Errors [motions, samples].
        columns: Sensitivities to the parameters, which initial states follow [motions,
            parameters, samples].
        scatter: Deviations of the parameters between joints of its kind.
        scatter_dof: Their degrees of freedom.
    """

    fit: JointFit
    number: int
    errors: np.ndarray
    columns: np.ndarray
    scatter: np.ndarray
    scatter_dof: int

    def deviations(self, symbols: np.ndarray) -> Deviations:
        """Return the uncertainty if only some parameters are unknown."""
        fit = self.fit
        j = self.number
        pull = fit.pull.precision(fit.parameters)[j]
        information = fit.equations.information[:, j].sum(axis=0) + np.diag(pull)
        B = _inverse(information[np.ix_(symbols, symbols)])
        squares = np.diag(B)
        motion = fit.simulator.motion
        motions = motion.motions
        counted = motion.counted[:, j].mean(axis=-1)
        variances, dofs = sandwich_of_columns(
            np,
            [range(len(B))] * motions,
            np.sqrt(fit.weights[:, j]),
            B,
            np.zeros((1, len(B))),
            self.columns[:, symbols],
            self.errors[:, None],
            counted,
            float(motion.sample_time.mean()),
        )
        # Where a joint rests, the rounding of its encoder is the same again and again.
        # No spectrum tells that, as it is the same for all samples.
        stretch_squares = self._changes_by_stretches(symbols, B) ** 2
        stretches = len(stretch_squares)
        stretch_sums = stretch_squares.sum(axis=0)
        stretch_variance = stretches / max(stretches - len(B), 1) * stretch_sums
        fourth_powers = np.maximum((stretch_squares**2).sum(axis=0), 1e-300)
        stretch_dof = np.maximum(3.0 * stretch_sums**2 / fourth_powers - 2.0, 1.0)
        is_wider = stretch_variance > variances[0]
        noise_dof = np.where(is_wider, stretch_dof, dofs[0])
        # Sums are blind where no error can show: there the information alone tells.
        sample_count = max(self.errors.shape[-1] * float(counted.max()), 1.0)
        variance = np.maximum(variances[0], stretch_variance)
        variance = np.maximum(variance, squares / sample_count)

        changes = fit.equations.gradient[:, j, symbols] @ B
        motion_dof = max(motions - 1, 1)
        scatter = motions / motion_dof * (changes**2).sum(axis=0)
        limit = scipy.stats.f.ppf(0.95, motion_dof, noise_dof)
        is_scattered = (motions > 1) & (scatter > limit * variance)
        dof = np.where(is_scattered, motion_dof, noise_dof)
        deviation = np.sqrt(np.where(is_scattered, scatter, variance))
        factor = deviation / np.sqrt(np.maximum(squares, 1e-300))
        return Deviations(B * np.outer(factor, factor), dof, ~is_scattered)

    def _changes_by_stretches(self, symbols: np.ndarray, B: Matrix) -> Matrix:
        """Return changes of estimates by the errors of each stretch of the motions.

        Stretches end in the middle between two reversals.

        Args:
            symbols: Indices of the parameters.
            B: Inverse of their information.

        Returns:
            Changes [stretches, parameters].
        """
        fit = self.fit
        positions = fit.simulator.motion.positions[:, self.number]
        changes = []
        for k, length in enumerate(fit.simulator.motion.lengths):
            errors = self.errors[k]
            starts = stretch_starts((positions[k] + errors)[:length])
            scores = fit.weights[k, self.number] * self.columns[k, symbols] * errors
            changes.append(np.add.reduceat(scores, starts, axis=1).T @ B)
        return np.concatenate(changes)

    def combinations(
        self, symbols: np.ndarray, deviations: Deviations
    ) -> list[Combination]:
        """Return what the logs determine of the joint.

        Args:
            symbols: Indices of its free parameters.
            deviations: Their uncertainty.
        """
        values = self.fit.parameters[self.number, symbols]
        sizes = np.maximum(np.abs(values), 0.1 * SCALE[symbols])
        quantiles = scipy.special.stdtrit(deviations.dof, 0.975)
        factors = quantiles / scipy.special.ndtri(0.975) / sizes
        reach = np.maximum(np.abs(values), SCALE[symbols]) / sizes
        indices, kappa = _merge(
            deviations.covariance * np.outer(factors, factors), reach
        )
        kappa = kappa * sizes[indices][:, None] / sizes
        remaining = self.deviations(symbols[indices])
        bodies = self.fit.simulator.bodies
        combinations = []
        for k, symbol in enumerate(symbols[indices].tolist()):
            coefficients = np.zeros(SIZE)
            coefficients[symbols] = kappa[k]
            scatter = float(np.sum((coefficients * self.scatter) ** 2))
            noise = float(remaining.covariance[k, k])
            difference = max(scatter - noise, 0.0)
            # Wider where equal joints differ.
            is_different = difference > noise
            dof = float(remaining.dof[k])
            combination = Combination(
                self.number,
                *_description(symbol, coefficients),
                unit_of_joint(PARAMETERS[symbol].unit, self.number, bodies),
                coefficients,
                float(coefficients @ self.fit.parameters[self.number]),
                float(np.sqrt(noise + difference)),
                min(dof, self.scatter_dof) if is_different else dof,
                bool(remaining.agrees[k]) and not is_different,
            )
            combinations.append(combination)
        return combinations


def stretch_starts(path: Vector) -> np.ndarray:
    """Return the first samples of stretches that hold one reversal of a path each."""
    steps = np.diff(path)
    moves = np.flatnonzero(steps)
    signs = np.sign(steps[moves])
    reversals = moves[1:][signs[1:] != signs[:-1]]
    middles = (reversals[1:] + reversals[:-1]) // 2
    return np.unique([0, *middles])


def _description(symbol: int, coefficients: Vector) -> tuple[str, str]:
    """Return name and meaning of a parameter and those that are merged into it."""
    name, meaning, *_ = PARAMETERS[symbol]
    merged = [m for m in np.flatnonzero(coefficients) if m != symbol]
    if not merged:
        return name, meaning
    terms = (f"{coefficients[m]:+.3g} {PARAMETERS[m].symbol}" for m in merged)
    meanings = ", ".join(PARAMETERS[m].meaning for m in merged)
    return " ".join((name, *terms)), f"{meaning} and {meanings} only together"


def unit_of_joint(unit: str, joint: int, bodies: Bodies | None) -> str:
    """Return the unit of a value of a joint that turns, or that of one that slides."""
    if bodies is None or bodies.model.robot.revolute[joint]:
        return unit
    linear_unit = unit.replace("(N m)", "N").replace("N m", "N").replace("kg m²", "kg")
    return linear_unit.replace("rad", "m")


def _inverse(H: Matrix) -> Matrix:
    """Return the inverse of an information matrix, finite where nothing is known."""
    size = np.sqrt(np.maximum(np.diag(H), 1e-30))
    values, vectors = np.linalg.eigh(H / np.outer(size, size))
    scaled_inverse = vectors / np.maximum(values, 1e-12) @ vectors.T
    return scaled_inverse / np.outer(size, size)


def _merge(covariance: Matrix, reach: Vector) -> tuple[np.ndarray, Matrix]:
    """Return which relative parameters are determined, and how others merge into them.

    A parameter is determined if its deviation is at most `MAX_RELATIVE_DEVIATION` when
    only those before it are unknown, too.

    Args:
        covariance: Covariance of the relative parameters.
        reach: Usual size of each, to which it may change if it is not determined.
    """
    information = _inverse(covariance)
    indices: list[int] = []
    for k in range(len(covariance)):
        unknowns = [*indices, k]
        inverse = _inverse(information[np.ix_(unknowns, unknowns)])
        if inverse[-1, -1] < MAX_RELATIVE_DEVIATION**2:
            indices.append(k)
    inverse = _inverse(information[np.ix_(indices, indices)])
    kappa = inverse @ information[indices]
    kappa[:, indices] = np.eye(len(indices))
    # What changes a combination by less than its deviation is left out.
    min_change = np.minimum(0.02, np.sqrt(np.diag(inverse)))
    kappa[np.abs(kappa) * reach < min_change[:, None]] = 0.0
    return np.array(indices, int), kappa
