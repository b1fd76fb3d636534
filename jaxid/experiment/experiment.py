"""An experiment: the objects that the user's file describes."""

import dataclasses
import functools
from pathlib import Path

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm
from jaxid.errors import InputError
from jaxid.experiment.collision_tables import build_collision
from jaxid.experiment.estimator_tables import build_estimator, build_single_axes
from jaxid.experiment.method_tables import (
    build_candidates,
    build_columns,
    build_decimation,
    build_filter,
    build_linear_terms,
    build_slow,
    build_terms,
)
from jaxid.experiment.reading import read_tables
from jaxid.experiment.robot_tables import build_load, build_robot, within
from jaxid.experiment.tables import ExcitationTable, RecordingTable, RobotTable
from jaxid.identification.essential import essential_parameters
from jaxid.identification.estimators import (
    AbstractEstimator,
    LeastSquares,
    WeightedLeastSquares,
)
from jaxid.identification.filter_choice import FilterCandidate
from jaxid.identification.fit import Fit
from jaxid.identification.identify import fit_rows
from jaxid.identification.nonlinear.estimator import NonlinearFriction
from jaxid.identification.nonlinear.verdict import identify_nonlinear
from jaxid.identification.rows import Rows
from jaxid.identification.solutions import Complete, CrossValidated
from jaxid.identification.stepwise import Stepwise
from jaxid.identification.streaming import Progress
from jaxid.identification.uncertainty.methods import AbstractUncertainty
from jaxid.identification.weights import GivenWeights
from jaxid.measurement.chunked_files import estimated_rows
from jaxid.measurement.columns import Columns
from jaxid.measurement.decimation import AbstractDecimation
from jaxid.measurement.filters import AbstractFilter
from jaxid.measurement.log_on_disk import scan_log
from jaxid.measurement.observations import Observations, observe
from jaxid.measurement.recording import Recording, read_recording, remove_delay
from jaxid.measurement.timestamps import NeedsMemory
from jaxid.robot.collision import CollisionModel
from jaxid.robot.robot import Robot, Tool

