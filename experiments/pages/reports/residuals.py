"""Residuals of readings by anchor and station: about the estimates and, where there is truth, about the truth."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.reports.pages import packed, rounded
from trackwright.experiments.pages.scored_tracks import ScoredRecording
from trackwright.trackers.recordings.columns import TagRows, float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, Measured

LEAST = 5
"""The fewest readings of a quantile or of a mean."""

BINS = 12
"""Bins of the true distance or angle over which the mean residual is drawn."""

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)


class Channel(NamedTuple):
    """Readings of one kind: their sources by name, and for each reading (N,) the numbers of its tag and source.

    `estimated`, `true` (N,): the reading less its prediction at the estimated and at the true position, in `unit`.
    `against` (N,): the true distance, m, or angle, °.
    """

    name: str
    unit: str
    sources: list[str]
    times: np.ndarray
    tag: np.ndarray
    source: np.ndarray
    estimated: np.ndarray
    true: np.ndarray
    against: np.ndarray
    against_name: str


def page_residuals(recording: ScoredRecording, most: int) -> dict[str, Any]:
    """The residuals as the page holds them: quantiles of all, and at most about `most` of them over time.

    Without estimates that are bearings.
    """
    tags: list[str] = []
    channels: list[Channel] = []
    for table, kind in KINDS.items():
        if table not in recording.folder.tables or not kind.averaged:
            continue
        rows = recording.folder.rows(table)
        tags += [tag for tag in rows.tags if tag not in tags]
        number = rows.of_each(np.array([tags.index(tag) for tag in rows.tags]))
        estimated = _estimated(recording, rows)
        true, _ = recording.folder.paths.at(rows.tags, rows.starts, rows.times)
        found = _channels(recording.folder, kind, rows, number, estimated, true)
        channels += [channel for channel in found if np.isfinite([channel.estimated, channel.true]).any()]
    step = max(1, -(-sum(len(c.times) for c in channels) // most)) if channels else 1
    start = float(np.min(recording.times, initial=np.inf)) if len(recording.times) else 0.0
    return {
        "tags": tags,
        "every": step,
        "channels": [
            {
                "name": c.name,
                "unit": c.unit,
                "sources": c.sources,
                "boxes": {"estimated": _boxes(c, c.estimated), "true": _boxes(c, c.true)},
                "curves": _curves(c),
                "againstName": c.against_name,
                "points": {
                    "t": packed(c.times[::step] - start),
                    "tag": packed(c.tag[::step], "u2"),
                    "source": packed(c.source[::step], "u2"),
                    "estimated": packed(c.estimated[::step]),
                    "true": packed(c.true[::step]),
                },
            }
            for c in channels
        ],
    }


def _estimated(recording: ScoredRecording, rows: TagRows) -> np.ndarray:
    """The estimated positions (N, 3), m, at the times of the readings, between rows of estimates; else NaN."""
    table, starts = recording.association.rows, recording.association.starts
    estimated = np.full((len(rows.times), 3), np.nan)
    if recording.angles:
        return estimated
    of_tags = dict(zip(table["tag"].gather(starts[:-1]).to_list(), range(len(starts) - 1), strict=True))
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


def _channels(
    folder: RecordingFolder, kind: Kind, rows: TagRows, tag: np.ndarray, estimated: np.ndarray, true: np.ndarray
) -> Iterator[Channel]:
    """A channel for each column of a kind, without the systematic errors of a calibration."""
    measured = kind.measured(folder.rig, rows).usable
    measured = measured._replace(values=_without_systematic_errors(folder, measured, rows))
    source = measured.sensors.number[:, 0] if kind.sensors else np.zeros(len(rows.times), int)
    against, about = measured.predicted(true), [measured.errors(positions) for positions in (estimated, true)]
    unit, factor = kind.shown[0].strip(), kind.shown[1]
    for k, column in enumerate(measured.columns):
        name = column.rpartition("_")[0].replace("_", " ")
        yield Channel(
            f"fix, {name}" if kind.position else name, unit, list(measured.ids) or [kind.name], rows.times, tag, source,
            factor * about[0][:, k], factor * about[1][:, k], factor * against[:, k], f"true {name} ({unit})",
        )  # fmt: skip


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


def _boxes(channel: Channel, residuals: np.ndarray) -> list[list[float | None]] | None:
    """Of each source: number, mean, robust standard deviation and the quantiles `SHARES`; None without residuals."""
    if not np.isfinite(residuals).any():
        return None
    boxes: list[list[float | None]] = []
    for k in range(len(channel.sources)):
        of_source = residuals[(channel.source == k) & np.isfinite(residuals)]
        if len(of_source) < LEAST:
            boxes.append([len(of_source), *[None] * (2 + len(SHARES))])
            continue
        middle = np.quantile(of_source, SHARES)
        spread = 1.4826 * float(np.median(np.abs(of_source - middle[2])))
        boxes.append([len(of_source), *(rounded(float(x)) for x in (of_source.mean(), spread, *middle))])
    return boxes


def _curves(channel: Channel) -> list[dict[str, Any]]:
    """Of each source: the mean residual about the truth in bins of the true distance or angle."""
    known = np.isfinite(channel.true) & np.isfinite(channel.against)
    if known.sum() < LEAST:
        return []
    edges = np.linspace(channel.against[known].min(), channel.against[known].max(), BINS + 1)
    if edges[-1] - edges[0] < 1e-6:
        return []
    bins = np.clip(np.searchsorted(edges, channel.against[known], side="right") - 1, 0, BINS - 1)
    cell = channel.source[known] * BINS + bins
    size = len(channel.sources) * BINS
    count = np.bincount(cell, minlength=size)
    mean = np.bincount(cell, channel.true[known], size) / np.maximum(count, 1)
    middles = 0.5 * (edges[1:] + edges[:-1])
    return [
        {"source": name, "x": [rounded(float(x)) for x in middles[there]],
         "y": [rounded(float(y)) for y in mean[k * BINS : (k + 1) * BINS][there]],
         "n": [int(c) for c in count[k * BINS : (k + 1) * BINS][there]]}
        for k, name in enumerate(channel.sources)
        if (there := count[k * BINS : (k + 1) * BINS] >= LEAST).any()
    ]  # fmt: skip
