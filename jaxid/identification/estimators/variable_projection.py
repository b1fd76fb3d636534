r"""Nonlinear friction by variable projection: shapes of friction laws beside linear parameters.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$. The residual,
$r = z - N c = P^\perp z$, is a function of the shapes alone. Its Jacobian is that of Golub and
Pereyra (1973), $-P^\perp \partial N\, c - (N^+)^T \partial N^T r$, exact since JAX differentiates
the friction laws. Everything is computed from the triangles of the rows.
"""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

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
from jaxid.measurement.observations import Observations
from jaxid.program import evaluate_packed

from ..factors import Blocks, Factors, JointFactor, RowChunk
from ..problem import RegressionProblem
from .estimate import AbstractEstimator
from .least_squares import WeightedLeastSquares
from .regularisation_and_weights import Decomposition


class NonlinearFriction(AbstractEstimator):
    """Estimator of epsilons, Stribeck speeds and other shapes, and then of all parameters.

    The weights of the joints are those of the linear estimator at the shapes of the model; with the
    shapes found, it estimates again. The base parameters of the fit are those of the model with
    these shapes. Standard deviations assume that the shapes are known: `identify_nonlinear` also
    accounts for their uncertainty, and compares the result with the linear model.

    Attributes:
        linear: Estimator of the linear parameters.
        shapes: Names of the shapes that are identified, such as `("vs", "delta")`; by default
            those that the terms propose. The others keep their values.
    """

    linear: AbstractEstimator = WeightedLeastSquares()
    shapes: tuple[str, ...] = eqx.field(static=True, default=())

    def __call__(self, problem):
        """Search for the shapes, and estimate with them."""
        separable, x, notes = self.search(problem, np.asarray(self.linear(problem).weights))
        base = separable.shapes.set(problem.base, x)
        estimate = self.linear(problem.with_base(base))
        return dataclasses.replace(estimate, notes=(*estimate.notes, *notes))

    def search(self, problem: RegressionProblem, weights: np.ndarray):
        """Return the separable problem, the shapes found, and notes about the search."""
        shapes = select_shapes(problem.base, self.shapes)
        separable = SeparableProblem(problem, shapes)
        start = separable.shapes.values
        begin = _best_multiples(separable, weights, start)
        x, notes = search_shapes(separable, weights, start, begin)
        return separable, x, notes


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
        robot, terms = self.model.robot, self.model.terms
        owners = [i for i, term in enumerate(terms) for _ in term.parameters(robot)]
        return [k for k, i in enumerate(owners) if i in self._terms]

    @property
    def _terms(self) -> list[int]:
        return sorted({i for i, _ in self.members})

    @property
    def values(self) -> Float[np.ndarray, " shapes"]:
        """Shapes of the model; one that is not positive is rejected."""
        terms, n = self.model.terms, (self.model.robot.joints,)
        given = [np.asarray(shape.value(terms[i]), np.float64) for i, shape in self.members]
        x = np.concatenate([np.broadcast_to(value, n) for value in given])
        if not (x > 0).all():
            name, _ = self.parameters[int(np.argmin(x))]
            raise InputError(f"`{name}` must start at a positive number, not at {x.min():g}.")
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

    def columns_and_slopes(self, x, q, qd, qdd) -> jax.Array:
        """Return the columns, and their derivatives behind them [joints, columns, 1 + shapes]."""
        slopes = jax.jacfwd(self.columns)(x, q, qd, qdd)
        return jnp.concatenate([self.columns(x, q, qd, qdd)[..., None], slopes], axis=-1)


def select_shapes(base: BaseParameters, names: Sequence[str] = ()) -> Shapes:
    """Return the shapes of these names; without names, those that the terms propose.

    Raises:
        InputError: If there are none.
    """
    if base.model.memory is not None:
        raise InputError("shapes are not searched for beside `Presliding`: take `Tanh`.")
    members = []
    for i, term in enumerate(base.model.terms):
        for shape in term.nonlinear_parameters:
            chosen = shape.name in names if names else shape.default
            members += [(i, shape)] * chosen
    if not members or not {shape.name for _, shape in members} >= set(names):
        raise InputError("the `model` has no friction with such `shapes`: use `StribeckFriction`.")
    return Shapes(base.model, tuple(members))


