"""Payload: the difference between a run without a load and a run with it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxid.arrays import (
    AnyArray,
    BaseVector,
    Float,
    Matrix,
    Matrix3,
    Vector3,
    double_precision,
)
from jaxid.dynamics.base import BaseParameters
from jaxid.errors import InputError
from jaxid.result_table import (
    Remark,
    Status,
    Summarised,
    Table,
    percent,
    significant,
)
from jaxid.robot.inertia import INERTIAL_NAMES, Inertia
from jaxid.robot.robot import Robot, Tool

from .combination import (
    as_least_squares,
    combine,
    relative_residual,
    require_same_base,
)
from .consistency import BodyBounds, consistency_margin, consistent_body
from .fit_result import Fit, interval_table
from .operating_states import state_maps, varying_parameters
from .uncertainty import Uncertainty

CENTRAL_NAMES = ("m", "x", "y", "z", "A_c", "B_c", "C_c", "D_c", "E_c", "F_c")
CENTRAL_UNITS = ("kg", "m", "m", "m", *("kg m²",) * 6)
CENTRAL_WORDS = (
    "mass",
    "centre of mass, x",
    "centre of mass, y",
    "centre of mass, z",
    "moment of inertia about x",
    "moment of inertia about y",
    "moment of inertia about z",
    "product of inertia in y, z",
    "product of inertia in x, z",
    "product of inertia in x, y",
)

Body = Float[AnyArray, "10"]
"""Parameters $(m, m r_c, A, B, C, D, E, F)$ of a body."""

MAX_DISTANCE = 4.0
"""Standard deviations from the estimate to a possible body that are not unusual."""
MAX_RESIDUAL_RATIO = 2.0
"""Ratio of the residuals with and without a load that is not unusual."""
SMALL_RESIDUAL = 0.01
"""Residual that says nothing of a load, relative to the forces."""
SCALE_DEVIATION = 1e-3
"""Standard deviation of a weighed mass, relative to it."""
MAX_ERROR_BOUND = 0.01
"""Relative error bound of half the squared distance to the nearest body.

