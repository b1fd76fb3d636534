"""Base parameters: combinations of parameters that forces determine (Eqs. 20-24)."""

import enum
import functools
import re
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    Float,
    Hashable,
    JointMatrix,
    Joints,
    ManyJoints,
    Matrix,
    Numbers,
    Texts,
    as_array,
)
from jaxid.errors import InputError
from jaxid.program import Program, Shape, select_outputs
from jaxid.program.sample_methods import in_numpy, on_samples, program_of
from jaxid.result_table import MISSING, Column, Remark, Status, Summarised, Table

from .base_parameter_expressions import Summand, write_expression
from .model import Coordinates, Model
from .motion import Motion, as_motion
from .packed_regressor import Columns, JointRegressor, PackedRegressor
from .rank import (
    Dependence,
    Regrouped,
    gram_schmidt,
    random_regressor,
    rank_by_singular_values,
    regrouping,
)

Parameters = Float[AnyArray, " base"] | Sequence[float | int]


MIN_SHARE = 5e-4
"""Fraction of an independent column that must be new."""
MIN_GAP = 1e3
"""Ratio of the new parts of independent and of dependent columns."""
MAX_UNEXPLAINED = 1e-9
"""Fraction of a dependent column that the independent ones may leave unexplained."""


class Identifiability(enum.Enum):
    """Identifiability of one standard parameter from measured forces."""

    ALONE = "identifiable"
    COMBINED = "only in combination"
    NONE = "not identifiable"


