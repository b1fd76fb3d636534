"""Changes of the model in an experiment file, one at a time, as keys of its tables."""

from collections.abc import Mapping
from typing import Any

import tomlkit

from jaxid.dynamics.terms import TERMS

Keys = dict[str, dict[str, Any]]
"""Keys of an experiment file by their tables."""

EFFECTS: dict[str, Keys] = {
    term.choice: {"model": term.choice_keys or {name: True}}
    for name, term in TERMS.items()
    if term.choice
}
EFFECTS |= {
    "friction by load": {"model": {"load": True}},
    "ripple of motors": {"model": {"motor_ripple": [1]}},
    "ripple of joints": {"model": {"joint_ripple": [1, 2]}},
    "offsets": {"model": {"offset": True}},
}
"""Effects that add columns to a model."""
PRESLIDING: Keys = {"model": {"coulomb": {"presliding": True}}}
"""Friction with memory, which takes the place of that without."""


def changed_text(text: str, *changes: Keys) -> str:
    """Return the text of an experiment file with other keys; comments are kept."""
    document = tomlkit.parse(text)
    for keys in changes:
        for name, table in keys.items():
            if name not in document:
                document[name] = tomlkit.table()
            _merge(document[name], table)
    return tomlkit.dumps(document)


def _merge(table: Any, keys: Mapping[str, Any]) -> None:
    """Set keys in a table, and in tables within it."""
    for name, value in keys.items():
        if not isinstance(value, Mapping):
            table[name] = value
            continue
        if not isinstance(table.get(name), Mapping):
            table[name] = tomlkit.inline_table()
        _merge(table[name], value)
