"""Calibration of stations and anchors from recordings with truth: `trackers/recordings/calibration.py` has the models.

Each angle of a station, and each anchor, is a robust linear regression of its own with a weak normal prior. Its errors
are correlated: over seconds, and at a place however often a tag returns. Rows of one piece of time and place share
their weight, and the covariance is a sandwich whose meat adds scores within pieces of time and within places.

Cross-fitting corrects a recording by what others show, or each half of it by the other half.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.stats import norm

from trackwright.trackers.core.errors import UnusableInput, one_or_more
from trackwright.trackers.core.model.rig import Point
from trackwright.trackers.recordings.calibration import (
    ANGLE_PRIOR,
    OFFSET_SIGMA,
    RANGE_PRIOR,
    TAG_SIGMA,
    AnchorCalibration,
    Calibration,
    StationCalibration,
    TagCalibration,
    angle_terms,
    has_moved,
    has_turned,
    predicted,
    range_terms,
)
from trackwright.trackers.recordings.columns import TruthStatus, independent_pieces
from trackwright.trackers.recordings.folder import FOLDERS, RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, Kind, wrapped
from trackwright.trackers.recordings.tracks import known_heights
from trackwright.tuning.clustered_regression import Regression, Rows, regressions, with_least_slope

Stations = Mapping[str, StationCalibration]
Numbers = Mapping[str, np.ndarray]  # by station or anchor

LEAST_SLOPE = 0.2  # least slope of a calibrated angle or range, so that each reading has one true value
TAG_ROUNDS = 3  # how often the biases of anchors and of tags are fitted in turn
MOST_VISITS = 500  # the most visits of a station that a map keeps; more are thinned evenly


def calibrate(recordings: RecordingFolder | Sequence[RecordingFolder]) -> Calibration:
    """The systematic errors of stations, anchors and tags of recordings with truth, with their covariances.

    Stations, anchors and tags of one id in several recordings are one. Each recording has the same weight. Those with
    fewer than 20 rows with truth are left out. Of several recordings with bearings also a map of what is left of these,
    where each of them, left out, confirms it.
    Raises UnusableInput where none is left, and for a station or anchor that stands at several places.
    """
    folders = one_or_more(recordings, (RecordingFolder,), FOLDERS)
    calibration, kind = systematic(folders), KINDS["bearings"]
    seen = [folder for folder in folders if {"bearings", "truth"} <= folder.tables.keys()]
    several = seen if len(seen) > 1 else []
    without = [_stations(calibration_pairs([other for other in seen if other is not apart], kind)) for apart in several]
    by_place = _confirmed_map(calibration_pairs(several, kind), calibration.stations, without)
    return replace(calibration, bearing_map=by_place)


def _confirmed_map(pairs: Mapping[str, Pairs], stations: Stations, without: Sequence[Stations]) -> Numbers:
    """The visits (V, 4) of all recordings about their calibration, by station; none where those left out refute them.

    The rule: the visits of each recording, about a calibration on the others (`without`, by number), are together more
    probable by the map of the others' visits than by a normal density of no mean and, for each angle of a station, the
    others' root mean square.
    """
    gain = 0.0
    for number, others in enumerate(without):
        for name in others.keys() & pairs.keys():
            visits, recording = visits_of(pairs[name], others[name])
            known, left_out = _thinned(visits[recording != number]), visits[recording == number]
            if len(known) and len(left_out):
                means, sigmas = np.split(predicted(known, left_out[:, :2]), 2, axis=1)
                spread = np.sqrt((known[:, 2:] ** 2).mean(axis=0)) + 10.0**-DIGITS
                errors = left_out[:, 2:]
                gain += (norm.logpdf(errors, means, sigmas) - norm.logpdf(errors, 0.0, spread)).sum()
    if gain <= 0.0:
        return {}
    whole = {name: _thinned(visits_of(pairs[name], station)[0]) for name, station in stations.items()}
    return {name: visits for name, visits in whole.items() if len(visits)}


def _thinned(visits: np.ndarray) -> np.ndarray:
    return visits[np.unique(np.linspace(0, len(visits) - 1, min(MOST_VISITS, len(visits))).astype(int))]


def systematic(folders: Sequence[RecordingFolder]) -> Calibration:
    """The calibration without what follows the place; raises as `calibrate`."""
    check_at_rest(folders)
    stations = _stations(calibration_pairs(folders, KINDS["bearings"]))
    places = {name: place for folder in folders for name, place in folder.rig.anchors.items()}
    anchors, tags, spread = _anchors(calibration_pairs(folders, KINDS["ranges"]), places)
    if not stations and not anchors:
        raise UnusableInput(_lacking(folders))
    mounted = {name: station for folder in folders for name, station in folder.rig.stations.items()}
    return Calibration(
        {name: replace(calibration, mounted=mounted[name]) for name, calibration in stations.items()},
        {name: replace(calibration, position=places[name]) for name, calibration in anchors.items()},
        tags,
        tuple(folder.name for folder in folders),
        spread,
    )


def check_at_rest(folders: Sequence[RecordingFolder]) -> None:
    """Raises UnusableInput for a station or anchor that stands elsewhere in another recording."""
    for number, folder in enumerate(folders):
        for other in folders[:number]:
            a, b = folder.rig, other.rig
            moved = [f"station '{n}'" for n, now in a.stations.items() if has_turned(b.stations.get(n), now)]
            moved += [f"anchor '{n}'" for n, now in a.anchors.items() if has_moved(b.anchors.get(n), now)]
            if moved:
                raise UnusableInput(
                    f"{folder.path or folder.name}: {moved[0]} stands elsewhere than in {other.path or other.name}; "
                    "expected recordings of one installation; take them apart"
                )


def _lacking(folders: Sequence[RecordingFolder]) -> str:
    names = ", ".join(str(folder.path or folder.name) for folder in folders)
    if not any("truth" in folder.tables for folder in folders):
        return f"{names}: no truth table; expected truth to calibrate against; give recordings with truth"
    calibrated = [name for name, kind in KINDS.items() if kind.calibrated is not None]
    if not any(name in folder.tables for folder in folders for name in calibrated):
        tables = ", ".join(dict.fromkeys(table for folder in folders for table in folder.tables))
        expected = f"{', '.join(calibrated[:-1])} or {calibrated[-1]}"
        return f"{names}: tables {tables}; expected {expected} to calibrate; give recordings with such a table"
    return (
        f"{names}: fewer than {MIN_ROWS} rows with truth in x, y and z for every station and anchor; expected at least "
        f"{MIN_ROWS} for one; give longer recordings, or height_m of the tags in rig.toml where the truth has no z_m"
    )


def _stations(pairs: Mapping[str, Pairs]) -> dict[str, StationCalibration]:
    spans = {name: np.stack([of.true.min(axis=0), of.true.max(axis=0)], axis=1) for name, of in pairs.items()}
    unknown = Regression(ANGLE_PRIOR[0], np.diag(ANGLE_PRIOR[1] ** 2), 0.0)
    angles: list[dict[str, Regression]] = []
    for k in range(2):
        rows = {name: _rows(values, angle_terms(values.true, spans[name])[:, k], k) for name, values in pairs.items()}
        fitted = regressions({name: of_station for name, of_station in rows.items() if len(of_station.y)}, *ANGLE_PRIOR)
        angles.append({name: _increasing(fitted.get(name, unknown), spans[name], k) for name in pairs})
    calibrations = {}
    for name, values in pairs.items():
        terms, covariances, _ = (np.stack(x) for x in zip(*(angle[name] for angle in angles), strict=True))
        calibrations[name] = StationCalibration(terms, covariances, spans[name], len(values.true))
    return calibrations


def _rows(pairs: Pairs, factors: np.ndarray, column: int) -> Rows:
    """The rows of a regression: those with a measured value."""
    seen = np.isfinite(pairs.measured[:, column])
    groups = (numbers[seen] for numbers in (pairs.recording, pairs.piece, pairs.place))
    return Rows(factors[seen], pairs.measured[seen, column], *groups)


def _increasing(regression: Regression, spans: np.ndarray, k: int) -> Regression:
    """Terms with which angle `k` increases everywhere: its slope is least at a corner of the spans, or at angle 0."""
    corners = np.meshgrid(*[np.append(span, np.clip(0.0, *span)) for span in spans], indexing="ij")
    angle, other = corners[k].ravel(), corners[1 - k].ravel()
    slopes = np.stack([np.zeros_like(angle), np.ones_like(angle), 3.0 * angle**2, other], axis=1)
    return with_least_slope(regression, slopes, LEAST_SLOPE)


def _anchors(
    pairs: Mapping[str, Pairs], places: Mapping[str, Point]
) -> tuple[dict[str, AnchorCalibration], dict[str, TagCalibration], float | None]:
    """The calibrations of anchors and of tags, fitted in turn: the range errors of both add; what spread they leave."""
    if not pairs:
        return {}, {}, None
    rows = {name: _rows(values, range_terms(values.true[:, 0]), 0) for name, values in pairs.items()}
    rows = {name: of_anchor._replace(y=of_anchor.y - of_anchor.x[:, 1]) for name, of_anchor in rows.items()}
    owners = {name: values.tag[np.isfinite(values.measured[:, 0])] for name, values in pairs.items()}
    tags, counts = np.unique(np.concatenate(list(owners.values())), return_counts=True)
    number = {name: np.searchsorted(tags, row_tags) for name, row_tags in owners.items()}
    biases, sigmas = np.zeros(len(tags)), np.zeros(len(tags))
    for _ in range(TAG_ROUNDS if len(tags) > 1 else 1):
        corrected = {name: of_anchor._replace(y=of_anchor.y - biases[number[name]]) for name, of_anchor in rows.items()}
        fitted = regressions(corrected, *RANGE_PRIOR)
        if len(tags) > 1:
            biases, sigmas = _tag_biases(rows, fitted, number, len(tags))
    seen = {name: np.isfinite(values.measured[:, 0]) for name, values in pairs.items()}
    ends = {name: end_factors(values, places[name])[seen[name]] for name, values in pairs.items()}
    offsets, offset_sigmas = _tag_offsets(corrected, fitted, number, ends)
    calibrations = {}
    for name, regression in fitted.items():
        terms, covariance, _ = with_least_slope(regression, np.array([[0.0, 1.0]]), LEAST_SLOPE - 1.0)
        distances = rows[name].x[:, 1]
        span = np.array([distances.min(), distances.max()])
        calibrations[name] = AnchorCalibration(terms, covariance, span, len(distances))
    places_of_tags = (map(tuple, column.tolist()) for column in (offsets, offset_sigmas))
    of_tags = zip(tags.tolist(), biases.tolist(), sigmas.tolist(), counts.tolist(), *places_of_tags, strict=True)
    spread = float(np.sqrt(np.mean([regression.scale**2 for regression in fitted.values()])))
    return calibrations, {tag: TagCalibration(*fields) for tag, *fields in of_tags}, spread


def _tag_biases(
    rows: Mapping[str, Rows], fitted: Mapping[str, Regression], number: Numbers, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Biases of tags (count,), relative to their mean, and their standard deviations, from errors at all anchors."""
    left = [r._replace(x=np.ones((len(r.y), 1)), y=r.y - r.x @ fitted[name].terms) for name, r in rows.items()]
    joined = Rows(*(np.concatenate(column) for column in zip(*left, strict=True)))
    tag = np.concatenate([number[name] for name in rows])
    of_tags = {str(k): Rows(*(column[tag == k] for column in joined)) for k in range(count)}
    fits = regressions(of_tags, np.zeros(1), np.array([TAG_SIGMA])).values()
    biases = np.array([fit.terms[0] for fit in fits])
    return biases - biases.mean(), np.sqrt([fit.covariance[0, 0] for fit in fits])


