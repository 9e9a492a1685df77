"""Estimates beside the truth at their times: which rows count, and where the tag really was."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from trackers.core.errors import UnusableInput
from trackers.core.rig import Station

HOLE_S = 1.0
HOLE_M = 0.02
"""An estimate between two truth rows further apart than this, in time and in place, has no truth."""

NO_ESTIMATE = ("waiting", "non-finite")
"""Statuses of rows whose numbers are no estimates."""


UNITS = ("_s", "_m", "_m2", "_rad", "nis", "nis_dof")
"""How the names of columns of numbers end."""


class TruthStatus(IntEnum):
    """Why a row counts or doesn't."""

    COUNTS = 0
    NO_ESTIMATE = 1
    NO_TRUTH = 2
    HOLE = 3


class Matched(NamedTuple):
    """Tracks sorted by recording, tag, station and time, and what stands beside each row.

    `truth`: (n, 3) m, NaN where there is none. `verdict`: (n,) values of `TruthStatus`. `starts`: (g + 1,) where each of
    the g tracks begins, and the end.
    """

    rows: pl.DataFrame
    truth: np.ndarray
    verdict: np.ndarray
    starts: np.ndarray

    @property
    def counts(self) -> np.ndarray:
        """Which rows are judged."""
        return self.verdict == TruthStatus.COUNTS


def track_keys(tracks: pl.DataFrame) -> list[str]:
    """The columns that tell one track from another: recording and tag, for bearings the station too."""
    return ["recording", "tag", "station"] if is_bearing(tracks) else ["recording", "tag"]


def is_bearing(tracks: pl.DataFrame) -> bool:
    """Whether the tracks are of bearings and not of positions."""
    return "x_m" not in tracks.columns


def match_truth(tracks: pl.DataFrame, truths: Mapping[str, pl.DataFrame]) -> Matched:
    """The tracks with the truth linearly interpolated at each row's `t_s`.

    Truth counts only inside its span, and not in holes longer than `HOLE_S` over which it moved more than `HOLE_M`.
    `truths`: for each recording a table of t_s, tag, x_m, y_m, z_m. Raises UnusableInput for missing columns.
    """
    values = ["azimuth_rad", "elevation_rad"] if is_bearing(tracks) else ["x_m", "y_m"]
    keys = track_keys(tracks)
    _require(tracks, [*keys, "t_s", *values], "the tracks")
    rows = tracks.with_columns(pl.col(keys).cast(pl.String)).sort([*keys, "t_s"], maintain_order=True)
    times = numbers(rows, "t_s")
    usable = np.isfinite(times)
    for name in values:
        usable &= np.isfinite(numbers(rows, name))
    if "status" in rows.columns:
        usable &= ~rows["status"].is_in(NO_ESTIMATE).fill_null(False).to_numpy()

    paths = {name: truth_paths(frame, name) for name, frame in truths.items()}
    truth = np.full((len(rows), 3), np.nan)
    verdict = np.where(usable, TruthStatus.NO_TRUTH, TruthStatus.NO_ESTIMATE).astype(np.uint8)
    starts = _starts(rows, keys)
    first = rows[starts[:-1]]
    for (a, b), recording, tag in zip(pairwise(starts), first["recording"], first["tag"], strict=True):
        path = paths.get(recording, {}).get(tag)
        if path is not None:
            part = a + np.flatnonzero(usable[a:b])
            truth[part], verdict[part] = interpolated(times[part], *path)
    return Matched(rows, truth, verdict, starts)


def true_bearings(matched: Matched, stations: Mapping[str, Mapping[str, Station]]) -> np.ndarray:
    """Azimuth and elevation (n, 2), rad, of the truth as each row's station sees it; NaN where the row doesn't count.

    `stations`: for each recording its stations by id. Raises UnusableInput for a station the rig doesn't know.
    """
    angles = np.full((len(matched.rows), 2), np.nan)
    first = matched.rows[matched.starts[:-1]]
    for (a, b), recording, ident in zip(pairwise(matched.starts), first["recording"], first["station"], strict=True):
        part = a + np.flatnonzero(matched.counts[a:b])
        known = stations.get(recording, {})
        if len(part) and ident not in known:
            raise UnusableInput(
                f"the tracks of recording '{recording}': station '{ident}' is not in its rig; found "
                f"{', '.join(known) or 'no stations'}; give the recording that was tracked as --truth"
            )
        if len(part):
            angles[part] = known[ident].angles(matched.truth[part])
    return angles


