"""An objective over one or two parameters: of a sweep's grid, in a file, and for the charts of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

from trackwright.experiments.pages.charts.style import INK, SKY, VERMILION, Chart, literal
from trackwright.tuning.sweeping import Sweep

BEST: dict[str, Any] = {"color": VERMILION, "markersize": 8, "markeredgecolor": "white", "clip_on": False, "zorder": 5}
"""The mark of the best point."""


def sweep_plot(path: Path | str, swept: Sweep, objective: str) -> Path:
    """Writes the objective over the grid, its minimum marked, with its spread over repeats; returns the path.

    `objective`: its name and unit. Raises UnusableInput where the file can't be written.
    """
    mean, at = swept.mean, swept.best_index
    best = [float(grid[k]) for grid, k in zip(swept.grids, at, strict=True)]
    labels = [named(p.label, p.example.unit) for p in swept.parameters]
    spread = swept.spread if len(swept.values) > 1 else None
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))

    def draw(axes: Axes) -> None:
        draw_objective(axes, labels, swept.grids, mean, best, objective, (), spread)
        axes.set_title(literal(f"minimum {mean[at]:.5g} at {shown}"), fontsize=9)

    return Chart("sweep", f"Sweep: {objective}", draw, 7.0, 4.6).write(path)


def named(name: str, unit: str) -> str:
    """Name and unit of a parameter, for an axis."""
    return literal(name + (f" ({unit})" if unit not in ("", "1") else ""))


def draw_objective(
    axes: Axes,
    labels: Sequence[str],
    grids: Sequence[np.ndarray],
    values: np.ndarray,
    best: Sequence[float],
    name: str,
    paths: Sequence[np.ndarray] = (),
    spread: np.ndarray | None = None,
) -> None:
    """The objective `name` over one parameter (n,) as a curve, or over two (n, m) as contours.

    `best`: the point that is marked. `paths`: optimiser traces (i, p), the best one first; along a curve they are drawn
    at its values, since a fit may have had another objective. `spread` (n,): over repeats. Levels of contours are
    equidistant in the square root of the excess over the minimum: evenly spaced for a quadratic.
    """
    curve, height = len(labels) == 1, float(np.nanmin(values))
    if curve:
        (grid,) = grids
        if spread is not None:
            label = "± standard deviation over repeats"
            axes.fill_between(grid, values - spread, values + spread, color=SKY, alpha=0.35, linewidth=0, label=label)
        axes.plot(grid, values, color=INK, linewidth=1.4, marker="o" if len(grid) <= 40 else "", markersize=3.5)
        paths = [np.column_stack([path, np.interp(path[:, 0], grid, values, np.nan, np.nan)]) for path in paths]
        axes.set_ylabel(literal(name))
    else:
        above = values[np.isfinite(values)] - height
        top = float(np.quantile(above, 0.97)) or float(above.max()) or 1.0
        levels = height + np.linspace(0, np.sqrt(top), 12) ** 2
        shown = np.where(np.isfinite(values), values, np.nan).T
        filled = axes.contourf(*grids, shown, levels=levels, cmap="Blues_r", extend="max", alpha=0.75)
        bar = axes.figure.colorbar(filled, ax=axes, ticks=levels[::3], format="%.4g", pad=0.02, aspect=30)
        bar.set_label(literal(name), fontsize=8)
        bar.outline.set_visible(False)  # type: ignore[operator]
        axes.contour(*grids, shown, levels=levels, colors="white", linewidths=0.6, linestyles="solid")
        axes.grid(visible=False)
        scale_axis(axes, grids[1], "y", tight=True)
        axes.set_ylabel(labels[1])
    for k, path in reversed(list(enumerate(paths))):
        colour, size, width, alpha = (VERMILION, 4.5, 1.2, 1.0) if k == 0 else (INK, 2.5, 0.6, 0.5)
        label = {0: "best start" if len(paths) > 1 else "optimiser steps", 1: "other starts"}.get(k, "_")
        axes.plot(*path.T, ".-", color=colour, markersize=size, linewidth=width, alpha=alpha, label=label)
    axes.plot(*best, *([height] if curve else []), "o", **BEST)
    handles, texts = axes.get_legend_handles_labels()
    if texts:
        place = {"loc": "best"} if curve else {"loc": "lower left", "bbox_to_anchor": (-0.01, 1.0), "ncols": 3}
        axes.legend(handles[::-1], texts[::-1], **place)
    scale_axis(axes, grids[0], "x", tight=not curve)
    axes.set_xlabel(labels[0])


def scale_axis(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """Scales the axis x or y: logarithmic where all values are positive and differ by more than half, else linear."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    axis = axes.xaxis if which == "x" else axes.yaxis
    if low > 0 and high > 1.5 * low:
        axes.set(**{f"{which}scale": "log"})
        axis.set_major_locator(FixedLocator(_round_numbers(low, high)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter("{x:g}")
        factor = 1.0 if tight else (high / low) ** 0.06
        axes.set(**{f"{which}lim": (low / factor, high * factor)})
        return
    axis.set_major_locator(MaxNLocator(5))
    margin = 0.0 if tight and high > low else 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    axes.set(**{f"{which}lim": (low - margin, high + margin)})


def _round_numbers(low: float, high: float) -> list[float]:
    """A few round numbers from `low` to `high`, evenly spaced on a logarithmic axis."""
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 2)
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        ticks = [d * 10.0**k for k in decades for d in digits if low <= d * 10.0**k <= high]
        if len(ticks) >= 3:
            return ticks
    ticks = [float(x) for x in MaxNLocator(5).tick_values(low, high) if low <= x <= high]
    return ticks
