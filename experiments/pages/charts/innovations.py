"""Charts of innovations: NIS against its distribution, its probabilities and its autocorrelation over rows."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trackwright.experiments.pages.charts.style import BEFORE, BLUE, VERMILION, plain
from trackwright.tuning.diagnostics import (
    Innovations,
    autocorrelation,
    expected_density,
    nis_probabilities,
    nis_quantile,
)

LAGS = 30


def draw_nis(axes: Axes, after: Innovations, before: Innovations | None = None) -> None:
    """Histograms of NIS, and the density of a consistent filter with the degrees of freedom of the rows `after`."""
    law = law_of(after.student_t_dof)
    end = 1.25 * nis_quantile(0.995, float(np.quantile(after.dof, 0.9)), after.student_t_dof if law else None)
    bins = np.linspace(0, end, 36)
    sides = [after] if before is None else [after, before]
    new, *old = (np.histogram(v.nis, bins)[0] / (len(v.nis) * (bins[1] - bins[0])) for v in sides)
    _pair(axes, bins, old[0] if old else None, new, "after" if old else f"{len(after.nis)} rows")
    # Before a fit the first bin may exceed all others many times; it is cut off.
    tallest = peak = max(float(heights.max()) for heights in (new, *old))
    if law:
        x = np.linspace(end / 400, end, 400)
        density = expected_density(x, after)
        axes.plot(x, density, color=VERMILION, linewidth=1.6, label=f"consistent ({law})")
        peak = min(float(density[x > bins[1] / 2].max()), 2.5 * tallest)
    highest = max(peak, min(tallest, 2.5 * peak))
    axes.set(xlim=(0, end), ylim=(0, 1.6 * highest if before is not None else 1.12 * highest))
    axes.set(xlabel="NIS of a row", ylabel="density")
    beyond = [f"{100 * np.mean(v.nis > end):.1f} %" for v in sides]
    shares = beyond[0] if before is None else f"{beyond[1]} before, {beyond[0]} after"
    axes.legend(loc="upper right", title=f"beyond the axis: {shares}", title_fontsize=8, alignment="left")


def _pair(axes: Axes, bins: np.ndarray, old: np.ndarray | None, new: np.ndarray, label: str = "after") -> None:
    """Two histograms: `new` filled, `old` as an outline."""
    axes.stairs(new, bins, fill=True, color=BLUE, alpha=0.35, label=label)
    if old is not None:
        axes.stairs(old, bins, color=BEFORE, linewidth=1.3, label="before")


def law_of(student_t_dof: float | None) -> str:
    """The distribution of NIS in words: of normal noise, of Student's t, empty for NaN, where it is unknown."""
    if student_t_dof is None:
        return "χ²"
    return "" if math.isnan(student_t_dof) else "Student's t"


def draw_probabilities(axes: Axes, before: Innovations, after: Innovations) -> None:
    """Histograms of the probabilities of NIS, which are uniform for a consistent filter."""
    bins = np.linspace(0, 1, 21)
    old, new = (np.histogram(nis_probabilities(values), bins, density=True)[0] for values in (before, after))
    _pair(axes, bins, old, new)
    axes.axhline(1.0, color=VERMILION, linewidth=1.6, label="consistent")
    highest = max(2.0, float(new.max()), min(float(old.max()), 6.0))
    axes.set(xlim=(0, 1), ylim=(0, 1.3 * highest), xlabel="probability of a smaller NIS", ylabel="density")
    axes.legend(loc="upper center", ncols=3)
    axes.set_title("Probability transform of NIS")
    plain(axes)


def draw_autocorrelation(axes: Axes, before: Innovations, after: Innovations) -> None:
    """Autocorrelation over rows of NIS transformed to normal scores; near zero for white innovations."""
    lags = np.arange(1, LAGS + 1)
    old, _ = autocorrelation(before, LAGS)
    new, pairs = autocorrelation(after, LAGS)
    band = 1.96 / np.sqrt(max(pairs, 1))
    axes.axhspan(-band, band, color=VERMILION, alpha=0.16, linewidth=0, label="95 % band of white noise")
    axes.axhline(0, color=VERMILION, linewidth=0.8)
    axes.vlines(lags, 0, new, color=BLUE, linewidth=2.4, alpha=0.55)
    axes.plot(lags, new, "o", color=BLUE, markersize=3.5, label="after")
    axes.plot(lags, old, "o-", color=BEFORE, markersize=2.5, linewidth=0.8, label="before")
    known = np.concatenate([old, new, [band, -band]])
    low, high = float(np.nanmin(known)), float(np.nanmax(known))
    axes.set(xlabel="lag (rows)", xlim=(0, LAGS + 1), ylim=(low - 0.1 * (high - low), high + 0.4 * (high - low)))
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.legend(loc="upper right", ncols=2)
    axes.set_title("Autocorrelation of NIS (normal scores)")
    plain(axes)