Estimates with tiny deviations, as those of noiseless data, leave no digits for a proof.
"""


class Payload(Summarised, eqx.Module):
    """Mass, centre of mass and inertia of a load on a body.

    Attributes:
        body: Index of the body that carries it (0 is the first).
        parameters: $(m, m r_c, A, B, C, D, E, F)$ about the origin of the body's frame:
            the estimate, or the body nearest to it, in units of its uncertainty, that
            can exist. If the robot is lighter with the load, the estimate.
        estimate: Estimate from the forces, whether such a body can exist or not.
        uncertainty: Uncertainty of the estimate.
        distance: From the estimate to the parameters, in standard deviations: below 4
            nothing unusual; NaN where the runs do not determine all ten, or where the
            robot is lighter with the load.
        base_parameters: Base parameters of the robot without the load and with it; they
            differ by the load, friction and offsets alone.
        residuals: Residual of the fit without the load, and of the model with the load,
            relative to the forces.
    """

    body: int = eqx.field(static=True)
    parameters: Body
    estimate: Body
    uncertainty: Uncertainty
    distance: float
    base_parameters: tuple[BaseVector, BaseVector]
    residuals: tuple[float, float]

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        return float(self.parameters[0])

    @property
    def centre_of_mass(self) -> Vector3:
        """Centre of mass in the frame of the body [m]; NaN without a mass."""
        return np.asarray(self.parameters[1:4] / (self.mass or np.nan))

    @property
    def inertia(self) -> Matrix3:
        """Inertia tensor about the centre of mass, along the body's axes [kg m²]."""
        return np.asarray(Inertia.from_parameters(self.parameters).tensor)

    @property
    def tool(self) -> Tool:
        """The payload as a known load: `robot.replace(tool=payload.tool)`.

        Raises:
            InputError: If it is no body that can exist.
        """
        return Tool(
            self.body,
            mass=self.mass,
            centre_of_mass=self.centre_of_mass,
            inertia=self.inertia,
        )

    @property
    def central(self) -> tuple[np.ndarray, Uncertainty]:
        """Mass, centre of mass, moments about it, and uncertainty (`CENTRAL_NAMES`)."""
        with double_precision():
            p = jnp.asarray(self.parameters)
            values = np.asarray(_about_centre(p))
            J = np.asarray(jax.jacfwd(_about_centre)(p))
        covariance = self.uncertainty.covariance
        # Infinite variances would make all others NaN in the product.
        is_undetermined = ~np.isfinite(np.diag(covariance))
        finite_part = np.where(np.isfinite(covariance), covariance, 0.0)
        central_covariance = J @ finite_part @ J.T
        is_affected = np.any(J[:, is_undetermined] != 0.0, axis=1)
        central_covariance[is_affected, is_affected] = np.inf
        return values, Uncertainty(
            central_covariance, self.uncertainty.dof, central_covariance
        )

    def summary(self) -> Table:
        """Return a table of mass, centre, moments about it, and consistency."""
        values, uncertainty = self.central
        return interval_table(
            "payload in the frame of its body; moments about the centre of mass",
            CENTRAL_NAMES,
            CENTRAL_UNITS,
            values,
            uncertainty,
            [self._remark()],
            CENTRAL_WORDS,
        )

    @property
    def is_lighter(self) -> bool:
        """Whether the robot is lighter with the load than without it."""
        return _is_negative(self.estimate, self.uncertainty)

    def _remark(self) -> Remark:
        """Return whether the payload is a body that could exist."""
        if self.is_lighter:
            half_width = float(self.uncertainty.half_widths()[0])
            return Remark(
                f"With the load the robot is lighter by {significant(-self.mass, 2)} kg"
                f" (± {significant(half_width, 2)} kg, 95 %): are the logs exchanged, "
                "or was a tool taken off? Exchange them to identify what was taken "
                "off.",
                Status.BAD,
            )
        residual, loaded_residual = self.residuals
        if loaded_residual > MAX_RESIDUAL_RATIO * residual + SMALL_RESIDUAL:
            return Remark(
                "No load explains the forces: the torque error of the model is "
                f"{percent(loaded_residual)} % with it, and {percent(residual)} % "
                "without. Does another body carry the load? Or is the load set in the "
                "robot's controller, which then subtracts its gravity from the "
                "forces? Set it to zero there, and record again.",
                Status.BAD,
            )
        if not np.isfinite(self.distance):
            return Remark(
                "The logs do not determine all ten parameters of the payload: move the "
                "joints that carry it in more poses, faster, and alike in both runs.",
                Status.BAD,
            )
        if self.distance > 0:
            is_usual = self.distance < MAX_DISTANCE
            return Remark(
                "The estimate itself is not physically possible: these are the "
                "parameters of the nearest possible body, "
                f"{self.distance:.2g} standard deviations away.",
                Status.NEUTRAL if is_usual else Status.DOUBTFUL,
            )
        return Remark("The payload is a physically possible body.", Status.GOOD)


def identify_payload(
    unloaded: Fit,
    loaded: Fit,
    *,
    body: int | None = None,
    mass: float | None = None,
) -> Payload:
    """Identify a payload from a run without it and a run with it.

    Both are fitted together. What the payload adds to the base parameters depends on
    its ten parameters alone, and these are determined all ten although the last body's
    own are not: the robot without the payload is known from the other run. Friction and
    offsets may differ between the runs, since they change with load and temperature.
    Uncertainties of both runs count.

    Args:
        unloaded: Fit of the run without the payload.
        loaded: Fit of the run with it.
        body: Index of the body that carries it; that of the end-effector if None.
        mass: Mass of the payload [kg] if a scale has told it (to 0.1 %): the rest is
            then known better.

    Raises:
        InputError: If the runs have different base parameters or have seen the same
            data, or the model does not have ten parameters for the body.
        RuntimeError: If no body was proved to be the nearest.
    """
    require_same_base((unloaded, loaded))
    base = unloaded.base
    body = base.model.robot.tip_body if body is None else body
    columns = body_columns(base, body)
    fits = (as_least_squares(unloaded), as_least_squares(loaded))
    estimate, uncertainty = _estimate(fits, columns)
    if mass is not None and not _is_negative(estimate, uncertainty):
        estimate, uncertainty = _weigh(estimate, uncertainty, mass)
    parameters, distance = _possible_body(estimate, uncertainty, base.model.robot)
    base_parameters = _robot_with_load(fits, columns @ parameters)
    loaded_residual = relative_residual(fits[1], base_parameters[1])
    return Payload(
        body=body,
        parameters=parameters,
        estimate=estimate,
        uncertainty=uncertainty,
        distance=distance,
        base_parameters=base_parameters,
        residuals=(fits[0].residual, loaded_residual),
    )


