"""Loads between two runs: a payload that is not known, and gains of the drives from one that is.

Currents times nominal torque constants are forces up to one factor for each joint.
Masses scale with these factors alike, so that no single run tells them; a known load
does.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize

from jaxid.arrays import AnyArray, Array, Float, double_precision
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.result_table import Remark, Status, Summarised, Table
from jaxid.robot.inertia import INERTIAL_NAMES, Inertia
from jaxid.robot.robot import Tool

from .combination import as_least_squares, combine, require_same_base
from .consistency import BodyBounds, consistency_margin, consistent_body
from .estimators.regularisation_and_weights import NUMERICAL, Decomposition
from .factors import Factors
from .fit_result import Fit, interval_table
from .operating_states import state_maps, varying_parameters
from .uncertainty import Uncertainty
from .uncertainty.blocks import block_covariance

CENTRAL_NAMES = ("m", "x", "y", "z", "A_c", "B_c", "C_c", "D_c", "E_c", "F_c")
CENTRAL_UNITS = ("kg", "m", "m", "m", *("kg m²",) * 6)


class Payload(Summarised, eqx.Module):
    """Mass, centre of mass and inertia of a load on a body.

    Attributes:
        body: Index of the body that carries it (0 is the first).
        parameters: $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's frame:
            the estimate, or the body nearest to it, in units of its uncertainty, that
            can exist.
        estimate: Estimate from the forces, whether such a body can exist or not.
        uncertainty: Uncertainty of the estimate.
        distance: From the estimate to the parameters, in standard deviations: below 4
            nothing unusual; NaN where the runs do not determine all ten.
    """

    body: int = eqx.field(static=True)
    parameters: Float[AnyArray, "10"]
    estimate: Float[AnyArray, "10"]
    uncertainty: Uncertainty
    distance: float

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.parameters[0])

    @property
    def centre_of_mass(self) -> Float[np.ndarray, "3"]:
        """Centre of mass in the frame of the body [m]."""
        return np.asarray(self.parameters[1:4] / self.mass)

    @property
    def inertia(self) -> Float[np.ndarray, "3 3"]:
        """Inertia tensor about the centre of mass, along the body's axes [kg m²]."""
        return np.asarray(Inertia.from_parameters(self.parameters).tensor)

    @property
    def tool(self) -> Tool:
        """The payload as a known load: `robot.replace(tool=payload.tool)`.

        Raises:
            InputError: If it is no body that can exist.
        """
        centre, inertia = self.centre_of_mass, self.inertia
        return Tool(self.body, mass=self.mass, centre_of_mass=centre, inertia=inertia)

    @property
    def central(self) -> tuple[Float[np.ndarray, "10"], Uncertainty]:
        """Mass, centre of mass, and moments about it, with their uncertainty (`CENTRAL_NAMES`)."""
        with double_precision():
            p = jnp.asarray(self.parameters)
            values, J = (
                np.asarray(f(p)) for f in (_about_centre, jax.jacfwd(_about_centre))
            )
        C = self.uncertainty.covariance
        covariance = J @ np.where(np.isfinite(C), C, 0.0) @ J.T
        lost = np.any(J[:, ~np.isfinite(np.diag(C))] != 0.0, axis=1)
        covariance[lost, lost] = np.inf
        return values, Uncertainty(covariance, self.uncertainty.dof, covariance)

    def summary(self) -> Table:
        """Return a table of mass, centre of mass and moments about it, and of their consistency."""
        text, status = "the payload is a body that could exist.", Status.GOOD
        if not np.isfinite(self.distance):
            status = Status.BAD
            text = (
                "the logs do not determine all ten parameters of the payload: move "
                "the joints that "
                "carry it in more poses, faster, and alike in both runs."
            )
        elif self.distance > 0:
            status = Status.NEUTRAL if self.distance < 4.0 else Status.DOUBTFUL
            text = (
                "the estimate itself belongs to no body: these are the parameters of "
                "the nearest "
                f"one that could exist, {self.distance:.2g} standard deviations away."
            )
        remarks = [Remark(text, status)]
        title = "payload in the frame of its body; moments about the centre of mass"
        return interval_table(
            title, CENTRAL_NAMES, CENTRAL_UNITS, *self.central, remarks
        )


