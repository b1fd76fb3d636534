"""The tables `[model]`, `[recording]`, `[filter]` and `[rows]` become objects."""

import msgspec
import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.friction import StribeckFriction
from jaxid.dynamics.terms import (
    AbstractTerm,
    AsymmetricCoulombFriction,
    ConstantOffset,
    CoulombFriction,
    CoupledDrives,
    LinearSpring,
    RigidBodies,
    RotorInertia,
    ViscousFriction,
)
from jaxid.dynamics.transitions import AbstractTransition, HardSign, Tanh
from jaxid.errors import InputError
from jaxid.experiment.robot_tables import each
from jaxid.experiment.tables import (
    ButterworthTable,
    CoulombTable,
    ModelTable,
    PaperTable,
    PeriodicTable,
    RecordingTable,
    RowsTable,
)
from jaxid.identification.filter_choice import FilterCandidate
from jaxid.measurement.columns import Columns, Selection
from jaxid.measurement.decimation import AbstractDecimation, Decimation, Subsample
from jaxid.measurement.filters import (
    AbstractFilter,
    PaperFilter,
    PeriodicFourier,
    ZeroPhaseButterworth,
)
from jaxid.measurement.units import NM, Unit, unit
from jaxid.robot.robot import Robot

TURNS = ("deg", "rev", "deg/s", "rpm", "N m")
SLIDES = ("mm", "mm/s", "N")
CUTOFF = 10.0
"""Cut-off of the filter where the file says nothing [Hz]."""


def build_terms(table: ModelTable, robot: Robot) -> tuple[AbstractTerm, ...]:
    """The terms of the model, in the paper's order: bodies, friction, rotors, and the rest.

    Raises:
        InputError: If a list does not hold one number for each joint.
    """
    coulomb = CoulombTable() if isinstance(table.coulomb, bool) else table.coulomb
    transition = _transition(coulomb, robot)
    terms: list[AbstractTerm] = [RigidBodies(principal_axes=table.principal_axes)]
    if table.viscous:
        terms.append(ViscousFriction())
    if table.coulomb is not False:
        terms.append(_dry(coulomb, transition, robot))
    if table.rotor_inertia:
        terms.append(RotorInertia())
    # An offset is half of what two levels of dry friction can say already.
    if table.offset or (table.offset is None and not coulomb.asymmetric):
        terms.append(ConstantOffset())
    if table.coupled_drives or (table.coupled_drives is None and coupled(robot)):
        terms.append(CoupledDrives(transition))
    if table.springs:
        terms.append(LinearSpring())
    return tuple(terms)


def build_linear_terms(table: ModelTable, robot: Robot) -> tuple[AbstractTerm, ...]:
    """The terms of the same model with Coulomb's law in place of Stribeck's."""
    if isinstance(table.coulomb, CoulombTable):
        coulomb = msgspec.structs.replace(table.coulomb, stribeck=None)
        table = msgspec.structs.replace(table, coulomb=coulomb)
    return build_terms(table, robot)


def _dry(table: CoulombTable, transition: AbstractTransition, robot: Robot) -> AbstractTerm:
    if table.stribeck is None:
        dry = AsymmetricCoulombFriction if table.asymmetric else CoulombFriction
        return dry(transition)
    if table.asymmetric:
        raise InputError(
            "give `coulomb.stribeck` or `coulomb.asymmetric`, but not both: one level for each "
            "direction has no Stribeck effect here."
        )
    speed = _number_or_each(robot, "coulomb.stribeck", table.stribeck)
    return StribeckFriction(speed, transition=transition)


def coupled(robot: Robot) -> bool:
    """Whether some motor turns more than one axis."""
    return bool(CoupledDrives().couplings(robot))


def _transition(table: CoulombTable, robot: Robot) -> AbstractTransition:
    dead_zone = _number_or_each(robot, "coulomb.dead_zone", table.dead_zone)
    if table.hard:
        return HardSign(dead_zone)
    return Tanh(_number_or_each(robot, "coulomb.epsilon", table.epsilon), dead_zone)


def _number_or_each(
    robot: Robot, name: str, value: float | int | list
) -> float | Float[np.ndarray, " joints"]:
    if isinstance(value, list):
        return np.array(each(robot, name, value), np.float64)
    return float(value)


