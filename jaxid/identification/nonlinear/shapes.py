"""Which numbers of a model's friction laws are to be found, as one vector."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.terms import AbstractTerm
from jaxid.dynamics.transitions import Shape
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

Free = Callable[[tuple[AbstractTerm, ...]], Sequence[Any]]
"""Picks the leaves that shall be found out of a model's terms."""


class Shapes(eqx.Module):
    """A selection of a model's shapes, in the order of the terms; one of each for every joint.

    Attributes:
        robot: Whose joints they belong to.
        chosen: Number of the term, and the shape, of each.
    """

    robot: Robot
    chosen: tuple[tuple[int, Shape], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, base: BaseParameters, free: Free | None = None) -> "Shapes":
        """The shapes that terms want to have found, or those that a user picks.

        Args:
            base: The base parameters of the model.
            free: Picks leaves of the model's terms; what the terms want if None.

        Raises:
            InputError: If there are none, a leaf is no shape, or two shapes have one name.
        """
        terms = base.model.terms
        numbered = jax.tree.unflatten(jax.tree.structure(terms), range(len(jax.tree.leaves(terms))))
        picked = None if free is None else set(jax.tree.leaves(tuple(free(numbered))))
        known = [(i, s, s.leaf(numbered[i])) for i, t in enumerate(terms) for s in t.shapes]
        if picked is not None and not picked <= {leaf for _, _, leaf in known}:
            raise InputError(
                "`free` picks a leaf that is no shape of a friction law: pick such as "
                "`terms[2].transition.epsilon` or `terms[2].speed`."
            )
        chosen = tuple(
            (i, shape)
            for i, shape, leaf in known
            if (shape.wanted if picked is None else leaf in picked)
        )
        names = [shape.name for _, shape in chosen]
        if not names:
            raise InputError(
                "the model has no friction law with a shape to be found: use a smooth transition "
                "(`Tanh`) or `StribeckFriction`, or pick leaves by `free`."
            )
        if len(set(names)) < len(names):
            twice = next(n for n in names if names.count(n) > 1)
            raise InputError(
                f"two terms have a shape called `{twice}`: pick one of them by `free`, and give "
                "the other the value that it shall keep."
            )
        return cls(base.model.robot, chosen)

    @property
    def size(self) -> int:
        """Number of shapes, those of all joints."""
        return len(self.chosen) * self.robot.joints

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each, such as `vs3` in rad/s."""
        return tuple(
            (f"{shape.name}{j + 1}", shape.units[0 if revolute else 1])
            for _, shape in self.chosen
            for j, revolute in enumerate(self.robot.revolute)
        )

    @property
    def terms(self) -> tuple[int, ...]:
        """Numbers of the terms that they shape."""
        return tuple(sorted({i for i, _ in self.chosen}))

    def values(self, base: BaseParameters) -> Float[np.ndarray, " shapes"]:
        """The shapes of a model as they are.

        Raises:
            InputError: If one of them is not positive.
        """
        terms, n = base.model.terms, self.robot.joints
        found = [
            np.broadcast_to(np.asarray(shape.leaf(terms[i]), np.float64), (n,))
            for i, shape in self.chosen
        ]
        x = np.concatenate(found)
        if not (x > 0).all():
            name, _ = self.parameters[int(np.argmin(x))]
            raise InputError(
                f"the search for `{name}` must begin at a positive number, but begins at "
                f"{x.min():g}."
            )
        return x

    def set_in(
        self, terms: tuple[AbstractTerm, ...], x: Float[AnyArray, " shapes"]
    ) -> tuple[AbstractTerm, ...]:
        """The terms of a model with other shapes."""
        changed = list(terms)
        for (i, shape), row in zip(self.chosen, x.reshape(len(self.chosen), -1), strict=True):
            changed[i] = eqx.tree_at(shape.leaf, changed[i], row)
        return tuple(changed)

    def set(self, base: BaseParameters, x: Float[AnyArray, " shapes"]) -> BaseParameters:
        """The base parameters of the model with other shapes: the same combinations."""
        terms = self.set_in(base.model.terms, x)
        return eqx.tree_at(lambda b: b.model.terms, base, terms)
