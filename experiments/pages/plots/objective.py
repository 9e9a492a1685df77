"""Plots of an objective: over one or two parameters, along the optimiser's steps, and over a sweep's grid.

`sweep_plot` and `tuning_trace` write a PNG; the charts return the data address of an SVG for a page.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from trackwright.experiments.pages.plots.style import (
    BLACK,
    BLUE,
    INK,
    NARROW,
    SKY,
    VERMILION,
    WIDTH,
    figure_file,
    literal,
    plain,
    svg_address,
)
from trackwright.experiments.pages.reports.tuning_data import OptimiserTrace, TuningReportData
from trackwright.experiments.text.wording import number
from trackwright.tuning.surface import Surface
from trackwright.tuning.sweeping import Sweep

PALE = "#c3ccd6"


def sweep_plot(path: Path | str, swept: Sweep, objective: str, paths: Sequence[np.ndarray] = ()) -> Path:
    """Writes the objective over the grid, its minimum marked, with its spread over repeats; returns the path.

    `objective`: its name and unit. `paths`: optimiser traces, (i, p) for the p swept parameters. Raises UnusableInput
    where the file can't be written.
    """
    mean, at = swept.mean, swept.best_index
    best = [grid[k] for grid, k in zip(swept.grids, at, strict=True)]
    labels = [_named(p.label, p.example.unit) for p in swept.parameters]
    shown = ", ".join(f"{p.label} = {x:.4g}" for p, x in zip(swept.parameters, best, strict=True))
    with figure_file(path, 7.0, 4.6, f"Sweep: {objective}") as figure:
        axes = figure.subplots()
        if len(labels) == 1:
            repeated = len(swept.values) > 1
            _curve(axes, swept.grids[0], mean, swept.spread if repeated else None, (float(best[0]), float(mean[at])))
            for steps in paths:
                # The fit may have had another objective: its steps are drawn at the sweep's values.
                level = np.interp(steps[:, 0], swept.grids[0], mean)
                axes.plot(steps[:, 0], level, ".-", color=BLUE, markersize=4, linewidth=0.6, label="optimiser steps")
            axes.set_ylabel(literal(objective))
            if repeated or paths:
                axes.legend(loc="best")
        else:
            _contours(axes, swept.grids, mean, paths, (float(best[0]), float(best[1])), objective)
            _scale_axis(axes, swept.grids[1], "y", tight=True)
            axes.set_ylabel(labels[1])
        _scale_axis(axes, swept.grids[0], "x", tight=len(labels) == 2)
        axes.set_xlabel(labels[0])
        # Over contours the legend is between them and the title.
        above = 22 if len(labels) == 2 and paths else 6
        axes.set_title(literal(f"minimum {mean[at]:.5g} at {shown}"), fontsize=9, pad=above)
    return Path(path)


def tuning_trace(
    path: Path | str,
    objective: np.ndarray,
    values: Mapping[str, np.ndarray],
    units: Mapping[str, str] | None = None,
    objective_name: str = "objective",
    title: str = "Fit",
) -> Path:
    """Writes the objective and every tuned parameter over the iterations; returns the path.

    `objective` (i,); `values`: by name (i,), in the units of `units`. Parameters that are always positive have a
    logarithmic axis. Raises UnusableInput where the file can't be written.
    """
    lines = (len(values) + 1) // 2
    with figure_file(path, 8.0, 2.7 + 1.7 * lines, title) as figure:
        grid = figure.add_gridspec(1 + lines, 2)
        top = figure.add_subplot(grid[0, :])
        top.plot(objective, color=BLACK)
        top.set_title(literal(f"{objective_name}: {objective[-1]:.6g}"))
        last = top
        for k, (name, trace) in enumerate(values.items()):
            last = figure.add_subplot(grid[1 + k // 2, k % 2], sharex=top)
            last.plot(trace, color=BLUE)
            unit = (units or {}).get(name, "1")
            last.set_title(literal(f"{name}: {trace[-1]:.4g} {unit if unit != '1' else ''}"))
            if np.nanmin(trace) > 0:
                _log_axis(last, trace)
            if k >= len(values) - 2:
                last.set_xlabel("iteration")
        last.set_xlabel("iteration")
    return Path(path)


def objective_chart(data: TuningReportData) -> str:
    """The objective at every step of every start."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _lines(axes, data.traces, lambda t: t.objective)
        shown = np.concatenate([t.objective for t in data.traces])
        shown = shown[np.isfinite(shown)]
        best, longest = float(shown.min()), max(len(t.objective) for t in data.traces)
        # A start with a far larger objective must not flatten all others.
        usual = best + 6 * float(np.quantile(shown, 0.75) - best) or np.inf
        top = max(float(np.nanmax(data.traces[0].objective)), min(float(shown.max()), usual))
        margin = 0.06 * (top - best) or 0.1 * abs(best) or 1.0
        axes.set(xlabel="step", ylim=(best - margin, top + margin))
        axes.set_title(literal(data.objective_about))
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        step, value = _selected(data)
        axes.plot([step], [value], "o", color=BLUE, markersize=6, markeredgecolor="white", zorder=3)
        axes.annotate(
            number(value), (step, value), xytext=(0, 7), textcoords="offset points",
            ha="right" if step > 0.5 * longest else "left", color=BLUE, fontsize=9, fontweight="bold",
        )  # fmt: skip
        if len(data.traces) > 1:
            axes.legend(*(x[::-1] for x in axes.get_legend_handles_labels()), loc="upper right")
        plain(axes)

    return svg_address(draw)


