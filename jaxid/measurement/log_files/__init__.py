"""Log files as tables of columns: texts, Parquet, arrays, and bags."""

from ..log_columns import Selection as Selection, Selections as Selections
from .log_file import AbstractLogFile as AbstractLogFile
from .log_table import (
    COMMENT as COMMENT,
    NO_NUMBER as NO_NUMBER,
    Complaints as Complaints,
    LogTable as LogTable,
)
from .readers import (
    READERS as READERS,
    estimated_rows as estimated_rows,
    is_bag_folder as is_bag_folder,
    open_log_file as open_log_file,
    summarise_columns as summarise_columns,
)
