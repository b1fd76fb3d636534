"""The part that all readers of log files have."""

import abc

from ..log_columns import AbstractLogColumns, Channels
from .log_table import BadRows, LogTable


class AbstractLogFile(AbstractLogColumns):
    """A log file, whose columns have names; those that are needed are read."""

    @abc.abstractmethod
    def table(self, channels: Channels, on_disk: bool, bad_rows: BadRows) -> LogTable:
        """Return the columns of some channels; on the disk if they can stay there.

        Complaints about rows that cannot be read go into `bad_rows`, by their numbers;
        the first one is an error if that is None.
        """

    def estimated_rows(self) -> int:
        """Estimate the number of rows; 0 if they cannot be read in parts."""
        return 0
