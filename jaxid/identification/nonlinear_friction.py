"""Nonlinear friction: laws with unknown shapes, their temperature, and presliding lengths."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, TemperatureScaled
from jaxid.errors import InputError
from jaxid.measurement.friction_state import with_memory
from jaxid.measurement.observations import Observations, Progress

from .estimators.regularisation_and_weights import Decomposition
from .estimators.variable_projection import NonlinearFriction, Shapes, ShapeSearch
from .factors import Blocks
from .fit_result import Fit
from .identify import fit_problem
from .problem import RegressionProblem, cross_validation_folds


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
        return self.gain > max(2.0 * self.gain_deviation, 0.01)

    def __str__(self):
        verdict = "pays" if self.pays else "does not pay"
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
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    shapes: Float[AnyArray, " shapes"]
    shape_covariance: Float[AnyArray, "shapes shapes"]
    linear: Fit
    held_out: HeldOutErrors

    @property
    def shape_deviations(self) -> Float[np.ndarray, " shapes"]:
        """Standard deviations of the shapes; infinite where nothing is known."""
        return np.sqrt(np.diag(self.shape_covariance))

    @property
    def better(self) -> Fit:
        """The nonlinear fit if it pays, otherwise the linear one, with notes that say why."""
        fit, notes = self.linear, (str(self.held_out),)
        if self.held_out.pays:
            rows = zip(
                self.names, self.shapes, self.shape_deviations, self.units, strict=True
            )
            shown = ", ".join(
                f"{name} = {x:.3g} ± {s:.2g} {unit}" for name, x, s, unit in rows
            )
            fit, notes = self.fit, (*notes, f"shapes of friction: {shown}.")
        return dataclasses.replace(fit, notes=(*fit.notes, *notes))


def identify_nonlinear(
    base: BaseParameters,
    observations: Observations | Sequence[Observations],
    estimator: NonlinearFriction | None = None,
    *,
    linear: BaseParameters | None = None,
    progress: Progress | None = None,
) -> NonlinearFit:
    """Identify friction laws with their shapes, and compare them with the linear model.

    Both models are fitted again without each of five blocks of time, and tested on it.

    Args:
        base: Base parameters of a model with shapes, such as those of
            `StribeckFriction`.
        observations: Observations of one recording, or of several that are fitted
            together.
        estimator: Estimator; by default weighted least squares and the shapes that
            terms propose.
        linear: Base parameters of the linear model; by default the same model with its
            own shapes.
        progress: Callback, called with the completed fraction (0 to 1).

    Raises:
        InputError: If the model has no shapes, or the observations do not fit to it.
    """
    estimator = estimator or NonlinearFriction()
    linear_problem = RegressionProblem(linear or base, observations)
    before = fit_problem(linear_problem, estimator.linear)
    weights = np.asarray(before.weights)
    problem = linear_problem.with_base(base)
    search, x, notes = estimator.search(problem, weights)
    shapes, size = search.shapes, base.size
    shaped = shapes.set(base, x)
    fit = fit_problem(problem.with_base(shaped), estimator.linear)
    # Small changes of the shapes are further parameters.
    model, kappa = shaped.model, np.asarray(base.kappa)
    p = np.asarray(shaped.to_standard(fit.parameters))[shapes.columns_of_terms]
    slopes = ShapeSlopes(dataclasses.replace(shapes, model=model), x, p)
    linearised = dataclasses.replace(
        shaped,
        model=Model(model.robot, (*model.terms, slopes)),
        indices=(*base.indices, *range(model.size, model.size + shapes.size)),
        kappa=np.vstack([kappa, np.zeros((shapes.size, kappa.shape[1]))]),
    )
    both = fit_problem(problem.with_base(linearised), estimator.linear).uncertainty
    uncertainty = jax.tree.map(lambda x: x[(slice(size),) * x.ndim], both)
    changes = {"estimator": estimator, "notes": (*fit.notes, *notes)}
    return NonlinearFit(
        fit=dataclasses.replace(fit, uncertainty=uncertainty, **changes),
        names=tuple(name for name, _ in shapes.parameters),
        units=tuple(unit for _, unit in shapes.parameters),
        shapes=x,
        shape_covariance=both.covariance[size:, size:],
        linear=before,
        held_out=_held_out_errors(linear_problem.blocks, search, weights, progress),
    )


def _held_out_errors(blocks, search: ShapeSearch, weights, progress) -> HeldOutErrors:
    """Test both models on blocks that neither has seen, nor the search for shapes."""
    squares, errors, folds = weights**2, [], cross_validation_folds(blocks)
    for rest, out in folds:
        p = Decomposition.of(*blocks.select(rest).total.weighted(weights)).solve()
        kept = np.zeros(len(blocks.parts))
        kept[rest] = 1.0
        x, _ = eqx.filter_jit(search)(weights, kept)
        _, left = eqx.filter_jit(search.fit)(x, search.row_weights(weights, kept))
        nonlinear = np.sum((search.row_weights(weights, 1.0 - kept) * left) ** 2)
        test = blocks.select(out).total
        linear, forces = (
            squares @ y for y in (test.residual_squares(p), test.force_squares)
        )
        errors.append([linear, nonlinear, forces])
        if progress is not None:
            progress(len(errors) / len(folds))
    linear, nonlinear, forces = np.array(errors).T
    saved, total = linear - nonlinear, float(linear.sum())
    return HeldOutErrors(
        linear=float(np.sqrt(total / forces.sum())),
        nonlinear=float(np.sqrt(nonlinear.sum() / forces.sum())),
        gain=float(saved.sum() / total),
        gain_deviation=float(saved.std(ddof=1) * np.sqrt(len(saved)) / total),
    )


class ShapeSlopes(AbstractTerm):
    """Forces of small changes of shapes: it makes the linearised problem an ordinary one."""

    shapes: Shapes  # shapes that change, at which forces are linearised
    x: Float[AnyArray, " shapes"]  # their values
    p: Float[AnyArray, " standard"]  # standard parameters of the terms that have shapes

    def parameters(self, robot):
        """Return names and units of the shapes."""
        return self.shapes.parameters

    def columns(self, robot, q, qd, qdd):
        """Return the derivatives of the shaped terms' forces."""

        def forces(x):
            return self.shapes.columns(x, q, qd, qdd) @ jnp.asarray(self.p)

        return jax.jacfwd(forces)(jnp.asarray(self.x, q.dtype))


