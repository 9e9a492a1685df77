"""The plots that `track` writes into its folder: which ones, of what, under which names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl

from trackwright.experiments.pages.plots.bearings import bearings_over_time
from trackwright.experiments.pages.plots.coverage import coverage_curve
from trackwright.experiments.pages.plots.errors import error_cdf, error_over_time, rmse_over_time
from trackwright.experiments.pages.plots.filters import consistency
from trackwright.experiments.pages.plots.style import LINES
from trackwright.experiments.pages.plots.tracks import floor_plan, natural
from trackwright.experiments.pages.scored_tracks import ScoredRecording, ScoredTracks, directions, drawn_of
from trackwright.trackers.core.data.seconds import time_label
from trackwright.trackers.evaluation.association import true_bearings
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import track_keys


def plot_tracks(out: Path, tracks: ScoredTracks, kind: str = "png") -> list[str]:
    """Writes the plots of tracks and their errors into the folder `out`; returns the file names without their endings.

    `kind`: the ending of the files, png or pdf.
    """
    drawn = _Drawn(out, kind)
    if tracks.bearing:
        _draw_bearings(drawn, tracks)
        if not tracks.association.scored.any():
            return drawn.names
    else:
        for k, why in tracks.drawn.items():
            recording = tracks.recordings[k]
            suffix = "" if len(tracks.folders) == 1 else f"-{_plain(recording.folder.name)}"
            rig, title = recording.folder.rig, recording.folder.name + (f", {why}" if why else "")
            truth = recording.folder.tables.get("truth")
            shown = _shown_tags(recording)
            rows = recording.association.rows.with_columns(pl.col("t_s") - recording.zero)
            floor_plan(
                drawn("floor-plan" + suffix), rows, truth, rig.stations, rig.anchors, title, rig.all_walls(), shown
            )
            if recording.association.scored.any():
                _draw_errors(drawn, suffix, recording)
    if np.isfinite(tracks.scored.nees).any():
        names = tracks.association.rows["recording"].gather(tracks.scored.index).to_numpy()
        coverage_curve(drawn("coverage"), names, tracks.scored.nees, tracks.scored.nees_3d)
    return drawn.names


class _Drawn:
    """The plots in a folder; a call returns the path of another one."""

    def __init__(self, out: Path, kind: str) -> None:
        self.out, self.kind, self.names = out, kind, list[str]()

    def __call__(self, name: str) -> Path:
        self.names.append(name)
        return self.out / f"{name}.{self.kind}"


def _shown_tags(recording: ScoredRecording) -> dict[str, str]:
    """The tags of a floor plan with remarks for its legend: all, or of many the worst, the median and the best."""
    tags = recording.association.rows["tag"].gather(recording.association.starts[:-1]).to_list()
    order = sorted(range(len(tags)), key=lambda k: natural(tags[k]))
    return {tags[order[k]]: why for k, why in drawn_of(recording.rmse[order], False, len(LINES)).items()}


def _draw_errors(drawn: _Drawn, suffix: str, recording: ScoredRecording) -> None:
    """The plots of the errors of a recording with truth."""
    association, errors, sigmas, name = (
        recording.association,
        recording.errors,
        recording.sigmas(),
        recording.folder.name,
    )
    times, starts, bounds = recording.times - recording.zero, recording.association.starts, recording.bounds
    bounds = None if bounds is None else (bounds[0] - recording.zero, bounds[1])
    label = time_label(recording.zero)
    error_cdf(drawn("error-cdf" + suffix), errors[association.scored], f"Errors, {name}")
    worst = recording.worst_first()[0]
    own = slice(starts[worst], starts[worst + 1])
    title = f"Error over time, {name}, tag {association.rows['tag'][int(starts[worst])]}"
    if len(starts) > 2:
        title += f", the largest RMSE of {len(starts) - 1}"
    alone = None if bounds is None else _at(bounds, times[own])
    error_over_time(
        drawn("error-over-time" + suffix), times[own], errors[own], sigmas[own], alone, title=title, xlabel=label
    )
    grid = _by_run(
        starts, times, recording.nees, float_column(association.rows, "nis"), float_column(association.rows, "nis_dof")
    )
    title = f"Consistency of the reported covariances, {name}"
    noise = recording.student_t_dof
    consistency(drawn("consistency" + suffix), grid[0], grid[1], 2, grid[2], grid[3], title, label, noise)
    if len(starts) > 10:
        _draw_runs(drawn("rmse-over-time" + suffix), starts, times, errors, sigmas, bounds, label)


def _draw_runs(
    path: Path,
    starts: np.ndarray,
    times: np.ndarray,
    errors: np.ndarray,
    sigmas: np.ndarray,
    bounds: tuple | None,
    xlabel: str,
) -> None:
    grid = _by_run(starts, times, *(x for k in range(3) for x in (errors[:, k] ** 2, sigmas[:, k] ** 2)))
    if not any(np.isfinite(g).any() for g in grid[1:]):
        return
    rmse = np.stack([np.sqrt(_mean(grid[1 + 2 * k])) for k in range(3)], axis=1)
    reported = np.stack([np.sqrt(_mean(grid[2 + 2 * k])) for k in range(3)], axis=1)
    limits = None if bounds is None else _at(bounds, grid[0])
    rmse_over_time(path, grid[0], rmse, reported, limits, len(starts) - 1, xlabel=xlabel)


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


def _draw_bearings(drawn: _Drawn, tracks: ScoredTracks) -> None:
    association = tracks.association
    true = true_bearings(association, {folder.name: folder.rig.stations for folder in tracks.folders})
    keys = association.rows.select(track_keys(association.rows))[association.starts[:-1]].to_dicts()
    # The rows are sorted by recording, the recordings as they were given.
    ordered = sorted(tracks.recordings, key=lambda recording: recording.folder.name)
    rmse = np.concatenate([recording.rmse for recording in ordered])
    for k, why in drawn_of(rmse, True).items():
        key = keys[k]
        part = slice(association.starts[k], association.starts[k + 1])
        rows = association.rows[part]
        angles = directions(rows)
        sigmas = np.stack([float_column(rows, f"std_{a}_rad") for a in ("azimuth", "elevation")], axis=1)
        zero = next(one.zero for one in ordered if one.folder.name == key["recording"])
        times, known = float_column(rows, "t_s") - zero, bool(np.isfinite(true[part]).any())
        label = f"{key['recording']}, tag {key['tag']}, station {key['station']}"
        name = "bearings-" + _plain(label.replace(", ", "-"))
        bearings_over_time(
            drawn(name),
            times,
            angles,
            sigmas,
            true_times=times if known else None,
            true_angles=true[part] if known else None,
            title=label + (f"; {why}" if why else ""),
            xlabel=time_label(zero),
        )


def _plain(text: str) -> str:
    """The text as part of a file name."""
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in text)[:80]
