"""Payload: what runs with a load have more than runs without it, or than the sensor.

Behind a force sensor everything is payload if no run without it is given.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

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
from jaxid.robot.inertia import INERTIAL_NAMES, Inertia, Tool
from jaxid.robot.robot import Robot

from .combination import (
    as_least_squares,
    combine,
    relative_residual,
    require_same_base,
)
from .consistency import BodyBounds, consistency_margin, consistent_body
from .fit_result import Fit, interval_table
from .force_sensor import SensorEstimates, sensor_estimates
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
Runs = Fit | Sequence[Fit]
"""Fit of one run, or of several."""

MAX_DISTANCE = 4.0
"""Standard deviations from the estimate to a possible body that are not unusual."""
MAX_RESIDUAL_RATIO = 2.0
"""Ratio of the residuals with and without a load that is not unusual."""
SMALL_RESIDUAL = 0.01
"""Residual that says nothing of a load, relative to the forces."""
MIN_DRIFT_CHANCE = 0.01
"""Probability of the differences between biases by chance, below which they drift."""
SCALE_DEVIATION = 1e-3
"""Standard deviation of a weighed mass, relative to it."""
INERTIA_RADIUS = 0.1
"""Distance at which the load's mass has a moment that is told: less certain ones are
not [m]."""
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
        residuals: Residual of the fit without the load (NaN if there is none), and of
            the model with the load, relative to the forces.
        sensor: Bias and rotation of the force sensor; None without a sensor.
        is_misread: Whether its wrench is surely not the one that is described: nothing
            is then said of the body.
    """

    body: int = eqx.field(static=True)
    parameters: Body
    estimate: Body
    uncertainty: Uncertainty
    distance: float
    base_parameters: tuple[BaseVector, BaseVector]
    residuals: tuple[float, float]
    sensor: SensorEstimates | None = None
    is_misread: bool = eqx.field(static=True, default=False)

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
        """Inertia tensor about the centre of mass, along the body's axes [kg m²].

        NaN where the runs do not determine it.
        """
        if not self.has_inertia:
            return np.full((3, 3), np.nan)
        return np.asarray(Inertia.from_parameters(self.parameters).tensor)

    @property
    def has_inertia(self) -> bool:
        """Whether the runs determine the moments of inertia: static poses do not."""
        values, uncertainty = self.central
        half_widths = uncertainty.half_widths()[4:7]
        is_precise = half_widths.max() < abs(self.mass) * INERTIA_RADIUS**2
        # Noise at rest looks like impossible moments in narrow intervals.
        is_noise = self.distance > MAX_DISTANCE and np.all(values[4:7] < half_widths)
        return bool(is_precise and not is_noise)

    @property
    def tool(self) -> Tool:
        """The payload as a known load: `robot.replace(tool=payload.tool)`.

        A point mass if the runs do not determine its inertia.

        Raises:
            InputError: If it is no body that can exist.
        """
        return Tool(
            self.body,
            mass=self.mass,
            centre_of_mass=self.centre_of_mass,
            inertia=self.inertia if self.has_inertia else None,
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
        """Return a table of mass, centre, moments about it, and consistency.

        Bias and rotation of a force sensor follow, if there is one.
        """
        central_values, uncertainty = self.central
        is_told = np.arange(10) < (10 if self.has_inertia else 4)
        values = np.where(is_told, central_values, np.nan)
        names, units, words = CENTRAL_NAMES, CENTRAL_UNITS, CENTRAL_WORDS
        covariance = uncertainty.covariance
        dof = uncertainty.dof
        if self.sensor is not None:
            sensor = self.sensor.in_degrees
            names = (*names, *sensor.names)
            units = (*units, *sensor.units)
            words = (*words, *sensor.words)
            values = np.append(values, sensor.values)
            covariance = scipy.linalg.block_diag(
                covariance, sensor.uncertainty.covariance
            )
            dof = np.append(dof, sensor.uncertainty.dof)
        return interval_table(
            "payload in the frame of its body; moments about the centre of mass",
            names,
            units,
            values,
            Uncertainty(covariance, dof, covariance),
            [*self._remarks()],
            words,
        )

    @property
    def has_drifting_bias(self) -> bool:
        """Whether the biases of several runs differ by more than chance."""
        return self.sensor is not None and self.sensor.drift_chance < MIN_DRIFT_CHANCE

    @property
    def is_lighter(self) -> bool:
        """Whether the robot is lighter with the load than without it."""
        return _is_negative(self.estimate, self.uncertainty)

    def _remarks(self) -> Iterator[Remark]:
        """Yield whether the payload is a body that could exist, and what is open."""
        if not self.is_misread:
            yield self._remark()
        if self.has_drifting_bias:
            yield Remark(
                "The bias of the force sensor drifts: each part of the log has its "
                "own, and the table holds that of the last part."
            )

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
                "No load explains the forces: the error of the model is "
                f"{percent(loaded_residual)} % with it, and {percent(residual)} % "
                "without. Does another body carry the load? Or is the load set in the "
                "robot's controller, which then subtracts its gravity from the "
                "forces? Set it to zero there, and record again.",
                Status.BAD,
            )
        if not np.isfinite(self.uncertainty.covariance[:4, :4]).all():
            return Remark(
                "The logs do not determine mass and centre of the payload: move the "
                "joints that carry it in more poses, and alike in both runs.",
                Status.BAD,
            )
        # With moments of inertia that nothing tells no body is impossible.
        if not self.has_inertia:
            return Remark(
                "The runs do not determine the moments of inertia, as slow motion or "
                "poses at rest never do: the table leaves them out. Mass and centre "
                "are determined without them. Move the load faster if they are needed.",
                Status.DOUBTFUL,
            )
        if not np.isfinite(self.distance):
            return Remark("Whether such a body can exist is not known.")
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
    unloaded: Runs | None,
    loaded: Runs,
    *,
    body: int | None = None,
    mass: float | None = None,
) -> Payload:
    """Identify a payload from runs without it and runs with it.

    All are fitted together. What the payload adds to the base parameters depends on its
    ten parameters alone, and these are determined all ten although the last body's own
    are not: the robot without the payload is known from the other run. Friction and
    offsets may differ between the runs, since they change with load and temperature,
    and so may the bias of a force sensor. Uncertainties of all runs count.

    Args:
        unloaded: Fit of the run without the payload, or fits of several. None if a
            force sensor measures what is behind it: then all of that is payload.
        loaded: Fit of the run with it, or fits of several.
        body: Index of the body that carries it; that of the end-effector if None.
        mass: Mass of the payload [kg] if a scale has told it (to 0.1 %): the rest is
            then known better.

    Raises:
        InputError: If the runs have different base parameters or have seen the same
            data, the model does not have ten parameters for the body, or there are no
            runs without the payload and no sensor.
        RuntimeError: If no body was proved to be the nearest.
    """
    runs = _joined_runs(_as_fits(unloaded), _as_fits(loaded), body)
    base = runs.fits[0].base
    values, all_uncertainty = combine(runs.fits, runs.maps)
    estimate = values[-10:]
    # Parameters about the centre of mass are combinations: the fewest count for all.
    covariance = all_uncertainty.covariance[-10:, -10:]
    dof = np.full(10, np.min(all_uncertainty.dof[-10:]))
    uncertainty = Uncertainty(covariance, dof, covariance)
    if mass is not None and not _is_negative(estimate, uncertainty):
        estimate, uncertainty = _weigh(estimate, uncertainty, mass)
    parameters, distance = _possible_body(estimate, uncertainty, base.model.robot)
    base_parameters = _robot_with_load(runs, parameters)
    residual = runs.fits[0].residual if runs.unloaded else np.nan
    return Payload(
        body=runs.body,
        parameters=parameters,
        estimate=estimate,
        uncertainty=uncertainty,
        distance=distance,
        base_parameters=base_parameters,
        residuals=(residual, relative_residual(runs.fits[-1], base_parameters[1])),
        sensor=sensor_estimates(
            base, runs.maps[runs.unloaded :], values, all_uncertainty
        ),
    )


