"""Nonlinear friction beside linear: uncertainties of both, and whether it pays on data unseen."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.identification.factors import Blocks
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_problem
from jaxid.identification.nonlinear.estimator import NonlinearFriction, not_converged
from jaxid.identification.nonlinear.projection import Found, Search, project
from jaxid.identification.nonlinear.separable import SeparableRows, joined
from jaxid.identification.nonlinear.shapes import Shapes
from jaxid.identification.nonlinear.slopes import with_slopes
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.solutions import Complete, Decomposition
from jaxid.measurement.observations import Observations, Progress

FOLDS = 5
WORTH = 0.01
"""Share of the squared error that nonlinear friction must save at least, of 1."""


class HeldOut(eqx.Module):
    """Errors on contiguous blocks of time that were left out in turn.

    Attributes:
        linear: Sums of the squared weighted errors of the linear model, for each block.
        nonlinear: The same for nonlinear friction, its shapes found without the block.
        forces: Sums of the squared weighted forces, for each block.
    """

    linear: Float[AnyArray, " folds"]
    nonlinear: Float[AnyArray, " folds"]
    forces: Float[AnyArray, " folds"]

    @property
    def errors(self) -> tuple[float, float]:
        """Errors of the linear and the nonlinear model relative to the forces, of 1."""
        whole = float(np.sum(self.forces))
        return (
            float(np.sqrt(np.sum(self.linear) / whole)),
            float(np.sqrt(np.sum(self.nonlinear) / whole)),
        )

    @property
    def gain(self) -> float:
        """Share of the squared error that nonlinear friction saves, of 1; negative if it costs."""
        return 1.0 - float(np.sum(self.nonlinear) / np.sum(self.linear))

    @property
    def gain_deviation(self) -> float:
        """Standard deviation of the gain, from the scatter between the blocks, of 1."""
        saved = np.asarray(self.linear) - np.asarray(self.nonlinear)
        return float(saved.std(ddof=1) * np.sqrt(len(saved)) / np.sum(self.linear))

    @property
    def pays(self) -> bool:
        """Whether the gain is larger than its standard deviation, and worth further parameters."""
        return self.gain > max(self.gain_deviation, WORTH)

    def __str__(self):
        linear, nonlinear = (f"{100 * e:.2f} %" for e in self.errors)
        verdict = "pays" if self.pays else "does not pay"
        return (
            f"nonlinear friction {verdict}: it leaves {nonlinear} of the forces of blocks of time "
            f"that it has not seen, the linear model {linear} (squared error "
            f"{-100 * self.gain:+.1f} ± {100 * self.gain_deviation:.1f} %)."
        )


class NonlinearFit(eqx.Module):
    """Nonlinear friction, identified, beside the linear model.

    Attributes:
        fit: With the shapes that were found; its covariance knows that they are estimates too.
        names: Of the shapes, such as `vs3`.
        units: Of the shapes.
        shapes: Their values.
        shape_covariance: Of their values.
        linear: The fit of the linear model.
        held_out: Both on blocks of time that they have not seen.
    """

    fit: Fit
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    shapes: Float[AnyArray, " shapes"]
    shape_covariance: Float[AnyArray, "shapes shapes"]
    linear: Fit
    held_out: HeldOut

    @property
    def shape_deviations(self) -> Float[np.ndarray, " shapes"]:
        """Standard deviations of the shapes; infinite where nothing is known."""
        return np.sqrt(np.diag(self.shape_covariance))

    @property
    def better(self) -> Fit:
        """The nonlinear fit if it pays, otherwise the linear one; its notes say why."""
        if not self.held_out.pays:
            return dataclasses.replace(self.linear, notes=(*self.linear.notes, str(self.held_out)))
        return dataclasses.replace(
            self.fit, notes=(*self.fit.notes, str(self.held_out), self.sentence)
        )

    @property
    def sentence(self) -> str:
        """The shapes with their standard deviations, in words."""
        shown = ", ".join(
            f"{name} = {value:.3g} ± {deviation:.2g} {unit}"
            for name, unit, value, deviation in zip(
                self.names, self.units, self.shapes, self.shape_deviations, strict=True
            )
        )
        return f"shapes of friction: {shown}."


def identify_nonlinear(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    estimator: NonlinearFriction | None = None,
    *,
    linear: BaseParameters | None = None,
    progress: Progress | None = None,
) -> NonlinearFit:
    """Identifies friction laws with their shapes, and says whether they are worth it.

    Both models are fitted again without each of five blocks of time, and judged on it.

    Args:
        base: Of a model whose friction laws have shapes, such as `StribeckFriction`.
        observations: Of one recording, or of several that are fitted together.
        estimator: With weighted least squares and all shapes that the terms want if None.
        linear: Base parameters of the model to compare with; the same model with the shapes that
            it comes with if None.
        progress: Is told now and then which share of the work is done, of 1.

    Raises:
        InputError: If the model has no shapes, or the observations do not fit to it.
    """
    single = isinstance(observations, Observations)
    recordings = (observations,) if single else tuple(observations)
    estimator = NonlinearFriction() if estimator is None else estimator
    beside = RegressionProblem(base if linear is None else linear, recordings)
    before = fit_problem(beside, estimator.linear)
    weights = np.asarray(before.weights)
    shapes, separable, found = estimator.search(RegressionProblem(base, recordings), weights)
    chosen = shapes.set(base, found.x)
    fit = fit_problem(RegressionProblem(chosen, recordings), estimator.linear)
    whole = fit_problem(
        RegressionProblem(with_slopes(chosen, shapes, fit.parameters), recordings), estimator.linear
    )
    covariance, size = np.asarray(whole.covariance), base.size
    own = whole.uncertainty.of_first(size)
    return NonlinearFit(
        fit=dataclasses.replace(
            fit,
            uncertainty=own,
            estimator=estimator,
            notes=(*fit.notes, *not_converged(found)),
        ),
        names=tuple(name for name, _ in shapes.parameters),
        units=tuple(unit for _, unit in shapes.parameters),
        shapes=found.x,
        shape_covariance=covariance[size:, size:],
        linear=before,
        held_out=_held_out(beside.blocks, separable, shapes, found, weights, progress),
    )


def _held_out(
    blocks: Blocks,
    rows: SeparableRows,
    shapes: Shapes,
    found: Found,
    weights: Float[np.ndarray, " joints"],
    progress: Progress | None,
) -> HeldOut:
    """Both models on blocks that they have not seen; searches begin where the whole one ended."""
    squares, errors = weights**2, []
    start = shapes.values(rows.base)
    count = len(blocks.parts)
    for fold, part in enumerate(np.array_split(np.arange(count), min(FOLDS, count))):
        out = part.tolist()
        rest = tuple(k for k in range(count) if k not in out)
        left_out = joined(blocks, out)
        decomposition = Decomposition.of(*joined(blocks, rest).weighted(weights))
        p = decomposition.solve(Complete().inverse(decomposition.values))
        x = Search(rows, weights, start, rest)(found.x).x
        shaped = rows.blocks(x)
        c = project(joined(shaped, rest), rows, weights).linear
        test = joined(shaped, out)
        errors.append(
            (
                squares @ left_out.residual_squares(p),
                squares @ test.residual_squares(np.append(c, np.zeros(test.size - len(c)))),
                squares @ left_out.force_squares,
            )
        )
        if progress is not None:
            progress((fold + 1) / FOLDS)
    return HeldOut(*np.array(errors).T)
