"""The tables `[model]`, `[recording]`, `[filter]` and `[rows]` of an experiment file."""

import dataclasses
import inspect
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics import terms
from jaxid.errors import InputError
from jaxid.measurement import filters
from jaxid.measurement.columns import Columns
from jaxid.measurement.log_files import Selection
from jaxid.measurement.reading import MAX_BAD_ROWS
from jaxid.robot.limits_and_drives import per_joint
from jaxid.robot.robot import Robot
from jaxid.units import Unit

from .decoder import (
    Bounds,
    Count,
    Magnitude,
    OneOf,
    Positive,
    call,
    decode,
    decode_value,
    within,
)

FASTEST = 100.0
"""Speed that no joint exceeds [rad/s or m/s]."""
CUTOFF = 10.0
"""Cut-off of the filter where the file says nothing [Hz]."""

Side = Literal["joint", "motor"]


@dataclasses.dataclass(frozen=True)
class DryFriction:
    """Dry friction, and its transition from one direction of motion to the other.

    Attributes:
        epsilon: Speed of the smooth transition [rad/s or m/s]; or a list.
        dead_zone: Speed below which there is no dry friction [rad/s or m/s]; or a list.
        hard: Whether to take a sign instead of tanh(speed / epsilon).
        asymmetric: Whether each direction has a level of its own (then there is no
            `offset`).
        presliding: Whether friction has memory: it builds up along a path, whose length
            is found from the logs, and rest keeps it.
        stribeck: Speed about which friction falls from a static level [rad/s or m/s],
            like `0.1`; or a list.
    """

    epsilon: Positive | list[Positive] = 0.01
    dead_zone: Magnitude | list[Magnitude] = 0.0
    hard: bool = False
    asymmetric: bool = False
    presliding: bool = False
    stribeck: Positive | list[Positive] | None = None

    def transition(self, robot: Robot) -> terms.AbstractTransition:
        """Return the transition between the directions."""
        if self.presliding:
            steady = dataclasses.replace(self, presliding=False).transition(robot)
            A, coupled = (
                np.asarray(robot.drives.reduction),
                terms.CoupledDrives().couplings(robot),
            )
            motors = A / np.diag(A)[:, None] if coupled else None
            return terms.Presliding(steady=steady, motors=motors)
        dead_zone = _speed(robot, "coulomb.dead_zone", self.dead_zone)
        if self.hard:
            return terms.HardSign(dead_zone)
        return terms.Tanh(_speed(robot, "coulomb.epsilon", self.epsilon), dead_zone)

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
        speed = _speed(robot, "coulomb.stribeck", self.stribeck)
        return terms.StribeckFriction(speed=speed, transition=transition)


def _speed(
    robot: Robot, name: str, value: float | list[float]
) -> float | Float[np.ndarray, " joints"]:
    speeds = np.broadcast_to(np.asarray(value, np.float64), (robot.joints,))
    if isinstance(value, list):
        speeds = per_joint(name, value, robot.joints, 0.0)
    fastest = np.minimum(np.asarray(robot.limits.velocity), FASTEST)
    if (slow := np.flatnonzero(speeds > fastest)).size:
        j = int(slow[0])
        raise InputError(
            f"`{name}` must be below the largest speed of joint "
            f"`{robot.joint_names[j]}`, "
            f"{fastest[j]:g} {robot.joint_unit(j)}/s, but is {speeds[j]:g}."
        )
    return speeds if isinstance(value, list) else float(value)


SWITCHES = {name: term for name, term in terms.TERMS.items() if term.is_switch}
"""Terms that a key of `[model]` with their name adds, like `springs = true`."""


