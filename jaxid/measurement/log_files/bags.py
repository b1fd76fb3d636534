"""Bags of ROS 1 and ROS 2 as columns, named like `/joint_states.position.shoulder`."""

import contextlib
import dataclasses
import functools
import itertools
import re
import struct
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from jaxid.io import import_extra

from ..log_columns import Selections
from .log_file import AbstractLogFile
from .log_table import LogTable, readable, refuse_inflation

STAMP = ".header.stamp"
"""Field of a topic with the times of measurement."""
RECORDING_TIME = ".log_time"
"""Field of a topic with the times of recording."""
CLOCK = "time"
"""Column of the times that is taken if none is named."""
MAX_ELEMENTS = 1000
"""Elements of the largest array that is no picture or point cloud."""
MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First bytes of an MCAP file."""
MCAP_TAG = struct.Struct("<BQ")
"""Code and size of a record of such a file."""
MCAP_CHUNK = 6
"""Code of records that hold compressed messages."""
ROS1_MAGIC = b"#ROSBAG V2.0\n"
"""First bytes of a bag of ROS 1."""
ROS1_CHUNK = re.compile(rb"\x09\x00\x00\x00size=(.{4})", re.DOTALL)
"""Field of a header with the size of compressed messages."""

Elements = tuple[str, ...]
"""Endings of the names of a field's numbers, such as `[0]` or `.shoulder`."""
Field = tuple[str, Elements, Sequence[float]]
"""Name, elements and numbers of one field of a message."""


class BagFile(AbstractLogFile):
    """Bag of ROS, with fields of messages as columns."""

    @functools.cached_property
    def topics(self) -> "list[Topic]":
        """Topics of the bag: all messages of the needed ones, one of each other."""
        return read_bag(self.path, selected_topics(self.selections))

    @property
    def names(self):  # noqa: D102
        return [name for topic in self.topics for name in topic.columns]

    @property
    def clock(self):  # noqa: D102
        return CLOCK

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        names = list(itertools.chain(*channels.values()))
        joined_topics = join_topics(self.topics, names)
        return LogTable(
            self.path.name,
            joined_topics.columns,
            channels,
            bad_rows=bad_rows,
            notes=tuple(self.notes),
            is_merged=joined_topics.is_merged,
        )

    def _numbered_names(self, channel, pattern):
        """Return the elements of an array by the names that its messages state."""
        names = super()._numbered_names(channel, pattern)
        if not pattern.endswith("[{}]") or self.joint_names is None:
            return names
        prefix = pattern.removesuffix("[{}]") + "."
        elements = [
            name.removeprefix(prefix) for name in self.names if name.startswith(prefix)
        ]
        is_by_name = set(self.joint_names) <= set(elements)
        if is_by_name:
            names = tuple(prefix + joint for joint in self.joint_names)
        # The angles tell the order of the other channels, too.
        is_other_order = elements[: len(names)] != [*self.joint_names]
        if elements and is_other_order and channel == "angles":
            way = "by place"
            cure = "list the columns if that is not the order of the robot"
            if is_by_name:
                way = "by name"
                cure = f"`{prefix}{{name}}` says the same"
            self.notes.append(
                f"`{pattern}` is read {way}: its messages hold the joints "
                f"{', '.join(elements)} in this order ({cure})"
            )
        return names


def selected_topics(selections: Selections) -> set[str]:
    """Return the topics of columns."""
    topics = set()
    for selection in selections.values():
        columns = selection if isinstance(selection, tuple) else [selection]
        topics |= set(map(topic_of, columns))
    return topics


def topic_of(column: str | int | None) -> str:
    """Return the topic of a column: the part of its name before a point."""
    return str(column).partition(".")[0]


class TimeSeries(NamedTuple):
    """Values of a field and their times."""

    times: np.ndarray  # [ns]
    values: np.ndarray

    def at(self, times: np.ndarray) -> np.ndarray:
        """Return the values at all times of a table [ns]; NaN where there is none."""
        column = np.full(len(times), np.nan)
        column[np.searchsorted(times, self.times)] = self.values
        return column


