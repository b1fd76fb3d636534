"""Choice between models and estimators by errors on data unseen by their fits."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations, ObservedLogs, Progress
from jaxid.result_table import Column, Remark, Status, Summarised, Table, percent

from .estimators import AbstractEstimator, WeightedLeastSquares
from .factors import Blocks, Factors
from .problem import RegressionProblem, cross_validation_folds

MIN_LOGS = 4
"""Number of logs from which whole logs are left out, instead of parts of time."""
MIN_BLOCKS = 3
"""Blocks of rows without which nothing remains for a fit once two are left out."""


class ModelCandidate(NamedTuple):
    """A model and an estimator.

    Attributes:
        name: Name in tables.
        base: Base parameters of the model.
        estimator: Estimator of the parameters.
    """

    name: str
    base: BaseParameters
    estimator: AbstractEstimator = WeightedLeastSquares()


class ModelChoice(Summarised, eqx.Module):
    """Result of a choice of models.

    Attributes:
        candidates: The candidates, in the given order.
        errors: Error of each candidate on each part of the data, fitted to all other
            parts, relative to the forces.
        best: Index of the candidate that is chosen.
        promise: Error to expect on further data of this kind, relative to the forces:
            each part was predicted by the candidate that the other parts choose.
        parts: What was left out in turn, in words.
    """

    candidates: tuple[ModelCandidate, ...]
    errors: Float[AnyArray, "candidates parts"]
    best: int = eqx.field(static=True)
    promise: float
    parts: str = eqx.field(static=True)

    @property
    def chosen(self) -> ModelCandidate:
        """The candidate that is chosen."""
        return self.candidates[self.best]

    def summary(self) -> Table:
        """Return a table of all candidates, the smallest error first."""
        squares = np.square(self.errors)
        means = squares.mean(axis=1)
        order = np.argsort(means).tolist()
        excess = _excess(squares)
        # A small change of a square root is half of it over the root.
        slopes = 0.5 / np.sqrt(means)
        return Table(
            "models by their errors on parts that were left out",
            Column("model", [self.candidates[k].name for k in order]),
            Column("parameters", [self.candidates[k].base.size for k in order]),
            Column("error", np.sqrt(means)[order].tolist(), "%", percent),
            Column(
                "above the best", (slopes * excess.mean)[order].tolist(), "%", percent
            ),
            Column(
                "one deviation",
                (slopes * excess.deviation)[order].tolist(),
                "%",
                percent,
            ),
            remarks=[Remark(str(self))],
            status=[Status.GOOD if k == self.best else Status.NEUTRAL for k in order],
        )

    def __str__(self):
        return (
            f"`{self.chosen.name}` is the simplest model whose error exceeds "
            "the smallest one by at most one deviation of the difference. "
            f"On further data of this kind expect errors of {percent(self.promise)} % "
            f"of the forces: {self.parts} were left out in turn, "
            "and the choice was repeated without each."
        )


def choose_model(
    candidates: Sequence[ModelCandidate],
    observations: ObservedLogs,
    *,
    progress: Progress | None = None,
) -> ModelChoice:
    """Choose the simplest model that predicts unseen data about as well as any other.

    Parts of time are left out in turn, or whole logs if there are at least four. Each
    candidate is fitted to the rest and predicts the part. Of all candidates whose mean
    squared error exceeds the smallest one by at most one standard deviation of the
    difference, the one with the fewest parameters is chosen (Breiman et al., 1984).
    Among models with equally many parameters the same rule prefers friction with
    memory, because only such a model predicts the force of a joint at rest.

    The promised error comes from a second loop around this choice: otherwise it would
    be too small, since the choice has seen the errors. Presliding lengths are not
    fitted: find them before, with `identify_presliding`.

    Args:
        candidates: Models of one robot, and their estimators.
        observations: Observations of one log, or of several.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or too few rows.
    """
    if not candidates:
        raise InputError("`candidates` must hold at least one model, but is empty.")
    is_one_log = isinstance(observations, Observations)
    logs = (observations,) if is_one_log else tuple(observations)
    by_log = len(logs) >= MIN_LOGS

    # All candidates are judged with the weights of the first.
    first = candidates[0]
    parts = _parts(first.base, logs, by_log)
    problem = RegressionProblem(first.base, blocks=Blocks(parts))
    weights = np.asarray(first.estimator(problem).weights)
    joint_weights = weights**2
    force_squares = [joint_weights @ part.force_squares for part in parts]
    mean_force_square = float(np.mean(force_squares))
    tables = []
    for number, candidate in enumerate(candidates):
        if candidate is not first:
            parts = _parts(candidate.base, logs, by_log)
        part_squares = _held_out_squares(candidate, parts, joint_weights)
        tables.append(part_squares / mean_force_square)
        if progress is not None:
            progress((number + 1) / len(candidates))
    table = np.array(tables)

    # On the diagonal of its table a fit leaves out one part, and predicts it.
    count = len(parts)
    squares = np.diagonal(table, axis1=1, axis2=2)
    choice = _simplest_candidate(squares, candidates)
    return ModelChoice(
        candidates=tuple(candidates),
        errors=np.sqrt(squares),
        best=choice,
        promise=_promise(table, candidates),
        parts=f"{count} logs" if by_log else f"{count} parts of time",
    )


def _parts(base: BaseParameters, logs: Sequence[Observations], by_log: bool):
    """Return the factors of the parts that are left out in turn."""
    if by_log:
        return tuple(RegressionProblem(base, [log]).factors for log in logs)
    blocks = RegressionProblem(base, logs).blocks
    if len(blocks.parts) < MIN_BLOCKS:
        raise InputError(
            "a choice of models needs at least three blocks of rows: record longer."
        )
    folds = cross_validation_folds(blocks)
    return tuple(blocks.select(test_part).total for _, test_part in folds)


def _held_out_squares(
    candidate: ModelCandidate, parts: Sequence[Factors], joint_weights
) -> np.ndarray:
    """Return the squared errors on the second part of fits without both [parts, parts].

    On the diagonal only that part was left out.
    """
    squares = np.zeros((len(parts), len(parts)))
    numbers = range(len(parts))
    for i, k in itertools.combinations_with_replacement(numbers, 2):
        training = tuple(parts[n] for n in numbers if n not in (i, k))
        problem = RegressionProblem(candidate.base, blocks=Blocks(training))
        p = candidate.estimator(problem).parameters
        for row, part in ((i, k), (k, i)):
            joint_squares = parts[part].residual_squares(p)
            squares[row, part] = joint_weights @ joint_squares
    return squares


def _promise(table, candidates: Sequence[ModelCandidate]) -> float:
    """Return the error on parts of the candidates that the other parts choose.

    The table has the squared errors on the second part of fits without both
    [candidates, parts, parts].
    """
    squares = []
    numbers = range(table.shape[1])
    for part in numbers:
        other_parts = [n for n in numbers if n != part]
        choice = _simplest_candidate(table[:, part, other_parts], candidates)
        # The error on a part that neither the choice nor the fit has used.
        squares.append(table[choice, part, part])
    return float(np.sqrt(np.mean(squares)))


class Excess(NamedTuple):
    """Squared errors above those of the best candidate."""

    mean: np.ndarray
    deviation: np.ndarray  # standard deviation of the mean


def _excess(squares: np.ndarray) -> Excess:
    """Return by how much squared errors [candidates, parts] exceed the smallest."""
    best_number = np.argmin(squares.mean(axis=1))
    differences = squares - squares[best_number]
    deviations = differences.std(axis=1, ddof=1) / np.sqrt(squares.shape[1])
    return Excess(differences.mean(axis=1), deviations)


def _simplest_candidate(
    squares: np.ndarray,
    candidates: Sequence[ModelCandidate],
) -> int:
    """Return the simplest of the candidates that are about as good as the best one.

    Of candidates with equally many parameters, those with memory are preferred.

    Args:
        squares: Squared errors on parts [candidates, parts].
        candidates: Candidates.
    """
    sizes = np.array([c.base.size for c in candidates])
    lacks_memory = np.array([c.base.model.memory is None for c in candidates])
    indices = np.arange(len(candidates))
    for ranks in (sizes, lacks_memory):
        excess = _excess(squares[indices])
        indices = indices[excess.mean <= excess.deviation]
        remaining_ranks = ranks[indices]
        indices = indices[remaining_ranks == remaining_ranks.min()]
    means = squares[indices].mean(axis=1)
    return int(indices[np.argmin(means)])
