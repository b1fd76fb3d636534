"""Tables `[model]`, `[recording]`, `[filter]`, `[rows]` and `[estimator]` of a file.

They say how logs become parameters: a `Setup` is built from them.
"""

import dataclasses
import inspect
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxid.arrays import Float, Texts, Vector
from jaxid.dynamics import terms
from jaxid.dynamics.model import Model
from jaxid.errors import InputError
from jaxid.experiment_file import KEYS, within
from jaxid.experiment_values import TomlTable, decode_value, quoted
from jaxid.identification import estimators
from jaxid.identification.consistency import BodyBounds
from jaxid.identification.estimators_by_name import ESTIMATORS
from jaxid.identification.filter_selection import USUAL_CUTOFFS
from jaxid.identification.uncertainty import UNCERTAINTIES, AbstractUncertainty
from jaxid.measurement import filters
from jaxid.measurement.columns import (
    JOINT_CHANNELS,
    Columns,
    with_lerobot_calibration,
)
from jaxid.measurement.log_columns import Selection
from jaxid.robot.limits_and_drives import per_joint
from jaxid.robot.robot import Robot
from jaxid.robot.virtual_joints import on_all_joints
from jaxid.units import Unit
from jaxid.workflow.robot_file import RobotFile
from jaxid.workflow.setup import LogReading, Setup, pull_to_bodies

from .decoder import call, decode, keys_of

MAX_SPEED = 100.0
"""Speed that no joint exceeds [rad/s or m/s]."""
LENGTH_UNITS = ("mm", "mm/s", "N")
ANGLE_UNITS = ("deg", "rev", "deg/s", "rpm", "N m")

Side = Literal["joint", "motor"]


@dataclasses.dataclass(frozen=True)
class DryFriction:
    """Dry friction, and its transition from one direction of motion to the other.

    Attributes:
        epsilon: Speed of the smooth transition [rad/s or m/s], like `0.01`; or a list;
            by default it is found from the logs, for each joint.
        hard: Whether to use a sign function instead of tanh(speed / epsilon).
        asymmetric: Whether friction has its own level in each direction (then there is
            no `offset`).
        presliding: Whether friction has memory: it builds up over a distance, which is
            found from the logs, and remains at rest.
        stribeck: Speed around which friction falls from its static level [rad/s or
            m/s], like `0.1`; or a list.
    """

    epsilon: float | list[float] | None = None
    hard: bool = False
    asymmetric: bool = False
    presliding: bool = False
    stribeck: float | list[float] | None = None

    def transition(self, robot: Robot) -> terms.AbstractTransition:
        """Return the transition between the directions."""
        if self.presliding:
            steady_friction = dataclasses.replace(self, presliding=False)
            steady_transition = steady_friction.transition(robot)
            motors = None
            if terms.CoupledDrives().couplings(robot):
                ratios = robot.drives.reduction
                motors = ratios / np.diag(ratios)[:, None]
            return terms.Presliding(steady=steady_transition, motors=motors)
        if self.hard:
            return terms.HardSign()
        if self.epsilon is None:
            return terms.Tanh()
        return terms.Tanh(_speed_of_term(robot, "coulomb.epsilon", self.epsilon))

    def term(self, robot: Robot) -> terms.AbstractTerm:
        """Return the term of the model."""
        transition = self.transition(robot)
        if self.stribeck is None:
            kind = (
                terms.AsymmetricCoulombFriction
                if self.asymmetric
                else terms.CoulombFriction
            )
            return kind(transition)
        if self.asymmetric:
            raise InputError(
                "give `coulomb.stribeck` or `coulomb.asymmetric`, but not both."
            )
        speed = _speed_of_term(robot, "coulomb.stribeck", self.stribeck)
        return terms.StribeckFriction(speed=speed, transition=transition)


def _speeds(robot: Robot, name: str, value: float | list[float]) -> Vector:
    """Return a speed of each driven joint, within what the joints reach."""
    joints = robot.driven
    if isinstance(value, list):
        speeds = per_joint(name, value, len(joints), 0.0)
    else:
        speeds = np.full(len(joints), float(value))
    max_speeds = np.minimum(robot.limits.velocity, MAX_SPEED)
    for j, speed in zip(joints, speeds, strict=True):
        if speed > max_speeds[j]:
            raise InputError(
                f"`{name}` must be below the largest speed of joint "
                f"`{robot.joint_names[j]}`, {max_speeds[j]:g} {robot.joint_unit(j)}/s, "
                f"but is {speed:g}."
            )
    return speeds