def read_tracks(folder: Path | str) -> pl.DataFrame:
    """The estimates that `trackwright track` wrote into the folder; raises UnusableInput where there are none."""
    path = Path(folder) / "tracks.parquet"
    if not path.is_file():
        raise UnusableInput(
            f"{path}: no such file; expected a folder with tracks.parquet; give the --out of `trackwright track`"
        )
    try:
        tracks = pl.read_parquet(path)
    except (pl.exceptions.PolarsError, OSError) as error:
        raise UnusableInput(
            f"{path}: unreadable ({str(error).splitlines()[0]}); expected a Parquet table; run `track` again"
        ) from error
    if tracks.is_empty():
        raise UnusableInput(
            f"{path}: the table is empty; expected one row per estimate; look at what `trackwright track` said"
        )
    return tracks


def numbers(frame: pl.DataFrame, name: str) -> np.ndarray:
    """A column as float64 with NaN for what is missing; all NaN where the table has no such column."""
    if name not in frame.columns:
        return np.full(len(frame), np.nan)
    return frame[name].cast(pl.Float64).fill_null(np.nan).to_numpy()


def truth_paths(truth: pl.DataFrame, recording: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """For each tag the times (n,) and places (n, 3) of its truth, one row a time; rows without x or y are holes."""
    _require(truth, ["t_s", "tag", "x_m", "y_m"], f"the truth of recording '{recording}'")
    ordered = (
        truth.with_columns(pl.col("tag").cast(pl.String))
        .filter(pl.all_horizontal(pl.col("t_s", "x_m", "y_m").is_finite()))
        .unique(["tag", "t_s"], keep="first", maintain_order=True)
        .sort(["tag", "t_s"])
    )
    times = numbers(ordered, "t_s")
    places = np.stack([numbers(ordered, axis) for axis in ("x_m", "y_m", "z_m")], axis=1)
    starts = _starts(ordered, ["tag"])
    tags = ordered["tag"].gather(starts[:-1]).to_list()
    return {tag: (times[a:b], places[a:b]) for tag, (a, b) in zip(tags, pairwise(starts), strict=True)}


def interpolated(at: np.ndarray, times: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Truth (n, 3) and verdict (n,) at the times `at`, from a path of at least one row."""
    verdict = np.full(len(at), TruthStatus.COUNTS, np.uint8)
    place = np.stack([np.interp(at, times, axis) for axis in places.T], axis=1)
    if len(times) > 1:
        moved = np.sqrt(np.nansum(np.diff(places, axis=0) ** 2, axis=1))
        hole = (np.diff(times) > HOLE_S) & (moved > HOLE_M)
        after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
        verdict[hole[after - 1] & (times[after - 1] < at) & (at < times[after])] = TruthStatus.HOLE
    verdict[(at < times[0]) | (at > times[-1])] = TruthStatus.NO_TRUTH
    place[verdict != TruthStatus.COUNTS] = np.nan
    return place, verdict


def _starts(rows: pl.DataFrame, keys: list[str]) -> np.ndarray:
    """Where each run of equal keys begins in sorted rows, and the end."""
    if len(rows) == 0:
        return np.zeros(1, int)
    group = rows.select(pl.struct(keys).rle_id()).to_series().to_numpy()
    return np.concatenate([[0], np.flatnonzero(np.diff(group)) + 1, [len(rows)]])


def _require(frame: pl.DataFrame, columns: list[str], what: str) -> None:
    missing = [name for name in columns if name not in frame.columns]
    if missing:
        raise UnusableInput(
            f"{what}: no column {', '.join(missing)}; found {', '.join(frame.columns) or 'none'}; "
            f"expected {', '.join(columns)}; give the table that `trackwright track` wrote or a recording's truth"
        )
    wordy = [name for name in frame.columns if name.endswith(UNITS) and not _holds_numbers(frame.schema[name])]
    if wordy:
        raise UnusableInput(
            f"{what}: column {wordy[0]} holds {frame.schema[wordy[0]]}; expected numbers; write the table anew"
        )
    if _holds_numbers(frame.schema.get("status", pl.String())):
        raise UnusableInput(
            f"{what}: column status holds {frame.schema['status']}; expected words as ok, lost, waiting; "
            "write the words or leave the column out"
        )


def _holds_numbers(kind: pl.DataType) -> bool:
    return kind.is_numeric() or kind == pl.Null