class BaseParameters(Summarised, Hashable):
    r"""A model with base parameters: $\hat\Theta_1 (p_1 + \kappa p_2) = Q_m$ (Eq. 22).

    Attributes:
        model: The model with all its standard parameters.
        indices: Columns of the independent standard parameters, in order (the paper's
            numbering).
        dependent: Columns of the other standard parameters, in order.
        kappa: Matrix by which the dependent columns follow from the independent ones.
        smallest_independent: Fraction of the least independent column that earlier
            columns do not explain, from 0 to 1.
        largest_dependent: Fraction of the most doubtful dependent column that they do
            not explain.
        notes: Doubts about the rank, in sentences; empty if there are none.
    """

    model: Model
    indices: Columns = eqx.field(static=True)
    dependent: Columns = eqx.field(static=True)
    kappa: Float[AnyArray, "base dependent"]
    smallest_independent: float
    largest_dependent: float
    notes: Texts = eqx.field(static=True)

    @property
    def size(self) -> int:
        """Number of base parameters."""
        return len(self.indices)

    @property
    def names(self) -> Texts:
        """Names of the standard parameters that lead the base parameters."""
        names = self.model.parameter_names
        return tuple(names[k] for k in self.indices)

    @property
    def units(self) -> Texts:
        """Units of the base parameters."""
        units = self.model.parameter_units
        return tuple(units[k] for k in self.indices)

    @property
    def kinds(self) -> Texts:
        """Terms of the leading parameters in words, like `viscous friction`."""
        kinds = []
        for term in self.model.terms:
            words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", type(term).__name__).lower()
            kinds += [words] * len(term.parameters(self.model.robot))
        return tuple(kinds[k] for k in self.indices)

    @functools.cached_property
    def expressions(self) -> Texts:
        """Base parameters as readable combinations, `mx2 + 0.05*m3 - mz4` (Eq. 24)."""
        names = self.model.parameter_names
        expressions = []
        for leader, row in zip(self.indices, np.asarray(self.kappa), strict=True):
            factors = dict(zip(self.dependent, row.tolist(), strict=True))
            factors[leader] = 1.0
            summands = []
            for k in sorted(factors):
                if factors[k] != 0.0:
                    summands.append(Summand(names[k], factors[k]))
            expressions.append(write_expression(summands))
        return tuple(expressions)

    def columns(self, q, qd, qdd, s=None) -> AnyArray:
        """Return the base regressor of one sample by definition (Eq. 23)."""
        return self.model.columns(q, qd, qdd, s)[:, np.array(self.indices)]

    def forces(self, p, q, qd, qdd, s=None) -> Joints:
        """Return the generalised forces of one sample by definition (Eq. 39)."""
        return self.model.forces(self.to_standard(p), q, qd, qdd, s)

    def inertia(self, p, q) -> JointMatrix:
        """Return the mass matrix of one sample by definition (Eq. 38)."""
        return self.model.inertia(self.to_standard(p), q)

    def derived_program(self, name: str, *shapes: Shape) -> Program | None:
        """Return the program of the method `columns`; None for any other method.

        The base regressor is some columns of the full one: the model's program, which
        is traced once, is used again without the outputs of the other columns.
        """
        if name != "columns":
            return None
        program = program_of(self.model, self.model.columns, *shapes)
        joints, columns = program.output_shapes[0]
        entries = np.arange(joints * columns).reshape(joints, columns)
        base_entries = entries[:, np.array(self.indices, int)]
        return select_outputs(program, base_entries)

    @property
    def joint_regressor(self) -> JointRegressor:
        """Base regressor of many samples, joint by joint, for JAX (Eq. 23)."""
        return JointRegressor(self, self.columns, *self.model.input_shapes)

    @property
    def acting_columns(self) -> tuple[Columns, ...]:
        """For each joint the base parameters that can act on it."""
        return self.joint_regressor.columns

    def regressor_rows(self, motion: Motion) -> list[np.ndarray]:
        """Return each joint's rows of the base regressor in NumPy (Eq. 23).

        Args:
            motion: Joint motion [samples, joints].
        """
        arguments = self.model.arguments(motion)
        arrays = [np.asarray(x, np.float64).T for x in arguments]
        shapes = [x.shape[:1] for x in arrays]
        regressor = JointRegressor(self, self.columns, *shapes)
        return [np.asarray(rows).T for rows in regressor.evaluate(*arrays)]

    def forces_in_numpy(self, p: AnyArray, motion: Motion) -> Matrix:
        r"""Return the forces $\Theta_B p_B$ [N m or N] in float64 (Eq. 39)."""
        return in_numpy(self, self.forces, *self.model.arguments(motion), shared=(p,))

    def tool_forces(self, motion: Motion) -> Matrix:
        """Return the forces of the known tool [N m or N] in float64."""
        model = self.model
        if model.robot.tool is None:
            return np.zeros(motion.q.shape)
        return in_numpy(model, model.known_forces, *model.arguments(motion))

    def regressor(self, motion: Motion) -> AnyArray:
        r"""Return the base regressor $\Theta_B$ [*batch, joints, base] (Eq. 23)."""
        return on_samples(self, self.columns, *self.model.arguments(motion))

    def packed_regressor(self, motion: Motion) -> PackedRegressor:
        r"""Return the stacked base regressor without its zeros (Eqs. 23, 26).

        Raises:
            InputError: If the motion does not have one axis of samples, or JAX is
                tracing the robot's geometry.
        """
        return PackedRegressor(self, self.columns, *self.model.arguments(motion))

    def from_standard(self, p: AnyArray | Sequence[Any]) -> AnyArray:
        r"""Return the base parameters $p_B = p_1 + \kappa p_2$ (Eq. 22)."""
        p = _as_parameters("standard", p, self.model.size)
        leaders = np.array(self.indices)
        dependent_columns = np.array(self.dependent, int)
        return p[..., leaders] + p[..., dependent_columns] @ self.kappa.T

    def to_standard(self, p: AnyArray | Sequence[Any]) -> AnyArray:
        """Return standard parameters with the same forces.

        The dependent ones are zero. They are no physical masses and inertias, but give
        the same forces and mass matrix.
        """
        p = _as_parameters("base", p, self.size)
        shape = (*p.shape[:-1], self.model.size)
        places = np.array(self.indices)
        if isinstance(p, np.ndarray):
            standard_parameters = np.zeros(shape)
            standard_parameters[..., places] = p
            return standard_parameters
        return jnp.zeros(shape, p.dtype).at[..., places].set(p)

    def inverse_dynamics(
        self, p: Parameters, *motion: Motion | Coordinates
    ) -> ManyJoints:
        r"""Return the generalised forces $\Theta_B p_B$ [N m or N] (Eq. 39).

        Args:
            p: Base parameters.
            motion: A motion, or joint coordinates, velocities and accelerations.
        """
        arguments = self.model.arguments(as_motion(*motion))
        return on_samples(self, self.forces, *arguments, shared=(p,))

    def mass_matrix(self, p: Parameters, q: Coordinates) -> AnyArray:
        """Return the mass matrix, which base parameters determine (Eq. 38)."""
        return on_samples(self, self.inertia, self.model.closed(q), shared=(p,))

    @property
    def identifiability(self) -> tuple[Identifiability, ...]:
        """Identifiability of every standard parameter."""
        identifiability = [Identifiability.NONE] * self.model.size
        combines = np.asarray(self.kappa) != 0.0
        for row, k in enumerate(self.indices):
            is_combined = combines[row].any()
            identifiability[k] = (
                Identifiability.COMBINED if is_combined else Identifiability.ALONE
            )
        for column, k in enumerate(self.dependent):
            if combines[:, column].any():
                identifiability[k] = Identifiability.COMBINED
        return tuple(identifiability)

    def summary(self) -> Table:
        """Return a table of the base parameters, with their combinations and units."""
        names = self.model.parameter_names
        facts = []
        for kind in Identifiability:
            verdicts = zip(names, self.identifiability, strict=True)
            members = [name for name, verdict in verdicts if verdict is kind]
            facts.append(
                (f"{kind.value} ({len(members)})", ", ".join(members) or MISSING)
            )
        count = f"{self.size} base parameters of {self.model.size} standard parameters"
        return Table(
            f"{self.model.robot.name}: {count}",
            Column("parameter", self.names),
            Column("combination", self.expressions, kind="code"),
            Column("unit", self.units),
            facts=facts,
            remarks=[Remark(note, Status.DOUBTFUL) for note in self.notes],
        )


