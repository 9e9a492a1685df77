"""A chart as a plain description: lines, areas and fields with their axes, for plotly.js and matplotlib alike."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

BLACK, GREY, INK = "#000000", "#6e6e6e", "#1d2733"
ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7"
LINES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Okabe & Ito (2008) in the order in which lines take them; yellow is left out, it is too light for a line on white."""

BEFORE, PALE = "#7b8794", "#c3ccd6"
"""Results before tuning, and what stands back."""

NARROW = 3.6
"""Inches of a chart of which three stand abreast on a page."""

Limits = tuple[float | None, float | None]


@dataclass(frozen=True)
class Line:
    """Points (n,) that are joined, marked, or enclose a filled area; NaN where the line breaks.

    `name`: in the legend, if any. `width`: 0 for no line. `marker`: as plotly.js calls it. `text`: below each point.
    """

    x: ArrayLike
    y: ArrayLike
    name: str = ""
    colour: str = BLUE
    width: float = 1.3
    dash: str = "solid"
    marker: str = ""
    size: float = 5.0
    opacity: float = 1.0
    filled: bool = False
    text: Sequence[str] = ()

    def plotly(self) -> dict[str, Any]:
        """The trace of plotly.js."""
        trace = {"x": numbers(self.x), "y": numbers(self.y), "name": escape(self.name), "showlegend": bool(self.name)}
        trace |= {"opacity": self.opacity, "line": {"color": self.colour, "width": self.width, "dash": self.dash}}
        if self.filled:
            return trace | {"fill": "toself", "fillcolor": self.colour, "mode": "lines", "hoverinfo": "skip"}
        mode = ["lines"] * (self.width > 0) + ["markers"] * bool(self.marker) + ["text"] * bool(self.text)
        marker = {"symbol": self.marker or "circle", "size": self.size + 1, "color": self.colour}
        words = {"text": [*map(escape, self.text)], "textposition": "bottom center", "cliponaxis": False}
        return trace | {"mode": "+".join(mode) or "none", "marker": marker} | (words if self.text else {})


@dataclass(frozen=True)
class Field:
    """Values (m, n) over x (n,) and y (m,) as coloured cells, or as contours at the values `ticks` with their texts.

    `colours`: Blues, RdBu or Viridis, from `low` to `high`.
    """

    x: ArrayLike
    y: ArrayLike
    values: ArrayLike
    label: str
    colours: str
    low: float
    high: float
    ticks: Mapping[float, str] | None = None

    def plotly(self) -> dict[str, Any]:
        """The trace of plotly.js."""
        bar: dict[str, Any] = {
            "title": {"text": escape(self.label), "side": "right"},
            "thickness": 12,
            "outlinewidth": 0,
        }
        trace = {"x": numbers(self.x), "y": numbers(self.y), "z": [numbers(row) for row in np.asarray(self.values)]}
        trace |= {"zmin": self.low, "zmax": self.high, "colorscale": self.colours, "colorbar": bar}
        if self.ticks is None:
            return trace | {"type": "heatmap", "xgap": 1, "ygap": 1, "hovertemplate": "%{z:.3g}<extra></extra>"}
        bar |= {"tickvals": [*self.ticks][::3], "ticktext": [*self.ticks.values()][::3]}
        first, second, *_, last = self.ticks
        contours = {"start": first, "end": last, "size": second - first}
        return trace | {"type": "contour", "contours": contours, "hoverinfo": "skip", "line": {"color": "#fff"}}


