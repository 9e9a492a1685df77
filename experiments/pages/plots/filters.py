"""Plots of a filter's consistency: NEES and NIS over time, NIS against its distribution, and its autocorrelation.

`consistency` writes a PNG; the others return the data address of an SVG for a page.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from trackwright.experiments.pages.plots.style import (
    BEFORE,
    BLUE,
    GREY,
    NARROW,
    SKY,
    VERMILION,
    figure_file,
    legend_above,
    plain,
    svg_address,
)
from trackwright.trackers.evaluation.statements import LIMITS
from trackwright.tuning.diagnostics import (
    Innovations,
    autocorrelation,
    expected_density,
    nis_band,
    nis_probabilities,
    nis_quantile,
)

WINDOW = 50
"""Rows of the running mean that replaces the mean over runs where there is a single run."""

LAGS = 30


def consistency(
    path: Path | str,
    times: np.ndarray,
    nees: np.ndarray | None,
    nees_dof: float,
    nis: np.ndarray | None,
    nis_dof: float | np.ndarray,
    title: str = "Consistency of the reported covariances",
    xlabel: str = "time (s)",
    student_t_dof: float | None = None,
) -> Path:
    """Writes NEES and NIS per degree of freedom over time with their bands, and the NIS histogram; returns the path.

    `times` (t,) s; `nees`, `nis` (runs, t), None where unavailable, NaN in rows without; `nis_dof` a number or
    (runs, t). `student_t_dof`: of the tracker's noise, None for normal noise, NaN where it is unknown: NIS then has no
    band. Averaged over runs; a single run is averaged over `WINDOW` rows. Raises UnusableInput where the file can't be
    written.
    """
    shown = [(name, v, dof) for name, v, dof in (("NEES", nees, nees_dof), ("NIS", nis, nis_dof)) if v is not None]
    rows = len(shown) + (nis is not None)
    with figure_file(path, 8.0, 1.0 + 1.9 * rows, title) as figure:
        panels = figure.subplots(rows, 1, squeeze=False)[:, 0]
        for axes, (name, values, dof) in zip(panels, shown, strict=False):
            _ratio_panel(axes, times, values, dof, name, student_t_dof if name == "NIS" else None)
            axes.sharex(panels[0])
        panels[len(shown) - 1].set_xlabel(xlabel)
        legend_above(panels[0])
        if nis is not None:
            known = np.isfinite(nis) & (np.asarray(nis_dof) > 0)
            dofs = np.broadcast_to(nis_dof, nis.shape)[known]
            panels[-1].set(xlabel="NIS", ylabel="density")
            if known.any():
                _nis_histogram(panels[-1], Innovations(nis[known], dofs, np.zeros(len(dofs), int), student_t_dof))
    return Path(path)


def nis_chart(before: Innovations, after: Innovations) -> str:
    """Histograms of NIS before and after, and its density for a consistent filter."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _nis_histogram(axes, after, before)
        axes.set(xlabel="NIS of a row", ylabel="density")
        axes.set_title("NIS of all rows")
        plain(axes, "")

    return svg_address(draw, NARROW, NARROW * 0.92)


def probability_chart(before: Innovations, after: Innovations) -> str:
    """Histograms of the probabilities of NIS, which are uniform for a consistent filter."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        bins = np.linspace(0, 1, 21)
        old, new = (np.histogram(nis_probabilities(values), bins, density=True)[0] for values in (before, after))
        _pair(axes, bins, old, new)
        axes.axhline(1.0, color=VERMILION, linewidth=1.6, label="consistent")
        highest = max(2.0, float(new.max()), min(float(old.max()), 6.0))
        axes.set(xlim=(0, 1), ylim=(0, 1.3 * highest), xlabel="probability of a smaller NIS", ylabel="density")
        axes.legend(loc="upper center", ncols=3)
        axes.set_title("Probability transform of NIS")
        plain(axes)

    return svg_address(draw, NARROW, NARROW * 0.92)


def autocorrelation_chart(before: Innovations, after: Innovations) -> str:
    """Autocorrelation over rows of NIS transformed to normal scores; near zero for white innovations."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
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

    return svg_address(draw, NARROW, NARROW * 0.92)


