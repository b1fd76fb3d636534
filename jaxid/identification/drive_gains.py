"""Drive gains: true forces relative to nominal ones, from runs without and with a known load.

Currents times nominal torque constants are forces up to one factor for each joint.
Masses scale with these factors alike, so that no single run tells them; a known load
does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from scipy import optimize

from jaxid.arrays import AnyArray, Float, Int
from jaxid.errors import InputError
from jaxid.result_table import Summarised, Table
from jaxid.robot.robot import Robot, Tool

from .combination import as_least_squares, combine, require_same_base
from .estimators.regularisation_and_weights import NUMERICAL, Decomposition
from .factors import Factors
from .fit_result import Fit, interval_table
from .operating_states import state_maps, varying_parameters
from .payload import body_columns
from .uncertainty import Uncertainty
from .uncertainty.blocks import block_covariance

MAX_GAIN = 100.0
"""Ratio of a true to an assumed force beyond which something else is wrong."""
TOLERANCE = 1e-14
"""Of the search: as far as rounding allows, since logs may be noiseless."""


class DriveGains(Summarised, eqx.Module):
    """True forces relative to those of nominal gains, joint by joint.

    Attributes:
        gains: Factors by which the measured forces of each joint must be multiplied.
        uncertainty: Uncertainty of the gains.
        parameters: Base parameters of the unloaded robot, from true forces.
        joint_names: Names of the joints.
    """

    gains: Float[AnyArray, " joints"]
    uncertainty: Uncertainty
    parameters: Float[AnyArray, " base"]
    joint_names: tuple[str, ...] = eqx.field(static=True)

    def summary(self) -> Table:
        """Return a table of the gains with their 95 % intervals."""
        return interval_table(
            "true forces over those of the logs",
            self.joint_names,
            ("1",) * len(self.joint_names),
            self.gains,
            self.uncertainty,
        )


def identify_drive_gains(
    unloaded: Fit,
    loaded: Fit,
    load: Tool | float,
    *,
    varying: Sequence[str] | None = None,
) -> DriveGains:
    r"""Identify drive gains from a run without and a run with a known load.

    The measured forces of joint $j$ are $c_j \Theta_j p$ with the reciprocal gain
    $c_j$. Noise is in the measured forces, so least squares of *their* residuals are
    unbiased, and gains do not shrink as they would if forces stood among the columns.
    Parameters that several joints feel tie the gains to each other: joints that feel
    the load help those that hardly do.

    Args:
        unloaded: Fit of the run without the load; forces by nominal gains.
        loaded: Fit of the run with it, and with the same nominal gains.
        load: Load that was mounted between the runs. If only its mass [kg] on the
            end-effector is given, its centre and inertia are identified too.
        varying: Names of base parameters that may differ between the runs beside the
            load. If None, friction and offsets.

    Raises:
        InputError: If the runs have different base parameters, motors turn more than
            one axis, the robot has a known tool, or the load tells nothing about some
            gain.
    """
    require_same_base((unloaded, loaded))
    robot = unloaded.base.model.robot
    _require_gains(robot)
    runs = _runs(as_least_squares(unloaded), as_least_squares(loaded), load, varying)

    start_parameters, _ = combine(
        [run.fit for run in runs],
        [run.parameter_map for run in runs],
        [run.offset for run in runs],
    )
    start = np.append(start_parameters, np.ones(robot.joints))
    rows = _stack([run.rows(run.fit.time_blocks.total) for run in runs])
    solution = optimize.least_squares(
        rows.residuals,
        start,
        rows.jacobian,
        method="lm",
        x_scale="jac",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
    )
    unknowns = solution.x
    size = rows.columns.shape[1]
    reciprocals = unknowns[size:]
    decomposition = Decomposition.of(rows.jacobian(unknowns), -rows.residuals(unknowns))
    _require_determined(decomposition, reciprocals)

    blocks = []
    for run in runs:
        for part in run.fit.time_blocks.parts:
            block = run.rows(part)
            blocks.append((block.jacobian(unknowns), block.residuals(unknowns)))
    inverse = decomposition.inverse_information()
    covariance, dof = block_covariance(blocks, inverse)
    # The gain 1 / c changes by -1 / c² times a small change of c.
    squares = reciprocals**2
    of_gains = covariance[size:, size:] / squares / squares[:, None]
    return DriveGains(
        gains=1.0 / reciprocals,
        uncertainty=Uncertainty(of_gains, np.full(robot.joints, dof), of_gains),
        parameters=runs[0].parameter_map @ unknowns[:size],
        joint_names=robot.joint_names,
    )


def _require_gains(robot: Robot) -> None:
    """Check that each motor turns its own axis, and that no tool is subtracted."""
    reduction = np.asarray(robot.drives.reduction)
    if np.count_nonzero(reduction - np.diag(np.diag(reduction))):
        raise InputError(
            f"motors of `{robot.name}` turn more than one axis: they have no gains."
        )
    if robot.tool is not None:
        raise InputError(
            f"`{robot.name}` has a known tool: leave it out (`tool=None`)."
        )


def _require_determined(
    decomposition: Decomposition, reciprocals: Float[np.ndarray, " joints"]
) -> None:
    """Check that the runs determine all gains, and that these are plausible."""
    values = decomposition.values
    is_determined = values[-1] > NUMERICAL * values[0]
    is_plausible = (reciprocals > 1 / MAX_GAIN) & (reciprocals < MAX_GAIN)
    if not is_determined or not is_plausible.all():
        raise InputError(
            "the load does not tell all gains: take a heavier one, move every joint."
        )


class Rows(NamedTuple):
    """Weighted rows, whose forces are in nominal units.

    The unknowns are those of the base parameters, then the reciprocal gains.
    """

    columns: Float[np.ndarray, "rows unknowns"]
    offsets: Float[np.ndarray, " rows"]  # forces of a known load
    forces: Float[np.ndarray, " rows"]  # measured ones
    joints: Int[np.ndarray, " rows"]

    def predict(self, unknowns: np.ndarray) -> Float[np.ndarray, " rows"]:
        """Return the forces in true units."""
        return self.columns @ unknowns[: self.columns.shape[1]] + self.offsets

    def reciprocals(self, unknowns: np.ndarray) -> Float[np.ndarray, " rows"]:
        """Return the reciprocal gain of each row."""
        return unknowns[self.columns.shape[1] :][self.joints]

    def residuals(self, unknowns: np.ndarray) -> Float[np.ndarray, " rows"]:
        """Return predicted less measured forces."""
        return self.reciprocals(unknowns) * self.predict(unknowns) - self.forces

    def jacobian(self, unknowns: np.ndarray) -> Float[np.ndarray, "rows all_unknowns"]:
        """Return the derivatives of the residuals by the unknowns."""
        joints = len(unknowns) - self.columns.shape[1]
        by_parameters = self.reciprocals(unknowns)[:, None] * self.columns
        by_reciprocals = np.eye(joints)[self.joints] * self.predict(unknowns)[:, None]
        return np.hstack([by_parameters, by_reciprocals])


class Run(NamedTuple):
    """A run whose base parameters are a map of the unknowns plus an offset."""

    fit: Fit
    parameter_map: Float[np.ndarray, "base unknowns"]
    offset: Float[np.ndarray, " base"]

    def rows(self, factors: Factors) -> Rows:
        """Return the weighted rows of some factors of the run."""
        weights = np.asarray(self.fit.weights)
        columns = []
        forces = []
        for joint, weight in zip(factors.joints, weights, strict=True):
            R = weight * joint.R
            dense = np.zeros((len(R), factors.size))
            dense[:, list(joint.columns)] = R[:, :-1]
            columns.append(dense)
            forces.append(R[:, -1])
        heights = [len(x) for x in forces]
        matrix = np.vstack(columns)
        return Rows(
            columns=matrix @ self.parameter_map,
            offsets=matrix @ self.offset,
            forces=np.concatenate(forces),
            joints=np.repeat(np.arange(len(heights)), heights),
        )


def _runs(
    unloaded: Fit, loaded: Fit, load: Tool | float, varying: Sequence[str] | None
) -> list[Run]:
    """Return both runs as functions of the same unknowns."""
    base = unloaded.base
    maps = state_maps(base.size, varying_parameters(base, varying), 2)
    if isinstance(load, Tool):
        offset = body_columns(base, load.body) @ load.parameters
    else:
        # The other nine parameters of the load are unknowns, too.
        columns = body_columns(base, base.model.robot.tip_body)
        offset = load * columns[:, 0]
        others = columns[:, 1:]
        maps = [
            np.hstack([maps[0], np.zeros_like(others)]),
            np.hstack([maps[1], others]),
        ]
    return [
        Run(unloaded, maps[0], np.zeros(base.size)),
        Run(loaded, maps[1], offset),
    ]


def _stack(parts: Sequence[Rows]) -> Rows:
    """Return the rows of several parts together."""
    return Rows(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))
