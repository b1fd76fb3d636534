r"""Nonlinear friction by variable projection: shapes beside linear parameters.

For shapes $x$ the best linear parameters are $c = N^+ z$, where $N = [A \; \Phi(x)]$,
so the residual $r = z - N c$ is a function of the shapes alone (Golub and Pereyra,
1973). Everything is JAX: the search can be compiled, mapped over draws of the forces,
and differentiated.
"""

import itertools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import AnyArray, Array, Float, Int, Joints, require_float64
from jaxid.measurement.observations import Observations

from ..estimators.regularisation_and_weights import RIDGE, inverse_information
from ..factors import RowChunk
from ..problem import RegressionProblem
from .friction_shapes import Shapes, ShapeValues

JointRows = Float[AnyArray, "rows joints"]
"""A number for each joint in each row."""

MAX_STEPS = 60
"""Largest number of steps of a search."""
START_RATIOS = (0.2, 1.0, 5.0)
"""Multiples of the model's shapes at which a search may begin."""


class ColumnEntry(NamedTuple):
    """A column of the regressor that depends on shapes, in the rows of one joint."""

    joint: int
    parameter: int  # base parameter of the column
    column: int  # column among those of the terms with shapes


class ShapeSearch(eqx.Module):
    """Search for the shapes that explain the rows of some recordings best.

    It is a function of JAX: `eqx.filter_jit(search)(weights)`. Replace `forces` to map
    over draws or to differentiate by the measurements. Only friction is evaluated and
    filtered again.
    """

    shapes: Shapes
    start: ShapeValues  # shapes of the model
    recordings: tuple[Observations, ...]
    # columns that do not depend on shapes; zero in rows that do not count
    fixed_columns: Float[AnyArray, "rows joints base"]
    # measured forces [N m or N]; zero in rows that do not count
    forces: JointRows
    mask: JointRows  # one for rows that count, otherwise zero
    blocks: Int[AnyArray, " rows"]  # block of time of each row
    entries: tuple[ColumnEntry, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, problem: RegressionProblem, shapes: Shapes) -> "ShapeSearch":
        """Evaluate and filter the columns that do not depend on the shapes."""
        require_float64("a search for shapes of friction")
        base = problem.base
        standard_columns = shapes.standard_columns
        column_of_parameter = {
            parameter: standard_columns.index(standard_column)
            for parameter, standard_column in enumerate(base.indices)
            if standard_column in standard_columns
        }
        entries = [
            ColumnEntry(joint, parameter, column_of_parameter[parameter])
            for joint, parameters in enumerate(base.acting_columns)
            for parameter in parameters
            if parameter in column_of_parameter
        ]

        starts = np.cumsum([0, *(o.rows for o in problem.recordings)])
        shape = (starts[-1], problem.robot.joints)
        columns = np.zeros((*shape, base.size))
        forces = np.zeros(shape)
        mask = np.zeros(shape)
        blocks = np.zeros(len(forces), int)
        for chunk in problem.chunks():
            start = starts[chunk.recording]
            rows = slice(start + chunk.rows.start, start + chunk.rows.stop)
            forces[rows] = chunk.forces
            mask[rows] = chunk.mask
            blocks[rows] = chunk.block
            columns[rows] = _dense_columns(chunk, base.size)
        # Columns that depend on the shapes are evaluated anew for each shape.
        columns[..., list(column_of_parameter)] = 0.0
        return cls(
            shapes=shapes,
            start=shapes.values,
            recordings=problem.recordings,
            fixed_columns=columns * mask[..., None],
            forces=forces * mask,
            mask=mask,
            blocks=blocks,
            entries=tuple(entries),
        )

    def __call__(
        self,
        weights: Joints,
        block_mask: AnyArray | None = None,
    ) -> tuple[ShapeValues, Array]:
        """Search by Levenberg-Marquardt; return shapes, and whether it converged.

        It searches over logarithms, begins at the model's shapes and at the best of a
        few multiples of them, and keeps the better end: from one start, a Stribeck
        speed can stop at ten times its value. Where the rows hardly determine a shape,
        a weak pull keeps it near that of the model: as strong as one row that tells
        that it differs by a factor of ten.

        Args:
            weights: Weight of each joint [1/(N m) or 1/N].
            block_mask: One for each block of time that counts, zero for others; by
                default all count.
        """
        # Fits without nonlinear friction do not wait for optimistix.
        from jaxid.least_squares import minimise_squares

        start = jnp.asarray(self.start)
        rows = self.row_weights(weights, block_mask)
        row_count = jnp.sum(jnp.where(rows > 0, 1.0, 0.0))
        # Rows less linear parameters; shapes are few.
        dof = jnp.maximum(row_count - float(self.fixed_columns.shape[-1]), 1.0)

        def weighted_residuals(logarithms):
            shapes = start * jnp.exp(logarithms)
            _, residuals = self.fit(shapes, rows)
            return rows * residuals

        def pulled_residuals(logarithms, noise):
            residuals = weighted_residuals(logarithms) / noise
            return jnp.append(residuals, logarithms / np.log(10.0))

        def search(logarithms, _):
            squares = jnp.sum(weighted_residuals(logarithms) ** 2)
            noise = jnp.maximum(jnp.sqrt(squares / dof), 1e-150)
            minimum = minimise_squares(
                pulled_residuals, logarithms, args=noise, rtol=1e-6, max_steps=MAX_STEPS
            )
            return minimum.x, minimum.converged

        def search_twice(first_shapes):
            # The strength of the pull depends on the noise, which is known at the end
            # only.
            logarithms, successes = jax.lax.scan(
                search, jnp.log(first_shapes / start), length=2
            )
            squares = jnp.sum(weighted_residuals(logarithms) ** 2)
            return logarithms, successes[-1], squares

        starts = jnp.stack([start, self._best_multiples(rows)])
        logarithms, successes, squares = jax.lax.map(search_twice, starts)
        best_start = jnp.argmin(squares)
        return start * jnp.exp(logarithms[best_start]), successes[best_start]

    def _best_multiples(self, rows: JointRows) -> ShapeValues:
        """Return each joint's multiples of its shapes that best explain its rows."""
        kinds = len(self.shapes.kinds)
        # Combinations of the first two kinds only: there would be too many.
        repeat = min(kinds, 2)
        combinations = list(itertools.product(START_RATIOS, repeat=repeat))
        ratios = np.ones((len(combinations), kinds, 1))
        ratios[:, :repeat, 0] = combinations
        start = jnp.reshape(jnp.asarray(self.start), (1, kinds, -1))
        shapes = start * ratios

        def joint_squares(x):
            _, residuals = self.fit(x.ravel(), rows)
            return jnp.sum((rows * residuals) ** 2, axis=0)

        best_numbers = jnp.argmin(jax.lax.map(joint_squares, shapes), axis=0)
        joints = np.arange(shapes.shape[-1])
        return shapes[best_numbers, :, joints].T.ravel()

    def row_weights(
        self, weights: AnyArray, block_mask: AnyArray | None = None
    ) -> JointRows:
        """Return the weight of each row; zero for rows that do not count."""
        rows = jnp.asarray(self.mask) * jnp.asarray(weights)[None]
        if block_mask is None:
            return rows
        return rows * jnp.asarray(block_mask)[self.blocks, None]

    def columns(self, x: ShapeValues) -> Array:
        """Return the rows of everything that depends on shapes."""
        joint, _, column = np.array(self.entries).T
        rows = _filtered_columns(
            jnp.asarray(x), self.shapes, self.recordings, joint, column
        )
        return rows * jnp.asarray(self.mask)[:, joint]

    def fit(
        self,
        x: ShapeValues,
        rows: JointRows,
    ) -> tuple[Array, JointRows]:
        """Return the best linear parameters, and what remains of the forces [N m or N].

        Args:
            x: Shapes.
            rows: Weights of the rows to which the linear parameters are fitted.
        """
        columns = self.columns(x)
        joint, parameter, _ = np.array(self.entries).T
        fixed_columns = jnp.asarray(self.fixed_columns)
        forces = jnp.asarray(self.forces)

        def predict(c):
            shaped_part = columns * c[parameter][None]
            return (fixed_columns @ c).at[:, joint].add(shaped_part)

        def project(residuals):
            """Return the products of all columns with weighted residuals."""
            weighted_residuals = rows**2 * residuals
            shaped_part = jnp.sum(columns * weighted_residuals[:, joint], axis=0)
            fixed_part = jnp.einsum("rjk,rj->k", fixed_columns, weighted_residuals)
            return fixed_part.at[parameter].add(shaped_part)

        size = fixed_columns.shape[-1]
        all_columns = fixed_columns.at[:, joint, parameter].add(columns)
        weighted_columns = (all_columns * rows[..., None]).reshape(-1, size)
        # The matrix of Newton's steps needs no derivatives.
        weighted_columns = jax.lax.stop_gradient(weighted_columns)
        information = weighted_columns.T @ weighted_columns
        inverse, _ = inverse_information(information, RIDGE * size)

        def refine(c):
            return c + inverse @ project(forces - predict(c))

        c = jax.lax.stop_gradient(refine(refine(jnp.zeros(size))))
        # A step of Newton with a constant matrix has the derivatives of the solution.
        c = refine(c)
        return c, forces - predict(c)


