"""Result of an identification: estimates, covariance, factors; and its file."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import BaseMatrix, BaseVector, Indices, Matrix, Texts, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.open_directions import (
    OPEN_SHARES,
    UndeterminedDirection,
    random_rows,
    status_of,
)
from jaxid.errors import InputError
from jaxid.io import (
    import_extra,
    json_text,
    to_json,
    write_text,
)
from jaxid.measurement.observations import Observations
from jaxid.result_table import (
    Column,
    Remark,
    Status,
    Summarised,
    Table,
    percent,
    significant,
    with_deviations,
)

from .consistency.estimator import Consistency
from .estimators.estimate import AbstractEstimator, EstimatorInWords
from .estimators.regularisation_and_weights import (
    AbstractSpectralSolution,
    Complete,
    Decomposition,
)
from .factors import Blocks, LinearSystem
from .uncertainty.result import ResidualSpectra, Uncertainty

MAX_NAMED = 8
"""Number of undetermined combinations that are named, the weakest ones."""
FORMAT = "jaxid model"
"""Entry of a model file that tells what it is."""
VERSION = 1
"""Version of the entries of a model file."""


class ConditionNumbers(eqx.Module):
    """Condition numbers of the observation matrix.

    Attributes:
        raw: As it is, in SI units.
        weighted: With the weights of the fit.
        scaled: Weighted, with columns of length one: free of units.
    """

    raw: float
    weighted: float
    scaled: float


class Fit(Summarised, eqx.Module):
    """Identified base parameters with their uncertainty.

    Attributes:
        base: Base parameters, as combinations of standard parameters.
        parameters: Estimates, in the units of `base.units`.
        uncertainty: Uncertainty of the estimates.
        weights: Weights of the joints' rows [1/(N m) or 1/N].
        condition_numbers: Condition numbers of the observation matrix.
        rows: Number of rows of each joint.
        residual_rms: RMS of the residuals of each joint [N m or N].
        residual: Norm of all residuals relative to the norm of all forces.
        undetermined: Combinations that these observations do not determine.
        estimator: Estimator that made the fit.
        solution: Solution of the system, with all its settings determined.
        recordings: Names of the observations.
        notes: Sentences for the user.
        consistency: Properties of a physically consistent estimate.
        full_parameters: Standard parameters, of an estimator that finds a complete set
            of them.
        residual_spectra: Spectra of each joint's residuals, and their whiteness; None
            where only factors of the rows were known.
        date: Day on which the fit was made, like 2026-01-31; empty if it is not known.
        blocks: Factors of the rows by contiguous blocks of time, for later functions;
            None if they are not known.
        name: Name of the fit, such as `cold`; by default the names of its recordings.
    """

    base: BaseParameters
    parameters: BaseVector
    uncertainty: Uncertainty
    weights: Vector
    condition_numbers: ConditionNumbers
    rows: Indices = eqx.field(static=True)
    residual_rms: Vector
    residual: float
    undetermined: tuple[UndeterminedDirection, ...]
    estimator: AbstractEstimator
    solution: AbstractSpectralSolution
    recordings: Texts = eqx.field(static=True)
    notes: Texts = eqx.field(static=True)
    consistency: Consistency | None = None
    full_parameters: Vector | None = None
    residual_spectra: ResidualSpectra | None = None
    date: str = eqx.field(static=True, default="")
    blocks: Blocks | None = None
    name: str = eqx.field(static=True, default="")

    @property
    def covariance(self) -> BaseMatrix:
        """Covariance of the estimates; infinite variances where nothing is known."""
        return self.uncertainty.covariance

    @property
    def standard_deviations(self) -> BaseVector:
        """Standard deviations of the estimates; infinite where nothing is known."""
        return self.uncertainty.standard_deviations

    @property
    def naive_standard_deviations(self) -> BaseVector:
        """Standard deviations for independent rows, which filtered rows are not."""
        return self.uncertainty.naive_standard_deviations

    def intervals(self, level: float = 0.95) -> Matrix:
        """Return confidence intervals of the parameters.

        They tell how far noise can take the estimates of a model that is right: errors
        that every recording of this kind would share (a wrong geometry, a missing
        effect) are not in them. Those of a consistent estimate reach so far that they
        include the interval without bounds and prior.

        Args:
            level: Probability (0 to 1) that an interval contains the truth.

        Raises:
            InputError: If `level` is not between 0 and 1.
        """
        half_widths = self.uncertainty.half_widths(level)
        if self.consistency is not None:
            half_widths = half_widths + np.abs(self.consistency.shift)
        lower_ends = self.parameters - half_widths
        return np.stack([lower_ends, self.parameters + half_widths], axis=1)

    def draws(self, count: int, *, seed: int = 0) -> Matrix:
        """Return random parameters, as likely as `covariance` and `intervals` say.

        A consistent estimate widens its intervals, but not these. Bodies of a draw can
        be impossible where the logs determine little.

        Args:
            count: Number of draws.
            seed: Seed of the random numbers.

        Raises:
            InputError: If the logs leave a parameter open altogether.
        """
        return self.parameters + self.uncertainty.random_errors(count, seed)

    def columns(self) -> dict[str, Any]:
        """Return names, estimates and intervals, as `parameters.csv` holds them."""
        intervals = self.intervals(0.95)
        return {
            "name": self.base.names,
            "expression": self.base.expressions,
            "unit": self.base.units,
            "group": self.base.kinds,
            "estimate": self.parameters,
            "standard_deviation": self.standard_deviations,
            "open_share": self.open_shares,
            "low_95": intervals[:, 0],
            "high_95": intervals[:, 1],
            "degrees_of_freedom": self.uncertainty.dof,
            "naive_standard_deviation": self.naive_standard_deviations,
            "ratio_to_naive": self.uncertainty.ratios,
        }

    def to_polars(self) -> Any:
        """Return `columns` as a `polars.DataFrame`: one row for each parameter."""
        import polars  # loaded by those who want a frame

        return polars.DataFrame(self.columns())

    def to_pandas(self) -> Any:
        """Return `columns` as a `pandas.DataFrame`: one row for each parameter.

        Raises:
            InputError: If pandas is not installed.
        """
        pandas = import_extra("pandas", "pandas", "`to_pandas` needs")
        return pandas.DataFrame(self.columns())

    @property
    def open_shares(self) -> BaseVector:
        """Share of the forces (fraction) that each estimate leaves open by itself.

        It is half the width of its 95 % interval, as forces on random motions within
        the robot's limits, relative to all forces there.
        """
        rows = random_rows(self.base, self.parameters)
        return self.uncertainty.half_widths() * np.linalg.norm(rows, axis=0)

    @property
    def trust(self) -> tuple[Status, ...]:
        """Judgement of each estimate by the share of the forces that it leaves open.

        `GOOD` up to a tenth; `DOUBTFUL` up to half; `BAD` above.
        """
        return tuple(map(status_of, self.open_shares))

    @property
    def time_blocks(self) -> Blocks:
        """The factors by contiguous blocks of time.

        Raises:
            InputError: If the fit does not hold its factors.
        """
        if self.blocks is None:
            raise InputError(
                f"the fit `{self.name}` does not hold its factors: identify again."
            )
        return self.blocks

    @property
    def factor(self) -> LinearSystem:
        """Matrix and right-hand side with the norms of all weighted rows (Eq. 29).

        Raises:
            InputError: If the fit does not hold its factors.
        """
        return self.time_blocks.total.weighted(self.weights)

    @property
    def is_least_squares(self) -> bool:
        """Whether estimates are weighted least squares of the rows, up to rounding."""
        R, z = self.factor
        difference = self.parameters - Decomposition.of(R, z).solve()
        return bool(np.linalg.norm(R @ difference) <= 1e-7 * np.linalg.norm(z))

    @property
    def condition_number(self) -> float:
        """Condition number of the observation matrix in SI units."""
        return self.condition_numbers.raw

    @property
    def standard_parameters(self) -> Vector:
        """Standard parameters with the same forces.

        Physical masses and inertias only if the estimator finds such
        (`full_parameters`).
        """
        if self.full_parameters is not None:
            return self.full_parameters
        return np.asarray(self.base.to_standard(self.parameters))

    @property
    def facts(self) -> list[tuple[str, str]]:
        """Rows, condition numbers, residual and trust, each with its word."""
        numbers = self.condition_numbers
        rows = f"{min(self.rows)} to {max(self.rows)}"
        if min(self.rows) == max(self.rows):
            rows = str(self.rows[0])
        return [
            ("rows per joint", rows),
            (
                "condition number",
                f"{significant(numbers.raw, 4)} in SI units, "
                f"{significant(numbers.weighted, 4)} weighted, "
                f"{significant(numbers.scaled, 4)} weighted with columns of length one",
            ),
            (
                "residual",
                f"{percent(self.residual, 3)} % of the forces (norms over all rows)",
            ),
            (
                "estimates",
                f"{self.trust.count(Status.GOOD)} of {self.base.size} make at most "
                f"{100 * OPEN_SHARES.doubtful:g} % of the forces uncertain",
            ),
        ]

    @property
    def determination(self) -> list[Remark]:
        """Combinations that the logs do not determine, and what to do about them."""
        size = self.base.size
        count = len(self.undetermined)
        if not count:
            text = f"These logs determine all {size} base parameters."
            return [Remark(text, Status.GOOD)]
        combinations = "1 combination" if count == 1 else f"{count} combinations"
        worst_share = max(direction.uncertainty for direction in self.undetermined)
        consequence = "some of which the motion does not excite at all"
        if np.isfinite(worst_share):
            share = percent(worst_share)
            consequence = (
                f"up to {share} % of the forces of other motions are uncertain"
            )
        headline = (
            "NOT DETERMINED by these logs: "
            f"{combinations} of the {size} base parameters, {consequence}."
        )
        remarks = [Remark(headline, status_of(worst_share))]
        for direction in self.undetermined[:MAX_NAMED]:
            detail = "not moved at all"
            if np.isfinite(direction.uncertainty):
                detail = (
                    f"makes {percent(direction.uncertainty)} % of the forces uncertain"
                )
            detail += f"; singular value {direction.singular_value:.1e} of the largest"
            sentence = f"{direction.sentence(self.base)}."
            remarks.append(Remark(sentence, status_of(direction.uncertainty), detail))
        if count > MAX_NAMED:
            remarks.append(Remark(f"And {count - MAX_NAMED} more"))
        advice = (
            "A combination counts as not determined if its 95 % interval makes more "
            f"than {100 * OPEN_SHARES.doubtful:g} % of the forces uncertain, for "
            "random motions within the robot's limits. The estimates of these "
            "parameters must not be used individually, and the model may fail on "
            "other motions. Record a motion that moves these joints in more poses, "
            "faster and in both directions, or leave effects out in `[model]`"
        )
        if isinstance(self.solution, Complete):
            advice += (
                '; `ridge = "cross_validated"` in `[estimator]` '
                "keeps undetermined combinations small"
            )
        return [*remarks, Remark(advice)]

    def summary(self) -> Table:
        """Return a table of the estimates with their standard deviations.

        Estimates are shown with the digits that their standard deviations leave
        meaningful. Beside them are the standard deviations that independent rows would
        have, and the ratio to these.
        """
        base = self.base
        values, deviations = with_deviations(self.parameters, self.standard_deviations)
        columns = [
            Column("#", list(range(1, base.size + 1))),
            Column("parameter", base.expressions, kind="code"),
            Column("estimate", values, kind="number"),
            Column("±", deviations, kind="number"),
            Column("unit", base.units),
            Column("open", self.open_shares, "%", percent),
        ]
        remarks = self.determination
        ratios = self.uncertainty.ratios
        finite_ratios = ratios[np.isfinite(ratios)]
        if np.any(np.abs(finite_ratios - 1.0) > 1e-9):
            naive_deviations = self.naive_standard_deviations
            columns += [
                Column("naive ±", naive_deviations, format=lambda x: significant(x, 2)),
                Column("ratio", ratios, format=lambda x: significant(x, 2)),
            ]
            typical_ratio = significant(np.median(finite_ratios), 2)
            text = (
                f"Standard deviations are {typical_ratio} times (median) those of "
                "independent rows, because errors of neighbouring rows are correlated."
            )
            remarks = [*remarks, Remark(text)]
        return Table(
            f"{base.model.robot.name}: {base.size} base parameters",
            *columns,
            facts=self.facts,
            status=self.trust,
            remarks=remarks,
        )

    def predict(self, motion: Motion) -> Matrix:
        """Return the forces of a motion, without a known tool's [N m or N] (Eq. 39).

        Raises:
            InputError: If the motion is of another number of joints.
        """
        robot = self.base.model.robot
        if motion.joints != robot.joints:
            raise InputError(
                f"`motion` must be of {robot.joints} joints, not {motion.joints}."
            )
        return self.base.forces_in_numpy(self.parameters, motion)

    @property
    def checksum(self) -> str:
        """Checksum of all that a model file of this fit holds: tells models apart."""
        return checksum_of(self._content())

    def save(self, path: str | Path) -> Path:
        """Write the fit to a model file (JSON), from which `load` makes it again.

        An estimator that holds recordings or functions is kept in words only.

        Args:
            path: Path of the file; an existing file is replaced.

        Raises:
            InputError: If the model holds something that no file can hold, such as a
                term with functions in it.
        """
        document = {"format": FORMAT, "version": VERSION, "checksum": self.checksum}
        write_text(path, json_text({**document, "model": self._content()}))
        return Path(path)

    def _content(self):
        """Return the fit as plain JSON values."""
        fit = self
        try:
            to_json(self.estimator, refused=(Observations,))
        except InputError:
            fit = dataclasses.replace(
                self, estimator=EstimatorInWords(str(self.estimator))
            )
        return to_json(fit)


def checksum_of(content: Any) -> str:
    """Return the SHA-256 of plain JSON values, whatever their layout in a file."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return f"sha256:{hashlib.sha256(text.encode()).hexdigest()}"


def interval_table(
    title: str, names, units, values, uncertainty: Uncertainty, remarks=(), words=()
) -> Table:
    """Return a table of estimates with their 95 % intervals, and perhaps in words."""
    estimates, half_widths = with_deviations(values, uncertainty.half_widths())
    return Table(
        title,
        Column("parameter", names),
        *([Column("in words", words)] if words else []),
        Column("estimate", estimates, kind="number"),
        Column("± (95 %)", half_widths, kind="number"),
        *([Column("unit", units)] if any(units) else []),
        remarks=remarks,
    )
