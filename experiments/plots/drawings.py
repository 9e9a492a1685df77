"""Drawings inside a page: vector graphics whose text stays text, in the fonts of the reader."""

from __future__ import annotations

import base64
import io
import re
import warnings
from collections.abc import Callable

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from experiments.plots.style import GREY, STYLE

FONTS = "'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
INK = "#1d2733"
WIDTH, HEIGHT = 5.0, 3.1
"""Inches; a phone then shows the text at about its size, a desk two drawings side by side."""

NARROW = 3.6
"""Inches wide, where three drawings stand side by side."""

_STYLE = STYLE | {
    "savefig.bbox": "standard",
    "axes.facecolor": "none",
    "svg.fonttype": "none",
    "svg.hashsalt": "trackwright",  # the same drawing is the same file
    "axes.edgecolor": "#9aa5b1",
    "axes.labelcolor": GREY,
    "axes.titlesize": 9.5,
    "axes.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 0,
    "ytick.minor.size": 0,
    "text.color": INK,
    "axes.titlecolor": INK,
    "grid.color": "#e9edf1",
    "legend.handlelength": 1.5,
    "legend.borderaxespad": 0.2,
}


def drawn(draw: Callable[[Figure], object], width: float = WIDTH, height: float = HEIGHT) -> str:
    """The SVG that `draw` makes of an empty figure of that size in inches, as a data address for an image."""
    with rc_context(_STYLE), warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasSVG(figure)
        draw(figure)
        page = io.BytesIO()
        figure.savefig(
            page, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
            facecolor="none",
        )  # fmt: skip
    text = page.getvalue().decode()
    text = re.sub(r"<\?xml.*?\?>\s*|<!DOCTYPE.*?>\s*|<metadata>.*?</metadata>\s*", "", text, flags=re.DOTALL)
    text = re.sub(r"font-family: [^;\"]*", f"font-family: {FONTS}", text)
    return "data:image/svg+xml;base64," + base64.b64encode(text.encode()).decode()


def plain(axes: Axes, grid: str = "y") -> None:
    """Only the lines that help: no box, a grid along one axis."""
    axes.grid(visible=False)
    if grid:
        axes.grid(visible=True, axis=grid)  # type: ignore[arg-type]
    axes.spines["left"].set_visible(False)
    axes.tick_params(left=False)
