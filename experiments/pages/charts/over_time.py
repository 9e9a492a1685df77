"""Charts over time: errors of a track and of many runs, directions, and NEES or NIS with their bands."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

from trackwright.experiments.pages.charts.style import BLACK, BLUE, GREY, SKY, VERMILION, broken_at_gaps, legend_above
from trackwright.trackers.evaluation.statements import LIMITS
from trackwright.tuning.diagnostics import nis_band

WINDOW = 50
"""Rows of the running mean that replaces the mean over runs where there is a single run."""

BOUND: dict[str, Any] = {"color": VERMILION, "linewidth": 1.1, "linestyle": (0, (5, 2))}
"""The line of a Cramér–Rao bound."""


def draw_band(axes: Axes, times: np.ndarray, low: np.ndarray, high: np.ndarray, label: str) -> None:
    """A band between two curves (n,) over `times` (n,)."""
    at, low, high = broken_at_gaps(times, low, high)
    axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label=label)


def draw_error(
    axes: Axes, times: np.ndarray, error: np.ndarray, sigma: np.ndarray, bound: np.ndarray | None, half: float
) -> None:
    """An error (n,) with the reported ± 3 σ up to `half` the height of the axes, and the number of errors beyond.

    `bound` (n,): the posterior Cramér–Rao bound as a standard deviation.
    """
    draw_band(axes, times, -3 * sigma, 3 * sigma, "reported ± 3 σ")
    axes.plot(*broken_at_gaps(times, error), color=BLUE, linewidth=0.9, label="error")
    if bound is not None:
        at, limit = broken_at_gaps(times, 3 * bound)
        axes.plot(at, limit, label="± 3 × Cramér–Rao bound of this model", **BOUND)
        axes.plot(at, -limit, label="_", **BOUND)
        known = np.isfinite(bound) & np.isfinite(sigma)
        if known.any() and np.mean(bound[known] > sigma[known]) > 0.5:
            _note(axes, "σ is below the bound, which is a mean over noise. NEES tells whether σ is too small.", 0.88)
    axes.set_ylim(-half, half)
    axes.margins(x=0.01)
    outside = int((np.abs(error) > half).sum())
    if outside:
        _note(axes, f"{outside} outside the axes", 0.03)
    legend_above(axes)


def _note(axes: Axes, text: str, height: float) -> None:
    axes.text(0.995, height, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=7, color=GREY)


def half_heights(errors: Sequence[np.ndarray], sigmas: Sequence[np.ndarray]) -> list[float]:
    """Half the height of the panel of each component: every error that lasts two rows, and usual bands of 3 σ.

    A band counts up to four times as much as the errors. A component which the tracker holds fixed is not magnified to
    its rounding.
    """
    bands, halves = [], []
    for error, sigma in zip(errors, sigmas, strict=True):
        size, known = np.abs(error[np.isfinite(error)]), sigma[np.isfinite(sigma)]
        most = float(np.max(np.minimum(size[1:], size[:-1]), initial=0.0)) if len(size) > 1 else float(size.sum())
        bands.append(3 * float(np.quantile(known, 0.9)) if len(known) else 0.0)
        halves.append(1.15 * max(most, min(bands[-1], 4 * most)) or 1e-9)
    largest = max(halves)
    return [max(half, min(band, largest), 0.05 * largest) for half, band in zip(halves, bands, strict=True)]


def draw_rmse(
    axes: Axes, times: np.ndarray, rmse: np.ndarray, sigma: np.ndarray, bound: np.ndarray | None, runs: int
) -> None:
    """The RMSE (t,) over so many runs with the reported σ and the Cramér–Rao bound."""
    axes.plot(times, rmse, color=BLUE, linewidth=1.0, label=f"RMSE of {runs} runs")
    axes.plot(times, sigma, color=SKY, linewidth=1.4, label="reported σ")
    if bound is not None:
        axes.plot(times, bound, label="Cramér–Rao bound of this model", **BOUND)
    known = rmse[np.isfinite(rmse)]
    axes.set_ylim(0, 1.6 * float(np.quantile(known, 0.98)) if len(known) else None)
    axes.margins(x=0.01)
    legend_above(axes)


def draw_angle(axes: Axes, times: np.ndarray, angle: np.ndarray, sigma: np.ndarray, truth: np.ndarray | None) -> None:
    """An angle (n,), °, with the reported ± 3 σ and the truth, so that no line crosses the axes where it turns on."""
    middle = _circular_mean(angle if truth is None else truth)
    at, shown, spread = broken_at_gaps(times, angle, sigma)
    shown = _about(middle, shown)
    if np.isfinite(spread).any():
        axes.fill_between(
            at, shown - 3 * spread, shown + 3 * spread, color=SKY, alpha=0.35, lw=0, label="reported ± 3 σ"
        )
    axes.plot(at, shown, color=BLUE, linewidth=0.9, label="estimate")
    if truth is not None:
        known = np.isfinite(truth)
        at, true = broken_at_gaps(times[known], truth[known])
        true = _about(middle, true)
        axes.plot(at, true, color=BLACK, linewidth=1.0, linestyle=(0, (4, 2)), label="truth")
        shown = np.concatenate([shown, true])
    low, high = np.nanquantile(shown, (0.005, 0.995)) if np.isfinite(shown).any() else (0.0, 0.0)
    margin = max(0.15 * (high - low), 1.0)
    axes.set_ylim(low - margin, high + margin)
    axes.margins(x=0.01)
    legend_above(axes)


def _circular_mean(degrees: np.ndarray) -> float:
    known = np.radians(degrees[np.isfinite(degrees)])
    return float(np.degrees(np.angle(np.exp(1j * known).sum()))) if len(known) else 0.0


def _about(middle: float, degrees: np.ndarray) -> np.ndarray:
    """The angles within half a turn of `middle`, NaN at jumps."""
    within = middle + 180 - (180 - (degrees - middle)) % 360
    jumps = np.append(np.abs(np.diff(within)) > 180, False)
    return np.where(jumps, np.nan, within)


def draw_consistency(
    axes: Axes,
    times: np.ndarray,
    values: np.ndarray,
    dof: float | np.ndarray,
    name: str,
    law: str = "χ²",
    student_t_dof: float | None = None,
) -> None:
    """The mean of NEES or NIS per degree of freedom over time with its band: 1 for correct covariances.

    `times` (t,); `values` (runs, t), NaN in rows without; `dof` a number or (runs, t). `name`: NEES or NIS. `law`: the
    distribution in words, empty where it is unknown: no band is drawn. Averaged over runs; a single run is averaged
    over `WINDOW` rows.
    """
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    freedom = np.where(known, dof, 0.0).sum(axis=0)
    runs, independent = len(values), 1.0
    mean = float(total.sum() / max(freedom.sum(), 1.0))
    window = min(WINDOW, len(times))
    if runs == 1:
        independent = 1.0 / inflation(total, freedom, window)
        total, freedom = (np.convolve(x, np.ones(window), "same") for x in (total, freedom))
    there = freedom > 0.5
    at, ratio, freedom = times[there], total[there] / freedom[there], freedom[there]
    low = high = np.ones(len(at))
    if law:
        low, high = nis_band(independent * freedom, student_t_dof)
        band = "95 % band" + (", rows as correlated as these" if runs == 1 else " of a consistent filter")
        axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label=band)
    axes.axhline(1.0, color=GREY, linewidth=0.8)
    over = f"mean of {runs} runs" if runs > 1 else f"running mean of {window} rows"
    axes.plot(at, ratio, color=BLUE, label=over)
    axes.set_ylabel(f"{name} / dof")
    axes.margins(x=0.01)
    legend_above(axes)
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
    expected = LIMITS[1] if name == "NEES" else "1 expected" + (f" ({law})" if law else "")
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