def _estimate(fits: tuple[Fit, Fit], columns: Matrix):
    """Return the parameters that a load on a body has added between two runs."""
    base = fits[0].base
    states = state_maps(base.size, varying_parameters(base), 2)
    # The payload's ten parameters are unknowns that only the loaded run has.
    maps = [
        np.hstack([states[0], np.zeros_like(columns)]),
        np.hstack([states[1], columns]),
    ]
    values, uncertainty = combine(fits, maps)
    covariance = uncertainty.covariance[-10:, -10:]
    # Parameters about the centre of mass are combinations: the fewest count for all.
    dof = np.full(10, np.min(uncertainty.dof[-10:]))
    return values[-10:], Uncertainty(covariance, dof, covariance)


def _possible_body(
    estimate: Body, uncertainty: Uncertainty, robot: Robot
) -> tuple[Body, float]:
    """Return the nearest body that can exist, and its distance; else the estimate."""
    is_determined = np.isfinite(uncertainty.covariance).all()
    # The body nearest to a negative mass would say nothing about the logs.
    if _is_negative(estimate, uncertainty) or not is_determined:
        return estimate, np.nan
    if consistency_margin(estimate) >= 0:
        return estimate, 0.0
    parameters, distance, error_bound = consistent_body(
        estimate, uncertainty.covariance, _wide_bounds(robot)
    )
    if not error_bound <= MAX_ERROR_BOUND * (1.0 + distance**2):
        raise RuntimeError(
            "the nearest possible body was not found with certainty: are both runs "
            "from the same robot?"
        )
    return parameters, distance


def _robot_with_load(
    fits: tuple[Fit, Fit], load: BaseVector
) -> tuple[BaseVector, BaseVector]:
    """Return the base parameters without and with a load that is known."""
    base = fits[0].base
    states = state_maps(base.size, varying_parameters(base), 2)
    values, _ = combine(fits, states, [np.zeros(base.size), load])
    return states[0] @ values, states[1] @ values + load


def _is_negative(estimate: AnyArray, uncertainty: Uncertainty) -> bool:
    """Return whether the mass is below zero by more than its usual scatter."""
    deviation = uncertainty.standard_deviations[0]
    return bool(estimate[0] < -MAX_DISTANCE * deviation)


def _weigh(estimate: np.ndarray, uncertainty: Uncertainty, mass: float):
    """Update the estimate by a measured mass [kg], as a Kalman filter does."""
    covariance = uncertainty.covariance
    variance = (SCALE_DEVIATION * mass) ** 2
    gain = covariance[:, 0] / (covariance[0, 0] + variance)
    estimate = estimate + gain * (mass - estimate[0])
    covariance = covariance - np.outer(gain, covariance[0])
    return estimate, Uncertainty(covariance, uncertainty.dof, covariance)


def _wide_bounds(robot: Robot) -> BodyBounds:
    """Return the widest bounds of the robot's bodies as those of one body."""
    bounds = BodyBounds.from_geometry(robot)
    return BodyBounds(mass_max=np.max(bounds.mass_max), radius=np.max(bounds.radius))


def body_columns(base: BaseParameters, body: int) -> np.ndarray:
    """Return what unit parameters of a load on a body add to base parameters."""
    bodies = base.model.robot.bodies
    if not 0 <= body < bodies:
        raise InputError(f"`body` must be from 0 to {bodies - 1}, but is {body}.")
    names = list(base.model.parameter_names)
    columns = []
    for symbol in INERTIAL_NAMES:
        name = f"{symbol}{body + 1}"
        if name not in names:
            raise InputError(
                f"the model lacks `{name}` of body {body}: use `RigidBodies()`."
            )
        columns.append(names.index(name))
    unit_vectors = np.eye(base.model.size)[columns]
    return np.asarray(base.from_standard(unit_vectors)).T


def _about_centre(p: jax.Array) -> jax.Array:
    """Return mass, centre of mass, and the six moments about it."""
    body = Inertia.from_parameters(p)
    central_parameters = Inertia(
        body.mass, jnp.zeros_like(body.centre), body.tensor
    ).parameters
    return jnp.concatenate([p[:1], body.centre, central_parameters[4:]])
