"""Drive gains from runs without and with a known load: true over nominal forces.

Currents times nominal torque constants are forces up to one factor for each joint.
Masses scale with these factors alike, so that no single run tells them; a known load
does.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, Float, Joints, Matrix, Texts, Vector
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.result_table import Remark, Status, Summarised, Table, percent
from jaxid.robot.inertia import Tool
from jaxid.robot.robot import Robot

from .combination import as_least_squares, combine, require_same_base
from .estimators.regularisation_and_weights import Decomposition
from .factors import Factors
from .fit_result import Fit, interval_table
from .operating_states import state_maps, varying_parameters
from .payload import MAX_RESIDUAL_RATIO, body_columns
from .uncertainty import Uncertainty
from .uncertainty.blocks import block_covariance

MAX_GAIN = 100.0
"""Ratio of a true to an assumed force beyond which something else is wrong."""
MAX_DEVIATION = 0.25
"""Relative standard deviation of a gain beyond which the logs do not determine it."""
MAX_MISFIT_RATIO = 1.1
"""Residual of a known load, relative to that of any load, that chance explains."""
MIN_MISFIT = 1e-3
"""Share of the forces below which a load fits in any case."""
TOLERANCE = 1e-14
"""Of the search: as far as rounding allows, since logs may be noiseless."""


class DriveGains(Summarised, eqx.Module):
    """True forces relative to those of nominal gains, joint by joint.

    Attributes:
        gains: Factors by which the measured forces of each joint must be multiplied: 1
            where the logs do not tell it.
        uncertainty: Uncertainty of the gains: infinite where the logs do not tell it.
        parameters: Base parameters of the unloaded robot, from true forces.
        misfits: Share of the forces that the load leaves unexplained, and share that
            the best load of its mass on its body does.
        joint_names: Names of the joints.
    """

    gains: Joints
    uncertainty: Uncertainty
    parameters: Float[AnyArray, " base"]
    misfits: tuple[float, float]
    joint_names: Texts = eqx.field(static=True)

    @property
    def remarks(self) -> list[Remark]:
        """Doubts about the load, and joints whose gains it does not tell."""
        remarks = []
        misfit, min_misfit = self.misfits
        if misfit > max(MIN_MISFIT, MAX_MISFIT_RATIO * min_misfit):
            is_wrong = misfit > MAX_RESIDUAL_RATIO * min_misfit
            text = (
                f"The load does not fit: it leaves {percent(misfit)} % of the forces "
                f"unexplained, another load of the same mass only "
                f"{percent(min_misfit)} %. Give its centre of mass in the frame of the "
                "body that carries it"
            )
            remarks.append(Remark(text, Status.BAD if is_wrong else Status.DOUBTFUL))
        variances = np.diag(self.uncertainty.covariance)
        names = [
            f"`{name}`"
            for name, variance in zip(self.joint_names, variances, strict=True)
            if np.isinf(variance)
        ]
        if names:
            text = (
                f"These logs do not determine the gain of {', '.join(names)}, which "
                "stays 1: use a heavier load, or move faster and in more poses"
            )
            remarks.append(Remark(text, Status.DOUBTFUL))
        return remarks

    def summary(self) -> Table:
        """Return a table of the gains with their 95 % intervals."""
        return interval_table(
            "gains: true force over the force in the log",
            self.joint_names,
            ("",) * len(self.joint_names),
            self.gains,
            self.uncertainty,
            self.remarks,
        )


def identify_drive_gains(
    unloaded: Fit,
    loaded: Fit,
    load: Tool | float,
) -> DriveGains:
    r"""Identify drive gains from a run without and a run with a known load.

    The measured forces of joint $j$ are $c_j \Theta_j p$ with the reciprocal gain
    $c_j$. Noise is in the measured forces, so least squares of *their* residuals are
    unbiased, and gains do not shrink as they would if forces stood among the columns.
    Parameters that several joints feel tie the gains to each other: joints that feel
    the load help those that hardly do. Friction and offsets may differ between the
    runs.

    Args:
        unloaded: Fit of the run without the load; forces by nominal gains.
        loaded: Fit of the run with it, and with the same nominal gains.
        load: Load that was mounted between the runs. If only its mass [kg] on the
            end-effector is given, its centre and inertia are identified too.

    Raises:
        InputError: If the runs have different base parameters, motors turn more than
            one axis, the robot has a known tool, or the load tells nothing about any
            gain.
    """
    require_same_base((unloaded, loaded))
    robot = unloaded.base.model.robot
    _require_gains(robot)
    fits = (as_least_squares(unloaded), as_least_squares(loaded))
    maps, offsets = _parameter_maps(unloaded.base, load)
    rows, unknowns = _solve(fits, maps, offsets)
    misfit = min_misfit = _misfit(rows, unknowns)
    if isinstance(load, Tool):
        maps_of_mass = _maps_of_mass(unloaded.base, load.body, load.mass)
        min_misfit = _misfit(*_solve(fits, *maps_of_mass))

    # The base parameters come first, then the reciprocal gains.
    size = len(unknowns) - robot.joints
    reciprocals = unknowns[size:]
    residuals, jacobian = rows.linearise(unknowns)
    decomposition = Decomposition.of(jacobian, -residuals)
    linearised_parts = []
    for fit, parameter_map, offset in zip(fits, maps, offsets, strict=True):
        for factors in fit.time_blocks.parts:
            part = _rows(factors, fit.weights, parameter_map, offset)
            part_residuals, part_jacobian = part.linearise(unknowns)
            linearised_parts.append((part_jacobian, part_residuals))
    covariance, dof = block_covariance(
        linearised_parts, decomposition.inverse_information()
    )
    relative_deviations = np.sqrt(np.diag(covariance)[size:]) / np.abs(reciprocals)
    is_determined = ~decomposition.unknown[size:] & _are_plausible(reciprocals)
    is_determined &= relative_deviations < MAX_DEVIATION
    if not is_determined.any():
        raise InputError(
            "the load determines no gain: describe its centre of mass and inertia as "
            "well, use a heavier load, or move every joint faster."
        )
    # The gain 1 / c changes by -1 / c² times a small change of c.
    slopes = np.where(is_determined, -1.0 / reciprocals**2, 0.0)
    covariance = slopes[:, None] * covariance[size:, size:] * slopes
    covariance[~is_determined, ~is_determined] = np.inf
    return DriveGains(
        gains=np.where(is_determined, 1.0 / reciprocals, 1.0),
        uncertainty=Uncertainty(covariance, np.full(robot.joints, dof), covariance),
        parameters=maps[0] @ unknowns[:size],
        misfits=(misfit, min_misfit),
        joint_names=robot.joint_names,
    )


def _solve(fits, maps, offsets) -> tuple["Rows", np.ndarray]:
    """Return the rows of both runs, and their base parameters and reciprocal gains."""
    # With nominal gains the problem is linear, and a good start.
    start_parameters, _ = combine(fits, maps, offsets)
    totals = []
    for fit, parameter_map, offset in zip(fits, maps, offsets, strict=True):
        total = fit.time_blocks.total
        totals.append(_rows(total, fit.weights, parameter_map, offset))
    rows = _stack(totals)
    solution = scipy.optimize.least_squares(
        lambda u: rows.linearise(u)[0],
        np.append(start_parameters, np.ones(rows.joints.shape[1])),
        lambda u: rows.linearise(u)[1],  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
    )
    return rows, solution.x


def _misfit(rows: "Rows", unknowns: Vector) -> float:
    """Return the share of the forces that stays unexplained (norms)."""
    residuals, _ = rows.linearise(unknowns)
    return float(np.linalg.norm(residuals) / np.linalg.norm(rows.measured_forces))


def _require_gains(robot: Robot) -> None:
    """Check that each motor turns its own axis, and that no tool is subtracted."""
    reduction = robot.drives.reduction
    if np.count_nonzero(reduction - np.diag(np.diag(reduction))):
        raise InputError(
            f"motors of `{robot.name}` turn more than one axis: they have no gains."
        )
    if robot.tool is not None:
        raise InputError(
            f"`{robot.name}` has a known tool: leave it out (`tool=None`)."
        )


def _are_plausible(reciprocals: Vector) -> np.ndarray:
    """Return which gains are positive, and neither tiny nor huge."""
    return (reciprocals > 1 / MAX_GAIN) & (reciprocals < MAX_GAIN)


class Rows(NamedTuple):
    """Weighted rows, whose measured forces are in nominal units.

    The unknowns are those of the base parameters, then the reciprocal gains.
    """

    columns: np.ndarray  # [rows, unknowns]
    known_forces: np.ndarray  # forces of a known load
    measured_forces: np.ndarray
    joints: np.ndarray  # one for the joint of each row, otherwise zero [rows, joints]

    def linearise(self, unknowns: Vector) -> tuple[Vector, Matrix]:
        """Return predicted less measured forces, and their derivatives by unknowns."""
        size = self.columns.shape[1]
        reciprocals = self.joints @ unknowns[size:]
        forces = self.columns @ unknowns[:size] + self.known_forces
        by_parameters = reciprocals[:, None] * self.columns
        by_reciprocals = forces[:, None] * self.joints
        residuals = reciprocals * forces - self.measured_forces
        return residuals, np.hstack([by_parameters, by_reciprocals])


def _rows(factors: Factors, weights, parameter_map, offset) -> Rows:
    """Return factors' rows; base parameters are the map times unknowns plus offset."""
    parts = []
    for number, joint in enumerate(factors.joints):
        R = weights[number] * joint.R
        columns = R[:, :-1]
        parameters = list(joint.columns)
        joint_columns = np.zeros((len(R), len(factors.joints)))
        joint_columns[:, number] = 1.0
        parts.append(
            Rows(
                columns=columns @ parameter_map[parameters],
                known_forces=columns @ offset[parameters],
                measured_forces=R[:, -1],
                joints=joint_columns,
            )
        )
    return _stack(parts)


def _stack(parts: Sequence[Rows]) -> Rows:
    """Return the rows of several parts together."""
    return Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _parameter_maps(base: BaseParameters, load: Tool | float):
    """Return maps and offsets from common unknowns to both runs' base parameters."""
    if not isinstance(load, Tool):
        return _maps_of_mass(base, base.model.robot.tip_body, load)
    maps = state_maps(base.size, varying_parameters(base), 2)
    load_parameters = body_columns(base, load.body) @ load.parameters
    return maps, [np.zeros(base.size), load_parameters]


def _maps_of_mass(base: BaseParameters, body: int, mass: AnyArray | float):
    """Return maps and offsets for a load of which only the mass is known."""
    maps = state_maps(base.size, varying_parameters(base), 2)
    columns = body_columns(base, body)
    mass_column = columns[:, 0]
    # The other nine parameters of the load are unknowns, too.
    other_columns = columns[:, 1:]
    unloaded_map = np.hstack([maps[0], 0.0 * other_columns])
    loaded_map = np.hstack([maps[1], other_columns])
    return [unloaded_map, loaded_map], [np.zeros(base.size), mass * mass_column]
