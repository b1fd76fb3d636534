"""Choice of the model of an experiment file: effects that unseen parts of logs need.

The search begins with the file as it is. Each round tries every single change and makes
the one that lowers the errors on unseen parts most. The columns of all effects are
evaluated and filtered once; the models are subsets of them.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np

from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, LoadFriction
from jaxid.errors import InputError
from jaxid.identification.consistency import PhysicallyConsistent
from jaxid.identification.friction_laws import (
    identify_presliding,
    identify_transition_speeds,
)
from jaxid.identification.model_selection import (
    BODY_RIDGE,
    DIVISIONS,
    RIDGE,
    HeldOutPrediction,
    ModelChoice,
    Trial,
    UnseenParts,
    column_products,
    divide_logs,
    estimate_without_parts,
    next_model,
    predict_held_out,
)
from jaxid.identification.problem import RegressionProblem
from jaxid.measurement.filters import ZeroPhaseButterworth
from jaxid.measurement.observations import Observations
from jaxid.measurement.recording import Recording
from jaxid.workflow.log_identification import require_separate_logs
from jaxid.workflow.log_loading import read_log, select_filter
from jaxid.workflow.setup import (
    Paths,
    Progress,
    Setup,
    dry_transition,
    ignore_progress,
    pull_to_bodies,
)

from .changes_of_models import EFFECTS, PRESLIDING, Keys, changed_text
from .experiment import Experiment, parse_experiment

MIN_SPEED_SHARE = 0.05
"""Speed below which rows may be left out, relative to a joint's largest speed."""
STRIBECK_SHARES = (0.01, 0.02, 0.05, 0.1, 0.2)
"""Stribeck speeds that are tried, relative to a joint's largest speed."""

Names = tuple[str, ...]
"""Names of changes, in the order in which they are made."""


def choose_model(
    experiment: Experiment,
    logs: Paths,
    *,
    seconds: float | None = None,
    keep: Callable[[str], None] | None = None,
    progress: Progress = ignore_progress,
) -> ModelChoice:
    """Choose the effects of a model, and whether slow rows count, from logs.

    Where the file leaves the cut-off open, it is chosen first, as for `identify_logs`:
    all models are compared in this one band.

    Parts of time are left out in turn, or whole logs if there are at least four. A
    change is kept if it lowers the errors on them by more than one standard deviation
    of the difference, and by 1 % of the error at least. The models are fitted by
    weighted least squares; the promised error is that of the file's own estimator.

    Args:
        experiment: Experiment file with which the search begins.
        logs: Paths of logs.
        seconds: Time after which the best model so far is returned [s].
        keep: Function that is called with the text of the best experiment file so far.
        progress: Callback, called with a stage and its completed fraction (0 to 1).

    Raises:
        InputError: If a log cannot be used, or is too short.
    """
    end_time = np.inf if seconds is None else time.monotonic() + seconds
    paths = [Path(log) for log in logs]
    require_separate_logs(paths)
    columns = experiment.require_columns(paths)
    setup = select_filter(experiment.setup, paths, columns, progress)
    recordings = [read_log(setup, path, columns) for path in paths]
    progress("evaluating the columns", 0.0)
    search = ModelSearch(experiment, setup, recordings)
    path, others, is_complete = search.run(end_time, keep, progress)
    changes = path[-1].changes
    progress("predicting unseen parts", 0.0)
    return ModelChoice(
        path=path,
        others=others,
        changes=search.keys,
        text=search.text(changes),
        first_predictions=search.predict(()),
        predictions=search.predict(changes),
        band=search.band,
        parts=search.parts.words,
        is_complete=is_complete,
    )


class ColumnSource(NamedTuple):
    """Columns of all effects, filtered alike, and the effects that they belong to."""

    # products of the columns; two with the lengths of presliding of either half
    products: list[UnseenParts]
    first_columns: list[int]  # columns of the first model
    columns: dict[str, list[int]]  # columns that each effect adds


