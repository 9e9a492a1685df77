"""Measured and true values of stations and anchors, with the pieces of time and the places that share errors.

Of an anchor also whether its ranges contradict the straight line fitted to their errors.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.stats import f_oneway

from trackwright.trackers.core.model.rig import Point
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


INTERVALS = 6
"""Intervals of distance with the same number of readings."""

LEAST_READINGS, LEAST_PIECES = 3, 3
"""The least readings of a median, and the least medians of an interval."""

LEVEL = 0.001
"""Level of the test."""


def differs_by_distance(distance: np.ndarray, errors: np.ndarray, piece: np.ndarray, spread: float) -> bool:
    """Whether errors (N,), m, that a line left at distances (N,), m, differ systematically between distances.

    One-way analysis of variance between intervals of distance; its samples are medians of the pieces of time (N,),
    whose errors count as independent. The means of the intervals must also differ by half the `spread` of errors, m.
    """
    known = np.isfinite(errors)
    edges = np.quantile(distance[known], np.linspace(0, 1, INTERVALS + 1)[1:-1]) if known.any() else np.zeros(0)
    interval = np.searchsorted(edges, distance[known])
    rows = pl.DataFrame({"interval": interval, "piece": piece[known], "error": errors[known]})
    medians = rows.group_by("interval", "piece").agg(pl.col("error").median(), pl.len())
    medians = medians.filter(pl.col("len") >= LEAST_READINGS).group_by("interval", maintain_order=True).agg("error")
    samples = [np.array(sample) for sample in medians["error"].to_list() if len(sample) >= LEAST_PIECES]
    if len(samples) < 2:
        return False
    means = [float(np.mean(sample)) for sample in samples]
    return bool(f_oneway(*samples).pvalue < LEVEL and max(means) - min(means) > 0.5 * spread)
