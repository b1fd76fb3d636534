r"""Nonlinear friction by variable projection: shapes of friction laws beside linear parameters.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$,
so the residual $r = z - N c$ is a function of the shapes alone (Golub and Pereyra,
1973). Everything is
JAX: the search can be compiled, mapped over draws of the forces, and differentiated.
"""

import dataclasses
import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, require_float64
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, NonlinearParameter
from jaxid.errors import InputError
from jaxid.measurement.observations import Observations

from ..problem import RegressionProblem
from .estimate import AbstractEstimator
from .least_squares import WeightedLeastSquares
from .regularisation_and_weights import RIDGE, inverse_information

STEPS = 60
"""Largest number of steps of a search."""


class NonlinearFriction(AbstractEstimator):
    """Estimator of epsilons, Stribeck speeds and other shapes, and then of all parameters.

    The weights of the joints are those of the linear estimator at the shapes of the
    model; with the shapes found, it estimates again. The base parameters of the fit are
    those of the model with these shapes. Standard deviations assume that the shapes are
    known: `identify_nonlinear` also accounts for their uncertainty, and compares the
        result with the linear model.

    Attributes:
        linear: Estimator of the linear parameters.
        shapes: Names of the shapes that are identified, such as `("vs", "delta")`; by
            default those that the terms propose. The others keep their values.
    """

    linear: AbstractEstimator = WeightedLeastSquares()
    shapes: tuple[str, ...] = eqx.field(static=True, default=())

    def __call__(self, problem):
        """Search for the shapes, and estimate with them."""
        search, x, notes = self.search(
            problem, np.asarray(self.linear(problem).weights)
        )
        base = search.shapes.set(problem.base, x)
        estimate = self.linear(problem.with_base(base))
        return dataclasses.replace(estimate, notes=(*estimate.notes, *notes))

    def search(self, problem: RegressionProblem, weights: np.ndarray):
        """Return the search, the shapes found, and notes about it."""
        search = ShapeSearch.of(problem, select_shapes(problem.base, self.shapes))
        every = np.ones(max(search.blocks) + 1)
        x, converged = eqx.filter_jit(search)(weights, every)
        notes = ()
        if not converged:
            notes = (
                f"the search for the shapes of friction has not converged in {STEPS} "
                "steps: the "
                "logs hardly determine some of them; look at their standard "
                "deviations, or select "
                "fewer.",
            )
        return search, np.asarray(x), notes


class Shapes(eqx.Module):
    """Shape parameters of a model's friction laws, in the order of the terms."""

    model: Model  # model; every shape has one value for each of its joints
    # index of the term, and shape, of each
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
        given = [
            np.asarray(shape.value(terms[i]), np.float64) for i, shape in self.members
        ]
        x = np.concatenate([np.broadcast_to(value, n) for value in given])
        if not (x > 0).all():
            name, _ = self.parameters[int(np.argmin(x))]
            raise InputError(
                f"`{name}` must start at a positive number, not at {x.min():g}."
            )
        return x

    def set_in_terms(self, x: Float[AnyArray, " shapes"]) -> tuple[AbstractTerm, ...]:
        """Return the terms of the model with other shapes."""
        changed = list(self.model.terms)
        for (i, shape), row in zip(
            self.members, x.reshape(len(self.members), -1), strict=True
        ):
            changed[i] = eqx.tree_at(shape.value, changed[i], row)
        return tuple(changed)

    def set(
        self, base: BaseParameters, x: Float[AnyArray, " shapes"]
    ) -> BaseParameters:
        """Return the base parameters of the model with other shapes: the same combinations."""
        return eqx.tree_at(lambda b: b.model.terms, base, self.set_in_terms(x))

    def columns(
        self, x: AnyArray, q: AnyArray, qd: AnyArray, qdd: AnyArray
    ) -> jax.Array:
        """Return the shaped terms' columns of a sample [joints, columns]."""
        terms = self.set_in_terms(x)
        parts = [terms[i].columns(self.model.robot, q, qd, qdd) for i in self._terms]
        return jnp.concatenate(parts, axis=1)


def select_shapes(base: BaseParameters, names: Sequence[str] = ()) -> Shapes:
    """Return the shapes of these names; without names, those that the terms propose.

    Raises:
        InputError: If there are none.
    """
    if base.model.memory is not None:
        raise InputError(
            "shapes are not searched for beside `Presliding`: take `Tanh`."
        )
    members = []
    for i, term in enumerate(base.model.terms):
        for shape in term.nonlinear_parameters:
            chosen = shape.name in names if names else shape.default
            members += [(i, shape)] * chosen
    if not members or not {shape.name for _, shape in members} >= set(names):
        raise InputError(
            "the `model` has no friction with such `shapes`: use `StribeckFriction`."
        )
    return Shapes(base.model, tuple(members))