def _speed_of_term(
    robot: Robot, name: str, value: float | list[float]
) -> float | Float[np.ndarray, " joints"]:
    """Return a speed of all joints, or of each of them."""
    speeds = _speeds(robot, name, value)
    if not isinstance(value, list):
        return float(value)
    # Virtual joints have no friction, whatever their speed is.
    return on_all_joints(robot, speeds, 1.0)


SWITCHES = {name: term for name, term in terms.TERMS.items() if term.is_switch}
"""Terms that a field of `Effects` with their name adds, like `springs`."""


@dataclasses.dataclass(frozen=True)
class Effects:
    """Effects in the model in addition to rigid bodies.

    Attributes:
        principal_axes: Whether to leave out products of inertia (seven per body, Eq.
            12).
        viscous: Whether friction grows with speed; "asymmetric": with another rate in
            each direction.
        load: Whether dry friction also grows with the load on a joint; the load comes
            from the identified bodies, and the fit is repeated until both agree.
        motor_ripple: Multiples of the motors' turns at which their torques ripple, like
            `[1, 2]`.
        joint_ripple: Multiples of the joints' turns at which forces ripple, like `[1]`.
        rotor_inertia: Whether the inertia of the motors' rotors acts through the gears.
        offset: Whether there is a constant force at each joint (sensor offsets); by
            default unless dry friction is asymmetric.
        coulomb: Dry friction, as a table; or none, like `false`.
        square_root: Friction that grows more slowly than speed.
        springs: A spring at each joint that pulls it to a position of rest.
        passive_friction: Friction of the joints that closed loops move.
    """

    principal_axes: bool = False
    viscous: bool | Literal["asymmetric"] = True
    load: bool = False
    motor_ripple: tuple[int, ...] = ()
    joint_ripple: tuple[int, ...] = ()
    rotor_inertia: bool = True
    offset: bool | None = None
    coulomb: bool | DryFriction | None = None
    square_root: bool = False
    springs: bool = False
    passive_friction: bool = False

    def __post_init__(self) -> None:
        if self.load and self.principal_axes:
            raise InputError(
                "`load` needs complete bodies: leave `principal_axes` out."
            )

    def build(self, robot: Robot) -> tuple[terms.AbstractTerm, ...]:
        """Return the terms of the model, in the paper's order."""
        dry_friction = DryFriction()
        if isinstance(self.coulomb, DryFriction):
            dry_friction = self.coulomb
        transition = dry_friction.transition(robot)
        effects: dict[str, terms.AbstractTerm] = {
            "bodies": terms.RigidBodies(principal_axes=self.principal_axes)
        }
        if self.viscous == "asymmetric":
            effects["viscous"] = terms.AsymmetricViscousFriction()
        elif self.viscous:
            effects["viscous"] = terms.ViscousFriction()
        if self.coulomb is not False:
            effects["coulomb"] = dry_friction.term(robot)
        if self.rotor_inertia:
            effects["rotor_inertia"] = terms.RotorInertia()
        if self.motor_ripple or self.joint_ripple:
            ripple = terms.TorqueRipple(self.motor_ripple, self.joint_ripple)
            effects["ripple"] = ripple
        # An offset is half of what two levels of dry friction can express already.
        has_offset = not dry_friction.asymmetric if self.offset is None else self.offset
        if has_offset:
            effects["offset"] = terms.ConstantOffset()
        if terms.CoupledDrives().couplings(robot):
            effects["coupled_drives"] = terms.CoupledDrives(transition)
        for name, switch in SWITCHES.items():
            if getattr(self, name):
                effects[name] = switch.with_transition(transition)
        return tuple(effects[name] for name in terms.TERMS if name in effects)


@dataclasses.dataclass(frozen=True)
class Sides:
    """Sides of the gears on which the logs are.

    Attributes:
        side: Side of the gears on which the log was recorded: "joint" or "motor".
        forces_side: Side of the forces, if it differs from `side`, like `"motor"`.
    """

    side: Side = "joint"
    forces_side: Side | None = None

    @property
    def of_columns(self) -> TomlTable:
        """Sides as arguments of `Columns`."""
        forces_side = self.forces_side or self.side
        return {
            "angles_on_motor_side": self.side == "motor",
            "forces_on_motor_side": forces_side == "motor",
        }