def build_columns(table: RecordingTable | None, robot: Robot) -> Columns | None:
    """What the columns of the logs hold.

    Raises:
        InputError: If a unit is unknown or does not fit its joint, a list has a wrong length, or
            the time is not given.
    """
    if table is None:
        return None
    if (table.time is None) == (table.sample_time is None):
        came = "it has neither" if table.time is None else "not both"
        raise InputError(
            "give `time` (the column of the time stamps) or `sample_time` [s] (rows equally far "
            f"apart): {came}."
        )
    for name in (
        "torque_constants",
        "angle_signs",
        "force_signs",
        "angle_offsets",
        "force_gains",
    ):
        each(robot, name, getattr(table, name))
    forces_side = table.side if table.forces_side is None else table.forces_side
    if table.side == "joint":
        _refuse_mixed(robot, "angle_unit", table.angle_unit)
        _refuse_mixed(robot, "velocity_unit", table.velocity_unit)
    if forces_side == "joint":
        _refuse_mixed(robot, "force_unit", table.force_unit)
    return Columns(
        _selection(robot, "angles", table.angles),
        _selection(robot, "forces", table.forces),
        None if table.velocities is None else _selection(robot, "velocities", table.velocities),
        time=table.time,
        sample_time=table.sample_time,
        time_unit=unit(table.time_unit),
        angle_unit=_units(robot, "angle_unit", table.angle_unit),
        velocity_unit=(
            None
            if table.velocity_unit is None
            else _units(robot, "velocity_unit", table.velocity_unit)
        ),
        force_unit=_units(robot, "force_unit", _force_unit(robot, table)),
        torque_constants=table.torque_constants,
        angle_signs=table.angle_signs,
        force_signs=table.force_signs,
        angle_offsets=table.angle_offsets,
        force_gains=table.force_gains,
        angles_on_motor_side=table.side == "motor",
        forces_on_motor_side=forces_side == "motor",
    )


def _selection(robot: Robot, name: str, value: str | int | list) -> Selection:
    return tuple(each(robot, name, value) or ()) if isinstance(value, list) else value


def _units(robot: Robot, name: str, value: str | list[str]) -> Unit | list[Unit]:
    if isinstance(value, str):
        return unit(value)
    return [unit(one) for one in each(robot, name, value) or []]


def _force_unit(robot: Robot, table: RecordingTable) -> str | list[str]:
    """As the file says; otherwise SI units, which are the same number for both kinds of joint."""
    return NM.symbol if table.force_unit is None else table.force_unit


def _refuse_mixed(robot: Robot, name: str, value: str | list[str] | None) -> None:
    """Refuses degrees or N m for a joint that slides, and millimetres or N for one that turns.

    Raises:
        InputError: If there is such a joint.
    """
    if value is None:
        return
    symbols = [value] * robot.joints if isinstance(value, str) else each(robot, name, value) or []
    for label, turns, symbol in zip(robot.joint_names, robot.revolute, symbols, strict=True):
        if symbol in (SLIDES if turns else TURNS):
            kinds = ("a torque", "a force") if "force" in name else ("an angle", "a length")
            raise InputError(
                f'`{name}` of joint `{label}` is "{symbol}", but the joint '
                f"{'turns' if turns else 'slides'}: give a list with one unit for each joint, of "
                f"{kinds[not turns]} for this one."
            )


def build_filter(
    table: ButterworthTable | PaperTable | PeriodicTable | None,
) -> tuple[AbstractFilter, list[str]]:
    """The filter, and what is assumed."""
    match table:
        case None:
            said = (
                f"no table `[filter]`: a Butterworth low-pass at {CUTOFF:g} Hz is assumed; choose "
                "about five times the highest frequency of the motion."
            )
            return ZeroPhaseButterworth(CUTOFF), [said]
        case ButterworthTable():
            return _butterworth(table)[0], []
        case PaperTable():
            return PaperFilter(table.velocity, table.acceleration, table.margin), []
        case PeriodicTable():
            return PeriodicFourier(
                table.period, table.harmonics, table.force_harmonics, table.order, table.margin
            ), []


def _butterworth(table: ButterworthTable) -> list[ZeroPhaseButterworth]:
    """One filter, or one for each cut-off of a list."""
    cutoffs = table.cutoff if isinstance(table.cutoff, list) else [table.cutoff]
    if not cutoffs:
        raise InputError("`cutoff` must be a number, or a list to choose from, but is empty.")
    return [ZeroPhaseButterworth(f, table.order, table.force_cutoff, table.margin) for f in cutoffs]


def build_candidates(
    table: ButterworthTable | PaperTable | PeriodicTable | None, rows: RowsTable
) -> tuple[FilterCandidate, ...]:
    """The filters to choose from, where the file lists cut-offs; none where it names one."""
    if not isinstance(table, ButterworthTable) or not isinstance(table.cutoff, list):
        return ()
    decimation = build_decimation(rows)
    return tuple(FilterCandidate(filter, decimation) for filter in _butterworth(table))


def build_decimation(table: RowsTable) -> AbstractDecimation:
    """Which samples become rows.

    Raises:
        InputError: If two ways are asked for, or a factor is too large.
    """
    if table.every is not None and table.factors is not None:
        raise InputError(
            "give `every` (takes every n-th sample) or `factors` (low-pass filters before every "
            "stage), but not both."
        )
    if table.factors is not None:
        return Decimation(tuple(table.factors))
    return Subsample(1 if table.every is None else table.every)


def build_slow(table: RowsTable, robot: Robot) -> Float[np.ndarray, " joints"] | None:
    """Speeds below which rows do not count [rad/s or m/s].

    Raises:
        InputError: If there is not one number for each joint.
    """
    if table.slow is None:
        return None
    return np.broadcast_to(_number_or_each(robot, "slow", table.slow), (robot.joints,)) + 0.0
