"""A payload behind a force sensor, from logs of its wrench, with torques or without."""

import dataclasses
from collections.abc import Sequence

import jax
import numpy as np

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    AbstractTerm,
    SensorBias,
    SensorLoad,
    SensorRotation,
)
from jaxid.errors import InputError
from jaxid.identification.fit_result import Fit
from jaxid.identification.identify import identify
from jaxid.identification.payload import Payload, identify_payload
from jaxid.measurement.columns import Columns
from jaxid.measurement.log_columns import Selection
from jaxid.measurement.observations import Observations
from jaxid.robot.robot import Robot
from jaxid.robot.rotations import rpy_rotation
from jaxid.robot.virtual_joints import on_all_joints

from .setup import Setup

PART_TIME = 60.0
"""Shortest part of a log that may have a bias of its own [s]."""
MAX_PARTS = 10
"""Largest number of such parts."""


@dataclasses.dataclass(frozen=True)
class ForceSensor:
    """Six-axis force sensor at the end-effector, or under the base.

    Attributes:
        wrench: Columns of three forces [N], then three moments [N m], like
            `["fx", "fy", "fz", "tx", "ty", "tz"]`.
        sign: 1 if the force points up at rest, as that of the sensor on the load does;
            -1 if it points down, as most drivers have it.
        rotation: Roll, pitch and yaw of the sensor's frame in that of the end-effector,
            or of the ground under the base [deg], like `[0.0, 0.0, 0.0]`.
        position: Origin of the sensor's frame there [m], like `[0.0, 0.0, 0.0]`.
        in_ground: Whether the driver turns the wrench into the axes of the ground.
        under_base: Whether the sensor is between ground and robot: `jaxid identify`
            then uses it; otherwise `jaxid payload`.
    """

    wrench: Selection
    sign: float = 1.0
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    in_ground: bool = False
    under_base: bool = False

    def __post_init__(self) -> None:
        """Refuse other signs, and a base that turns.

        Raises:
            InputError: If the sign is neither 1 nor -1, or two keys do not go together.
        """
        if abs(self.sign) != 1:
            raise InputError(f"`sign` must be 1 or -1, but is {self.sign:g}.")
        if self.in_ground and self.under_base:
            raise InputError(
                "`in_ground` is for sensors that turn: a sensor under the base does "
                "not; give the ground's axes by `rotation`."
            )

    def on(self, robot: Robot) -> Robot:
        """Return the robot with the sensor."""
        rotation = rpy_rotation(np.deg2rad(self.rotation))
        return robot.with_sensor(rotation, self.position, under_base=self.under_base)

    def terms_on(self, setup: Setup) -> tuple[AbstractTerm, ...]:
        """Return the terms of the robot with the sensor, which adds virtual joints."""
        robot = self.on(setup.robot)

        def with_virtual(values):
            # Virtual joints have no friction, whatever its constants are.
            is_each = np.shape(values) == (setup.robot.joints,)
            return on_all_joints(robot, values, 1.0) if is_each else values

        return jax.tree.map(with_virtual, setup.model.terms)

    def columns(self, columns: Columns) -> Columns:
        """Return the columns of logs, with those of the wrench."""
        return dataclasses.replace(columns, wrench=self.wrench, wrench_sign=self.sign)

    def beside(self, setup: Setup, columns: Columns) -> Setup:
        """Return the setup of a robot with the sensor.

        Logs without forces of the joints tell of what the sensor carries only, and
        nothing of friction and rotors.

        Raises:
            InputError: If friction grows with the load.
        """
        if setup.load_friction:
            raise InputError(
                "`load` in `[model]` must not be given with a force sensor: leave it "
                "out."
            )
        robot = self.on(setup.robot)
        terms = self.terms_on(setup)
        if columns.forces is None:
            terms = tuple(term for term in terms if term.body_parameters)
        if self.under_base:
            model = Model(robot, (*terms, SensorBias()))
            return dataclasses.replace(setup, unknowns=model)
        if columns.forces is None:
            terms = (SensorLoad(),)
        model = Model(robot, (*terms, SensorBias(), SensorRotation()))
        reading = dataclasses.replace(setup.reading, in_ground=self.in_ground)
        return dataclasses.replace(
            setup, unknowns=model, reading=reading, filter_candidates=()
        )


def parts_of(log: Observations) -> list[Observations]:
    """Return parts of a log in time, each long enough for a bias of its own."""
    count = int(min(MAX_PARTS, log.duration // PART_TIME))
    if count < 2:
        return [log]
    edges = np.linspace(0, log.rows, count + 1).round()
    part_of_row = np.searchsorted(edges, np.arange(log.rows), side="right") - 1
    parts = []
    for part in range(count):
        mask = np.asarray(log.mask) & (part_of_row == part)[:, None]
        parts.append(log.replace(mask=mask, name=f"{log.name}, part {part + 1}"))
    return parts


def with_drifting_bias(
    payload: Payload,
    unloaded: Fit | None,
    base: BaseParameters,
    loaded: Sequence[Observations],
    mass: float | None,
) -> Payload:
    """Return the payload of parts with biases of their own, if these are not equal.

    Args:
        payload: Payload of logs that have one bias.
        unloaded: Fit without the payload, if there is one.
        base: Base parameters of the runs with the payload.
        loaded: Logs with the payload.
        mass: Mass of the payload, if it is known [kg].
    """
    parts = [part for log in loaded for part in parts_of(log)]
    if len(parts) == 1:
        return payload
    fits = [identify(base, part) for part in parts]
    by_parts = identify_payload(unloaded, fits, mass=mass)
    return by_parts if by_parts.has_drifting_bias else payload