class Topic(NamedTuple):
    """Messages of a topic."""

    stamps: array  # times of measurement [ns]; zeros if the messages have none
    recording_times: array  # [ns]
    columns: dict[str, tuple[array, array]]  # numbers of messages, and their values

    def time_series(self, column: str, are_recorded: bool) -> TimeSeries:
        """Return a column's values by the times of recording, or of measurement."""
        rows, values = map(np.asarray, self.columns[column])
        times = self.recording_times if are_recorded else self.stamps
        return TimeSeries(np.asarray(times)[rows], values)


def refuse_huge_chunks(path: Path) -> None:
    """Refuse a bag whose compressed messages do not suit the size of their file."""
    for file_path in path.glob("*") if path.is_dir() else [path]:
        size = max(chunk_sizes(file_path), default=0)
        refuse_inflation(file_path, {"a chunk of messages": size})


def chunk_sizes(path: Path) -> Iterator[int]:
    """Yield the sizes of the chunks of a bag, decompressed [bytes]."""
    end = path.stat().st_size
    with path.open("rb") as file:
        magic = file.read(len(ROS1_MAGIC))
        if magic.startswith(MCAP_MAGIC):
            file.seek(len(MCAP_MAGIC))
            while len(tag := file.read(MCAP_TAG.size)) == MCAP_TAG.size:
                code, size = MCAP_TAG.unpack(tag)
                next_record = min(file.tell() + size, end)
                if code == MCAP_CHUNK:
                    _, _, chunk_size = struct.unpack("<QQQ", file.read(24).ljust(24))
                    yield chunk_size
                file.seek(next_record)
        while magic == ROS1_MAGIC and (tag := file.read(4)):
            header = file.read(int.from_bytes(tag, "little"))
            if chunk := ROS1_CHUNK.search(header):
                yield int.from_bytes(chunk[1], "little")
            size = int.from_bytes(file.read(4), "little")
            file.seek(size, 1)


def read_bag(path: Path, needed_topics: Collection[str]) -> list[Topic]:
    """Read the messages of selected topics, and one message of each other topic."""
    purpose = f"`{path.name}` is read by"
    typesys = import_extra("rosbags.typesys", "logs", purpose)
    highlevel = import_extra("rosbags.highlevel", "logs", purpose)
    with readable(path.name, "bag"):
        refuse_huge_chunks(path)
    types = typesys.get_typestore(typesys.Stores.LATEST)
    topics = []
    with (
        readable(path.name, "bag that defines its messages"),
        highlevel.AnyReader([path], default_typestore=types) as bag,
    ):
        for name in dict.fromkeys(connection.topic for connection in bag.connections):
            messages = _messages(bag, name)
            if name in needed_topics:
                topics.append(_topic(name, messages))
            else:
                # The bag need not define messages that are not needed.
                with contextlib.suppress(Exception):
                    topics.append(_topic(name, itertools.islice(messages, 1)))
    return topics


def _messages(bag: Any, topic: str) -> Iterator[tuple[int, Any]]:
    """Yield the messages of a topic with their times of recording [ns]."""
    connections = [x for x in bag.connections if x.topic == topic]
    for connection, time, data in bag.messages(connections):
        yield time, bag.deserialize(data, connection.msgtype)


def _topic(name: str, messages: Iterable[tuple[int, Any]]) -> Topic:
    """Collect the numbers of messages by column."""
    topic = Topic(array("q"), array("q"), {})
    # Elements of each field in the order of their first message, by the set of them.
    variants: dict[str, dict[frozenset, Elements]] = {}
    for number, (time, message) in enumerate(messages):
        topic.stamps.append(_stamp(message))
        topic.recording_times.append(time)
        for field, elements, values in _fields(message, f"{name}.", {}):
            orders = variants.setdefault(field, {})
            orders.setdefault(frozenset(elements), elements)
            for element, value in zip(elements, values, strict=True):
                empty_column = (array("q"), array("d"))
                name_in_bag = field + element
                numbers, column = topic.columns.setdefault(name_in_bag, empty_column)
                numbers.append(number)
                column.append(value)

    times = topic.recording_times
    topic.columns[name + RECORDING_TIME] = times, times
    for field, orders in variants.items():
        _name_by_position(topic, field, [*orders.values()])
    return topic