@dataclasses.dataclass(frozen=True)
class AbstractEffects:
    """Effects that the model has beside the rigid bodies.

    Attributes:
        principal_axes: Whether to leave out products of inertia (seven per body, Eq.
            12).
        viscous: Whether friction grows with speed; "asymmetric": at one rate for each
            direction.
        load: Whether dry friction grows with the weight on a joint, too; the bodies are
            those that are identified, until both agree.
        motor_ripple: Multiples of the motors' turns at which their torques ripple, like
            `[1, 2]`.
        joint_ripple: Multiples of the joints' turns at which forces ripple, like `[1]`.
        rotor_inertia: Whether the motors' rotors are felt through the gears.
        offset: Whether there is a constant force at each joint (sensor offsets); by
            default unless dry friction is asymmetric.
        coupled_drives: Whether motors turn several axes; by default where the matrix of
            `[drives]` has entries beside its diagonal.
        coulomb: Dry friction, as a table; or none, like `false`.
    """

    principal_axes: bool = False
    viscous: bool | Literal["asymmetric"] = True
    load: bool = False
    motor_ripple: tuple[Count, ...] = ()
    joint_ripple: tuple[Count, ...] = ()
    rotor_inertia: bool = True
    offset: bool | None = None
    coupled_drives: bool | None = None
    coulomb: bool | DryFriction | None = None

    def build(self, robot: Robot) -> tuple[terms.AbstractTerm, ...]:
        """Return the terms of the model, in the paper's order."""
        dry = self.coulomb if isinstance(self.coulomb, DryFriction) else DryFriction()
        # An offset is half of what two levels of dry friction can express already.
        offset = not dry.asymmetric if self.offset is None else self.offset
        coupled = self.coupled_drives
        if coupled is None:
            coupled = bool(terms.CoupledDrives().couplings(robot))
        viscous = self.viscous and terms.ViscousFriction()
        if self.viscous == "asymmetric":
            viscous = terms.AsymmetricViscousFriction()
        ripples = bool(self.motor_ripple or self.joint_ripple)
        transition = dry.transition(robot)
        chosen = {
            "bodies": terms.RigidBodies(principal_axes=self.principal_axes),
            "viscous": viscous,
            "coulomb": self.coulomb is not False and dry.term(robot),
            "rotor_inertia": self.rotor_inertia and terms.RotorInertia(),
            "ripple": ripples
            and terms.TorqueRipple(self.motor_ripple, self.joint_ripple),
            "offset": offset and terms.ConstantOffset(),
            "coupled_drives": coupled and terms.CoupledDrives(transition),
        }
        for name, switch in SWITCHES.items():
            chosen[name] = getattr(self, name) and switch.with_transition(transition)
        return tuple(chosen[name] for name in terms.TERMS if chosen.get(name))

    def load_transition(self, robot: Robot) -> terms.AbstractTransition | None:
        """Return the transition of friction by load; None without it.

        Raises:
            InputError: If the bodies that it needs are not complete.
        """
        if self.load and self.principal_axes:
            raise InputError(
                "`load` needs complete bodies: leave `principal_axes` out."
            )
        dry = self.coulomb if isinstance(self.coulomb, DryFriction) else DryFriction()
        return dry.transition(robot) if self.load else None

    def linear_terms(self, robot: Robot) -> tuple[terms.AbstractTerm, ...]:
        """Return the terms with Coulomb's law in place of Stribeck's."""
        if not isinstance(self.coulomb, DryFriction):
            return self.build(robot)
        coulomb = dataclasses.replace(self.coulomb, stribeck=None)
        return dataclasses.replace(self, coulomb=coulomb).build(robot)


Effects = dataclasses.make_dataclass(
    "Effects",
    [(name, bool, False) for name in SWITCHES],
    bases=(AbstractEffects,),
    frozen=True,
)
Effects.__doc__ = f"{inspect.getdoc(AbstractEffects)}\n" + "\n".join(
    f"    {name}: {(inspect.getdoc(term) or '').splitlines()[0]}"
    for name, term in SWITCHES.items()
)