def build_columns(
    table: TomlTable, robot: Robot, folder: Path, wrench: Selection | None = None
):
    """Return the columns of the logs, and how logs are read.

    With the columns of a `wrench`, forces of the joints may be missing.
    """
    table = {key: with_joint_names(value, robot) for key, value in table.items()}
    arguments, sides, reading = decode([Columns, Sides, LogReading], table, "recording")
    if "forces" not in arguments:
        if wrench is None and "commands" not in arguments:
            raise InputError("`recording.forces` is missing: `[recording]` needs it.")
        arguments["wrench"] = wrench
    with within("recording"):
        if "lerobot_calibration" in reading:
            path = folder / reading["lerobot_calibration"]
            arguments = with_lerobot_calibration(arguments, path, robot.joint_names)
        columns = Columns(
            **arguments, **Sides(**sides).of_columns, joint_names=robot.joint_names
        )
        zeros = np.zeros((1, robot.joints))
        # Refuses lists that do not fit the robot.
        columns.to_si(dict.fromkeys(JOINT_CHANNELS, zeros))
        require_fitting_units(columns, robot, arguments)
        return columns, LogReading(**reading)


def with_joint_names(value: Any, robot: Robot) -> Any:
    """Return a pattern of columns with "{name}" as names; other values as they are."""
    if isinstance(value, str) and "{name}" in value:
        return [value.replace("{name}", name) for name in robot.joint_names]
    return value


def require_fitting_units(columns: Columns, robot: Robot, arguments: TomlTable) -> None:
    """Reject units of length for joints that turn, of angle for those that slide."""
    names = []
    if not columns.angles_on_motor_side:
        names += ["angle_unit", "velocity_unit"]
    if not columns.forces_on_motor_side:
        names.append("force_unit")
    for name in names:
        units = getattr(columns, name) if name in arguments else ()
        if isinstance(units, Unit):
            units = [units] * robot.joints
        for joint, is_revolute, unit in zip(
            robot.joint_names, robot.revolute, units, strict=False
        ):
            foreign_units = LENGTH_UNITS if is_revolute else ANGLE_UNITS
            if unit.symbol in foreign_units:
                motion = "turns" if is_revolute else "slides"
                raise InputError(
                    f'`{name}` of joint `{joint}` is "{unit.symbol}", but the joint '
                    f"{motion}: give a list of units."
                )


def build_filters(table: TomlTable) -> list[filters.AbstractFilter]:
    """Return the filter, or several to choose from."""
    kind = decode_value(table.get("kind", ""), KEYS["filter"]["kind"], "filter.kind")
    build = filters.FILTERS[kind]
    keys = {name: value for name, value in table.items() if name != "kind"}
    usual_cutoffs = list(USUAL_CUTOFFS) if kind == "butterworth" else None
    cutoffs = keys.get("cutoff", usual_cutoffs)
    if not isinstance(cutoffs, list):
        return [call(build, keys, "filter")]
    if not cutoffs:
        raise InputError("`filter.cutoff` must be a number, or a list to choose from.")
    tables = [{**keys, "cutoff": cutoff} for cutoff in cutoffs]
    return [call(build, keys, "filter") for keys in tables]


def build_rows(
    robot: Robot,
    *,
    step: int = 1,
    min_speed: float | list[float] | None = None,
) -> tuple[filters.Subsample, Vector | None]:
    """Rows of the least-squares problem, and samples that become rows.

    Args:
        robot: Robot with the joints.
        step: Number of samples from one row to the next; the filter must remove
            frequencies above half of the resulting rate.
        min_speed: Speed below which rows do not count [rad/s or m/s], like `0.05`; or a
            list.
    """
    speeds = None
    if min_speed is not None:
        speeds = _speeds(robot, "min_speed", min_speed)
    return filters.Subsample(step), speeds


KEYS_OF_ROWS = ("weights", "ridge")
# Instrumental variables need a motion, which a file cannot hold.
KINDS: dict[str, Texts] = {
    "weighted": KEYS_OF_ROWS,
    "least_squares": ("ridge",),
    "huber": KEYS_OF_ROWS,
    "tukey": KEYS_OF_ROWS,
    "consistent": ("weights", "pull", *keys_of(BodyBounds)),
}
"""Keys of each kind of estimator; others are for all kinds."""


class Estimation(NamedTuple):
    """Choice of how rows become parameters."""

    estimator: estimators.AbstractEstimator  # estimator of the file
    # least squares with the same weights and solution
    least_squares: estimators.LeastSquares | estimators.WeightedLeastSquares
    uncertainty: AbstractUncertainty  # method of the standard deviations


