"""Figures as data for a page: packed so that one file holds everything.

`templates/figures.js` unpacks them in the browser, and draws them with plotly.
"""

import base64
import functools
import gzip
import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxid.arrays import Matrix

from .figure_elements import Curve, Drawing, Panel, Scene, Solids, decimate

Content = dict[str, Any]
"""Data of a figure as the page holds them."""
PIXELS_PER_INCH = 96
"""Pixels of an inch on a page."""
SCENE_HEIGHT = 560
"""Height of a robot in space [px]."""
COLOUR_PERCENTILE = 98.0
"""Share of the values of a scene that are within its scale of colours [%]."""
LENGTH_DIGITS = 4
"""Decimals of vertices and origins of solids [m]."""


@functools.cache
def library() -> str:
    """Return the code of plotly for browsers, packed."""
    spec = importlib.util.find_spec("plotly")
    folder = Path(str(spec and spec.origin)).parent
    return pack((folder / "package_data" / "plotly.min.js").read_bytes())


def pack(content: bytes) -> str:
    """Return bytes as the page holds them: compressed, in letters."""
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


def charts(drawing: Drawing) -> list[Content]:
    """Return the charts of a figure: titles, values, heights [px], contents."""
    if drawing.scene is not None:
        return [_chart("", "", SCENE_HEIGHT, scene_content(drawing.scene))]
    height = drawing.height * PIXELS_PER_INCH
    return [
        _chart(panel.title, panel.value, height, panel_content(panel))
        for panel in drawing.panels
    ]


def _chart(title: str, value: str, height: float, content: Any) -> Content:
    """Return a chart as the template takes it."""
    text = json.dumps(content, separators=(",", ":"))
    # A page takes these characters for its own, or spells them out.
    for character in "<\x7f":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return {
        "title": title,
        "value": value,
        "height": height,
        "content": Markup(text),
    }


def panel_content(panel: Panel) -> Content:
    """Return a panel, those below it, and their curves; long lines are decimated."""
    curves: list[Content] = [
        _curve_content(curve, part) | {"panel": number}
        for number, part in enumerate(panel.parts)
        for curve in part.curves
    ]
    # Abscissas that several curves have are there once; the others name that curve.
    first_curves: dict[str, int] = {}
    for number, curve in enumerate(curves):
        first_number = first_curves.setdefault(str(curve["x"]), number)
        if first_number < number:
            curve["x"] = first_number
    panels = [
        {**vars(part), "y_label": part.y_label, "curves": [], "below": []}
        for part in panel.parts
    ]
    return {"panels": panels, "curves": curves}


def _curve_content(curve: Curve, panel: Panel) -> Content:
    """Return a curve with its points packed; a line in time is decimated."""
    x = curve.x
    y = curve.y
    if panel.in_time and curve.kind == "line":
        x, y = decimate(x, y)
    content = {**vars(curve), "x": _floats(x), "y": _floats(y)}
    if curve.low is not None:
        content["low"] = _floats(curve.low)
        content["high"] = _floats(curve.high)
    return content


def scene_content(scene: Scene) -> Content:
    """Return a robot in space: its end-effector's path, and its poses at all frames."""
    bones = scene.bones[scene.frames]
    # A line with gaps: ends of each link, and nothing.
    gaps = np.full_like(bones[:, :, :1], np.nan)
    lines = np.concatenate([bones, gaps], axis=2).reshape(len(bones), -1, 3)
    content: Content = {
        "label": scene.label,
        "path": _coordinates(scene.points[:, -1]),
        "mean": _floats(scene.mean),
        "largest": None,
        "frames": {
            "time": scene.time[scene.frames].tolist(),
            "points": [_coordinates(line) for line in lines],
        },
    }
    if scene.values is not None:
        values = scene.values[scene.frames]
        content["largest"] = float(np.percentile(values, COLOUR_PERCENTILE)) or 1.0
        # Link -1, the ground, is the last column.
        ground = np.zeros((len(values), 1))
        link_values = np.concatenate([values, ground], axis=1)[:, list(scene.links)]
        # The two ends of a link, and the gap behind it.
        colours = np.repeat(link_values, 3, axis=1)
        content["frames"]["colours"] = [_floats(row) for row in colours]
    if scene.solids is not None:
        content["frames"]["solids"] = _solids_content(scene.solids)
    return content


def _solids_content(solids: Solids) -> Content:
    """Return shapes, which the browser moves with the bodies."""
    frames, bodies = solids.places.shape[:2]
    places = solids.places.reshape(frames, bodies * 12)
    return {
        "vertices": solids.vertices.round(LENGTH_DIGITS).tolist(),
        "bodies": solids.bodies.tolist(),
        "faces": solids.faces.tolist(),
        "places": [_floats(place) for place in places],
    }


def _coordinates(points: Matrix) -> Content:
    """Return the coordinates of points by their axes, as plotly takes them."""
    return {axis: _floats(points[:, k]) for k, axis in enumerate("xyz")}


def _floats(values: Any) -> dict[str, str]:
    """Return numbers in single precision, packed; gaps stay NaN."""
    array = np.asarray(values, "<f4")
    return {"floats": base64.b64encode(array.tobytes()).decode()}
