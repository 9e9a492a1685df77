"""Unlock decisions on the tracks of recordings, at fastening points in a file: `trackwright evaluate --worksteps`."""

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
from trackwright.trackers.recordings.input_file import LARGEST_NUMBER
from trackwright.trackers.recordings.table_file import SUFFIXES, TableFile, read_table_file
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

METRICS = {
    "work_named": "named", "work_right": "right", "work_wrong": "wrong", "work_missed": "missed",
    "work_false": "false", "visits_right": "visits_right", "visits_wrong": "visits_wrong",
}  # fmt: skip
"""The names for `--fail-if` of fractions of `UnlockMetrics`."""

_REQUIRED, _HEIGHT = ("name", "x_m", "y_m"), "z_m"
_EXPECTED = "expected name, x_m, y_m and optionally z_m"


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


def read_points(path: Path) -> FasteningPoints:
    """The fastening points of a `.csv`, `.csv.gz` or `.parquet` file; raises UnusableInput for unusable ones."""
    if not path.is_file():
        raise UnusableInput(f"{path}: no such file; {_EXPECTED} in a {', '.join(SUFFIXES)} file; check the path")
    file = read_table_file(path)
    columns = file.frame.columns
    missing = [c for c in _REQUIRED if c not in columns]
    strange = [c for c in columns if c not in (*_REQUIRED, _HEIGHT)]
    if missing or strange:
        fault = f"no column {missing[0]}" if missing else f"unknown column {strange[0][:30]!r}"
        raise UnusableInput(
            f"{path}: {fault}, found {', '.join(c[:30] for c in columns[:8])}; {_EXPECTED}, metres; rename or remove it"
        )
    names = _names(file)
    axes = [*_REQUIRED[1:], *([_HEIGHT] if _HEIGHT in columns else [])]
    points = FasteningPoints(tuple(names), np.stack([_metres(file, axis) for axis in axes], axis=1))
    if len(names) > 1 and points.spacing() == 0:
        distance = np.linalg.norm(points.positions[:, None] - points.positions, axis=-1)
        one, other = np.argwhere(np.triu(distance == 0, 1))[0]
        raise UnusableInput(
            f"{path}: points '{names[one]}' and '{names[other]}' have the same position; expected different positions; "
            f"remove one{'' if _HEIGHT in columns else ' or give z_m'}"
        )
    return points


def _names(file: TableFile) -> list[str]:
    names = [("" if n is None else str(n)).strip() for n in file.frame["name"].cast(pl.String).to_list()]
    for row, name in enumerate(names):
        if not name:
            raise UnusableInput(f"{file.location(row, 'name')}: empty, expected a name")
        first = names.index(name)
        if first < row:
            raise UnusableInput(
                f"{file.location(row, 'name')}: '{name[:40]}' is a duplicate of row {first + 1}; expected unique "
                "names; rename one"
            )
    return names


def _metres(file: TableFile, column: str) -> np.ndarray:
    cells = file.frame[column]
    texts = cells.cast(pl.String).to_list()
    metres = cells.str.strip_chars().cast(pl.Float64, strict=False) if cells.dtype == pl.String else cells
    if not (metres.dtype.is_numeric() or metres.dtype == pl.Null):
        raise UnusableInput(f"{file.path}: column {column} has type {metres.dtype}, expected numbers in metres")
    values = metres.cast(pl.Float64).fill_null(np.nan).to_numpy()
    wrong = np.flatnonzero(~(np.abs(values) <= LARGEST_NUMBER))
    if len(wrong):
        row = int(wrong[0])
        text = "empty" if not (texts[row] or "").strip() else repr(texts[row][:40])
        raise UnusableInput(
            f"{file.location(row, column)}: {text}, expected a finite number, m, at most {LARGEST_NUMBER:g}; "
            "correct the cell"
        )
    return values
