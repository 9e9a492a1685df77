"""Residuals of readings by anchor and station: about the estimates and, where there is truth, about the truth."""

from __future__ import annotations

from typing import Any

import numpy as np

from trackwright.experiments.pages.reports.pages import TYPES, packed, rounded
from trackwright.experiments.pages.scored_tracks import ScoredRecording
from trackwright.trackers.recordings.columns import TagRows, float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Measured

LEAST = 5
"""The fewest readings of a quantile or of a mean."""

BINS = 12
"""Bins of the true distance or angle over which the mean residual is drawn."""

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)


def page_residuals(recording: ScoredRecording, most: int) -> dict[str, Any]:
    """The residuals as the page holds them, by kind of reading: quantiles of all, and at most about `most` over time.

    About the estimated and about the true position; without estimates that are bearings.
    """
    folder, tags = recording.folder, list[str]()
    channels, points = list[dict[str, Any]](), list[dict[str, np.ndarray]]()
    start = float(np.min(recording.times, initial=np.inf)) if len(recording.times) else 0.0
    for table, kind in KINDS.items():
        if table not in folder.tables or not kind.averaged:
            continue
        rows = folder.rows(table)
        tags += [tag for tag in rows.tags if tag not in tags]
        tag = rows.of_each(np.array([tags.index(tag) for tag in rows.tags]))
        measured = kind.measured(folder.rig, rows).usable
        measured = measured._replace(values=_without_systematic_errors(folder, measured, rows))
        sources = list(measured.ids) or [kind.name]
        source = measured.sensors.number[:, 0] if kind.sensors else np.zeros(len(rows.times), int)
        true_places, _ = folder.paths.at(rows.tags, rows.starts, rows.times)
        unit, factor = kind.shown[0].strip(), kind.shown[1]
        all_estimated, all_true, all_against = (
            factor * numbers.T
            for numbers in (measured.errors(_estimated(recording, rows)), measured.errors(true_places),
                            measured.predicted(true_places))
        )  # fmt: skip
        for column, estimated, true, against in zip(
            measured.columns, all_estimated, all_true, all_against, strict=True
        ):
            if not np.isfinite([estimated, true]).any():
                continue
            name = column.rpartition("_")[0].replace("_", " ")
            channels.append({
                "name": f"fix, {name}" if kind.position else name, "unit": unit, "sources": sources,
                "boxes": {"estimated": _boxes(sources, source, estimated), "true": _boxes(sources, source, true)},
                "curves": _curves(sources, source, true, against), "againstName": f"true {name} ({unit})",
            })  # fmt: skip
            points.append({"t": rows.times - start, "tag": tag, "source": source, "estimated": estimated, "true": true})
    step = max(1, -(-sum(len(columns["t"]) for columns in points) // most))
    for channel, columns in zip(channels, points, strict=True):
        channel["points"] = {name: packed(x[::step], TYPES.get(name, "f4")) for name, x in columns.items()}
    return {"tags": tags, "every": step, "channels": channels}


def _estimated(recording: ScoredRecording, rows: TagRows) -> np.ndarray:
    """The estimated positions (N, 3), m, at the times of the readings, between rows of estimates; else NaN."""
    table, starts = recording.rows, recording.starts
    estimated = np.full((len(rows.times), 3), np.nan)
    if recording.angles:
        return estimated
    of_tags = dict(zip(recording.first["tag"].to_list(), range(len(starts) - 1), strict=True))
    times, positions = recording.times, np.stack([float_column(table, f"{a}_m") for a in "xyz"], axis=1)
    for k, tag in enumerate(rows.tags):
        number = of_tags.get(tag)
        if number is None:
            continue
        of_tag = slice(rows.starts[k], rows.starts[k + 1])
        part = slice(starts[number], starts[number + 1])
        known = np.isfinite(positions[part, :2]).all(axis=1)
        if known.any():
            for axis in range(3):
                estimated[of_tag, axis] = np.interp(
                    rows.times[of_tag], times[part][known], positions[part][known, axis], np.nan, np.nan
                )
    return estimated


def _without_systematic_errors(folder: RecordingFolder, measured: Measured, rows: TagRows) -> np.ndarray:
    """The readings (N, m), NaN where one is missing, without what the calibration says of their anchors or stations."""
    values, kind = measured.values, measured.kind
    if folder.calibration is None or kind.calibrated is None:
        return values
    number = measured.sensors.number[:, 0]
    if kind.calibrated == "stations":
        return folder.calibration.of_bearings(measured.ids, number, values)[1]
    if kind.calibrated == "differences":
        return folder.calibration.of_differences(measured.ids, measured.sensors.number, values[:, 0])[0][:, None]
    tag = rows.of_each(np.arange(len(rows.tags)))
    return folder.calibration.of_ranges(measured.ids, number, rows.tags, tag, values[:, 0])[0][:, None]


def _boxes(sources: list[str], source: np.ndarray, residuals: np.ndarray) -> list[list[float | None]] | None:
    """Of each source: number, mean, robust standard deviation and the quantiles `SHARES`; None without residuals."""
    if not np.isfinite(residuals).any():
        return None
    boxes: list[list[float | None]] = []
    for k in range(len(sources)):
        of_source = residuals[(source == k) & np.isfinite(residuals)]
        if len(of_source) < LEAST:
            boxes.append([len(of_source), *[None] * (2 + len(SHARES))])
            continue
        middle = np.quantile(of_source, SHARES)
        spread = 1.4826 * float(np.median(np.abs(of_source - middle[2])))
        boxes.append([len(of_source), *(rounded(float(x)) for x in (of_source.mean(), spread, *middle))])
    return boxes


def _curves(sources: list[str], source: np.ndarray, residuals: np.ndarray, against: np.ndarray) -> list[dict[str, Any]]:
    """Of each source: the mean residual about the truth in bins of the true distance or angle."""
    known = np.isfinite(residuals) & np.isfinite(against)
    if known.sum() < LEAST or np.ptp(against[known]) < 1e-6:
        return []
    edges = np.linspace(against[known].min(), against[known].max(), BINS + 1)
    shape = len(sources), BINS
    cell = source[known] * BINS + np.clip(np.searchsorted(edges, against[known], side="right") - 1, 0, BINS - 1)
    counts = np.bincount(cell, minlength=len(sources) * BINS).reshape(shape)
    means = np.bincount(cell, residuals[known], len(sources) * BINS).reshape(shape) / np.maximum(counts, 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    return [
        {"source": name, "x": [rounded(float(x)) for x in middles[there]],
         "y": [rounded(float(y)) for y in mean[there]],
         "n": count[there].tolist()}
        for name, count, mean in zip(sources, counts, means, strict=True)
        if (there := count >= LEAST).any()
    ]  # fmt: skip
