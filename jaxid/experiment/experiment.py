"""Experiment: the objects that the user's TOML file describes."""

import dataclasses
import functools
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxid.arrays import Float
from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import (
    AbstractTerm,
    AbstractTransition,
    LoadFriction,
    RigidBodies,
    Tanh,
)
from jaxid.errors import InputError
from jaxid.identification.consistency import BodyBounds, PhysicallyConsistent
from jaxid.identification.estimators import NonlinearFriction
from jaxid.identification.filter_selection import FilterCandidate
from jaxid.identification.fit_result import Fit
from jaxid.identification.friction_laws import (
    identify_nonlinear_friction,
    identify_presliding,
)
from jaxid.identification.friction_laws.presliding_lengths import presliding_note
from jaxid.identification.identify import fit_problem
from jaxid.identification.parameter_elimination import essential_parameters
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.columns import Columns
from jaxid.measurement.filters import FILTERS, AbstractDecimation, AbstractFilter
from jaxid.measurement.log_files import estimated_rows, summarise_columns
from jaxid.measurement.observations import Observations, Progress, observe
from jaxid.measurement.reading import read_recording, scan_log
from jaxid.measurement.recording import NeedsMemory, Recording, remove_delay
from jaxid.robot.robot import Robot, Tool
from jaxid.rollout import Bodies
from jaxid.units import NM

from .decoder import call, check_names, within
from .estimator_table import Estimation, build_estimation, decode_estimator
from .excitation_tables import Collision, Excitation, Surroundings
from .model_and_log_tables import (
    Effects,
    Logs,
    Rollout,
    build_columns,
    build_filters,
    build_rows,
)
from .robot_tables import RobotSource, known_load, replace_drives, replace_limits

