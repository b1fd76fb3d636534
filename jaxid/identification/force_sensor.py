"""Bias of a force sensor, and the rotation by which it is mounted."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import numpy as np
import scipy

from jaxid.arrays import AnyArray, BaseVector, Float, Matrix, Matrix3, Texts
from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import SensorBias, SensorLoad, SensorRotation
from jaxid.measurement.observations import Observations, ObservedLogs
from jaxid.measurement.sensor_turns import SensorRows
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import GROUP

from .parameter_changes import equality_test
from .uncertainty import Uncertainty

ROWS = 300
"""Rows of a log in which a rotation is searched, at most."""
BLOCKS = 20
"""Blocks of time of a log whose errors are independent."""


class SensorEstimates(eqx.Module):
    """Bias and rotation of force sensors in the last run, with their uncertainty.

    Attributes:
        names: Names of the parameters.
        units: Units of the parameters.
        words: Meanings of the parameters.
        values: Estimates; rotations are those against the description.
        uncertainty: Uncertainty of the estimates.
        drift_chance: Probability of biases of several runs that differ by chance; 1 of
            a single run.
    """

    names: Texts = eqx.field(static=True)
    units: Texts = eqx.field(static=True)
    words: Texts = eqx.field(static=True)
    values: Float[AnyArray, " estimates"]
    uncertainty: Uncertainty
    drift_chance: float

    @property
    def in_degrees(self) -> "SensorEstimates":
        """The same estimates with angles in degrees."""
        is_angle = [unit == "rad" for unit in self.units]
        scale = np.where(is_angle, 180.0 / np.pi, 1.0)
        covariance = self.uncertainty.covariance * np.outer(scale, scale)
        return dataclasses.replace(
            self,
            units=tuple("deg" if unit == "rad" else unit for unit in self.units),
            values=self.values * scale,
            uncertainty=Uncertainty(covariance, self.uncertainty.dof, covariance),
        )

    @property
    def bias(self) -> Float[np.ndarray, " biases"]:
        """Bias of all sensors: three forces [N], three moments [N m] of each."""
        is_bias = np.array([unit != "rad" for unit in self.units])
        return np.asarray(self.values)[is_bias]

    @property
    def rotation(self) -> Float[np.ndarray, " angles"]:
        """Rotation of the sensor against its description, as a vector [rad]."""
        is_angle = np.array([unit == "rad" for unit in self.units])
        return np.asarray(self.values)[is_angle]


def sensor_parameters(base: BaseParameters) -> dict[int, str]:
    """Return the base parameters that belong to force sensors, with their meanings."""
    words = {}
    for term in base.model.terms:
        if term.is_of_sensors:
            for name, _ in term.parameters(base.model.robot):
                words[name] = term.meanings[name.rstrip("0123456789")]
    names = enumerate(base.names)
    return {k: words[name] for k, name in names if name in words}


def sensor_estimates(
    base: BaseParameters,
    maps: Sequence[Matrix],
    values: BaseVector,
    uncertainty: Uncertainty,
) -> SensorEstimates | None:
    """Return what fits of several runs tell about sensors; None without sensors.

    Args:
        base: Base parameters of each run.
        maps: Matrix of each run from the common unknowns to its base parameters.
        values: Estimates of the common unknowns.
        uncertainty: Uncertainty of the common unknowns.
    """
    indices = sensor_parameters(base)
    if not indices:
        return None
    # Each of them is an unknown of its own, perhaps one for each run.
    places = [matrix[list(indices)].argmax(axis=1) for matrix in maps]
    last = places[-1]
    units = tuple(base.units[k] for k in indices)
    estimates = np.asarray(values)[last]
    is_angle = np.array([unit == "rad" for unit in units])
    if is_angle.any():
        turned = mounting_rotation(base.model.robot)
        step = scipy.spatial.transform.Rotation.from_rotvec(estimates[is_angle])
        total = scipy.spatial.transform.Rotation.from_matrix(turned) * step
        estimates[is_angle] = total.as_rotvec()
    covariance = uncertainty.covariance[np.ix_(last, last)]
    return SensorEstimates(
        names=tuple(base.names[k] for k in indices),
        units=units,
        words=tuple(indices.values()),
        values=estimates,
        uncertainty=Uncertainty(covariance, uncertainty.dof[last], covariance),
        drift_chance=_drift_chance(np.array(places)[:, ~is_angle], values, uncertainty),
    )


def _drift_chance(places: Matrix, values: BaseVector, uncertainty: Uncertainty):
    """Return the probability of biases of several runs that differ by chance."""
    if len(places) < 2:
        return 1.0
    flat = places.ravel()
    dof = float(np.min(uncertainty.dof[flat]))
    covariance = uncertainty.covariance[np.ix_(flat, flat)]
    _, chance = equality_test(np.asarray(values)[places], covariance, dof)
    return chance


def mounting_rotation(robot: Robot) -> Matrix3:
    """Return the attitude of the sensor at the end-effector in its description."""
    return np.asarray(robot.axis)[list(robot.rigid[-GROUP:])][:3].T


def some_rows(log: Observations) -> slice:
    """Return the rows of a log in which a rotation is searched."""
    return slice(None, None, -(-log.rows // ROWS))


def wrench_rows(model: Model, logs: ObservedLogs) -> SensorRows:
    """Return wrenches of a sensor in some rows, and what bodies and biases explain.

    Args:
        model: Model of the bodies that the sensor carries, and its biases.
        logs: Observations of one log or of several.
    """
    logs = (logs,) if isinstance(logs, Observations) else logs
    places = list(model.robot.rigid[-GROUP:])
    parts = []
    for number, log in enumerate(logs):
        rows = some_rows(log)
        motion = log.reduced_motion[rows]
        wrench = log.reduced_forces[rows][:, places]
        known = np.asarray(model.tool_forces(motion))[:, places]
        columns = np.asarray(model.regressor(motion))[:, places]
        times = np.arange(len(wrench)) / len(wrench)
        blocks = (BLOCKS * (number + times)).astype(int)
        parts.append((wrench, known, columns, blocks))
    wrench, known, columns, blocks = map(np.concatenate, zip(*parts, strict=True))
    return SensorRows(
        measured=wrench.reshape(-1, 2, 3),
        known=known.reshape(-1, 2, 3),
        columns=columns.reshape(-1, 2, 3, model.size),
        prior=np.zeros(model.size),
        blocks=blocks,
    )


def identify_sensor_rotation(
    base: BaseParameters, observations: ObservedLogs, *, turns: bool = True
) -> BaseParameters:
    """Find the rotation by which the force sensor at the end-effector is mounted.

    Its wrench is along its own axes, of which gravity and accelerations tell where they
    are. The model of the base parameters returned has turned axes, and the effect of a
    small rotation of the load found. A fit with it tells what is left of the rotation,
    and its uncertainty is part of all others.

    Args:
        base: Base parameters of a model with a `SensorRotation`; others are returned as
            they are.
        observations: Observations with the wrench of a load.
        turns: Whether to turn the sensor; otherwise only the load is found, as for
            another run with a sensor that is turned already.
    """
    model = base.model
    if not any(isinstance(term, SensorRotation) for term in model.terms):
        return base
    rows = wrench_rows(Model(model.robot, (SensorLoad(), SensorBias())), observations)
    turn = rows.estimate().turn if turns else np.eye(3)
    load = rows.turned(turn).unknowns()[:10]
    attitude = mounting_rotation(model.robot) @ turn
    axes = np.array(model.robot.axis)
    axes[list(model.robot.rigid[-GROUP:])] = np.tile(attitude.T, (2, 1))
    terms = [
        SensorRotation(load) if isinstance(term, SensorRotation) else term
        for term in model.terms
    ]
    turned_model = type(model)(model.robot.replace(axis=axes), tuple(terms))
    return eqx.tree_at(lambda b: b.model, base, turned_model)