def identify_payload(
    unloaded: Fit,
    loaded: Fit,
    *,
    body: int | None = None,
    mass: float | None = None,
    varying: Sequence[str] | None = None,
    bounds: BodyBounds | None = None,
) -> Payload:
    """Identify a payload from a run without it and a run with it.

    Both are fitted together. What the payload adds to the base parameters depends on
    its ten parameters alone, and these are determined all ten although the last body's
    own are not: the robot without the payload is known from the other run.
    Uncertainties of both runs count.

    Args:
        unloaded: Fit of the run without the payload.
        loaded: Fit of the run with it.
        body: Index of the body that carries it; that of the end-effector if None.
        mass: Mass of the payload [kg] if a scale has told it (to 0.1 %): the rest is
            then known better.
        varying: Names of base parameters that may differ between the runs beside the
            payload. If None, friction and offsets: they change with load and
            temperature.
        bounds: Bounds of the payload, such as `BodyBounds(mass_max=..., radius=...)`.
            If None, wide ones from the robot's reach, which count only if the estimate
            could not exist.

    Raises:
        InputError: If the runs have different base parameters or have seen the same
            data, or the model does not have ten parameters for the body.
        RuntimeError: If no body within the bounds was proved to be the nearest.
    """
    require_same_base((unloaded, loaded))
    base = unloaded.base
    body = base.model.robot.tip_body if body is None else body
    first, second = state_maps(base.size, varying_parameters(base, varying), 2)
    added = body_columns(base, body)
    maps = [np.hstack([first, np.zeros_like(added)]), np.hstack([second, added])]
    x, both = combine([as_least_squares(unloaded), as_least_squares(loaded)], maps)
    covariance = both.covariance[-10:, -10:]
    dof = np.full(10, np.min(both.dof[-10:]))
    estimate = x[-10:]
    if mass is not None:
        gain = covariance[:, 0] / (covariance[0, 0] + (1e-3 * mass) ** 2)
        estimate = estimate + gain * (mass - estimate[0])
        covariance = covariance - np.outer(gain, covariance[0])
    uncertainty = Uncertainty(covariance, dof, covariance)
    known = np.isfinite(covariance).all()
    if not known or (bounds is None and consistency_margin(estimate) >= 0):
        return Payload(body, estimate, estimate, uncertainty, 0.0 if known else np.nan)
    if bounds is None:
        wide = BodyBounds.from_geometry(base.model.robot)
        bounds = BodyBounds(mass_max=np.max(wide.mass_max), radius=np.max(wide.radius))
    # Estimates that are known too well, as those of noiseless data, leave no digits for
    # a proof: a relative error of one percent of half the squared distance is good
    # enough.
    p, distance, error_bound = consistent_body(
        estimate, covariance, bounds, throw=False
    )
    if not error_bound <= 0.01 * (1.0 + distance**2):
        raise RuntimeError(
            "no body was proved to be the nearest: are both runs of one robot?"
        )
    return Payload(body, p, estimate, uncertainty, distance)


def body_columns(base: BaseParameters, body: int) -> Float[np.ndarray, "base 10"]:
    """Return the base parameters that unit parameters of a load on a body add."""
    robot, names = base.model.robot, base.model.parameter_names
    if not 0 <= body < robot.joints:
        raise InputError(f"`body` must be from 0 to {robot.joints - 1}, but is {body}.")
    ten = [f"{name}{body + 1}" for name in INERTIAL_NAMES]
    for name in ten:
        if name not in names:
            raise InputError(
                f"the model lacks `{name}` of body {body}: use `RigidBodies()`."
            )
    unit = np.eye(base.model.size)[[names.index(name) for name in ten]]
    return np.asarray(base.from_standard(unit)).T