def _nis_histogram(axes: Axes, after: Innovations, before: Innovations | None = None) -> None:
    """Histograms of NIS, and the density of a consistent filter with the degrees of freedom of the rows `after`."""
    known = _known(after.student_t_dof)
    end = 1.25 * nis_quantile(0.995, float(np.quantile(after.dof, 0.9)), after.student_t_dof if known else None)
    bins = np.linspace(0, end, 36)
    sides = [after] if before is None else [after, before]
    new, *old = (np.histogram(v.nis, bins)[0] / (len(v.nis) * (bins[1] - bins[0])) for v in sides)
    _pair(axes, bins, old[0] if old else None, new, "after" if old else f"{len(after.nis)} rows")
    # Before a fit the first bin may exceed all others many times; it is cut off.
    tallest = peak = max(float(heights.max()) for heights in (new, *old))
    if known:
        x = np.linspace(end / 400, end, 400)
        density = expected_density(x, after)
        axes.plot(x, density, color=VERMILION, linewidth=1.6, label=f"consistent ({_law(after.student_t_dof)})")
        peak = min(float(density[x > bins[1] / 2].max()), 2.5 * tallest)
    highest = max(peak, min(tallest, 2.5 * peak))
    axes.set(xlim=(0, end), ylim=(0, 1.6 * highest if before is not None else 1.12 * highest))
    beyond = [f"{100 * np.mean(v.nis > end):.1f} %" for v in sides]
    shares = beyond[0] if before is None else f"{beyond[1]} before, {beyond[0]} after"
    axes.legend(loc="upper right", title=f"beyond the axis: {shares}", title_fontsize=8, alignment="left")


def _pair(axes: Axes, bins: np.ndarray, old: np.ndarray | None, new: np.ndarray, label: str = "after") -> None:
    """Two histograms: `new` filled, `old` as an outline."""
    axes.stairs(new, bins, fill=True, color=BLUE, alpha=0.35, label=label)
    if old is not None:
        axes.stairs(old, bins, color=BEFORE, linewidth=1.3, label="before")


def _known(student_t_dof: float | None) -> bool:
    return student_t_dof is None or not math.isnan(student_t_dof)


def _law(student_t_dof: float | None) -> str:
    """The distribution behind a band or a density, in words."""
    return "χ²" if student_t_dof is None else "Student's t"


def _ratio_panel(
    axes: Axes, times: np.ndarray, values: np.ndarray, dof: float | np.ndarray, name: str, student_t_dof: float | None
) -> None:
    """The mean of `values` per degree of freedom over time: 1 for correct covariances."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    freedom = np.where(known, dof, 0.0).sum(axis=0)
    runs, independent, known_law = len(values), 1.0, _known(student_t_dof)
    mean = float(total.sum() / max(freedom.sum(), 1.0))
    window = min(WINDOW, len(times))
    if runs == 1:
        independent = 1.0 / inflation(total, freedom, window)
        total, freedom = (np.convolve(x, np.ones(window), "same") for x in (total, freedom))
    there = freedom > 0.5
    at, ratio, freedom = times[there], total[there] / freedom[there], freedom[there]
    over = f"mean of {runs} runs" if runs > 1 else f"running mean of {window} rows"
    low = high = np.ones(len(at))
    if known_law:
        low, high = nis_band(independent * freedom, student_t_dof)
        band = "95 % band" + (", rows as correlated as these" if runs == 1 else " of a consistent filter")
        axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label=band)
    axes.axhline(1.0, color=GREY, linewidth=0.8)
    axes.plot(at, ratio, color=BLUE, label=over)
    axes.set_ylabel(f"{name} / dof")
    axes.margins(x=0.01)
    if len(ratio) == 0:
        return
    # The first rows, with the covariance of the start, do not set the axis.
    least, largest = (float(np.quantile(ratio, p)) for p in (0.02, 0.98))
    if largest > 5 or least < 0.1:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
    bottom = 0.8 * max(min(least, float(np.median(low))), 1e-3)
    axes.set_ylim(bottom, 1.25 * max(largest, float(np.median(high))))
    expected = LIMITS[1] if name == "NEES" else f"1 expected ({_law(student_t_dof)})" if known_law else "1 expected"
    text = f"mean {mean:.2f}, {expected}"
    axes.text(0.995, 1.02, text, transform=axes.transAxes, ha="right", fontsize=8, color=GREY)


def inflation(values: np.ndarray, dof: np.ndarray, window: int) -> float:
    """So many rows carry the information of one in means of `values` (t,) over `window` rows; 1 at least.

    1 + 2 Σ (1 − k/w) ρₖ of the values per degree of freedom, w = `window` (Bartlett 1946); rows without any are left
    out.
    """
    ratio = values[dof > 0] / dof[dof > 0]
    # A few rows that lie far out, as those of a start, do not decide.
    centred = np.minimum(ratio, np.quantile(ratio, 0.99)) if len(ratio) else ratio
    centred = centred - centred.mean() if len(ratio) else centred
    power = float(centred @ centred)
    lags = range(1, min(window, len(centred)))
    total = sum((1 - k / window) * float(centred[k:] @ centred[:-k]) for k in lags)
    return max(1.0, 1 + 2 * total / power) if power > 0 else 1.0
