"""Bags of ROS 1 and ROS 2 as columns, named like `/joint_states.position.shoulder`."""

import dataclasses
import functools
import itertools
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from jaxid.errors import InputError

from .array_files import library, readable

BAGS = (".mcap", ".bag", ".db3")
"""Suffixes of files that are bags."""
WIDEST = 1000
"""Most numbers of an array that are columns: images are none."""
LONGEST_PAUSE = 3.0
"""Longest pause between two values that are interpolated, in their usual distance."""
STAMP, RECORDED = ".header.stamp", ".log_time"
"""Fields of each topic with the times of measurement and of recording."""
CLOCK = "time"
"""Column of the times that is taken if none is named."""


def is_bag(path: Path) -> bool:
    """Return whether a file is a bag, or a folder a bag of ROS 2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix.lower() in BAGS


class Topic(NamedTuple):
    """Messages of a topic: their times [ns], and their numbers and values by column."""

    stamps: array
    recorded: array
    columns: dict[str, tuple[array, array]]


def read_bag(path: Path, selected: Collection[str]) -> list[Topic]:
    """Read the messages of selected topics, and one message of each other topic.

    Raises:
        InputError: If the bag is damaged, or does not define the messages of a selected topic.
    """
    types, topics = library("rosbags.typesys", path.name), []
    latest = types.get_typestore(types.Stores.LATEST)
    highlevel = library("rosbags.highlevel", path.name)
    with readable(path, "bag"), highlevel.AnyReader([path], default_typestore=latest) as bag:
        for name in dict.fromkeys(connection.topic for connection in bag.connections):
            raw = bag.messages([one for one in bag.connections if one.topic == name])
            read = ((time, bag.deserialize(data, one.msgtype)) for one, time, data in raw)
            try:
                topics.append(_topic(name, read if name in selected else itertools.islice(read, 1)))
            except Exception as error:  # of many kinds: no definition, or damaged bytes
                if name in selected:
                    raise InputError(
                        f"`{name}` of `{path.name}` cannot be read ({error!r}): record it as MCAP, "
                        "which holds the definitions of its messages."
                    ) from error
    return topics


def _topic(name: str, messages: Iterable[tuple[int, Any]]) -> Topic:
    topic = Topic(array("q"), array("q"), {})
    orders: dict[str, dict[frozenset[str], tuple[str, ...]]] = {}
    for number, (time, message) in enumerate(messages):
        stamp = getattr(getattr(message, "header", None), "stamp", None)
        topic.stamps.append(0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec)
        topic.recorded.append(time)
        for field, elements, values in _fields(message, f"{name}.", {}):
            orders.setdefault(field, {}).setdefault(frozenset(elements), elements)
            for element, value in zip(elements, values, strict=True):
                column = topic.columns.setdefault(field + element, (array("q"), array("d")))
                column[0].append(number)
                column[1].append(value)
    count = len(topic.recorded)
    topic.columns[name + RECORDED] = array("q", range(count)), array("d", topic.recorded)
    for field, kinds in orders.items():
        for k, element in enumerate(itertools.chain(*kinds.values())):
            if len(kinds) == 1 and element:
                topic.columns[f"{field}[{k}]"] = topic.columns[field + element]
            elif element.startswith("["):
                # Positions mean nothing if messages differ in their elements.
                topic.columns.pop(field + element, None)
    return topic


def _fields(
    message: Any, prefix: str, names: Mapping[int, tuple[str, ...]]
) -> Iterator[tuple[str, tuple[str, ...], Sequence[float]]]:
    """Yield names, elements and values of the numbers in a message and in those within it.

    Texts called `name` or `joint_names` name the elements of all arrays of their length.
    """
    values = {field.name: getattr(message, field.name) for field in dataclasses.fields(message)}
    for key, texts in values.items():
        if re.search("(^|_)names?$", key) and isinstance(texts, list):
            elements = tuple(f".{text}" for text in texts)
            names = {**names, len(texts): elements} if len({*elements}) == len(texts) else names
    for key, value in values.items():
        field = prefix + key
        if isinstance(value, int | float):
            yield field, ("",), (value,)
        elif hasattr(value, "nanosec"):
            yield field, ("",), (value.sec + 1e-9 * value.nanosec,)
        elif dataclasses.is_dataclass(value):
            yield from _fields(value, f"{field}.", names)
        elif isinstance(value, np.ndarray | list) and 0 < len(value) <= WIDEST:
            elements = names.get(len(value)) or _positions(len(value))
            if isinstance(value, np.ndarray):
                yield field, elements, value.tolist()
            elif dataclasses.is_dataclass(value[0]):
                for element, item in zip(elements, value, strict=True):
                    yield from _fields(item, f"{field}{element}.", names)


@functools.cache
def _positions(count: int) -> tuple[str, ...]:
    return tuple(f"[{k}]" for k in range(count))


def join_topics(
    source: str, topics: Sequence[Topic], names: Sequence[str]
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return columns at the times of the first one, and notes.

    The times are the stamps in the headers if all of the topics have them and no time of recording
    is asked for. Columns with other times are interpolated linearly.

    Raises:
        InputError: If the columns do not overlap in time.
    """
    clocks = [name for name in names if name.endswith((STAMP, RECORDED)) or name == CLOCK]
    names = [name for name in names if name not in clocks]
    owners = {name: topic for topic in topics for name in topic.columns}
    recorded = any(name.endswith(RECORDED) for name in clocks)
    if clocks == [CLOCK]:
        recorded = not all(all(owners[name].stamps) for name in names)
    times, values = {}, {}
    for name in names:
        rows, values[name] = map(np.asarray, owners[name].columns[name])
        times[name] = np.asarray(owners[name].recorded if recorded else owners[name].stamps)[rows]
    first = times[names[0]]
    others = [name for name in names if not np.array_equal(times[name], first)]
    covered = [_covered(times[name], first) for name in others]
    kept = np.all([np.full(len(first), True), *covered], axis=0)
    if not kept.any():
        raise InputError(
            f"`{names[0]}` and `{others[0]}` of `{source}` do not overlap in time: compare their "
            "clocks."
        )
    notes = [
        f"`{topic}` is interpolated linearly at the times of `{names[0].partition('.')[0]}`"
        for topic in dict.fromkeys(name.partition(".")[0] for name in others)
    ]
    if left := int(np.sum(~kept)):
        notes.append(f"{left} of {len(kept)} messages were left out: other topics pause there")
    wanted = first[kept]
    columns: dict[str, Any] = dict.fromkeys(clocks, pl.Series(wanted.astype("M8[ns]")))
    for name in names:
        same = name not in others
        columns[name] = (
            values[name][kept] if same else _interpolated(times[name], values[name], wanted)
        )
    return columns, tuple(notes)


def _interpolated(times: np.ndarray, values: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    order = np.argsort(times, kind="stable")
    # Float64 holds nanoseconds only if they do not count from 1970.
    own, new = ((x - wanted[0]).astype(np.float64) for x in (times[order], wanted))
    return np.interp(new, own, values[order])


def _rate(times: np.ndarray) -> float:
    """Return the usual number of messages in a second."""
    return 1e9 / max(float(np.median(np.diff(np.sort(times)))), 1.0) if len(times) > 1 else 0.0


def _covered(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return which times lie between values, but not in a pause."""
    times = np.sort(times)
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1)) % len(times)
    pauses = (times[after] - times[after - 1]) * 1e-9 * _rate(times)
    inside = (times[0] <= wanted) & (wanted <= times[-1])
    return inside & ((pauses <= LONGEST_PAUSE) | (times[after] == wanted))
