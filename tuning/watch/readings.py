"""The readings of anchors and stations with the positions that a tracker gives, and what weight each has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import polars as pl
from jaxtyping import Bool, Float, Int

from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.recordings.columns import run_starts
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Measured, wrapped

WATCHED = ("ranges", "tdoa", "bearings")
OF_ANCHOR, OF_STATION = ("delay", "x", "y", "z"), ("turn", "tilt", "x", "y", "z")
"""The parameters of an anchor, m, and of a station, rad and m: its turn about the vertical, and of all elevations."""

SLOT_S = 5.0
"""Time, s, over which scores are summed for the sequential test."""

WINDOWS_S = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Times, s, for which the error of a tracked position is taken as constant: the first in which enough is seen."""

GAP_S = 1.0
"""Time, s, from the nearest estimate within which a reading has a tracked position."""

CUT, MEDIAN_S = 2.0, 10.0
"""Standard deviations from the median of its source over so many seconds at which a reading has half its weight."""


class Source(NamedTuple):
    """What may change: an anchor by its ranges or differences, or a station; `first`: the number of its parameters'."""

    table: str
    name: str
    first: int

    @property
    def parameters(self) -> tuple[str, ...]:
        """The names of its parameters."""
        return OF_STATION if self.table == "bearings" else OF_ANCHOR

    @property
    def offsets(self) -> list[int]:
        """The numbers of those that add a constant to its values."""
        return [self.first, self.first + 1] if self.table == "bearings" else [self.first]

    def number(self, parameter: str) -> int:
        """The number of one of its parameters."""
        return self.first + self.parameters.index(parameter)

    def __str__(self) -> str:
        return f"{KINDS[self.table].noun} {self.name}"


@dataclass(frozen=True, eq=False)
class Readings:
    """The readings of one kind with tracked positions.

    `times` (N,) s; `track` (N,): which tag of which run; `positions` (N, 3) m; `level` (N,): whether the height is
    known; `weights` (N, m), per squared unit: zero where a value is missing.
    """

    measured: Measured
    times: Float[np.ndarray, " N"]
    track: Int[np.ndarray, " N"]
    positions: Float[np.ndarray, "N 3"]
    level: Bool[np.ndarray, " N"]
    weights: Float[np.ndarray, "N m"]

    def of_rows(self, part: np.ndarray) -> Readings:
        """Some of them, by a mask or numbers."""
        rows = np.flatnonzero(part) if part.dtype == bool else part
        of = {name: getattr(self, name)[rows] for name in ("times", "track", "positions", "level", "weights")}
        return replace(self, measured=self.measured.of_rows(rows), **of)


def sources_of(folders: Sequence[RecordingFolder]) -> tuple[Source, ...]:
    """The anchors and stations that have readings in the recordings."""
    sources, first = [], 0
    for table in WATCHED:
        columns = [
            folder.tables[table][name] for folder in folders if table in folder.tables for name in KINDS[table].sensors
        ]
        for name in sorted({str(name) for column in columns for name in column.unique()}):
            sources.append(Source(table, name, first))
            first += len(sources[-1].parameters)
    return tuple(sources)


def times_of(folder: RecordingFolder) -> tuple[float, float]:
    """When the first and the last of its readings that are watched are, s."""
    times = np.concatenate([folder.rows(table).times for table in WATCHED if table in folder.tables])
    return float(times.min()), float(times.max())


def readings_of(
    folder: RecordingFolder, tracks: pl.DataFrame, rig: Rig, sources: Sequence[Source], first: int, later: float
) -> dict[str, Readings]:
    """The readings of the sources by table, of tags with estimates, their weights not yet set.

    `first`: the number of the first of its tracks; `later`: what is added to its times, s.
    """
    estimates = tracks.select("tag", "t_s", "x_m", "y_m", "z_m").drop_nulls(["x_m", "y_m"]).sort("tag", "t_s")
    starts = run_starts(estimates, ["tag"])
    tags = estimates["tag"].cast(pl.String)[starts[:-1]].to_list()
    paths = {
        tag: (first + k, estimates[a:b]) for k, (tag, (a, b)) in enumerate(zip(tags, pairwise(starts), strict=True))
    }
    result = {}
    for table in WATCHED:
        if table not in folder.tables:
            continue
        rows, names = folder.rows(table), {source.name for source in sources if source.table == table}
        measured = KINDS[table].measured(rig, rows).usable
        count = len(rows.times)
        track, level, positions = np.zeros(count, int), np.zeros(count, bool), np.full((count, 3), np.nan)
        for tag, (a, b) in zip(rows.tags, pairwise(rows.starts), strict=True):
            if tag in paths:
                track[a:b], path = paths[tag]
                positions[a:b] = _interpolated(path, rows.times[a:b])
                level[a:b] = tag in folder.rig.tags and folder.rig.tags[tag].height is not None
        used = np.array([name in names for name in measured.ids])[measured.sensors.number].all(axis=1)
        kept = used & np.isfinite(positions).all(axis=1) & np.isfinite(measured.values).any(axis=1)
        seen = np.isfinite(measured.values).astype(float)
        result[table] = Readings(measured, rows.times + later, track, positions, level, seen).of_rows(kept)
    return {table: each for table, each in result.items() if len(each.times)}