@dataclasses.dataclass(frozen=True)
class Logs:
    """Sides, files and parts of the logs.

    Attributes:
        side: Side of the gears on which the log is: "joint" or "motor".
        forces_side: Side of the forces, if it is another one, like `"motor"`.
        forces_file: File of the forces, if they lie in another file beside the log,
            like `"{}_torque.csv"`: "{}" stands for the log's name without its suffix.
        velocities_file: File of the velocities, likewise, like `"{}_speed.csv"`.
        commands: Columns of the commanded angles, like `"cmd{}"`: with them `jaxid
            inspect` tells a delay in spite of disturbances, and `jaxid rollout` needs
            no `forces`.
        force_delay: Time by which forces stand later in the log than angles [s].
        largest_gap: Longest pause that is bridged, in sample times; a tenth of the
            period of the filter's cut-off frequency is bridged in any case.
        bad_rows: Fraction of the rows that may be bad, and are left out.
        start: Start of the part of every log that is used [s], like `0.0`; or a table
            with that of some logs, `{ "a.csv" = 1.5 }`.
        stop: End of that part [s], like `10.0`; or a table.
    """

    side: Side = "joint"
    forces_side: Side | None = None
    forces_file: str | None = None
    velocities_file: str | None = None
    commands: Selection | None = None
    force_delay: float = 0.0
    largest_gap: Annotated[float, Bounds(above=1.0)] = 1.75
    bad_rows: Annotated[float, Bounds(least=0.0, below=1.0)] = MAX_BAD_ROWS
    start: float | dict[str, float] = -np.inf
    stop: float | dict[str, float] = np.inf

    def part(self, log: Path) -> tuple[float, float]:
        """Return start and stop of the part of a log that is used [s]."""
        ends = (self.start, -np.inf), (self.stop, np.inf)
        start, stop = (
            x.get(log.name, own) if isinstance(x, dict) else x for x, own in ends
        )
        return start, stop

    def files(self, log: Path) -> dict[str, Any]:
        """Return the paths of the files beside a log, as the readers take them."""
        names = {
            "forces_path": self.forces_file,
            "velocities_path": self.velocities_file,
        }
        return {
            key: None if name is None else log.parent / name.replace("{}", log.stem)
            for key, name in names.items()
        }


SERVO_OPTIONS = ("stiffness", "time_step", "friction", "saturation", "integral")
"""Arguments of `identify_rollout` among the keys of `[rollout]`."""
SERVO_KEYS = (*SERVO_OPTIONS, "bodies", "samples")
"""Keys of `[rollout]` for logs of commands; the others are for logs of torques."""


@dataclasses.dataclass(frozen=True)
class Rollout:
    """Settings of `jaxid rollout`: for logs of commands, without torques, or for logs of torques.

    Attributes:
        bodies: Whether the bodies of the robot's file load the joints; by default if it
            has some.
        stiffness: Stiffness (proportional gain) of the servos if it is known [N m/rad
            or N/m], like `12.0`, or a list with `nan` where it is not; otherwise a
            known weight tells it.
        time_step: Longest step of the simulation [s].
        friction: Whether friction that grows with load or falls with speed is tried.
        saturation: Whether a largest torque of the servo is tried.
        integral: Whether integral action of the servos (PID instead of PD controllers)
            is tried.
        samples: Number of MJCF files drawn from the distribution of the estimates.
        horizon: With torques: length of the windows that are simulated [s].
        gains: With torques: whether gains of the other joints' torques, relative to the
            first joint's, are identified.
        load_friction: With torques: whether friction that grows with the torque is
            identified.
    """

    bodies: bool | None = None
    stiffness: Positive | list[float] | None = None
    time_step: Positive = 0.01
    friction: bool = True
    saturation: bool = True
    integral: bool = False
    samples: Annotated[int, Bounds(least=0, most=10_000)] = 0
    horizon: Positive = 0.2
    gains: bool = False
    load_friction: bool = False

    def options(self, torques: bool) -> dict[str, Any]:
        """Return the settings for logs of torques, or of commands.

        Raises:
            InputError: If a setting is given that is for logs of the other kind.
        """
        values = dataclasses.asdict(self)
        own = {key: x for key, x in values.items() if (key in SERVO_KEYS) != torques}
        for key in sorted(values.keys() - own.keys()):
            if values[key] != getattr(Rollout, key):
                kind = "commands" if torques else "forces` without `recording.commands"
                raise InputError(
                    f"`rollout.{key}` is for logs with `recording.{kind}`."
                )
        return own


