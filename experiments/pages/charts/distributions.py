"""Distributions: of errors, of the truth over the levels of the reported ellipses, and of NIS; its autocorrelation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from trackwright.experiments.pages.charts.style import BEFORE, BLACK, BLUE, GREY, LINES, VERMILION, literal, plain
from trackwright.trackers.core.data.consistency import chi_square_probability
from trackwright.trackers.evaluation.statements import COVERAGE
from trackwright.tuning.diagnostics import (
    Innovations,
    autocorrelation,
    expected_density,
    nis_probabilities,
    nis_quantile,
)

POINTS = 201
"""The most points of a curve."""

LOOKS: list[dict[str, Any]] = [{"color": colour} for colour in LINES]

SHARES = (0, 25, 50, 75, 90, 95, 100)
"""Ticks of an axis of shares, %."""

LEVELS = (50, 90, 95, 99)
"""Levels of ellipses, %, marked on the curve of all rows."""

LAGS = 30
"""Rows over which the autocorrelation of NIS is drawn."""


class Curve(NamedTuple):
    """A distribution function: its name, sorted errors (k,) and the shares (k,), %, of rows with at most this error."""

    name: str
    errors: np.ndarray
    shares: np.ndarray

    @classmethod
    def of(cls, name: str, errors: np.ndarray) -> Curve:
        """That of errors (n,), linear between order statistics (Hyndman & Fan 1996, definition 7); NaN is left out."""
        ordered = np.sort(errors[np.isfinite(errors)])
        shares = np.linspace(0, 100, min(len(ordered), POINTS))
        return cls(name, np.interp(shares / 100 * (len(ordered) - 1), np.arange(len(ordered)), ordered), shares)

    def quantiles(self, shares: Sequence[float]) -> np.ndarray:
        """The errors that these shares, %, of the rows have at most; exact where they are among those of the curve."""
        return np.interp(shares, self.shares, self.errors)


def draw_distributions(
    axes: Axes,
    curves: Sequence[Curve],
    quantity: str,
    end: float,
    marked: Sequence[float] = (),
    looks: Sequence[Mapping[str, Any]] = LOOKS,
) -> None:
    """Distribution functions of errors up to `end`, the last error shown.

    `quantity`: what the errors are, with their unit. `marked`: shares, %, marked on each curve. `looks`: colour and
    more of the lines, taken in turn.
    """
    for share in marked if len(marked) > 1 else ():
        axes.axhline(share, color=GREY, linewidth=0.7, linestyle=":")
    for k, curve in enumerate(curves):
        look = dict(looks[k % len(looks)])
        axes.plot(curve.errors, curve.shares, label=literal(curve.name), **look)
        if marked:
            at = curve.quantiles(marked)
            mark = {"color": look["color"], "markersize": 4.5, "markeredgecolor": "white", "label": "_"}
            axes.plot(at, marked, "o", **mark)
    axes.set(xlim=(0, end), ylim=(0, 101), yticks=SHARES, xlabel=quantity)
    axes.set_ylabel("estimates with at most this error (%)")


def levels_of(nees: np.ndarray, dof: int) -> np.ndarray:
    """The level of the ellipse through the truth of each row, sorted; NaN is left out."""
    return np.sort(chi_square_probability(nees[~np.isnan(nees)], dof))


def observed_shares(levels_of_rows: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The share of rows inside the ellipse of each level; `levels_of_rows`: sorted."""
    return np.searchsorted(levels_of_rows, levels, side="right") / max(len(levels_of_rows), 1)


def draw_coverage(axes: Axes, curves: Mapping[str, np.ndarray], pooled: str = "") -> None:
    """The observed share of the truth inside the reported ellipses against their level.

    On the diagonal for correct covariances, below it where they are too small. `curves`: by name the levels of rows as
    `levels_of` has them. `pooled`: the name of the curve that is drawn thick, of all of them together.
    """
    if pooled:
        curves = {**curves, pooled: np.sort(np.concatenate([*curves.values()]))}
    at = np.linspace(0.0, 1.0, POINTS)
    axes.plot([0, 100], [0, 100], color=GREY, linewidth=1.0, linestyle=(0, (4, 3)), label="correct covariances")
    low, high = (100 * x for x in COVERAGE)
    axes.vlines(95, low, high, GREY, linewidth=4.0, alpha=0.45, label=f"covariances hold: {low:.0f} to {high:.0f} %")
    others = [name for name in curves if name != pooled]
    for name, levels in curves.items():
        inside = literal(f"{name}: {100 * observed_shares(levels, np.array([0.95]))[0]:.0f} % inside 95 %")
        shares = 100 * observed_shares(levels, at)
        if name == pooled:
            axes.plot(100 * at, shares, color=BLACK, linewidth=1.9, label=inside)
            marked = 100 * observed_shares(levels, np.array(LEVELS) / 100)
            axes.plot(LEVELS, marked, "o", color=BLACK, markersize=4, markeredgecolor="white", label="_")
        elif len(others) <= len(LINES):
            axes.plot(100 * at, shares, color=LINES[others.index(name)], linewidth=0.9 if pooled else 1.6, label=inside)
        else:
            # Of many curves none has a colour and a name of its own.
            axes.plot(100 * at, shares, color=GREY, linewidth=0.9, label="_")
    axes.set(xlim=(0, 100.8), ylim=(0, 100.8), xticks=SHARES[:5] + SHARES[6:], yticks=SHARES[:5] + SHARES[6:])
    axes.set_aspect("equal")
    all_levels = curves[pooled] if pooled else np.sort(np.concatenate([*curves.values()]))
    below = float(np.mean(observed_shares(all_levels, at) - at)) < 0
    axes.legend(loc="upper left" if below else "lower right")


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