def decode_estimator(table: TomlTable) -> tuple[TomlTable, TomlTable]:
    """Return the arguments of `build_estimation`, and the bounds of bodies.

    Raises:
        InputError: If a key is wrong, belongs to another kind, or does not go with
            another one.
    """
    arguments, bounds = decode(
        [build_estimation, BodyBounds], table, "estimator", complete=False
    )
    weighted_keys = set(KINDS["weighted"]) - set(KINDS["consistent"])
    if weighted_keys & arguments.keys():
        arguments.setdefault("kind", "weighted")
    kind = arguments.get("kind", "consistent")
    for name in (*arguments, *bounds):
        owners = [owner for owner, keys in KINDS.items() if name in keys]
        if owners and kind not in owners:
            raise InputError(
                f"`estimator.{name}`: belongs to `kind = {quoted(owners)}`."
            )
    return arguments, bounds


def build_estimation(
    robot: Robot,
    robot_file: RobotFile | None,
    bounds: TomlTable,
    *,
    kind: str = "consistent",
    weights: Literal["maximum_forces", "residual_variances"] | None = None,
    ridge: float | Literal["cross_validated"] | None = None,
    uncertainty: str = "spectral",
    pull: float | None = None,
) -> Estimation:
    """Estimator of the parameters from the rows, and of their standard deviations.

    Args:
        robot: The robot.
        robot_file: File of the robot, whose bodies are the prior of consistent ones.
        bounds: Bounds of bodies, in place of those from the robot's geometry.
        kind: "consistent": weighted least squares over physically possible bodies;
            "weighted": without that condition; "least_squares": every newton metre
            counts the same; "huber", "tukey": rows that the model cannot explain count
            less, or not at all. By default, the kind that the other keys belong to.
        weights: Weights of the joints: "maximum_forces" (Eq. 30), the default where
            they are known; or "residual_variances": from the errors of the model.
        ridge: Strength of a pull of undetermined combinations towards zero, relative to
            the best-determined one, like `"cross_validated"`: as much as predicts
            left-out parts of the logs best; or a number like 0.01.
        uncertainty: Method of the standard deviations: "spectral"; "jackknife": from
            blocks of time left out in turn; "independent": as if rows were independent
            (far too small).
        pull: Strength of a pull towards the bodies of the robot's file, or towards
            balls if those are impossible ("consistent"), like `1.0`; 0 for none. By
            default, the strength that predicts left-out parts of the logs best.

    Raises:
        InputError: If keys do not go together, or a file cannot be read.
    """
    joint_weights = estimators.MaximumForces()
    if weights == "residual_variances" or kind == "least_squares":
        joint_weights = estimators.ResidualVariances()
    elif weights == "maximum_forces":
        with within('weights = "maximum_forces"'):
            _ = robot.max_forces
    solution = build_solution(ridge)
    least_squares = estimators.WeightedLeastSquares(joint_weights, solution)
    settings: TomlTable = {"weights": joint_weights, "solution": solution}
    if kind == "least_squares":
        least_squares = estimators.LeastSquares(solution)
    if kind == "consistent":
        if bounds:
            settings["bounds"] = BodyBounds.from_geometry(robot).replace(**bounds)
        settings["pull"] = pull_to_bodies(robot_file, pull)
    build = ESTIMATORS[kind]
    names = inspect.signature(build).parameters.keys() & settings.keys()
    estimator = build(**{name: settings[name] for name in names})
    return Estimation(estimator, least_squares, UNCERTAINTIES[uncertainty]())


def build_solution(
    ridge: float | Literal["cross_validated"] | None,
) -> estimators.AbstractSolution:
    """Return how undetermined combinations are treated."""
    if ridge == "cross_validated":
        return estimators.CrossValidated()
    if ridge is not None:
        return estimators.Ridge(ridge)
    return estimators.Complete()


def build_setup(
    tables: TomlTable,
    robot: Robot,
    robot_file: RobotFile | None,
    reading: LogReading,
) -> Setup:
    """Return how logs become parameters."""
    effects = call(Effects, tables.get("model", {}), "model")
    with within("model"):
        model = Model(robot, effects.build(robot))
    filters = {}
    if "filter" in tables:
        first_filter, *other_filters = build_filters(tables["filter"])
        filters["filter"] = first_filter
        if other_filters:
            filters["filter_candidates"] = (first_filter, *other_filters)
    decimation, min_speed = call(build_rows, tables.get("rows", {}), "rows", robot)
    arguments, bounds = decode_estimator(tables.get("estimator", {}))
    with within("estimator"):
        estimation = build_estimation(robot, robot_file, bounds, **arguments)
    return Setup(
        model,
        decimation=decimation,
        min_speed=min_speed,
        load_friction=effects.load,
        robot_file=robot_file,
        reading=reading,
        **filters,
        **estimation._asdict(),
    )
