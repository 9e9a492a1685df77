"""The plots that `track` writes into its folder: which ones, of what, under which names."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.plots.coverage import coverage_curve
from experiments.plots.errors import error_cdf, error_over_time, rmse_over_time
from experiments.plots.filters import consistency
from experiments.plots.tracks import bearings_over_time, floor_plan
from trackers.bounds import bounds_of
from trackers.recordings.association import Association, true_bearings
from trackers.recordings.columns import float_column
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks_table import is_bearing, track_keys
from trackers.scoring import score

DRAWN = 4
"""The most recordings (or tags) with plots of their own."""


def plot_tracks(
    out: Path, association: Association, folders: Sequence[RecordingFolder], batches: Sequence[TrackerBatch]
) -> list[str]:
    """Writes the plots of tracks and their errors into the folder `out`; returns the file names without their endings.

    `association`: the estimates with their truth. `batches`: the trajectories of the folders, for their bounds.
    """
    bearing = is_bearing(association.rows)
    drawn = _draw_bearings(out, association, folders) if bearing else []
    if bearing and not association.scored.any():
        return drawn
    scored = score(association, {folder.name: folder.rig.stations for folder in folders})
    if not bearing:
        errors, nees = np.full((len(association.rows), 3), np.nan), np.full(len(association.rows), np.nan)
        errors[scored.index], nees[scored.index] = scored.errors, scored.nees
        for folder in folders[:DRAWN]:
            part = association.of_recording(folder.name)
            own = (association.rows["recording"] == folder.name).to_numpy()
            suffix = "" if len(folders) == 1 else f"-{_plain(folder.name)}"
            truth = folder.tables.get("truth")
            rig = folder.rig
            plan = _png(out, drawn, "floor-plan" + suffix)
            floor_plan(plan, part.rows, truth, rig.stations, rig.anchors, folder.name, rig.all_walls())
            if part.scored.any():
                _draw_errors(out, drawn, suffix, part, errors[own], nees[own], folder, batches)
    if np.isfinite(scored.nees).any():
        names = association.rows["recording"].gather(scored.index).to_numpy()
        coverage_curve(_png(out, drawn, "coverage"), names, scored.nees, scored.nees_3d)
    return drawn


def _draw_errors(
    out: Path,
    drawn: list[str],
    suffix: str,
    association: Association,
    errors: np.ndarray,
    nees: np.ndarray,
    folder: RecordingFolder,
    batches: Sequence[TrackerBatch],
) -> None:
    """`errors` (n, 3) and `nees` (n,) of the rows of the association, NaN where not scored."""
    sigmas = np.stack([float_column(association.rows, f"std_{a}_m") for a in "xyz"], axis=1)
    known = sigmas[:, 2] > 0
    errors[~known, 2] = np.nan
    times = float_column(association.rows, "t_s")
    error_cdf(_png(out, drawn, "error-cdf" + suffix), errors[association.scored], f"Errors, {folder.name}")
    first = slice(association.starts[0], association.starts[1])
    tag = association.rows["tag"][0]
    bounds = bounds_of(folder, batches)
    alone = None if bounds is None else _at(bounds, times[first])
    title = f"Error over time, {folder.name}, tag {tag}"
    error_over_time(
        _png(out, drawn, "error-over-time" + suffix), times[first], errors[first], sigmas[first], alone, title=title
    )
    grid = _by_run(
        association.starts,
        times,
        nees,
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


def _draw_bearings(out: Path, association: Association, folders: Sequence[RecordingFolder]) -> list[str]:
    drawn: list[str] = []
    true = true_bearings(association, {folder.name: folder.rig.stations for folder in folders})
    keys = association.rows.select(track_keys(association.rows))[association.starts[:-1]].to_dicts()
    for k, key in enumerate(keys[:DRAWN]):
        part = slice(association.starts[k], association.starts[k + 1])
        rows = association.rows[part]
        angles = np.stack([float_column(rows, f"{a}_rad") for a in ("azimuth", "elevation")], axis=1)
        sigmas = np.stack([float_column(rows, f"std_{a}_rad") for a in ("azimuth", "elevation")], axis=1)
        times, known = float_column(rows, "t_s"), bool(np.isfinite(true[part]).any())
        label = f"{key['recording']}, tag {key['tag']}, station {key['station']}"
        name = "bearings-" + _plain(label.replace(", ", "-"))
        bearings_over_time(
            _png(out, drawn, name),
            times,
            angles,
            sigmas,
            true_times=times if known else None,
            true_angles=true[part] if known else None,
            title=label,
        )
    return drawn


def _png(out: Path, drawn: list[str], name: str) -> Path:
    drawn.append(name)
    return out / f"{name}.png"


def _plain(text: str) -> str:
    """The text as part of a file name."""
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:80]