SHORTEST = 1e-6
"""Time between two samples that no robot's log goes below [s]."""
LONG = 500_000
"""Samples from which a log is read part by part."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """What an experiment file describes.

    Attributes:
        path: Of the file.
        text: Of the file, as it was read.
        source: The table of the robot.
        robot: What is known.
        model: The effects whose parameters are wanted.
        collision: What may not touch what; None if the file does not say.
        clearance: Least distance between what may not touch [m].
        recording: The table of the log's columns; None if the file has none.
        columns: The same as the reader needs them; None if the file has none.
        load: What is on the robot in some logs only, and known; None if the file does not say.
        filter: For motion, forces and columns.
        decimation: For forces and columns.
        slow: Speeds below which rows do not count [rad/s or m/s]; None if all count.
        estimator: How rows become parameters.
        plain: Least squares with the same weights and solution: to look at logs, one by one.
        uncertainty: How standard deviations are found.
        regularised: Whether the estimator keeps small what the logs do not decide.
        single_axes: Logs of single axes if axes are identified one by one; None if at once.
        essential: Held-out error that leaving parameters out may cost, of 1; None to keep all.
        linear: Terms of the model that nonlinear friction must beat; None if it is not wanted.
        candidates: Filters to choose from; none if the file names one.
        excitation: The table of the motion to design.
        notes: What was assumed where the file says nothing, in sentences.
    """

    path: Path
    text: str
    source: RobotTable
    robot: Robot
    model: Model
    collision: CollisionModel | None
    clearance: float
    recording: RecordingTable | None
    columns: Columns | None
    load: Tool | None
    filter: AbstractFilter
    decimation: AbstractDecimation
    slow: Float[np.ndarray, " joints"] | None
    estimator: AbstractEstimator
    plain: LeastSquares | WeightedLeastSquares
    uncertainty: AbstractUncertainty
    regularised: bool
    single_axes: tuple[Path, ...] | None
    essential: float | None
    linear: tuple[AbstractTerm, ...] | None
    candidates: tuple[FilterCandidate, ...]
    excitation: ExcitationTable
    notes: tuple[str, ...]

    @functools.cached_property
    def base(self) -> BaseParameters:
        """The base parameters of the model, found when they are first asked for."""
        return base_parameters(self.model)

    @property
    def other_estimator(self) -> LeastSquares | WeightedLeastSquares:
        """What the estimator is compared with where logs do not determine everything.

        Plain least squares beside an estimator that keeps undecided parameters small, and the
        other way round; identification at once beside axis by axis.
        """
        if self.single_axes is not None:
            return self.plain
        other = Complete() if self.regularised else CrossValidated()
        return dataclasses.replace(self.plain, solution=other)

    def fit(self, rows: Rows, progress: Progress | None = None) -> Fit:
        """Estimates as the table `[estimator]` says.

        Args:
            rows: To identify with.
            progress: Is told which share of a search is done, of 1.
        """
        if self.single_axes is not None:
            alone = tuple(self.observe(self.read(log)) for log in self.single_axes)
            weights = np.asarray(self.plain(rows).weights)
            stepwise = Stepwise(alone, GivenWeights(weights))
            return fit_rows(rows, stepwise, uncertainty=self.uncertainty)
        if self.linear is None:
            fit = fit_rows(rows, self.estimator, uncertainty=self.uncertainty)
            if self.essential is None:
                return fit
            found = essential_parameters(
                fit, rows.recordings, cost=self.essential, uncertainty=self.uncertainty
            )
            return dataclasses.replace(found.fit, notes=(*found.fit.notes, *found.notes))
        linear = base_parameters(Model(self.robot, self.linear))
        estimator = NonlinearFriction(self.plain)
        found = identify_nonlinear(
            self.base, rows.recordings, estimator, linear=linear, progress=progress
        )
        return found.better

    def read(self, log: str | Path) -> Recording:
        """Reads a log as the file's table `[recording]` says.

        Args:
            log: Path of the log; the files of forces and velocities lie beside it.

        Raises:
            InputError: If the file has no table `[recording]`, or the log is not as it says.
        """
        log = Path(log)
        table, columns = self._columns_of(log)
        recording = read_recording(
            log,
            columns,
            forces_path=_beside(log, table.forces_file),
            velocities_path=_beside(log, table.velocities_file),
            largest_gap=table.largest_gap,
        )
        if recording.joints != self.robot.joints:
            raise InputError(
                f"{self.path.name}: `recording.angles` names {recording.joints} of the "
                f"columns of `{log.name}`, but the robot `{self.robot.name}` has "
                f"{self.robot.joints} joints: "
                "name one column for each joint, or choose another robot (`robot.tip`)."
            )
        with within(self.path.name, "recording"):
            if recording.sample_time < SHORTEST:
                raise InputError(
                    f"`{log.name}` has {1 / recording.sample_time:.3g} samples in a second: check "
                    "`time_unit` or `sample_time`."
                )
            if table.start is not None or table.stop is not None:
                recording = recording.crop(
                    -np.inf if table.start is None else table.start,
                    np.inf if table.stop is None else table.stop,
                )
            if table.force_delay:
                recording = remove_delay(recording, table.force_delay)
        return recording

    def observe(self, recording: Recording) -> Observations:
        """Filters a recording and makes rows of it, as the tables `[filter]` and `[rows]` say.

        Raises:
            InputError: If filter and recording do not go together.
        """
        with within(self.path.name, "filter` and `rows"):
            return observe(recording, self.robot, self.filter, self.decimation, self.slow)

    def is_long(self, log: str | Path) -> bool:
        """Whether a log is better read part by part than as a whole."""
        return estimated_rows(Path(log)) >= LONG

    def open(self, log: str | Path, progress: Progress | None = None) -> Observations:
        """Opens a log that need not fit into memory: like `read` and `observe`, part by part.

        Args:
            log: Path of the log.
            progress: Is told which share of the log was gone through for `rows.slow`, of 1.

        Raises:
            NeedsMemory: If it can be read only as a whole.
            InputError: Like `read` and `observe`.
        """
        log = Path(log)
        table, columns = self._columns_of(log)
        if table.force_delay:
            raise NeedsMemory("`recording.force_delay` shifts the angles of whole logs")
        return scan_log(
            log,
            columns,
            self.robot,
            self.filter,
            self.decimation,
            self.slow,
            forces_path=_beside(log, table.forces_file),
            velocities_path=_beside(log, table.velocities_file),
            largest_gap=table.largest_gap,
            start=-np.inf if table.start is None else table.start,
            stop=np.inf if table.stop is None else table.stop,
            progress=progress,
        )

    def _columns_of(self, log: Path) -> tuple[RecordingTable, Columns]:
        if self.recording is None or self.columns is None:
            raise InputError(
                f"{self.path.name}: the table `[recording]` is missing: it says which columns of "
                f"`{log.name}` hold angles and forces."
            )
        return self.recording, self.columns


def _beside(log: Path, name: str | None) -> Path | None:
    return None if name is None else log.parent / name.replace("{}", log.stem)


def _two_forces(robot: Robot) -> list[str]:
    """Says which of two known largest forces decides."""
    own, motors = np.asarray(robot.limits.force), np.asarray(robot.drives.max_forces)
    both = np.isfinite(own) & np.isfinite(motors) & ~np.isclose(own, motors, rtol=1e-6)
    if not both.any():
        return []
    shown = (
        f"{robot.joint_names[j]} {own[j]:.4g}, not {motors[j]:.4g} {robot.force_unit(j)}"
        for j in np.flatnonzero(both).tolist()
    )
    return [
        "the largest forces are those of the joints (`limits.force`), which decide before what the "
        f"motors give through the gears (`drives.max_torques`): {'; '.join(shown)}."
    ]


def load_experiment(path: str | Path) -> Experiment:
    """Loads an experiment file.

    Args:
        path: Of a TOML file; paths in it are relative to its folder.

    Raises:
        OSError: If the file cannot be read.
        InputError: If the file or something in it is not what it should be: one sentence with the
            names of file and key.
    """
    path = Path(path)
    tables, text = read_tables(path)
    robot = build_robot(tables, path)
    notes = _two_forces(robot)
    with within(path.name, "model"):
        model = Model(robot, build_terms(tables.model, robot))
    collision = build_collision(tables, robot, path)
    with within(path.name, "recording"):
        columns = build_columns(tables.recording, robot)
    load = None
    if tables.load is not None:
        with within(path.name, "load"):
            load = build_load(robot, tables.load)
    with within(path.name, "filter"):
        filtering, said = build_filter(tables.filter)
        notes += said
        candidates = build_candidates(tables.filter, tables.rows)
    nonlinear = tables.estimator.nonlinear_friction
    linear = build_linear_terms(tables.model, robot) if nonlinear else None
    with within(path.name, "rows"):
        decimation = build_decimation(tables.rows)
        slow = build_slow(tables.rows, robot)
    with within(path.name, "estimator"):
        chosen = build_estimator(tables.estimator, robot, model, tables.robot, path)
        notes += chosen.notes
        single_axes = build_single_axes(tables.estimator, path)
    return Experiment(
        path=path,
        text=text,
        source=tables.robot,
        robot=robot,
        model=model,
        collision=collision,
        clearance=0.0 if tables.collision is None else tables.collision.distance,
        recording=tables.recording,
        columns=columns,
        load=load,
        filter=filtering,
        decimation=decimation,
        slow=slow,
        estimator=chosen.estimator,
        plain=chosen.plain,
        uncertainty=chosen.uncertainty,
        regularised=tables.estimator.ridge is not None or tables.estimator.truncate is not None,
        single_axes=single_axes,
        essential=tables.estimator.essential,
        linear=linear,
        candidates=candidates,
        excitation=tables.excitation,
        notes=tuple(notes),
    )