class ShapeSearch(eqx.Module):
    """Search for the shapes that explain the rows of some recordings best.

    It is a function of JAX: `eqx.filter_jit(search)(weights)`. Replace `forces` to map
    over draws or to differentiate by the measurements. Only friction is evaluated and
    filtered again.
    """

    shapes: Shapes  # shapes to be found
    start: Float[AnyArray, " shapes"]  # their values in the model
    recordings: tuple[Observations, ...]  # observations whose rows they are
    # columns that do not depend on shapes; zero in rows that do not count
    fixed: Float[AnyArray, "rows joints base"]
    forces: Float[
        AnyArray, "rows joints"
    ]  # measured forces of the rows [N m or N], likewise
    counted: Float[AnyArray, "rows joints"]  # one for rows that count, otherwise zero
    blocks: AnyArray  # block of time of each row
    # joint, base parameter, and column of the shaped terms, of what depends on shapes
    entries: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    @classmethod
    def of(cls, problem: RegressionProblem, shapes: Shapes) -> "ShapeSearch":
        """Evaluate and filter the columns that do not depend on the shapes."""
        require_float64("a search for shapes of friction")
        base, shaped = problem.base, shapes.columns_of_terms
        place = {k: shaped.index(i) for k, i in enumerate(base.indices) if i in shaped}
        starts = np.cumsum([0, *(o.rows for o in problem.recordings)])
        fixed = np.zeros((starts[-1], problem.robot.joints, base.size))
        forces, counted = np.zeros((2, *fixed.shape[:2]))
        blocks = np.zeros(len(fixed), int)
        for chunk in problem.chunks():
            rows = slice(
                *(starts[chunk.recording] + [chunk.rows.start, chunk.rows.stop])
            )
            for j, (own, columns) in enumerate(
                zip(chunk.indices, chunk.columns, strict=True)
            ):
                kept = [i for i, k in enumerate(own) if k not in place]
                fixed[rows, j, [own[i] for i in kept]] = columns[:, kept]
            counted[rows], blocks[rows] = chunk.mask, chunk.block
            forces[rows] = chunk.forces
        fixed *= counted[..., None]
        entries = [
            (j, k, place[k])
            for j, own in enumerate(base.acting_columns)
            for k in own
            if k in place
        ]
        known = shapes, shapes.values, problem.recordings
        return cls(*known, fixed, forces * counted, counted, blocks, tuple(entries))

    def __call__(
        self,
        weights: Float[AnyArray, " joints"],
        kept: Float[AnyArray, " blocks"] | None = None,
    ) -> tuple[Float[Array, " shapes"], Array]:
        """Search by Levenberg-Marquardt over logarithms; return shapes, and whether it converged.

        It begins at the model's shapes, and at the best of a few multiples of them, and
        keeps the better end: from one start, a Stribeck speed can stop at ten times its
        value. Where the rows hardly determine a shape, a weak pull keeps it near that
        of the model: as strong as one row that tells that it differs by a factor of
        ten.

        Args:
            weights: Weight of each joint [1/(N m) or 1/N].
            kept: One for each block of time that counts, zero for others; by default
                all count.
        """
        # Fits without nonlinear friction do not wait for it.
        import optimistix as optx

        start = jnp.asarray(self.start)
        rows = self.row_weights(weights, kept)
        count = jnp.sum(jnp.where(rows > 0, 1.0, 0.0)) - float(self.fixed.shape[-1])
        information = self.information(rows)
        solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-3)

        def weighted(u: Array) -> Array:
            return rows * self.fit(start * jnp.exp(u), rows, information)[1]

        def left(u: Array, scale: Array) -> Array:
            return jnp.append(weighted(u) / scale, u / np.log(10.0))

        def search(u: Array, _) -> tuple[Array, Array]:
            deviation = jnp.sqrt(jnp.sum(weighted(u) ** 2) / jnp.maximum(count, 1.0))
            scale = jnp.maximum(deviation, 1e-150)
            found = optx.least_squares(
                left, solver, u, args=scale, max_steps=STEPS, throw=False
            )
            return found.value, found.result == optx.RESULTS.successful

        def from_start(begin: Array) -> tuple[Array, Array, Array]:
            # Twice: the strength of the pull depends on the noise, which is known at
            # the end only.
            u, successes = jax.lax.scan(search, jnp.log(begin / start), length=2)
            return u, successes[-1], jnp.sum(weighted(u) ** 2)

        starts = jnp.stack([start, self._best_multiples(rows)])
        ends, successes, squares = jax.lax.map(from_start, starts)
        best = jnp.argmin(squares)
        return start * jnp.exp(ends[best]), successes[best]

    def _best_multiples(
        self, rows: Float[AnyArray, "rows joints"]
    ) -> Float[Array, " shapes"]:
        """Return for each joint the multiples of its shapes that explain its own rows best."""
        kinds = len(self.shapes.members)
        multiples = np.ones((3 ** min(kinds, 2), kinds, 1))
        multiples[:, :2, 0] = list(
            itertools.product((0.2, 1.0, 5.0), repeat=min(kinds, 2))
        )
        grid = jnp.reshape(self.start, (1, kinds, -1)) * multiples

        def squares(x: Array) -> Array:
            return jnp.sum((rows * self.fit(x.ravel(), rows)[1]) ** 2, axis=0)

        best = jnp.argmin(jax.lax.map(squares, grid), axis=0)
        return jnp.asarray(grid)[best, :, np.arange(grid.shape[-1])].T.ravel()

    def row_weights(self, weights: AnyArray, kept: AnyArray | None = None) -> Array:
        """Return the weight of each row [rows, joints]; zero for rows that do not count."""
        rows = jnp.asarray(self.counted) * jnp.asarray(weights)[None]
        return rows if kept is None else rows * jnp.asarray(kept)[self.blocks, None]

    def columns(self, x: Float[AnyArray, " shapes"]) -> Float[Array, "rows entries"]:
        """Return the rows of everything that depends on shapes."""
        joint, _, column = self._entries
        rows = _filtered_columns(
            jnp.asarray(x), self.shapes, self.recordings, joint, column
        )
        return rows * jnp.asarray(self.counted)[:, joint]

    @property
    def _entries(self) -> list[np.ndarray]:
        return [np.array(part) for part in zip(*self.entries, strict=True)]

    def information(
        self, rows: Float[AnyArray, "rows joints"]
    ) -> Float[Array, "base base"]:
        """Return the products of the fixed columns of rows with these weights."""
        weighted = (jnp.asarray(self.fixed) * rows[..., None]).reshape(
            -1, self.fixed.shape[-1]
        )
        return weighted.T @ weighted

    def fit(
        self,
        x: Float[AnyArray, " shapes"],
        rows: Float[AnyArray, "rows joints"],
        information: Float[Array, "base base"] | None = None,
    ) -> tuple[Float[Array, " base"], Float[Array, "rows joints"]]:
        """Return the best linear parameters, and what they leave of the forces [N m or N].

        Args:
            x: Shapes.
            rows: Weights of the rows to which the linear parameters are fitted.
            information: That of the fixed columns, if it is known.
        """
        own = self.columns(x)
        joint, place, _ = self._entries
        fixed, forces, squares = (
            jnp.asarray(self.fixed),
            jnp.asarray(self.forces),
            rows**2,
        )

        def predict(c: Array) -> Array:
            whole = jnp.zeros_like(forces).at[:, joint].add(own * c[place][None])
            return whole + fixed @ c

        def project(r: Array) -> Array:
            weighted = squares * r
            along = jnp.sum(own * weighted[:, joint], axis=0)
            return jnp.einsum("rjk,rj->k", fixed, weighted).at[place].add(along)

        information = self.information(rows) if information is None else information
        spread = (
            jnp.zeros((*rows.shape, len(place)))
            .at[:, joint, np.arange(len(place))]
            .set(own)
        )
        spread = (spread * squares[..., None]).reshape(-1, len(place))
        cross = spread.T @ fixed.reshape(-1, fixed.shape[-1])
        both = jnp.where(
            joint == joint[:, None], own.T @ (own * squares[:, joint]), 0.0
        )
        information = information.at[place].add(cross).at[:, place].add(cross.T)
        information = information.at[place[:, None], place].add(both)
        size = len(information)
        inverse, _ = inverse_information(
            jax.lax.stop_gradient(information), RIDGE * size
        )

        def refine(c: Array) -> Array:
            return c + inverse @ project(forces - predict(c))

        c = jax.lax.stop_gradient(refine(refine(jnp.zeros(size))))
        # A step of Newton with a constant matrix has the derivatives of the solution.
        c = refine(c)
        return c, forces - predict(c)


