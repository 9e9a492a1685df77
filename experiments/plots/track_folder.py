"""The plots that `track` writes into its folder: which ones, of what, under which names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl

from experiments.plots.errors import error_cdf, error_over_time, rmse_over_time
from experiments.plots.filters import consistency
from experiments.plots.tracks import bearings_over_time, floor_plan
from trackers.bounds import bounds_of
from trackers.core.metrics import nees
from trackers.recordings.association import associate_truth, true_bearings
from trackers.recordings.columns import float_column
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks_table import is_bearing, track_keys
from trackers.scoring import covariances

DRAWN = 4
"""The most recordings (or tags) with plots of their own."""


def plot_tracks(
    out: Path, tracks: pl.DataFrame, folders: Sequence[RecordingFolder], groups: Sequence[TrackerBatch]
) -> list[str]:
    """Writes the plots of the tracks into the folder; returns the file names without their endings."""
    if is_bearing(tracks):
        return _draw_bearings(out, tracks, folders)
    drawn: list[str] = []
    for folder in folders[:DRAWN]:
        rows = tracks.filter(pl.col("recording") == folder.name)
        suffix = "" if len(folders) == 1 else f"-{_plain(folder.name)}"
        truth = folder.tables.get("truth")
        rig = folder.rig
        plan = _png(out, drawn, "floor-plan" + suffix)
        floor_plan(plan, rows, truth, rig.stations, rig.anchors, folder.name, rig.all_walls())
        if truth is not None:
            _draw_errors(out, drawn, suffix, rows, folder, groups)
    return drawn


def _draw_errors(
    out: Path,
    drawn: list[str],
    suffix: str,
    rows: pl.DataFrame,
    folder: RecordingFolder,
    groups: Sequence[TrackerBatch],
) -> None:
    association = associate_truth(rows, {folder.name: folder.tables["truth"]})
    if not association.scored.any():
        return
    positions = np.stack([float_column(association.rows, f"{a}_m") for a in "xyz"], axis=1)
    errors = np.where(association.scored[:, None], positions - association.truth, np.nan)
    sigmas = np.stack([float_column(association.rows, f"std_{a}_m") for a in "xyz"], axis=1)
    known = sigmas[:, 2] > 0
    errors[~known, 2] = np.nan
    times = float_column(association.rows, "t_s")
    error_cdf(_png(out, drawn, "error-cdf" + suffix), errors[association.scored], f"Errors, {folder.name}")
    first = slice(association.starts[0], association.starts[1])
    tag = association.rows["tag"][0]
    bounds = bounds_of(folder, groups)
    alone = None if bounds is None else _at(bounds, times[first])
    title = f"Error over time, {folder.name}, tag {tag}"
    error_over_time(
        _png(out, drawn, "error-over-time" + suffix), times[first], errors[first], sigmas[first], alone, title=title
    )
    covs = covariances(association.rows)
    square = nees(errors[:, :2], covs[:, :2, :2])
    grid = _by_run(
        association.starts,
        times,
        square,
        float_column(association.rows, "nis"),
        float_column(association.rows, "nis_dof"),
    )
    consistency(_png(out, drawn, "consistency" + suffix), grid[0], grid[1], 2, grid[2], grid[3])
    if len(association.starts) > 10:
        _draw_runs(_png(out, drawn, "rmse-over-time" + suffix), association.starts, times, errors, sigmas, bounds)


def _draw_runs(
    path: Path, starts: np.ndarray, times: np.ndarray, errors: np.ndarray, sigmas: np.ndarray, bounds: tuple | None
) -> None:
    grid = _by_run(starts, times, *(x for k in range(3) for x in (errors[:, k] ** 2, sigmas[:, k] ** 2)))
    if not any(np.isfinite(g).any() for g in grid[1:]):
        return
    rmse = np.stack([np.sqrt(_mean(grid[1 + 2 * k])) for k in range(3)], axis=1)
    reported = np.stack([np.sqrt(_mean(grid[2 + 2 * k])) for k in range(3)], axis=1)
    rmse_over_time(path, grid[0], rmse, reported, None if bounds is None else _at(bounds, grid[0]), len(starts) - 1)


def _mean(values: np.ndarray) -> np.ndarray:
    """The mean over runs of the finite values, NaN where there are none."""
    finite = np.isfinite(values)
    count = finite.sum(axis=0)
    return np.where(count > 0, np.where(finite, values, 0).sum(axis=0) / np.maximum(count, 1), np.nan)


def _by_run(starts: np.ndarray, times: np.ndarray, *columns: np.ndarray) -> tuple[np.ndarray, ...]:
    """Times (t,) and columns (runs, t): all runs with the times of the first; the first alone if lengths differ."""
    lengths = np.diff(starts)
    first = times[starts[0] : starts[1]]
    runs = [0]
    if len(lengths) > 1 and np.all(lengths == lengths[0]):
        every = times.reshape(len(lengths), -1)
        runs = list(np.flatnonzero(np.all(every == first, axis=1)))
    index = np.stack([np.arange(starts[k], starts[k + 1]) for k in runs])
    return first, *(c[index] for c in columns)


def _at(bounds: tuple[np.ndarray, np.ndarray], times: np.ndarray) -> np.ndarray:
    """The bounds (t, 3) interpolated to other times, NaN outside their own."""
    return np.stack([np.interp(times, bounds[0], b, np.nan, np.nan) for b in bounds[1].T], axis=1)


def _draw_bearings(out: Path, tracks: pl.DataFrame, folders: Sequence[RecordingFolder]) -> list[str]:
    drawn: list[str] = []
    by_name = {f.name: f for f in folders}
    keys = tracks.select(track_keys(tracks)).unique(maintain_order=True).to_dicts()
    for key in keys[:DRAWN]:
        folder = by_name[key["recording"]]
        rows = tracks.filter(pl.all_horizontal(pl.col(k) == v for k, v in key.items()))
        angles = np.stack([float_column(rows, f"{a}_rad") for a in ("azimuth", "elevation")], axis=1)
        sigmas = np.stack([float_column(rows, f"std_{a}_rad") for a in ("azimuth", "elevation")], axis=1)
        times, true = float_column(rows, "t_s"), None
        if "truth" in folder.tables:
            association = associate_truth(rows, {folder.name: folder.tables["truth"]})
            true = true_bearings(association, {folder.name: folder.rig.stations})
            true = true if np.isfinite(true).any() else None
        label = f"{key['recording']}, tag {key['tag']}, station {key['station']}"
        name = "bearings-" + _plain(label.replace(", ", "-"))
        bearings_over_time(
            _png(out, drawn, name), times, angles, sigmas, times if true is not None else None, true, label
        )
    return drawn


def _png(out: Path, drawn: list[str], name: str) -> Path:
    drawn.append(name)
    return out / f"{name}.png"


def _plain(text: str) -> str:
    """The text as part of a file name."""
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:80]