LOAD_ROUNDS = 10
"""Fits after which friction by load must have settled."""
TABLES: dict[str, tuple[Callable, ...]] = {
    "robot": (RobotSource,),
    "load": (known_load,),
    "limits": (replace_limits,),
    "drives": (replace_drives,),
    "model": (Effects,),
    "recording": (Columns, Logs),
    "filter": tuple(FILTERS.values()),
    "rows": (build_rows,),
    "estimator": (build_estimation, BodyBounds),
    "rollout": (Rollout,),
    "excitation": (Excitation,),
    "collision": (Collision,),
}
"""Tables of an experiment file, and functions whose arguments are their keys."""
LONG = 500_000
"""Samples from which a log is read part by part."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Content of an experiment file."""

    path: Path  # path of the file
    text: str  # text of the file
    source: RobotSource  # source of the robot
    robot: Robot  # robot with its limits, drives and known tool
    model: Model  # effects whose parameters are wanted
    collision: Collision  # shapes that must keep a distance, as the file describes them
    columns: Columns | None  # columns of the logs; None if the file does not say
    logs: Logs  # sides, files and parts of the logs
    # known load that is on the robot in some logs only; None if the file does not say
    load: Tool | float | None
    filter: AbstractFilter  # filter of motion, forces and columns
    candidates: tuple[
        FilterCandidate, ...
    ]  # filters to choose from; none if the file names one
    decimation: AbstractDecimation  # decimation of forces and columns
    # speeds below which rows do not count [rad/s or m/s]; None if all count
    min_speed: Float[np.ndarray, " joints"] | None
    estimation: Estimation  # estimator and uncertainty
    # terms of the model that nonlinear friction must beat; None if it is not wanted
    linear: tuple[AbstractTerm, ...] | None
    # transition of friction by load, which the model leaves out; None without
    load_transition: AbstractTransition | None
    rollout: Rollout  # settings of the identification without torques
    excitation: Excitation  # settings of the motion to design
    notes: tuple[str, ...]  # assumptions where the file says nothing, in sentences

    @functools.cached_property
    def base(self) -> BaseParameters:
        """Base parameters of the model, found when they are first asked for."""
        return base_parameters(self.model)

    @functools.cached_property
    def surroundings(self) -> Surroundings:
        """Shapes of robot and surroundings, found when they are first asked for."""
        with within("collision", self.path.name):
            return self.collision.build(self.robot, self.source, self.path.parent)

    def fit(self, rows: RegressionProblem, progress: Progress | None = None) -> Fit:
        """Estimate parameters as the table `[estimator]` says."""
        chosen, logs = self.estimation, rows.recordings
        if self.linear is not None:
            linear = base_parameters(Model(self.robot, self.linear))
            estimator = NonlinearFriction(chosen.plain)
            found = identify_nonlinear_friction(
                self.base, logs, estimator, linear=linear, progress=progress
            )
            return found.better
        notes = ()
        if self.model.memory is not None:
            rows = rows.with_base(identify_presliding(rows.base, logs))
            notes = (presliding_note(rows.base),)
        fit = fit_problem(rows, chosen.estimator, uncertainty=chosen.uncertainty)
        fit = dataclasses.replace(fit, notes=(*notes, *fit.notes))
        if self.load_transition is not None:
            return self._with_load_friction(fit, logs)
        if chosen.essential is None:
            return fit
        choice = essential_parameters(
            fit, logs, cost=chosen.essential, uncertainty=chosen.uncertainty
        )
        return dataclasses.replace(choice.fit, notes=(*choice.fit.notes, *choice.notes))

    def _with_load_friction(self, fit: Fit, logs: Sequence[Observations]) -> Fit:
        """Fit again with friction by the weight of the bodies found, until it changes no more."""
        terms, last, count = fit.base.model.terms, np.inf, self.robot.joints
        transition = fit.base.model.memory or self.load_transition or Tanh()
        for _ in range(LOAD_ROUNDS):
            # The first ten columns of each body, whatever follows.
            bodies = np.asarray(fit.full_parameters)[: 10 * count].reshape(count, 10)
            load = LoadFriction(bodies=bodies, transition=transition)
            model = Model(self.robot, (*terms, load))
            rows = RegressionProblem(base_parameters(model), logs)
            chosen = self.estimation
            fit = fit_problem(rows, chosen.estimator, uncertainty=chosen.uncertainty)
            found = np.asarray(fit.full_parameters)[-count:]
            if np.abs(found - last).max() < 1e-3 * np.abs(found).max():
                return fit
            last = found
        note = (
            f"friction by load has not settled in {LOAD_ROUNDS} fits: its values "
            "are uncertain."
        )
        return dataclasses.replace(fit, notes=(*fit.notes, note))

    def read(self, log: str | Path) -> Recording:
        """Read a log as the table `[recording]` says."""
        return self._read(Path(log), self._columns_of(Path(log)))

    def commanded(self, log: Path) -> Observations | None:
        """Return a log with the commanded angles in place of the measured ones, filtered.

        None if the file does not name them, or the log is long.
        """
        commands = self.logs.commands
        if commands is None or self.is_long(log):
            return None
        columns = dataclasses.replace(
            self._columns_of(log), angles=commands, velocities=None
        )
        return self.observe(self._read(log, columns))

    def read_commands(self, log: str | Path) -> Recording:
        """Read a log with the commanded angles in place of forces.

        Raises:
            InputError: If the file does not name the columns of the commands, or the
                log is not as it says.
        """
        log, commands = Path(log), self.logs.commands
        columns = self._columns_of(log)
        if commands is None:
            raise InputError(
                f"{self.path.name}: `recording.commands` is missing: it names the "
                "columns of the "
                'commanded angles, like "cmd{}".'
            )
        plain = {
            "forces": commands,
            "force_unit": NM,
            "force_signs": None,
            "force_gains": None,
        }
        columns = dataclasses.replace(
            columns, **plain, torque_constants=None, velocities=None
        )
        swapped = dataclasses.replace(columns, angles=commands, forces=columns.angles)
        found = []
        for key, chosen in (("forces", columns), ("angles", swapped)):
            try:
                found.append(self._read(log, chosen))
            except InputError as error:
                raise InputError(str(error).replace(f"`{key}`", "`commands`")) from None
        measured, sent = found
        return dataclasses.replace(measured, forces=sent.angles)

    def bodies(self) -> Bodies | None:
        """Return the bodies that the robot's file describes, as loads of its joints."""
        wanted = self.rollout.bodies
        found = None if wanted is False else self.source.parameters(self.path.parent)
        if found is None and wanted:
            raise InputError(
                f"{self.path.name}: `rollout.bodies` needs a robot from a URDF or "
                "MJCF file."
            )
        if found is None or not (found[:, 0] > 0).any():
            return None
        return Bodies(Model(self.robot, (RigidBodies(),)), found.ravel())

    def _read(self, log: Path, columns: Columns) -> Recording:
        logs = self.logs
        tried = [self.filter, *(filter for filter, _ in self.candidates)]
        recording = read_recording(
            log,
            columns,
            largest_gap=logs.largest_gap,
            bridged=0.1 / max(getattr(x, "cutoff", np.inf) for x in tried),
            bad_rows=logs.bad_rows,
            **logs.files(log),
        )
        if recording.joints != self.robot.joints:
            raise InputError(
                f"{self.path.name}: `recording.angles` names {recording.joints} of the "
                f"columns of `{log.name}`, but `{self.robot.name}` has "
                f"{self.robot.joints} joints: "
                "name one column for each, or choose another robot (`robot.tip`)."
            )
        with within("recording", self.path.name):
            if recording.sample_time < 1e-6:
                rate = 1 / recording.sample_time
                raise InputError(
                    f"`{log.name}` has {rate:.3g} samples in a second: check "
                    "`time_unit`."
                )
            start, stop = logs.part(log)
            if np.isfinite((start, stop)).any():
                recording = recording.crop(start, stop)
            return (
                remove_delay(recording, logs.force_delay)
                if logs.force_delay
                else recording
            )

    def observe(self, recording: Recording) -> Observations:
        """Filter a recording and make rows of it, as the tables `[filter]` and `[rows]` say."""
        with within("filter` and `rows", self.path.name):
            return observe(
                recording, self.robot, self.filter, self.decimation, self.min_speed
            )

    def is_long(self, log: str | Path) -> bool:
        """Return whether a log is better read part by part than as a whole."""
        return estimated_rows(Path(log)) >= LONG

    def open(self, log: Path) -> Observations:
        """Open a log that need not fit into memory: like `read` and `observe`, part by part."""
        logs = self.logs
        if logs.force_delay:
            raise NeedsMemory("`recording.force_delay` shifts the angles of whole logs")
        start, stop = logs.part(log)
        return scan_log(
            log,
            self._columns_of(log),
            self.robot,
            self.filter,
            self.decimation,
            self.min_speed,
            largest_gap=logs.largest_gap,
            start=start,
            stop=stop,
            **logs.files(log),
        )

    def _columns_of(self, log: Path) -> Columns:
        if self.columns is None:
            raise InputError(
                f"{self.path.name}: the table `[recording]` is missing: it names "
                "columns of "
                f"`{log.name}`, which has {summarise_columns(log)}."
            )
        return self.columns


