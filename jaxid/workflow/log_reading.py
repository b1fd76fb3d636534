"""Settings of reading: files, parts, gaps, bad rows, and the delay of the forces."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from jaxid.measurement.log_files import Selection
from jaxid.measurement.reading import MAX_BAD_ROWS

from .allowed_values import Bounds


@dataclasses.dataclass(frozen=True)
class LogReading:
    """Files and parts of the logs, and how they are read.

    Attributes:
        forces_file: File of the forces, if they lie in another file beside the log,
            like `"{}_torque.csv"`: "{}" stands for the log's name without its suffix.
        velocities_file: File of the velocities, likewise, like `"{}_speed.csv"`.
        commands: Columns of the commanded angles, like `"cmd{}"`: with them `jaxid
            inspect` tells a delay in spite of disturbances, and `jaxid rollout` needs
            no `forces`.
        force_delay: Time by which forces stand later in the log than angles [s].
        largest_gap: Longest pause that is bridged, in sample times; a tenth of the
            period of the filter's cut-off frequency is bridged in any case.
        bad_rows: Fraction of the rows that may be bad, and are left out.
        start: Start of the part of every log that is used [s], like `0.0`.
        stop: End of that part [s], like `10.0`.
    """

    forces_file: str | None = None
    velocities_file: str | None = None
    commands: Selection | None = None
    force_delay: float = 0.0
    largest_gap: Annotated[float, Bounds(above=1.0)] = 1.75
    bad_rows: Annotated[float, Bounds(minimum=0.0, below=1.0)] = MAX_BAD_ROWS
    start: float = -np.inf
    stop: float = np.inf

    def files(self, log: Path) -> dict[str, Any]:
        """Return the paths of the files beside a log, as the readers take them."""
        names = {
            "forces_path": self.forces_file,
            "velocities_path": self.velocities_file,
        }
        return {
            key: None if name is None else log.parent / name.replace("{}", log.stem)
            for key, name in names.items()
        }
