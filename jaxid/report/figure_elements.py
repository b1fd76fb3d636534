"""Elements of figures, without their style: curves in panels, and a robot in space.

`templates/figures.js` draws them on pages, `matplotlib_figures.py` in notebooks and
for papers.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Indices, Vector

# The palette of Okabe and Ito, which colour-blind readers can tell apart. Orange and
# sky are darker than theirs, so that lines have a contrast of 3 to 1 on white.
BLUE = "#0072B2"
ORANGE = "#C27D00"
VERMILION = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#3D9BD6"
INK = "#22262b"
GREY = "#7b8794"
PALE_GREY = "#d5dae0"
MEASUREMENT_COLOUR = GREY
PREDICTION_COLOUR = VERMILION
ERROR = BLUE
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, GREY)
"""Colours of joints in one panel."""
MAX_BINS = 600
"""Pixel columns of a line, of which each keeps its extremes if the line is longer."""
GAP_RATIO = 1.5
"""Time between two samples, relative to the median, from which a line has a gap."""


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """Line, points, bars, band or intervals in a panel."""

    x: Any  # abscissas
    y: Any  # ordinates
    name: str = ""  # entry of the legend; curves of one name are one entry
    colour: str = BLUE  # colour of all its parts
    # a band lies between `low` and `high`, intervals lie along x between them
    kind: Literal["line", "points", "bars", "band", "intervals"] = "line"
    width: float = 1.0  # width of the line [pt], or of the bars
    dashed: bool = False  # whether the line is dashed
    marker: bool = False  # whether a line has dots
    low: Any = None  # lower ends
    high: Any = None  # upper ends
    texts: Sequence[str] = ()  # text of each point; of bars written on them


@dataclasses.dataclass(frozen=True, eq=False)
class Panel:
    """Axes with curves."""

    curves: Sequence[Curve]  # what is drawn, the first one at the back
    title: str = ""  # title, such as the name of a joint
    value: str = ""  # measured value beside the title
    x: str = "time [s]"  # label of the abscissa
    y: str = ""  # label of the ordinate
    unit: str = ""  # unit of the ordinate
    log: str = ""  # logarithmic axes: `x`, `y` or both
    # limits of the abscissa; those of the curves if None
    x_range: tuple[float, float] | None = None
    # names of the abscissas 0, 1, …, instead of numbers
    x_names: Sequence[str] = ()
    # names of the ordinates 0, 1, … from the top, instead of numbers
    y_names: Sequence[str] = ()
    # thin lines across: `x` or `y`, value, colour
    levels: Sequence[tuple[str, float, str]] = ()
    # panels below this one with the same abscissa, smaller by their share
    below: Sequence["Panel"] = ()
    share: float = 1.0  # height relative to the first panel

    @property
    def parts(self) -> tuple["Panel", ...]:
        """This panel and those below it."""
        return (self, *self.below)

    @property
    def in_time(self) -> bool:
        """Whether the abscissa is time, in which lines have gaps and may be long."""
        return self.x.startswith("time")

    @property
    def y_label(self) -> str:
        """Label of the ordinate with its unit."""
        return f"{self.y} [{self.unit}]".lstrip() if self.unit else self.y


class Solids(NamedTuple):
    """Surfaces of triangles that move with the robot's bodies or stand still."""

    vertices: np.ndarray  # (vertices, 3): in the frames of their bodies [m]
    bodies: np.ndarray  # (vertices,): body of each vertex; -1 is the ground
    faces: np.ndarray  # (faces, 3): vertices of each triangle
    # (frames, bodies, 3, 4): rotation and origin of each body as [R r]
    places: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Robot along a motion in space."""

    time: Vector  # (samples,): their instants [s]
    points: np.ndarray  # (samples, points, 3): all bodies' origins, and the tip [m]
    # body from whose origin the line to each point leads; -1 for the ground
    links: Indices
    frames: np.ndarray  # samples at which the page shows the robot
    # (samples, joints): values of the joints, as colours; None for none
    values: np.ndarray | None = None
    label: str = ""  # name of the values, with their unit
    # shapes of the robot and around it, on a page; None for none
    solids: Solids | None = None

    @property
    def bones(self) -> np.ndarray:
        """Lines between joints and to the tip, (samples, points, 2, 3)."""
        ground = np.zeros_like(self.points[:, :1])
        # Link -1, the ground, is the last point.
        starts = np.concatenate([self.points, ground], axis=1)[:, list(self.links)]
        return np.stack([starts, self.points], axis=2)

    @property
    def mean(self) -> Vector:
        """Mean of the values of all joints."""
        if self.values is None:
            return np.zeros(len(self.time))
        return self.values.mean(axis=1)


@dataclasses.dataclass(frozen=True, eq=False)
class Drawing:
    """Panels with a title and one legend, or a robot in space.

    Attributes:
        title: Title above all panels.
        panels: Panels, in rows from the left.
        columns: Panels beside each other, where there is room.
        height: Height of each panel with those below it [inch].
        width: Width of all on paper [inch].
        scene: Robot in space, in place of panels.
    """

    title: str
    panels: Sequence[Panel] = ()
    columns: int = 1
    height: float = 2.1
    width: float = 11.0
    scene: Scene | None = None

    @property
    def legend(self) -> list[Curve]:
        """The first curve of each name."""
        entries: dict[str, Curve] = {}
        for panel in self.panels:
            for part in panel.parts:
                for curve in part.curves:
                    entries.setdefault(curve.name, curve)
        # Curves without a name have no entry.
        entries.pop("", None)
        return list(entries.values())


def decimate(
    time: AnyArray, values: AnyArray, bins: int = MAX_BINS
) -> tuple[Vector, Vector]:
    """Return points of a line: all if they are few, else least and largest of each bin.

    A peak of one sample stays visible however long the log is. Gaps in time become NaN,
    at which a line breaks; values that are NaN stay out of their bin.
    """
    times = np.asarray(time)
    ordinates = np.asarray(values)
    if len(times) < 2:
        return times, ordinates
    if len(times) <= 2 * bins:
        steps = np.diff(times)
        is_gap = steps > GAP_RATIO * np.median(steps)
        gaps = np.flatnonzero(is_gap) + 1
        return np.insert(times, gaps, np.nan), np.insert(ordinates, gaps, np.nan)

    elapsed_times = times - times[0]
    fractions = elapsed_times / elapsed_times[-1]
    numbers = (bins * fractions).astype(int)
    row_bins = np.minimum(numbers, bins - 1)
    first_rows = np.flatnonzero(np.diff(row_bins, prepend=-1))
    last_rows = np.append(first_rows[1:], len(times)) - 1
    low = np.fmin.reduceat(ordinates, first_rows)
    high = np.fmax.reduceat(ordinates, first_rows)

    # Two points for each bin, in the order that follows the line from end to end.
    is_falling = ordinates[last_rows] < ordinates[first_rows]
    starts = np.where(is_falling, high, low)
    ends = np.where(is_falling, low, high)
    # A bin without rows is a gap.
    bin_steps = np.diff(row_bins[first_rows])
    gaps = np.flatnonzero(bin_steps > 1) + 1
    bin_times = np.stack([times[first_rows], times[last_rows]], axis=1)
    bin_values = np.stack([starts, ends], axis=1)
    return (
        np.insert(bin_times, gaps, np.nan, axis=0).ravel(),
        np.insert(bin_values, gaps, np.nan, axis=0).ravel(),
    )