SIDES = ("angles_on_motor_side", "forces_on_motor_side")
"""Arguments of `Columns` for which the file has `side` and `forces_side`."""


def build_columns(table: dict[str, Any], robot: Robot) -> tuple[Columns, Logs]:
    """Return the columns of the logs, and how logs are read."""
    table = {
        key: [value.replace("{name}", name) for name in robot.joint_names]
        if isinstance(value, str) and "{name}" in value
        else value
        for key, value in table.items()
    }
    if "commands" in table:
        # A robot that logs no torque.
        table.setdefault("forces", table["commands"])
    given, reading = decode([Columns, Logs], table, "recording", skip=SIDES)
    with within("recording"):
        logs = Logs(**reading)
        motors, motor_forces = (
            logs.side == "motor",
            (logs.forces_side or logs.side) == "motor",
        )
        columns = Columns(
            **given, **dict(zip(SIDES, (motors, motor_forces), strict=True))
        )
        still = np.zeros((1, robot.joints))
        columns.to_si(still, still, still)  # refuses lists that do not fit the robot
        checked = [] if motors else ["angle_unit", "velocity_unit"]
        for name in (*checked, *([] if motor_forces else ["force_unit"])):
            units = given.get(name, ())
            units = [units] * robot.joints if isinstance(units, Unit) else units
            for label, turns, one in zip(
                robot.joint_names, robot.revolute, units, strict=False
            ):
                foreign = (
                    ("mm", "mm/s", "N")
                    if turns
                    else ("deg", "rev", "deg/s", "rpm", "N m")
                )
                if one.symbol in foreign:
                    raise InputError(
                        f'`{name}` of joint `{label}` is "{one.symbol}", but the joint '
                        f"{'turns' if turns else 'slides'}: give a list of units."
                    )
    return columns, logs


def build_filters(
    table: dict[str, Any] | None,
) -> tuple[list[filters.AbstractFilter], list[str]]:
    """Return the filter, or several to choose from, and what is assumed without a table."""
    if table is None:
        note = (
            f"no table `[filter]`: a Butterworth low-pass at {CUTOFF:g} Hz is "
            "assumed; choose "
            "about five times the highest frequency of the motion."
        )
        return [filters.ZeroPhaseButterworth(CUTOFF)], [note]
    name = Annotated[str, OneOf(filters.FILTERS)]
    kind = decode_value(table.get("kind", ""), name, "filter.kind")
    keys = {name: value for name, value in table.items() if name != "kind"}
    tables = [keys]
    if isinstance(keys.get("cutoff"), list):
        tables = [{**keys, "cutoff": cutoff} for cutoff in keys["cutoff"]]
    if not tables:
        raise InputError("`filter.cutoff` must be a number, or a list to choose from.")
    return [call(filters.FILTERS[kind], one, "filter") for one in tables], []


def build_rows(
    robot: Robot,
    *,
    step: Count | None = None,
    factors: list[Count] | None = None,
    min_speed: Magnitude | list[Magnitude] | None = None,
) -> tuple[filters.AbstractDecimation, Float[np.ndarray, " joints"] | None]:
    """Rows of the least-squares problem, and samples that become rows.

    Args:
        robot: Robot with the joints.
        step: Number of samples from one row to the next, of signals below half of that
            rate.
        factors: Factors of stages that low-pass and decimate, instead of `step`, like
            `[10, 10]`: 13 at most.
        min_speed: Speed below which rows do not count [rad/s or m/s], like `0.05`; or a
            list.

    Raises:
        InputError: If two ways are asked for, or a factor is too large.
    """
    if step is not None and factors is not None:
        raise InputError(
            "give `step` or `factors`, which also low-pass filter, but not both."
        )
    speed = None
    if min_speed is not None:
        speed = (
            np.broadcast_to(_speed(robot, "min_speed", min_speed), (robot.joints,))
            + 0.0
        )
    if factors is not None:
        return filters.Decimation(tuple(factors)), speed
    return filters.Subsample(step or 1), speed
