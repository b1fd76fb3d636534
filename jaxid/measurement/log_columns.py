"""Columns of a log file by name, and how an experiment file selects them.

This module imports neither JAX nor NumPy: a missing column is refused at once.
"""

import abc
import difflib
import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from jaxid.errors import InputError

Names = tuple[str, ...]
"""Names of columns or joints, in their order."""
Selection = str | int | tuple[str | int, ...]
"""A name, a pattern with `{}` for the joint's number, a position from 0, or several."""
Selections = Mapping[str, Selection | None]
"""Selections by channel; None is the clock that some kinds of files have."""
Channels = Mapping[str, Names]
"""Names of the columns of each channel, in the order of the joints."""


class AbstractLogColumns(abc.ABC):
    """The columns of a log file, which are selected by names or positions.

    Attributes:
        path: Path of the file.
        selections: Columns that will be read; a reader may leave out all others.
        joint_names: Names of the robot's joints; None if they are unknown.
        notes: Remarks about how columns were selected.
    """

    def __init__(
        self, path: Path, selections: Selections, joint_names: Names | None = None
    ):
        self.path = path
        self.selections = selections
        self.joint_names = joint_names
        self.notes: list[str] = []

    @property
    @abc.abstractmethod
    def names(self) -> Sequence[str]:
        """Names of the columns; their positions if there is no header."""

    @property
    def clock(self) -> str:
        """Column of time stamps that is taken if none is named; empty without one."""
        return ""

    @property
    def has_header(self) -> bool:
        """Whether the file names its columns."""
        return True

    def channels(self) -> Channels:
        """Return the names of each channel's columns, none of them for two channels."""
        channels = {}
        for channel, selection in self.selections.items():
            channels[channel] = self._selected_names(channel, selection)
        names = [*itertools.chain(*channels.values())]
        repeated_names = [name for name in names if names.count(name) > 1]
        if repeated_names:
            owners = [f"`{c}`" for c in channels if repeated_names[0] in channels[c]]
            raise InputError(
                f"the column `{repeated_names[0]}` of `{self.path.name}` is used "
                f"twice, for {' and '.join(owners)}: name the right one for each joint."
            )
        return channels

    def _selected_names(self, channel: str, selection: Selection | None) -> Names:
        """Return the names of a selection's columns, in the order of the joints."""
        if selection is None:
            return (self._clock_name(),)
        if isinstance(selection, tuple):
            return tuple(self._name(channel, column) for column in selection)
        has_elements = f"{selection}[0]" in self.names
        if has_elements and selection not in self.names:
            selection = f"{selection}[{{}}]"
        if isinstance(selection, str) and "{}" in selection:
            return self._numbered_names(channel, selection)
        return (self._name(channel, selection),)

    def _clock_name(self) -> str:
        if not self.clock:
            raise InputError(
                f"`{self.path.name}` has no clock of its own: give `time` (its column "
                "of time stamps) or `sample_time` [s]."
            )
        return self.clock

    def _numbered_names(self, channel: str, pattern: str) -> Names:
        """Return the columns whose names differ only in their numbers, in order."""
        expression = re.escape(pattern).replace(re.escape("{}"), r"(\d{1,18})")
        matches = [re.fullmatch(expression, name) for name in self.names]
        columns = sorted((int(match[1]), match[0]) for match in matches if match)
        if not columns:
            # Its error names the closest columns.
            return (self._name(channel, pattern.replace("{}", "1")),)
        numbers = [number for number, _ in columns]
        names = [name for _, name in columns]
        first_number = min(numbers[0], 1)
        last_number = first_number + len(numbers) - 1
        if numbers != list(range(first_number, last_number + 1)):
            raise InputError(
                f"the columns of `{self.path.name}` for `{channel}`, "
                f"`{'`, `'.join(names[:20])}`, must have the numbers from "
                f"{first_number} to {last_number}: name each."
            )
        return tuple(names)

    def _name(self, channel: str, column: str | int) -> str:
        """Return the name of a column that is named itself, or by its position."""
        names = self.names
        if isinstance(column, int) and 0 <= column < len(names):
            return names[column]
        if self.has_header and column in names:
            return str(column)
        if isinstance(column, int) or not self.has_header:
            words = "columns" if self.has_header else "no header, and columns"
            raise InputError(
                f"`{channel}` asks for column {column} of `{self.path.name}`, which "
                f"has {words} from 0 to {len(names) - 1}: give another position."
            )
        candidates = joined_elements(names)
        closest_names = difflib.get_close_matches(column, candidates, n=40, cutoff=0)
        raise InputError(
            f"`{self.path.name}` has no column `{column}` for `{channel}`: name one "
            f"of its columns, the closest first: `{'`, `'.join(closest_names)}`."
        )


def joined_elements(names: Iterable[str]) -> list[str]:
    """Return names, with one for all elements of an array, like `q[{}]`."""
    patterns = [re.sub(r"\[\d+\]$", "[{}]", name) for name in names]
    return list(dict.fromkeys(patterns))


def selected_names(selections: Selections) -> list[str]:
    """Return the names and patterns of columns that are selected."""
    names = []
    for selection in selections.values():
        columns = selection if isinstance(selection, tuple) else (selection,)
        names += [column for column in columns if isinstance(column, str)]
    return names


def has_column(names: Sequence[str], name: str) -> bool:
    """Return whether a name, or a pattern with `{}` for numbers, is among names."""
    pattern = re.escape(name).replace(re.escape("{}"), r"\d+")
    return any(re.fullmatch(rf"{pattern}(\[\d+\])?", cell) for cell in names)