def _stamp(message: Any) -> int:
    """Return the time of measurement of a message [ns]; 0 if it has none."""
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    return 0 if stamp is None else stamp.sec * 10**9 + stamp.nanosec


def _name_by_position(topic: Topic, field: str, orders: Sequence[Elements]) -> None:
    """Give the elements of a field positions; remove those that mean nothing.

    Positions mean nothing if messages differ in their elements, as those of two robots
    on one topic do.
    """
    columns = topic.columns
    if len(orders) == 1 and orders[0] != ("",):
        for k, element in enumerate(orders[0]):
            columns[f"{field}[{k}]"] = columns[field + element]
    if len(orders) > 1:
        for element in itertools.chain(*orders):
            if element.startswith("["):
                columns.pop(field + element, None)


def _fields(
    message: Any, prefix: str, element_names: Mapping[int, Elements]
) -> Iterator[Field]:
    """Yield the fields with numbers of a message and of those within it.

    Texts called `name` or `joint_names` name the elements of all arrays of their
    length: `element_names` holds them by their number.
    """
    values = {x.name: getattr(message, x.name) for x in dataclasses.fields(message)}
    element_names = {**element_names, **_named_elements(values)}
    for key, value in values.items():
        name = prefix + key
        if isinstance(value, int | float):
            yield name, ("",), (value,)
        elif hasattr(value, "nanosec"):
            yield name, ("",), (value.sec + 1e-9 * value.nanosec,)
        elif dataclasses.is_dataclass(value):
            yield from _fields(value, f"{name}.", element_names)
        elif isinstance(value, np.ndarray | list) and 0 < len(value) <= MAX_ELEMENTS:
            yield from _array_fields(value, name, element_names)


def _named_elements(values: Mapping[str, Any]) -> dict[int, Elements]:
    """Return the names of elements that a message lists, by the number of elements."""
    elements = {}
    for key, texts in values.items():
        has_names = re.search("(^|_)names?$", key) and isinstance(texts, list)
        if has_names and len(set(texts)) == len(texts):
            elements[len(texts)] = tuple(f".{text}" for text in texts)
    return elements


def _array_fields(
    values: Any, name: str, element_names: Mapping[int, Elements]
) -> Iterator[Field]:
    """Yield the fields of an array of numbers, or of a list of messages."""
    positions = tuple(f"[{k}]" for k in range(len(values)))
    elements = element_names.get(len(values)) or positions
    if isinstance(values, np.ndarray):
        yield name, elements, values.tolist()
    elif dataclasses.is_dataclass(values[0]):
        for element, item in zip(elements, values, strict=True):
            yield from _fields(item, f"{name}{element}.", element_names)


class JoinedTopics(NamedTuple):
    """Columns of some topics at common times."""

    columns: dict[str, Any]  # NaN where a column has no value
    is_merged: bool  # whether some columns have times of their own


def join_topics(topics: Sequence[Topic], names: Sequence[str]) -> JoinedTopics:
    """Return columns at all of their times, with a column of these times."""
    clocks = [x for x in names if x.endswith((STAMP, RECORDING_TIME)) or x == CLOCK]
    clock = clocks[0] if clocks else CLOCK
    owners = {name: topic for topic in topics for name in topic.columns}
    owners = {name: owners[name] for name in names if name != clock}

    are_recorded = clock.endswith(RECORDING_TIME)
    if clock == CLOCK:
        # Stamps of the headers count if all of the topics have them.
        are_recorded = not all(all(topic.stamps) for topic in owners.values())
    series = [topic.time_series(name, are_recorded) for name, topic in owners.items()]
    times = series[0].times
    is_merged = not all(np.array_equal(x.times, times) for x in series)
    values = [x.values for x in series]
    if is_merged:
        times = np.unique(np.concatenate([x.times for x in series]))
        values = [x.at(times) for x in series]

    columns: dict[str, Any] = dict(zip(owners, values, strict=True))
    columns[clock] = pl.Series(times.astype("M8[ns]"))
    return JoinedTopics(columns, is_merged)
