"""Bearings of one tag at one station over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from trackwright.experiments.pages.plots.style import BLACK, BLUE, SKY, broken_at_gaps, figure_file, legend_above
from trackwright.experiments.pages.scored_tracks import IN_PLANE, in_one_plane, in_the_plane


def bearings_over_time(
    path: Path | str,
    times: np.ndarray,
    angles: np.ndarray,
    sigmas: np.ndarray | None = None,
    true_times: np.ndarray | None = None,
    true_angles: np.ndarray | None = None,
    title: str = "Bearings over time",
    xlabel: str = "time (s)",
) -> Path:
    """Writes azimuth and elevation in degrees with the reported ± 3 σ and the truth; returns the path.

    `times` (n,) s; `angles`, `sigmas` (n, 2) rad; `true_times` (m,) s, `true_angles` (m, 2) rad. Directions in the
    plane of a flat array, whose azimuth is ± 90°, are drawn as one angle.
    """
    names = {0: "azimuth (°)", 1: "elevation (°)"}
    if in_one_plane(angles[:, 0]):
        names = {1: f"{IN_PLANE} (°)"}
        angles = np.tile(in_the_plane(angles)[:, None], 2)
        true_angles = None if true_angles is None else np.tile(in_the_plane(true_angles)[:, None], 2)
    with figure_file(path, 8.0, 1.0 + 1.8 * len(names), title) as figure:
        panels = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for (k, name), axes in zip(names.items(), panels, strict=True):
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
            axes.set(ylim=(low - margin, high + margin), ylabel=name)
            axes.margins(x=0.01)
        panels[-1].set_xlabel(xlabel)
        legend_above(panels[0])
    return Path(path)


def _circular_mean(angle: np.ndarray) -> float:
    known = angle[np.isfinite(angle)]
    return float(np.angle(np.exp(1j * known).sum())) if len(known) else 0.0


def _degrees_about(middle: float, angle: np.ndarray) -> np.ndarray:
    """The angles in degrees within half a turn of `middle`, NaN at jumps, so that no line crosses the panel."""
    degrees = np.degrees(middle + np.pi - (np.pi - (angle - middle)) % (2 * np.pi))
    jumps = np.append(np.abs(np.diff(degrees)) > 180, False)
    return np.where(jumps, np.nan, degrees)