def _tag_offsets(
    rows: Mapping[str, Rows], fitted: Mapping[str, Regression], number: Numbers, ends: Numbers
) -> tuple[np.ndarray, np.ndarray]:
    """Where the ranges of tags end (tags, 2) and its standard deviations, zero where no heading is known.

    Fitted in turn with terms of the anchors that serve here alone: trackers without a heading keep `fitted`.
    """
    tag = np.concatenate([number[name] for name in rows])
    offsets, sigmas = np.zeros((2, tag.max() + 1, 2))
    if not any(factors.any() for factors in ends.values()):
        return offsets, sigmas
    for _ in range(TAG_ROUNDS):
        left = []
        for code, (name, of_anchor) in enumerate(rows.items()):
            # Obstruction and multipath at a place belong to an anchor.
            clusters = {key: getattr(of_anchor, key) * len(rows) + code for key in ("piece", "place")}
            x = np.column_stack([np.ones(len(of_anchor.y)), ends[name]])
            left.append(of_anchor._replace(x=x, y=of_anchor.y - of_anchor.x @ fitted[name].terms, **clusters))
        joined = Rows(*(np.concatenate(column) for column in zip(*left, strict=True)))
        for k in range(len(offsets)):
            of_tag = {"": Rows(*(column[tag == k] for column in joined))}
            fit = regressions(of_tag, np.zeros(3), np.array([TAG_SIGMA, OFFSET_SIGMA, OFFSET_SIGMA]))[""]
            offsets[k], sigmas[k] = fit.terms[1:], np.sqrt(np.diag(fit.covariance)[1:])
        shifts = {name: (ends[name] * offsets[number[name]]).sum(axis=1) for name in rows}
        fitted = regressions({name: r._replace(y=r.y - shifts[name]) for name, r in rows.items()}, *RANGE_PRIOR)
    return offsets, sigmas


