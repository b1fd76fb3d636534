"""Variants of an experiment file, to choose from: other friction or estimators."""

import copy
import itertools
import tomllib
from collections.abc import Iterator
from typing import Any

import tomlkit

from jaxid.dynamics.terms import TERMS
from jaxid.errors import InputError

from .experiment import Experiment, parse_experiment

Changes = dict[str, dict[str, Any]]
"""Keys that differ from those of a file, by their tables."""
EFFECTS: dict[str, dict[str, Any]] = {
    term.choice: term.choice_keys or {name: True}
    for name, term in TERMS.items()
    if term.choice
}
EFFECTS["presliding"] = {"coulomb": {"presliding": True}}
"""Effects that a model may have beside those of each model, as keys of `[model]`."""
COMMON_EFFECTS = "viscous, dry"
ESTIMATORS: dict[str, Changes] = {
    "least squares": {"estimator": {"kind": "weighted"}},
    "ridge": {"estimator": {"kind": "weighted", "ridge": "cross_validated"}},
}
"""Estimators beside the one that finds bodies that can exist."""


def variants(experiment: Experiment) -> dict[str, Experiment]:
    """Return all variants of an experiment that its robot can have, by their names."""
    experiments = {}
    for name, changes in _changes(tomllib.loads(experiment.text)):
        text = changed_text(experiment.text, changes)
        try:
            experiments[name] = parse_experiment(text, experiment.path)
        except InputError:
            continue  # an effect that this robot cannot have
    return experiments


def _changes(tables: dict[str, Any]) -> Iterator[tuple[str, Changes]]:
    """Yield names and changes of all variants, the file itself first."""
    yield "as the file says", {}
    for count in range(len(EFFECTS) + 1):
        for names in itertools.combinations(EFFECTS, count):
            model: dict[str, Any] = {}
            for name in names:
                model |= copy.deepcopy(EFFECTS[name])
            # Keys of dry friction are added to each other, and to those of the file.
            dry_friction = [EFFECTS[name].get("coulomb") for name in names]
            if any(dry_friction):
                keys_of_file = tables.get("model", {}).get("coulomb")
                table = {**keys_of_file} if isinstance(keys_of_file, dict) else {}
                for keys in filter(None, dry_friction):
                    table |= keys
                model["coulomb"] = table
            changes = {"estimator": {"kind": "consistent"}, "model": model}
            yield " + ".join((COMMON_EFFECTS, *names)), changes
    for name, changes in ESTIMATORS.items():
        yield f"{COMMON_EFFECTS}, {name}", changes


def changed_text(text: str, changes: Changes) -> str:
    """Return the text of an experiment file with other keys; comments are kept."""
    document = tomlkit.parse(text)
    for name, keys in changes.items():
        if not keys:
            continue
        table: Any = document.setdefault(name, tomlkit.table())
        if name == "estimator":
            # It would contradict another kind of estimator.
            table.pop("ridge", None)
        for key, value in keys.items():
            table[key] = value
    return tomlkit.dumps(document)
