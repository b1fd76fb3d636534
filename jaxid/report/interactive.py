"""Figures to explore on a page: traces of plotly, packed so that one file holds everything."""

import base64
import functools
import gzip
import html
import importlib.util
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .figure import (
    GREY,
    ORANGE,
    PALE,
    SKY,
    VERMILION,
    Curve,
    Figure,
    Panel,
    Scene,
    Solids,
    decimate,
)

SCALE = [[0.0, SKY], [0.5, ORANGE], [1.0, VERMILION]]
"""Colours of small to large values."""
_GAP = 0.05
"""Gap between panels with one abscissa, relative to their height."""


@functools.cache
def library() -> str:
    """Return the code of plotly for browsers, packed."""
    spec = importlib.util.find_spec("plotly")
    folder = Path(str(spec and spec.origin)).parent
    return pack((folder / "package_data" / "plotly.min.js").read_bytes())


def pack(content: bytes) -> str:
    """Return bytes as the page holds them: compressed, in letters."""
    return base64.b64encode(gzip.compress(content, 6, mtime=0)).decode()


def charts(figure: Figure) -> list[dict[str, Any]]:
    """Return the charts of a figure: titles, values, heights [px] and packed contents."""
    if figure.scene is not None:
        return [
            {"title": "", "value": "", "height": 560, "content": _scene(figure.scene)}
        ]
    height = figure.height * 96  # pixels of an inch on the page
    return [
        {
            "title": p.title,
            "value": p.value,
            "height": height,
            "content": _panel(figure, p),
        }
        for p in figure.panels
    ]


