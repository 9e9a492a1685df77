"""Summaries of all rows of a recording: the map of errors, the distribution of errors, the calibration curve."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackwright.experiments.pages.interactive.packing import packed, rounded
from trackwright.experiments.pages.scored_tracks import ScoredRecording
from trackwright.trackers.core.data.chi_square import chi_square_probability

CELLS = 30
"""The most cells along the longer side of the map of errors."""

SHARES = np.linspace(0.0, 1.0, 101)


def error_map(recording: ScoredRecording, origin: np.ndarray) -> dict[str, Any] | None:
    """The RMSE of the horizontal position, m, in square cells of the floor by the true position; None without truth.

    `x`, `y`: the cells' middles, m, relative to the origin. `rmse`, `count`: by rows of cells; null in an empty cell.
    """
    if recording.angles:
        return None
    squares = (recording.errors[:, :2] ** 2).sum(axis=1)
    true = recording.association.truth[:, :2] - origin
    known = np.isfinite(squares) & np.isfinite(true).all(axis=1)
    if known.sum() < 2:
        return None
    low, high = true[known].min(axis=0), true[known].max(axis=0)
    extent = float(np.max(high - low))
    if extent < 0.05:
        return None
    cell = _round_size(extent / CELLS)
    corner = np.floor(low / cell)
    place = (np.floor(true[known] / cell) - corner).astype(int)
    shape = place.max(axis=0) + 1
    flat = place[:, 1] * shape[0] + place[:, 0]
    count = np.bincount(flat, minlength=int(shape.prod()))
    total = np.bincount(flat, squares[known], int(shape.prod()))
    rmse = np.sqrt(total / np.maximum(count, 1))
    values = [rounded(float(r)) if n else None for r, n in zip(rmse, count, strict=True)]
    width = int(shape[0])
    return {
        "cell": cell,
        "x": [round(float(x), 4) for x in (np.arange(width) + 0.5 + corner[0]) * cell],
        "y": [round(float(y), 4) for y in (np.arange(int(shape[1])) + 0.5 + corner[1]) * cell],
        "rmse": [values[k : k + width] for k in range(0, len(values), width)],
        "count": count.reshape(-1, width).tolist(),
    }


def _round_size(size: float) -> float:
    """The smallest of 1, 2 and 5 times a power of ten that is no smaller than `size`."""
    decade = 10.0 ** np.floor(np.log10(size))
    return float(next(d * decade for d in (1, 2, 5, 10) if d * decade >= size * (1 - 1e-9)))


def calibration_curve(recording: ScoredRecording) -> dict[str, Any] | None:
    """The observed share of the truth inside the reported ellipses of each level; None without covariances."""
    curves = {}
    for name, nees, dof in _distances(recording):
        levels = np.sort(chi_square_probability(nees[np.isfinite(nees)], dof))
        if len(levels):
            share = np.searchsorted(levels, SHARES, side="right") / len(levels)
            curves[name] = {"share": packed(100 * share), "rows": len(levels)}
    return {"level": packed(100 * SHARES), "curves": curves} if curves else None


def _distances(recording: ScoredRecording) -> list[tuple[str, np.ndarray, int]]:
    """Names, NEES and degrees of freedom of the curves."""
    if recording.in_plane:
        (angle,) = recording.components()
        return [(angle.name, (angle.errors / angle.sigmas) ** 2, 1)]
    if recording.nees_3d is None:
        return [("both angles", recording.nees, 2)]
    return [("horizontal", recording.nees, 2), ("3-D", recording.nees_3d, 3)]


def error_distribution(recording: ScoredRecording) -> list[dict[str, Any]]:
    """Quantiles of the errors of all rows: horizontal and 3-D, m, or azimuth and elevation, °."""
    errors = recording.errors
    if recording.angles:
        named = {component.name: np.abs(component.errors) for component in recording.components()}
    else:
        named = {"horizontal": np.hypot(errors[:, 0], errors[:, 1]), "3-D": np.sqrt((errors**2).sum(axis=1))}
    found = []
    for name, values in named.items():
        known = values[np.isfinite(values)]
        if len(known):
            found.append({"name": name, "share": packed(100 * SHARES), "rows": len(known),
                          "error": packed(np.quantile(known, SHARES))})  # fmt: skip
    return found
