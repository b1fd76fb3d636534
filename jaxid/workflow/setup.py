"""Setup of an identification: how logs of a robot become parameters."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from jaxid.arrays import AnyArray, Float, Texts
from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    AbstractTerm,
    AbstractTransition,
    ConstantOffset,
    CoupledDrives,
    LoadFriction,
    Tanh,
)
from jaxid.dynamics.terms.friction import AbstractDryFriction
from jaxid.identification.consistency import (
    EntropicPull,
    PhysicallyConsistent,
)
from jaxid.identification.estimators import (
    AbstractEstimator,
    LeastSquares,
    MaximumForces,
    WeightedLeastSquares,
)
from jaxid.identification.filter_selection import USUAL_FILTERS
from jaxid.identification.fit_result import Fit
from jaxid.identification.friction_laws import (
    identify_presliding,
    identify_transition_speeds,
)
from jaxid.identification.friction_laws.presliding_lengths import presliding_note
from jaxid.identification.friction_laws.transition_speeds import transition_note
from jaxid.identification.identify import fit_problem
from jaxid.identification.problem import RegressionProblem
from jaxid.identification.uncertainty import AbstractUncertainty, SpectralSandwich
from jaxid.measurement.filters import (
    AbstractFilter,
    Subsample,
)
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.reading import MAX_BAD_ROWS
from jaxid.measurement.recording import Recording
from jaxid.robot.inertia import INERTIAL_NAMES
from jaxid.robot.robot import Robot

from .robot_file import RobotFile

MAX_LOAD_FRICTION_FITS = 10
"""Fits after which friction by load must have settled."""
LOAD_FRICTION_TOLERANCE = 1e-3
"""Relative change of the friction by load, from fit to fit, that counts as none."""

Paths = Sequence[str | Path]
"""Paths of logs."""
Unknowns = BaseParameters | Model
"""Parameters that are to be identified, or their model."""
Progress = Callable[[str, float], None]
"""Callback, called with the name of a stage and its completed fraction (0 to 1)."""


def ignore_progress(stage: str, fraction: float) -> None:
    """Show no progress."""


def default_terms(robot: Robot) -> tuple[AbstractTerm, ...]:
    """Return the effects in the model of an experiment file without `[model]`.

    They are those of `Model(robot)`, a constant offset of each joint, and the friction
    and rotors of motors that move two joints.
    """
    terms = (*Model(robot).terms, ConstantOffset())
    coupled_drives = CoupledDrives()
    return (*terms, coupled_drives) if coupled_drives.couplings(robot) else terms


def as_unknowns(source: Unknowns | Robot) -> Unknowns:
    """Return base parameters or a model as they are; the default model of a robot."""
    if isinstance(source, Robot):
        return Model(source, default_terms(source))
    return source


@dataclasses.dataclass(frozen=True)
class LogReading:
    """Files and parts of the logs, and how they are read.

    Attributes:
        forces_file: File of the forces, if they are in another file in the folder of
            the log, like `"{}_torque.csv"`: "{}" is replaced by the log's name without
            its suffix.
        lerobot_calibration: Calibration file of LeRobot for `angle_unit = "%"`, like
            `"my_arm.json"`: angles count from the middle of each calibrated range.
        force_delay: Time by which the forces in the log are late, compared with the
            angles [s].
        largest_gap: Longest gap that is interpolated, in sample times; gaps up to a
            tenth of the period of the filter's cut-off frequency are always
            interpolated.
        bad_rows: Share of the rows that may be bad, and are left out.
        start: Start of the part of every log that is used [s], like `0.0`.
        stop: End of that part [s], like `10.0`.
        imu_offset: Whether rotation, place and biases of the IMU of a floating base are
            estimated, by the legs while all feet stand on level ground.
        in_ground: Whether the wrench of a force sensor is along the axes of the ground.
    """

    forces_file: str | None = None
    lerobot_calibration: str | None = None
    force_delay: float = 0.0
    largest_gap: float = 1.75
    bad_rows: float = MAX_BAD_ROWS
    start: float = -np.inf
    stop: float = np.inf
    imu_offset: bool = False
    in_ground: bool = False

    def forces_path(self, log: Path) -> Path | None:
        """Return the path of the file with the forces of a log, if it has one."""
        if self.forces_file is None:
            return None
        return log.parent / self.forces_file.replace("{}", log.stem)


class Setup(eqx.Module):
    """How logs of a robot become parameters; the command line uses the same defaults.

    Attributes:
        unknowns: Base parameters to identify; or their model, whose base parameters
            are then found when they are needed; or the robot: then its model has the
            effects that a file has by default (`default_terms`).
        filter: Filter of motion, forces and columns; by default the first candidate, a
            zero-phase Butterworth filter of 10 Hz.
        filter_candidates: Filters of which the logs choose one instead of the first of
            them; none where another `filter` is given, by default those of
            `choose_filter`.
        decimation: Samples that become rows of forces and columns.
        min_speed: Speed of each joint below which its rows do not count [rad/s or m/s].
        estimator: Estimator; by default weighted least squares over bodies that can
            exist, pulled towards those of the robot's file as far as the logs bear.
        least_squares: Least squares for checks, and for runs that are compared or
            combined; by default weighted like the default estimator.
        uncertainty: Method of the standard deviations.
        load_friction: Whether dry friction grows with the load on a joint, too, by the
            weight of the bodies that are identified.
        robot_file: File of the robot: the prior of its bodies, and claims to compare
            with.
        reading: How logs are read.
        notes: Assumptions, as sentences.
    """

    unknowns: Unknowns = eqx.field(converter=as_unknowns)
    _: dataclasses.KW_ONLY
    filter: AbstractFilter = eqx.field(default=None)
    filter_candidates: tuple[AbstractFilter, ...] = ()
    decimation: Subsample = Subsample()
    min_speed: Float[AnyArray, " joints"] | Sequence[float] | None = None
    estimator: AbstractEstimator = eqx.field(default=None)
    least_squares: LeastSquares | WeightedLeastSquares = eqx.field(default=None)
    uncertainty: AbstractUncertainty = SpectralSandwich()
    load_friction: bool = False
    robot_file: RobotFile | None = None
    reading: LogReading = LogReading()
    notes: Texts = ()

    def __post_init__(self) -> None:
        """Fill in the defaults that depend on the robot.

        Raises:
            InputError: If two settings do not go together.
        """
        # Equinox converts fields after this method, which needs the model.
        self.unknowns = as_unknowns(self.unknowns)
        if self.filter is None:
            self.filter_candidates = self.filter_candidates or USUAL_FILTERS
            self.filter = self.filter_candidates[0]
        elif self.filter not in self.filter_candidates[:1]:
            # A filter that is given is kept.
            self.filter_candidates = ()
        weights = MaximumForces()
        if self.least_squares is None:
            self.least_squares = WeightedLeastSquares(weights)
        if self.estimator is None:
            pull = pull_to_bodies(self.robot_file)
            self.estimator = PhysicallyConsistent(weights, pull=pull)

    @functools.cached_property
    def base(self) -> BaseParameters:
        """Base parameters of the model, found when they are first asked for."""
        if isinstance(self.unknowns, BaseParameters):
            return self.unknowns
        return base_parameters(self.unknowns)

    @property
    def file_bodies(self) -> Float[np.ndarray, "bodies 10"] | None:
        """Inertial parameters of the robot's file; None if no such bodies can exist."""
        return None if self.robot_file is None else self.robot_file.possible_bodies()

    @property
    def model(self) -> Model:
        """Model whose parameters are wanted."""
        unknowns = self.unknowns
        return unknowns.model if isinstance(unknowns, BaseParameters) else unknowns

    @property
    def robot(self) -> Robot:
        """Robot of the model."""
        return self.model.robot

    @property
    def has_bounded_bodies(self) -> bool:
        """Whether the estimator keeps to bodies that can exist."""
        return isinstance(self.estimator, PhysicallyConsistent)

    @property
    def unbounded_estimator(self) -> AbstractEstimator:
        """The estimator; for bodies that can exist, least squares without bounds."""
        return self.least_squares if self.has_bounded_bodies else self.estimator

    def observe(self, recording: Recording) -> Observations:
        """Filter a recording and make rows of it."""
        return observe(
            recording, self.robot, self.filter, self.decimation, self.min_speed
        )

    def fit(self, rows: RegressionProblem) -> Fit:
        """Estimate the parameters from rows of logs."""
        # Constants of friction laws are no linear parameters: they are found first.
        notes = ()
        # Legs that stand mix the friction of many joints, which hides these speeds.
        base = rows.base
        if not self.robot.floating:
            base = identify_transition_speeds(base, rows.recordings)
        if base is not rows.base:
            rows = rows.with_base(base)
            notes = (transition_note(base),)
        if self.model.memory is not None:
            rows = rows.with_base(identify_presliding(rows.base, rows.recordings))
            notes = (presliding_note(rows.base),)
        fit = fit_problem(rows, self.estimator, uncertainty=self.uncertainty)
        fit = dataclasses.replace(fit, notes=(*notes, *fit.notes))
        if self.load_friction:
            return self._fit_with_load_friction(fit, rows.recordings)
        return fit

    def _fit_with_load_friction(self, fit: Fit, logs: Sequence[Observations]) -> Fit:
        """Fit again with friction by the bodies' weight, until it no longer changes."""
        memory = fit.base.model.memory
        terms = self.model.terms if memory is None else fit.base.model.terms
        transition = dry_transition(terms)
        joints = self.robot.joints
        coefficients = np.full(joints, np.inf)
        estimator = self.estimator
        notes = list(fit.notes)
        if fit.consistency is not None:
            # The first fit has chosen the pull, and says why.
            pull: Any = fit.consistency.pull
            estimator = dataclasses.replace(self.estimator, pull=pull)
            first_notes = fit.consistency.notes(self.robot)
            notes = [x for x in fit.notes if x not in first_notes]
        for _ in range(MAX_LOAD_FRICTION_FITS):
            # The columns of the bodies come first, whatever follows.
            size = self.robot.bodies * len(INERTIAL_NAMES)
            body_parameters = fit.standard_parameters[:size]
            bodies = body_parameters.reshape(self.robot.bodies, -1)
            load_friction = LoadFriction(bodies=bodies, transition=transition)
            base = base_parameters(Model(self.robot, (*terms, load_friction)))
            # Speeds that were found without friction by load make up for it.
            base = identify_transition_speeds(base, logs)
            rows = RegressionProblem(base, logs)
            fit = fit_problem(rows, estimator, uncertainty=self.uncertainty)
            every_note = tuple(dict.fromkeys((*notes, *fit.notes)))
            fit = dataclasses.replace(fit, notes=every_note)

            earlier_coefficients = coefficients
            coefficients = fit.standard_parameters[-joints:]
            change = np.abs(coefficients - earlier_coefficients).max()
            if change < LOAD_FRICTION_TOLERANCE * np.abs(coefficients).max():
                return fit
        note = (
            f"load-dependent friction has not converged in {MAX_LOAD_FRICTION_FITS} "
            "fits: its values are uncertain."
        )
        return dataclasses.replace(fit, notes=(*fit.notes, note))


def pull_to_bodies(
    robot_file: RobotFile | None, strength: float | None = None
) -> EntropicPull | None:
    """Return the pull of a consistent estimator towards the bodies of the robot's file.

    Args:
        robot_file: File of the robot; balls are the prior without it, or where its
            bodies cannot exist.
        strength: Strength of the pull; chosen by the logs if None, 0 for none.
    """
    if strength == 0.0:
        return None
    bodies = None if robot_file is None else robot_file.possible_bodies()
    return EntropicPull(bodies, strength)


def dry_transition(terms: Sequence[AbstractTerm]) -> AbstractTransition:
    """Return a model's transition of dry friction, or the usual one without it."""
    for term in terms:
        if isinstance(term, AbstractDryFriction):
            return term.transition
    return Tanh()
