"""A chart described as numbers, for plotly.js on a page and matplotlib elsewhere, which is imported to draw only."""

from __future__ import annotations

import math
import re
import textwrap
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from trackwright.trackers.recordings.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes

BLACK, GREY, INK = "#000000", "#6e6e6e", "#1d2733"
ORANGE, SKY, GREEN, BLUE, VERMILION, PURPLE = "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7"
LINES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Okabe & Ito (2008) in the order in which lines take them; yellow is left out, it is too light for a line on white."""

PALE, TRUTH = "#c3ccd6", "#9aa5b0"
"""What stands back, and true paths, below the tracks and wider: neither hides the other."""

SYMBOLS, DASHES = {"circle": "o", "square": "s", "triangle-up": "^"}, {"solid": "-", "dash": "--"}
STYLE: dict[Any, Any] = {
    "font.size": 9, "text.color": INK, "axes.labelcolor": GREY, "xtick.color": GREY, "ytick.color": GREY,
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#9aa5b1", "axes.linewidth": 0.7,
    "axes.grid": True, "axes.axisbelow": True, "axes.formatter.useoffset": False, "grid.color": "#e6eaee",
    "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "savefig.dpi": 150,
}  # fmt: skip

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
class Chart:
    """A chart: its name in a file's name, its title, the labels of its axes and what is drawn, the lowest first.

    `xlim`, `ylim`: ends of the axes, None for those of the data. `log`: the logarithmic axes, as "xy". `xticks`,
    `yticks`: texts by their places. `equal`: whether both axes have one scale. `note`: small words below. `width`,
    `height`: inches.
    """

    name: str
    title: str
    x: str
    y: str
    parts: Sequence[Line]
    xlim: Limits = (None, None)
    ylim: Limits = (None, None)
    log: str = ""
    xticks: Mapping[Any, str] | None = None
    yticks: Mapping[Any, str] | None = None
    equal: bool = False
    note: str = ""
    width: float = 5.0
    height: float = 3.1

    def plotly(self) -> dict[str, Any]:
        """Title, note, traces, layout and height over width, as a page holds them."""
        layout: dict[str, Any] = {"showlegend": any(part.name for part in self.parts)}
        axes = ("x", self.x, self.xlim, self.xticks), ("y", self.y, self.ylim, self.yticks)
        for axis, label, limits, ticks in axes:
            log = axis in self.log
            ends = [math.log10(end) if log and end is not None else end for end in limits]
            layout[f"{axis}axis"] = {"title": {"text": escape(label)}, "zeroline": False, "range": ends}
            layout[f"{axis}axis"] |= {"type": "log", "dtick": "D2"} if log else {}
            layout[f"{axis}axis"] |= {"tickvals": [*ticks], "ticktext": [*map(escape, ticks.values())]} if ticks else {}
        layout["yaxis"] |= {"scaleanchor": "x"} if self.equal else {}
        traces = [part.plotly() for part in self.parts]
        return {"title": self.title, "note": self.note, "data": traces, "layout": layout,
                "height": self.height / self.width}  # fmt: skip


def numbers(values: ArrayLike) -> list[float | None]:
    """The numbers with nine significant digits, as of coordinates of maps; None for NaN."""
    return [float(f"{x:.9g}") if math.isfinite(x) else None for x in np.asarray(values, float).tolist()]


def band(
    x: ArrayLike, low: ArrayLike, high: ArrayLike, name: str = "", colour: str = SKY, opacity: float = 0.35
) -> Line:
    """The area between two lines over x (n,), one for each run of rows without NaN."""
    x, low, high = (np.asarray(values, float) for values in np.broadcast_arrays(x, low, high))
    known = np.isfinite(low) & np.isfinite(high)
    corners = [np.zeros((0, 2))]
    for k in np.split(np.arange(len(x)), np.flatnonzero(np.diff(known.astype(int))) + 1):
        if known[k].any():
            corners += [np.stack([x[k], low[k]], 1), np.stack([x[k], high[k]], 1)[::-1], np.full((1, 2), np.nan)]
    return path(np.concatenate(corners), name, colour, 0.0, opacity=opacity, filled=True)


def path(points: np.ndarray, name: str = "", colour: str = BLUE, width: float = 1.3, **look: Any) -> Line:
    """A line through points (n, 2)."""
    return Line(points[:, 0], points[:, 1], name, colour, width, **look)


def is_logarithmic(values: ArrayLike, ratio: float = 5.0) -> bool:
    """Whether an axis of these values is logarithmic: all are positive and span more than this ratio."""
    known = np.asarray(values, float)[np.isfinite(values)]
    return bool(len(known) and known.min() > 0 and known.max() > ratio * known.min())


def broken_at_gaps(times: np.ndarray, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Times and columns with a row of NaN in each gap longer than a second and ten median steps."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    at = np.flatnonzero(steps > max(1.0, 10 * usual)) + 1
    middles = 0.5 * (times[at] + times[at - 1])
    return np.insert(times, at, middles), *(np.insert(column, at, np.nan, axis=0) for column in columns)


def draw(chart: Chart, axes: Axes | None = None, above: bool = False) -> Axes:
    """Draws the chart on these or new axes and returns them; `above`: whether the legend is there, not inside."""
    from matplotlib.ticker import LogLocator, NullLocator

    if axes is None:
        import matplotlib.pyplot as plt

        axes = plt.subplots(layout="constrained")[1]
    for part in chart.parts:
        _draw_line(axes, part)
    for name, axis, ticks in (("x", axes.xaxis, chart.xticks), ("y", axes.yaxis, chart.yticks)):
        if name in chart.log:
            axes.set(**{f"{name}scale": "log"})
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
        if ticks:
            axis.set_ticks([*ticks], [*map(_literal, ticks.values())])
    note = "".join(f"\n{line}" for line in textwrap.wrap(chart.note, int(16 * chart.width)))
    axes.set(xlim=chart.xlim, ylim=chart.ylim, xlabel=_literal(chart.x + note), ylabel=_literal(chart.y))
    if chart.equal:
        axes.set_aspect("equal")
    if names := axes.get_legend_handles_labels()[1]:
        columns = max(1, int(13 * chart.width / (max(map(len, names)) + 6)))
        place = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "ncols": columns}
        axes.legend(fontsize=8, frameon=False, **(place if above else {"loc": "best"}))
    return axes


def _draw_line(axes: Axes, line: Line) -> None:
    x, y = (np.asarray(values, float) for values in (line.x, line.y))
    look: dict[str, Any] = {"color": line.colour, "alpha": line.opacity, "label": _literal(line.name) or "_"}
    if line.filled:
        broken = np.isnan(x) | np.isnan(y)
        pieces = [k[~broken[k]] for k in np.split(np.arange(len(x)), np.flatnonzero(broken))]
        for number, k in enumerate(piece for piece in pieces if len(piece)):
            axes.fill(x[k], y[k], linewidth=0, **look | ({"label": "_"} if number else {}))
        return
    if line.marker:
        look |= {"marker": SYMBOLS[line.marker], "markersize": line.size, "markeredgecolor": "white"}
    axes.plot(x, y, linestyle=DASHES[line.dash] if line.width else "none", linewidth=line.width, **look)
    for place, text in zip(zip(x.tolist(), y.tolist(), strict=True), line.text, strict=False):
        axes.annotate(_literal(text), place, (0, -6), textcoords="offset points", ha="center", va="top", fontsize=7,
                      color=line.colour)  # fmt: skip


def write(chart: Chart, path: Path | str) -> Path:
    """Writes the chart, whole or not at all, as the ending of `path` says, png or pdf; returns the path."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    kind = Path(path).suffix[1:]
    with rc_context(STYLE), warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes; a warning would not help the user.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure = Figure(figsize=(chart.width, chart.height), facecolor="white", layout="constrained")
        draw(chart, figure.subplots(), above=True)
        title = "\n".join(textwrap.wrap(chart.title, int(12 * chart.width)))
        figure.suptitle(_literal(title), x=0.02, ha="left", fontsize=10)
        atomic_write(path, lambda to: figure.savefig(to, format=kind))
    return Path(path)


def write_charts(folder: Path, charts: Iterable[Chart], kind: str) -> list[str]:
    """Writes each chart as a file into the folder; returns their names. `kind`: their ending, png or pdf."""
    names: list[str] = []
    for chart in charts:
        name = re.sub(r"[^\w.-]", "_", chart.name)[:100]
        while f"{name}.{kind}" in names:
            name += "_"
        names.append(write(chart, folder / f"{name}.{kind}").name)
    return names


def _literal(text: str) -> str:
    """A user's text for matplotlib: a dollar sign in it starts no formula."""
    return text.replace("$", r"\$")
