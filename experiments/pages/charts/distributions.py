"""Distributions of errors and of NIS, one or several, and the autocorrelation of NIS before and after a fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from trackwright.experiments.pages.charts.style import BEFORE, BLUE, GREY, LINES, VERMILION, literal, plain
from trackwright.tuning.diagnostics import (
    Innovations,
    autocorrelation,
    expected_density,
    nis_probabilities,
    nis_quantile,
)

LOOKS: list[dict[str, Any]] = [{"color": colour} for colour in LINES]

SHARES = (0, 25, 50, 75, 90, 95, 100)
"""Ticks of an axis of shares, %."""

LAGS = 30
"""Rows over which the autocorrelation of NIS is drawn."""


class Curve(NamedTuple):
    """A distribution function: its name, sorted errors (k,) and the shares (k,), %, of rows with at most this error."""

    name: str
    errors: np.ndarray
    shares: np.ndarray

    @classmethod
    def of(cls, name: str, errors: np.ndarray) -> Curve:
        """The curve of errors (n,), linear between order statistics; NaN is left out."""
        known = errors[np.isfinite(errors)]
        shares = np.linspace(0, 100, min(len(known), 201))
        return cls(name, np.percentile(known, shares), shares)

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
    for k, curve in enumerate(curves):
        look = dict(looks[k % len(looks)])
        axes.plot(curve.errors, curve.shares, label=literal(curve.name), **look)
        if marked:
            mark = {"color": look["color"], "markersize": 4.5, "markeredgecolor": "white", "label": "_"}
            axes.plot(curve.quantiles(marked), marked, "o", **mark)
    axes.set(xlim=(0, end), ylim=(0, 101), yticks=SHARES, xlabel=quantity)
    axes.set_ylabel("estimates with at most this error (%)")


def law_of(student_t_dof: float | None) -> str:
    """The distribution of NIS in words: of normal noise, of Student's t, empty for NaN, where it is unknown."""
    if student_t_dof is None:
        return "χ²"
    return "" if math.isnan(student_t_dof) else "Student's t"


def draw_nis(axes: Axes, after: Innovations, before: Innovations | None = None) -> None:
    """Histograms of NIS, and the density of a consistent filter with the degrees of freedom of the rows `after`."""
    law = law_of(after.student_t_dof)
    end = 1.25 * nis_quantile(0.995, float(np.quantile(after.dof, 0.9)), after.student_t_dof if law else None)
    bins, sides = np.linspace(0, end, 36), [after] if before is None else [after, before]
    heights = [np.histogram(side.nis, bins)[0] / (len(side.nis) * bins[1]) for side in sides]
    _histograms(axes, bins, heights, f"{len(after.nis)} rows" if before is None else "after")
    # Before a fit the first bin may exceed all others many times; it is cut off.
    tallest = peak = max(float(height.max()) for height in heights)
    if law:
        x = np.linspace(end / 400, end, 400)
        density = expected_density(x, after)
        axes.plot(x, density, color=VERMILION, linewidth=1.6, label=f"consistent ({law})")
        peak = min(float(density[x > bins[1] / 2].max()), 2.5 * tallest)
    room = 1.12 if before is None else 1.6
    axes.set(xlim=(0, end), ylim=(0, room * max(peak, min(tallest, 2.5 * peak))), xlabel="NIS of a row")
    axes.set_ylabel("density")
    beyond = [f"{100 * np.mean(side.nis > end):.1f} %" for side in sides]
    shares = beyond[0] if before is None else f"{beyond[1]} before, {beyond[0]} after"
    axes.legend(loc="upper right", title=f"beyond the axis: {shares}", title_fontsize=8, alignment="left")


def _histograms(axes: Axes, bins: np.ndarray, heights: Sequence[np.ndarray], label: str = "after") -> None:
    """The histogram after filled, the one before, if any, as an outline."""
    axes.stairs(heights[0], bins, fill=True, color=BLUE, alpha=0.35, label=label)
    for before in heights[1:]:
        axes.stairs(before, bins, color=BEFORE, linewidth=1.3, label="before")


def draw_probabilities(axes: Axes, before: Innovations, after: Innovations) -> None:
    """Histograms of the probabilities of NIS, which are uniform for a consistent filter."""
    bins = np.linspace(0, 1, 21)
    new, old = (np.histogram(nis_probabilities(side), bins, density=True)[0] for side in (after, before))
    _histograms(axes, bins, [new, old])
    axes.axhline(1.0, color=VERMILION, linewidth=1.6, label="consistent")
    highest = max(2.0, float(new.max()), min(float(old.max()), 6.0))
    axes.set(xlim=(0, 1), ylim=(0, 1.3 * highest), xlabel="probability of a smaller NIS", ylabel="density")
    axes.legend(loc="upper center", ncols=3)
    axes.set_title("Probability transform of NIS")
    plain(axes)


def draw_autocorrelation(axes: Axes, before: Innovations, after: Innovations) -> None:
    """Autocorrelation over rows of NIS transformed to normal scores; near zero for white innovations."""
    lags = np.arange(1, LAGS + 1)
    (old, _), (new, pairs) = autocorrelation(before, LAGS), autocorrelation(after, LAGS)
    band = 1.96 / np.sqrt(max(pairs, 1))
    axes.axhspan(-band, band, color=VERMILION, alpha=0.16, linewidth=0, label="95 % band of white noise")
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.vlines(lags, 0, new, color=BLUE, linewidth=2.4, alpha=0.55)
    axes.plot(lags, new, "o", color=BLUE, markersize=3.5, label="after")
    axes.plot(lags, old, "o-", color=BEFORE, markersize=2.5, linewidth=0.8, label="before")
    known = np.concatenate([old, new, [band, -band]])
    low, high = float(np.nanmin(known)), float(np.nanmax(known))
    axes.set(xlabel="lag (rows)", xlim=(0, LAGS + 1), ylim=(low - 0.1 * (high - low), high + 0.4 * (high - low)))
    axes.legend(loc="upper right", ncols=2)
    axes.set_title("Autocorrelation of NIS (normal scores)")
    plain(axes)