class _LoadRuns(NamedTuple):
    """Fits of the runs without the load, then with it, and what they have in common.

    Attributes:
        fits: Fits, as least squares.
        unloaded: Number of fits without the load.
        body: Index of the body that carries it.
        maps: For each fit the matrix [base, unknowns] from all unknowns, of which the
            last ten are the load's, to its base parameters.
    """

    fits: tuple[Fit, ...]
    unloaded: int
    body: int
    maps: list[Matrix]


def _as_fits(runs: Runs | None) -> tuple[Fit, ...]:
    """Return one fit or several as a tuple; an empty one for None."""
    if runs is None:
        return ()
    fits = (runs,) if isinstance(runs, Fit) else runs
    return tuple(map(as_least_squares, fits))


def _joined_runs(
    unloaded: tuple[Fit, ...], loaded: tuple[Fit, ...], body: int | None
) -> _LoadRuns:
    """Return the runs, and how their base parameters follow from common unknowns."""
    fits = (*unloaded, *loaded)
    require_same_base(fits)
    base = fits[0].base
    body = base.model.robot.tip_body if body is None else body
    columns = body_columns(base, body)
    states = state_maps(base.size, varying_parameters(base), len(fits))
    if not unloaded:
        states = [_without_own_parameters(state, columns) for state in states]
    maps = []
    for number, state in enumerate(states):
        # The payload's ten parameters are unknowns that only loaded runs have.
        is_loaded = number >= len(unloaded)
        maps.append(np.hstack([state, is_loaded * columns]))
    return _LoadRuns(fits, len(unloaded), body, maps)


def _without_own_parameters(state: Matrix, columns: Matrix) -> Matrix:
    """Return the map of a run whose body behind the sensor is the load alone.

    Raises:
        InputError: If the body's ten parameters are no base parameters themselves, as
            they are behind a sensor.
    """
    if np.linalg.matrix_rank(columns) < 10 or np.count_nonzero(columns) > 10:
        raise InputError(
            "`unloaded` must hold a run without the payload, since no force sensor "
            "measures the payload alone: give one, or use `robot.with_sensor()`."
        )
    own_parameters = columns.any(axis=1)
    return np.delete(state, state[own_parameters].argmax(axis=1), axis=1)


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


def _robot_with_load(runs: _LoadRuns, load: Body) -> tuple[BaseVector, BaseVector]:
    """Return the base parameters without and with a load that is known."""
    states = [matrix[:, :-10] for matrix in runs.maps]
    loads = [matrix[:, -10:] @ load for matrix in runs.maps]
    values, _ = combine(runs.fits, states, loads)
    return states[0] @ values, states[-1] @ values + loads[-1]


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
        name = f"{symbol}{base.model.robot.numbers[body]}"
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
