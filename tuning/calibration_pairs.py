"""Measured and true values of stations and anchors, with the pieces of time and the places that share errors."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.model.rig import Point
from trackwright.trackers.recordings.calibration import StationCalibration
from trackwright.trackers.recordings.columns import TruthStatus, independent_pieces
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import Kind, wrapped
from trackwright.trackers.recordings.trajectories import known_heights

PLACE_M = 1.0
"""Side of the squares of the floor, m, within which errors count as dependent."""

MIN_ROWS = 20
"""Least number of rows with truth of a station or anchor that is calibrated."""

MOST_PIECES = 1_000_000
"""More pieces than a recording has: pieces of different recordings have different numbers."""

VISIT_M, DIGITS = 0.5, 4
"""Distance, m, from the first row of a visit within which further rows are of the same one; decimals of its means."""


class Pairs(NamedTuple):
    """Measured and true values of one station or anchor.

    `true` and `measured` (N, 2) rad or (N, 1) m, NaN where not measured. `positions` (N, 3) m. `recording` (N,): the
    number of each row's recording. `piece`, `place` (N,): numbers of its piece of time and of its square. `tag` (N,):
    its id. `time` (N,) s. `heading` (N,) rad: of the body, NaN where it
    is not known.
    """

    true: np.ndarray
    measured: np.ndarray
    positions: np.ndarray
    recording: np.ndarray
    piece: np.ndarray
    place: np.ndarray
    tag: np.ndarray
    time: np.ndarray
    heading: np.ndarray


def calibration_pairs(folders: Sequence[RecordingFolder], kind: Kind) -> dict[str, Pairs]:
    """Measured and true values of a kind by station or anchor, of those with enough rows."""
    parts: dict[str, list[Pairs]] = {}
    for number, folder in enumerate(folders):
        if kind.name in folder.tables:
            for name, pairs in _of_folder(folder, number, kind):
                parts.setdefault(name, []).append(pairs)
    joined = {
        name: Pairs(*map(np.concatenate, zip(*by_folder, strict=True))) for name, by_folder in sorted(parts.items())
    }
    return {name: pairs for name, pairs in joined.items() if np.isfinite(pairs.measured).sum(axis=0).max() >= MIN_ROWS}


def _of_folder(folder: RecordingFolder, number: int, kind: Kind) -> Iterator[tuple[str, Pairs]]:
    """The pairs of each station or anchor of one recording."""
    rows = folder.rows(kind.name)
    raw = kind.measured(folder.rig, rows)
    measured = raw.usable
    positions, status = folder.paths.at(rows.tags, rows.starts, rows.times)
    headings = folder.paths.headings_at(rows.tags, rows.starts, rows.times)
    # A truth over the floor is completed by the height of the tag in the rig.
    heights = rows.of_each(known_heights(folder, rows.tags))
    positions = np.column_stack([positions[:, :2], np.where(np.isnan(positions[:, 2]), heights, positions[:, 2])])
    known = (status == TruthStatus.SCORED) & np.isfinite(positions).all(axis=1) & np.isfinite(raw.values).any(axis=1)
    piece = independent_pieces(rows.times, positions, rows.starts, known) + MOST_PIECES * number
    place = _places(positions)
    tag = rows.of_each(np.array(rows.tags))
    true = measured.predicted(positions)
    # The difference of azimuths is wrapped, so that readings beyond half a turn stay near the true ones.
    away = measured.values - true
    values = measured.values - (away - wrapped(away, measured.columns))
    number_of = np.full(len(tag), number)
    for code, name in enumerate(measured.ids):
        mask = known & (measured.sensors.number[:, 0] == code)
        columns = true, values, positions, number_of, piece, place, tag, rows.times, headings
        yield name, Pairs(*(column[mask] for column in columns))


def end_factors(pairs: Pairs, anchor: Point) -> np.ndarray:
    """What ranges grow by (N, 2) per metre by which they end ahead of a tag and to the left; 0 of unknown headings."""
    away = pairs.positions - anchor
    x, y = away[:, :2].T / np.maximum(np.linalg.norm(away, axis=1), 1e-6)
    cosine, sine = np.cos(pairs.heading), np.sin(pairs.heading)
    return np.nan_to_num(np.stack([cosine * x + sine * y, cosine * y - sine * x], axis=1))


def _places(positions: np.ndarray) -> np.ndarray:
    """The number of each row's square of the floor (N,)."""
    x, y = np.floor(np.nan_to_num(positions[:, :2]) / PLACE_M).astype(int).T
    return x * 100003 + y


def visits_of(pairs: Pairs, station: StationCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Visits (V, 4) to places, m, with mean errors about a calibration, rad, and the numbers (V,) of their recordings.

    A visit is a run of rows of a station and a tag with both angles, within half a metre: one sample of the place.
    """
    tags = np.unique(pairs.tag, return_inverse=True)[1].ravel()
    order = np.lexsort((pairs.time, tags, pairs.recording))
    order = order[np.isfinite(pairs.measured[order]).all(axis=1)]
    columns = np.concatenate([pairs.positions[:, :2], pairs.measured - station.measured(pairs.true)], axis=1)[order]
    sources = list(zip(pairs.recording[order].tolist(), tags[order].tolist(), strict=True))
    places, begins = columns[:, :2].tolist(), list[int]()
    for k, source in enumerate(sources):
        first = begins[-1] if begins else k
        if not begins or source != sources[first] or math.dist(places[k], places[first]) > VISIT_M:
            begins.append(k)
    if not begins:
        return columns, pairs.recording[order]
    counts = np.diff(begins, append=len(columns))
    means = np.add.reduceat(columns, begins) / counts[:, None]
    return np.round(means, DIGITS), pairs.recording[order][begins]
