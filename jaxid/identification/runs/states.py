"""Several states of one robot, cold and warm or light and loaded, identified together (Sec. 6)."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np

from jaxid.arrays import Bool, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import in_numpy
from jaxid.errors import InputError
from jaxid.identification.fit import Fit
from jaxid.identification.runs.comparison import LEVEL, Comparison, joint_test
from jaxid.identification.runs.estimates import Estimates, groups, with_covariance
from jaxid.identification.runs.least_squares import least_squares_of, require_same_base
from jaxid.identification.runs.tied import Tied, tied
from jaxid.table import Table

POSES = 3
"""Random poses in which energies are looked at."""


class StatesFit(eqx.Module):
    """Parameters that all states share, and those that each state has for itself.

    Attributes:
        runs: One for each state.
        shared: Indices of the base parameters that are the same in all states.
        varying: Indices of the others.
        found: Estimates: the shared ones, then those of each state.
    """

    runs: tuple[Fit, ...]
    shared: tuple[int, ...] = eqx.field(static=True)
    varying: tuple[int, ...] = eqx.field(static=True)
    found: Tied

    @property
    def base(self) -> BaseParameters:
        """The base parameters of each state."""
        return self.runs[0].base

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""
        return tuple(run.name for run in self.runs)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all estimates, like `m1` and `fv1 (cold)`."""
        names = self.base.names
        own = (f"{names[k]} ({state})" for state in self.states for k in self.varying)
        return (*(names[k] for k in self.shared), *own)

    def summary(self) -> Table:
        """Return a table of all estimates with their 95 % intervals."""
        title = "parameters that all states share, then those of each state"
        return self.estimates.summary(title)

    def __str__(self) -> str:
        return str(self.summary())

    @property
    def estimates(self) -> Estimates:
        """All estimates at once: what is shared, then what each state has for itself."""
        units, kinds = self.base.units, groups(self.base)
        order = (*self.shared, *self.varying * len(self.runs))
        return Estimates(
            label=", ".join(self.states),
            names=self.names,
            expressions=self.names,
            units=tuple(units[k] for k in order),
            groups=tuple(kinds[k] for k in order),
            parameters=self.found.parameters,
            covariance=self.found.covariance,
            freedom=self.found.freedom,
        )

    def places(self, state: str) -> tuple[int, ...]:
        """For each base parameter where it stands in a state's estimates.

        Raises:
            InputError: If there is no such state.
        """
        if state not in self.states:
            raise InputError(f"`state` must be one of {', '.join(self.states)}, but is `{state}`.")
        return _places(self.base.size, self.shared, self.varying, self.states.index(state))

    def of(self, state: str) -> Estimates:
        """The base parameters of one state.

        Raises:
            InputError: If there is no such state.
        """
        k = np.array(self.places(state))
        base = self.base
        return Estimates(
            label=state,
            names=base.names,
            expressions=base.names,
            units=base.units,
            groups=groups(base),
            parameters=np.asarray(self.found.parameters)[k],
            covariance=np.asarray(self.found.covariance)[np.ix_(k, k)],
            freedom=np.asarray(self.found.freedom)[k],
        )

    def fit(self, state: str) -> Fit:
        """The model of one state: to validate, predict and report.

        Raises:
            InputError: If there is no such state.
        """
        own = self.of(state)
        run = self.runs[self.states.index(state)]
        return with_covariance(run, own.parameters, own.covariance, own.freedom)

    def compare(self, first: str, second: str, level: float = LEVEL) -> Comparison:
        """Decides which of the parameters that vary have changed between two states.

        What the states share is the same in both by assumption; `sharing` tests that.

        Args:
            first: Name of one state.
            second: Name of the other.
            level: Confidence of intervals and tests, of 1.

        Raises:
            InputError: If there is no such state, or `level` is no share.
        """
        a, b = (np.array(self.places(state))[list(self.varying)] for state in (first, second))
        cross = np.asarray(self.found.covariance)[np.ix_(a, b)]
        one, other = (self.of(state).only(self.varying) for state in (first, second))
        return Comparison.of(one, other, level, cross)

    @property
    def sharing(self) -> tuple[float, float]:
        """Whether the runs agree on what they share: a joint test, and its chance, of 1.

        The runs' own estimates of the shared parameters are compared with those of the first run.
        A small chance says that some of them have changed after all.
        """
        k = np.array(self.shared)
        first, others = self.runs[0], self.runs[1:]
        blocks = [np.asarray(run.covariance)[np.ix_(k, k)] for run in others]
        difference = np.concatenate(
            [np.asarray(run.parameters)[k] - np.asarray(first.parameters)[k] for run in others]
        )
        size = len(k)
        covariance = np.tile(np.asarray(first.covariance)[np.ix_(k, k)], (len(others), len(others)))
        for i, block in enumerate(blocks):
            own = slice(i * size, (i + 1) * size)
            covariance[own, own] += block
        freedom = min(float(np.min(np.asarray(run.uncertainty.dof)[k])) for run in self.runs)
        return joint_test(difference, covariance, freedom)


