"""Tracks of recordings beside points of work: `trackwright evaluate --worksteps`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from trackers.core.errors import UnusableInput
from trackers.evaluation import covariances, last_of_every
from trackers.recordings.association import Association, associate_truth
from trackers.recordings.columns import float_column
from trackers.recordings.tracks_table import is_bearing
from trackers.worksteps.decisions import LEVEL, NOWHERE, WorkPoints
from trackers.worksteps.metrics import Bin, Judged, Workstep, calibration, judge, workstep
from trackers.worksteps.points_file import read_points


@dataclass(frozen=True)
class WorkReport:
    """What tracks say of points of work: overall, by recording, by point (None: rows at no point), and calibration.

    `tolerance`, `play` m. `calibrated`: None where no track reports a covariance.
    """

    points: WorkPoints
    tolerance: float
    play: float
    overall: Workstep
    recordings: dict[str, Workstep]
    by_point: dict[str, Workstep]
    calibrated: list[Bin] | None

    def figures(self, name: str | None = None) -> dict[str, float | None]:
        """The shares that `--fail-if` knows, of a recording or overall; None where a share has no rows."""
        w = self.overall if name is None else self.recordings[name]
        shares = {
            "work_named": w.named, "work_right": w.right, "work_wrong": w.wrong, "work_missed": w.missed,
            "work_false": w.false, "visits_right": w.visits_right, "visits_wrong": w.visits_wrong,
        }  # fmt: skip
        return {key: None if np.isnan(s.value) else s.value for key, s in shares.items()}

    def plain(self) -> dict[str, Any]:
        """Everything as plain numbers, for JSON."""
        return {
            "points": dict(zip(self.points.names, self.points.places.tolist(), strict=True)),
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


def work_report(
    tracks: pl.DataFrame,
    truths: Mapping[str, pl.DataFrame],
    path: Path,
    tolerance: float | None,
    every: float | None = None,
) -> WorkReport:
    """The report on the points in the file `path`; `tolerance` m, by default half the points' spacing.

    `every`: s, judge only the last estimate in every so many seconds.

    A tip counts as being at a point anywhere within the tolerance: its play is half of that, as the standard deviation
    per axis of places spread evenly over a disc. Raises UnusableInput for points or tracks that cannot be used.
    """
    points = read_points(path)
    if tolerance is not None and not (np.isfinite(tolerance) and tolerance > 0):
        raise UnusableInput(f"--tolerance {tolerance}: expected a number of metres above 0")
    if is_bearing(tracks):
        raise UnusableInput("--worksteps: the tracks are bearings, expected positions; track with another --tracker")
    association = associate_truth(tracks, truths)
    d = points.dimensions
    means = np.stack([float_column(association.rows, f"{axis}_m") for axis in "xyz"[:d]], axis=1)
    placed = np.isfinite(means).all(axis=1) & np.isfinite(association.truth[:, :d]).all(axis=1)
    counted = last_of_every(association, every) if every else np.flatnonzero(association.scored)
    kept = counted[placed[counted]]
    if not len(kept):
        raise UnusableInput(
            f"{path}: has z_m, but no estimate with a height meets a truth with one; expected heights in both; "
            "leave the column z_m out to compare over the floor"
        )
    within = points.tolerance() if tolerance is None else tolerance
    covs = covariances(association.rows[kept])[:, :d, :d]
    starts = np.searchsorted(kept, association.starts[:-1])
    judged = judge(means[kept], covs, association.truth[kept, :d], starts, points, within, within / 2)
    _refuse_without_work(judged, association.truth[kept, :d], points, within, path)
    return _report(association, kept, judged, points, within, bool(np.isfinite(covs).any()))


def _report(
    association: Association, kept: np.ndarray, judged: Judged, points: WorkPoints, within: float, believes: bool
) -> WorkReport:
    names = association.rows["recording"].to_numpy()[kept]
    recordings = {str(name): workstep(judged.part(names == name)) for name in dict.fromkeys(names)}
    by_point = {
        name: workstep(judged.part(judged.at == k)) for k, name in enumerate(points.names) if (judged.at == k).any()
    }
    bins = calibration(judged) if believes else None
    return WorkReport(points, within, within / 2, workstep(judged), recordings, by_point, bins)


def _refuse_without_work(judged: Judged, truth: np.ndarray, points: WorkPoints, within: float, path: Path) -> None:
    if (judged.at != NOWHERE).any():
        return
    nearest = min(float(np.linalg.norm(truth - place, axis=1).min()) for place in points.places)
    raise UnusableInput(
        f"{path}: no truth comes within {within:g} m of any of the {len(points.names)} points, the nearest passes at "
        f"{nearest:.4g} m; expected points in metres in the frame of the truth; check units and origin, or --tolerance"
    )


def _named(w: Workstep) -> dict[str, Any]:
    plain = {name: getattr(w, name) for name in asdict(w)}
    return {name: x._asdict() if hasattr(x, "_asdict") else x for name, x in plain.items()}
