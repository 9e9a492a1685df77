"""Calibration of stations and anchors from recordings with truth: `trackers/recordings/calibration.py` has the models.

Each angle of a station, and each anchor, is a robust linear regression of its own with a weak normal prior. Its errors
are correlated: over seconds, and at a place however often a tag returns. Rows of one piece of time and place share
their weight, and the covariance is a sandwich whose meat adds scores within pieces of time and within places.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from trackers.core.errors import UnusableInput
from trackers.recordings.calibration import (
    ANGLE_PRIOR,
    RANGE_PRIOR,
    AnchorCalibration,
    Calibration,
    StationCalibration,
    angle_terms,
    range_terms,
)
from trackers.recordings.columns import TagRows
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.truth import TruthStatus
from tuning.clustered_regression import Regression, Rows, regressions, with_least_slope

PIECE_S, PIECE_M = 5.0, 1.0
"""Least duration, s, and way, m, of a piece of time: errors of different pieces count as independent."""

PLACE_M = 1.0
"""Side of the squares of the floor, m, within which errors count as dependent."""

LEAST_SLOPE = 0.2
"""Least slope of a calibrated angle or range, so that each reading has one true value."""

MIN_ROWS = 20
"""Least number of rows with truth of a station or anchor that is calibrated."""


class Pairs(NamedTuple):
    """Measured and true values of one station or anchor.

    `true` and `measured` (N, 2) rad or (N, 1) m, NaN where not measured. `positions` (N, 3) m. `recording` (N,): the
    number of each row's recording. `piece` and `place` (N,): numbers of its piece of time and of its square.
    """

    true: np.ndarray
    measured: np.ndarray
    positions: np.ndarray
    recording: np.ndarray
    piece: np.ndarray
    place: np.ndarray


def calibrate(recordings: RecordingFolder | Sequence[RecordingFolder]) -> Calibration:
    """The systematic errors of the stations and anchors of recordings with truth, with their covariances.

    Stations and anchors of one id in several recordings are one. Each recording has the same weight. Those with fewer
    than 20 rows with truth are left out. Raises UnusableInput where none is left.
    """
    folders = [recordings] if isinstance(recordings, RecordingFolder) else list(recordings)
    stations, anchors = _stations(station_pairs(folders)), _anchors(anchor_pairs(folders))
    if not stations and not anchors:
        raise UnusableInput(_lacking(folders))
    return Calibration(stations, anchors, tuple(folder.name for folder in folders))


def _lacking(folders: Sequence[RecordingFolder]) -> str:
    names = ", ".join(str(folder.path or folder.name) for folder in folders)
    if not any("truth" in folder.tables for folder in folders):
        return f"{names}: no truth table; expected truth to calibrate against; give recordings with truth"
    if not any({"bearings", "ranges"} & set(folder.tables) for folder in folders):
        found = ", ".join(dict.fromkeys(table for folder in folders for table in folder.tables))
        return f"{names}: tables {found}; expected bearings or ranges to calibrate; give recordings with such a table"
    return (
        f"{names}: fewer than {MIN_ROWS} rows with truth for every station and anchor; expected at least {MIN_ROWS} "
        "for one; give longer recordings"
    )


def station_pairs(folders: Sequence[RecordingFolder]) -> dict[str, Pairs]:
    """Measured and true angles by station, of the stations with enough rows."""
    return _pairs(folders, "bearings", "station", ("azimuth_rad", "elevation_rad"))


def anchor_pairs(folders: Sequence[RecordingFolder]) -> dict[str, Pairs]:
    """Measured and true ranges by anchor, of the anchors with enough rows."""
    return _pairs(folders, "ranges", "anchor", ("range_m",))


def _pairs(folders: Sequence[RecordingFolder], table: str, source: str, columns: Sequence[str]) -> dict[str, Pairs]:
    parts: dict[str, list[Pairs]] = {}
    for number, folder in enumerate(folders):
        if table in folder.tables:
            for name, pairs in _of_folder(folder, number, table, source, columns):
                parts.setdefault(name, []).append(pairs)
    joined = {name: Pairs(*map(np.concatenate, zip(*own, strict=True))) for name, own in sorted(parts.items())}
    enough = {
        name: pairs for name, pairs in joined.items() if np.isfinite(pairs.measured).sum(axis=0).max() >= MIN_ROWS
    }
    # Pieces and places get numbers that differ between recordings and from 0 up.
    return {
        name: pairs._replace(
            piece=np.unique(np.stack([pairs.recording, pairs.piece]), axis=1, return_inverse=True)[1].ravel()
        )
        for name, pairs in enough.items()
    }


def _of_folder(
    folder: RecordingFolder, number: int, table: str, source: str, columns: Sequence[str]
) -> Iterator[tuple[str, Pairs]]:
    """The pairs of each station or anchor of one recording."""
    rows = folder.rows(table)
    measured = rows.floats(columns)
    positions, status = folder.paths.at(rows.tags, rows.starts, rows.times)
    known = (status == TruthStatus.SCORED) & np.isfinite(positions).all(axis=1) & np.isfinite(measured).any(axis=1)
    piece, place = _pieces(rows, positions, known), _places(positions)
    rig = folder.rig
    ids = list(rig.stations) if source == "station" else sorted(rig.anchors)
    codes = rows.codes(source, ids)
    for code, name in enumerate(ids):
        own = known & (codes == code)
        if source == "station":
            true = rig.stations[name].angles(positions[own])
            # The difference of azimuths is wrapped, so that readings beyond half a turn stay near the true ones.
            values = true + (measured[own] - true + np.pi) % (2 * np.pi) - np.pi
        else:
            true = np.linalg.norm(positions[own] - np.asarray(rig.anchors[name]), axis=1)[:, None]
            values = np.where(measured[own] > 0.0, measured[own], np.nan)
        yield name, Pairs(true, values, positions[own], np.full(own.sum(), number), piece[own], place[own])


def _pieces(rows: TagRows, positions: np.ndarray, known: np.ndarray) -> np.ndarray:
    """The number of each row's piece of time (N,): a new one after `PIECE_S` and `PIECE_M`, the same for all tags.

    A tag that stands still stays in one piece, since the errors of its readings are those of one place.
    """
    piece = np.zeros(len(rows.times), int)
    if not known.any():
        return piece
    # The way of the tag that moves most stands for all of them: tags on one body move together.
    ways = []
    for k in range(len(rows.tags)):
        own = np.arange(rows.starts[k], rows.starts[k + 1])
        own = own[known[own]]
        if len(own) > 1:
            ways.append((rows.times[own], np.append(0.0, np.cumsum(_steps(rows.times[own], positions[own])))))
    if not ways:
        return piece
    times, way = max(ways, key=lambda one: one[1][-1])
    begins, last = [times[0]], (times[0], 0.0)
    for time, gone in zip(times, way, strict=True):
        if time - last[0] >= PIECE_S and gone - last[1] >= PIECE_M:
            begins.append(time)
            last = (time, gone)
    return np.searchsorted(np.array(begins), rows.times, side="right")


def _steps(times: np.ndarray, positions: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(positions, axis=0), axis=1)


def _places(positions: np.ndarray) -> np.ndarray:
    """The number of each row's square of the floor (N,)."""
    x, y = np.floor(np.nan_to_num(positions[:, :2]) / PLACE_M).astype(int).T
    return x * 100003 + y