class ModelSearch:
    """Errors of the models that changes of an experiment file make.

    Args:
        experiment: Experiment file with which the search begins.
        setup: Its setup, with one filter.
        recordings: Logs.
    """

    def __init__(
        self, experiment: Experiment, setup: Setup, recordings: Sequence[Recording]
    ):
        self._experiment = experiment
        self._recordings = recordings
        self._text = experiment.text
        if setup.filter != experiment.setup.filter:
            # The cut-off that the logs have chosen.
            cutoff = getattr(setup.filter, "cutoff", None)
            table: dict[str, Any] = {"cutoff": cutoff}
            if isinstance(setup.filter, ZeroPhaseButterworth):
                table["kind"] = "butterworth"
            self._text = changed_text(self._text, {"filter": table})
        self._sources: dict[Names, ColumnSource] = {}
        logs = [setup.observe(recording) for recording in recordings]
        max_speeds = np.max([np.abs(log.motion.qd).max(axis=0) for log in logs], axis=0)
        self._row_changes = self._changes_of_rows(setup, max_speeds)
        cutoff = setup.filter.low_pass(logs[0].sample_time).cutoff
        self.band = f"below {cutoff:.3g} Hz"
        self.parts = divide_logs(logs)
        self._is_late = np.arange(self.parts.size) >= self.parts.size / 2
        self._masks = [log.mask for log in logs]
        first_base = find_friction_constants(setup.base, logs)
        transition = dry_transition(first_base.model.terms)
        self._speeds = getattr(transition, "speed", None)
        problem = RegressionProblem(first_base, logs, divisions=DIVISIONS)
        estimate = setup.least_squares(problem)
        self._weights = np.asarray(estimate.weights)
        self._bodies = first_base.to_standard(np.asarray(estimate.parameters))
        self._first_names = first_base.names
        estimator = bounded_estimator(setup, problem)
        self._first_estimates = estimate_without_parts(problem, self.parts, estimator)
        self._effects = self._effects_of_robot(logs, max_speeds)

    def _changes_of_rows(self, setup: Setup, max_speeds) -> dict[str, Keys]:
        """Return the changes that need other rows: memory, and a smallest speed."""
        changes: dict[str, Keys] = {}
        if setup.model.memory is None:
            changes["presliding"] = PRESLIDING
        if setup.min_speed is None:
            speeds = [float(f"{MIN_SPEED_SHARE * x:.2g}") for x in max_speeds]
            changes["minimum speed"] = {"rows": {"min_speed": speeds}}
        return changes

    def _setup(self, *changes: Keys) -> Setup:
        """Return the setup of the file with other keys."""
        text = changed_text(self._text, *changes)
        return parse_experiment(text, self._experiment.path).setup

    @property
    def keys(self) -> dict[str, Keys]:
        """Keys of each change by its name."""
        return {**self._effects, **self._row_changes}

    def text(self, names: Names) -> str:
        """Return the text of the experiment file with some changes."""
        return changed_text(self._text, *(self.keys[name] for name in names))

    def run(
        self,
        end_time: float,
        keep: Callable[[str], None] | None,
        progress: Progress,
    ) -> tuple[list[Trial], list[Trial], bool]:
        """Make one change after another, as long as one lowers the errors enough.

        Returns:
            The first model and that after each change; all others; whether no change
            was left to try.
        """
        path = [self.trial(())]
        others: list[Trial] = []
        while time.monotonic() < end_time:
            current = path[-1]
            trials = []
            neighbours = self.neighbours(current.changes)
            stage = f"round {len(path)}: {len(neighbours)} changes"
            for number, changes in enumerate(neighbours):
                progress(stage, number / len(neighbours))
                if time.monotonic() < end_time:
                    trials += self.try_changes(changes)
            model = next_model(current, trials)
            others += [trial for trial in trials if trial is not model]
            if model is None:
                break
            path.append(model)
            if keep is not None:
                keep(self.text(model.changes))
        return path, others, time.monotonic() < end_time

    def neighbours(self, changes: Names) -> list[Names]:
        """Return the changes together with each one that is not among them."""
        return [(*changes, name) for name in self.keys if name not in changes]

    def try_changes(self, changes: Names) -> list[Trial]:
        """Return the errors of a model; nothing if its changes do not go together."""
        try:
            return [self.trial(changes)]
        except InputError:
            return []

    def trial(self, changes: Names) -> Trial:
        """Return the errors of a model on the parts."""
        names_of_rows = tuple(x for x in self._row_changes if x in changes)
        if names_of_rows not in self._sources:
            self._sources[names_of_rows] = self._column_source(names_of_rows)
        source = self._sources[names_of_rows]
        columns = list(source.first_columns)
        for name in changes:
            columns += source.columns.get(name, [])
        # The first half is judged with the lengths of the second one.
        trials = [x.trial(changes, sorted(columns)) for x in source.products]
        squares = np.where(self._is_late, trials[0].squares, trials[-1].squares)
        return trials[0]._replace(squares=squares)

    def _effects_of_robot(
        self, logs: Sequence[Observations], max_speeds
    ) -> dict[str, Keys]:
        """Return the effects that the robot can have and the file does not."""
        effects = {}
        first_names = self._names()
        for name, keys in EFFECTS.items():
            try:
                if not self._names(keys) - first_names:
                    continue
            except InputError:
                continue
            effects[name] = keys
        if "Stribeck" in effects:
            base = base_parameters(self._model(effects["Stribeck"]))
            speeds = stribeck_speeds(base, logs, max_speeds)
            effects["Stribeck"] = {"model": {"coulomb": {"stribeck": speeds}}}
        return effects

    def _names(self, *changes: Keys) -> set[str]:
        return set(self._model(*changes).parameter_names)

    def _model(self, *changes: Keys) -> Model:
        """Return the model of the file with other keys, friction by load included."""
        setup = self._setup(*changes)
        terms = setup.model.terms
        if setup.load_friction:
            transition = setup.model.memory or dry_transition(terms)
            terms = (*terms, LoadFriction(bodies=self._bodies, transition=transition))
        return Model(setup.robot, terms)

    def _column_source(self, names_of_rows: Names) -> ColumnSource:
        """Evaluate and filter the columns of all effects."""
        row_keys = [self._row_changes[name] for name in names_of_rows]
        first_model = self._model(*row_keys)
        models = {
            name: self._model(keys, *row_keys) for name, keys in self._effects.items()
        }
        setup = self._setup(*row_keys)
        logs = [setup.observe(recording) for recording in self._recordings]
        terms = join_terms([first_model, *models.values()])
        model = Model(setup.robot, terms)
        if self._speeds is not None:
            model = model.with_transition_speeds(self._speeds)
        base = base_parameters(model)
        products = [self._products(base, logs)]
        if base.model.memory is not None:
            # Lengths must not have seen the parts that are judged.
            products = []
            for half in self._halves(logs):
                base = identify_presliding(base, half)
                products.append(self._products(base, logs))
        first_names = set(first_model.parameter_names)
        columns = {}
        for name, model in models.items():
            names = set(model.parameter_names) - first_names
            columns[name] = [k for k, x in enumerate(base.names) if x in names]
        first_columns = [k for k, x in enumerate(base.names) if x in first_names]
        return ColumnSource(products, first_columns, columns)

    def _halves(self, logs: Sequence[Observations]) -> list[list[Observations]]:
        """Return the logs in the first half of the parts, and in the second one."""
        halves: list[list[Observations]] = [[], []]
        for log, row_parts in zip(logs, self.parts.rows, strict=True):
            is_late = self._is_late[row_parts]
            for half, is_inside in zip(halves, (~is_late, is_late), strict=True):
                mask = np.asarray(log.mask) & is_inside[:, None]
                if mask.any(axis=0).all():
                    half.append(log.replace(mask=mask))
        return halves

    def _products(
        self, base: BaseParameters, logs: Sequence[Observations]
    ) -> UnseenParts:
        """Return the products of all columns, for fits and for their errors."""
        training = column_products(base, logs, self.parts, self._weights)
        # All models are judged by the same rows.
        judged_logs = [
            log.replace(mask=mask) for log, mask in zip(logs, self._masks, strict=True)
        ]
        ones = np.ones(base.model.robot.joints)
        judged = column_products(base, judged_logs, self.parts, ones)
        priors, ridges = self._priors(base)
        return UnseenParts(training, judged, priors, ridges)

    def _priors(self, base: BaseParameters) -> tuple[np.ndarray, np.ndarray]:
        """Return the bodies near which the fits stay, and how strongly."""
        priors = np.zeros((self.parts.size, base.size))
        first_columns = [base.names.index(name) for name in self._first_names]
        priors[:, first_columns] = self._first_estimates
        # The columns of the bodies come first.
        bodies = base.model.terms[0].parameters(base.model.robot)
        is_body = np.array(base.indices) < len(bodies)
        return priors, np.where(is_body, BODY_RIDGE, RIDGE)

    def predict(self, changes: Names) -> list[HeldOutPrediction]:
        """Predict the parts by the file's own estimator, in the model's own band."""
        keys = [self.keys[name] for name in changes]
        setup = self._setup(*keys)
        logs = [setup.observe(recording) for recording in self._recordings]
        base = find_friction_constants(base_parameters(self._model(*keys)), logs)
        estimator = setup.least_squares
        if setup.has_bounded_bodies:
            estimator = bounded_estimator(setup, RegressionProblem(base, logs))
        return predict_held_out(base, logs, estimator)


