"""Base parameters: what forces can tell apart of the standard parameters (Eqs. 20-24)."""

import enum
import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float, Hashable, Numbers, as_array
from jaxid.dynamics.closed_forms import ClosedForms, closed_forms
from jaxid.dynamics.machine import columns_of, on_samples
from jaxid.dynamics.model import Coordinates, Model
from jaxid.dynamics.motion import Motion
from jaxid.dynamics.observation import observation_matrix
from jaxid.dynamics.packed import PackedRegressor
from jaxid.dynamics.rank import (
    AbstractRankMethod,
    Dependence,
    GramSchmidt,
    SingularValues,
    regrouping,
)
from jaxid.errors import InputError

Parameters = Float[AnyArray, " base"] | Sequence[float | int]

CLEAR_GAP = 1e3
BARELY = 1e-4


class Identifiability(enum.Enum):
    """What measured forces can say about one standard parameter."""

    ALONE = "identifiable"
    COMBINED = "only in combination"
    NONE = "not identifiable"


class BaseParameters(Hashable):
    r"""A model regrouped to its base parameters: $\hat\Theta_1 (p_1 + \kappa p_2) = Q_m$ (Eq. 22).

    Attributes:
        model: The model with all its standard parameters.
        indices: Columns of the independent standard parameters, in order (the paper's numbering).
        dependent: Columns of the others.
        kappa: How the dependent columns follow from the independent ones.
        smallest_independent: Share of the least independent column that is new, of 1.
        largest_dependent: Share of the most doubtful dependent column that is new, of 1.
        notes: Doubts about the rank, in sentences; empty if there are none.
    """

    model: Model
    indices: tuple[int, ...] = eqx.field(static=True)
    dependent: tuple[int, ...] = eqx.field(static=True)
    kappa: Float[AnyArray, "base dependent"]
    smallest_independent: float
    largest_dependent: float
    notes: tuple[str, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of base parameters."""
        return len(self.indices)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of the standard parameter that leads each base parameter."""
        names = self.model.parameter_names
        return tuple(names[k] for k in self.indices)

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the base parameters."""
        units = self.model.parameter_units
        return tuple(units[k] for k in self.indices)

    @functools.cached_property
    def closed_forms(self) -> ClosedForms:
        """The base parameters in letters, found when they are first asked for (Eq. 24)."""
        return closed_forms(self.model, self.indices, self.dependent, np.asarray(self.kappa))

    @property
    def expressions(self) -> tuple[str, ...]:
        """Each base parameter as a readable combination, like `mx2 + l2x*m3` (Eq. 24)."""
        return tuple(str(e) for e in self.closed_forms.expressions)

    @property
    def lengths(self) -> dict[str, float]:
        """Values of the letters in the expressions: lengths [m], and `g` [m/s²]."""
        return dict(self.closed_forms.lengths)

    @columns_of(lambda base: (base.model, base.model.columns, base.indices))
    def columns(self, q, qd, qdd) -> Float[AnyArray, "joints base"]:
        """The base regressor of one sample, as it is defined (Eq. 23)."""
        return self.model.columns(q, qd, qdd)[:, np.array(self.indices)]

    def forces(self, p, q, qd, qdd) -> Float[AnyArray, " joints"]:
        """The generalized forces of one sample, as they are defined (Eq. 39)."""
        return self.model.forces(self.to_standard(p), q, qd, qdd)

    def inertia(self, p, q) -> Float[AnyArray, "joints joints"]:
        """The mass matrix of one sample, as it is defined (Eq. 38)."""
        return self.model.inertia(self.to_standard(p), q)

    def regressor(self, motion: Motion) -> Float[AnyArray, "*batch joints base"]:
        r"""The base regressor $\Theta_B = \hat\Theta_1$ (Eq. 23)."""
        self.model.check(motion.q)
        return on_samples(self, self.columns, motion.q, motion.qd, motion.qdd)

    def packed_regressor(self, motion: Motion) -> PackedRegressor:
        r"""The stacked base regressor of many samples without its zeros (Eqs. 23, 26).

        Raises:
            InputError: If the motion does not have one axis of samples, or JAX is tracing the
                robot's geometry.
        """
        self.model.check(motion.q)
        return PackedRegressor.of(self, self.columns, motion)

    def from_standard(
        self, p: Float[AnyArray, "*batch standard"] | Sequence[Any]
    ) -> Float[AnyArray, "*batch base"]:
        r"""The base parameters $p_B = p_1 + \kappa p_2$ (Eq. 22)."""
        p = _one_each("standard", p, self.model.size)
        first, second = np.array(self.indices), np.array(self.dependent, dtype=int)
        return p[..., first] + p[..., second] @ self.kappa.T

    def to_standard(
        self, p: Float[AnyArray, "*batch base"] | Sequence[Any]
    ) -> Float[AnyArray, "*batch standard"]:
        """The standard parameters with the same forces whose dependent ones are zero.

        They are no physical masses and inertias, but give the same forces and mass matrix.
        """
        p = _one_each("base", p, self.size)
        shape, places = (*p.shape[:-1], self.model.size), np.array(self.indices)
        if isinstance(p, np.ndarray):
            full = np.zeros(shape)
            full[..., places] = p
            return full
        return jnp.zeros(shape, p.dtype).at[..., places].set(p)

    def inverse_dynamics(self, p: Parameters, motion: Motion) -> Float[AnyArray, "*batch joints"]:
        r"""The generalized forces $\Theta_B p_B$ [N m or N] (Eq. 39)."""
        self.model.check(motion.q)
        return on_samples(self, self.forces, motion.q, motion.qd, motion.qdd, shared=(p,))

    def mass_matrix(self, p: Parameters, q: Coordinates) -> Float[AnyArray, "*batch joints joints"]:
        """The mass matrix, which base parameters determine completely (Eq. 38)."""
        return on_samples(self, self.inertia, self.model.check(q), shared=(p,))

    @property
    def identifiability(self) -> tuple[Identifiability, ...]:
        """For every standard parameter whether forces determine it, alone or in combination."""
        verdict = [Identifiability.NONE] * self.model.size
        mixed = np.asarray(self.kappa) != 0.0
        for row, k in enumerate(self.indices):
            alone = not mixed[row].any()
            verdict[k] = Identifiability.ALONE if alone else Identifiability.COMBINED
        for column, k in enumerate(self.dependent):
            if mixed[:, column].any():
                verdict[k] = Identifiability.COMBINED
        return tuple(verdict)


def _one_each(kind: str, p: Numbers, size: int) -> Float[AnyArray, "*batch parameters"]:
    # What is no array of JAX stays in NumPy, and in float64 where JAX runs in float32.
    p = as_array("p", p)
    if p.shape[-1:] != (size,):
        raise InputError(
            f"`p` must hold one number for each {kind} parameter ({size}) along its last axis, but "
            f"has shape {p.shape}."
        )
    return p


def base_parameters(
    model: Model, *, method: AbstractRankMethod | None = None, seed: int = 0
) -> BaseParameters:
    r"""Finds which combinations of parameters the forces determine (Eqs. 20-22).

    The regressor is evaluated at random motions and stacked. Columns that earlier ones replace are
    found by Gram-Schmidt in column order, and counted again by singular values.

    Args:
        model: The model.
        method: How dependence is decided; the other way is always the cross-check.
        seed: Of the random motions.

    Returns:
        The base parameters; a disagreement or a small gap stands in their `notes`.
    """
    method = GramSchmidt() if method is None else method
    check = GramSchmidt() if isinstance(method, SingularValues) else SingularValues()
    W, scale = observation_matrix(model, seed)
    found = method(W)
    other = check(W)
    kappa, left = regrouping(W, found)
    first, second = np.array(found.independent, int), np.array(found.dependent, int)
    kappa = kappa * scale[first][:, None] / scale[second]
    notes = _doubts(found, other, left, _least_independent(W, model, found))
    return BaseParameters(
        model,
        found.independent,
        found.dependent,
        kappa,
        found.smallest_independent,
        found.largest_dependent,
        notes,
    )


def _least_independent(
    W: Float[np.ndarray, "rows standard"], model: Model, found: Dependence
) -> str:
    """Name of the parameter whose column earlier independent ones replace best."""
    if not found.independent:
        return ""
    chosen = W[:, found.independent]
    R = np.linalg.qr(chosen / np.linalg.norm(chosen, axis=0), mode="r")
    return model.parameter_names[found.independent[int(np.argmin(np.abs(np.diag(R))))]]


def _doubts(found: Dependence, other: Dependence, left: float, weakest: str) -> tuple[str, ...]:
    notes = []
    if len(found.independent) != len(other.independent):
        notes.append(
            f"the two ways to count base parameters disagree: {len(found.independent)} and "
            f"{len(other.independent)}; the geometry is nearly degenerate, or angles are rounded."
        )
    elif found.independent != other.independent:
        notes.append(
            "the two ways to count base parameters agree on their number but not on which columns "
            "lead them; the geometry is nearly degenerate."
        )
    if found.smallest_independent < BARELY:
        notes.append(
            f"`{weakest}` is barely a base parameter of its own: only "
            f"{found.smallest_independent:.1e} of its column is new. Lengths that are almost zero, "
            "or rounded angles such as 1.5708, do that; forces cannot determine it well."
        )
    if found.dependent and found.gap < CLEAR_GAP:
        notes.append(
            f"independent and dependent columns are not clearly apart: the smallest independent "
            f"share is {found.smallest_independent:.1e}, the largest dependent one "
            f"{found.largest_dependent:.1e}."
        )
    if left > 1e-9:
        notes.append(f"a dependent column is explained only to {left:.1e} of its size.")
    return tuple(notes)