def _filter_columns(
    x: Array, shapes: Shapes, recordings: tuple[Observations, ...], joint, column
) -> Float[Array, "rows entries"]:
    """Return the filtered columns of the shaped terms, of these joints."""
    parts = []
    for o in recordings:
        motion = [jnp.asarray(x) for x in (o.motion.q, o.motion.qd, o.motion.qdd)]
        at_samples = jax.vmap(shapes.columns, (None, 0, 0, 0))(x, *motion)
        parts.append(o.reduce(at_samples[:, joint, column]))
    return jnp.concatenate(parts)


_filtered_columns = eqx.filter_custom_jvp(_filter_columns)


@_filtered_columns.def_jvp
def _(primals, tangents):
    """Differentiate by the shapes of all joints together: each acts on its own joint only."""
    x, shapes, recordings, joint, column = primals
    kinds = len(shapes.members)
    together = jnp.repeat(jnp.eye(kinds), shapes.size // kinds, axis=1)

    def along(direction: Array) -> tuple[Array, Array]:
        other = shapes, recordings, joint, column
        return jax.jvp(lambda x: _filter_columns(x, *other), (x,), (direction,))

    rows, slopes = jax.vmap(along, out_axes=(None, 0))(together)
    change = tangents[0].reshape(kinds, -1)[:, joint]
    return rows, jnp.einsum("ike,ie->ke", slopes, change)
