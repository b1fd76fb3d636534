"""What an experiment file may hold: its tables, their keys and the types of their values."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

Positive = Annotated[float, Meta(gt=0)]
Magnitude = Annotated[float, Meta(ge=0)]
Count = Annotated[int, Meta(ge=1, le=10_000)]
Share = Annotated[float, Meta(gt=0, lt=1)]
Sign = Literal[1, -1]
Side = Literal["joint", "motor"]
AngleUnit = Literal["rad", "deg"]
Vector = tuple[float, float, float]
PerJoint = list[float]
Column = str | int
Group = str | list[Column]


class _Table(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table whose misspelt keys are refused."""


class DhRow(_Table, frozen=True):
    """One joint of a Denavit-Hartenberg table: angles in degrees, lengths in metres."""

    alpha: float
    a: float
    d: float
    theta: float = 0.0
    slides: bool = False
    name: str | None = None


class InertiaTable(_Table, frozen=True):
    """Inertia tensor about the centre of mass [kg m²], with the signs of a URDF file."""

    xx: Magnitude
    yy: Magnitude
    zz: Magnitude
    xy: float = 0.0
    xz: float = 0.0
    yz: float = 0.0


class ToolTable(_Table, frozen=True):
    """A known load: as `[robot.tool]` it is subtracted; `[load]` is on the robot in some logs."""

    mass: Positive
    centre_of_mass: Vector
    inertia: InertiaTable | None = None
    body: str | None = None


class RobotTable(_Table, frozen=True):
    """Where the robot comes from, and how it stands."""

    urdf: str | None = None
    builtin: str | None = None
    dh: list[DhRow] | None = None
    convention: Literal["modified", "standard"] | None = None
    name: str | None = None
    tip: str | None = None
    base: str | None = None
    gravity: Vector | None = None
    base_rotation: Vector | None = None
    base_position: Vector | None = None
    snap_tolerance: Magnitude | None = None
    tool: ToolTable | None = None


class LimitsTable(_Table, frozen=True):
    """Limits that replace those of the robot's source."""

    angle_unit: AngleUnit = "rad"
    position_min: PerJoint | None = None
    position_max: PerJoint | None = None
    velocity: PerJoint | None = None
    acceleration: PerJoint | None = None
    jerk: PerJoint | None = None
    force: PerJoint | None = None


class DrivesTable(_Table, frozen=True):
    """Motors and gears that replace those of the robot's source."""

    gear_ratios: PerJoint | None = None
    matrix: list[PerJoint] | None = None
    angle_unit: AngleUnit = "rad"
    zero: PerJoint | None = None
    max_torques: list[Positive] | None = None
    rotor_inertia: list[Magnitude] | None = None


class CapsuleTable(_Table, frozen=True):
    """A capsule on the body that a joint moves, or on the ground; a sphere without `end`."""

    name: str
    body: str
    start: Vector
    radius: Positive
    end: Vector | None = None


class BoxTable(_Table, frozen=True):
    """A box in the world: angles in degrees, lengths in metres."""

    name: str
    centre: Vector
    size: Vector
    rotation: Vector | None = None


class CollisionTable(_Table, frozen=True):
    """What may not touch: shapes of the file, of the URDF or of the library."""

    distance: Positive = 0.03
    fit: bool = False
    packages: str | None = None
    ground: float | None = None
    capsules: list[CapsuleTable] = []
    boxes: list[BoxTable] = []
    pairs: list[tuple[str, str]] | None = None


class CoulombTable(_Table, frozen=True):
    """How dry friction passes from one direction of motion to the other."""

    epsilon: Positive | list[Positive] = 0.01
    dead_zone: Magnitude | list[Magnitude] = 0.0
    hard: bool = False
    asymmetric: bool = False
    stribeck: Positive | list[Positive] | None = None


class ModelTable(_Table, frozen=True):
    """Which effects the model has."""

    principal_axes: bool = False
    rotor_inertia: bool = True
    viscous: bool = True
    coulomb: bool | CoulombTable = True
    offset: bool | None = None
    coupled_drives: bool | None = None
    springs: bool = False


class RecordingTable(_Table, frozen=True):
    """Which columns of a log hold what, and in which units."""

    angles: Group | int
    forces: Group | int
    velocities: Group | int | None = None
    time: Column | None = None
    sample_time: Positive | None = None
    time_unit: str = "s"
    angle_unit: str | list[str] = "rad"
    velocity_unit: str | list[str] | None = None
    force_unit: str | list[str] | None = None
    torque_constants: PerJoint | None = None
    angle_signs: list[Sign] | None = None
    force_signs: list[Sign] | None = None
    angle_offsets: PerJoint | None = None
    force_gains: list[Positive] | None = None
    force_delay: float = 0.0
    side: Side = "joint"
    forces_side: Side | None = None
    forces_file: str | None = None
    velocities_file: str | None = None
    largest_gap: Annotated[float, Meta(gt=1)] = 1.75
    start: float | None = None
    stop: float | None = None


class ButterworthTable(_Table, frozen=True, tag="butterworth", tag_field="kind"):
    """A Butterworth low-pass without phase, then differences."""

    cutoff: Positive | list[Positive]
    order: Count = 4
    force_cutoff: Positive | None = None
    margin: Magnitude | None = None


class PaperTable(_Table, frozen=True, tag="paper", tag_field="kind"):
    """The differentiating filter of first order (Eq. 25)."""

    velocity: Positive = 1200.0
    acceleration: Positive = 100.0
    margin: Magnitude | None = None