@dataclass(frozen=True)
class Chart:
    """A chart: its name in a file's name, its title, the labels of its axes and what is drawn, the lowest first.

    `xlim`, `ylim`: ends of the axes, None for those of the data; `robust`: without the last 1 % of these in y. `log`:
    the logarithmic axes, as "xy". `xticks`, `yticks`: texts by their places. `equal`: whether both axes have one scale.
    `note`: small words below; `caption`: what a page says beside them. `width`, `height`: inches, None for a height by
    the shape of the limits.
    """

    name: str
    title: str
    x: str
    y: str
    parts: Sequence[Line | Field]
    xlim: Limits = (None, None)
    ylim: Limits = (None, None)
    robust: bool = False
    log: str = ""
    xticks: Mapping[Any, str] | None = None
    yticks: Mapping[Any, str] | None = None
    equal: bool = False
    note: str = ""
    caption: str = ""
    width: float = 5.0
    height: float | None = 3.1

    @property
    def narrow(self) -> bool:
        """Whether three stand abreast."""
        return self.width == NARROW

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, inches."""
        (left, right), (bottom, top) = self.limits("x"), self.limits("y")
        ratio = float(np.clip((top - bottom) / (right - left), 0.3, 1.5))
        return self.width, self.height or ratio * (self.width - 0.6) + 1.1

    def limits(self, axis: str) -> tuple[float, float]:
        """The ends of an axis, x or y; those not given from the data with a margin."""
        log, tail, ends = axis in self.log, 0.005 * (self.robust and axis == "y"), []
        for filled in (False, True):
            own = [part for part in self.parts if (isinstance(part, Line) and part.filled) == filled]
            values = np.concatenate([np.zeros(0), *(np.ravel(np.asarray(getattr(part, axis), float)) for part in own)])
            shown = np.log10(values[values > 0]) if log else values[np.isfinite(values)]
            ends += [np.quantile(shown, (tail, 1 - tail))] if len(shown) else []
        low, high = ends[0] if ends else (0.0, 1.0)
        # A wide band does not flatten the lines.
        for first, last in ends[1:]:
            span = high - low if tail else np.inf
            low, high = min(low, max(first, low - span)), max(high, min(last, high + span))
        margin = 0.05 * (high - low) or 0.1 * abs(high) or 1.0
        both = [10**end if log else end for end in (low - margin, high + margin)]
        given = self.xlim if axis == "x" else self.ylim
        first, last = (end if asked is None else asked for asked, end in zip(given, both, strict=True))
        return float(first), float(last)

    def plotly(self) -> dict[str, Any]:
        """Title, note, traces, layout and height over width, as a page holds them."""
        layout: dict[str, Any] = {"showlegend": any(isinstance(part, Line) and part.name for part in self.parts)}
        for axis, label, ticks in (("x", self.x, self.xticks), ("y", self.y, self.yticks)):
            log = axis in self.log
            ends = [math.log10(end) if log else end for end in self.limits(axis)]
            layout[f"{axis}axis"] = {"title": {"text": escape(label)}, "zeroline": False, "range": numbers(ends)}
            layout[f"{axis}axis"] |= {"type": "log", "dtick": "D2"} if log else {}
            layout[f"{axis}axis"] |= {"tickvals": [*ticks], "ticktext": [*map(escape, ticks.values())]} if ticks else {}
        layout["yaxis"] |= {"scaleanchor": "x"} if self.equal else {}
        width, height = self.size
        note, traces = f"{self.caption} {self.note}".strip(), [part.plotly() for part in self.parts]
        return {"title": self.title, "note": note, "data": traces, "layout": layout, "height": height / width}


def numbers(values: ArrayLike) -> list[float | None]:
    """The numbers with five significant digits, or those of their span where they lie far from zero; None for NaN."""
    array = np.asarray(values, float)
    known = array[np.isfinite(array)]
    span = float(np.ptp(known)) if len(known) else 0.0

    def short(x: float) -> float:
        size = min(abs(x), span) or abs(x)
        return round(x, 4 - math.floor(math.log10(size))) if size else 0.0

    return [short(x) if math.isfinite(x) else None for x in array.tolist()]


def band(
    x: ArrayLike, low: ArrayLike, high: ArrayLike, name: str = "", colour: str = SKY, opacity: float = 0.35
) -> Line:
    """The area between two lines over x (n,), one for each run of rows without NaN."""
    x, low, high = (np.asarray(values, float) for values in np.broadcast_arrays(x, low, high))
    known = np.isfinite(low) & np.isfinite(high)
    runs = np.split(np.arange(len(x)), np.flatnonzero(np.diff(known.astype(int))) + 1)
    corners = [np.zeros((0, 2))]
    for k in (run for run in runs if known[run].any()):
        corners += [np.stack([x[k], low[k]], 1), np.stack([x[k], high[k]], 1)[::-1], np.full((1, 2), np.nan)]
    return path(np.concatenate(corners), name, colour, 0.0, opacity=opacity, filled=True)


def steps(edges: np.ndarray, heights: np.ndarray, **look: Any) -> Line:
    """The outline of a histogram by the edges (n + 1,) of its bins."""
    return Line(np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]]), **look)


def path(points: np.ndarray, name: str = "", colour: str = BLUE, width: float = 1.3, **look: Any) -> Line:
    """A line through points (n, 2)."""
    return Line(points[:, 0], points[:, 1], name, colour, width, **look)


def rule(at: float, ends: Sequence[float], upright: bool = False, **look: Any) -> Line:
    """A thin line across the chart."""
    thin: dict[str, Any] = {"colour": GREY, "width": 0.8} | look
    return Line([at, at], [*ends], **thin) if upright else Line([*ends], [at, at], **thin)


def is_logarithmic(values: ArrayLike, ratio: float = 5.0) -> bool:
    """Whether an axis of these values is logarithmic: all are positive and span more than this ratio."""
    known = np.asarray(values, float)[np.isfinite(values)]
    return bool(len(known) and known.min() > 0 and known.max() > ratio * known.min())


def broken_at_gaps(times: np.ndarray, *columns: np.ndarray, gap: float = 1.0) -> tuple[np.ndarray, ...]:
    """Times and columns with a row of NaN in each gap longer than `gap` seconds and ten median steps."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    at = np.flatnonzero(steps > max(gap, 10 * usual)) + 1
    middles = 0.5 * (times[at] + times[at - 1])
    return np.insert(times, at, middles), *(np.insert(column, at, np.nan, axis=0) for column in columns)
