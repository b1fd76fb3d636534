"""Friction laws with unknown shapes, against the linear model on held-out data."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Texts
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm
from jaxid.measurement.observations import ObservedLogs, Progress

from ..estimators import AbstractEstimator, WeightedLeastSquares
from ..estimators.regularisation_and_weights import Decomposition
from ..factors import Blocks
from ..fit_result import Fit
from ..identify import fit_problem
from ..problem import RegressionProblem, cross_validation_folds
from ..uncertainty import Uncertainty
from .friction_shapes import Shapes, ShapeValues, select_shapes
from .variable_projection import MAX_STEPS, ShapeSearch

MIN_GAIN = 0.01
"""Relative reduction of the squared error from which nonlinear friction can pay."""

NOT_CONVERGED = (
    f"the search for the shapes of friction has not converged in {MAX_STEPS} steps: "
    "the logs hardly determine some of them; look at their standard deviations, or "
    "select fewer."
)


class HeldOutErrors(eqx.Module):
    """Errors on contiguous blocks of time that were left out in turn.

    Attributes:
        linear: Error of the linear model relative to the forces.
        nonlinear: The same for nonlinear friction, its shapes found without the block.
        gain: Relative reduction of the squared error by nonlinear friction; negative if
            it grows.
        gain_deviation: Standard deviation of the gain, from the scatter between the
            blocks.
    """

    linear: float
    nonlinear: float
    gain: float
    gain_deviation: float

    @property
    def pays(self) -> bool:
        """Whether the gain exceeds twice its standard deviation, and 1 %."""
        return self.gain > max(2.0 * self.gain_deviation, MIN_GAIN)

    def __str__(self):
        verdict = "pays" if self.pays else "is not worth its parameters"
        return (
            f"nonlinear friction {verdict}: on held-out blocks of time its error is "
            f"{100 * self.nonlinear:.2f} % of the forces, that of the linear model "
            f"{100 * self.linear:.2f} % (squared error {-100 * self.gain:+.1f} ± "
            f"{100 * self.gain_deviation:.1f} %)."
        )


class NonlinearFit(eqx.Module):
    """Fit with nonlinear friction, beside the linear model.

    Attributes:
        fit: Fit with the shapes found; its covariance includes their uncertainty.
        names: Names of the shapes, such as `vs3`.
        units: Units of the shapes.
        shapes: Values of the shapes.
        shape_covariance: Covariance of the shapes.
        linear: Fit of the linear model.
        held_out: Errors of both on held-out blocks of time.
    """

    fit: Fit
    names: Texts = eqx.field(static=True)
    units: Texts = eqx.field(static=True)
    shapes: ShapeValues
    shape_covariance: Float[AnyArray, "shapes shapes"]
    linear: Fit
    held_out: HeldOutErrors

    @property
    def shape_deviations(self) -> np.ndarray:
        """Standard deviations of the shapes; infinite where nothing is known."""
        return np.sqrt(np.diag(self.shape_covariance))

    @property
    def better(self) -> Fit:
        """The nonlinear fit if it pays, else the linear one; notes say why."""
        if not self.held_out.pays:
            notes = (*self.linear.notes, str(self.held_out))
            return dataclasses.replace(self.linear, notes=notes)
        shapes = zip(
            self.names, self.shapes, self.shape_deviations, self.units, strict=True
        )
        words = [
            f"{name} = {value:.3g} ± {deviation:.2g} {unit}"
            for name, value, deviation, unit in shapes
        ]
        note = f"shapes of friction: {', '.join(words)}."
        notes = (*self.fit.notes, str(self.held_out), note)
        return dataclasses.replace(self.fit, notes=notes)


def identify_nonlinear_friction(
    base: BaseParameters,
    observations: ObservedLogs,
    estimator: AbstractEstimator | None = None,
    *,
    shapes: Sequence[str] = (),
    linear: BaseParameters | None = None,
    progress: Progress | None = None,
) -> NonlinearFit:
    """Identify friction laws with their shapes, and compare them with the linear model.

    The weights of the joints are those of the linear model. Both models are fitted
    again without each of five blocks of time, and tested on it.

    Args:
        base: Base parameters of a model with shapes, such as those of
            `StribeckFriction`.
        observations: Observations of one recording, or of several that are fitted
            together.
        estimator: Estimator of the linear parameters; by default weighted least
            squares.
        shapes: Names of the shapes that are identified, such as `("vs", "delta")`; by
            default those that the terms propose. The others keep their values.
        linear: Base parameters of the linear model; by default the same model with its
            own shapes.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If the model has no shapes, or the observations do not fit to it.
    """
    estimator = estimator or WeightedLeastSquares()
    linear_problem = RegressionProblem(linear or base, observations)
    linear_fit = fit_problem(linear_problem, estimator)
    weights = np.asarray(linear_fit.weights)

    problem = linear_problem.with_base(base)
    search = ShapeSearch.of(problem, select_shapes(base, shapes))
    all_blocks = np.ones(len(linear_problem.blocks.parts))
    values, has_converged = eqx.filter_jit(search)(weights, all_blocks)
    values = np.asarray(values)
    shaped_base = search.shapes.set(base, values)
    fit = fit_problem(problem.with_base(shaped_base), estimator)
    notes = fit.notes
    if not has_converged:
        notes = (*notes, NOT_CONVERGED)

    # In the extended model, uncertain shapes make the levels of friction uncertain.
    extended_base = _add_shape_slopes(
        shaped_base, search.shapes, values, fit.parameters
    )
    extended_fit = fit_problem(problem.with_base(extended_base), estimator)
    uncertainty = extended_fit.uncertainty
    return NonlinearFit(
        fit=dataclasses.replace(
            fit,
            uncertainty=_leading_part(uncertainty, base.size),
            notes=notes,
        ),
        names=tuple(name for name, _ in search.shapes.parameters),
        units=tuple(unit for _, unit in search.shapes.parameters),
        shapes=values,
        shape_covariance=uncertainty.covariance[base.size :, base.size :],
        linear=linear_fit,
        held_out=_held_out_errors(linear_problem.blocks, search, weights, progress),
    )


def _leading_part(uncertainty: Uncertainty, size: int) -> Uncertainty:
    """Return the uncertainty of the first parameters."""
    return jax.tree.map(lambda x: x[(slice(size),) * x.ndim], uncertainty)


def _add_shape_slopes(
    base: BaseParameters, shapes: Shapes, values, parameters
) -> BaseParameters:
    """Return base parameters with small changes of the shapes as further parameters."""
    model = base.model
    standard_parameters = np.asarray(base.to_standard(parameters))[
        shapes.standard_columns
    ]
    slopes = ShapeSlopes(
        dataclasses.replace(shapes, model=model), values, standard_parameters
    )
    # No other parameter depends on the slopes: their rows of kappa are zero.
    kappa = np.asarray(base.kappa)
    return dataclasses.replace(
        base,
        model=Model(model.robot, (*model.terms, slopes)),
        indices=(*base.indices, *range(model.size, model.size + shapes.size)),
        kappa=np.vstack([kappa, np.zeros((shapes.size, kappa.shape[1]))]),
    )


def _held_out_errors(
    blocks: Blocks, search: ShapeSearch, weights, progress: Progress | None
) -> HeldOutErrors:
    """Test both models on blocks that neither their fits nor the search have used."""
    folds = cross_validation_folds(blocks)
    squares = []
    for training, test in folds:
        squares.append(_test_squares(blocks, search, weights, training, test))
        if progress is not None:
            progress(len(squares) / len(folds))
    linear_squares, nonlinear_squares, force_squares = np.array(squares).T
    reductions = linear_squares - nonlinear_squares
    total_square = float(linear_squares.sum())
    deviation = reductions.std(ddof=1) * np.sqrt(len(reductions))
    return HeldOutErrors(
        linear=float(np.sqrt(total_square / force_squares.sum())),
        nonlinear=float(np.sqrt(nonlinear_squares.sum() / force_squares.sum())),
        gain=float(reductions.sum() / total_square),
        gain_deviation=float(deviation / total_square),
    )


def _test_squares(blocks: Blocks, search: ShapeSearch, weights, training, test):
    """Return squared errors of the linear and nonlinear model, and squared forces."""
    training_mask = np.zeros(len(blocks.parts))
    training_mask[training] = 1.0
    shapes, _ = eqx.filter_jit(search)(weights, training_mask)
    training_rows = search.row_weights(weights, training_mask)
    _, residuals = eqx.filter_jit(search.fit)(shapes, training_rows)
    test_rows = search.row_weights(weights, 1.0 - training_mask)
    nonlinear_square = float(np.sum((test_rows * residuals) ** 2))

    linear_system = blocks.select(training).total.weighted(weights)
    p = Decomposition.of(*linear_system).solve()
    test_factors = blocks.select(test).total
    linear_square = float(weights**2 @ test_factors.residual_squares(p))
    force_square = float(weights**2 @ test_factors.force_squares)
    return linear_square, nonlinear_square, force_square


class ShapeSlopes(AbstractTerm):
    """Forces of small changes of shapes: the linearised problem is ordinary."""

    shapes: Shapes  # shapes that change, at which forces are linearised
    x: ShapeValues  # their values
    p: Float[AnyArray, " standard"]  # standard parameters of the terms that have shapes

    def parameters(self, robot):
        """Return names and units of the shapes."""
        return self.shapes.parameters

    def columns(self, robot, q, qd, qdd):
        """Return the derivatives of the forces of the terms with shapes."""

        def forces(x):
            return self.shapes.columns(x, q, qd, qdd) @ jnp.asarray(self.p)

        return jax.jacfwd(forces)(jnp.asarray(self.x, q.dtype))
