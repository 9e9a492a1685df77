"""What all charts share: one matplotlib style, colours for colour-blind readers, and PNG, PDF and SVG output.

A chart is a function that draws on axes: `write_panels` puts some into a file, `Chart.address` one onto a page.
"""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

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


@contextmanager
def figure_file(path: Path | str, width: float, height: float, title: str) -> Iterator[Figure]:
    """A figure of the given size in inches, written at the end of the block, whole or not at all: a PNG or a PDF.

    The ending of `path` names the kind. The block may change the size.
    """
    with _styled():
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
        figure = Figure(figsize=(width, height), dpi=STYLE["savefig.dpi"], facecolor="white", layout=layout)
        yield figure
        if title:
            left = 0.12 / float(figure.get_figwidth())
            figure.suptitle(literal(title), x=left, ha="left", fontsize=11, fontweight="bold")
        # `savefig` draws twice, the first time to lay the figure out, which drawing does anyway.
        if Path(path).suffix == ".pdf":
            from matplotlib.backends.backend_pdf import FigureCanvasPdf

            atomic_write(path, FigureCanvasPdf(figure).print_pdf)
        else:
            canvas = FigureCanvasAgg(figure)
            atomic_write(path, partial(canvas.print_png, pil_kwargs={"compress_level": COMPRESSION}))


def write_panels(
    path: Path | str,
    panels: Sequence[Draw],
    size: tuple[float, float] | None,
    title: str = "",
    columns: int = 1,
    legend: int = 0,
    **grid: Any,
) -> Path:
    """Writes a figure of the panels, in rows of `columns`, as `figure_file` does; returns its path.

    `size`: width and height in inches; None: of floor plans, whose axes say it. Panels below each other with the same
    words along x share that axis and the legend. `legend`: columns of one legend below all panels, that of the first,
    if any. `grid`: more for `Figure.subplots`.
    """
    with figure_file(path, *(size or (WIDTH, HEIGHT)), title) as figure:
        drawn = figure.subplots(-(-len(panels) // columns), columns, squeeze=False, **grid)
        for axes, draw in zip(drawn.flat, panels, strict=False):
            draw(axes)
        for axes in drawn.flat[len(panels) :]:
            axes.set_axis_off()
        if columns == 1:
            _joined(drawn[:, 0])
        for axes in drawn[:, 1:].flat if grid.get("sharey") else ():
            axes.set_ylabel("")
        if legend:
            figure.legend(*drawn[0, 0].get_legend_handles_labels(), loc="outside lower left", ncols=legend)
        if size is None:
            figure.set_size_inches(_plan_size(drawn))
    return Path(path)


def _plan_size(drawn: np.ndarray) -> tuple[float, float]:
    """Width and height in inches of floor plans in rows and columns; one alone has room for a legend at its side."""
    if drawn.size > 1:
        columns = drawn.shape[1]
        width = min(3.3 * columns + 0.4, 16.0)
        heights = [height_over_width(row[0], 0.3, 1.5) * width / columns + 0.6 for row in drawn]
        drawn[0, 0].get_gridspec().set_height_ratios(heights)
        return width, sum(heights) + 0.4
    ratio = height_over_width(drawn[0, 0], 0.25, 2.5)
    width = float(np.clip(np.sqrt(30 / ratio), 3.5, 8.5))
    legend = drawn[0, 0].get_legend()
    lines = [line for text in (legend.texts if legend else ()) for line in text.get_text().splitlines()]
    return width + max(1.9, 0.9 + 0.08 * max(map(len, lines), default=0)), width * ratio + 1.3


def _joined(column: Sequence[Axes]) -> None:
    """Panels below each other with the same words along x: one axis, one legend, one title at the right."""
    for above, below in pairwise(column):
        if above.get_xlabel() != below.get_xlabel():
            continue
        below.sharex(above)
        above.set_xlabel("")
        above.tick_params(labelbottom=False)
        below.set_title("", loc="right")
        legend = below.get_legend()
        if legend is not None:
            legend.remove()


def height_over_width(axes: Axes, least: float, most: float) -> float:
    """Of axes with equal units, between two limits."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    return float(np.clip((top - bottom) / (right - left), least, most))


class Chart(NamedTuple):
    """A chart of a page: its name in a file's name, words for the blind, what draws it, and its size in inches.

    `height`: None of a floor plan, whose axes say it.
    """

    name: str
    title: str
    draw: Draw
    width: float = WIDTH
    height: float | None = HEIGHT

    @property
    def address(self) -> str:
        """The chart as a data address, for an image inside a page, with the data that scripts draw instead."""
        return svg_address(self._drawn, self.width, self.height or HEIGHT)

    def _drawn(self, figure: Figure) -> None:
        axes = figure.subplots()
        self.draw(axes)
        if self.height is None:
            figure.set_size_inches(self.width, height_over_width(axes, 0.3, 1.5) * (self.width - 0.6) + 1.1)


def svg(draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT, movable: bool = False) -> str:
    """The SVG text that `draw` makes of an empty figure of that size in inches; its text stays text.

    With `movable` the SVG also holds the chart as data for plotly.js where it can, as the metadata `chart`.
    """
    with _styled():
        figure = Figure(figsize=(width, height), dpi=72, facecolor="none", layout="constrained")
        canvas = FigureCanvasSVG(figure)
        draw(figure)
        page, nothing = io.BytesIO(), dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas.print_svg(page, metadata=nothing)
        chart = plotly_figure(figure) if movable else None
    text = page.getvalue().decode()
    text = re.sub(r"<\?xml.*?\?>\s*|<!DOCTYPE.*?>\s*|<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"font-family: [^;\"]*", f"font-family: {FONTS}", text)
    if chart is None:
        return text
    data = script_json(chart).replace("&", "\\u0026").replace(">", "\\u003e")
    return text.replace("</svg>", f'<metadata id="chart">{data}</metadata></svg>')


def svg_address(draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT) -> str:
    """`svg` as a data address, for an image inside a page, with the data of the chart that scripts draw instead."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg(draw, width, height, movable=True).encode()).decode()


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
