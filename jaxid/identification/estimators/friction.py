r"""Nonlinear friction by variable projection: shapes of friction laws beside linear parameters.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$. The residual,
$r = z - N c = P^\perp z$, is a function of the shapes alone. Its Jacobian is that of Golub and
Pereyra (1973), $-P^\perp \partial N\, c - (N^+)^T \partial N^T r$, exact since JAX differentiates
the friction laws. Everything is computed from the triangles of the rows.
"""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from jaxid.arrays import AnyArray, Float
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.dispatch import program_of
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, NonlinearParameter
from jaxid.errors import InputError
from jaxid.identification.estimators.estimate import AbstractEstimator
from jaxid.identification.estimators.least_squares import WeightedLeastSquares
from jaxid.identification.estimators.solutions import Decomposition
from jaxid.identification.factors import Blocks, Factors, JointFactor, RowChunk
from jaxid.identification.problem import RegressionProblem
from jaxid.program import evaluate_packed

Selection = Callable[[tuple[AbstractTerm, ...]], Sequence[Any]]
"""Function from the terms of a model to those of their leaves that are identified."""


class NonlinearFriction(AbstractEstimator):
    """Estimator of epsilons, Stribeck speeds and other shapes, and then of all parameters.

    The weights of the joints are those of the linear estimator at the shapes of the model; with the
    shapes found, it estimates again. The base parameters of the fit are those of the model with
    these shapes. Standard deviations assume that the shapes are known: `identify_nonlinear` also
    accounts for their uncertainty, and compares the result with the linear model.

    Attributes:
        linear: Estimator of the linear parameters.
        free: Function that selects leaves of the model's terms; by default epsilons, Stribeck
            speeds and others that the terms propose.
    """

    linear: AbstractEstimator = WeightedLeastSquares()
    free: Selection | None = eqx.field(static=True, default=None)

    def __call__(self, problem):
        """Search for the shapes, and estimate with them.

        Raises:
            InputError: If the model has no shapes, or only factors are known.
        """
        separable, x, notes = self.search(problem, np.asarray(self.linear(problem).weights))
        base = separable.shapes.set(problem.base, x)
        estimate = self.linear(problem.with_base(base))
        return dataclasses.replace(estimate, notes=(*estimate.notes, *notes))

    def search(
        self, problem: RegressionProblem, weights: Float[np.ndarray, " joints"]
    ) -> tuple["SeparableProblem", Float[np.ndarray, " shapes"], tuple[str, ...]]:
        """Return the separable problem, the shapes found, and notes about the search."""
        separable = SeparableProblem(problem, select_shapes(problem.base, self.free))
        start = separable.shapes.values
        begin = _best_multiples(separable, weights, start)
        return separable, *search_shapes(separable, weights, start, begin)


class Shapes(eqx.Module):
    """Shape parameters of a model's friction laws, in the order of the terms.

    Attributes:
        model: Model; every shape has one value for each of its joints.
        members: Index of the term, and shape, of each.
    """

    model: Model
    members: tuple[tuple[int, NonlinearParameter], ...] = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of shape parameters, those of all joints."""
        return len(self.members) * self.model.robot.joints

    @property
    def parameters(self) -> tuple[tuple[str, str], ...]:
        """Name and unit of each, such as `vs3` in rad/s."""
        return tuple(
            (f"{shape.name}{j + 1}", shape.units[0 if revolute else 1])
            for _, shape in self.members
            for j, revolute in enumerate(self.model.robot.revolute)
        )

    @property
    def columns_of_terms(self) -> list[int]:
        """Standard parameters of the terms that have shapes."""
        sizes = [len(term.parameters(self.model.robot)) for term in self.model.terms]
        ends = np.cumsum(sizes)
        return [k for i in self._terms for k in range(ends[i] - sizes[i], ends[i])]

    @property
    def _terms(self) -> list[int]:
        return sorted({i for i, _ in self.members})

    @property
    def values(self) -> Float[np.ndarray, " shapes"]:
        """Shapes of the model.

        Raises:
            InputError: If one of them is not positive.
        """
        terms, n = self.model.terms, (self.model.robot.joints,)
        given = [np.asarray(shape.value(terms[i]), np.float64) for i, shape in self.members]
        x = np.concatenate([np.broadcast_to(value, n) for value in given])
        if not (x > 0).all():
            name, _ = self.parameters[int(np.argmin(x))]
            raise InputError(
                f"the search for `{name}` must start at a positive number, but starts at "
                f"{x.min():g}."
            )
        return x

    def set_in_terms(self, x: Float[AnyArray, " shapes"]) -> tuple[AbstractTerm, ...]:
        """Return the terms of the model with other shapes."""
        changed = list(self.model.terms)
        for (i, shape), row in zip(self.members, x.reshape(len(self.members), -1), strict=True):
            changed[i] = eqx.tree_at(shape.value, changed[i], row)
        return tuple(changed)

    def set(self, base: BaseParameters, x: Float[AnyArray, " shapes"]) -> BaseParameters:
        """Return the base parameters of the model with other shapes: the same combinations."""
        return eqx.tree_at(lambda b: b.model.terms, base, self.set_in_terms(x))

    def columns(self, x: AnyArray, q: AnyArray, qd: AnyArray, qdd: AnyArray) -> jax.Array:
        """Return the shaped terms' columns of a sample [joints, columns]."""
        terms = self.set_in_terms(x)
        parts = [terms[i].columns(self.model.robot, q, qd, qdd) for i in self._terms]
        return jnp.concatenate(parts, axis=1)

    def columns_and_slopes(self, x, q, qd, qdd) -> tuple[jax.Array, jax.Array]:
        """Return the columns, and their derivatives [joints, columns, shapes]."""
        return self.columns(x, q, qd, qdd), jax.jacfwd(self.columns)(x, q, qd, qdd)


