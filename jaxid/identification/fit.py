"""Result of an identification: estimates, covariance, factors."""

import dataclasses
import enum
from pathlib import Path

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.motion import Motion
from jaxid.errors import InputError
from jaxid.identification.consistency.estimator import Consistency
from jaxid.identification.estimators import (
    AbstractEstimator,
    AbstractSpectralSolution,
    Complete,
    EstimatorInWords,
)
from jaxid.identification.estimators.solutions import (
    LARGEST_UNCERTAINTY,
    Decomposition,
    UndeterminedDirection,
)
from jaxid.identification.factors import Blocks
from jaxid.identification.model_file import checksum_of, read_model, write_model
from jaxid.identification.uncertainty import ResidualSpectra, Uncertainty
from jaxid.io import to_json
from jaxid.measurement.observations import Observations
from jaxid.table import (
    Column,
    Remark,
    Status,
    Table,
    percent,
    significant,
    with_deviations,
)

TRUSTED, DOUBTFUL = 0.1, 0.5
"""Relative standard deviations up to which an estimate is trusted, or doubtful, as fractions."""


class Trust(enum.Enum):
    """How far an estimate can be trusted."""

    GOOD = "trusted"
    DOUBTFUL = "doubtful"
    NONE = "small, or not excited"

    @property
    def status(self) -> Status:
        """Mark of the row of such an estimate."""
        return {"GOOD": Status.GOOD, "DOUBTFUL": Status.DOUBTFUL, "NONE": Status.BAD}[self.name]


class ConditionNumbers(eqx.Module):
    """Condition numbers of the observation matrix.

    Attributes:
        raw: As it is, in SI units.
        weighted: With the rows weighted as they were for the fit.
        scaled: Weighted, with columns of length one: free of units.
    """

    raw: float
    weighted: float
    scaled: float