class PeriodicTable(_Table, frozen=True, tag="periodic", tag_field="kind"):
    """A Fourier series for periodic motions."""

    period: Positive
    harmonics: Count
    force_harmonics: Positive | None = None
    order: Count = 4
    margin: Magnitude | None = None


class RowsTable(_Table, frozen=True):
    """Which samples become rows of the least-squares problem."""

    every: Count | None = None
    factors: list[Count] | None = None
    slow: Magnitude | list[Magnitude] | None = None


class EstimatorTable(_Table, frozen=True):
    """How the rows become parameters."""

    kind: Literal[
        "weighted",
        "least_squares",
        "huber",
        "tukey",
        "correlated",
        "instrumental",
        "consistent",
        "stepwise",
    ] = "weighted"
    weights: Literal["maximum_forces", "residual_variances"] | None = None
    truncate: Share | None = None
    ridge: Share | Literal["cross_validated"] | None = None
    nonlinear_friction: bool = False
    single_axes: list[str] | None = None
    prior: Literal["urdf"] | None = None
    limit: Positive | None = None
    reference: str | list[str] | None = None
    reference_start: float | list[float] | None = None
    margin: Share | None = None
    pull: Positive | None = None
    mass_min: Magnitude | list[Magnitude] | None = None
    mass_max: Positive | list[Positive] | None = None
    radius: Positive | list[Positive] | None = None
    centre_min: list[float | list[float]] | None = None
    centre_max: list[float | list[float]] | None = None
    ellipsoid_centre: list[float | list[float]] | None = None
    ellipsoid_axes: list[float | list[float]] | None = None
    total_mass: Positive | None = None
    essential: Annotated[float, Meta(ge=0, lt=1)] | None = None
    uncertainty: Literal["spectral", "jackknife", "independent"] = "spectral"


class SplineTable(_Table, frozen=True):
    """A spline from standstill to standstill, in place of a Fourier series."""

    points: Annotated[int, Meta(ge=4, le=100)] = 12
    duration: Annotated[float, Meta(gt=0, le=10_000)] = 8.0


class LeadsTable(_Table, frozen=True):
    """How the robot gets from standstill into a periodic motion, and out of it."""

    time: Positive | None = None
    periods: Annotated[int, Meta(ge=1, le=1000)] = 1


class ExcitationTable(_Table, frozen=True):
    """The motion to design."""

    criterion: Literal[
        "d_optimal",
        "a_optimal",
        "e_optimal",
        "condition_number",
        "weighted_condition_number",
        "scaled_condition_number",
    ] = "d_optimal"
    harmonics: Annotated[int, Meta(ge=1, le=50)] | None = None
    omega: Annotated[float, Meta(gt=0, le=1000)] | None = None
    rest: bool = False
    spline: SplineTable | None = None
    samples: Annotated[int, Meta(ge=2, le=10_000_000)] = 800
    noise: list[Annotated[float, Meta(gt=0, lt=1e9)]] | None = None
    starts: Count = 32
    generations: Annotated[int, Meta(ge=0, le=10_000)] = 12
    polish: Annotated[int, Meta(ge=0, le=10_000)] = 4
    seed: Annotated[int, Meta(ge=0, le=2**32 - 1)] = 0
    leads: bool | LeadsTable = True
    sample_time: Annotated[float, Meta(ge=1e-5)] | None = None
    ros: Literal["yaml", "json"] = "yaml"
    nominal: str | None = None
    earlier: list[str] = []
    force_margin: Annotated[float, Meta(ge=0, lt=1)] | None = None
    tip_speed: Positive | None = None
    tip_acceleration: Positive | None = None
    workspace: tuple[Vector, Vector] | None = None

    @property
    def series(self) -> tuple[int, float]:
        """Number of harmonics, and ground frequency [rad/s]."""
        return (
            5 if self.harmonics is None else self.harmonics,
            0.8 if self.omega is None else self.omega,
        )

    @property
    def led(self) -> LeadsTable | None:
        """How the robot gets into the motion; None if it starts as it is."""
        if not self.leads or self.rest or self.spline is not None:
            return None
        return self.leads if isinstance(self.leads, LeadsTable) else LeadsTable()

    @property
    def idle(self) -> list[str]:
        """Keys that were given although others leave them nothing to do, in sentences."""
        said = []
        if self.spline is not None:
            given = [f"`{k}`" for k in ("harmonics", "omega") if getattr(self, k) is not None]
            if given:
                verb = "do" if len(given) > 1 else "does"
                said.append(f"{' and '.join(given)} {verb} nothing for a `spline`")
        if isinstance(self.leads, LeadsTable) and self.led is None:
            said.append("`leads` do nothing for a motion that rests at its ends")
        return said


class Tables(_Table, frozen=True):
    """The whole file."""

    robot: RobotTable
    limits: LimitsTable | None = None
    drives: DrivesTable | None = None
    collision: CollisionTable | None = None
    model: ModelTable = ModelTable()
    recording: RecordingTable | None = None
    load: ToolTable | None = None
    filter: ButterworthTable | PaperTable | PeriodicTable | None = None
    rows: RowsTable = RowsTable()
    estimator: EstimatorTable = EstimatorTable()
    excitation: ExcitationTable = ExcitationTable()


FILTERS = {
    "butterworth": ButterworthTable,
    "paper": PaperTable,
    "periodic": PeriodicTable,
}
