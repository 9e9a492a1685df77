"""Figures that judge a filter: are its covariances consistent, and how did its tuning go.

Every function writes one PNG, whole or not at all, and returns its path; it raises UnusableInput where the file can't
be written.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from experiments.plots.style import BLACK, BLUE, GREY, LINES, SKY, VERMILION, drawing, legend_above, literal
from trackers.core.metrics import chi_square_density, chi_square_quantile

WINDOW = 50
"""Rows of the running mean that stands for the mean over runs where there is one run only."""


def consistency(
    path: Path | str,
    times: np.ndarray,
    nees: np.ndarray | None,
    nees_dof: float,
    nis: np.ndarray | None,
    nis_dof: float | np.ndarray,
    title: str = "Consistency of the reported covariances",
) -> Path:
    """Writes NEES and NIS per degree of freedom over time with χ² bounds, and the NIS histogram; returns the path.

    `times` (t,) s; `nees`, `nis` (runs, t), None where they can't be had, NaN in rows without; `nis_dof` a number or
    (runs, t). Averaged over runs; of one run a running mean over `WINDOW` rows.
    """
    shown = [(name, v, dof) for name, v, dof in (("NEES", nees, nees_dof), ("NIS", nis, nis_dof)) if v is not None]
    rows = len(shown) + (nis is not None)
    with drawing(path, 8.0, 1.0 + 1.9 * rows, title) as figure:
        panels = figure.subplots(rows, 1, squeeze=False)[:, 0]
        for axes, (name, values, dof) in zip(panels, shown, strict=False):
            _ratio_panel(axes, times, values, dof, name)
            axes.sharex(panels[0])
        panels[len(shown) - 1].set_xlabel("time (s)")
        legend_above(panels[0])
        if nis is not None:
            _histogram(panels[-1], nis, nis_dof)
    return Path(path)


def tuning_trace(
    path: Path | str,
    objective: np.ndarray,
    values: Mapping[str, np.ndarray],
    units: Mapping[str, str] | None = None,
    objective_name: str = "objective",
    title: str = "Tuning",
) -> Path:
    """Writes the objective and every tuned number, on a logarithmic axis, against the iteration; returns the path.

    `objective` (i,); `values`: by name (i,) in the unit that `units` gives; a number that is not always positive gets
    a linear axis.
    """
    lines = (len(values) + 1) // 2
    with drawing(path, 8.0, 2.7 + 1.7 * lines, title) as figure:
        grid = figure.add_gridspec(1 + lines, 2)
        top = figure.add_subplot(grid[0, :])
        top.plot(objective, color=BLACK)
        top.set_title(literal(f"{objective_name}: {objective[-1]:.6g}"))
        last = top
        for k, (name, trace) in enumerate(values.items()):
            last = figure.add_subplot(grid[1 + k // 2, k % 2], sharex=top)
            last.plot(trace, color=LINES[k % len(LINES)])
            unit = (units or {}).get(name, "1")
            last.set_title(literal(f"{name}: {trace[-1]:.4g} {unit if unit != '1' else ''}"))
            if np.nanmin(trace) > 0:
                _log_axis(last, trace)
            if k >= len(values) - 2:
                last.set_xlabel("iteration")
        last.set_xlabel("iteration")
    return Path(path)


def _log_axis(axes: Axes, trace: np.ndarray) -> None:
    """A logarithmic axis with plain numbers, of some height even where nothing moved."""
    axes.set_yscale("log")
    low, high = float(np.nanmin(trace)), float(np.nanmax(trace))
    middle, factor = np.sqrt(low * high), max(np.sqrt(high / low), 1.2) * 1.15
    axes.set_ylim(middle / factor, middle * factor)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if factor < 10 else (1.0,)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _ratio_panel(axes: Axes, times: np.ndarray, values: np.ndarray, dof: float | np.ndarray, name: str) -> None:
    """The mean of `values` per degree of freedom over time: 1 where the covariance is right."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    freedom = np.where(known, dof, 0.0).sum(axis=0)
    runs = len(values)
    window = min(WINDOW, len(times))
    if runs == 1:
        total, freedom = (np.convolve(x, np.ones(window), "same") for x in (total, freedom))
    there = freedom > 0.5
    at, ratio, freedom = times[there], total[there] / freedom[there], freedom[there]
    low, high = _bounds(freedom)
    over = f"mean of {runs} runs" if runs > 1 else f"running mean of {window} rows"
    band = "95 % of such means if consistent (χ²)" + (", rows independent" if runs == 1 else "")
    axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label=band)
    axes.axhline(1.0, color=GREY, linewidth=0.8)
    axes.plot(at, ratio, color=BLUE, label=over)
    axes.set_ylabel(f"{name} / dof")
    axes.margins(x=0.01)
    if len(ratio) and (ratio.max() > 5 or ratio.min() < 0.1):
        axes.set_yscale("log")
    if len(ratio):
        inside = np.mean((low <= ratio) & (ratio <= high))
        axes.text(
            0.995, 1.02, f"{100 * inside:.0f} % inside", transform=axes.transAxes, ha="right", fontsize=8, color=GREY
        )


def _bounds(freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The central 95 % of a mean of χ² values per degree of freedom, for each sum of degrees of freedom."""
    different = np.unique(freedom)
    # The bounds are smooth in the degrees of freedom: some dozens of exact values carry thousands.
    grid = different if len(different) <= 40 else np.geomspace(different[0], different[-1], 40)
    exact = [[chi_square_quantile(p, float(f)) / f for f in grid] for p in (0.025, 0.975)]
    low, high = (np.interp(freedom, grid, values) if len(grid) else freedom for values in exact)
    return low, high


def _histogram(axes: Axes, nis: np.ndarray, nis_dof: float | np.ndarray) -> None:
    """All NIS values that have the most frequent number of degrees of freedom above 0, against the density of χ²."""
    known = np.isfinite(nis) & (np.asarray(nis_dof) > 0)
    values, dofs = nis[known], np.broadcast_to(nis_dof, nis.shape)[known]
    axes.set(xlabel="NIS", ylabel="density")
    if len(values) == 0:
        return
    kinds, counts = np.unique(dofs, return_counts=True)
    dof = float(kinds[counts.argmax()])
    chosen = values[dofs == dof]
    end = 1.3 * chi_square_quantile(0.999, dof)
    bins = np.linspace(0, end, 41)
    heights = np.histogram(chosen, bins)[0] / (len(chosen) * (bins[1] - bins[0]))
    axes.stairs(heights, bins, fill=True, color=SKY, alpha=0.6, label=f"{len(chosen)} NIS values with {dof:g} dof")
    x = np.linspace(end / 400, end, 400)
    density = chi_square_density(x, dof)
    axes.plot(x, density, color=VERMILION, label=f"χ² density, {dof:g} dof")
    axes.set(xlim=(0, end), ylim=(0, 1.15 * max(heights.max(), density[x > bins[1] / 2].max())))
    beyond = int((chosen > end).sum())
    axes.legend(loc="upper right", title=f"{beyond} values beyond the axis" if beyond else None, title_fontsize=8)