class Fit(eqx.Module):
    """Identified base parameters with their uncertainty.

    Attributes:
        base: Which combinations of standard parameters they are.
        parameters: The estimates, in the units of `base.units`.
        uncertainty: Uncertainty of the estimates, and its method.
        weights: Weights of the joints' rows [1/(N m) or 1/N].
        condition_numbers: Condition numbers of the observation matrix.
        rows: Number of rows of each joint.
        residual_rms: RMS of the residuals of each joint [N m or N].
        residual: Norm of all residuals relative to the norm of all forces, of 1.
        undetermined: Combinations that these observations do not determine.
        estimator: What made the fit.
        solution: How the system was solved in the end, with everything chosen that it chose.
        recordings: Names of the observations.
        notes: What the user should know, in sentences.
        consistency: How a physically consistent estimate came about, and which bounds decide.
        full_parameters: Standard parameters, of an estimator that finds a complete set of them.
        residual_spectra: Spectra of each joint's residuals, and their whiteness; None where only
            factors of the rows were known.
        date: Day on which the fit was made, like 2026-01-31; empty if it is not known.
        blocks: Factors of the rows by contiguous blocks of time, with which later functions go on;
            None if they are not known.
        name: Name of the fit, such as `cold`; by default the names of its recordings.
    """

    base: BaseParameters
    parameters: Float[AnyArray, " base"]
    uncertainty: Uncertainty
    weights: Float[AnyArray, " joints"]
    condition_numbers: ConditionNumbers
    rows: tuple[int, ...] = eqx.field(static=True)
    residual_rms: Float[AnyArray, " joints"]
    residual: float
    undetermined: tuple[UndeterminedDirection, ...]
    estimator: AbstractEstimator
    solution: AbstractSpectralSolution
    recordings: tuple[str, ...] = eqx.field(static=True)
    notes: tuple[str, ...] = eqx.field(static=True)
    consistency: Consistency | None = None
    full_parameters: Float[AnyArray, " standard"] | None = None
    residual_spectra: ResidualSpectra | None = None
    date: str = eqx.field(static=True, default="")
    blocks: Blocks | None = None
    name: str = eqx.field(static=True, default="")

    @property
    def covariance(self) -> Float[AnyArray, "base base"]:
        """Of the estimates; infinite variances where nothing is known."""
        return self.uncertainty.covariance

    @property
    def standard_deviations(self) -> Float[np.ndarray, " base"]:
        """Standard deviations of the estimates; infinite where nothing is known."""
        return self.uncertainty.standard_deviations

    @property
    def naive_standard_deviations(self) -> Float[np.ndarray, " base"]:
        """Standard deviations for independent rows; filtered rows are not independent."""
        return self.uncertainty.naive_standard_deviations

    def intervals(self, level: float = 0.95) -> Float[np.ndarray, "base 2"]:
        """Intervals that hold the true parameters in a share of cases.

        They tell how far noise can take the estimates, of a model that is right: errors that every
        recording of this kind would share (a wrong geometry, a missing effect) are not in them.

        Args:
            level: The share, of 1.

        Raises:
            InputError: If `level` is not between 0 and 1.
        """
        half = self.uncertainty.half_widths(level)
        p = np.asarray(self.parameters)
        return np.stack([p - half, p + half], axis=1)

    @property
    def relative_standard_deviations(self) -> Float[np.ndarray, " base"]:
        """Standard deviations in units of the estimates' sizes, as fractions."""
        size = np.abs(np.asarray(self.parameters))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(size > 0, self.standard_deviations / size, np.inf)

    @property
    def trust(self) -> tuple[Trust, ...]:
        """How far each estimate can be trusted; not if it is part of what is undetermined."""
        undecided = {k for direction in self.undetermined for k in direction.parts}
        return tuple(
            Trust.NONE
            if k in undecided or not share <= DOUBTFUL
            else Trust.GOOD
            if share <= TRUSTED
            else Trust.DOUBTFUL
            for k, share in enumerate(self.relative_standard_deviations)
        )

    @property
    def time_blocks(self) -> Blocks:
        """The factors by contiguous blocks of time.

        Raises:
            InputError: If the fit does not hold its factors.
        """
        if self.blocks is None:
            raise InputError(f"the fit `{self.name}` does not hold its factors: identify again.")
        return self.blocks

    @property
    def factor(self) -> tuple[Float[np.ndarray, "height base"], Float[np.ndarray, " height"]]:
        """Matrix and right-hand side with the norms of all weighted rows (Eq. 29).

        Raises:
            InputError: If the fit does not hold its factors.
        """
        return self.time_blocks.total.weighted(self.weights)

    @property
    def is_least_squares(self) -> bool:
        """Whether the estimates are weighted least squares of the rows, up to rounding."""
        R, z = self.factor
        plain = Decomposition.of(R, z).solve()
        apart = np.linalg.norm(R @ (np.asarray(self.parameters) - plain))
        return bool(apart <= 1e-7 * np.linalg.norm(z))

    @property
    def condition_number(self) -> float:
        """Condition number of the observation matrix in SI units."""
        return self.condition_numbers.raw

    @property
    def standard_parameters(self) -> Float[np.ndarray, " standard"]:
        """Standard parameters with the same forces.

        Physical masses and inertias only if the estimator finds such (`full_parameters`).
        """
        if self.full_parameters is not None:
            return np.asarray(self.full_parameters)
        full = np.zeros(self.base.model.size)
        full[list(self.base.indices)] = np.asarray(self.parameters)
        return full

    @property
    def facts(self) -> list[tuple[str, str]]:
        """Rows, condition numbers and residual, each with its word."""
        rows, numbers, trust = self.rows, self.condition_numbers, self.trust
        good, fair, poor = (
            trust.count(level) for level in (Trust.GOOD, Trust.DOUBTFUL, Trust.NONE)
        )
        return [
            (
                "rows per joint",
                str(rows[0]) if len(set(rows)) == 1 else f"{min(rows)} to {max(rows)}",
            ),
            (
                "condition number",
                f"{significant(numbers.raw, 4)} in SI units, {significant(numbers.weighted, 4)} "
                f"weighted, {significant(numbers.scaled, 4)} weighted with columns of length one",
            ),
            ("residual", f"{percent(self.residual, 3)} % of the forces (norms of all rows)"),
            (
                "estimates",
                f"{good} of {self.base.size} known to {100 * TRUSTED:g} %, {fair} to "
                f"{100 * DOUBTFUL:g} %, {poor} worse or undetermined",
            ),
        ]

    @property
    def determination(self) -> list[Remark]:
        """Combinations that the logs do not determine, and what to do about them."""
        base = self.base
        if not self.undetermined:
            return [Remark(f"These logs determine all {base.size} base parameters.", Status.GOOD)]
        count = len(self.undetermined)
        headline = (
            f"NOT DETERMINED by these logs: {count} combination{'' if count == 1 else 's'} of the "
            f"{base.size} base parameters."
        )
        remarks = [Remark(headline, Status.BAD)]
        for direction in self.undetermined:
            moved = np.isfinite(direction.uncertainty)
            open_part = f"leaves {percent(direction.uncertainty)} % of the forces open"
            remarks.append(
                Remark(
                    f"{direction.sentence(base)}.",
                    Status.BAD,
                    f"{open_part if moved else 'not moved at all'}; singular value "
                    f"{direction.singular_value:.1e} of the largest",
                )
            )
        advice = (
            "A combination counts as not determined if it leaves more than "
            f"{100 * LARGEST_UNCERTAINTY:g} % of the whole forces open. Estimates of these "
            "parameters mean nothing one by one, and the model may fail on other motions. Record "
            "a motion that moves these joints in more poses, faster and in both directions, or "
            "leave effects out in `[model]`"
        )
        if isinstance(self.solution, Complete):
            advice += '; `ridge = "cross_validated"` in `[estimator]` keeps small what is left open'
        return [*remarks, Remark(advice)]

    def summary(self) -> Table:
        """Return a table of the estimates with their standard deviations.

        Estimates are shown with the digits that their standard deviations leave meaningful. Beside
        them are the standard deviations that independent rows would have, and the ratio to these.
        """
        base, trust = self.base, self.trust
        values, deviations = with_deviations(self.parameters, self.standard_deviations)
        columns = [
            Column("#", list(range(1, base.size + 1))),
            Column("parameter", base.expressions, kind="code"),
            Column("estimate", values, kind="number"),
            Column("±", deviations, kind="number"),
            Column("unit", base.units),
            Column("±", self.relative_standard_deviations, "%", percent),
        ]
        ratios = self.uncertainty.ratios
        finite = ratios[np.isfinite(ratios)]
        remarks = [*self.determination]
        if np.any(np.abs(finite - 1.0) > 1e-9):
            columns += [
                Column(
                    "naive ±", self.naive_standard_deviations, format=lambda x: significant(x, 2)
                ),
                Column("ratio", ratios, format=lambda x: significant(x, 2)),
            ]
            remarks.append(
                Remark(
                    f"Standard deviations are {significant(float(np.median(finite)), 2)} times "
                    "(median) those of independent rows, because errors of neighbouring rows are "
                    "correlated."
                )
            )
        return Table(
            f"{base.model.robot.name}: {base.size} base parameters",
            *columns,
            facts=self.facts,
            status=[level.status for level in trust],
            remarks=remarks,
        )

    def __str__(self) -> str:
        return str(self.summary())

    def predict(self, motion: Motion) -> Float[np.ndarray, "samples joints"]:
        """Forces that the model needs for a motion, without a known tool's [N m or N] (Eq. 39).

        Raises:
            InputError: If the motion is of another number of joints.
        """
        robot = self.base.model.robot
        if motion.joints != robot.joints:
            raise InputError(
                f"`motion` must be of the {robot.joints} joints of `{robot.name}`, but is of "
                f"{motion.joints}."
            )
        return self.base.forces_in_numpy(self.parameters, motion)

    @property
    def checksum(self) -> str:
        """Of everything that a model file of this fit holds: tells models apart."""
        return checksum_of(to_json(self._kept()))

    def save(self, path: str | Path) -> Path:
        """Writes the fit to a model file (JSON) from which `load` makes the same fit again.

        An estimator that holds recordings or functions is kept in words only.

        Args:
            path: Path of the file; an existing file is replaced.

        Raises:
            InputError: If the model holds something that no file can hold, such as a term with
                functions in it.
        """
        return write_model(path, self._kept())

    def _kept(self) -> "Fit":
        try:
            to_json(self.estimator, refused=(Observations,))
        except InputError:
            return dataclasses.replace(self, estimator=EstimatorInWords(str(self.estimator)))
        return self


def load(path: str | Path) -> Fit:
    """Reads a fit from a model file, as `Fit.save` and `jaxid identify` write it.

    Numbers are the same to the last bit, and everything works as it did after `identify`. Terms of
    one's own are found if the module that defines them is imported; nothing in a file is run.

    Args:
        path: Path of the file.

    Raises:
        OSError: If the file cannot be read.
        InputError: If it is no model file, of another version, or not as it was written.
    """
    return read_model(path, Fit, _check)


def _check(fit: Fit) -> None:
    """Refuses arrays of a file that do not belong to its robot."""
    n, joints = fit.base.size, fit.base.model.robot.joints
    for name, array, shape in (
        ("parameters", fit.parameters, (n,)),
        ("uncertainty.covariance", fit.uncertainty.covariance, (n, n)),
        ("weights", fit.weights, (joints,)),
    ):
        if np.shape(array) != shape:
            raise InputError(f"`{name}` must have the shape {shape}, but has {np.shape(array)}")
    if not np.isfinite(fit.parameters).all():
        raise InputError("`parameters` must hold finite numbers")