def _interpolated(path: pl.DataFrame, times: np.ndarray) -> np.ndarray:
    """The positions (N, 3) at times, NaN farther than `GAP_S` from any estimate."""
    at = path["t_s"].to_numpy()
    after = np.searchsorted(at, times)
    around = at[np.clip([after - 1, after], 0, len(at) - 1)]
    near = np.abs(around - times).min(axis=0) <= GAP_S
    known = [np.interp(times, at, path[axis].to_numpy()) for axis in ("x_m", "y_m", "z_m")]
    return np.where(near[:, None], np.stack(known, axis=1), np.nan)


def joined(parts: Sequence[Mapping[str, Readings]]) -> dict[str, Readings]:
    """The readings of several recordings of one rig."""
    return {
        table: _joined([part[table] for part in parts if table in part])
        for table in WATCHED
        if any(table in part for part in parts)
    }


def _joined(pieces: Sequence[Readings]) -> Readings:
    names = ("times", "track", "positions", "level", "weights")
    of = {name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in names}
    number = np.concatenate([piece.measured.sensors.number for piece in pieces])
    values = np.concatenate([piece.measured.values for piece in pieces])
    one = pieces[0].measured
    return Readings(one._replace(values=values, sensors=one.sensors._replace(number=number)), **of)


def window_of(readings: Mapping[str, Readings]) -> float:
    """The shortest time, s, in which most windows with readings see more values than a position and one source need."""
    for width in WINDOWS_S:
        keys = np.concatenate([np.stack([r.track, np.floor(r.times / width)]) for r in readings.values()], axis=1)
        values = np.concatenate([(r.weights > 0).sum(axis=1) for r in readings.values()])
        _, number = np.unique(keys, axis=1, return_inverse=True)
        if np.median(np.bincount(number.ravel(), values)[number.ravel()]) >= 4:
            return width
    return WINDOWS_S[-1]


def merged(readings: Mapping[str, Readings], width: float) -> dict[str, Readings]:
    """The readings with those of a source, or of a pair, within a window of `width` s as one: their weighted mean."""
    return {table: _merged(each, width) for table, each in readings.items()}


def _merged(each: Readings, width: float) -> Readings:
    measured = each.measured
    keys = np.column_stack([each.track, np.floor(each.times / width), measured.sensors.number])
    _, first, group = np.unique(keys.astype(int), axis=0, return_index=True, return_inverse=True)

    def sums(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(group.ravel(), column) for column in values.T], axis=1)

    count, weights = sums(np.ones((len(keys), 1))), sums(each.weights)
    positions, one = sums(each.positions) / count, each.of_rows(first)
    # Means of errors, not of values: those are of different positions.
    errors = sums(each.weights * np.nan_to_num(measured.errors(each.positions))) / np.maximum(weights, 1e-300)
    values = np.where(weights > 0.0, measured.kind.values_at(positions, one.measured.sensors) + errors, np.nan)
    means = {"times": sums(each.times[:, None])[:, 0] / count[:, 0], "positions": positions, "weights": weights}
    return replace(one, measured=one.measured._replace(values=wrapped(values, measured.columns)), **means)


def with_weights(
    readings: Mapping[str, Readings], scales: Mapping[tuple[str, str], np.ndarray] | None = None
) -> tuple[dict[str, Readings], dict[tuple[str, str], np.ndarray]]:
    """The readings with their weights, and the scales of errors (m,) of each source, by table and name.

    `scales`: as they are known. A reading that is far from the median of its source and slot counts less: a change
    moves the median, too.
    """
    found, weighted = dict(scales or {}), {}
    for table, each in readings.items():
        errors = each.measured.errors(each.positions)
        away = errors - _medians(each, errors)
        names = np.array(each.measured.ids)[each.measured.sensors.number[:, 0]] if len(errors) else np.zeros(0, str)
        weights = np.zeros_like(errors)
        for name in np.unique(names):
            rows = names == name
            if scales is None or (table, name) not in found:
                floor = each.measured.kind.sizes("floor", errors.shape[1]) / 5.0
                found[table, str(name)] = np.maximum(1.4826 * np.nanmedian(np.abs(away[rows]), axis=0), floor)
            scale = found[table, str(name)]
            far = np.abs(away[rows]) / scale
            weights[rows] = np.where(np.isfinite(far), 1.0 / (1.0 + (far / CUT) ** 2) / scale**2, 0.0)
        weighted[table] = replace(each, weights=weights)
    return weighted, found


def _medians(each: Readings, errors: np.ndarray) -> np.ndarray:
    """The median error (N, m) over the readings of the same source and track, and the same seconds."""
    keys = {"track": each.track, "piece": np.floor(each.times / MEDIAN_S)}
    keys |= {f"of{k}": column for k, column in enumerate(each.measured.sensors.number.T)}
    values = {f"value{k}": column for k, column in enumerate(errors.T)}
    frame = pl.DataFrame({**keys, **values}, nan_to_null=True)
    medians = frame.select(pl.col(name).median().over(list(keys)) for name in values)
    return medians.fill_null(np.nan).to_numpy()
