"""Unlock decisions on the tracks of recordings: `trackwright evaluate --worksteps`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.association import Association, associate_truth
from trackwright.trackers.evaluation.scoring import covariances, last_of_every
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import is_bearing
from trackwright.trackers.worksteps.decisions import LEVEL, NO_POINT, FasteningPoints
from trackwright.trackers.worksteps.metrics import (
    CalibrationBin,
    ScoredDecisions,
    UnlockMetrics,
    calibration,
    score,
    unlock_metrics,
)
from trackwright.trackers.worksteps.points_file import read_points

METRICS = {
    "work_named": "named", "work_right": "right", "work_wrong": "wrong", "work_missed": "missed",
    "work_false": "false", "visits_right": "visits_right", "visits_wrong": "visits_wrong",
}  # fmt: skip
"""The names for `--fail-if` of fractions of `UnlockMetrics`."""


@dataclass(frozen=True)
class WorkstepReport:
    """Unlock decisions scored overall, by recording and by point, and their calibration.

    `tolerance`, `play` m. `calibrated`: None where no track has a covariance.
    """

    points: FasteningPoints
    tolerance: float
    play: float
    overall: UnlockMetrics
    recordings: dict[str, UnlockMetrics]
    by_point: dict[str, UnlockMetrics]
    calibrated: list[CalibrationBin] | None

    def metrics(self, name: str | None = None) -> dict[str, float | None]:
        """The fractions for `--fail-if`, of a recording or overall; None without rows."""
        w = self.overall if name is None else self.recordings[name]
        shares = {key: getattr(w, share) for key, share in METRICS.items()}
        return {key: None if np.isnan(s.value) else s.value for key, s in shares.items()}

    def plain(self) -> dict[str, Any]:
        """Everything as plain numbers, for `evaluation.json`."""
        return {
            "points": dict(zip(self.points.names, self.points.positions.tolist(), strict=True)),
            "tolerance_m": self.tolerance,
            "play_m": self.play,
            "level": LEVEL,
            "overall": _named(self.overall),
            "recordings": {name: _named(w) for name, w in self.recordings.items()},
            "by_point": {name: _named(w) for name, w in self.by_point.items()},
            "calibration": None
            if self.calibrated is None
            else [
                {"low": b.low, "high": b.high, "claimed": b.claimed, "right": b.right._asdict()}
                for b in self.calibrated
            ],
        }


def workstep_report(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    path: Path,
    tolerance: float | None,
    every: float | None = None,
) -> WorkstepReport:
    """The report on the fastening points in the file `path`.

    `tolerance` m, by default half the points' spacing. `every`: s, score only the last estimate of each such interval.
    The tip is at a point if it is within the tolerance; the play is half of that, the standard deviation per axis of a
    uniform distribution over the disc. Raises UnusableInput for points or tracks that cannot be used.
    """
    points = read_points(path)
    if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0):
        raise UnusableInput(f"tolerance {tolerance}: expected a number of metres above 0")
    if is_bearing(tracks):
        raise UnusableInput("work steps: the tracks are bearings; expected positions; use a tracker of positions")
    association = associate_truth(tracks, truths)
    d = points.dimensions
    means = np.stack([float_column(association.rows, f"{axis}_m") for axis in "xyz"[:d]], axis=1)
    placed = np.isfinite(means).all(axis=1) & np.isfinite(association.truth[:, :d]).all(axis=1)
    counted = last_of_every(association, every) if every else np.flatnonzero(association.scored)
    kept = counted[placed[counted]]
    if not len(kept):
        raise UnusableInput(
            f"{path}: has z_m, but no row has a height in both track and truth; expected heights in both; "
            "remove the column z_m to compare horizontally"
        )
    within = points.tolerance() if tolerance is None else tolerance
    covs = covariances(association.rows[kept])[:, :d, :d]
    starts = np.searchsorted(kept, association.starts[:-1])
    scored = score(means[kept], covs, association.truth[kept, :d], starts, points, within, within / 2)
    _require_a_visit(scored, association.truth[kept, :d], points, within, path)
    return _report(association, kept, scored, points, within, bool(np.isfinite(covs).any()))


def _report(
    association: Association,
    kept: np.ndarray,
    scored: ScoredDecisions,
    points: FasteningPoints,
    within: float,
    has_covariance: bool,
) -> WorkstepReport:
    names = association.rows["recording"].to_numpy()[kept]
    recordings = {str(name): unlock_metrics(scored.part(names == name)) for name in dict.fromkeys(names)}
    by_point = {
        name: unlock_metrics(scored.part(scored.at == k))
        for k, name in enumerate(points.names)
        if (scored.at == k).any()
    }
    bins = calibration(scored) if has_covariance else None
    return WorkstepReport(points, within, within / 2, unlock_metrics(scored), recordings, by_point, bins)


def _require_a_visit(
    scored: ScoredDecisions, truth: np.ndarray, points: FasteningPoints, within: float, path: Path
) -> None:
    if (scored.at != NO_POINT).any():
        return
    nearest = min(float(np.linalg.norm(truth - position, axis=1).min()) for position in points.positions)
    raise UnusableInput(
        f"{path}: the true path never comes within {within:g} m of any of the {len(points.names)} points, its "
        f"smallest distance is {nearest:.4g} m; expected points in metres in the frame of the truth; check units and "
        "origin, or the tolerance"
    )


def _named(w: UnlockMetrics) -> dict[str, Any]:
    plain = {name: getattr(w, name) for name in asdict(w)}
    return {name: x._asdict() if hasattr(x, "_asdict") else x for name, x in plain.items()}
