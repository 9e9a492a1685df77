"""Error metrics of estimates against truth, by track, by recording and overall.

Names are those of `--fail-if` and of evaluation.json, in metres and radians, horizontal unless the name has `3d`. A
metric without data (no heights, no reported covariance) is None.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
import polars as pl

from trackers.core import metrics
from trackers.core.errors import UnusableInput, one_or_more
from trackers.core.estimates import Estimates, numbered_names
from trackers.core.frames import evaluation_html, evaluation_text
from trackers.core.recording import Recording
from trackers.core.rig import Station
from trackers.core.wording import counted
from trackers.evaluation.association import Association, associate_truth, refuse_without_overlap
from trackers.evaluation.rank_correlation import LAGS_S, RankSums
from trackers.evaluation.residuals import residual_ratios
from trackers.evaluation.scoring import Scored, outside_plane, score
from trackers.evaluation.statements import covariance_statements
from trackers.recordings.columns import require_columns
from trackers.recordings.folder import RecordingFolder, refuse_same_names
from trackers.recordings.tracks import Tracks
from trackers.recordings.tracks_table import is_bearing, track_keys
from trackers.recordings.truth import TruthStatus

T = TypeVar("T")
OneOrMore = RecordingFolder | Recording | Sequence[RecordingFolder] | Sequence[Recording]

LEVELS = (50, 68, 90, 95, 99)
"""Levels, %, of the ellipses whose share of the truth is a metric."""

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

    def with_residuals(self, tracks: Tracks) -> Evaluation:
        """This evaluation with the metric `residual_ratio_5s` of each recording, and the largest overall."""
        ratios, name = residual_ratios(tracks), "residual_ratio_5s"
        own = [one | {name: ratios.get(one["recording"])} for one in self.recordings]
        return replace(self, overall=self.overall | {name: max(ratios.values(), default=None)}, recordings=own)

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
    executor: Executor | None = None,
) -> Evaluation:
    """The error metrics of estimates against the truth of their recordings, interpolated at the times of the estimates.

    `estimates`: `Tracks`, a table with the columns of tracks.parquet, the `Estimates` of `Recording`s whose truth is a
    `position`, or the `Association` of any of these. `every`: s, score only the last estimate in each interval of that
    length. `executor`: associates and scores each recording of a table there, to the same bits. Recordings in arrays of
    one name are told apart by their place, which must be that of the run. Raises UnusableInput if no recording has a
    truth, or no estimate lies inside that of its recording and tag, and for two folders of one name.
    """
    stations = {f.name: f.rig.stations for f in _several(recordings) if isinstance(f, RecordingFolder)}
    if executor is not None and isinstance(estimates, pl.DataFrame):
        truths = _required_truths(recordings)
        require_columns(estimates, ["recording"], "the tracks")
        by_name = estimates.with_columns(pl.col("recording").cast(pl.String)).partition_by("recording", as_dict=True)
        parts = [
            executor.submit(_scored_recording, by_name[name,], _of(name, truths), _of(name, stations), every)
            for name in sorted(str(name) for (name,) in by_name)
        ]
        done = [part.result() for part in parts]
        association, scored = Association.joined([x for x, _ in done]), Scored.joined([x for _, x in done])
        refuse_without_overlap(association, truths)
        return evaluation_of(association, scored)
    association = estimates if isinstance(estimates, Association) else associate(estimates, recordings)
    if not association.scored.any():
        refuse_without_overlap(association, _truths(recordings))
    found = evaluate_association(association, stations, every)
    return found.with_residuals(estimates) if isinstance(estimates, Tracks) else found


def _of(name: str, values: Mapping[str, T]) -> dict[str, T]:
    """The entry of this name alone, if there is one."""
    return {name: values[name]} if name in values else {}


def _scored_recording(
    rows: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    stations: Mapping[str, Mapping[str, Station]],
    every: float | None,
) -> tuple[Association, Scored]:
    """The estimates of one recording with their truth, and their scores."""
    association = associate_truth(rows, truths)
    return association, score(association, stations, every)


def associate(estimates: Tracks | Estimates | pl.DataFrame, recordings: OneOrMore) -> Association:
    """The estimates with the true position at the time of each; `evaluate` accepts the result, and so do plots.

    Arguments as of `evaluate`. Raises UnusableInput if no recording has a truth.
    """
    truths = _required_truths(recordings)
    if isinstance(estimates, Estimates):
        _refuse_other_places(estimates.names, [recording.name for recording in _several(recordings)])
        # an array recording has one trajectory, so its name identifies it
        return associate_truth(estimates.to_polars().with_columns(tag=pl.lit("")), truths)
    return associate_truth(estimates.to_polars() if isinstance(estimates, Tracks) else estimates, truths)


def _required_truths(recordings: OneOrMore) -> dict[str, pl.DataFrame]:
    truths = _truths(recordings)
    if not truths:
        names = ", ".join(str(getattr(r, "path", None) or r.name) for r in _several(recordings))
        raise UnusableInput(f"{names}: no truth table, expected one to evaluate against; give recordings that have one")
    return truths


def _several(recordings: OneOrMore) -> list[RecordingFolder | Recording]:
    kinds: tuple[type[RecordingFolder | Recording], ...] = (RecordingFolder, Recording)
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
    refuse_same_names([one.name for one in several if isinstance(one, RecordingFolder)])
    truths = {}
    for name, recording in zip(numbered_names([one.name for one in several]), several, strict=True):
        if isinstance(recording, RecordingFolder):
            if "truth" in recording.tables:
                truths[name] = recording.tables["truth"]
        elif "position" in recording.truth:
            truths[name] = _true_positions(recording)
    return truths


def _true_positions(recording: Recording) -> pl.DataFrame:
    """The truth of an array recording as a truth table."""
    values, known = recording.truth["position"]
    axes = {f"{a}_m": x for a, x in zip("xyz", np.asarray(values, float)[known].T, strict=False)}
    none = {f"{a}_m": np.full(int(np.sum(known)), np.nan) for a in "xyz"}
    return pl.DataFrame({"t_s": recording.times[known], "tag": [""] * int(np.sum(known))} | none | axes)


def evaluate_table(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
) -> Evaluation:
    """As `evaluate`, of tables; the metrics of a recording and overall are taken over the rows of all its tracks.

    `tracks`: the columns of tracks.parquet. `truths`: by recording, the columns of a truth table. `stations`: by
    recording, its stations by id, required for bearings. `every`: s, score only the last estimate in each interval of
    that length. Raises UnusableInput if no estimate lies inside the truth of its recording and tag.
    """
    association = associate_truth(tracks, truths)
    refuse_without_overlap(association, truths)
    return evaluate_association(association, stations, every)


def evaluate_association(
    association: Association,
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
) -> Evaluation:
    """As `evaluate_table`, of estimates already associated with truth; metrics are None if no row is scored."""
    return evaluation_of(association, score(association, stations, every))


def metric_names(tracks: pl.DataFrame) -> list[str]:
    """The names of the metrics that such estimates, the columns of tracks.parquet, have overall."""
    return list(evaluate_association(associate_truth(tracks.head(1), {})).overall)


def evaluation_of(association: Association, scored: Scored) -> Evaluation:
    """The metrics by track, by recording and overall of estimates that are associated and scored."""
    keys = association.rows.select(track_keys(association.rows))[association.starts[:-1]].to_dicts()
    last = len(keys)
    first = [k for k in range(last) if k == 0 or keys[k]["recording"] != keys[k - 1]["recording"]]
    # A recording of one track has the metrics of that.
    of = cache(partial(_metrics, association, scored))
    recordings = [{"recording": keys[a]["recording"], **of(a, b)} for a, b in pairwise([*first, last])]
    per_track = [{**key, **of(k, k + 1)} for k, key in enumerate(keys)]
    return Evaluation(is_bearing(association.rows), of(0, last), recordings, per_track)


def _metrics(association: Association, scored: Scored, first: int, end: int) -> Metrics:
    """The metrics of the tracks `first` … `end` − 1."""
    begin, stop = association.starts[first], association.starts[end]
    part = slice(*np.searchsorted(scored.index, (begin, stop)))
    counts = np.bincount(association.truth_status[begin:stop], minlength=len(TruthStatus)).tolist()
    found: Metrics = {
        "n": int(part.stop - part.start),
        "n_rows": int(stop - begin),
        "n_no_estimate": counts[TruthStatus.NO_ESTIMATE],
        "n_no_truth": counts[TruthStatus.NO_TRUTH],
        "n_hole": counts[TruthStatus.HOLE],
    }
    errors = scored.errors[part]
    if scored.angle is None:
        found |= _errors_of(errors)
    else:
        found |= _errors_of_bearings(scored.angle[part], errors[outside_plane(association, scored.index[part])])
    found |= _consistency(scored.nees[part], 2, "")
    if scored.nees_3d is not None:
        found |= _consistency(scored.nees_3d[part], 3, "_3d")
    nis, freedom = float(scored.nis[begin:stop].sum()), float(scored.dof[begin:stop].sum())
    lost = scored.lost[first:end].sum(axis=0).tolist()
    found |= innovations_and_loss(nis, freedom, scored.nis_ranks.of_tracks(first, end), lost, int(stop - begin))
    return {name: None if value != value else value for name, value in found.items()}


def innovations_and_loss(nis: float, freedom: float, ranks: RankSums, lost: Sequence[float], n_rows: int) -> Metrics:
    """The metrics of innovations and track loss from sums over tracks; `lost`: seconds, span, s, rows, losses."""
    seconds, span, rows, losses = lost
    return {
        "nis_ratio": nis / freedom if freedom > 0 else None,
        **{f"nis_correlation_{name}": r for name, r in zip(LAGS_S, ranks.correlations().tolist(), strict=True)},
        "nis_inflation_1s": ranks.inflation(),
        "residual_ratio_5s": None,
        "lost_s": seconds,
        "lost_fraction": seconds / span if span > 0 else rows / n_rows,
        "losses": int(losses),
    }


def _errors_of(errors: np.ndarray) -> Metrics:
    """Of errors (n, 3), m."""
    solid = errors[np.isfinite(errors[:, 2])]
    means = [*metrics.bias(errors[:, :2]).tolist(), float(metrics.bias(solid)[2])]
    bias = dict(zip(("bias_x_m", "bias_y_m", "bias_z_m"), means, strict=True))
    return _named({"_m": errors[:, :2], "_3d_m": solid}) | bias


def _errors_of_bearings(angle: np.ndarray, errors: np.ndarray) -> Metrics:
    """Of angles between directions (n, 1), and of azimuths and elevations (m, 2) outside the plane of an array, rad."""
    bias = dict(zip(("bias_azimuth_rad", "bias_elevation_rad"), metrics.bias(errors).tolist(), strict=True))
    return _named({"_direction_rad": angle, "_azimuth_rad": errors[:, :1], "_elevation_rad": errors[:, 1:]}) | bias


def _named(errors: Mapping[str, np.ndarray]) -> Metrics:
    """The error metrics, with these suffixes."""
    return {
        name + suffix: value
        for suffix, values in errors.items()
        for name, value in metrics.error_metrics(values)._asdict().items()
    }


def _consistency(nees: np.ndarray, dof: int, suffix: str) -> Metrics:
    known = nees[np.isfinite(nees)]
    mean = float(known.mean()) if len(known) else None
    return {
        f"nees{suffix}_mean": mean,
        f"nees{suffix}_ratio": None if mean is None else mean / dof,
        f"sigma_factor{suffix}": metrics.sigma_factor(known, dof),
        **{f"coverage_{percent}{suffix}": metrics.covered(known, dof, percent / 100) for percent in LEVELS},
    }
