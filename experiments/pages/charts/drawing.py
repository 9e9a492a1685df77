"""Charts by matplotlib: on the axes of a notebook, and as PNG or PDF files."""

from __future__ import annotations

import re
import textwrap
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from trackwright.experiments.pages.charts.style import GREY, INK, Chart, Field, Line
from trackwright.trackers.recordings.atomic import atomic_write

SYMBOLS = {"circle": "o", "square": "s", "diamond": "D", "triangle-up": "^", "triangle-down": "v", "line-ns": "|"}
DASHES = {"solid": "-", "dash": "--", "dot": ":", "dashdot": "-."}
COLOURS = {"Blues": "Blues_r", "RdBu": "RdBu_r", "Viridis": "viridis"}

STYLE: dict[Any, Any] = {
    "font.size": 9, "text.color": INK, "axes.labelcolor": GREY, "xtick.color": GREY, "ytick.color": GREY,
    "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": "#9aa5b1", "axes.linewidth": 0.7,
    "axes.grid": True, "axes.axisbelow": True, "axes.formatter.useoffset": False, "grid.color": "#e6eaee",
    "xtick.labelsize": 8.5, "ytick.labelsize": 8.5, "xtick.major.size": 2.5, "ytick.major.size": 2.5,
    "savefig.dpi": 150,
}  # fmt: skip


@contextmanager
def _styled() -> Iterator[None]:
    with rc_context(STYLE), warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes; a warning would not help the user.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        warnings.filterwarnings("ignore", message="constrained_layout not applied")
        yield


def draw(chart: Chart, axes: Axes | None = None, above: bool = False) -> Axes:
    """Draws the chart on these or new axes and returns them; `above`: whether the legend is there, not inside."""
    if axes is None:
        import matplotlib.pyplot as plt

        axes = plt.subplots(layout="constrained")[1]
    for part in chart.parts:
        _draw_line(axes, part) if isinstance(part, Line) else _draw_field(axes, part)
    for name, ticks in (("x", chart.xticks), ("y", chart.yticks)):
        axis = axes.xaxis if name == "x" else axes.yaxis
        if name in chart.log:
            axes.set(**{f"{name}scale": "log"})
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
            axis.set_major_formatter("{x:g}")
            axis.set_minor_locator(NullLocator())
        if ticks:
            axis.set_ticks([*ticks], [*map(_literal, ticks.values())])
    note = "".join(f"\n{line}" for line in textwrap.wrap(chart.note, int(16 * chart.width)))
    axes.set(xlim=chart.limits("x"), ylim=chart.limits("y"), xlabel=_literal(chart.x + note), ylabel=_literal(chart.y))
    if chart.equal:
        axes.set_aspect("equal")
    if axes.get_legend_handles_labels()[1]:
        place = {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "ncols": max(1, int(chart.width / 2))}
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
        look |= {
            "marker": SYMBOLS[line.marker.removesuffix("-open")],
            "markersize": line.size,
            "markeredgecolor": "white",
        }
        if line.marker.endswith("-open"):
            look |= {"markerfacecolor": "none", "markeredgecolor": line.colour, "markeredgewidth": 1.5}
    axes.plot(x, y, linestyle=DASHES[line.dash] if line.width else "none", linewidth=line.width, **look)
    for place, text in zip(zip(x.tolist(), y.tolist(), strict=True), line.text, strict=False):
        axes.annotate(_literal(text), place, (0, -6), textcoords="offset points", ha="center", va="top", fontsize=7,
                      color=line.colour)  # fmt: skip


def _draw_field(axes: Axes, field: Field) -> None:
    look: dict[str, Any] = {"cmap": COLOURS[field.colours], "vmin": field.low, "vmax": field.high}
    values, figure = np.ma.masked_invalid(np.asarray(field.values, float)), axes.figure
    if field.ticks is None:
        bar = figure.colorbar(axes.pcolormesh(field.x, field.y, values, shading="nearest", **look), ax=axes)
    else:
        filled = axes.contourf(field.x, field.y, values, levels=[*field.ticks], extend="max", **look)
        bar = figure.colorbar(filled, ax=axes)
        bar.set_ticks([*field.ticks][::3], labels=[*field.ticks.values()][::3])
        axes.contour(field.x, field.y, values, levels=[*field.ticks], colors="white", linewidths=0.6)
    bar.set_label(_literal(field.label))


def write(chart: Chart, path: Path | str) -> Path:
    """Writes the chart, whole or not at all, as the ending of `path` says, png or pdf; returns the path."""
    kind = Path(path).suffix[1:]
    with _styled():
        figure = Figure(figsize=chart.size, facecolor="white", layout="constrained")
        draw(chart, figure.subplots(), above=True)
        figure.suptitle(
            _literal("\n".join(textwrap.wrap(chart.title, int(12 * chart.width)))), x=0.02, ha="left", fontsize=10
        )
        atomic_write(path, lambda to: figure.savefig(to, format=kind))
    return Path(path)


def write_charts(folder: Path, charts: Iterable[Chart], kind: str, prefix: str = "") -> list[str]:
    """Writes each chart as a file into the folder; returns their names. `kind`: their ending, png or pdf."""
    names: list[str] = []
    for chart in charts:
        name = re.sub(r"[^\w.-]", "_", prefix + chart.name)[:100]
        while f"{name}.{kind}" in names:
            name += "_"
        names.append(write(chart, folder / f"{name}.{kind}").name)
    return names


def _literal(text: str) -> str:
    """A user's text for matplotlib: a dollar sign in it starts no formula."""
    return text.replace("$", r"\$")
