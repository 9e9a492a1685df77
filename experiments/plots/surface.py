"""An objective over one or two numbers, drawn on axes: what a sweep and the report of a fit have in common."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator

from experiments.plots.style import SKY, VERMILION, literal

DARK = "#1d2733"


def named(name: str, unit: str) -> str:
    """A number's name and unit for an axis."""
    return literal(name + (f" ({unit})" if unit not in ("", "1") else ""))


def curve(
    axes: Axes, grid: np.ndarray, values: np.ndarray, spread: np.ndarray | None, best: tuple[float, float]
) -> None:
    """The objective (n,) over the values of one number, ± its spread over repeats, the best point marked."""
    if spread is not None:
        low, high = values - spread, values + spread
        axes.fill_between(
            grid, low, high, color=SKY, alpha=0.35, linewidth=0, label="± standard deviation over repeats"
        )
    axes.plot(grid, values, color=DARK, linewidth=1.4)
    axes.plot(*best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3)


def contours(
    axes: Axes,
    grids: Sequence[np.ndarray],
    values: np.ndarray,
    paths: Sequence[np.ndarray],
    best: tuple[float, float],
) -> None:
    """The objective (n, m) over the values of two numbers, with paths (i, 2) to its optimum, the important one first.

    Rings are drawn at equal steps of the square root of what is above the least: a quadratic bowl has them evenly.
    """
    low = float(np.nanmin(values))
    above = values[np.isfinite(values)] - low
    top = float(np.quantile(above, 0.97)) or float(above.max()) or 1.0
    rings = low + np.linspace(0, np.sqrt(top), 12) ** 2
    shown = np.where(np.isfinite(values), values, np.nan).T
    axes.contourf(*grids, shown, levels=rings, cmap="Blues_r", extend="max", alpha=0.75)
    axes.contour(*grids, shown, levels=rings, colors="white", linewidths=0.6, linestyles="solid")
    for number, path in reversed(list(enumerate(paths))):
        first = number == 0
        axes.plot(
            path[:, 0], path[:, 1], ".-", color=VERMILION if first else DARK, markersize=4.5 if first else 2.5,
            linewidth=1.2 if first else 0.6, alpha=1.0 if first else 0.5,
            label={0: "best start" if len(paths) > 1 else "gradient", 1: "other starts"}.get(number),
        )  # fmt: skip
    axes.plot(*best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3)
    axes.grid(visible=False)
    if paths:
        handles = (x[::-1] for x in axes.get_legend_handles_labels())
        axes.legend(*handles, loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)


def scale_axis(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """A logarithmic axis with plain numbers where all values are positive and far apart, else a linear one."""
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
    """A few round numbers from `low` to `high`, evenly spread on a logarithmic axis."""
    decades = range(int(np.floor(np.log10(low))) - 1, int(np.ceil(np.log10(high))) + 2)
    for digits in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 4, 5, 6, 8)):
        found = [d * 10.0**k for k in decades for d in digits if low <= d * 10.0**k <= high]
        if len(found) >= 3:
            return found
    ticks = [float(x) for x in MaxNLocator(5).tick_values(low, high) if low <= x <= high]
    return ticks
