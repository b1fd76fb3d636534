"""Several states of one robot, like cold and warm, identified together (Sec. 6)."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Indices, Matrix, Texts
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.program.sample_methods import in_numpy
from jaxid.result_table import Summarised, Table
from jaxid.robot.loop_closing import reachable

from .combination import as_least_squares, combine, replace_estimates, require_same_base
from .fit_result import Fit, interval_table
from .parameter_changes import Comparison, compare_some, equality_test
from .uncertainty import Uncertainty


class StatesFit(Summarised, eqx.Module):
    """Parameters that all states share, and those that each state has for itself.

    Attributes:
        fits: Fit of each state alone.
        shared: Indices of the base parameters that are the same in all states.
        varying: Indices of the others.
        parameters: Estimates: the shared ones, then those of each state.
        uncertainty: Uncertainty of the estimates.
    """

    fits: tuple[Fit, ...]
    shared: Indices = eqx.field(static=True)
    varying: Indices = eqx.field(static=True)
    parameters: Float[AnyArray, " estimates"]
    uncertainty: Uncertainty

    @property
    def base(self) -> BaseParameters:
        """The base parameters of each state."""
        return self.fits[0].base

    @property
    def states(self) -> Texts:
        """Names of the states."""
        return tuple(fit.name for fit in self.fits)

    @property
    def names(self) -> Texts:
        """Names of all estimates, like `m1` and `fv1 (cold)`."""
        names = [self.base.names[k] for k in self.shared]
        for state in self.states:
            names += [f"{self.base.names[k]} ({state})" for k in self.varying]
        return tuple(names)

    @property
    def units(self) -> Texts:
        """Units of all estimates."""
        indices = (*self.shared, *self.varying * len(self.states))
        return tuple(self.base.units[k] for k in indices)

    def summary(self) -> Table:
        """Return a table of all estimates with their 95 % intervals."""
        return interval_table(
            "parameters shared by all states, then those of each state",
            self.names,
            self.units,
            self.parameters,
            self.uncertainty,
        )

    def fit(self, state: str) -> Fit:
        """Return the fit of one state: to validate, predict and report.

        Raises:
            InputError: If there is no such state.
        """
        k = self._indices(state)
        fit = self.fits[self.states.index(state)]
        uncertainty = Uncertainty(
            covariance=self.uncertainty.covariance[np.ix_(k, k)],
            dof=self.uncertainty.dof[k],
            naive_covariance=fit.uncertainty.naive_covariance,
        )
        return replace_estimates(fit, self.parameters[k], uncertainty)

    def compare(self, first: str, second: str) -> Comparison:
        """Decide which of the parameters that vary have changed between two states.

        The shared ones are the same in both by assumption; `sharing` tests that.

        Args:
            first: Name of one state.
            second: Name of the other.

        Raises:
            InputError: If there is no such state.
        """
        first_indices = self._indices(first)[list(self.varying)]
        second_indices = self._indices(second)[list(self.varying)]
        cross = self.uncertainty.covariance[np.ix_(first_indices, second_indices)]
        return compare_some(self.fit(first), self.fit(second), self.varying, cross)

    @property
    def sharing(self) -> tuple[float, float]:
        """Statistic and p-value of a test if states agree on shared parameters.

        The states' own estimates are compared. A small p-value says that some of them
        have changed after all.
        """
        variances = np.array([np.diag(fit.covariance) for fit in self.fits])
        is_determined = np.all(np.isfinite(variances), axis=0)
        k = [index for index in self.shared if is_determined[index]]
        covariances = [fit.covariance[np.ix_(k, k)] for fit in self.fits]
        dof = [fit.uncertainty.dof[k].min(initial=np.inf) for fit in self.fits]
        return equality_test(
            np.array([fit.parameters[k] for fit in self.fits]),
            np.asarray(scipy.linalg.block_diag(*covariances)),
            float(min(dof)),
        )

    def _indices(self, state: str) -> np.ndarray:
        if state not in self.states:
            raise InputError(
                f"`state` must be one of {', '.join(self.states)}, but is `{state}`."
            )
        return state_indices(self.base.size, self.varying, self.states.index(state))


def identify_states(fits: Sequence[Fit]) -> StatesFit:
    """Identify a robot in several states at once, with common inertia.

    Base parameters that store no energy (friction and offsets) are each state's own.

    The factors of the fits are combined, without another pass over the data. Shared
    parameters become more precise than in any single fit, and so do those that vary,
    since what is mistaken for friction in one state is determined by the others.

    Args:
        fits: Fit of each state, with different names.

    Raises:
        InputError: If there are fewer than two fits, two have the same name, or base
            parameters differ.
    """
    names = [fit.name for fit in fits]
    if len(names) < 2 or len(set(names)) < len(names):
        raise InputError(
            f"`fits` must be two or more with different names: {', '.join(names)}."
        )
    require_same_base(fits)
    # The combination is linear in estimates of least squares only.
    fits = tuple(map(as_least_squares, fits))
    base = fits[0].base
    indices = varying_parameters(base)
    parameters, uncertainty = combine(fits, state_maps(base.size, indices, len(fits)))
    return StatesFit(
        fits=fits,
        shared=tuple(k for k in range(base.size) if k not in indices),
        varying=indices,
        parameters=parameters,
        uncertainty=uncertainty,
    )


def state_indices(size: int, varying: Sequence[int], state: int) -> np.ndarray:
    """Return places of a state's parameters: shared ones, then those of each state."""
    is_varying = np.isin(np.arange(size), varying)
    count = np.count_nonzero(is_varying)
    indices = np.cumsum(~is_varying) - 1
    start = size - count + state * count
    # Those that vary follow the shared ones, state by state.
    indices[is_varying] = np.arange(start, start + count)
    return indices


def state_maps(size: int, varying: Sequence[int], states: int) -> list[Matrix]:
    """Return each state's matrix [base, unknowns] from unknowns to base parameters."""
    unit = np.eye(size + (states - 1) * len(varying))
    return [unit[state_indices(size, varying, state)] for state in range(states)]


def varying_parameters(base: BaseParameters) -> Indices:
    """Return which base parameters are each state's own: those without energy."""
    return tuple(np.flatnonzero(~stores_energy(base)).tolist())


def stores_energy(base: BaseParameters) -> np.ndarray:
    """Return which base parameters make kinetic or potential energy.

    Friction and offsets do not.

    Forces of the others neither depend on accelerations nor come from a potential,
    whatever the terms of the model are called.
    """
    model = base.model
    shape = (2, 3, model.robot.joints)
    # Random poses show every energy; three of them exclude a coincidence.
    q, qdd = np.random.default_rng(0).uniform(-1.0, 1.0, shape)
    q = reachable(model.robot, q)
    zeros = np.zeros_like(q)
    moving_columns = in_numpy(base, base.columns, q, zeros, qdd)
    resting_columns = in_numpy(base, base.columns, q, zeros, zeros)
    inertial_forces = np.abs(moving_columns - resting_columns)
    has_inertia = inertial_forces.max(axis=(0, 1)) > 0

    unit_vectors = np.eye(model.size)[list(base.indices)]
    energies = [in_numpy(model, model.potential, q, shared=(p,)) for p in unit_vectors]
    has_potential = np.ptp(energies, axis=1) > 0
    return has_inertia | has_potential
