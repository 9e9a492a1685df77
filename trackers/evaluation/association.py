"""Association of estimates with truth: the true position interpolated at the time of each estimate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.seconds import span
from trackwright.trackers.core.errors import UnusableInput, listed
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.wording import counted
from trackwright.trackers.recordings.columns import float_column, require_columns, run_starts
from trackwright.trackers.recordings.tracks_table import HEADING, NO_ESTIMATE, is_bearing, track_keys
from trackwright.trackers.recordings.truth import TruePaths, TruthStatus


class Association(NamedTuple):
    """Estimates, sorted by track and time, with the truth at each row.

    `rows`: the table of estimates, sorted by recording, tag, station and time. `truth`: (n, 3), m, NaN without truth.
    `truth_status`: (n,) values of `TruthStatus`. `starts`: (g + 1,) first row of each of the g tracks, then n.
    `headings`: (n,) true ones, rad, NaN where they are not known; None for estimates without.
    """

    rows: pl.DataFrame
    truth: np.ndarray
    truth_status: np.ndarray
    starts: np.ndarray
    headings: np.ndarray | None = None

    @property
    def scored(self) -> np.ndarray:
        """Mask (n,) of the rows with both an estimate and a truth."""
        return self.truth_status == TruthStatus.SCORED

    def of_recording(self, name: str) -> Association:
        """The part of one recording, empty if it has no rows."""
        first = self.rows["recording"].gather(self.starts[:-1])
        tracks = np.flatnonzero((first == name).to_numpy())
        begin, stop = (self.starts[tracks[0]], self.starts[tracks[-1] + 1]) if len(tracks) else (0, 0)
        starts = self.starts[tracks[0] : tracks[-1] + 2] - begin if len(tracks) else np.zeros(1, int)
        part = slice(begin, stop)
        headings = None if self.headings is None else self.headings[part]
        return Association(self.rows[part], self.truth[part], self.truth_status[part], starts, headings)

    @classmethod
    def joined(cls, parts: Sequence[Association]) -> Association:
        """The association of all recordings from those of each, in the order of their names."""
        before = np.cumsum([0, *(len(part.rows) for part in parts)])
        starts = [part.starts[:-1] + first for part, first in zip(parts, before, strict=False)]
        return cls(
            pl.concat([part.rows for part in parts]),
            np.concatenate([part.truth for part in parts]),
            np.concatenate([part.truth_status for part in parts]),
            np.concatenate([*starts, before[-1:]]),
            None if parts[0].headings is None else np.concatenate([part.headings for part in parts]),
        )


def associate_truth(tracks: pl.DataFrame, truths: Mapping[str, pl.DataFrame]) -> Association:
    """The estimates with the truth linearly interpolated at their `t_s`.

    There is no truth outside its span, nor in holes longer than `HOLE_S` over which the tag moved more than `HOLE_M`.
    `truths`: by recording, a table of t_s, tag, x_m, y_m and optionally z_m. Raises UnusableInput for missing columns.
    """
    rows, usable, starts = _sorted(tracks)
    paths = {name: TruePaths.of_table(frame, name) for name, frame in truths.items()}
    truth = np.full((len(rows), 3), np.nan)
    status = np.where(usable, TruthStatus.NO_TRUTH, TruthStatus.NO_ESTIMATE).astype(np.uint8)
    headings = np.full(len(rows), np.nan) if HEADING in rows.columns else None
    times = float_column(rows, "t_s")
    recordings, tags = (rows[name].gather(starts[:-1]).to_list() for name in ("recording", "tag"))
    first = [k for k, name in enumerate(recordings) if k == 0 or name != recordings[k - 1]]
    for k, end in pairwise([*first, len(recordings)]):
        path = paths.get(recordings[k])
        if path is not None:
            part = starts[k] + np.flatnonzero(usable[starts[k] : starts[end]])
            # Estimates alone, since other rows may have no time.
            kept = np.searchsorted(part, starts[k : end + 1])
            truth[part], status[part] = path.at(tags[k:end], kept, times[part])
            if headings is not None:
                headings[part] = path.headings_at(tags[k:end], kept, times[part])
    return Association(rows, truth, status, starts, headings)


def associate_paths(tracks: pl.DataFrame, paths: TruePaths) -> Association:
    """As `associate_truth`, of recordings of one tag each, after which the true paths are named."""
    rows, usable, starts = _sorted(tracks)
    truth, status = paths.at(rows["recording"].gather(starts[:-1]).to_list(), starts, float_column(rows, "t_s"))
    if not usable.all():
        truth = np.where(usable[:, None], truth, np.nan)
        status = np.where(usable, status, np.uint8(TruthStatus.NO_ESTIMATE))
    return Association(rows, truth, status, starts)


def _sorted(tracks: pl.DataFrame) -> tuple[pl.DataFrame, np.ndarray, np.ndarray]:
    """The rows sorted by track and time, the mask of those with an estimate, and the first row of each track."""
    values = ["azimuth_rad", "elevation_rad"] if is_bearing(tracks) else ["x_m", "y_m"]
    keys = track_keys(tracks)
    require_columns(tracks, [*keys, "t_s", *values], "the tracks")
    rows, starts = _in_order(tracks.with_columns(pl.col(keys).cast(pl.String)), keys)
    usable = np.isfinite(float_column(rows, "t_s"))
    for name in values:
        usable &= np.isfinite(float_column(rows, name))
    if "status" in rows.columns:
        usable &= ~rows["status"].is_in(NO_ESTIMATE).fill_null(False).to_numpy()
    return rows, usable, starts


def _in_order(rows: pl.DataFrame, keys: list[str]) -> tuple[pl.DataFrame, np.ndarray]:
    """The rows sorted by keys and time, and the first row of each track."""
    starts = run_starts(rows, keys)
    lengths, later = np.diff(starts), np.diff(float_column(rows, "t_s"), prepend=-np.inf) >= 0
    later[starts[:-1]] = True
    runs = rows[starts[:-1]].select(keys).with_row_index("run")
    if not later.all() or runs.select(keys).is_duplicated().any():
        rows = rows.sort([*keys, "t_s"], maintain_order=True)
        return rows, run_starts(rows, keys)
    # Tracks that follow one another are moved as a whole, which takes a third of the time of sorting rows.
    order = runs.sort(keys)["run"].to_numpy()
    moved = np.append(0, np.cumsum(lengths[order]))
    if (np.diff(order) != 1).any():
        rows = rows[np.arange(len(rows)) + np.repeat(starts[:-1][order] - moved[:-1], lengths[order])]
    return rows, moved


def true_bearings(association: Association, stations: Mapping[str, Mapping[str, Station]]) -> np.ndarray:
    """True azimuth and elevation (n, 2), rad, from the station of each row; NaN in rows that are not scored.

    `stations`: by recording, its stations by id. Raises UnusableInput for a station that is missing there.
    """
    angles = np.full((len(association.rows), 2), np.nan)
    scored = association.scored
    for (a, b), recording, ident in _tracks(association.rows, association.starts, "station"):
        part = a + np.flatnonzero(scored[a:b])
        known = stations.get(recording, {})
        if len(part) and ident not in known:
            raise UnusableInput(
                f"the tracks of recording '{recording}': station '{ident}' is not in its rig; found "
                f"{', '.join(known) or 'no stations'}; give the recording that was tracked"
            )
        if len(part):
            angles[part] = known[ident].angles(association.truth[part])
    return angles


def _tracks(rows: pl.DataFrame, starts: np.ndarray, column: str) -> Iterator[tuple[tuple[int, int], str, str]]:
    """Of each track: its first row and end, its recording, and its value of `column`."""
    first = rows[starts[:-1]]
    return zip(pairwise(starts), first["recording"], first[column], strict=True)


def refuse_without_overlap(association: Association, truths: Mapping[str, pl.DataFrame]) -> None:
    """Raises UnusableInput, with the spans and tags of both, where no estimate lies inside a truth."""
    if association.scored.any():
        return
    rows, usable = association.rows, association.truth_status != TruthStatus.NO_ESTIMATE
    expected = "expected estimates inside the span of a truth of the same recording and tag"
    if not usable.any():
        raise UnusableInput(
            f"the tracks: none of {counted(len(rows), 'row')} holds an estimate (waiting, non-finite or empty); "
            f"{expected}; run `trackwright check` on the recording"
        )
    common = sorted(set(rows["recording"]) & set(truths))
    if not common:
        raise UnusableInput(
            f"the tracks are of recording {_names(rows['recording'])}, the truth is of {_names(truths)}; {expected}; "
            "give the recordings that were tracked"
        )
    truth = truths[common[0]]
    raise UnusableInput(
        f"no estimate lies inside a truth: estimates {_span(rows.filter(usable))} of tags {_names(rows['tag'])}, "
        f"truth of '{common[0]}' {_span(truth)} of tags {_names(truth['tag'])}; "
        f"{expected}; compare time bases and tag ids"
    )


def _span(table: pl.DataFrame) -> str:
    times = float_column(table, "t_s")
    return f"from {span(times.min(), times.max())}" if len(times) else "at no time"


def _names(names: Iterable[object]) -> str:
    return listed(sorted({str(name) for name in names})) or "none"