def _scene(scene: Scene) -> str:
    """Return the chart of a robot in space: its path, and all poses of the robot."""
    path, links = scene.points[:, -1], np.array(scene.links)
    bones, count = scene.bones[scene.frames], len(scene.frames)
    # A line with gaps: ends of each link, and nothing.
    gaps = np.full_like(bones[:, :, :1], np.nan)
    lines = np.concatenate([bones, gaps], axis=2).reshape(count, -1, 3)
    coloured = scene.values is not None
    values = np.zeros((count, len(scene.links)))
    if scene.values is not None:
        values[:, :-1] = scene.values[scene.frames]
    most = float(np.percentile(values[:, :-1], 98)) or 1.0
    scale = {"colorscale": SCALE, "cmin": 0.0, "cmax": most} if coloured else {}
    bar = {"title": {"text": html.escape(scene.label), "side": "top"}, "thickness": 10}
    bar |= {"orientation": "h", "len": 0.6, "y": 0.0, "yanchor": "bottom"}
    line = {
        "color": _floats(scene.mean),
        "width": 4,
        "showscale": coloured,
        "colorbar": bar,
    }
    trace = {"type": "scatter3d", "hoverinfo": "skip", "showlegend": False}
    tip = trace | {"mode": "lines", "line": line | scale, **_coordinates(path)}
    dots = {"size": 5, "color": PALE, "line": {"color": GREY, "width": 2}}
    thick = {"width": 14, "color": GREY} | scale
    robot = trace | {"mode": "lines+markers", "line": thick, "marker": dots}
    corners = scene.bones.reshape(-1, 3)
    if scene.solids is not None:
        corners = np.concatenate([corners, scene.solids.placed.reshape(-1, 3)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.06 * float(np.max(high - low))
    ranges = np.stack([low - margin, high + margin], axis=1).tolist()
    axes: dict[str, Any] = {
        f"{axis}axis": {"title": {"text": f"{axis} [m]"}, "range": limits}
        for axis, limits in zip("xyz", ranges, strict=True)
    }
    axes |= {"aspectmode": "data", "camera": {"eye": {"x": 1.2, "y": -1.5, "z": 0.7}}}
    axes["domain"] = {"x": [0.0, 1.0], "y": [0.12, 1.0]}
    packed: dict[str, Any] = {
        "data": [tip, robot],
        "layout": {"scene": axes},
        "frames": {
            "points": [_coordinates(pose) for pose in lines],
            "time": scene.time[scene.frames].tolist(),
        },
    }
    if scene.solids is not None:
        packed["data"].append(trace | _surface(scene.solids))
        packed["frames"]["solids"] = {
            "vertices": scene.solids.vertices.round(4).tolist(),
            "bodies": scene.solids.bodies.tolist(),
            "places": scene.solids.places.round(4)
            .reshape(*scene.solids.places.shape[:2], 12)
            .tolist(),
        }
    if coloured:
        colours = np.repeat(values[:, links], 3, axis=1)
        packed["frames"]["colours"] = [_floats(row) for row in colours]
    return pack(_json(packed))


def _surface(solids: Solids) -> dict[str, Any]:
    """Return the trace of surfaces at the first frame: those of the robot, and around it."""
    still = (solids.bodies[solids.faces[:, 0]] < 0).tolist()
    colours = [GREY if ground else SKY for ground in still]
    corners = dict(zip("ijk", solids.faces.T.tolist(), strict=True))
    look = {"opacity": 0.25, "facecolor": colours, "lighting": {"ambient": 0.9}}
    return {"type": "mesh3d", **corners, **look, **_coordinates(solids.placed[0])}


def _coordinates(points: np.ndarray) -> dict[str, Any]:
    return {axis: _floats(points[:, k]) for k, axis in enumerate("xyz")}


def _panel(figure: Figure, panel: Panel) -> str:
    """Return the chart of a panel and those below it."""
    parts = panel.parts
    layout: dict[str, Any] = {
        "xaxis": _x_axis(panel, f"y{len(parts)}" if panel.below else "y")
    }
    heights = np.array([part.share for part in parts])
    ends = np.cumsum(heights[::-1] / heights.sum())[::-1]
    traces, shapes = [], []
    for k, part in enumerate(parts):
        number = str(k + 1) if k else ""
        bottom = ends[k + 1] + _GAP if k + 1 < len(parts) else 0.0
        layout[f"yaxis{number}"] = _y_axis(part) | {"domain": [bottom, ends[k]]}
        own = [
            _trace(c, part, figure.bins) | {"yaxis": f"y{number}"} for c in part.curves
        ]
        traces += own
        shapes += [_level(level, number) for level in part.levels]
    for k, trace in enumerate(traces):
        # What all curves have in common is there once.
        trace["x"] = next(
            (j for j in range(k) if traces[j]["x"] == trace["x"]), trace["x"]
        )
    lines = all(c.kind in ("line", "band") for part in parts for c in part.curves)
    layout |= {
        "shapes": shapes,
        "hovermode": "x" if lines or panel.x_names else "closest",
    }
    return pack(_json({"data": traces, "layout": layout}))


def _x_axis(panel: Panel, anchor: str) -> dict[str, Any]:
    axis = _axis(panel.x, panel.x_range, "x" in panel.log) | {"anchor": anchor}
    return axis | _ticks(panel.x_names)


def _y_axis(panel: Panel) -> dict[str, Any]:
    axis = _axis(panel.y_label, panel.y_range, "y" in panel.log) | _ticks(panel.y_names)
    if panel.y_names:
        axis |= {"range": [len(panel.y_names) - 0.4, -0.6]}
    if panel.share < 1.0:
        axis |= {"nticks": 4}
    return axis


def _axis(
    label: str, limits: Sequence[float] | None, logarithmic: bool
) -> dict[str, Any]:
    axis: dict[str, Any] = {"title": {"text": html.escape(label)}}
    if logarithmic:
        axis |= {"type": "log", "exponentformat": "power"}
    if limits is not None:
        ends = [float(x) for x in limits]
        axis["range"] = np.log10(ends).tolist() if logarithmic else ends
    return axis


def _ticks(names: Sequence[str]) -> dict[str, Any]:
    if not names:
        return {}
    shown = [html.escape(name) for name in names]
    return {
        "tickvals": [*range(len(names))],
        "ticktext": shown,
        "autotickangles": [0, 90],
    }


def _trace(curve: Curve, panel: Panel, bins: int) -> dict[str, Any]:
    unit = html.escape(panel.unit)
    label = html.escape(curve.name or panel.y or panel.title)
    trace: dict[str, Any] = {
        "type": "scatter",
        "name": label,
        "legendgroup": curve.name,
    }
    trace["hovertemplate"] = f"{label}: %{{y:.4~g}} {unit}<extra></extra>"
    texts = [html.escape(text) for text in curve.texts]
    if texts:
        trace |= {"text": texts, "hovertemplate": "%{text}<extra></extra>"}
    match curve.kind:
        case "band":
            x = np.concatenate([curve.x, np.flip(curve.x)])
            y = np.concatenate([curve.high, np.flip(curve.low)])
            fill = {
                "fill": "toself",
                "hoverinfo": "skip",
                "line": {"width": 0},
                "opacity": 0.35,
            }
            trace |= {"mode": "lines", "fillcolor": curve.colour, **fill}
            del trace["hovertemplate"]
        case "bars":
            x, y = curve.x, curve.y
            trace |= {
                "type": "bar",
                "width": curve.width,
                "marker": {"color": curve.colour},
            }
            trace |= {"textposition": "none"}
        case "intervals":
            x, y = curve.x, curve.y
            ends = {"array": _floats(np.subtract(curve.high, x))}
            ends |= {"arrayminus": _floats(np.subtract(x, curve.low))}
            look = {"type": "data", "symmetric": False, "width": 0, "thickness": 1.6}
            trace |= {"mode": "markers", "marker": {"color": curve.colour, "size": 7}}
            trace |= {"error_x": look | ends | {"color": curve.colour}}
        case "points":
            x, y = curve.x, curve.y
            ring = {"color": GREY, "width": 1}
            trace |= {
                "mode": "markers",
                "marker": {"color": curve.colour, "size": 7, "line": ring},
            }
        case _:
            x, y = (
                decimate(curve.x, curve.y, bins)
                if panel.in_time
                else (curve.x, curve.y)
            )
            dash = "dash" if curve.dashed else "solid"
            line = {"color": curve.colour, "width": 0.4 + curve.width, "dash": dash}
            mode = "lines+markers" if curve.marker else "lines"
            trace |= {"mode": mode, "line": line, "marker": {"size": 4}}
    return trace | {"x": _floats(x), "y": _floats(y)}


def _level(level: tuple[str, float, str], number: str) -> dict[str, Any]:
    which, value, colour = level
    line = {"color": colour, "width": 1, "dash": "dash" if value else "solid"}
    shape = {
        "type": "line",
        "line": line,
        "xref": "x",
        "yref": f"y{number}",
        "layer": "below",
    }
    if which == "x":
        return shape | {
            "x0": value,
            "x1": value,
            "yref": f"y{number} domain",
            "y0": 0,
            "y1": 1,
        }
    return shape | {"y0": value, "y1": value, "xref": "x domain", "x0": 0, "x1": 1}


def _floats(values: Any) -> dict[str, str]:
    """Return numbers in the packed form that plotly reads; gaps stay NaN."""
    array = np.asarray(values, "<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(array.tobytes()).decode()}


def _json(content: Any) -> bytes:
    return json.dumps(content, separators=(",", ":"), ensure_ascii=False).encode()
