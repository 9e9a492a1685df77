"""Plot of the observed share of the truth inside the reported ellipses against their level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.plots.style import BLACK, GREY, LINES, figure_file, literal
from trackwright.trackers.core.data.chi_square import chi_square_probability
from trackwright.trackers.evaluation.statements import COVERAGE

NAMED = len(LINES)
"""The most recordings with a colour and a name of their own."""

MARKED = (50, 90, 95, 99)
"""Levels, %, marked on the curve of all rows."""

POINTS = np.linspace(0.0, 1.0, 401)


def coverage_curve(
    path: Path | str,
    recordings: np.ndarray,
    nees: np.ndarray,
    nees_3d: np.ndarray | None,
    title: str = "Share of the truth inside the reported ellipses",
) -> Path:
    """Writes the observed share against the level of the ellipse, of each recording and of all rows; returns the path.

    On the diagonal for correct covariances, below it where they are too small. `recordings` (n,): name of each row's.
    `nees` (n,): of the horizontal position or of both angles; `nees_3d` (n,): None without. NaN is left out.
    """
    panels = [("horizontal" if nees_3d is not None else "", nees, 2)]
    if nees_3d is not None and np.isfinite(nees_3d).any():
        panels.append(("3-D", nees_3d, 3))
    with figure_file(path, 1.0 + 4.2 * len(panels), 4.6, title) as figure:
        for axes, (name, values, dof) in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
            _panel(axes, recordings, values, dof)
            shape = "ellipsoid" if dof == 3 else "ellipse"
            axes.set(xlabel=f"level of the reported {shape} (%)", ylabel=f"truth inside the {shape} (% of rows)")
            axes.set_title(name)
    return Path(path)


def levels_of(nees: np.ndarray, dof: int) -> np.ndarray:
    """The level of the ellipse through the truth of each row, sorted; NaN is left out."""
    return np.sort(chi_square_probability(nees[np.isfinite(nees)], dof))


def observed_shares(levels_of_rows: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The share of rows inside the ellipse of each level; `levels_of_rows`: sorted."""
    return np.searchsorted(levels_of_rows, levels, side="right") / max(len(levels_of_rows), 1)


def _panel(axes: Axes, recordings: np.ndarray, nees: np.ndarray, dof: int) -> None:
    names = [name for name in np.unique(recordings) if np.isfinite(nees[recordings == name]).any()]
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="correct covariances")
    low, high = (100 * x for x in COVERAGE)
    axes.vlines(95, low, high, GREY, linewidth=4.0, alpha=0.45, label=f"covariances hold: {low:.0f} to {high:.0f} %")
    if len(names) > 1:
        for k, name in enumerate(names):
            own = levels_of(nees[recordings == name], dof)
            colour, label = (LINES[k], _named(name, own)) if len(names) <= NAMED else (GREY, None)
            axes.plot(100 * POINTS, 100 * observed_shares(own, POINTS), linewidth=0.9, color=colour, label=label)
    every = levels_of(nees, dof)
    label = _named("all rows" if len(names) > 1 else str(names[0]), every)
    shares = observed_shares(every, POINTS)
    axes.plot(100 * POINTS, 100 * shares, color=BLACK, linewidth=1.9, label=label)
    marked = observed_shares(every, np.array(MARKED) / 100)
    axes.plot(MARKED, 100 * marked, "o", color=BLACK, markersize=4, markeredgecolor="white")
    axes.set(xlim=(0, 100.8), ylim=(0, 100.8), xticks=(0, 25, 50, 75, 90, 100), yticks=(0, 25, 50, 75, 90, 100))
    axes.set_aspect("equal")
    below = float(np.mean(shares - POINTS)) < 0
    axes.legend(loc="upper left" if below else "lower right")


def _named(name: str, levels_of_rows: np.ndarray) -> str:
    return literal(f"{name}: {100 * observed_shares(levels_of_rows, np.array([0.95]))[0]:.0f} % inside 95 %")
