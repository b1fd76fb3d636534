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
    """Line, points, bars, band or intervals in a panel.

    Attributes:
        x: Abscissas.
        y: Ordinates.
        name: Entry of the legend; curves of one name are one entry.
        colour: Colour of all its parts.
        kind: A band lies between `low` and `high`, intervals lie along x between them.
        width: Width of the line [pt].
        dashed: Whether the line is dashed.
        marker: Whether a line has dots.
        low: Lower ends.
        high: Upper ends.
        texts: Text of each point; of bars written on them.
    """

    x: Any
    y: Any
    name: str = ""
    colour: str = BLUE
    kind: Literal["line", "points", "bars", "band", "intervals"] = "line"
    width: float = 1.0
    dashed: bool = False
    marker: bool = False
    low: Any = None
    high: Any = None
    texts: Sequence[str] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class Panel:
    """Axes with curves.

    Attributes:
        curves: What is drawn, the first one at the back.
        title: Title, such as the name of a joint.
        value: Measured value beside the title.
        x: Label of the abscissa.
        y: Label of the ordinate.
        unit: Unit of the ordinate.
        log: Logarithmic axes: `x`, `y` or both.
        x_range: Limits of the abscissa; those of the curves if None.
        y_range: Limits of the ordinate; those of the curves if None.
        x_names: Names of the abscissas 0, 1, …, instead of numbers.
        y_names: Names of the ordinates 0, 1, … from the top, instead of numbers.
        beside: Texts to the right of these names.
        levels: Thin lines across: `x` or `y`, value, colour.
        below: Panels below this one with the same abscissa, smaller by their share.
        share: Height relative to the first panel.
    """

    curves: Sequence[Curve]
    title: str = ""
    value: str = ""
    x: str = "time [s]"
    y: str = ""
    unit: str = ""
    log: str = ""
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    x_names: Sequence[str] = ()
    y_names: Sequence[str] = ()
    beside: Sequence[str] = ()
    levels: Sequence[tuple[str, float, str]] = ()
    below: Sequence["Panel"] = ()
    share: float = 1.0

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
    """Surfaces of triangles that move with the robot's bodies, or stand on the ground.

    Attributes:
        vertices: Vertices in the frames of their bodies [m].
        bodies: Body of each vertex; -1 is the ground.
        faces: Vertices of each triangle.
        places: Rotation and origin of each body at the frames of the scene, as [R r].
    """

    vertices: Float[np.ndarray, "vertices 3"]
    bodies: Int[np.ndarray, " vertices"]
    faces: Int[np.ndarray, "faces 3"]
    places: Float[np.ndarray, "frames bodies 3 4"]

    @property
    def placed(self) -> Float[np.ndarray, "frames vertices 3"]:
        """Vertices in the frame of the ground [m]."""
        still = np.broadcast_to(np.eye(3, 4), (len(self.places), 1, 3, 4))
        places = np.concatenate([self.places, still], axis=1)[:, self.bodies]
        return np.einsum("fvij,vj->fvi", places[..., :3], self.vertices) + places[..., 3]


@dataclasses.dataclass(frozen=True, eq=False)
class Scene:
    """Robot along a motion in space.

    Attributes:
        time: Instants of the samples [s].
        points: Origins of all bodies, and the end-effector [m].
        links: Body from whose origin the line to each point leads; -1 for the ground.
        frames: Samples at which the page shows the robot.
        poses: Number of poses on paper.
        values: Values of the joints at the samples, as colours; None for none.
        label: Name of the values, with their unit.
        solids: Shapes of the robot and around it, on a page; None for none.
    """

    time: Float[np.ndarray, " samples"]
    points: Float[np.ndarray, "samples points 3"]
    links: tuple[int, ...]
    frames: Int[np.ndarray, " frames"]
    poses: int = 6
    values: Float[np.ndarray, "samples joints"] | None = None
    label: str = ""
    solids: Solids | None = None

    @property
    def bones(self) -> Float[np.ndarray, "samples points 2 3"]:
        """Lines from joint to joint, and to the end-effector."""
        ground = np.zeros_like(self.points[:, :1])
        starts = np.concatenate([self.points, ground], axis=1)[:, list(self.links)]
        return np.stack([starts, self.points], axis=2)

    @property
    def mean(self) -> Float[np.ndarray, " samples"]:
        """Mean of the values of all joints."""
        return np.zeros(len(self.time)) if self.values is None else self.values.mean(axis=1)


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
        bins: Pixel columns of a line on a page: of longer lines each column keeps its extremes.
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

    A peak of one sample stays visible however long the log is. Gaps in time become NaN, at which
    a line breaks; values that are NaN stay out of their bin.
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
    points = np.stack([np.where(rising, least, largest), np.where(rising, largest, least)], axis=1)
    times = np.stack([t[first], t[last]], axis=1)
    gaps = np.flatnonzero(np.diff(place[first]) > 1) + 1
    times, points = (np.insert(x, gaps, np.nan, axis=0) for x in (times, points))
    return times.ravel(), points.ravel()