def load_experiment(path: str | Path) -> Experiment:
    """Load an experiment file; paths in it are relative to its folder."""
    path = Path(path)
    if not path.is_file():
        raise InputError(
            f"`{path}` is no file: check its path, or write one with `jaxid init "
            "arm.urdf`."
        )
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except ValueError as error:
        raise InputError(
            f"{path.name}: the file is no TOML in UTF-8: {error}."
        ) from error
    return parse_experiment(text, path)


def parse_experiment(text: str, path: Path) -> Experiment:
    """Return the experiment of a file with this text; other paths are relative to its folder."""
    try:
        content = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        said = str(error).rstrip(".")
        raise InputError(
            f"{path.name}: the file is no TOML in UTF-8: {said}."
        ) from error
    try:
        experiment = Experiment(path=path, text=text, **_build(content, path.parent))
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from error
    if "collision" in content:
        _ = experiment.surroundings  # for its mistakes
    return experiment


def _build(content: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the fields of an experiment from the tables of its file."""
    check_names(content, list(TABLES))
    for name, table in content.items():
        if not isinstance(table, dict):
            raise InputError(f"`{name}` must be a table, but is {table!r}.")
    if "robot" not in content:
        raise InputError(
            "the table `[robot]` is missing: give it `urdf`, `mjcf`, `builtin` or `dh`."
        )
    source = call(RobotSource, content["robot"], "robot")
    with within("robot"):
        robot = source.build(folder)
    for name, replace in (("limits", replace_limits), ("drives", replace_drives)):
        if name in content:
            robot = call(replace, content[name], name, robot)
    effects = call(Effects, content.get("model", {}), "model")
    with within("model"):
        model = Model(robot, effects.build(robot))
        load_transition = effects.load_transition(robot)
    filters, filter_notes = build_filters(content.get("filter"))
    decimation, min_speed = call(build_rows, content.get("rows", {}), "rows", robot)
    columns, logs = None, Logs()
    if "recording" in content:
        columns, logs = build_columns(content["recording"], robot)
    given, bounds = decode_estimator(content.get("estimator", {}))
    with within("estimator"):
        estimation = build_estimation(model, source, folder, bounds, **given)
        if load_transition and not isinstance(
            estimation.estimator, PhysicallyConsistent
        ):
            raise InputError(
                '`model.load` needs the bodies that `kind = "consistent"` finds.'
            )
    if estimation.nonlinear and model.memory is not None:
        raise InputError(
            "give `coulomb.presliding` or `nonlinear_friction`, but not both."
        )
    tool = None
    if "load" in content:
        load = call(known_load, content["load"], "load")
        with within("load"):
            tool = load(robot)
    return {
        "source": source,
        "robot": robot,
        "model": model,
        "collision": call(Collision, content.get("collision", {}), "collision"),
        "columns": columns,
        "logs": logs,
        "load": tool,
        "filter": filters[0],
        "candidates": tuple((f, decimation) for f in filters if len(filters) > 1),
        "decimation": decimation,
        "min_speed": min_speed,
        "estimation": estimation,
        "load_transition": load_transition,
        "linear": effects.linear_terms(robot) if estimation.nonlinear else None,
        "rollout": call(Rollout, content.get("rollout", {}), "rollout"),
        "excitation": call(Excitation, content.get("excitation", {}), "excitation"),
        "notes": (*filter_notes, *estimation.notes),
    }
