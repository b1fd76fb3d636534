"""Least squares of a nonlinear function, within bounds."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx

from jaxid.arrays import AnyArray, Array, Bool, Float

Residuals = Callable[[Array, Any], Array]
"""Function of the unknowns and of other arguments that returns errors [rows]."""


Bounds = tuple[AnyArray, AnyArray]
"""Smallest and largest unknowns."""


class Minimum(NamedTuple):
    """Unknowns for which the sum of squares is smallest.

    Attributes:
        x: Unknowns.
        converged: Whether the search has ended by itself.
        residuals: Residuals at the unknowns.
        jacobian: Their derivatives.
    """

    x: Float[Array, " unknowns"]
    converged: Bool[Array, ""]
    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows unknowns"]


def search_squares(
    residuals: Residuals, start: AnyArray, bounds: Bounds, args: Any, rtol: float
) -> Iterator[Minimum]:
    """Yield the best unknowns after each step of a search, which may take long.

    Args:
        residuals: Differentiable function of the unknowns and of `args`.
        start: Unknowns at which the search starts; brought within the bounds.
        bounds: Smallest and largest unknowns.
        args: Other arguments of `residuals`.
        rtol: Relative decrease of the sum of squares below which the search ends.
    """
    lower, upper = bounds
    solver = BoundedLevenbergMarquardt(rtol=rtol)
    options = {"lower": jnp.asarray(lower), "upper": jnp.asarray(upper)}

    def function(x: Array, args: Any) -> tuple[Array, None]:
        return residuals(x, args), None

    @jax.jit
    def step(x: Array, args: Any, state: _Linearisation) -> Any:
        return solver.step(function, x, args, options, state, frozenset())[:2]

    x = jnp.clip(jnp.asarray(start), lower, upper)
    rows = jax.eval_shape(residuals, x, args)
    state = solver.init(function, x, args, options, rows, None, frozenset())
    has_ended = False
    while not has_ended:
        x, state = step(x, args, state)
        end, _ = solver.terminate(function, x, args, options, state, frozenset())
        has_ended = bool(end)
        yield Minimum(x, end, state.residuals, state.jacobian)


class _Linearisation(NamedTuple):
    """Residuals and their derivatives at the unknowns, and how the search goes on.

    Attributes:
        residuals: Residuals [rows].
        jacobian: Their derivatives [rows, unknowns].
        cost: Sum of their squares; infinite before the first step, which only
            linearises.
        damping: Damping of the next step, relative to the columns of the Jacobian.
        decrease: Relative decrease of the sum of squares by the last step that was
            taken.
    """

    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows unknowns"]
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    decrease: Float[Array, ""]


class BoundedLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt with bounds, in the scales of the Jacobian's columns.

    An unknown at a bound that its gradient would leave stays there for one step; a step
    beyond a bound ends there. Steps that do not lower the sum of squares are not taken,
    and the damping grows. The bounds are the options `lower` and `upper` of
    `optimistix.least_squares`, whose other solvers have none.
    """

    rtol: float = 1e-8
    atol: float = 0.0
    norm: Callable[[Any], Array] = optx.max_norm
    start_damping: float = 1e-2
    max_damping: float = 1e9

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Return a state without derivatives, which the first step computes."""
        return _Linearisation(
            residuals=jnp.zeros(f_struct.shape, f_struct.dtype),
            jacobian=jnp.zeros((f_struct.size, y.size), f_struct.dtype),
            cost=jnp.asarray(jnp.inf, y.dtype),
            damping=jnp.asarray(self.start_damping, y.dtype),
            decrease=jnp.asarray(1.0, y.dtype),
        )

    def step(self, fn, y, args, options, state, tags):
        """Take one step, or none if it does not lower the sum of squares."""
        lower, upper = options["lower"], options["upper"]
        trial_point = jnp.clip(y + _damped_step(y, state, lower, upper), lower, upper)
        values, jacobian = _linearise(fn, trial_point, args)
        cost = jnp.sum(values**2)
        is_better = cost < state.cost

        factor = jnp.where(is_better, 0.1, 10.0)
        relative_cost = cost / jnp.maximum(state.cost, jnp.finfo(y.dtype).tiny)
        accepted_state = _Linearisation(
            residuals=values,
            jacobian=jacobian,
            cost=cost,
            damping=jnp.maximum(state.damping * factor, 1e-12),
            decrease=1.0 - relative_cost,
        )
        refused_state = state._replace(damping=state.damping * factor)
        next_state = jax.tree.map(
            lambda a, b: jnp.where(is_better, a, b), accepted_state, refused_state
        )
        return jnp.where(is_better, trial_point, y), next_state, None

    def terminate(self, fn, y, args, options, state, tags):
        """Return whether the last step changed little, or no step lowers the sum."""
        has_settled = state.decrease < self.rtol
        is_stuck = state.damping > self.max_damping
        return has_settled | is_stuck, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Return the unknowns as they are."""
        return y, aux, {}


def _linearise(fn, y: Array, args: Any) -> tuple[Array, Array]:
    """Return residuals and their derivatives by the unknowns."""

    def residuals(y):
        return fn(y, args)[0]

    values, derivative = jax.linearize(residuals, y)
    columns = jax.vmap(derivative)(jnp.eye(y.size, dtype=y.dtype))
    return values, columns.T


def _damped_step(
    y: Array, state: _Linearisation, lower: Array, upper: Array
) -> Float[Array, " unknowns"]:
    """Return the damped Gauss-Newton step of the unknowns that no bound holds."""
    gradient = state.jacobian.T @ state.residuals
    is_held_low = (y <= lower) & (gradient > 0)
    is_held_high = (y >= upper) & (gradient < 0)
    lengths = jnp.linalg.norm(state.jacobian, axis=0)
    scales = jnp.where(lengths > 0, lengths, 1.0)
    scaled_jacobian = state.jacobian / scales[None]
    columns = jnp.where((is_held_low | is_held_high)[None], 0.0, scaled_jacobian)
    # The damping as rows of their own: unlike normal equations, these keep all digits.
    damping_rows = jnp.sqrt(state.damping) * jnp.eye(y.size, dtype=y.dtype)
    rows = jnp.concatenate([columns, damping_rows])
    targets = jnp.concatenate([-state.residuals, jnp.zeros_like(y)])
    operator = lx.MatrixLinearOperator(rows)
    scaled_step = lx.linear_solve(operator, targets, lx.QR(), throw=False).value
    return scaled_step / scales
