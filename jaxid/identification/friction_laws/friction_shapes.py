"""Shapes of friction laws: the numbers in which forces are not linear."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, NonlinearParameter
from jaxid.dynamics.terms.dry_friction_transitions import USUAL_SPEED
from jaxid.errors import InputError

ShapeValues = Float[AnyArray, " shapes"]
"""Values of the shapes, kind by kind, and joint by joint within each kind."""


class ShapeKind(NamedTuple):
    """A shape of one term; it has one value for each joint."""

    term: int  # index of the term in the model
    shape: NonlinearParameter


class Shapes(eqx.Module):
    """Shape parameters of a model's friction laws, in the order of the terms."""

    model: Model
    kinds: tuple[ShapeKind, ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of shape parameters, those of all joints."""
        return len(self.kinds) * self.model.robot.joints

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each, such as `vs3` in rad/s."""
        parameters = []
        for _, shape in self.kinds:
            for joint, is_revolute in enumerate(self.model.robot.revolute):
                unit = shape.units[0 if is_revolute else 1]
                parameters.append((f"{shape.name}{joint + 1}", unit))
        return tuple(parameters)

    @property
    def terms(self) -> list[int]:
        """Indices of the terms that have shapes."""
        return sorted({kind.term for kind in self.kinds})

    @property
    def standard_columns(self) -> list[int]:
        """Standard parameters of the terms that have shapes."""
        robot = self.model.robot
        sizes = [len(term.parameters(robot)) for term in self.model.terms]
        # Index of the term of each standard parameter.
        owners = np.repeat(np.arange(len(sizes)), sizes)
        return np.flatnonzero(np.isin(owners, self.terms)).tolist()

    @property
    def values(self) -> np.ndarray:
        """Shapes of the model.

        Raises:
            InputError: If one of them is not positive.
        """
        joints = self.model.robot.joints
        values = np.empty((len(self.kinds), joints))
        for row, (term, shape) in enumerate(self.kinds):
            values[row] = shape.value(self.model.terms[term])
        values = values.ravel()
        if not (values > 0).all():
            name, _ = self.parameters[int(np.argmin(values))]
            raise InputError(
                f"`{name}` must start at a positive number, not at {values.min():g}."
            )
        return values

    def terms_with(self, values: ShapeValues) -> tuple[AbstractTerm, ...]:
        """Return the terms of the model with other shapes."""
        terms = list(self.model.terms)
        rows = values.reshape(len(self.kinds), -1)
        for (term, shape), row in zip(self.kinds, rows, strict=True):
            terms[term] = eqx.tree_at(shape.value, terms[term], row)
        return tuple(terms)

    def set(self, base: BaseParameters, values: ShapeValues) -> BaseParameters:
        """Return the same base parameters of the model with other shapes."""
        return eqx.tree_at(lambda b: b.model.terms, base, self.terms_with(values))

    def columns(
        self, values: AnyArray, q: AnyArray, qd: AnyArray, qdd: AnyArray
    ) -> jax.Array:
        """Return columns of the terms with shapes, of a sample [joints, columns]."""
        terms = self.terms_with(values)
        robot = self.model.robot
        parts = [terms[k].columns(robot, q, qd, qdd) for k in self.terms]
        return jnp.concatenate(parts, axis=1)


def select_shapes(base: BaseParameters, names: Sequence[str] = ()) -> Shapes:
    """Return the shapes of these names; without names, those that the terms propose.

    Raises:
        InputError: If there are none.
    """
    # Columns with memory depend on the path, so no sample can be evaluated alone.
    if base.model.memory is not None:
        raise InputError(
            "shapes cannot be identified together with `Presliding`: use `Tanh`."
        )
    kinds = []
    for number, term in enumerate(base.model.terms):
        for shape in term.nonlinear_parameters:
            is_selected = shape.name in names if names else shape.default
            if is_selected:
                kinds.append(ShapeKind(number, shape))
    missing_names = set(names) - {kind.shape.name for kind in kinds}
    if not kinds or missing_names:
        raise InputError(
            "the `model` has no friction with such `shapes`: use `StribeckFriction`."
        )
    # The search starts at numbers, also where no speed of a transition is given.
    model = base.model.with_transition_speeds(USUAL_SPEED)
    return Shapes(model, tuple(kinds))
