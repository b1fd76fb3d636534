"""Rows of a model whose friction laws have unknown shapes: the other columns are computed once."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.dynamics.terms import AbstractTerm, NonlinearParameter
from jaxid.errors import InputError
from jaxid.identification.factors import Blocks, Factors, JointFactor, RowChunk
from jaxid.identification.problem import RegressionProblem
from jaxid.program import evaluate_packed
from jaxid.robot.robot import Robot

Selection = Callable[[tuple[AbstractTerm, ...]], Sequence[Any]]
"""Function from the terms of a model to those of their leaves that are identified."""


class Shapes(eqx.Module):
    """Shape parameters of a model's friction laws, in the order of the terms.

    Attributes:
        robot: Robot; every shape has one value for each of its joints.
        members: Index of the term, and shape, of each.
    """

    robot: Robot
    members: tuple[tuple[int, NonlinearParameter], ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of shape parameters, those of all joints."""
        return len(self.members) * self.robot.joints

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each, such as `vs3` in rad/s."""
        return tuple(
            (f"{shape.name}{j + 1}", shape.units[0 if revolute else 1])
            for _, shape in self.members
            for j, revolute in enumerate(self.robot.revolute)
        )

    @property
    def terms(self) -> tuple[int, ...]:
        """Indices of the terms that they belong to."""
        return tuple(sorted({i for i, _ in self.members}))

    def values(self, base: BaseParameters) -> Float[np.ndarray, " shapes"]:
        """Return the shapes of a model.

        Raises:
            InputError: If one of them is not positive.
        """
        terms, n = base.model.terms, self.robot.joints
        x = np.concatenate(
            [
                np.broadcast_to(np.asarray(shape.value(terms[i]), np.float64), (n,))
                for i, shape in self.members
            ]
        )
        if not (x > 0).all():
            name, _ = self.parameters[int(np.argmin(x))]
            raise InputError(
                f"the search for `{name}` must start at a positive number, but starts at "
                f"{x.min():g}."
            )
        return x

    def set_in(
        self, terms: tuple[AbstractTerm, ...], x: Float[AnyArray, " shapes"]
    ) -> tuple[AbstractTerm, ...]:
        """Return the terms of a model with other shapes."""
        changed = list(terms)
        for (i, shape), row in zip(self.members, x.reshape(len(self.members), -1), strict=True):
            changed[i] = eqx.tree_at(shape.value, changed[i], row)
        return tuple(changed)

    def set(self, base: BaseParameters, x: Float[AnyArray, " shapes"]) -> BaseParameters:
        """Return the base parameters of the model with other shapes: the same combinations."""
        terms = self.set_in(base.model.terms, x)
        return eqx.tree_at(lambda b: b.model.terms, base, terms)


def select_shapes(base: BaseParameters, free: Selection | None = None) -> Shapes:
    """Return the shapes that are identified.

    Args:
        base: Base parameters of the model.
        free: Function that selects leaves of the model's terms; by default epsilons, Stribeck
            speeds and others that the terms propose.

    Raises:
        InputError: If there are none, a leaf is no shape, or two shapes have one name.
    """
    terms = base.model.terms
    numbered = jax.tree.unflatten(jax.tree.structure(terms), range(len(jax.tree.leaves(terms))))
    selected = None if free is None else set(jax.tree.leaves(tuple(free(numbered))))
    known = [
        (i, s, s.value(numbered[i])) for i, t in enumerate(terms) for s in t.nonlinear_parameters
    ]
    if selected is not None and not selected <= {leaf for _, _, leaf in known}:
        raise InputError(
            "`free` selects a leaf that is no shape of a friction law: select one like "
            "`terms[2].transition.epsilon` or `terms[2].speed`."
        )
    members = tuple(
        (i, shape)
        for i, shape, leaf in known
        if (shape.default if selected is None else leaf in selected)
    )
    names = [shape.name for _, shape in members]
    if not names:
        raise InputError(
            "the `model` has no friction law with a shape to identify: use a smooth transition "
            "(`Tanh`) or `StribeckFriction`, or select leaves by `free`."
        )
    if len(set(names)) < len(names):
        double = next(n for n in names if names.count(n) > 1)
        raise InputError(
            f"two terms have a shape called `{double}`: select one of them by `free`, and give "
            "the other its value."
        )
    return Shapes(base.model.robot, members)


class ShapedColumns(eqx.Module):
    """Columns of the base regressor that depend on shapes, and their derivatives.

    Attributes:
        base: Base parameters.
        shapes: Shapes.
        positions: Positions of these columns among the columns of the shaped terms.
    """

    base: BaseParameters
    shapes: Shapes
    positions: tuple[int, ...] = eqx.field(static=True)

    def columns(self, x, q, qd, qdd) -> tuple[jax.Array, jax.Array]:
        """Return columns [joints, varying] of a sample, and derivatives [joints, varying, shapes].

        Args:
            x: Shapes.
            q: Joint angles.
            qd: Joint velocities.
            qdd: Joint accelerations.
        """
        model = self.base.model

        def varying(x):
            terms = self.shapes.set_in(model.terms, x)
            parts = [terms[i].columns(model.robot, q, qd, qdd) for i in self.shapes.terms]
            return jnp.concatenate(parts, axis=1)[:, np.array(self.positions, int)]

        return varying(x), jax.jacfwd(varying)(x)


class _FactoredChunk(NamedTuple):
    """Rows with the QR decomposition of the columns that do not depend on shapes.

    Attributes:
        chunk: Rows; `columns` are orthonormal bases of each joint's fixed columns.
        R: Triangle of fixed columns and forces of each joint.
        rest: Forces of each joint that the fixed columns do not explain.
    """

    chunk: RowChunk
    R: list[np.ndarray]
    rest: list[np.ndarray]


class SeparableProblem:
    r"""The rows $[A \; \Phi(x) \; \partial\Phi(x) \; Q]$ of recordings, as factors for any $x$.

    The first columns are those of the base parameters, then comes for each pair of a varying column
    and a shape the derivative. The fixed columns $A$ are evaluated and factored once. For new
    shapes only friction is evaluated, at the full rate, filtered and decimated like all columns.

    Args:
        problem: Regression problem of the model.
        shapes: Shapes to be found.

    Attributes:
        base: Base parameters of the model.
        shapes: Shapes to be found.
        varying: Positions of the varying columns among the base parameters.
        pairs: Varying column and shape of each derivative.

    Raises:
        InputError: If only factors are known, or the rows do not fit into memory.
    """

    max_numbers = 2**28
    """Largest size (two gigabytes) of the columns in memory."""

    def __init__(self, problem: RegressionProblem, shapes: Shapes):
        problem.require_samples("nonlinear friction")
        self._problem, self.base, self.shapes = problem, problem.base, shapes
        robot, base = problem.robot, problem.base
        sizes = [len(term.parameters(robot)) for term in base.model.terms]
        starts = np.cumsum([0, *sizes])
        shaped = [k for i in shapes.terms for k in range(starts[i], starts[i + 1])]
        self.varying = tuple(place for place, k in enumerate(base.indices) if k in shaped)
        positions = tuple(shaped.index(base.indices[k]) for k in self.varying)
        columns = ShapedColumns(base, shapes, positions)
        n = (robot.joints,)
        self._program = program_of(columns, columns.columns, (shapes.size,), n, n, n)
        moved, slopes = self._program.nonzeros
        self.pairs = tuple((int(v), int(k)) for v, k in np.argwhere(slopes.any(axis=0)))
        entries = []
        for j in range(robot.joints):
            own = [(self.varying[v], j * moved.shape[1] + v) for v in np.flatnonzero(moved[j])]
            for place, (v, k) in enumerate(self.pairs):
                if slopes[j, v, k]:
                    flat = np.ravel_multi_index((j, v, k), slopes.shape)
                    own.append((base.size + place, moved.size + int(flat)))
            entries.append(own)
        self._needed = sorted({entry for own in entries for _, entry in own})
        position = {entry: i for i, entry in enumerate(self._needed)}
        self._columns = [[column for column, _ in own] for own in entries]
        self._places = [[position[entry] for _, entry in own] for own in entries]
        self._pieces = self._factor_chunks()

    @property
    def size(self) -> int:
        """Number of columns of the factors."""
        return self.base.size + len(self.pairs)

    def _factor_chunks(self) -> list[_FactoredChunk]:
        pieces, size = [], 0
        for chunk in self._problem.chunks():
            pieces.append(self._factor(chunk))
            size += sum(Q.size for Q in pieces[-1].chunk.columns)
            if size > self.max_numbers:
                raise InputError(
                    "nonlinear friction keeps the columns of all rows of the `observations` in "
                    f"memory, but these are more than {self.max_numbers:.0e} numbers: decimate, or "
                    "take a part of the log."
                )
        return pieces

    def _factor(self, chunk: RowChunk) -> _FactoredChunk:
        bases, triangles, rests, indices = [], [], [], []
        joints = zip(chunk.indices, chunk.columns, chunk.forces.T, chunk.mask.T, strict=True)
        for own, theta, force, mask in joints:
            fixed = [place for place, k in enumerate(own) if k not in self.varying]
            Q, R = np.linalg.qr(theta[mask][:, fixed])
            along = Q.T @ force[mask]
            bases.append(Q)
            triangles.append(np.column_stack([R, along]))
            rests.append(force[mask] - Q @ along)
            indices.append(tuple(own[place] for place in fixed))
        chunk = chunk._replace(columns=bases, indices=indices)
        return _FactoredChunk(chunk, triangles, rests)

    def blocks(self, x: Float[np.ndarray, " shapes"]) -> Blocks:
        """Return the factors by blocks of time for some shapes."""
        shaped = [self._shaped_rows(number, x) for number in range(len(self._problem.recordings))]
        parts: dict[int, list[Factors]] = {}
        for piece in self._pieces:
            columns = shaped[piece.chunk.recording][piece.chunk.rows]
            joints = tuple(self._joint(piece, j, columns) for j in range(len(piece.R)))
            parts.setdefault(piece.chunk.block, []).append(Factors(joints, self.size))
        return Blocks(tuple(functools.reduce(lambda a, b: a + b, parts[k]) for k in sorted(parts)))

    def _joint(self, piece: _FactoredChunk, j: int, columns: np.ndarray) -> JointFactor:
        """Return the factor of a joint's fixed and shaped columns."""
        Q, R, rest = piece.chunk.columns[j], piece.R[j], piece.rest[j]
        own = columns[piece.chunk.mask[:, j]][:, self._places[j]]
        along = Q.T @ own
        below = np.linalg.qr(np.column_stack([own - Q @ along, rest]), mode="r")
        above = np.column_stack([R[:, :-1], along, R[:, -1]])
        left = np.zeros((len(below), R.shape[1] - 1))
        whole = np.vstack([above, np.column_stack([left, below])])
        return JointFactor((*piece.chunk.indices[j], *self._columns[j]), whole, len(own))

    def _shaped_rows(self, number: int, x: Float[np.ndarray, " shapes"]) -> np.ndarray:
        """Return the rows of everything that depends on shapes, for one recording."""
        observations = self._problem.recordings[number]
        rows = np.empty((observations.rows, len(self._needed)))
        for chunk in observations.chunks(RegressionProblem.samples_per_chunk):
            motion, _ = observations.read(slice(*chunk.samples))
            arrays = (np.asarray(a, np.float64).T for a in (motion.q, motion.qd, motion.qdd))
            packed = evaluate_packed(self._program, np.asarray(x), *arrays)
            samples = np.empty((len(motion.q), len(self._needed)), order="F")
            for place, entry in enumerate(self._needed):
                samples[:, place] = packed[entry]
            rows[slice(*chunk.rows)] = chunk.reduce(samples)
        return rows


def join_blocks(blocks: Blocks, chosen: Sequence[int]) -> Factors:
    """Return the factors of some blocks together."""
    return Blocks(tuple(blocks.parts[k] for k in chosen)).total