class SeparableProblem:
    r"""The rows $[A \; \Phi(x) \; \partial\Phi(x) \; Q]$ of recordings, as factors for any $x$.

    The first columns are those of the base parameters, then comes for each pair of a varying column
    and a shape the derivative. The fixed columns $A$ are evaluated and factored once. For new
    shapes only friction is evaluated, at the full rate, filtered and decimated like all columns.

    Attributes:
        base: Base parameters of the model.
        shapes: Shapes to be found.
        pairs: For each derivative the column, as an index of a base parameter, and the shape.
        size: Number of columns.
    """

    def __init__(self, problem: RegressionProblem, shapes: Shapes):
        base, n = problem.base, (problem.robot.joints,)
        self._problem, self.base, self.shapes = problem, base, shapes
        shaped = shapes.columns_of_terms
        # Place among the base parameters, and among the shaped terms' columns.
        varying = [(k, shaped.index(i)) for k, i in enumerate(base.indices) if i in shaped]
        self._varying = {place for place, _ in varying}
        self._program = program_of(shapes, shapes.columns_and_slopes, (shapes.size,), n, n, n)
        acts = np.asarray(self._program.nonzeros)
        pairs = []
        for k, c in varying:
            changing = np.flatnonzero(acts[:, c, 1:].any(axis=0))
            pairs += [(k, c, i) for i in changing.tolist()]
        self.pairs = [(k, i) for k, _, i in pairs]
        self.size = base.size + len(pairs)
        # For each joint the columns that vary, with their places in the output of the program.
        columns = [(k, c, 0) for k, c in varying]
        columns += [(base.size + place, c, 1 + i) for place, (_, c, i) in enumerate(pairs)]
        at = np.arange(acts.size).reshape(acts.shape)
        self._entries = []
        for own, acting in zip(at, acts, strict=True):
            self._entries.append([(k, int(own[c, i])) for k, c, i in columns if acting[c, i]])
        self._pieces = [self._factor(chunk) for chunk in problem.chunks()]

    def _factor(self, chunk: RowChunk) -> tuple[RowChunk, list[np.ndarray], list[np.ndarray]]:
        """Return orthonormal bases of each joint's fixed columns, triangles, and other forces."""
        bases, triangles, rests, indices = [], [], [], []
        joints = zip(chunk.indices, chunk.columns, chunk.forces.T, chunk.mask.T, strict=True)
        for own, theta, force, mask in joints:
            fixed = [place for place, k in enumerate(own) if k not in self._varying]
            Q, R = np.linalg.qr(theta[mask][:, fixed])
            along = Q.T @ force[mask]
            bases.append(Q)
            triangles.append(np.column_stack([R, along]))
            rests.append(force[mask] - Q @ along)
            indices.append(tuple(own[place] for place in fixed))
        return chunk._replace(columns=bases, indices=indices), triangles, rests

    def blocks(self, x: Float[np.ndarray, " shapes"]) -> Blocks:
        """Return the factors by blocks of time for some shapes."""
        shaped = [self._shaped_rows(observations, x) for observations in self._problem.recordings]
        parts: dict[int, list[Factors]] = {}
        for chunk, triangles, rests in self._pieces:
            joints = []
            for j, (Q, R, rest) in enumerate(zip(chunk.columns, triangles, rests, strict=True)):
                own = shaped[chunk.recording][j][chunk.rows][chunk.mask[:, j]]
                along = Q.T @ own
                below = np.linalg.qr(np.column_stack([own - Q @ along, rest]), mode="r")
                above = np.column_stack([R[:, :-1], along, R[:, -1]])
                left = np.zeros((len(below), R.shape[1] - 1))
                whole = np.vstack([above, np.column_stack([left, below])])
                columns = (*chunk.indices[j], *(column for column, _ in self._entries[j]))
                joints.append(JointFactor(columns, whole, len(own)))
            parts.setdefault(chunk.block, []).append(Factors(tuple(joints), self.size))
        return Blocks(tuple(functools.reduce(lambda a, b: a + b, parts[k]) for k in sorted(parts)))

    def _shaped_rows(self, observations: Observations, x: np.ndarray) -> list[np.ndarray]:
        """Return the rows of everything that depends on shapes, for each joint."""
        entries = [entry for own in self._entries for _, entry in own]
        rows = np.empty((observations.rows, len(entries)))
        for chunk in observations.chunks(RegressionProblem.samples_per_chunk):
            motion, _ = observations.read(slice(*chunk.samples))
            arrays = (np.asarray(a, np.float64).T for a in (motion.q, motion.qd, motion.qdd))
            packed = evaluate_packed(self._program, x, *arrays)
            samples = np.empty((len(motion.q), len(entries)), order="F")
            for place, entry in enumerate(entries):
                samples[:, place] = packed[entry]
            rows[slice(*chunk.rows)] = chunk.reduce(samples)
        return np.split(rows, np.cumsum([len(own) for own in self._entries])[:-1], axis=1)