def select_shapes(base: BaseParameters, free: Selection | None = None) -> Shapes:
    """Return the shapes that are identified: those that `free` selects, or the terms propose.

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
    return Shapes(base.model, members)


class SeparableProblem:
    r"""The rows $[A \; \Phi(x) \; \partial\Phi(x) \; Q]$ of recordings, as factors for any $x$.

    The first columns are those of the base parameters, then comes for each pair of a varying column
    and a shape the derivative. The fixed columns $A$ are evaluated and factored once. For new
    shapes only friction is evaluated, at the full rate, filtered and decimated like all columns.

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
        base, n = problem.base, (problem.robot.joints,)
        self._problem, self.base, self.shapes = problem, base, shapes
        shaped = shapes.columns_of_terms
        self.varying = tuple(place for place, k in enumerate(base.indices) if k in shaped)
        columns = [shaped.index(base.indices[k]) for k in self.varying]
        self._program = program_of(shapes, shapes.columns_and_slopes, (shapes.size,), n, n, n)
        moved, slopes = (np.asarray(x) for x in self._program.nonzeros)
        pairs = [(v, k) for v, c in enumerate(columns) for k in np.flatnonzero(slopes.any(0)[c])]
        self.pairs = tuple((v, int(k)) for v, k in pairs)
        # For each joint the columns of the factor, and the entries of the program in them.
        entries = []
        for j in range(problem.robot.joints):
            own = [
                (self.varying[v], int(np.ravel_multi_index((j, c), moved.shape)))
                for v, c in enumerate(columns)
                if moved[j, c]
            ]
            for place, (v, k) in enumerate(self.pairs):
                if slopes[j, columns[v], k]:
                    flat = np.ravel_multi_index((j, columns[v], k), slopes.shape)
                    own.append((base.size + place, moved.size + int(flat)))
            entries.append(own)
        self._needed = sorted({entry for own in entries for _, entry in own})
        self._columns = [[column for column, _ in own] for own in entries]
        self._places = [[self._needed.index(entry) for _, entry in own] for own in entries]
        self._pieces, size = [], 0
        for chunk in problem.chunks():
            self._pieces.append(self._factor(chunk))
            size += sum(Q.size for Q in self._pieces[-1][0].columns)
            if size > self.max_numbers:
                raise InputError(
                    "nonlinear friction keeps the columns of all rows of the `observations` in "
                    f"memory, but these are more than {self.max_numbers:.0e} numbers: decimate, or "
                    "take a part of the log."
                )

    @property
    def size(self) -> int:
        """Number of columns of the factors."""
        return self.base.size + len(self.pairs)

    def _factor(self, chunk: RowChunk) -> tuple[RowChunk, list[np.ndarray], list[np.ndarray]]:
        """Return orthonormal bases of each joint's fixed columns, triangles, and other forces."""
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
        return chunk._replace(columns=bases, indices=indices), triangles, rests

    def blocks(self, x: Float[np.ndarray, " shapes"]) -> Blocks:
        """Return the factors by blocks of time for some shapes."""
        shaped = [self._shaped_rows(number, x) for number in range(len(self._problem.recordings))]
        parts: dict[int, list[Factors]] = {}
        for chunk, triangles, rests in self._pieces:
            rows = shaped[chunk.recording][chunk.rows]
            joints = []
            for j, (Q, R, rest) in enumerate(zip(chunk.columns, triangles, rests, strict=True)):
                own = rows[chunk.mask[:, j]][:, self._places[j]]
                along = Q.T @ own
                below = np.linalg.qr(np.column_stack([own - Q @ along, rest]), mode="r")
                above = np.column_stack([R[:, :-1], along, R[:, -1]])
                left = np.zeros((len(below), R.shape[1] - 1))
                whole = np.vstack([above, np.column_stack([left, below])])
                columns = (*chunk.indices[j], *self._columns[j])
                joints.append(JointFactor(columns, whole, len(own)))
            parts.setdefault(chunk.block, []).append(Factors(tuple(joints), self.size))
        return Blocks(tuple(functools.reduce(lambda a, b: a + b, parts[k]) for k in sorted(parts)))

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


