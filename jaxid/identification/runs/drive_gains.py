"""Gains of the drives, such as torque constants, from two runs with a known load between them.

Currents times nominal torque constants are forces up to one factor for each joint. Masses scale
with these factors alike, so that no single run tells them; a load that is known does.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from scipy import optimize

from jaxid.arrays import AnyArray, Float
from jaxid.errors import InputError
from jaxid.identification.estimators import Complete
from jaxid.identification.estimators.solutions import NUMERICAL, Decomposition
from jaxid.identification.factors import Factors
from jaxid.identification.fit import Fit
from jaxid.identification.runs.estimates import Estimates
from jaxid.identification.runs.least_squares import least_squares_of, require_same_base
from jaxid.identification.runs.payload import body_columns
from jaxid.identification.runs.states import own_parameters, state_maps
from jaxid.identification.runs.tied import tied
from jaxid.identification.uncertainty.blocks import Block, block_covariance
from jaxid.measurement.recording import Recording
from jaxid.robot.robot import Tool
from jaxid.table import Table

LARGEST = 100.0
"""Ratio of a true to an assumed force beyond which something else is wrong."""


class DriveGains(eqx.Module):
    """True forces relative to those that nominal gains give, joint by joint.

    Attributes:
        gains: Factors by which the measured forces of each joint must be multiplied, of 1.
        covariance: Covariance of the gains.
        freedom: Degrees of freedom of their standard deviations.
        parameters: Base parameters of the unloaded robot, from true forces.
        joint_names: Names of the joints.
    """

    gains: Float[AnyArray, " joints"]
    covariance: Float[AnyArray, "joints joints"]
    freedom: float
    parameters: Float[AnyArray, " base"]
    joint_names: tuple[str, ...] = eqx.field(static=True)

    @property
    def estimates(self) -> Estimates:
        """The gains with their uncertainty."""
        n = len(self.joint_names)
        return Estimates(
            label="drives",
            names=self.joint_names,
            expressions=self.joint_names,
            units=("1",) * n,
            groups=("drive gain",) * n,
            parameters=self.gains,
            covariance=self.covariance,
            freedom=np.full(n, self.freedom),
        )

    def summary(self) -> Table:
        """Return a table of the gains with their 95 % intervals."""
        return self.estimates.summary("true forces over those of the logs")

    def __str__(self) -> str:
        return str(self.summary())

    def corrected(self, recording: Recording) -> Recording:
        """A recording with true forces in place of those of nominal gains.

        Args:
            recording: Recording of the same drives, with the same nominal gains.

        Raises:
            InputError: If it has another number of joints.
        """
        if recording.joints != len(self.joint_names):
            raise InputError(
                f"`{recording.name}` has {recording.joints} joints, but there are gains for "
                f"{len(self.joint_names)}."
            )
        forces = np.asarray(recording.forces) * np.asarray(self.gains)
        return dataclasses.replace(recording, forces=forces)


def identify_drive_gains(
    unloaded: Fit, loaded: Fit, load: Tool, *, varying: Sequence[str] | None = None
) -> DriveGains:
    r"""Identifies drive gains from a run without and a run with a load that is known.

    The measured forces of joint $j$ are $c_j \Theta_j p$ with the reciprocal gain $c_j$. Noise is
    in the measured forces, so least squares of *their* residuals are unbiased, and gains do not
    shrink as they would if forces stood among the columns. Parameters that several joints feel tie
    the joints' gains to each other: those that feel the load help those that hardly do.

    Args:
        unloaded: Without the load; forces by nominal gains.
        loaded: With it, and with the same nominal gains.
        load: What was mounted between the runs.
        varying: Names of base parameters that may differ between the runs beside the load. If None,
            friction and offsets.

    Raises:
        InputError: If the runs have different base parameters, motors turn more than one axis, the
            robot has a known tool, or the load tells nothing about some gain.
    """
    runs = (unloaded, loaded)
    require_same_base(runs)
    runs = tuple(map(least_squares_of, runs))
    base = unloaded.base
    robot = base.model.robot
    A = np.asarray(robot.drives.reduction)
    if np.count_nonzero(A - np.diag(np.diag(A))):
        raise InputError(
            f"motors of `{robot.name}` turn more than one axis, so that joints have no gains of "
            "their own: gains can be identified for independent drives only."
        )
    if robot.tool is not None:
        raise InputError(
            f"`{robot.name}` has a known tool, whose forces were subtracted from those of nominal "
            "gains: leave it out of the robot (`tool=None`), for its mass is found with the others."
        )
    own = own_parameters(base, varying, None)
    maps = state_maps(base.size, own, 2)
    added = body_columns(base, load.body) @ load.parameters
    known = (np.zeros(base.size), added)
    terms = [
        _Rows(run.time_blocks.total, np.asarray(run.weights), E, c)
        for run, E, c in zip(runs, maps, known, strict=True)
    ]
    n, size = robot.joints, maps[0].shape[1]
    start = np.append(np.asarray(tied(runs, maps, known).parameters), np.ones(n))
    found = optimize.least_squares(
        lambda u: np.concatenate([rows.residuals(u) for rows in terms]),
        start,
        lambda u: np.vstack([rows.derivatives(u) for rows in terms]),  # pyright: ignore[reportArgumentType]
        method="lm",
        x_scale="jac",
        xtol=1e-14,
        ftol=1e-14,
        gtol=1e-14,
    )
    c = found.x[size:]
    J = np.vstack([rows.derivatives(found.x) for rows in terms])
    decomposition = Decomposition.of(J, -found.fun)
    B = decomposition.inverse_information(Complete().inverse(decomposition.values))
    poor = np.flatnonzero(~((c > 1 / LARGEST) & (c < LARGEST)))
    if decomposition.values[-1] <= NUMERICAL * decomposition.values[0] or len(poor):
        raise InputError(
            "the load does not tell all gains: mount a heavier one, farther from the flange, and "
            "let every joint move it in both runs."
        )
    blocks: list[Block] = []
    for run, E, k in zip(runs, maps, known, strict=True):
        for part in run.time_blocks.parts:
            rows = _Rows(part, np.asarray(run.weights), E, k)
            blocks.append((rows.derivatives(found.x), -rows.residuals(found.x)))
    covariance, freedom = block_covariance(blocks, B)
    own_part = covariance[size:, size:] / c**2 / c[:, None] ** 2
    parameters = maps[0] @ found.x[:size]
    return DriveGains(1.0 / c, own_part, freedom, parameters, robot.joint_names)


class _Rows:
    """Rows of one run, as functions of common parameters and reciprocal gains."""

    def __init__(self, factors: Factors, weights: np.ndarray, E: np.ndarray, known: np.ndarray):
        self._joints = [
            (list(joint.columns), w * np.asarray(joint.R)[:, :-1], w * np.asarray(joint.R)[:, -1])
            for joint, w in zip(factors.joints, weights, strict=True)
        ]
        self._map, self._known = E, known

    def residuals(self, unknowns: np.ndarray) -> np.ndarray:
        """Weighted predicted less measured forces, in units of nominal gains."""
        size = self._map.shape[1]
        p, c = self._map @ unknowns[:size] + self._known, unknowns[size:]
        parts = [c[j] * (R @ p[own]) - z for j, (own, R, z) in enumerate(self._joints)]
        return np.concatenate(parts)

    def derivatives(self, unknowns: np.ndarray) -> np.ndarray:
        """Of the residuals, by all unknowns."""
        size = self._map.shape[1]
        p, c = self._map @ unknowns[:size] + self._known, unknowns[size:]
        parts = []
        for j, (own, R, _) in enumerate(self._joints):
            J = np.zeros((len(R), len(unknowns)))
            J[:, :size] = c[j] * (R @ self._map[own])
            J[:, size + j] = R @ p[own]
            parts.append(J)
        return np.vstack(parts)
