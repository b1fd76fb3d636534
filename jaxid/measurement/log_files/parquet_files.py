"""Parquet files, also those of LeRobot data sets, with lists of numbers in cells."""

import functools
import itertools

import polars as pl

from .array_files import MAX_COLUMNS
from .log_file import AbstractLogFile
from .log_table import NUMBER_SIZE, LogTable, readable, refuse_inflation

PAUSE = 10.0
"""Time from one episode of a data set to the next [s]: a gap in any log."""


class ParquetFile(AbstractLogFile):
    """Parquet file, which is read from the disk part by part.

    Elements of lists are columns, like `action[0]`. LeRobot data sets have their own
    clock, which begins again with each episode.
    """

    @functools.cached_property
    def frame(self) -> pl.LazyFrame:
        """Columns of the file, with those of lists, and its consecutive episodes."""
        with readable(self.path.name, "Parquet file"):
            frame = with_elements(pl.scan_parquet(self.path))
            return with_consecutive_episodes(frame) if has_episodes(frame) else frame

    @property
    def names(self):  # noqa: D102
        return self.frame.collect_schema().names()

    @property
    def clock(self):  # noqa: D102
        return "timestamp" if has_episodes(self.frame) else ""

    def table(self, channels, on_disk, bad_rows):  # noqa: D102
        table = LogTable(self.path.name, self.frame, channels, bad_rows=bad_rows)
        if not on_disk:
            names = itertools.chain(*channels.values())
            sizes = dict.fromkeys(names, NUMBER_SIZE * table.rows)
            refuse_inflation(self.path, sizes)
        return table

    def estimated_rows(self):  # noqa: D102
        return LogTable(self.path.name, pl.scan_parquet(self.path), {}).rows


def has_episodes(frame: pl.LazyFrame) -> bool:
    """Return whether a frame is that of a LeRobot data set."""
    return {"timestamp", "episode_index"} <= set(frame.collect_schema())


def with_elements(frame: pl.LazyFrame) -> pl.LazyFrame:
    """Return a frame with columns in place of lists, named like `action[0]`."""
    schema = frame.collect_schema()
    lists = {
        name: kind
        for name, kind in schema.items()
        if isinstance(kind, pl.List | pl.Array)
    }
    first_row = frame.select(list(lists)).head(1).collect()
    columns = []
    for name, kind in lists.items():
        elements = pl.col(name).cast(pl.List(kind.inner)).list
        values = first_row[name].to_list()
        length = len(values[0] or ()) if values else 0
        # A longer list is a picture or a sound, whose elements are no columns.
        for k in range(length if length <= MAX_COLUMNS else 0):
            element = elements.get(k, null_on_oob=True)
            columns.append(element.alias(f"{name}[{k}]"))
    return frame.with_columns(columns).drop(list(lists))


def with_consecutive_episodes(frame: pl.LazyFrame) -> pl.LazyFrame:
    """Return a frame whose stamps run on from episode to episode, after a pause."""
    stamps = pl.col("timestamp").cast(pl.Float64)
    is_start = (pl.col("episode_index").diff() != 0).fill_null(False)
    shifts = pl.when(is_start).then(PAUSE - stamps.diff()).otherwise(0.0)
    return frame.with_columns((stamps + shifts.cum_sum()).alias("timestamp"))