def search_shapes(
    problem: SeparableProblem,
    weights: Float[np.ndarray, " joints"],
    start: Float[np.ndarray, " shapes"],
    begin: Float[np.ndarray, " shapes"],
    blocks: Sequence[int] | None = None,
) -> tuple[Float[np.ndarray, " shapes"], tuple[str, ...]]:
    """Search for shapes by Levenberg-Marquardt over their logarithms; return notes as well.

    Where the rows hardly determine a shape, a weak pull keeps it near `start`: as strong as one row
    that tells that it differs by a factor of ten.

    Args:
        problem: Separable problem.
        weights: Weights of the joints' rows.
        start: Shapes to which the pull leads.
        begin: Shapes at which the search begins.
        blocks: Blocks of time that count; by default all.
    """
    pull = np.log(10.0)

    @functools.lru_cache(maxsize=1)
    def projected(x: bytes) -> tuple[Factors, np.ndarray, np.ndarray]:
        found = problem.blocks(np.frombuffer(x))
        factors = found.total if blocks is None else join_blocks(found, blocks)
        return factors, *project(problem, factors, weights)[1:]

    x, steps, success = begin, 0, False
    # Twice, since the strength of the pull depends on the noise, which is known at the end only.
    for _ in range(2):
        factors, left, _ = projected(x.tobytes())
        dof = max(float(factors.rows.sum()) - problem.base.size, 1.0)
        scale = max(float(np.linalg.norm(left)) / np.sqrt(dof), 1e-300)

        def residual(u: np.ndarray, scale: float = scale) -> np.ndarray:
            return np.concatenate([projected((start * np.exp(u)).tobytes())[1] / scale, u / pull])

        def jacobian(u: np.ndarray, scale: float = scale) -> np.ndarray:
            y = start * np.exp(u)
            return np.vstack([projected(y.tobytes())[2] * y / scale, np.eye(len(u)) / pull])

        options = {"jac": jacobian, "method": "lm", "xtol": 1e-4, "ftol": 1e-6, "max_nfev": 60}
        found = optimize.least_squares(residual, np.log(x / start), **options)
        x, steps, success = start * np.exp(found.x), steps + found.nfev, bool(found.success)
    if success:
        return x, ()
    return x, (
        f"the search for the shapes of friction has not converged in {steps} steps: the logs "
        "hardly determine some of them; look at their standard deviations, or select fewer.",
    )


def project(
    problem: SeparableProblem, factors: Factors, weights: Float[np.ndarray, " joints"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the best linear parameters, the weighted residual, and its derivatives by shapes.

    Args:
        problem: Separable problem.
        factors: Factors of all columns at some shapes, of all rows or a part of them.
        weights: Weights of the joints' rows.
    """
    size = problem.base.size
    R, z = factors.weighted(weights)
    missing = problem.size + 1 - len(R)
    R, z = np.pad(R, ((0, missing), (0, 0))), np.pad(z, (0, missing))
    N, slopes = R[:, :size], R[:, size:]
    decomposition = Decomposition.of(N, z)
    B, c = decomposition.inverse_information(), decomposition.solve()
    residual = z - N @ c
    # Derivatives of N c, and of N^T times the residual.
    forces = np.zeros((len(R), problem.shapes.size))
    products = np.zeros((size, problem.shapes.size))
    for place, (v, k) in enumerate(problem.pairs):
        column = problem.varying[v]
        forces[:, k] += c[column] * slopes[:, place]
        products[column, k] += slopes[:, place] @ residual
    orthogonal = forces - N @ (B @ (N.T @ forces))
    return c, residual, -orthogonal - N @ (B @ products)


def _best_multiples(
    problem: SeparableProblem, weights: np.ndarray, start: Float[np.ndarray, " shapes"]
) -> Float[np.ndarray, " shapes"]:
    """Return for each joint the multiples of its shapes that explain its own rows best."""
    kinds, joints = len(problem.shapes.members), problem.shapes.model.robot.joints
    candidates = np.array(list(itertools.product((0.2, 1.0, 5.0), repeat=min(kinds, 2))))
    multiples = np.ones((len(candidates), kinds))
    multiples[:, : candidates.shape[1]] = candidates
    grid = start.reshape(kinds, joints) * multiples[:, :, None]
    squares = []
    for x in grid:
        factors = problem.blocks(x.ravel()).total
        linear = project(problem, factors, weights)[0]
        p = np.append(linear, np.zeros(factors.size - problem.base.size))
        squares.append(factors.residual_squares(p))
    best = np.argmin(squares, axis=0)
    return np.stack([grid[k, :, j] for j, k in enumerate(best)], axis=1).ravel()
