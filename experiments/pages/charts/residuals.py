"""Residuals of readings by anchor and station about the estimates and about the truth, and errors over the floor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from trackwright.experiments.pages.charts.floor import rig_lines
from trackwright.experiments.pages.charts.style import BLUE, LINES, VERMILION, Chart, Field, Line
from trackwright.experiments.pages.scored_tracks import ScoredRecording
from trackwright.trackers.recordings.columns import TagRows
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Measured

LEAST, BINS, CELLS = 5, 12, 30
"""The fewest readings of a quantile or mean, bins of a true distance, and cells along the longer side of a map."""


class Residuals(NamedTuple):
    """The residuals (n,) of one column of readings about the estimated and the true positions, NaN where unknown.

    `source`, `tag` (n,): numbers of the anchor or station among `sources`, and of the tag among the recording's.
    `against` (n,): the true distance or angle. `times` (n,): s.
    """

    name: str
    unit: str
    sources: list[str]
    source: np.ndarray
    tag: np.ndarray
    times: np.ndarray
    estimated: np.ndarray
    true: np.ndarray
    against: np.ndarray


def residuals(recording: ScoredRecording) -> tuple[list[str], list[Residuals]]:
    """The tags of the readings, and the residuals of each column; none about estimates that are bearings."""
    folder, tags, found = recording.folder, list[str](), list[Residuals]()
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
        true, _ = folder.paths.at(rows.tags, rows.starts, rows.times)
        numbers = measured.errors(_estimated(recording, rows)), measured.errors(true), measured.predicted(true)
        for column, *parts in zip(measured.columns, *(kind.shown[1] * of.T for of in numbers), strict=True):
            if np.isfinite(parts[:2]).any():
                name = "fix, " * kind.position + column.rpartition("_")[0].replace("_", " ")
                found.append(Residuals(name, kind.shown[0].strip(), sources, source, tag, rows.times, *parts))
    return tags, found


def _estimated(recording: ScoredRecording, rows: TagRows) -> np.ndarray:
    """The estimated positions (N, 3), m, at the times of the readings, between rows of estimates; else NaN."""
    estimated = np.full((len(rows.times), 3), np.nan)
    if recording.angles:
        return estimated
    of_tags = {tag: k for k, tag in enumerate(recording.first["tag"])}
    positions = recording.columns("x_m", "y_m", "z_m")
    for k, tag in ((k, tag) for k, tag in enumerate(rows.tags) if tag in of_tags):
        part, own = recording.rows_of(of_tags[tag]), slice(rows.starts[k], rows.starts[k + 1])
        known = np.isfinite(positions[part, :2]).all(axis=1)
        for axis in range(3) if known.any() else ():
            values = recording.times[part][known], positions[part][known, axis]
            estimated[own, axis] = np.interp(rows.times[own], *values, np.nan, np.nan)
    return estimated


def _without_systematic_errors(folder: RecordingFolder, measured: Measured, rows: TagRows) -> np.ndarray:
    """The readings (N, m), NaN where one is missing, without what the calibration says of their anchors or stations."""
    values, of, known = measured.values, measured.kind.calibrated, folder.calibration
    if known is None or of is None:
        return values
    number = measured.sensors.number
    if of == "stations":
        return known.of_bearings(measured.ids, number[:, 0], values)[1]
    if of == "differences":
        return known.of_differences(measured.ids, number, values[:, 0])[0][:, None]
    tag = rows.of_each(np.arange(len(rows.tags)))
    return known.of_ranges(measured.ids, number[:, 0], rows.tags, tag, values[:, 0])[0][:, None]


def residual_charts(found: list[Residuals]) -> Iterator[Chart]:
    """Of each column the residuals by source, and their means over the true distance or angle."""
    for one in found:
        own = [one.source == k for k in range(len(one.sources))]
        by = f" by {'anchor' if one.name == 'range' else 'station'}" * (len(own) > 1)
        parts = [*boxes([one.estimated[of] for of in own], "about the estimates", BLUE, -0.18)]
        parts += boxes([one.true[of] for of in own], "about the truth", VERMILION, 0.18)
        ticks, note = dict(enumerate(one.sources)), "Boxes: median and half of the readings; lines: 90 %."
        title, label = f"Residuals, {one.name}{by}", f"measured − predicted ({one.unit})"
        yield Chart(f"residuals-{one.name}", title, "", label, parts, (-0.6, len(own) - 0.4), xticks=ticks, note=note)
        known = np.isfinite(one.true) & np.isfinite(one.against)
        if len(own) > 1 and known.sum() >= LEAST and np.ptp(one.against[known]) > 1e-6:
            edges = np.linspace(one.against[known].min(), one.against[known].max(), BINS + 1)
            bins, means = np.searchsorted(edges[1:-1], one.against, side="right"), list[Line]()
            for k, name in enumerate(one.sources):
                count, total = (np.bincount(bins[known & own[k]], w, BINS) for w in (None, one.true[known & own[k]]))
                x, mean = 0.5 * (edges[1:] + edges[:-1]), total / np.maximum(count, 1)
                there, look = count >= LEAST, LINES[k % len(LINES)]
                means += [Line(x[there], mean[there], name, look, marker="circle", size=4)] if there.any() else []
            labels = f"true {one.name} ({one.unit})", f"measured − true ({one.unit})"
            yield Chart(f"residual-means-{one.name}", f"Mean residual about the truth, {one.name}", *labels, means)


def boxes(groups: list[np.ndarray], name: str, colour: str, shift: float = 0.0) -> Iterator[Line]:
    """Boxes of groups of values beside each other: quartiles, median, and strokes from 5 to 95 %; none of a few."""
    known = {k + shift: values[np.isfinite(values)] for k, values in enumerate(groups)}
    known = {place: values for place, values in known.items() if len(values) >= LEAST}
    if known:
        q = np.transpose([np.quantile(values, (0.05, 0.25, 0.5, 0.75, 0.95)) for values in known.values()])
        x, none = np.array([*known]), np.full(len(known), np.nan)
        yield Line(np.stack([x, x, none], 1).ravel(), np.stack([q[0], q[4], none], 1).ravel(), "", colour)
        sides = np.stack([x - 0.13, x + 0.13, x + 0.13, x - 0.13, none], 1).ravel()
        yield Line(sides, np.stack([q[1], q[1], q[3], q[3], none], 1).ravel(), name, colour, opacity=0.45, filled=True)
        yield Line(x, q[2], "", colour, 0.0, marker="circle")


def error_map(recording: ScoredRecording) -> list[Chart]:
    """The RMSE of the horizontal position in square cells of the floor by the true position; none without truth."""
    true, squares = recording.columns("true_x_m", "true_y_m"), recording.miss**2
    known = np.isfinite(squares) & np.isfinite(true).all(axis=1)
    if recording.angles or known.sum() < 2 or (extent := float(np.ptp(true[known], axis=0).max())) < 0.05:
        return []
    decade = 10.0 ** np.floor(np.log10(extent / CELLS))
    cell = float(next(d * decade for d in (1, 2, 5, 10) if d * decade >= extent / CELLS * (1 - 1e-9)))
    edges = [cell * np.arange(np.floor(of.min() / cell), np.floor(of.max() / cell) + 2) for of in true[known].T]
    histogram: Any = np.histogram2d
    count, total = (histogram(*true[known].T, edges, weights=weights)[0].T for weights in (None, squares[known]))
    rmse = np.sqrt(total / np.where(count > 0, count, np.nan))
    x, y = (of[:-1] + cell / 2 for of in edges)
    field = Field(x, y, rmse, "RMSE (m)", "Viridis", 0.0, float(np.nanmax(rmse)))
    parts: list[Line | Field] = [field, *rig_lines(recording.folder.rig, extent)]
    title = f"Horizontal RMSE over the floor, cells of {cell:g} m"
    return [Chart("error-map", title, "x (m)", "y (m)", parts, equal=True)]
