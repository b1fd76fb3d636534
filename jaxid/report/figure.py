"""Figures, each defined once: `interactive.py` shows them on pages, `paper.py` by matplotlib."""

import dataclasses
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxid.arrays import AnyArray, Float, Int

# The palette of Okabe and Ito, which colour-blind readers can tell apart.
BLUE, ORANGE, VERMILION = "#0072B2", "#E69F00", "#D55E00"
GREEN, PURPLE, SKY = "#009E73", "#CC79A7", "#56B4E9"
INK, GREY, PALE = "#22262b", "#7b8794", "#d5dae0"
MEASURED, PREDICTED, ERROR = "#9aa6b2", VERMILION, BLUE
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, GREY)
"""Colours of joints in one panel."""


@dataclasses.dataclass(frozen=True, eq=False)
class Curve:
    """Line, points, bars, band or intervals in a panel."""

    x: Any  # abscissas
    y: Any  # ordinates
    name: str = ""  # entry of the legend; curves of one name are one entry
    colour: str = BLUE  # colour of all its parts
    # a band lies between `low` and `high`, intervals lie along x between them
    kind: Literal["line", "points", "bars", "band", "intervals"] = "line"
    width: float = 1.0  # width of the line [pt]
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
    # limits of abscissa and ordinate; those of the curves if None
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    x_names: Sequence[str] = ()  # names of the abscissas 0, 1, …, instead of numbers
    y_names: Sequence[
        str
    ] = ()  # names of the ordinates 0, 1, … from the top, instead of numbers
    beside: Sequence[str] = ()  # texts to the right of these names
    levels: Sequence[
        tuple[str, float, str]
    ] = ()  # thin lines across: `x` or `y`, value, colour
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
        return " ".join(filter(None, (self.y, self.unit and f"[{self.unit}]")))


class Solids(NamedTuple):
    """Surfaces of triangles that move with the robot's bodies, or stand on the ground."""

    vertices: Float[
        np.ndarray, "vertices 3"
    ]  # vertices in the frames of their bodies [m]
    bodies: Int[np.ndarray, " vertices"]  # body of each vertex; -1 is the ground
    faces: Int[np.ndarray, "faces 3"]  # vertices of each triangle
    # rotation and origin of each body at the frames of the scene, as [R r]
    places: Float[np.ndarray, "frames bodies 3 4"]

    @property
    def placed(self) -> Float[np.ndarray, "frames vertices 3"]:
        """Vertices in the frame of the ground [m]."""
        still = np.broadcast_to(np.eye(3, 4), (len(self.places), 1, 3, 4))
        places = np.concatenate([self.places, still], axis=1)[:, self.bodies]
        return (
            np.einsum("fvij,vj->fvi", places[..., :3], self.vertices) + places[..., 3]
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Robot along a motion in space."""

    time: Float[np.ndarray, " samples"]  # instants of the samples [s]
    points: Float[
        np.ndarray, "samples points 3"
    ]  # origins of all bodies, and the end-effector [m]
    links: tuple[
        int, ...
    ]  # body from whose origin the line to each point leads; -1 for the ground
    frames: Int[np.ndarray, " frames"]  # samples at which the page shows the robot
    poses: int = 6  # number of poses on paper
    # values of the joints at the samples, as colours; None for none
    values: Float[np.ndarray, "samples joints"] | None = None
    label: str = ""  # name of the values, with their unit
    solids: Solids | None = (
        None  # shapes of the robot and around it, on a page; None for none
    )

    @property
    def bones(self) -> Float[np.ndarray, "samples points 2 3"]:
        """Lines from joint to joint, and to the end-effector."""
        ground = np.zeros_like(self.points[:, :1])
        starts = np.concatenate([self.points, ground], axis=1)[:, list(self.links)]
        return np.stack([starts, self.points], axis=2)

    @property
    def mean(self) -> Float[np.ndarray, " samples"]:
        """Mean of the values of all joints."""
        return (
            np.zeros(len(self.time))
            if self.values is None
            else self.values.mean(axis=1)
        )


@dataclasses.dataclass(frozen=True, eq=False)
class Figure:
    """Panels with a title and one legend, or a robot in space.

    Attributes:
        title: Title above all panels.
        panels: Panels, in rows from the left.
        columns: Panels beside each other, where there is room.
        height: Height of each panel with those below it [inch].
        width: Width of all on paper [inch].
        scene: Robot in space, in place of panels.
        bins: Pixel columns of a line on a page: of longer lines each column keeps its
            extremes.
    """

    title: str
    panels: Sequence[Panel] = ()
    columns: int = 1
    height: float = 2.1
    width: float = 11.0
    scene: Scene | None = None
    bins: int = 2000

    @property
    def parts(self) -> Iterator[Panel]:
        """All panels, each followed by those below it."""
        return (part for panel in self.panels for part in panel.parts)

    @property
    def legend(self) -> list[tuple[str, Curve]]:
        """Entries of the legend, with the first curve of each name."""
        entries: dict[str, Curve] = {}
        for part in self.parts:
            for curve in part.curves:
                entries.setdefault(curve.name, curve)
        entries.pop("", None)
        return [*entries.items()]

    def matplotlib(self) -> Any:
        """Return a `matplotlib.figure.Figure`, to be changed for a paper."""
        from .paper import draw

        return draw(self)

    def save(self, path: str | Path) -> None:
        """Write a page to explore (`.html`), or PNG, PDF or SVG, without date in the file.

        Args:
            path: Path of the file, whose suffix tells the format.
        """
        if Path(path).suffix == ".html":
            from .page import render_page

            text = render_page(self.title, [("Figure", [self])])
            Path(path).write_text(text, encoding="utf-8")
        else:
            from .paper import save

            save(self, path, Path(path).suffix[1:])

    def _repr_png_(self) -> bytes:
        from .paper import save

        save(self, file := io.BytesIO(), "png")
        return file.getvalue()


def decimate(
    time: Float[AnyArray, " rows"], values: Float[AnyArray, " rows"], bins: int
) -> tuple[Float[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return points of a line: all if they are few, else the least and largest of each bin.

    A peak of one sample stays visible however long the log is. Gaps in time become NaN,
    at which a line breaks; values that are NaN stay out of their bin.
    """
    t, y = np.asarray(time), np.asarray(values)
    if len(t) <= 2 * bins:
        steps = np.diff(t)
        gaps = np.flatnonzero(steps > 1.5 * np.median(steps)) + 1 if len(steps) else []
        return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)
    place = np.minimum((bins * ((t - t[0]) / (t[-1] - t[0]))).astype(int), bins - 1)
    first = np.flatnonzero(np.diff(place, prepend=-1))
    last = np.append(first[1:], len(t)) - 1
    least = np.fmin.reduceat(y, first)
    largest = np.fmax.reduceat(y, first)
    rising = ~(y[last] < y[first])
    points = np.stack(
        [np.where(rising, least, largest), np.where(rising, largest, least)], axis=1
    )
    times = np.stack([t[first], t[last]], axis=1)
    gaps = np.flatnonzero(np.diff(place[first]) > 1) + 1
    times, points = (np.insert(x, gaps, np.nan, axis=0) for x in (times, points))
    return times.ravel(), points.ravel()
