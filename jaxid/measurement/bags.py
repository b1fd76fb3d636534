"""Bags of ROS 1 and ROS 2 as columns, named like `/joint_states.position.shoulder`."""

import contextlib
import dataclasses
import itertools
import re
from array import array
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from jaxid.errors import InputError
from jaxid.io import import_extra

from .array_files import readable

BAGS = (".mcap", ".bag", ".db3")
"""Suffixes of files that are bags."""
STAMP, RECORDED = ".header.stamp", ".log_time"
"""Fields of each topic with the times of measurement and of recording."""
CLOCK = "time"
"""Column of the times that is taken if none is named."""


def is_bag(path: Path) -> bool:
    """Return whether a file is a bag, or a folder a bag of ROS 2."""
    return (path / "metadata.yaml").is_file() or path.suffix.lower() in BAGS


class Topic(NamedTuple):
    """Messages of a topic: their times [ns], and their numbers and values by column."""

    stamps: array
    recorded: array
    columns: dict[str, tuple[array, array]]


def read_bag(path: Path, selected: Collection[str]) -> list[Topic]:
    """Read the messages of selected topics, and one message of each other topic."""
    types, highlevel = (
        import_extra(f"rosbags.{x}", "logs", f"`{path.name}` is read by")
        for x in ("typesys", "highlevel")
    )
    latest, topics = types.get_typestore(types.Stores.LATEST), []
    kind = "bag that defines its messages"
    with (
        readable(path.name, kind),
        highlevel.AnyReader([path], default_typestore=latest) as bag,
    ):
        for name in dict.fromkeys(connection.topic for connection in bag.connections):
            raw = bag.messages([one for one in bag.connections if one.topic == name])
            read = (
                (time, bag.deserialize(data, one.msgtype)) for one, time, data in raw
            )
            if name in selected:
                topics.append(_topic(name, read))
            else:
                with contextlib.suppress(
                    Exception
                ):  # the bag may not define these messages
                    topics.append(_topic(name, itertools.islice(read, 1)))
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
                column = topic.columns.setdefault(
                    field + element, (array("q"), array("d"))
                )
                column[0].append(number)
                column[1].append(value)
    topic.columns[name + RECORDED] = topic.recorded, topic.recorded
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

    Texts called `name` or `joint_names` name the elements of all arrays of their
    length.
    """
    values = {
        field.name: getattr(message, field.name)
        for field in dataclasses.fields(message)
    }
    for key, texts in values.items():
        if re.search("(^|_)names?$", key) and isinstance(texts, list):
            elements = tuple(f".{text}" for text in texts)
            names = (
                {**names, len(texts): elements}
                if len({*elements}) == len(texts)
                else names
            )
    for key, value in values.items():
        field = prefix + key
        if isinstance(value, int | float):
            yield field, ("",), (value,)
        elif hasattr(value, "nanosec"):
            yield field, ("",), (value.sec + 1e-9 * value.nanosec,)
        elif dataclasses.is_dataclass(value):
            yield from _fields(value, f"{field}.", names)
        elif isinstance(value, np.ndarray | list) and 0 < len(value) <= 1000:
            elements = names.get(len(value)) or tuple(
                f"[{k}]" for k in range(len(value))
            )
            if isinstance(value, np.ndarray):
                yield field, elements, value.tolist()
            elif dataclasses.is_dataclass(value[0]):
                for element, item in zip(elements, value, strict=True):
                    yield from _fields(item, f"{field}{element}.", names)


def join_topics(
    source: str, topics: Sequence[Topic], names: Sequence[str]
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return columns at the times of the first one, and notes.

    The times are the stamps in the headers if all of the topics have them and no time
    of recording is asked for. Columns with other times are interpolated linearly.
    """
    clock = next(
        (x for x in names if x.endswith((STAMP, RECORDED)) or x == CLOCK), CLOCK
    )
    names = [name for name in names if name != clock]
    owners = {name: topic for topic in topics for name in topic.columns}
    stamped = clock != CLOCK or all(all(owners[name].stamps) for name in names)
    recorded = clock.endswith(RECORDED) or not stamped
    times, values = {}, {}
    for name in names:
        rows, values[name] = map(np.asarray, owners[name].columns[name])
        times[name] = np.asarray(
            owners[name].recorded if recorded else owners[name].stamps
        )[rows]
    first, main = times[names[0]], names[0].partition(".")[0]
    others = [name for name in names if not np.array_equal(times[name], first)]
    for name in others:
        values[name] = _interpolated(times[name], values[name], first)
    kept = np.all(
        [np.isfinite(values[name]) | (name not in others) for name in names], axis=0
    )
    if not kept.any():
        raise InputError(
            f"the topics of `{source}` overlap nowhere in time: compare their clocks."
        )
    notes = [
        f"`{topic}` is interpolated linearly at the times of `{main}`"
        for topic in dict.fromkeys(name.partition(".")[0] for name in others)
    ]
    if left := int(np.sum(~kept)):
        notes.append(
            f"{left} of {len(kept)} messages were left out: other topics pause there"
        )
    columns = {name: values[name][kept] for name in names}
    return {**columns, clock: pl.Series(first[kept].astype("M8[ns]"))}, tuple(notes)


def _interpolated(
    times: np.ndarray, values: np.ndarray, wanted: np.ndarray
) -> np.ndarray:
    """Return values between others; NaN outside and in their pauses."""
    order = np.argsort(times, kind="stable")
    # Float64 holds nanoseconds only if they do not count from 1970.
    own, new = ((x - wanted[0]).astype(np.float64) for x in (times[order], wanted))
    found = np.interp(new, own, values[order], left=np.nan, right=np.nan)
    steps = np.diff(own, prepend=own[0])
    after = np.minimum(np.searchsorted(own, new), len(own) - 1)
    # Where usual distances are exceeded threefold nothing is interpolated.
    pausing = (steps[after] > 3.0 * np.median(steps)) & (own[after] != new)
    return np.where(pausing, np.nan, found)
