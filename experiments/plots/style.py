"""What all figures share: colours that colour-blind people tell apart, units, and saving a PNG."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from trackers.recordings.atomic import atomic_write

BLACK = "#000000"
GREY = "#6e6e6e"
ORANGE = "#e69f00"
SKY = "#56b4e9"
GREEN = "#009e73"
YELLOW = "#f0e442"
BLUE = "#0072b2"
VERMILION = "#d55e00"
PURPLE = "#cc79a7"
LINES = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""Okabe & Ito (2008) in the order tracks take them; yellow is left out, it is too light for a line on white."""

STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "savefig.dpi": 150,
    "savefig.bbox": "tight",
    "savefig.pad_inches": 0.12,
    "savefig.facecolor": "white",
}


@contextmanager
def drawing(path: Path | str, width: float, height: float, title: str) -> Iterator[Figure]:
    """A figure of the given size in inches, which is saved as a PNG at the end of the block, whole or not at all."""
    with rc_context(STYLE), warnings.catch_warnings():
        # A name in a script that the font lacks is drawn as boxes, which is no reason to bother the user.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        if title:
            figure.suptitle(literal(title), x=0.01, ha="left", fontsize=11, fontweight="bold")
        yield figure
        atomic_write(path, lambda temporary: figure.savefig(temporary, format="png"))


def literal(text: str) -> str:
    """A user's text for a figure: a dollar sign in it starts no formula."""
    return text.replace("$", r"\$")


def legend_above(axes: Axes, columns: int = 4) -> None:
    """A legend above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=columns, borderaxespad=0.2, handlelength=1.6)


def length_unit(size: float) -> tuple[str, float]:
    """The unit in which people read lengths of this size in metres, and how many of them are a metre."""
    if size >= 1.0 or not np.isfinite(size):
        return "m", 1.0
    return ("cm", 100.0) if size >= 0.01 else ("mm", 1000.0)


def broken_at_gaps(times: np.ndarray, *columns: np.ndarray, gap: float = 1.0) -> tuple[np.ndarray, ...]:
    """Times and columns with a row of NaN in each gap longer than `gap` seconds and ten usual steps."""
    steps = np.diff(times)
    usual = float(np.median(steps)) if len(steps) else 0.0
    at = np.flatnonzero(steps > max(gap, 10 * usual)) + 1
    middles = 0.5 * (times[at] + times[at - 1])
    return np.insert(times, at, middles), *(np.insert(column, at, np.nan, axis=0) for column in columns)
