"""Choice of the model of an experiment file: effects that unseen parts of logs need.

The search begins with the file as it is. Each round tries every single change and makes
the one that lowers the errors on unseen parts most; the next round begins with a new
fit. In a round the columns of all effects are evaluated and filtered once.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxid.arrays import Matrix, Texts, Vector
from jaxid.dynamics.base import BaseParameters, base_parameters
from jaxid.dynamics.model import Model
from jaxid.dynamics.terms import AbstractTerm, LoadFriction, StribeckFriction, Tanh
from jaxid.errors import InputError
from jaxid.identification.consistency import PhysicallyConsistent
from jaxid.identification.friction_laws import (
    identify_presliding,
    identify_stribeck_speeds,
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

    Parts of the logs are left out in turn, or whole logs if there are at least four. A
    change is kept if it lowers the errors of the parts, relative to what they were, by
    more than two standard deviations of their mean, and the error in all by 1 %. The
    models are fitted by weighted least squares; the promised error is that of the
    file's own estimator.

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
    first_predictions = search.predict()
    path, others, is_complete = search.run(end_time, keep, progress)
    progress("predicting unseen parts", 0.0)
    return ModelChoice(
        path=path,
        others=others,
        changes=search.keys,
        text=search.text,
        first_predictions=first_predictions,
        predictions=search.predict() if len(path) > 1 else first_predictions,
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
        self.text = experiment.text
        if setup.filter != experiment.setup.filter:
            # The cut-off that the logs have chosen.
            cutoff = getattr(setup.filter, "cutoff", None)
            table: dict[str, Any] = {"cutoff": cutoff}
            if isinstance(setup.filter, ZeroPhaseButterworth):
                table["kind"] = "butterworth"
            self.text = changed_text(self.text, {"filter": table})
        self._changes: Texts = ()
        logs = self._observe(setup)
        max_speeds = [np.abs(log.motion.qd).max(axis=0) for log in logs]
        driven = list(setup.robot.driven)
        self._max_speeds = np.max(max_speeds, axis=0)[driven]
        self._row_changes = self._changes_of_rows(setup)
        cutoff = setup.filter.low_pass(logs[0].sample_time).cutoff
        self.band = f"below {cutoff:.3g} Hz"
        self.parts = divide_logs(logs)
        self._is_late = np.arange(self.parts.size) >= self.parts.size / 2
        self._masks = [log.mask for log in logs]
        # Until constants of friction are found, those of the file are near enough.
        estimate = setup.least_squares(RegressionProblem(setup.base, logs))
        self._bodies = setup.base.to_standard(estimate.parameters)
        self._transition = dry_transition(setup.model.terms)
        self._effects = self._effects_of_robot()
        self._begin_round()

    def _observe(self, setup: Setup) -> list[Observations]:
        return [setup.observe(recording) for recording in self._recordings]

    def _changes_of_rows(self, setup: Setup) -> dict[str, Keys]:
        """Return the changes that need other rows: memory, and a smallest speed."""
        changes: dict[str, Keys] = {}
        if setup.model.memory is None:
            changes["presliding"] = PRESLIDING
        if setup.min_speed is None:
            speeds = [float(f"{MIN_SPEED_SHARE * x:.2g}") for x in self._max_speeds]
            changes["minimum speed"] = {"rows": {"min_speed": speeds}}
        return changes

    def _setup(self, *changes: Keys) -> Setup:
        """Return the setup of the file with other keys."""
        text = changed_text(self.text, *changes)
        return parse_experiment(text, self._experiment.path).setup

    @property
    def keys(self) -> dict[str, Keys]:
        """Keys of each change by its name."""
        return {**self._effects, **self._row_changes}

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
        path = [self.trial()]
        others: list[Trial] = []
        while time.monotonic() < end_time:
            trials = []
            names = [name for name in self.keys if name not in self._changes]
            stage = f"round {len(path)}: {len(names)} changes"
            for number, name in enumerate(names):
                progress(stage, number / len(names))
                if time.monotonic() < end_time:
                    trials += self.try_change(name)
            model = next_model(path[-1], trials)
            others += [trial for trial in trials if trial is not model]
            if model is None:
                break
            self.make_change(model.changes[-1])
            path.append(self.trial())
            if keep is not None:
                keep(self.text)
        return path, others, time.monotonic() < end_time

    def make_change(self, name: str) -> None:
        """Change the file, and begin the next round with it."""
        self.text = changed_text(self.text, self.keys[name])
        self._changes = (*self._changes, name)
        self._begin_round()

    def _begin_round(self) -> None:
        """Fit the model with the changes made; all models of the round use its bodies.

        Without that, a change would make up for bodies and constants of friction that
        only the model without an earlier change needs.
        """
        setup = self._setup()
        logs = self._observe(setup)
        if setup.load_friction:
            # It follows bodies and transitions of a fit, first of that without it.
            self._fit(setup, logs)
        problem, self._weights = self._fit(setup, logs)
        self._names_of_fit = problem.base.names
        estimator = bounded_estimator(setup, problem)
        self._estimates = estimate_without_parts(problem, self.parts, estimator)
        if "Stribeck" in self._effects and "Stribeck" not in self._changes:
            base = base_parameters(self._model(self._effects["Stribeck"]))
            base = identify_stribeck_speeds(base, logs)
            self._effects["Stribeck"] = {
                "model": {"coulomb": {"stribeck": _stribeck_speeds(base)}}
            }
        self._sources: dict[str | None, ColumnSource] = {}

    def _fit(
        self, setup: Setup, logs: Sequence[Observations]
    ) -> tuple[RegressionProblem, Vector]:
        """Fit the model, and return its rows and weights of the joints."""
        base = find_friction_constants(base_parameters(self._model()), logs)
        problem = RegressionProblem(base, logs, divisions=DIVISIONS)
        estimate = setup.least_squares(problem)
        self._bodies = base.to_standard(estimate.parameters)
        self._transition = dry_transition(base.model.terms)
        return problem, estimate.weights

    def try_change(self, name: str) -> list[Trial]:
        """Return the errors with a further change; nothing if it does not go along."""
        try:
            return [self.trial(name)]
        except InputError:
            return []

    def trial(self, name: str | None = None) -> Trial:
        """Return the errors on the parts of the model, or of that with a change."""
        row_change = name if name in self._row_changes else None
        if row_change not in self._sources:
            self._sources[row_change] = self._column_source(row_change)
        source = self._sources[row_change]
        columns = list(source.first_columns)
        changes = self._changes
        if name is not None:
            columns += source.columns.get(name, [])
            changes = (*changes, name)
        # The first half is judged with the lengths of the second one.
        trials = [x.trial(changes, sorted(columns)) for x in source.products]
        squares = np.where(self._is_late, trials[0].squares, trials[-1].squares)
        # A Stribeck speed of each joint is a parameter too.
        size = trials[0].size
        if "Stribeck" in changes:
            size += len(self._max_speeds)
        return trials[0]._replace(size=size, squares=squares)

    def _effects_of_robot(self) -> dict[str, Keys]:
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
        return effects

    def _names(self, *changes: Keys) -> set[str]:
        return set(self._model(*changes).parameter_names)

    def _model(self, *changes: Keys) -> Model:
        """Return the model of the file with other keys, friction by load included."""
        setup = self._setup(*changes)
        terms = setup.model.terms
        if setup.load_friction:
            transition = dry_transition(terms)
            terms = (*terms, LoadFriction(bodies=self._bodies, transition=transition))
        return Model(setup.robot, terms)

    def _column_source(self, row_change: str | None) -> ColumnSource:
        """Evaluate and filter the columns of all effects that the model lacks."""
        row_keys = [] if row_change is None else [self._row_changes[row_change]]
        first_model = self._model(*row_keys)
        models = {
            name: self._model(keys, *row_keys)
            for name, keys in self._effects.items()
            if name not in self._changes
        }
        setup = self._setup(*row_keys)
        logs = self._observe(setup)
        terms = join_terms([first_model, *models.values()])
        model = Model(setup.robot, terms)
        # All models of a round share the speeds of the one with which it begins.
        if isinstance(self._transition, Tanh):
            model = model.with_transition_speeds(self._transition.speed)
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
                mask = log.mask & is_inside[:, None]
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

    def _priors(self, base: BaseParameters) -> tuple[Matrix, Vector]:
        """Return the bodies near which the fits stay, and how strongly."""
        priors = np.zeros((self.parts.size, base.size))
        first_columns = [base.names.index(name) for name in self._names_of_fit]
        priors[:, first_columns] = self._estimates
        # The columns of the bodies come first.
        bodies = base.model.terms[0].parameters(base.model.robot)
        is_body = np.array(base.indices) < len(bodies)
        return priors, np.where(is_body, BODY_RIDGE, RIDGE)

    def predict(self) -> list[HeldOutPrediction]:
        """Predict the parts by the file's own estimator, in the model's own band."""
        setup = self._setup()
        logs = self._observe(setup)
        base = find_friction_constants(base_parameters(self._model()), logs)
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


def _stribeck_speeds(base: BaseParameters) -> list[float]:
    """Return the Stribeck speeds of a model as an experiment file holds them."""
    term = next(x for x in base.model.terms if isinstance(x, StribeckFriction))
    speeds = np.asarray(term.speed)
    return [float(f"{speeds[joint]:.2g}") for joint in base.model.robot.driven]