def _dense_columns(chunk: RowChunk, size: int) -> np.ndarray:
    """Return columns of a chunk; zeros where parameters do not act on a joint."""
    columns = np.zeros((*chunk.forces.shape, size))
    for joint, parameters in enumerate(chunk.indices):
        columns[:, joint, list(parameters)] = chunk.columns[joint]
    return columns


def _filter_columns(
    x, shapes: Shapes, recordings: tuple[Observations, ...], joint, column
) -> Array:
    """Return filtered columns of the terms with shapes, in the rows of these joints."""
    parts = []
    for o in recordings:
        q, qd, qdd = (jnp.asarray(x) for x in (o.motion.q, o.motion.qd, o.motion.qdd))
        columns = jax.vmap(shapes.columns, (None, 0, 0, 0))(x, q, qd, qdd)
        parts.append(o.reduce(columns[:, joint, column]))
    return jnp.concatenate(parts)


_filtered_columns = eqx.filter_custom_jvp(_filter_columns)


@_filtered_columns.def_jvp
def _(primals, tangents):
    """Differentiate by all joints' shapes together: each acts on its own joint only."""
    x, shapes, recordings, joint, column = primals
    # One direction for each kind of shape instead of one for each joint and kind saves
    # a third of the time of a search on 60,000 samples of seven joints.
    kinds = len(shapes.kinds)
    directions = jnp.repeat(jnp.eye(kinds), shapes.size // kinds, axis=1)

    def differentiate(direction):
        def columns(x):
            return _filter_columns(x, shapes, recordings, joint, column)

        return jax.jvp(columns, (x,), (direction,))

    rows, slopes = jax.vmap(differentiate, out_axes=(None, 0))(directions)
    changes = tangents[0].reshape(kinds, -1)[:, joint]
    return rows, jnp.einsum("ike,ie->ke", slopes, changes)
