"""Figures of tracks against truth: errors over time, their distribution, bearings over time.

Every function writes one PNG, whole or not at all, and returns its path; it raises UnusableInput where the file can't
be written. The floor plan has its own file, and so have the figures that judge a filter and its tuning.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from experiments.plots.style import (
    BLACK,
    BLUE,
    GREY,
    SKY,
    VERMILION,
    broken_at_gaps,
    drawing,
    legend_above,
    length_unit,
)
from trackers.core.metrics import percentiles

MARKED = (50.0, 90.0, 95.0)
"""Percentiles marked on the distribution of errors."""


def error_over_time(
    path: Path | str,
    times: np.ndarray,
    errors: np.ndarray,
    sigmas: np.ndarray,
    bounds: np.ndarray | None = None,
    names: Sequence[str] = ("x", "y", "z"),
    angles: bool = False,
    title: str = "Error over time",
) -> Path:
    """Writes the error of each axis with the reported ± 3 σ; returns the path.

    `times` (n,) s; `errors`, `sigmas` (n, d) m, or rad with `angles`; NaN where there is none. `bounds` (n, d), the
    posterior Cramér–Rao bound as a standard deviation. Errors far outside the rest don't decide the scale.
    """
    columns = [k for k in range(errors.shape[1]) if np.isfinite(errors[:, k]).any()]
    unit, scale = _unit(errors, angles)
    with drawing(path, 8.0, 1.0 + 1.7 * max(len(columns), 1), title) as figure:
        panels = figure.subplots(max(len(columns), 1), 1, sharex=True, squeeze=False)[:, 0]
        for k, axes in zip(columns, panels, strict=False):
            limits = [] if bounds is None else [bounds[:, k]]
            at, error, sigma, *limits = broken_at_gaps(times, errors[:, k], sigmas[:, k], *limits)
            axes.fill_between(
                at, -3 * scale * sigma, 3 * scale * sigma, color=SKY, alpha=0.35, lw=0, label="reported ± 3 σ"
            )
            axes.plot(at, scale * error, color=BLUE, linewidth=0.9, label="error")
            for limit in limits:
                line = {"color": VERMILION, "linewidth": 1.1, "linestyle": (0, (5, 2))}
                axes.plot(at, 3 * scale * limit, label="± 3 × Cramér–Rao bound of this model", **line)
                axes.plot(at, -3 * scale * limit, **line)
            half = scale * _half_height(errors[:, k], sigmas[:, k])
            axes.set(ylim=(-half, half), ylabel=f"error in {names[k]} ({unit})")
            axes.margins(x=0.01)
            _say_outside(axes, int((np.abs(scale * error) > half).sum()))
        panels[-1].set_xlabel("time (s)")
        if columns:
            legend_above(panels[0])
    return Path(path)


def error_cdf(path: Path | str, errors: np.ndarray, title: str = "Distribution of errors") -> Path:
    """Writes the share of estimates with at most a given error, horizontal and 3-D; returns the path.

    `errors`: (n, 2) or (n, 3) m; rows without a height count horizontally only.
    """
    flat = errors[np.isfinite(errors[:, :2]).all(axis=1), :2]
    curves = [("horizontal", flat, BLUE)] if len(flat) else []
    if errors.shape[1] == 3 and np.isfinite(errors).all(axis=1).any():
        curves.append(("3-D", errors[np.isfinite(errors).all(axis=1)], VERMILION))
    furthest = max(percentiles(values, (99.5,))[0] for _, values, _ in curves) if len(flat) else 0.0
    furthest = furthest or 1.0
    unit, scale = length_unit(furthest / 2)
    with drawing(path, 6.4, 4.4, title) as figure:
        axes = figure.add_subplot(xlabel=f"error ({unit})", ylabel="estimates with at most this error (%)")
        for percent in MARKED:
            axes.axhline(percent, color=GREY, linewidth=0.7, linestyle=":")
        for name, values, colour in curves:
            at = percentiles(values, MARKED)
            words = ", ".join(f"p{p:.0f} {scale * v:.3g}" for p, v in zip(MARKED, at, strict=True))
            shares = np.linspace(0, 100, min(len(values), 2000))
            axes.plot(
                scale * np.array(percentiles(values, tuple(shares))),
                shares,
                color=colour,
                label=f"{name}: {words} {unit}",
            )
            axes.plot(scale * np.array(at), MARKED, "o", color=colour, markersize=4.5, markeredgecolor="white")
        axes.set(xlim=(0, scale * furthest * 1.05), ylim=(0, 101), yticks=(0, 25, 50, 75, 90, 95, 100))
        if curves:
            axes.legend(loc="lower right")
        axes.set_title(f"{len(flat)} estimates", color=GREY, fontsize=8)
    return Path(path)


def bearings_over_time(
    path: Path | str,
    times: np.ndarray,
    angles: np.ndarray,
    sigmas: np.ndarray | None = None,
    true_times: np.ndarray | None = None,
    true_angles: np.ndarray | None = None,
    title: str = "Bearings over time",
) -> Path:
    """Writes azimuth and elevation in degrees with the reported ± 3 σ and the truth; returns the path.

    `times` (n,) s; `angles`, `sigmas` (n, 2) rad; `true_times` (m,) s, `true_angles` (m, 2) rad.
    """
    with drawing(path, 8.0, 4.6, title) as figure:
        panels = figure.subplots(2, 1, sharex=True)
        for k, axes in enumerate(panels):
            true = None if true_times is None or true_angles is None else true_angles[:, k]
            middle = _circular_mean(angles[:, k] if true is None else true)
            at, angle, *spread = broken_at_gaps(times, angles[:, k], *([] if sigmas is None else [sigmas[:, k]]))
            degrees = _degrees_about(middle, angle)
            for sigma in spread:
                low, high = degrees - 3 * np.degrees(sigma), degrees + 3 * np.degrees(sigma)
                axes.fill_between(at, low, high, color=SKY, alpha=0.35, lw=0, label="reported ± 3 σ")
            axes.plot(at, degrees, color=BLUE, linewidth=0.9, label="estimate")
            shown = degrees
            if true_times is not None and true is not None:
                at, truth = broken_at_gaps(true_times, true)
                truth = _degrees_about(middle, truth)
                axes.plot(at, truth, color=BLACK, linewidth=1.0, linestyle=(0, (4, 2)), label="truth")
                shown = np.concatenate([shown, truth])
            low, high = np.nanquantile(shown, (0.005, 0.995)) if np.isfinite(shown).any() else (0.0, 0.0)
            margin = max(0.15 * (high - low), 1.0)
            axes.set(ylim=(low - margin, high + margin), ylabel=("azimuth (°)", "elevation (°)")[k])
            axes.margins(x=0.01)
        panels[-1].set_xlabel("time (s)")
        legend_above(panels[0])
    return Path(path)


def _circular_mean(angle: np.ndarray) -> float:
    known = angle[np.isfinite(angle)]
    return float(np.angle(np.exp(1j * known).sum())) if len(known) else 0.0


def _degrees_about(middle: float, angle: np.ndarray) -> np.ndarray:
    """The angles in degrees within half a turn of `middle`, NaN where they jump: no line shall cross the panel."""
    degrees = np.degrees(middle + np.pi - (np.pi - (angle - middle)) % (2 * np.pi))
    jumps = np.append(np.abs(np.diff(degrees)) > 180, False)
    return np.where(jumps, np.nan, degrees)


def _unit(errors: np.ndarray, angles: bool) -> tuple[str, float]:
    if angles:
        return "°", 180 / np.pi
    known = np.abs(errors[np.isfinite(errors)])
    return length_unit(float(np.quantile(known, 0.95)) if len(known) else 1.0)


def _half_height(error: np.ndarray, sigma: np.ndarray) -> float:
    """Half the height of a panel: nearly all errors, and the usual 3 σ unless it dwarfs them."""
    most = float(np.nanquantile(np.abs(error), 0.995))
    known = sigma[np.isfinite(sigma)]
    band = 3 * float(np.quantile(known, 0.9)) if len(known) else 0.0
    return 1.15 * max(most, min(band, 4 * most)) or 1e-9


def _say_outside(axes: Axes, outside: int) -> None:
    if outside:
        text = f"{outside} outside the picture"
        axes.text(0.995, 0.03, text, transform=axes.transAxes, ha="right", va="bottom", fontsize=7, color=GREY)
