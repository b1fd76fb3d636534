"""Robots of one topology: what differs between them becomes an input of their program."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.robot.robot import Robot

_FIELDS = ("axis", "rotation", "offset", "gravity")


class Geometries(eqx.Module):
    """Robots that differ in some numbers of their geometry, with the base columns of one of them.

    Numbers that are the same for all robots stay constants of the program: robots whose lengths
    differ cost as much as one robot.

    Attributes:
        base: The base parameters; its robot has the numbers that do not differ.
        varying: Positions of those that do, in axes, rotations, offsets and gravity.
    """

    base: BaseParameters
    varying: tuple[int, ...] = eqx.field(static=True)

    def columns(self, q, qd, qdd, x) -> Float[AnyArray, "joints base"]:
        """The base regressor of one sample and one robot, whose own numbers are `x` (Eq. 23)."""
        model = self.base.model
        fixed = [np.asarray(getattr(model.robot, name), np.float64) for name in _FIELDS]
        size = sum(a.size for a in fixed)
        order = np.arange(size)
        order[list(self.varying)] = size + np.arange(len(self.varying))
        whole = jnp.concatenate([*(jnp.asarray(a.ravel(), x.dtype) for a in fixed), x])[order]
        changed, start = {}, 0
        for name, a in zip(_FIELDS, fixed, strict=True):
            changed[name] = whole[start : start + a.size].reshape(a.shape)
            start += a.size
        robot = model.robot.replace(**changed)
        placed = eqx.tree_at(lambda b: b.model.robot, self.base, robot)
        return placed.columns(q, qd, qdd)


def geometries(
    base: BaseParameters, robots: Sequence[Robot]
) -> tuple[Geometries, Float[np.ndarray, "datasets numbers"]]:
    """Finds what differs between robots.

    Args:
        base: The base parameters of a robot of the same topology.
        robots: One for each data set.

    Returns:
        The robots as one definition, and for each robot its numbers.

    Raises:
        InputError: If a robot has another topology, or carries a known tool.
    """
    own = base.model.robot
    for k, robot in enumerate(robots):
        if robot.parent != own.parent or robot.revolute != own.revolute:
            raise InputError(
                f"`robots` must have the topology of `{own.name}`, but number {k}, "
                f"`{robot.name}`, has other joints: identify it with its own base parameters."
            )
        if robot.tool is not None:
            raise InputError(
                f"number {k} of `robots`, `{robot.name}`, carries a known tool: subtract its "
                "forces beforehand and take the robot without it."
            )
    numbers = np.array([_numbers(robot) for robot in robots])
    varying = tuple(int(k) for k in np.flatnonzero((numbers != _numbers(own)).any(axis=0)))
    return Geometries(base, varying), numbers[:, list(varying)]


def _numbers(robot: Robot) -> np.ndarray:
    return np.concatenate([np.ravel(getattr(robot, name)) for name in _FIELDS]).astype(np.float64)
