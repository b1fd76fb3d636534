"""Choice of friction and estimator for an experiment file, by errors on unseen parts of logs."""

import copy
import itertools
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import tomlkit

from jaxid.dynamics.base import BaseParameters
from jaxid.dynamics.terms import TERMS
from jaxid.errors import InputError
from jaxid.identification.friction_laws import identify_presliding
from jaxid.identification.model_selection import (
    ModelCandidate,
    ModelChoice,
    choose_model,
)
from jaxid.measurement.observations import Observations, Progress

from .experiment import Experiment, parse_experiment
from .identify_logs import Stages, load_log, select_filter

Changes = dict[str, dict[str, Any]]
"""Keys that differ from those of a file, by their tables."""
KEYS: dict[str, dict[str, Any]] = {
    "viscous_asymmetric": {"viscous": "asymmetric"},
    "stribeck": {"coulomb": {"stribeck": 0.1}},
}
"""Keys of `[model]` for terms that are no switches."""
EFFECTS: dict[str, Changes] = {
    term.choice: {"model": KEYS.get(name, {name: True})}
    for name, term in TERMS.items()
    if term.choice
} | {"presliding": {"model": {"coulomb": {"presliding": True}}}}
"""Effects that the model may have beside those that each model has."""
PLAIN = "viscous, dry"
ESTIMATORS: dict[str, Changes] = {
    "least squares": {"estimator": {"kind": "weighted"}},
    "ridge": {"estimator": {"kind": "weighted", "ridge": "cross_validated"}},
}
"""Estimators beside the one that finds bodies that can exist."""


def choose(
    experiment: Experiment, logs: Sequence[Path], stage: Stages
) -> tuple[ModelChoice, str]:
    """Choose friction and estimator with some logs; return the choice and the text of a file."""
    if experiment.linear is not None:
        raise InputError(
            f"{experiment.path.name}: leave `estimator.nonlinear_friction` out: the "
            "choice is "
            "between models that are linear in their parameters."
        )
    experiment, _ = select_filter(experiment, logs, stage)
    observations = [load_log(experiment, path, stage)[1] for path in logs]
    stage("choosing the model")
    return choose_variant(experiment, observations, stage.through)


def choose_variant(
    experiment: Experiment,
    observations: Sequence[Observations],
    progress: Progress | None = None,
) -> tuple[ModelChoice, str]:
    """Choose between variants of an experiment file; return the choice and the text of its file."""
    changes = dict(_variants(tomllib.loads(experiment.text)))
    candidates = []
    for name, own in changes.items():
        try:
            variant = parse_experiment(_changed(experiment.text, own), experiment.path)
        except InputError:
            continue  # an effect that this robot cannot have
        candidates.append(
            ModelCandidate(name, variant.base, variant.estimation.estimator)
        )
    candidates = _with_lengths(candidates, observations)
    choice = choose_model(candidates, observations, progress=progress)
    return choice, _changed(experiment.text, changes[choice.chosen.name])


def _with_lengths(
    candidates: list[ModelCandidate], observations: Sequence[Observations]
) -> list[ModelCandidate]:
    """Return candidates with the lengths of presliding of the one with the most parameters."""
    preslide = [c.base for c in candidates if c.base.model.memory is not None]
    if not preslide:
        return candidates
    found = identify_presliding(max(preslide, key=lambda base: base.size), observations)
    length = getattr(found.model.memory, "length", None)

    def with_length(base: BaseParameters) -> BaseParameters:
        if base.model.memory is None:
            return base
        return eqx.tree_at(
            lambda b: b.model, base, base.model.with_memory(length=length)
        )

    return [c._replace(base=with_length(c.base)) for c in candidates]


def _variants(content: dict[str, Any]) -> Iterator[tuple[str, Changes]]:
    """Yield names and changes of all candidates, the file itself first."""
    yield "as the file says", {}
    given = content.get("model", {})
    bodies: Changes = {"estimator": {"kind": "consistent"}}
    for count in range(len(EFFECTS) + 1):
        for names in itertools.combinations(EFFECTS, count):
            changes = copy.deepcopy(bodies)
            for name in names:
                for key, value in EFFECTS[name]["model"].items():
                    inner = changes.setdefault("model", {})
                    before = inner.get(key, given.get(key, {}))
                    inner[key] = {**before, **value} if key == "coulomb" else value
            yield " + ".join((PLAIN, *names)), changes
    for name, own in ESTIMATORS.items():
        yield f"{PLAIN}, {name}", own


def _changed(text: str, changes: Changes) -> str:
    """Return the text of an experiment file with other keys; all others keep their comments."""
    document = tomlkit.parse(text)
    for table, keys in changes.items():
        own: Any = document.setdefault(table, tomlkit.table())
        if table == "estimator":
            # Keys of another kind of estimator would contradict.
            for key in ("ridge", "truncate", "essential", "limit", "reference"):
                own.pop(key, None)
        for key, value in keys.items():
            own[key] = value
    return tomlkit.dumps(document)
