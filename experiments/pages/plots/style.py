"""What all plots share: one matplotlib style, colours for colour-blind readers, and PNG, PDF and SVG output."""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from trackwright.experiments.pages.interactive.packing import script_json
from trackwright.experiments.pages.plots.plotly_figure import plotly_figure
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


@contextmanager
def figure_file(path: Path | str, width: float, height: float, title: str) -> Iterator[Figure]:
    """A figure of the given size in inches, written at the end of the block, whole or not at all: a PNG or a PDF.

    The ending of `path` names the kind.
    """
    with _styled():
        layout = ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.06)
        figure = Figure(figsize=(width, height), dpi=STYLE["savefig.dpi"], facecolor="white", layout=layout)
        if title:
            figure.suptitle(literal(title), x=0.12 / width, ha="left", fontsize=11, fontweight="bold")
        yield figure
        # `savefig` draws twice, the first time to lay the figure out, which drawing does anyway.
        if Path(path).suffix == ".pdf":
            from matplotlib.backends.backend_pdf import FigureCanvasPdf

            atomic_write(path, FigureCanvasPdf(figure).print_pdf)
        else:
            canvas = FigureCanvasAgg(figure)
            atomic_write(path, partial(canvas.print_png, pil_kwargs={"compress_level": COMPRESSION}))


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
    data = script_json(chart | {"height": height / width}).replace("&", "\\u0026").replace(">", "\\u003e")
    return text.replace("</svg>", f'<metadata id="chart">{data}</metadata></svg>')


def svg_address(draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT) -> str:
    """`svg` as a data address, for an image inside a page, with the data of the chart that scripts draw instead."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg(draw, width, height, movable=True).encode()).decode()


def write_svg(
    folder: Path, name: str, draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT
) -> str:
    """Writes `svg` to the file `name` of the folder; returns the name."""
    text = svg(draw, width, height)
    atomic_write(folder / name, lambda temporary: temporary.write_text(text, "utf-8"))
    return name


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
