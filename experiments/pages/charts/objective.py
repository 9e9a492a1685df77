"""An objective over one or two parameters: of a sweep's grid, in a file, and for the charts of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from trackwright.experiments.pages.charts.style import INK, SKY, VERMILION, literal, write_panels
from trackwright.tuning.sweeping import Sweep


def sweep_plot(path: Path | str, swept: Sweep, objective: str) -> Path:
    """Writes the objective over the grid, its minimum marked, with its spread over repeats; returns the path.

    `objective`: its name and unit. Raises UnusableInput where the file can't be written.
    """
    mean, at = swept.mean, swept.best_index
    best = [float(grid[k]) for grid, k in zip(swept.grids, at, strict=True)]
    labels = [named(p.label, p.example.unit) for p in swept.parameters]
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))

    def draw(axes: Axes) -> None:
        if len(labels) == 1:
            repeated = len(swept.values) > 1
            draw_curve(axes, swept.grids[0], mean, swept.spread if repeated else None, (best[0], float(mean[at])))
            axes.set_ylabel(literal(objective))
            if repeated:
                axes.legend(loc="best")
        else:
            draw_contours(axes, swept.grids, mean, (), (best[0], best[1]), objective)
            scale_axis(axes, swept.grids[1], "y", tight=True)
            axes.set_ylabel(labels[1])
        scale_axis(axes, swept.grids[0], "x", tight=len(labels) == 2)
        axes.set_xlabel(labels[0])
        axes.set_title(literal(f"minimum {mean[at]:.5g} at {shown}"), fontsize=9)

    return write_panels(path, [draw], (7.0, 4.6), f"Sweep: {objective}")


def named(name: str, unit: str) -> str:
    """Name and unit of a parameter, for an axis."""
    return literal(name + (f" ({unit})" if unit not in ("", "1") else ""))


def draw_curve(
    axes: Axes, grid: np.ndarray, values: np.ndarray, spread: np.ndarray | None, best: tuple[float, float]
) -> None:
    """The objective (n,) over one parameter, ± its spread over repeats, with the best point marked."""
    if spread is not None:
        low, high = values - spread, values + spread
        axes.fill_between(
            grid, low, high, color=SKY, alpha=0.35, linewidth=0, label="± standard deviation over repeats"
        )
    axes.plot(grid, values, color=INK, linewidth=1.4, marker="o" if len(grid) <= 40 else "", markersize=3.5)
    _mark(axes, best)


def _mark(axes: Axes, best: tuple[float, float]) -> None:
    axes.plot(
        *best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3, clip_on=False, zorder=5
    )


def draw_contours(
    axes: Axes,
    grids: Sequence[np.ndarray],
    values: np.ndarray,
    paths: Sequence[np.ndarray],
    best: tuple[float, float],
    name: str,
) -> None:
    """Contours of the objective `name` (n, m) over two parameters, and optimiser traces (i, 2), best one first.

    Levels are equidistant in the square root of the excess over the minimum: evenly spaced for a quadratic.
    """
    low = float(np.nanmin(values))
    above = values[np.isfinite(values)] - low
    top = float(np.quantile(above, 0.97)) or float(above.max()) or 1.0
    levels = low + np.linspace(0, np.sqrt(top), 12) ** 2
    shown = np.where(np.isfinite(values), values, np.nan).T
    filled = axes.contourf(*grids, shown, levels=levels, cmap="Blues_r", extend="max", alpha=0.75)
    bar = axes.figure.colorbar(filled, ax=axes, ticks=levels[::3], format="%.4g", pad=0.02, aspect=30)
    bar.set_label(literal(name), fontsize=8)
    bar.outline.set_visible(False)  # type: ignore[operator]
    axes.contour(*grids, shown, levels=levels, colors="white", linewidths=0.6, linestyles="solid")
    for k, path in reversed(list(enumerate(paths))):
        first = k == 0
        axes.plot(
            path[:, 0], path[:, 1], ".-", color=VERMILION if first else INK, markersize=4.5 if first else 2.5,
            linewidth=1.2 if first else 0.6, alpha=1.0 if first else 0.5,
            label={0: "best start" if len(paths) > 1 else "optimiser steps", 1: "other starts"}.get(k),
        )  # fmt: skip
    _mark(axes, best)
    axes.grid(visible=False)
    if paths:
        handles = (x[::-1] for x in axes.get_legend_handles_labels())
        axes.legend(*handles, loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)


def scale_axis(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """Scales the axis x or y: logarithmic where all values are positive and differ by more than half, else linear."""
    values = values[np.isfinite(values)]
    low, high = float(values.min()), float(values.max())
    set_limits = axes.set_xlim if which == "x" else axes.set_ylim
    axis = axes.xaxis if which == "x" else axes.yaxis
    if low > 0 and high > 1.5 * low:
        (axes.set_xscale if which == "x" else axes.set_yscale)("log")
        axis.set_major_locator(FixedLocator(_round_numbers(low, high)))
        axis.set_minor_locator(NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        factor = 1.0 if tight else (high / low) ** 0.06
        set_limits(low / factor, high * factor)
        return
    axis.set_major_locator(MaxNLocator(5))
    margin = 0.0 if tight and high > low else 0.08 * (high - low) or 0.1 * abs(high) or 1.0
    set_limits(low - margin, high + margin)


def _round_numbers(low: float, high: float) -> list[float]:
    """A few round numbers from `low` to `high`, evenly spaced on a logarithmic axis."""
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 2)
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        ticks = [d * 10.0**k for k in decades for d in digits if low <= d * 10.0**k <= high]
        if len(ticks) >= 3:
            return ticks
    ticks = [float(x) for x in MaxNLocator(5).tick_values(low, high) if low <= x <= high]
    return ticks
