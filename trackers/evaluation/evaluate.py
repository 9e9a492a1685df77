"""Error metrics of estimates against truth, by track, by recording and overall.

A metric without data (no heights, no reported covariance) is None.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.frames import evaluation_html, evaluation_text
from trackwright.trackers.core.errors import UnusableInput, one_or_more
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.core.wording import counted, numbered_names
from trackwright.trackers.evaluation.association import (
    Association,
    associate_paths,
    associate_truth,
    refuse_without_overlap,
)
from trackwright.trackers.evaluation.metrics import RESIDUALS, MetricRows
from trackwright.trackers.evaluation.scores import Scores
from trackwright.trackers.evaluation.scoring import score, scores_of_tracks
from trackwright.trackers.evaluation.statements import covariance_statements
from trackwright.trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackwright.trackers.recordings.tracks_table import is_bearing, track_keys
from trackwright.trackers.recordings.truth import TruePaths

# Tables are evaluated without jax, which takes as long to import as most of them to evaluate.
if TYPE_CHECKING:
    from trackwright.trackers.core.data.estimates import Estimates
    from trackwright.trackers.core.data.recording import Recording
    from trackwright.trackers.recordings.tracks import Tracks

    OneOrMore = RecordingFolder | Recording | Iterable[RecordingFolder | Recording]

Metrics = dict[str, Any]
"""Metrics by name; in lists by recording and by track also `recording`, `tag` and `station`."""


@dataclass(frozen=True, repr=False)
class Evaluation:
    """Error metrics over all rows, by recording and by track; `bearing`: of bearings, not of positions.

    `metrics["rmse_m"]` is a metric over all rows; names as in docs/formats.md.
    """

    bearing: bool
    overall: Metrics
    recordings: Sequence[Metrics]
    tracks: Sequence[Metrics]

    def __getitem__(self, metric: str) -> Any:
        if metric not in self.overall:
            raise KeyError(f"no metric '{metric}'; there are {', '.join(self.overall)}")
        return self.overall[metric]

    @property
    def statements(self) -> list[str]:
        """Sentences on whether the reported covariances hold; without truth, on what the innovations show."""
        return covariance_statements(self.overall, self.recordings)

    def to_polars(self) -> pl.DataFrame:
        """A table with one row per track and one column per metric."""
        return pl.DataFrame(self.tracks, infer_schema_length=None)

    _repr_html_ = evaluation_html

    __str__ = evaluation_text

    def __repr__(self) -> str:
        name = "rmse_direction_rad" if self.bearing else "rmse_m"
        known = "" if self.overall[name] is None else f", {name} {self.overall[name]:.4g}"
        counts = f"{counted(self.overall['n'], 'estimate')}, {counted(len(self.tracks), 'track')}"
        return f"<Evaluation of {counts}{known}; print it for a table>"


def evaluate(
    estimates: Tracks | Estimates | pl.DataFrame | Association,
    recordings: OneOrMore,
    every: float | None = None,
) -> Evaluation:
    """The error metrics of estimates against the truth of their recordings, interpolated at the times of the estimates.

    `estimates`: `Tracks`, a table with the columns of tracks.parquet, the `Estimates` of `Recording`s whose truth is a
    `position`, or the `Association` of any of these. `every`: s, score only the last estimate in each interval of that
    length. Recordings in arrays of one name are told apart by their place, which must be that of the run. Raises
    UnusableInput if no recording has a truth, or no estimate lies inside that of its recording and tag, and for two
    folders of one name.
    """
    recordings = _several(recordings)
    stations = {f.name: f.rig.stations for f in recordings if isinstance(f, RecordingFolder)}
    association = estimates if isinstance(estimates, Association) else associate(estimates, recordings)
    if not association.scored.any():
        refuse_without_overlap(association, _truths(recordings))
    return evaluate_association(association, stations, every, _ratios(estimates))


def _ratios(estimates: Tracks | Estimates | pl.DataFrame | Association) -> dict[str, tuple[float, float]]:
    """The `residual_ratios` of tracks; none of estimates without their readings."""
    if isinstance(estimates, pl.DataFrame | Association):
        return {}
    from trackwright.trackers.evaluation.residuals import residual_ratios
    from trackwright.trackers.recordings.tracks import Tracks

    return residual_ratios(estimates) if isinstance(estimates, Tracks) else {}


class TrackScores(NamedTuple):
    """The scores of tracks: the `keys` that identify each, and whether they are bearings."""

    keys: pl.DataFrame
    bearing: bool
    scores: Scores

    @classmethod
    def of(
        cls, association: Association, stations: Mapping[str, Mapping[str, Station]] | None, every: float | None = None
    ) -> TrackScores:
        """The tracks of associated estimates; `stations`, `every` as in `evaluate_association`."""
        rows = association.rows
        keys = rows.select(track_keys(rows))[association.starts[:-1]]
        return cls(keys, is_bearing(rows), scores_of_tracks(association, score(association, stations, every)))

    def recordings(self, ratios: Mapping[str, tuple[float, float]]) -> tuple[list[str], Scores]:
        """The names of the recordings and their scores; `ratios`: of their residuals, see `residual_ratios`."""
        names = self.keys["recording"].to_list()
        first = [k for k, name in enumerate(names) if k == 0 or name != names[k - 1]]
        single = len(first) == len(names)
        scores = self.scores if single else self.scores.grouped(np.array([*first, len(names)]))
        recordings = [names[k] for k in first]
        columns = np.array([ratios.get(name, (np.nan, np.nan)) for name in recordings]).T
        return recordings, replace(scores, largest={**scores.largest, **dict(zip(RESIDUALS, columns, strict=True))})

    def evaluation(self, ratios: Mapping[str, tuple[float, float]] | None = None) -> Evaluation:
        """The metrics by track, by recording and overall."""
        names, recordings = self.recordings(ratios or {})
        (overall,) = MetricRows(recordings.grouped(np.array([0, len(names)])))
        tracks = MetricRows(self.scores, self.keys.to_dict(as_series=False))
        return Evaluation(self.bearing, overall, MetricRows(recordings, {"recording": names}), tracks)


def associate(estimates: Tracks | Estimates | pl.DataFrame, recordings: OneOrMore) -> Association:
    """The estimates with the true position at the time of each; `evaluate` accepts the result, and so do plots.

    Arguments as of `evaluate`. Raises UnusableInput if no recording has a truth.
    """
    several = _several(recordings)
    if isinstance(estimates, pl.DataFrame):
        return associate_truth(estimates, _required_truths(several))
    from trackwright.trackers.core.data.estimates import Estimates

    if isinstance(estimates, Estimates):
        _refuse_other_places(estimates.names, [recording.name for recording in several])
        table = estimates.to_polars().with_columns(tag=pl.lit(""))
        arrays = [recording for recording in several if not isinstance(recording, RecordingFolder)]
        if len(arrays) == len(several) and any("position" in recording.truth for recording in arrays):
            return associate_paths(table, _true_paths(arrays))
        return associate_truth(table, _required_truths(several))
    return associate_truth(estimates.to_polars(), _required_truths(several))


def _required_truths(recordings: OneOrMore) -> dict[str, pl.DataFrame]:
    truths = _truths(recordings)
    if not truths:
        names = ", ".join(str(getattr(r, "path", None) or r.name) for r in _several(recordings))
        raise UnusableInput(f"{names}: no truth table, expected one to evaluate against; give recordings that have one")
    return truths


def _several(recordings: OneOrMore) -> list[RecordingFolder | Recording]:
    # Of recording folders alone jax need not be imported.
    kinds: tuple[type[RecordingFolder | Recording], ...] = (RecordingFolder,)
    if not (isinstance(recordings, Sequence) and all(isinstance(r, RecordingFolder) for r in recordings)):
        from trackwright.trackers.core.data.recording import Recording

        kinds = (RecordingFolder, Recording)
    return one_or_more(recordings, kinds, "recordings as the second argument, evaluate(estimates, recordings)")


def _refuse_other_places(estimated: Sequence[str], given: Sequence[str]) -> None:
    """Raises UnusableInput for recordings of one name that are not those of the run in its order."""
    if len(set(estimated)) < len(estimated) and list(estimated) != list(given):
        name, count = Counter(estimated).most_common(1)[0]
        raise UnusableInput(
            f"evaluate: {count} recordings of the run are named '{name}', which their places alone tell apart; "
            "expected the same recordings in the same order; or give each a `name` where it is made"
        )


def _truths(recordings: OneOrMore) -> dict[str, pl.DataFrame]:
    """The truth tables of the recordings that have one, by name."""
    several = _several(recordings)
    refuse_same_names([recording.name for recording in several if isinstance(recording, RecordingFolder)])
    truths = {}
    for name, recording in zip(numbered_names([recording.name for recording in several]), several, strict=True):
        if isinstance(recording, RecordingFolder):
            if "truth" in recording.tables:
                truths[name] = recording.tables["truth"]
        elif "position" in recording.truth:
            truths[name] = _true_positions(recording)
    return truths


def _true_paths(recordings: Sequence[Recording]) -> TruePaths:
    """The true paths of recordings in arrays, each of one trajectory, which its name identifies."""
    numbered, true = numbered_names([r.name for r in recordings]), [r for r in recordings if "position" in r.truth]
    names = [name for name, r in zip(numbered, recordings, strict=True) if "position" in r.truth]
    values, known = zip(*(r.truth["position"] for r in true), strict=True)
    times, known, lengths = np.concatenate([r.times for r in true]), np.concatenate(known), [len(r) for r in true]
    dimensions = np.array([x.shape[1] for x in values])
    if (dimensions == 3).all():
        positions = np.concatenate(values)
    else:
        positions = np.full((len(times), 3), np.nan)
        for d in set(dimensions.tolist()):
            positions[np.repeat(dimensions == d, lengths), :d] = np.concatenate([x for x in values if x.shape[1] == d])
    starts = np.append(0, np.cumsum(lengths))
    # Of known rows of one time the first counts, as in a table.
    kept = np.flatnonzero(known)
    first = np.searchsorted(kept, starts[:-1])
    later = np.diff(times[kept], prepend=-np.inf) > 0
    later[first[first < len(kept)]] = True
    if len(kept) < len(times) or not later.all():
        kept = kept[later]
        starts, times, positions = np.searchsorted(kept, starts), times[kept], positions[kept]
        # A truth that is known in no row is no path.
        names = [name for name, some in zip(names, np.diff(starts) > 0, strict=True) if some]
    return TruePaths(names, np.unique(starts), times, positions)


def _true_positions(recording: Recording) -> pl.DataFrame:
    """The truth of an array recording as a truth table."""
    values, known = recording.truth["position"]
    axes = {f"{a}_m": x for a, x in zip("xyz", np.asarray(values, float)[known].T, strict=False)}
    none = {f"{a}_m": np.full(int(np.sum(known)), np.nan) for a in "xyz"}
    return pl.DataFrame({"t_s": recording.times[known], "tag": [""] * int(np.sum(known))} | none | axes)


def evaluate_association(
    association: Association,
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
    ratios: Mapping[str, tuple[float, float]] | None = None,
) -> Evaluation:
    """As `evaluate`, of estimates already associated with truth; metrics are None if no row is scored.

    `stations`: by recording, its stations by id, required for bearings. `ratios`: by recording, those of
    `residual_ratios`.
    """
    return TrackScores.of(association, stations, every).evaluation(ratios)


def metric_names(tracks: pl.DataFrame) -> list[str]:
    """The names of the metrics that such estimates, the columns of tracks.parquet, have overall."""
    return list(evaluate_association(associate_truth(tracks.head(1), {})).overall)