def parameter_chart(data: TuningReportData, k: int) -> str:
    """Parameter `k` at every step of every start, on a logarithmic axis where it is positive."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _lines(axes, data.traces, lambda t: t.values[:, k])
        axes.set_title(_named(data.parameters[k].name, data.parameters[k].unit))
        _scale_axis(axes, np.concatenate([t.values[:, k] for t in data.traces]), "y")
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_xlabel("step")
        plain(axes)

    return svg_address(draw, NARROW, 0.62 * NARROW)


def surface_chart(data: TuningReportData, surface: Surface) -> str:
    """The objective over one parameter as a curve, over two as contours with the steps of all starts."""
    known = [data.parameters[k] for k in surface.axes]
    best = [n.after for n in known]

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        if len(known) == 1:
            _curve(axes, surface.grids[0], surface.values, None, (best[0], float(np.nanmin(surface.values))))
            axes.set_title(literal(data.objective_about))
            plain(axes)
        else:
            paths = [t.values[:, list(surface.axes)] for t in data.traces]
            _contours(axes, surface.grids, surface.values, paths, (best[0], best[1]), data.objective_about)
            _scale_axis(axes, surface.grids[1], "y", tight=True)
            axes.set_ylabel(_named(known[1].name, known[1].unit))
        _scale_axis(axes, surface.grids[0], "x", tight=True)
        axes.set_xlabel(_named(known[0].name, known[0].unit))

    return svg_address(draw, WIDTH, 3.6)


def _selected(data: TuningReportData) -> tuple[int, float]:
    """The step of the best start nearest to the selected point, and its objective."""
    trace = data.traces[0]
    after = np.array([n.after for n in data.parameters])
    size = np.maximum(np.abs(after), np.finfo(float).tiny)
    step = int(np.argmin((np.abs(trace.values - after) / size).max(axis=1)))
    return step, float(trace.objective[step])


def _lines(axes: Axes, traces: tuple[OptimiserTrace, ...], take: Callable[[OptimiserTrace], np.ndarray]) -> None:
    for k, trace in reversed(list(enumerate(traces))):
        label = {0: "best start", 1: "other starts"}.get(k)
        axes.plot(take(trace), color=BLUE if k == 0 else PALE, linewidth=1.8 if k == 0 else 1.1, label=label)


def _named(name: str, unit: str) -> str:
    """Name and unit of a parameter, for an axis."""
    return literal(name + (f" ({unit})" if unit not in ("", "1") else ""))


def _curve(
    axes: Axes, grid: np.ndarray, values: np.ndarray, spread: np.ndarray | None, best: tuple[float, float]
) -> None:
    """Draws the objective (n,) over one parameter, ± its spread over repeats, with the best point marked."""
    if spread is not None:
        low, high = values - spread, values + spread
        axes.fill_between(
            grid, low, high, color=SKY, alpha=0.35, linewidth=0, label="± standard deviation over repeats"
        )
    axes.plot(grid, values, color=INK, linewidth=1.4, marker="o" if len(grid) <= 40 else "", markersize=3.5)
    axes.plot(
        *best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3, clip_on=False, zorder=5
    )


def _contours(
    axes: Axes,
    grids: Sequence[np.ndarray],
    values: np.ndarray,
    paths: Sequence[np.ndarray],
    best: tuple[float, float],
    name: str,
) -> None:
    """Draws contours of the objective `name` (n, m) over two parameters, and optimiser traces (i, 2), best one first.

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
    axes.plot(
        *best, "o", color=VERMILION, markersize=8, markeredgecolor="white", markeredgewidth=1.3, clip_on=False, zorder=5
    )
    axes.grid(visible=False)
    if paths:
        handles = (x[::-1] for x in axes.get_legend_handles_labels())
        axes.legend(*handles, loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=3)


def _scale_axis(axes: Axes, values: np.ndarray, which: str, tight: bool = False) -> None:
    """Scales an axis: logarithmic where all values are positive and differ by more than half, else linear."""
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
        found = [d * 10.0**k for k in decades for d in digits if low <= d * 10.0**k <= high]
        if len(found) >= 3:
            return found
    ticks = [float(x) for x in MaxNLocator(5).tick_values(low, high) if low <= x <= high]
    return ticks


def _log_axis(axes: Axes, trace: np.ndarray) -> None:
    """A logarithmic axis with plain numbers, of some height even for a constant."""
    axes.set_yscale("log")
    low, high = float(np.nanmin(trace)), float(np.nanmax(trace))
    middle, factor = np.sqrt(low * high), max(np.sqrt(high / low), 1.2) * 1.15
    axes.set_ylim(middle / factor, middle * factor)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if factor < 10 else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
