"""Gains of the drives, such as torque constants, from two runs with a known load between them.

Currents times nominal torque constants are forces up to one factor for each joint. Masses scale
with these factors alike, so that no single run tells them; a known load does.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from scipy import optimize

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.result_table import Summarised, Table
from jaxid.robot.robot import Tool

from .combination import as_least_squares, combine, require_same_base
from .estimators.regularisation_and_weights import NUMERICAL, Decomposition
from .factors import Factors
from .fit_result import Fit, interval_table
from .operating_states import state_maps, varying_parameters
from .payload import body_columns
from .uncertainty import Uncertainty
from .uncertainty.blocks import block_covariance

LARGEST = 100.0
"""Ratio of a true to an assumed force beyond which something else is wrong."""


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
        units, title = ("1",) * len(self.joint_names), "true forces over those of the logs"
        return interval_table(title, self.joint_names, units, self.gains, self.uncertainty)


def identify_drive_gains(
    unloaded: Fit, loaded: Fit, load: Tool | float, *, varying: Sequence[str] | None = None
) -> DriveGains:
    r"""Identify drive gains from a run without and a run with a known load.

    The measured forces of joint $j$ are $c_j \Theta_j p$ with the reciprocal gain $c_j$. Noise is
    in the measured forces, so least squares of *their* residuals are unbiased, and gains do not
    shrink as they would if forces stood among the columns. Parameters that several joints feel tie
    the gains to each other: joints that feel the load help those that hardly do.

    Args:
        unloaded: Fit of the run without the load; forces by nominal gains.
        loaded: Fit of the run with it, and with the same nominal gains.
        load: Load that was mounted between the runs. If only its mass [kg] on the end-effector is
            given, its centre and inertia are identified too.
        varying: Names of base parameters that may differ between the runs beside the load. If None,
            friction and offsets.

    Raises:
        InputError: If the runs have different base parameters, motors turn more than one axis, the
            robot has a known tool, or the load tells nothing about some gain.
    """
    require_same_base((unloaded, loaded))
    base = unloaded.base
    robot = base.model.robot
    A = np.asarray(robot.drives.reduction)
    if np.count_nonzero(A - np.diag(np.diag(A))):
        raise InputError(f"motors of `{robot.name}` turn more than one axis: they have no gains.")
    if robot.tool is not None:
        raise InputError(f"`{robot.name}` has a known tool: leave it out (`tool=None`).")
    fits = (as_least_squares(unloaded), as_least_squares(loaded))
    maps = state_maps(base.size, varying_parameters(base, varying), 2)
    if isinstance(load, Tool):
        added = body_columns(base, load.body) @ load.parameters
    else:
        columns = body_columns(base, robot.tip_body)
        added, rest = load * columns[:, 0], columns[:, 1:]
        maps = [np.hstack([E, known * rest]) for E, known in zip(maps, (0.0, 1.0), strict=True)]
    offsets = (np.zeros(base.size), added)
    runs = list(zip(fits, maps, offsets, strict=True))
    size = maps[0].shape[1]

    def linearise(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [_linearise(f.time_blocks.total, f.weights, E, k, u) for f, E, k in runs]
        return np.concatenate([r for r, _ in parts]), np.vstack([J for _, J in parts])

    start = np.append(combine(fits, maps, offsets)[0], np.ones(robot.joints))
    settings = {"method": "lm", "x_scale": "jac", "xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
    functions: list[Any] = [lambda u, k=k: linearise(u)[k] for k in range(2)]
    solution = optimize.least_squares(functions[0], start, functions[1], **settings)
    c = solution.x[size:]
    residuals, J = linearise(solution.x)
    decomposition = Decomposition.of(J, -residuals)
    B = decomposition.inverse_information()
    plausible = np.all((c > 1 / LARGEST) & (c < LARGEST))
    if decomposition.values[-1] <= NUMERICAL * decomposition.values[0] or not plausible:
        raise InputError("the load does not tell all gains: take a heavier one, move every joint.")
    blocks = []
    for fit, E, k in runs:
        for part in fit.time_blocks.parts:
            r, rows = _linearise(part, fit.weights, E, k, solution.x)
            blocks.append((rows, r))
    covariance, dof = block_covariance(blocks, B)
    covariance = covariance[size:, size:] / c**2 / c[:, None] ** 2
    uncertainty = Uncertainty(covariance, np.full(robot.joints, dof), covariance)
    return DriveGains(1.0 / c, uncertainty, maps[0] @ solution.x[:size], robot.joint_names)


def _linearise(factors: Factors, weights, E, offset, unknowns) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted predicted less measured forces, in nominal units, and their derivatives.

    The unknowns are those of the base parameters, then the reciprocal gains.
    """
    size = E.shape[1]
    p, c = E @ unknowns[:size] + offset, unknowns[size:]
    residuals, derivatives = [], []
    for j, (joint, w) in enumerate(zip(factors.joints, np.asarray(weights), strict=True)):
        own, R = list(joint.columns), w * joint.R
        forces = R[:, :-1] @ p[own]
        J = np.zeros((len(R), len(unknowns)))
        J[:, :size] = c[j] * (R[:, :-1] @ E[own])
        J[:, size + j] = forces
        residuals.append(c[j] * forces - R[:, -1])
        derivatives.append(J)
    return np.concatenate(residuals), np.vstack(derivatives)