def by_halves(folder: RecordingFolder) -> list[RecordingFolder]:
    """The halves of a recording with truth, each with a calibration of the other; raises as `calibrate`."""
    tables = folder.tables
    times = tables["truth"]["t_s"]
    before = pl.col("t_s") < 0.5 * (float(times[0]) + float(times[-1]))
    first, second = (
        replace(folder, name=f"{folder.name}, {which} half", tables={k: t.filter(rows) for k, t in tables.items()})
        for which, rows in (("first", before), ("second", ~before))
    )
    return [first.calibrated(calibrate(second)), second.calibrated(calibrate(first))]


PLACE_M = 1.0  # side of the squares of the floor, m, within which errors count as dependent
MIN_ROWS = 20  # least number of rows with truth of a station or anchor that is calibrated
MOST_PIECES = 1_000_000  # more pieces than a recording has: pieces of different recordings have different numbers
VISIT_M, DIGITS = 0.5, 4  # distance, m, from a visit's first row within which rows are of it; decimals of its means


class Pairs(NamedTuple):
    """Measured and true values of one station or anchor.

    `true` and `measured` (N, 2) rad or (N, 1) m, NaN where not measured. `positions` (N, 3) m. `recording` (N,): the
    number of each row's recording. `piece`, `place` (N,): numbers of its piece of time and of its square. `tag` (N,):
    its id. `time` (N,) s. `heading` (N,) rad: of the body, NaN where it is not known.
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
    joined = {name: Pairs(*map(np.concatenate, zip(*of, strict=True))) for name, of in sorted(parts.items())}
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
    x, y = np.floor(np.nan_to_num(positions[:, :2]) / PLACE_M).astype(int).T
    place = x * 100003 + y
    tag = rows.of_each(np.array(rows.tags))
    true = measured.kind.values_at(positions, measured.sensors)
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