def _about_centre(p: Float[Array, "10"]) -> Float[Array, "10"]:
    """Return mass, centre of mass, and the six moments about it."""
    body = Inertia.from_parameters(p)
    central = Inertia(body.mass, jnp.zeros_like(body.centre), body.tensor).parameters
    return jnp.concatenate([p[:1], body.centre, central[4:]])


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
        units, title = (
            ("1",) * len(self.joint_names),
            "true forces over those of the logs",
        )
        return interval_table(
            title, self.joint_names, units, self.gains, self.uncertainty
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
    base = unloaded.base
    robot = base.model.robot
    A = np.asarray(robot.drives.reduction)
    if np.count_nonzero(A - np.diag(np.diag(A))):
        raise InputError(
            f"motors of `{robot.name}` turn more than one axis: they have no gains."
        )
    if robot.tool is not None:
        raise InputError(
            f"`{robot.name}` has a known tool: leave it out (`tool=None`)."
        )
    fits = (as_least_squares(unloaded), as_least_squares(loaded))
    maps = state_maps(base.size, varying_parameters(base, varying), 2)
    if isinstance(load, Tool):
        added = body_columns(base, load.body) @ load.parameters
    else:
        columns = body_columns(base, robot.tip_body)
        added, rest = load * columns[:, 0], columns[:, 1:]
        maps = [
            np.hstack([E, known * rest])
            for E, known in zip(maps, (0.0, 1.0), strict=True)
        ]
    offsets = (np.zeros(base.size), added)
    runs = list(zip(fits, maps, offsets, strict=True))
    size = maps[0].shape[1]

    def linearise(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [
            _linearise(f.time_blocks.total, f.weights, E, k, u) for f, E, k in runs
        ]
        return np.concatenate([r for r, _ in parts]), np.vstack([J for _, J in parts])

    start = np.append(combine(fits, maps, offsets)[0], np.ones(robot.joints))
    settings = {
        "method": "lm",
        "x_scale": "jac",
        "xtol": 1e-14,
        "ftol": 1e-14,
        "gtol": 1e-14,
    }
    functions: list[Any] = [lambda u, k=k: linearise(u)[k] for k in range(2)]
    solution = optimize.least_squares(functions[0], start, functions[1], **settings)
    c = solution.x[size:]
    residuals, J = linearise(solution.x)
    decomposition = Decomposition.of(J, -residuals)
    B = decomposition.inverse_information()
    plausible = np.all((c > 1 / LARGEST) & (c < LARGEST))
    if decomposition.values[-1] <= NUMERICAL * decomposition.values[0] or not plausible:
        raise InputError(
            "the load does not tell all gains: take a heavier one, move every joint."
        )
    blocks = []
    for fit, E, k in runs:
        for part in fit.time_blocks.parts:
            r, rows = _linearise(part, fit.weights, E, k, solution.x)
            blocks.append((rows, r))
    covariance, dof = block_covariance(blocks, B)
    covariance = covariance[size:, size:] / c**2 / c[:, None] ** 2
    uncertainty = Uncertainty(covariance, np.full(robot.joints, dof), covariance)
    return DriveGains(
        1.0 / c, uncertainty, maps[0] @ solution.x[:size], robot.joint_names
    )


def _linearise(
    factors: Factors, weights, E, offset, unknowns
) -> tuple[np.ndarray, np.ndarray]:
    """Return weighted predicted less measured forces, in nominal units, and their derivatives.

    The unknowns are those of the base parameters, then the reciprocal gains.
    """
    size = E.shape[1]
    p, c = E @ unknowns[:size] + offset, unknowns[size:]
    residuals, derivatives = [], []
    for j, (joint, w) in enumerate(
        zip(factors.joints, np.asarray(weights), strict=True)
    ):
        own, R = list(joint.columns), w * joint.R
        forces = R[:, :-1] @ p[own]
        J = np.zeros((len(R), len(unknowns)))
        J[:, :size] = c[j] * (R[:, :-1] @ E[own])
        J[:, size + j] = forces
        residuals.append(c[j] * forces - R[:, -1])
        derivatives.append(J)
    return np.concatenate(residuals), np.vstack(derivatives)