class TemperatureLaw(eqx.Module):
    r"""Friction $f_0 e^{-a (T - T_0)}$ of each joint, with uncertainties.

    Attributes:
        names: Names of the friction parameters, one for each joint.
        values: Values at the reference temperature, in the parameters' units.
        value_deviations: Their standard deviations.
        rates: Rates $a$ [1/K]; NaN where an estimate is not positive.
        rate_deviations: Their standard deviations [1/K].
        term: Friction term with these rates, for models at any temperature.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[AnyArray, " joints"]
    value_deviations: Float[AnyArray, " joints"]
    rates: Float[AnyArray, " joints"]
    rate_deviations: Float[AnyArray, " joints"]
    term: TemperatureScaled


def temperature_law(
    fits: Sequence[Fit],
    temperatures: Sequence[float] | Float[AnyArray, " fits"],
    term: AbstractTerm,
    *,
    reference: float = 25.0,
) -> TemperatureLaw:
    """Identify how friction falls with temperature, from fits at several temperatures.

    The logarithms of the estimates lie on a line, each as uncertain as in its fit.

    Args:
        fits: Fits of one model, each to recordings at one temperature.
        temperatures: Temperatures of the fits [°C].
        term: Term with one parameter for each joint, such as `ViscousFriction()`.
        reference: Temperature to which the values belong [°C].

    Raises:
        InputError: If there are fewer than two temperatures, or a fit has no such
            parameters.
    """
    warmer = np.asarray(temperatures, np.float64) - reference
    if warmer.shape != (len(fits),) or len(np.unique(warmer)) < 2:
        raise InputError(
            "`temperatures` must be one for each fit, at least two different."
        )
    robot = fits[0].base.model.robot
    names = tuple(name for name, _ in term.parameters(robot))
    if len(names) != robot.joints or any(
        set(names) - set(fit.base.names) for fit in fits
    ):
        raise InputError(
            f"`term` must have one parameter for each joint, in all fits: {names}."
        )
    places = [[fit.base.names.index(name) for name in names] for fit in fits]
    f = np.array([fit.parameters[k] for fit, k in zip(fits, places, strict=True)])
    s = np.array(
        [fit.standard_deviations[k] for fit, k in zip(fits, places, strict=True)]
    )
    lines = np.full((len(names), 4), np.nan)
    for j in np.flatnonzero((f > 0).all(axis=0)):
        # Exact estimates of simulated logs get a tiny deviation.
        weights = 1.0 / np.maximum(s[:, j] / f[:, j], 1e-12)
        line, covariance = np.polyfit(
            warmer, np.log(f[:, j]), 1, w=weights, cov="unscaled"
        )
        lines[j] = *line, *np.sqrt(np.diag(covariance))
    slope, level, slope_deviation, level_deviation = lines.T
    values, rates = np.exp(level), -slope
    known = np.where(np.isfinite(rates), rates, 0.0)
    scaled = TemperatureScaled(term, known, reference, reference)
    return TemperatureLaw(
        names, values, values * level_deviation, rates, slope_deviation, scaled
    )


LENGTHS = 3.0 ** np.arange(-9, 0)
"""Lengths that are tried for each joint, before those around the best one [rad or m]."""


def identify_presliding(
    base: BaseParameters, observations: Observations | Sequence[Observations]
) -> BaseParameters:
    """Find the length of presliding friction of each joint.

    The rows of a joint depend on its own length only, and are fitted alone. So one pass
    over the data tries a length of every joint. The best of `LENGTHS` is improved in
    steps that get smaller.

    Args:
        base: Base parameters of a model whose friction has the transition `Presliding`.
        observations: Observations of one recording, or of several that are fitted
            together.

    Returns:
        The same base parameters, with these lengths in `model.memory`.

    Raises:
        InputError: If the model has no such friction.
    """
    if base.model.memory is None:
        raise InputError(
            "the `model` has no friction with the transition `Presliding`."
        )
    problem, joints = RegressionProblem(base, observations), base.model.robot.joints
    tried, found = [], []

    def best_after(
        lengths: Float[np.ndarray, "lengths joints"],
    ) -> Float[np.ndarray, " joints"]:
        """Try lengths; return the best one of all that were tried for each joint."""
        for one in lengths:
            tried.append(one)
            found.append(blocks_with(problem, one))
        return np.array(tried)[best_of(found), np.arange(joints)]

    best = best_after(np.outer(LENGTHS, np.ones(joints)))
    for step in 3.0**0.5 ** np.arange(1, 5):
        best = best_after(np.array([best / step, best * step]))
    model = base.model.with_memory(length=best)
    return eqx.tree_at(lambda b: b.model, base, model)


def blocks_with(problem: RegressionProblem, length: np.ndarray | float) -> Blocks:
    """Return the factors with another length: compiled columns stay, only states differ."""
    base = problem.base
    law, trial = base.model.with_memory(length=length).memory, problem.with_base(base)
    trial.recordings = tuple(with_memory(o, law) for o in problem.recordings)
    return trial.blocks


def best_of(blocks: Sequence[Blocks]) -> list[int]:
    """Return for each joint which of several factors its own columns explain best."""
    # What they leave unexplained stands last in the triangle.
    left = [[abs(joint.R[-1, -1]) for joint in x.total.joints] for x in blocks]
    return np.argmin(left, axis=0).tolist()


def presliding_note(base: BaseParameters) -> str:
    """Return the lengths of presliding in words."""
    robot, law = base.model.robot, base.model.memory
    lengths = np.broadcast_to(getattr(law, "length", np.nan), robot.joints)
    named = enumerate(zip(robot.joint_names, lengths.tolist(), strict=True))
    shown = ", ".join(f"{name} {x:.2g} {robot.joint_unit(j)}" for j, (name, x) in named)
    return f"lengths of presliding, whose uncertainty is not in the intervals: {shown}."