def search_shapes(problem: SeparableProblem, weights, start, begin, blocks=None):
    """Search for shapes by Levenberg-Marquardt over their logarithms; return notes as well.

    Where the rows of some blocks of time (by default all) hardly determine a shape, a weak pull
    keeps it near `start`: as strong as one row that tells that it differs by a factor of ten.
    """
    pull = np.log(10.0)

    @functools.lru_cache(maxsize=1)
    def projected(u: bytes) -> tuple[Factors, np.ndarray, np.ndarray]:
        x = start * np.exp(np.frombuffer(u))
        found = problem.blocks(x)
        factors = found.total if blocks is None else found.select(blocks).total
        _, residual, jacobian = project(problem, factors, weights)
        return factors, residual, jacobian * x

    u, steps, success = np.log(begin / start), 0, False
    # Twice, since the strength of the pull depends on the noise, which is known at the end only.
    for _ in range(2):
        factors, left, _ = projected(u.tobytes())
        dof = max(float(factors.rows.sum()) - problem.base.size, 1.0)
        scale = max(float(np.linalg.norm(left)) / np.sqrt(dof), 1e-300)

        def residual(u: np.ndarray, scale: float = scale) -> np.ndarray:
            return np.append(projected(u.tobytes())[1] / scale, u / pull)

        def jacobian(u: np.ndarray, scale: float = scale) -> np.ndarray:
            return np.vstack([projected(u.tobytes())[2] / scale, np.eye(len(u)) / pull])

        options = {"jac": jacobian, "method": "lm", "xtol": 1e-4, "ftol": 1e-6, "max_nfev": 60}
        found = optimize.least_squares(residual, u, **options)
        u, steps, success = found.x, steps + found.nfev, bool(found.success)
    if success:
        return start * np.exp(u), ()
    return start * np.exp(u), (
        f"the search for the shapes of friction has not converged in {steps} steps: the logs "
        "hardly determine some of them; look at their standard deviations, or select fewer.",
    )


def project(problem: SeparableProblem, factors: Factors, weights: np.ndarray):
    """Return the best linear parameters, the weighted residual, and its derivatives by shapes."""
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
    for place, (column, k) in enumerate(problem.pairs):
        forces[:, k] += c[column] * slopes[:, place]
        products[column, k] += slopes[:, place] @ residual
    orthogonal = forces - N @ (B @ (N.T @ forces))
    return c, residual, -orthogonal - N @ (B @ products)


def _best_multiples(problem: SeparableProblem, weights: np.ndarray, start: np.ndarray):
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