def identify_states(
    runs: Sequence[Fit], varying: Sequence[str] | None = None, shared: Sequence[str] | None = None
) -> StatesFit:
    """Identifies a robot in several states at once: inertia is shared, friction is each state's.

    Nothing is computed from the data again: the factors of the runs are combined. Shared parameters
    become more precise than those of any single run, and so do those that vary, as what is mistaken
    for friction in one run is held by the others.

    Args:
        runs: One for each state, with different names.
        varying: Names of the base parameters that each state has for itself. If None, those that
            store no energy: friction and offsets.
        shared: Names of the base parameters that are the same in all states; an alternative to
            `varying`.

    Raises:
        InputError: If there are fewer than two runs, two have the same name, base parameters
            differ, or there is no such base parameter.
    """
    runs = tuple(runs)
    require_same_base(runs)
    runs = tuple(map(least_squares_of, runs))
    states = [run.name for run in runs]
    if len(runs) < 2 or len(set(states)) < len(states):
        raise InputError(
            "`runs` must be two or more with different names, but are "
            f"{', '.join(states)}: name them by their states."
        )
    base = runs[0].base
    own = own_parameters(base, varying, shared)
    same = tuple(k for k in range(base.size) if k not in own)
    return StatesFit(runs, same, own, tied(runs, state_maps(base.size, own, len(runs))))


def state_maps(
    size: int, varying: tuple[int, ...], states: int
) -> list[Float[np.ndarray, "base unknowns"]]:
    """For each state how its base parameters follow from shared ones and those of all states.

    Args:
        size: Number of base parameters.
        varying: Those that each state has for itself.
        states: Number of states.
    """
    shared = tuple(k for k in range(size) if k not in varying)
    maps = []
    for number in range(states):
        E = np.zeros((size, len(shared) + len(varying) * states))
        E[np.arange(size), list(_places(size, shared, varying, number))] = 1.0
        maps.append(E)
    return maps


def _places(
    size: int, shared: tuple[int, ...], varying: tuple[int, ...], number: int
) -> tuple[int, ...]:
    first = len(shared) + number * len(varying)
    places = dict(zip(shared, range(len(shared)), strict=True))
    places |= dict(zip(varying, range(first, first + len(varying)), strict=True))
    return tuple(places[k] for k in range(size))


def own_parameters(
    base: BaseParameters, varying: Sequence[str] | None, shared: Sequence[str] | None
) -> tuple[int, ...]:
    """Indices of the base parameters that each state has for itself.

    Args:
        base: The base parameters.
        varying: Their names; if None, those that store no energy.
        shared: Names of the others; an alternative to `varying`.

    Raises:
        InputError: If both are given, or there is no such base parameter.
    """
    if varying is not None and shared is not None:
        raise InputError("give either `varying` or `shared`, and not both.")
    named = shared if varying is None else varying
    if named is None:
        return tuple(int(k) for k in np.flatnonzero(~stores_energy(base)))
    wrong = [name for name in named if name not in base.names]
    if wrong:
        raise InputError(
            f"`{wrong[0]}` is no base parameter of `{base.model.robot.name}`: see `base.names`."
        )
    own = {base.names.index(name) for name in named}
    return tuple(k for k in range(base.size) if (k in own) == (varying is not None))


def stores_energy(base: BaseParameters) -> Bool[np.ndarray, " base"]:
    """Which base parameters make kinetic or potential energy; friction and offsets do not.

    Forces of the others depend neither on accelerations nor come from a potential, whatever the
    terms of the model are called.

    Args:
        base: The base parameters.
    """
    model, random = base.model, np.random.default_rng(0)
    n = model.robot.joints
    q, qdd = random.uniform(-1.0, 1.0, (2, POSES, n))
    rest = np.zeros_like(q)
    moving = in_numpy(base, base.columns, q, rest, qdd) - in_numpy(
        base, base.columns, q, rest, rest
    )
    kinetic = np.abs(moving).max(axis=(0, 1)) > 0
    chosen = np.eye(model.size)[list(base.indices)]
    energies = [in_numpy(model, model.potential, q, shared=(p,)) for p in chosen]
    potential = np.ptp(np.array(energies), axis=1) > 0
    return kinetic | potential