def bounded_estimator(setup: Setup, problem: RegressionProblem) -> PhysicallyConsistent:
    """Return the estimator of bodies that can exist, that of the file if it is one.

    The strength of its pull is that which all rows choose.
    """
    estimator = setup.estimator
    if not isinstance(estimator, PhysicallyConsistent):
        estimator = PhysicallyConsistent(pull=pull_to_bodies(setup.robot_file))
    consistency = estimator(problem).consistency
    pull = estimator.pull if consistency is None else consistency.pull
    return dataclasses.replace(estimator, pull=pull)


def find_friction_constants(
    base: BaseParameters, logs: Sequence[Observations]
) -> BaseParameters:
    """Return base parameters with the constants of friction that a fit finds first."""
    base = identify_transition_speeds(base, logs)
    if base.model.memory is None:
        return base
    return identify_presliding(base, logs)


def join_terms(models: Sequence[Model]) -> tuple[AbstractTerm, ...]:
    """Return the terms of all models; of two that share parameters the larger one."""
    terms: dict[frozenset[str], AbstractTerm] = {}
    for model in models:
        for term in model.terms:
            names = frozenset(name for name, _ in term.parameters(model.robot))
            if any(names <= other_names for other_names in terms):
                continue
            terms = {key: x for key, x in terms.items() if not key <= names}
            terms[names] = term
    return tuple(terms.values())


def stribeck_speeds(
    base: BaseParameters, logs: Sequence[Observations], max_speeds
) -> list[float]:
    """Return the Stribeck speed of each joint that explains its own rows best."""
    residuals = []
    for share in STRIBECK_SHARES:
        terms = []
        for term in base.model.terms:
            if hasattr(term, "speed"):
                term = dataclasses.replace(term, speed=share * max_speeds)
            terms.append(term)
        model = dataclasses.replace(base.model, terms=tuple(terms))
        trial_base = eqx.tree_at(lambda x: x.model, base, model)
        factors = RegressionProblem(trial_base, logs).factors
        # The last entry of a triangle is what the columns leave of the forces.
        residuals.append([abs(joint.R[-1, -1]) for joint in factors.joints])
    shares = np.array(STRIBECK_SHARES)[np.argmin(residuals, axis=0)]
    return [float(f"{x:.2g}") for x in shares * max_speeds]
