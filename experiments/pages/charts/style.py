"""What all charts share: one matplotlib style, colours for colour-blind readers, and PNG, PDF and SVG output.

A chart is a function that draws on axes: `Chart.write` puts it into a file, `Chart.address` onto a page.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from trackwright.experiments.pages.charts.plotly_figure import plotly_figure
from trackwright.experiments.pages.reports.pages import script_json
from trackwright.trackers.recordings.atomic import atomic_write

BLACK = "#000000"
GREY = "#6e6e6e"
ORANGE = "#e69f00"
SKY = "#56b4e9"
GREEN = "#009e73"
BLUE = "#0072b2"
VERMILION = "#d55e00"
PURPLE = "#cc79a7"
LINES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Okabe & Ito (2008) in the order in which lines take them; yellow is left out, it is too light for a line on white."""

INK = "#1d2733"
BEFORE = "#7b8794"
"""The colour of results before tuning; those after it are blue."""

WIDTH, HEIGHT = 5.0, 3.1
"""Inches of a plot on a page: about the text's size on a phone, two plots abreast on a desktop screen."""

NARROW = 3.6
"""Inches of a plot of which three stand abreast."""

COMPRESSION = 2
"""Level of a PNG's compression: a tenth more bytes than at the usual 6 in two thirds of the time."""

FONTS = "'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "text.color": INK,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlecolor": INK,
    "axes.labelcolor": GREY,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9aa5b1",
    "axes.linewidth": 0.7,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": "#e6eaee",
    "grid.linewidth": 0.6,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "legend.handlelength": 1.5,
    "legend.borderaxespad": 0.2,
    "savefig.dpi": 150,
    "svg.fonttype": "none",
    "svg.hashsalt": "trackwright",  # the same plot is the same file
}


@contextmanager
def _styled() -> Iterator[None]:
    with rc_context(STYLE), warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes; a warning would not help the user.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        # Nor would one about names as long as the figure.
        warnings.filterwarnings("ignore", message="constrained_layout not applied")
        yield


Draw = Callable[[Axes], object]
"""What draws a chart on axes."""


class Chart(NamedTuple):
    """A chart of a page or a file: its name in a file's name, its title, what draws it, and its size in inches.

    `height`: None of a floor plan, whose axes say it. `caption`: what a page says below it.
    """

    name: str
    title: str
    draw: Draw
    width: float = WIDTH
    height: float | None = HEIGHT
    caption: str = ""

    @property
    def narrow(self) -> bool:
        """Whether three stand abreast."""
        return self.width == NARROW

    @property
    def address(self) -> str:
        """The chart as a data address, for an image inside a page: an SVG whose text stays text.

        Where plotly.js can draw the chart instead, the SVG holds its data as the metadata `chart`.
        """
        with _styled():
            figure = Figure(figsize=(self.width, self.height or HEIGHT), dpi=72, facecolor="none", layout="constrained")
            canvas = FigureCanvasSVG(figure)
            self._drawn(figure)
            page, nothing = io.BytesIO(), dict.fromkeys(("Date", "Creator", "Format", "Type"))
            canvas.print_svg(page, metadata=nothing)
            chart = plotly_figure(figure)
        text = page.getvalue().decode()
        text = re.sub(r"<\?xml.*?\?>\s*|<!DOCTYPE.*?>\s*|<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
        text = re.sub(r"font-family: [^;\"]*", f"font-family: {FONTS}", text)
        if chart is not None:
            data = script_json(chart).replace("&", "\\u0026").replace(">", "\\u003e")
            text = text.replace("</svg>", f'<metadata id="chart">{data}</metadata></svg>')
        return "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()

    def write(self, path: Path | str) -> Path:
        """Writes the chart, whole or not at all, as a PDF or a PNG, as the ending of `path` says; returns the path.

        Raises UnusableInput where it can't be written.
        """
        kind = Path(path).suffix[1:]
        options: dict[str, Any] = {"pil_kwargs": {"compress_level": COMPRESSION}} if kind == "png" else {}
        with _styled():
            figure = Figure(figsize=(self.width, self.height or HEIGHT), facecolor="white", layout="constrained")
            FigureCanvasAgg(figure)
            title = literal(self.title)
            if title not in self._drawn(figure).get_title("left"):
                figure.suptitle(title, x=0.02, ha="left", fontsize=11, fontweight="bold")
            atomic_write(path, lambda to: figure.savefig(to, format=kind, **options))
        return Path(path)

    def _drawn(self, figure: Figure) -> Axes:
        axes = figure.subplots()
        self.draw(axes)
        if self.height is None:
            (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
            ratio = float(np.clip((top - bottom) / (right - left), 0.3, 1.5))
            figure.set_size_inches(self.width, ratio * (self.width - 0.6) + 1.1)
        return axes


def write_charts(folder: Path, charts: Iterable[Chart], kind: str, prefix: str = "") -> list[str]:
    """Writes each chart as a file into the folder; returns their names. `kind`: their ending, png or pdf."""
    names: list[str] = []
    for chart in charts:
        name = re.sub(r"[^\w.-]", "_", prefix + chart.name)[:100]
        while f"{name}.{kind}" in names:
            name += "_"
        names.append(chart.write(folder / f"{name}.{kind}").name)
    return names


def plotly_chart(draw: Draw) -> dict[str, Any]:
    """The chart as traces and layout of plotly.js, without an image."""
    with _styled():
        figure = Figure()
        draw(figure.subplots())
        chart = plotly_figure(figure)
    assert chart is not None
    return chart


def plain(axes: Axes, grid: str = "y") -> None:
    """Removes the left spine and its ticks, and keeps a grid along one axis only."""
    axes.grid(visible=False)
    if grid:
        axes.grid(visible=True, axis=grid)  # type: ignore[arg-type]
    axes.spines["left"].set_visible(False)
    axes.tick_params(left=False)


def logarithmic(axes: Axes, which: str) -> None:
    """Makes the axis x or y logarithmic, with round numbers at its ticks."""
    axes.set(**{f"{which}scale": "log"})
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=8))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_locator(NullLocator())


def literal(text: str) -> str:
    """A user's text for a plot: a dollar sign in it starts no formula."""
    return text.replace("$", r"\$")


def legend_above(axes: Axes, columns: int = 4) -> None:
    """A legend above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=columns, borderaxespad=0.2, handlelength=1.6)


def broken_at_gaps(times: np.ndarray, *columns: np.ndarray, gap: float = 1.0) -> tuple[np.ndarray, ...]:
    """Times and columns with a row of NaN in each gap longer than `gap` seconds and ten median steps."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    at = np.flatnonzero(steps > max(gap, 10 * usual)) + 1
    middles = 0.5 * (times[at] + times[at - 1])
    return np.insert(times, at, middles), *(np.insert(column, at, np.nan, axis=0) for column in columns)
