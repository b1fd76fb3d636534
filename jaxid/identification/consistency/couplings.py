"""Drives that turn several axes: their inertias, and viscous frictions, are matrices."""

import equinox as eqx
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.model import Model
from jaxid.errors import InputError

LARGEST = 4
"""Axes whose drives can be coupled."""


class Coupling(eqx.Module):
    """Numbers of drives that together are a semidefinite matrix.

    Attributes:
        columns: The standard parameters.
        basis: What a unit of each adds to the matrix.
        diagonal: For each axis the parameter on the matrix's diagonal.
    """

    columns: tuple[int, ...] = eqx.field(static=True)
    basis: Float[np.ndarray, "members axes axes"]
    diagonal: tuple[int, ...] = eqx.field(static=True)


def couplings_of(model: Model) -> tuple[Coupling, ...]:
    """Groups of axes whose drives' inertias, or viscous frictions, are one matrix each."""
    robot = model.robot
    total = np.concatenate([term.drive_matrices(robot) for term in model.terms], axis=-1)
    found = []
    for kind, matrix in zip(("RotorInertia", "ViscousFriction"), total, strict=True):
        joined = (matrix != 0).any(axis=-1)
        for group in _groups(joined):
            inside = matrix[np.ix_(group, group)]
            columns = np.flatnonzero(inside.any(axis=(0, 1)))
            diagonal = []
            for place in range(len(group)):
                own = [k for k in columns if inside[place, place, k] != 0]
                if not own:
                    raise InputError(
                        f"coupled drives are consistent only together with the drives' own "
                        f"columns: add `{kind}()`."
                    )
                diagonal.append(int(own[0]))
            if len(group) > LARGEST:
                raise InputError(
                    f"drives that couple more than {LARGEST} axes have no consistent estimate yet: "
                    f"`{robot.name}` couples {len(group)}."
                )
            basis = np.moveaxis(inside[:, :, columns], -1, 0)
            found.append(Coupling(tuple(int(k) for k in columns), basis, tuple(diagonal)))
    return tuple(found)


def _groups(joined: np.ndarray) -> list[list[int]]:
    """Connected groups of more than one axis."""
    n, seen, groups = len(joined), set(), []
    for start in range(n):
        group, front = [], [start]
        while front:
            k = front.pop()
            if k not in seen:
                seen.add(k)
                group.append(k)
                front += [int(j) for j in np.flatnonzero(joined[k] | joined[:, k])]
        if len(group) > 1:
            groups.append(sorted(group))
    return groups