def _as_parameters(kind: str, p: Numbers, size: int):
    """Return parameters as an array with this number of them along its last axis."""
    # What is no array of JAX stays in NumPy, and in float64 where JAX runs in float32.
    p = as_array("p", p)
    if p.shape[-1:] != (size,):
        raise InputError(
            f"`p` must have {size} {kind} parameters "
            f"along its last axis, but has shape {p.shape}."
        )
    return p


def base_parameters(model: Model, *, seed: int = 0) -> BaseParameters:
    r"""Find the combinations of parameters that forces determine (Eqs. 20-22).

    The regressor is evaluated at random motions and stacked. Columns that earlier ones
    replace are found by Gram-Schmidt in column order, and counted again by singular
    values. Rounded quarter turns count as exact here (`Robot.snapped`); in forces the
    robot keeps its own geometry.

    Args:
        model: The model.
        seed: Seed of the random motions.

    Returns:
        The base parameters; a disagreement or a small gap is reported in their `notes`.
    """
    # Random motions excite whatever any motion can excite.
    W, scale = random_regressor(_snapped(model), seed)
    dependence = gram_schmidt(W)
    rank = rank_by_singular_values(W)

    leaders = np.array(dependence.independent, int)
    dependent_columns = np.array(dependence.dependent, int)
    regrouped_columns = regrouping(W, leaders, dependent_columns)
    # Back from columns that are free of units to those of the model.
    kappa = regrouped_columns.kappa * scale[leaders][:, None] / scale[dependent_columns]
    return BaseParameters(
        model,
        dependence.independent,
        dependence.dependent,
        kappa,
        dependence.smallest_independent,
        dependence.largest_dependent,
        tuple(_doubts(model, dependence, rank, regrouped_columns)),
    )


def _snapped(model: Model):
    """Return the model of a robot whose rounded quarter turns are exact."""
    return Model(model.robot.snapped(), model.terms)


def _doubts(
    model: Model, dependence: Dependence, rank: int, regrouped_columns: Regrouped
) -> Iterator[str]:
    """Yield doubts about the choice of base parameters, in sentences."""
    count = len(dependence.independent)
    if count != rank:
        yield (
            "the two ways to choose base parameters disagree "
            f"({count} and {rank}): "
            "the geometry is nearly degenerate, or angles are rounded."
        )
    if dependence.smallest_independent < MIN_SHARE:
        column = dependence.independent[int(np.argmin(regrouped_columns.shares))]
        reason = (
            "due to a length near zero or an angle like 1.571 instead of pi/2, which "
            "`robot.snapped(1e-3)` (`snap_tolerance`) makes exact."
        )
        if model.robot.loops:
            reason = (
                "as the closed loops let the joints move only a little; expect a wide "
                "interval for it, which does no harm to torques."
            )
        yield (
            f"`{model.parameter_names[column]}` is barely a base parameter: only "
            f"{dependence.smallest_independent:.1e} of its column is independent, "
            f"{reason}"
        )
    if dependence.dependent and dependence.gap < MIN_GAP:
        yield (
            "independent and dependent columns are not clearly separated: their "
            "independent parts are "
            f" {dependence.smallest_independent:.1e} and "
            f"{dependence.largest_dependent:.1e}."
        )
    if regrouped_columns.max_residual > MAX_UNEXPLAINED:
        yield (
            "the combination of columns that replaces a dependent one has a relative "
            f"error of {regrouped_columns.max_residual:.1e}."
        )