def _stations(pairs: Mapping[str, Pairs]) -> dict[str, StationCalibration]:
    spans = {name: np.stack([one.true.min(axis=0), one.true.max(axis=0)], axis=1) for name, one in pairs.items()}
    unknown = Regression(ANGLE_PRIOR[0], np.diag(ANGLE_PRIOR[1] ** 2))
    angles: list[dict[str, Regression]] = []
    for k in range(2):
        rows = {name: _rows(one, angle_terms(one.true, spans[name])[:, k], k) for name, one in pairs.items()}
        found = regressions({name: one for name, one in rows.items() if len(one.y)}, *ANGLE_PRIOR)
        angles.append({name: _increasing(found.get(name, unknown), spans[name], k) for name in pairs})
    calibrations = {}
    for name, one in pairs.items():
        terms, covariances = (np.stack(x) for x in zip(*(angle[name] for angle in angles), strict=True))
        calibrations[name] = StationCalibration(terms, covariances, spans[name], len(one.true))
    return calibrations


def _rows(pairs: Pairs, factors: np.ndarray, column: int) -> Rows:
    """The rows of a regression: those with a measured value."""
    seen = np.isfinite(pairs.measured[:, column])
    return Rows(
        factors[seen], pairs.measured[seen, column], *(c[seen] for c in (pairs.recording, pairs.piece, pairs.place))
    )


def _increasing(found: Regression, spans: np.ndarray, k: int) -> Regression:
    """Terms with which angle `k` increases everywhere: its slope is least at a corner of the spans, or at angle 0."""
    corners = np.meshgrid(*[np.append(span, np.clip(0.0, *span)) for span in spans], indexing="ij")
    own, other = corners[k].ravel(), corners[1 - k].ravel()
    slopes = np.stack([np.zeros_like(own), np.ones_like(own), 3.0 * own**2, other], axis=1)
    return with_least_slope(found, slopes, LEAST_SLOPE)


def _anchors(pairs: Mapping[str, Pairs]) -> dict[str, AnchorCalibration]:
    rows = {name: _rows(one, range_terms(one.true[:, 0]), 0) for name, one in pairs.items()}
    found = regressions({name: one._replace(y=one.y - one.x[:, 1]) for name, one in rows.items()}, *RANGE_PRIOR)
    calibrations = {}
    for name, regression in found.items():
        terms, covariance = with_least_slope(regression, np.array([[0.0, 1.0]]), LEAST_SLOPE - 1.0)
        distances = rows[name].x[:, 1]
        span = np.array([distances.min(), distances.max()])
        calibrations[name] = AnchorCalibration(terms, covariance, span, len(distances))
    return calibrations
