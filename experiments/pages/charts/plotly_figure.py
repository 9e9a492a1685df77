"""A chart drawn by matplotlib as a figure of plotly.js, which a page draws in place of the image: hover, zoom, pan."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.contour import ContourSet
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle, StepPatch
from matplotlib.text import Annotation

SYMBOLS = {"o": "circle", ".": "circle", "s": "square", "^": "triangle-up", "v": "triangle-down", "D": "diamond",
           "P": "cross", "X": "x", "|": "line-ns-open"}  # fmt: skip

DASHES = {"-": "solid", "--": "dash", ":": "dot", "-.": "dashdot"}

SHOWN = "plot, stairs, fill_between, vlines, hlines, axhline, axvline, axhspan or axvspan"
"""What a page shows of what draws data; README.md beside this says it, too."""


def plotly_figure(figure: Figure) -> dict[str, Any] | None:
    """Traces, layout and height over width of a figure with one pair of axes; None for several, and for contours.

    Raises TypeError for what a page could not show.
    """
    if len(figure.axes) != 1 or any(isinstance(c, ContourSet) for c in figure.axes[0].collections):
        return None
    axes = figure.axes[0]
    axes.autoscale_view()
    parts = [*axes.collections, *axes.patches, *axes.lines, *axes.images, *axes.tables, *axes.artists]
    traces = [trace for part in parts for trace in _traces(axes, part)]
    traces.sort(key=lambda trace: trace.pop("order"))
    layout: dict[str, Any] = {
        "title": _plain(axes.get_title("left")),
        "xaxis": _axis(axes.xaxis, axes.get_xlim(), axes.get_xscale(), axes.get_xlabel()),
        "yaxis": _axis(axes.yaxis, axes.get_ylim(), axes.get_yscale(), axes.get_ylabel()),
        "showlegend": axes.get_legend() is not None or bool(figure.legends),
        "hovermode": "closest",
    }
    labels = (text for text in axes.texts if isinstance(text, Annotation) and text.get_text())
    layout["annotations"] = [_label(axes, text) for text in labels]
    if axes.get_aspect() == 1.0:
        layout["yaxis"]["scaleanchor"] = "x"
    width, height = (float(inches) for inches in figure.get_size_inches())
    return {"data": traces, "layout": layout, "height": height / width}


def _traces(axes: Axes, part: Any) -> Iterator[dict[str, Any]]:
    """The traces of a part, with its place in the order in which they cover each other."""
    label = str(part.get_label())
    named = {
        "name": _plain(label),
        "showlegend": label[:1] not in ("", "_"),
        "order": part.get_zorder(),
        "type": "scatter",
    }
    if isinstance(part, Line2D):
        yield named | _line(axes, part)
    elif isinstance(part, LineCollection):
        segments = [np.array(s, float) for s in part.get_segments()]
        x, y = ([value for s in segments for value in (*_numbers(s[:, k]), None)] for k in (0, 1))
        # Strokes of nothing have no colour.
        if segments:
            line = {"color": _colour(part.get_color()[0]), "width": 2}
            yield named | {"x": x, "y": y, "mode": "lines", "line": line, "hoverinfo": "skip"}
    # Those with offsets are arrows or hexagons.
    elif isinstance(part, (Rectangle, StepPatch)) or (
        isinstance(part, PolyCollection) and not np.any(np.asarray(part.get_offsets()))
    ):
        paths = part.get_paths() if isinstance(part, PolyCollection) else [part.get_path()]
        steps = isinstance(part, StepPatch)
        outline = {"line": {"color": _colour(part.get_edgecolor()), "width": part.get_linewidth()}} if steps else {}
        filled = {"fill": "toself", "fillcolor": _colour(np.ravel(part.get_facecolor())), "line": {"width": 0},
                  "hoverinfo": "x+y" if steps else "skip"}  # fmt: skip
        # Bands across the axes have shares of them in one coordinate.
        to_data = part.get_transform() - axes.transData
        for corners in (np.asarray(of, float) for path in paths for of in path.to_polygons(to_data, closed_only=False)):
            look = outline if steps and not part.get_fill() else filled
            yield named | {"x": _numbers(corners[:, 0]), "y": _numbers(corners[:, 1]), "mode": "lines"} | look
    else:
        raise _unshown(axes, f"{type(part).__name__} {label!r}", SHOWN)


def _unshown(axes: Axes, what: str, expected: str) -> TypeError:
    chart = axes.get_title("left") or axes.get_ylabel()
    return TypeError(f"chart {chart!r}: {what} is not shown on a page; expected {expected}; draw it with these")


def _line(axes: Axes, line: Line2D) -> dict[str, Any]:
    # Lines across the axes have shares of them in one coordinate.
    x, y = (line.get_transform() - axes.transData).transform(np.asarray(line.get_xydata(), float)).T
    marker, dash = str(line.get_marker()), str(line.get_linestyle())
    if marker not in (*SYMBOLS, "None", "none", "", " "):
        raise _unshown(axes, f"marker {marker!r} of {line.get_label()!r}", " ".join(SYMBOLS))
    drawn = ["lines"] * (dash in DASHES) + ["markers"] * (marker in SYMBOLS)
    trace: dict[str, Any] = {"x": _numbers(x), "y": _numbers(y), "mode": "+".join(drawn) or "none"}
    trace["line"] = {"color": _colour(line.get_color(), line.get_alpha()), "width": line.get_linewidth(),
                     "dash": DASHES.get(dash, "dot")}  # fmt: skip
    if marker in SYMBOLS:
        face = line.get_markerfacecolor()
        # Filled with white, or not at all.
        open_face = to_rgba(face)[3] == 0.0 or to_rgba(face) == (1.0, 1.0, 1.0, 1.0)
        colour = _colour(line.get_color() if open_face else face, line.get_alpha())
        size = line.get_markersize() * (0.6 if marker == "." else 1.0)
        symbol = SYMBOLS[marker] + "-open" * open_face
        trace["marker"] = {"symbol": symbol, "size": size + 1, "color": colour}
    return trace


def _label(axes: Axes, text: Annotation) -> dict[str, Any]:
    """The words at a point, above or below it as drawn; on a logarithmic axis plotly places them by the logarithm."""
    scales = (axes.get_xscale(), axes.get_yscale())
    x, y = (np.log10(value) if scale == "log" else value for value, scale in zip(text.xy, scales, strict=True))
    shift = -10 if text.get_verticalalignment() == "top" else 10
    font = {"size": 10, "color": _colour(text.get_color())}
    return {"x": float(f"{x:.5g}"), "y": float(f"{y:.5g}"), "text": _plain(text.get_text()), "showarrow": False,
            "xanchor": text.get_horizontalalignment(), "yshift": shift, "font": font}  # fmt: skip


def _axis(axis: Axis, limits: tuple[float, float], scale: str, label: str) -> dict[str, Any]:
    """Title, range, kind and, where the ticks are names, their texts."""
    settings: dict[str, Any] = {"title": {"text": _plain(label)}, "zeroline": False}
    settings["range"] = [float(f"{x:.6g}") for x in (np.log10(limits) if scale == "log" else limits)]
    texts = [label.get_text() for label in axis.get_ticklabels()]
    if scale == "log" or any(c.isalpha() for c in "".join(texts)):
        settings |= {"tickvals": _numbers(axis.get_majorticklocs()), "ticktext": [_plain(text) for text in texts]}
    if scale == "log":
        settings["type"] = "log"
    return settings


def _numbers(values: Any) -> list[float | None]:
    """The numbers with five significant digits; None for one that is not finite."""
    return [float(f"{x:.5g}") if np.isfinite(x) else None for x in np.asarray(values, float)]


def _colour(colour: Any, alpha: float | None = None) -> str:
    red, green, blue, opacity = to_rgba(colour, alpha)
    return f"rgba({round(255 * red)},{round(255 * green)},{round(255 * blue)},{opacity:.3g})"


def _plain(text: str) -> str:
    """A text of a chart for plotly, which takes some tags for markup."""
    return escape(text.replace(r"\$", "$"), quote=False)
