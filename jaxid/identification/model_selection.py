"""Choice between models and estimators by errors on data that their fits have not seen."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations, Progress
from jaxid.result_table import Column, Remark, Status, Summarised, Table, percent

from .estimators import AbstractEstimator, WeightedLeastSquares
from .factors import Blocks, Factors
from .problem import RegressionProblem, cross_validation_folds


class Candidate(NamedTuple):
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

    candidates: tuple[Candidate, ...]
    errors: Float[AnyArray, "candidates parts"]
    best: int = eqx.field(static=True)
    promise: float
    parts: str = eqx.field(static=True)

    @property
    def chosen(self) -> Candidate:
        """The candidate that is chosen."""
        return self.candidates[self.best]

    def summary(self) -> Table:
        """Return a table of all candidates, the smallest error first."""
        squares = np.square(self.errors)
        means = squares.mean(axis=1)
        order = np.argsort(means).tolist()
        excess, deviations = _excess(squares)
        half = 0.5 / np.sqrt(means)
        columns = np.sqrt(means), half * excess, half * deviations
        error, above, deviation = (x[order].tolist() for x in columns)
        return Table(
            "models by their errors on parts that were left out",
            Column("model", [self.candidates[k].name for k in order]),
            Column("parameters", [self.candidates[k].base.size for k in order]),
            Column("error", error, "%", percent),
            Column("above the best", above, "%", percent),
            Column("one deviation", deviation, "%", percent),
            remarks=[Remark(str(self))],
            status=[Status.GOOD if k == self.best else Status.NEUTRAL for k in order],
        )

    def __str__(self):
        return (
            f"`{self.chosen.name}` is the simplest model whose error exceeds the "
            "smallest one by "
            "at most one deviation of the difference. On further data of this kind "
            "expect errors "
            f"of {percent(self.promise)} % of the forces: {self.parts} were left out "
            "in turn, and "
            "the choice was repeated without each."
        )


def choose_model(
    candidates: Sequence[Candidate],
    observations: Observations | Sequence[Observations],
    *,
    progress: Progress | None = None,
) -> ModelChoice:
    """Choose the simplest model that predicts unseen parts of the data about as well as any.

    Parts of time are left out in turn, or whole logs if there are at least four. Each
    candidate is fitted to the rest and predicts the part. Of all candidates whose mean
    squared error exceeds the smallest one by at most one standard deviation of the
    difference, the one with the fewest parameters is chosen (Breiman et al., 1984). Of
    equally many parameters one whose friction has memory is preferred by the same rule:
    no other says which force a joint at rest keeps, even where no part holds rest. The
    promise comes from a second loop around this choice, so that choosing does not make
    it too small. Lengths of presliding are those of the candidates: find them before,
    with `identify_presliding`.

    Args:
        candidates: Models of one robot, and their estimators.
        observations: Observations of one log, or of several.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If there are no candidates, or too few rows.
    """
    if not candidates:
        raise InputError("`candidates` must hold at least one model, but is empty.")
    logs = (
        (observations,)
        if isinstance(observations, Observations)
        else tuple(observations)
    )
    first, by_log = candidates[0], len(logs) >= 4
    folds = _folds(first.base, logs, by_log)
    # All candidates are judged with the weights of the first.
    weights = first.estimator(
        RegressionProblem(first.base, blocks=Blocks(tuple(folds)))
    ).weights
    weights = np.asarray(weights) ** 2
    total = float(np.mean([weights @ fold.force_squares for fold in folds]))
    tables = []
    for number, candidate in enumerate(candidates):
        folds = folds if number == 0 else _folds(candidate.base, logs, by_log)
        tables.append(_held_out_squares(candidate, folds, weights) / total)
        if progress is not None:
            progress((number + 1) / len(candidates))
    table = np.array(tables)
    parts = table.shape[1]
    alone = np.arange(parts)
    squares = table[:, alone, alone]
    ranks = [(c.base.size, c.base.model.memory is None) for c in candidates]
    outer = []
    for out in alone:
        rest = np.setdiff1d(alone, [out])
        outer.append(squares[_simplest(table[:, out, rest], ranks), out])
    return ModelChoice(
        tuple(candidates),
        np.sqrt(squares),
        _simplest(squares, ranks),
        float(np.sqrt(np.mean(outer))),
        f"{parts} logs" if by_log else f"{parts} parts of time",
    )


def _folds(
    base: BaseParameters, logs: Sequence[Observations], by_log: bool
) -> list[Factors]:
    """Return the factors of the parts that are left out in turn."""
    if by_log:
        return [RegressionProblem(base, [log]).factors for log in logs]
    blocks = RegressionProblem(base, logs).blocks
    if len(blocks.parts) < 3:
        raise InputError(
            "a choice of models needs at least three blocks of rows: record longer."
        )
    return [blocks.select(part).total for _, part in cross_validation_folds(blocks)]


def _held_out_squares(
    candidate: Candidate, folds: list[Factors], weights: np.ndarray
) -> np.ndarray:
    """Return the squared errors on the second part of fits without both [parts, parts].

    On the diagonal only that part was left out.
    """
    found = np.zeros((len(folds), len(folds)))
    for i, k in itertools.combinations_with_replacement(range(len(folds)), 2):
        rest = Blocks(
            tuple(x for number, x in enumerate(folds) if number not in (i, k))
        )
        p = candidate.estimator(
            RegressionProblem(candidate.base, blocks=rest)
        ).parameters
        found[i, k], found[k, i] = (
            weights @ folds[n].residual_squares(p) for n in (k, i)
        )
    return found


def _excess(squares: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much squared errors exceed the smallest ones, and standard deviations of it."""
    differences = squares - squares[np.argmin(squares.mean(axis=1))]
    deviations = differences.std(axis=1, ddof=1) / np.sqrt(squares.shape[1])
    return differences.mean(axis=1), deviations


def _simplest(squares: np.ndarray, ranks: Sequence[tuple[int, bool]]) -> int:
    """Return the candidate of the lowest rank that is about as good as the best one.

    The last comparison is between candidates with equally many parameters.
    """
    good = np.arange(len(squares))
    for key in zip(*ranks, strict=True):
        excess, deviations = _excess(squares[good])
        good = good[excess <= deviations]
        good = good[np.array(key)[good] == min(np.array(key)[good])]
    return int(good[np.argmin(squares[good].mean(axis=1))])
