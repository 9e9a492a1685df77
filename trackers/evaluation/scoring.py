"""Errors, NEES, NIS and track loss of estimates that are associated with truth: the arrays behind all error metrics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import polars as pl

from trackers.core import metrics
from trackers.core.rig import Station
from trackers.evaluation.association import Association, true_bearings
from trackers.evaluation.rank_correlation import RankSums, rank_sums
from trackers.recordings.columns import float_column
from trackers.recordings.tracks_table import is_bearing


@dataclass(frozen=True)
class Scored:
    """Errors of the scored rows, and consistency and track loss of all rows.

    Of the n scored rows: `index`, their position in the association; `errors` (n, 3), m, or of bearings (n, 2), rad;
    `angle` (n, 1), rad, of bearings the angle between estimated and true direction, else None; `nees` of the horizontal
    position or of both angles; `nees_3d`, None for bearings. Of all rows: `nis` and `dof`, zero without a measurement.
    Of the g tracks: `nis_ranks`, for the autocorrelation of NIS, and `lost` (g, 4), seconds lost, seconds spanned, rows
    lost, number of losses.
    """

    index: np.ndarray
    errors: np.ndarray
    angle: np.ndarray | None
    nees: np.ndarray
    nees_3d: np.ndarray | None
    nis: np.ndarray
    dof: np.ndarray
    nis_ranks: RankSums
    lost: np.ndarray

    @classmethod
    def joined(cls, parts: Sequence[Scored]) -> Scored:
        """The scores of all recordings from those of each, in the order of the rows of the joined association."""
        before = np.cumsum([0, *(len(part.nis) for part in parts)])

        def all_of(name: str) -> np.ndarray:
            return np.concatenate([getattr(part, name) for part in parts])

        return cls(
            index=np.concatenate([part.index + n for part, n in zip(parts, before, strict=False)]),
            errors=all_of("errors"),
            angle=None if parts[0].angle is None else all_of("angle"),
            nees=all_of("nees"),
            nees_3d=None if parts[0].nees_3d is None else all_of("nees_3d"),
            nis=all_of("nis"),
            dof=all_of("dof"),
            nis_ranks=RankSums(*(np.concatenate(xs) for xs in zip(*(p.nis_ranks for p in parts), strict=True))),
            lost=all_of("lost"),
        )


def score(
    association: Association,
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
) -> Scored:
    """Errors, NEES, NIS and track loss of associated estimates; `stations`, `every` as in `evaluate_table`."""
    kept = last_of_every(association, every) if every else np.flatnonzero(association.scored)
    if is_bearing(association.rows):
        return _bearings(association, kept, stations or {})
    return _positions(association, kept)


def last_of_every(association: Association, every: float) -> np.ndarray:
    """Indices of the scored rows that are the last of their track in an interval of `every` seconds."""
    times, starts = float_column(association.rows, "t_s"), association.starts
    track = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return np.flatnonzero(last_of_intervals(times, association.scored, every, track))


def last_of_intervals(times: np.ndarray, scored: np.ndarray, every: float | None, track: np.ndarray) -> np.ndarray:
    """The mask (n,) of the scored rows that are the last of their `track` (n,) in an interval of `every` seconds.

    All of them without `every`.
    """
    if every is None:
        return scored
    rows, kept = np.flatnonzero(scored), np.zeros_like(scored)
    # 0.3 s belongs to the interval that starts there although 0.3 / 0.1 is 2.9999999999999996.
    interval = np.floor(times[rows] / every + 1e-6)
    new = (np.diff(interval) != 0) | (np.diff(track[rows]) != 0)
    kept[rows[np.append(new, True)[: len(rows)]]] = True
    return kept


def covariances(rows: pl.DataFrame) -> np.ndarray:
    """Reported position covariances (n, 3, 3), m²; covariances missing in the table are zero."""
    covs = np.empty((3, 3, len(rows)))
    for i, a in enumerate("xyz"):
        covs[i, i] = float_column(rows, f"std_{a}_m") ** 2
        for j, b in enumerate("xyz"[:i]):
            covs[i, j] = covs[j, i] = np.nan_to_num(float_column(rows, f"cov_{b}{a}_m2"))
    return np.moveaxis(covs, -1, 0)


def _positions(association: Association, kept: np.ndarray) -> Scored:
    rows = association.rows[kept]
    errors = np.stack([float_column(rows, f"{axis}_m") for axis in "xyz"], axis=1) - association.truth[kept]
    covs = covariances(rows)
    nees, nees_3d = metrics.nees(errors[:, :2], covs[:, :2, :2]), metrics.nees(errors, covs)
    return Scored(kept, errors, None, nees, nees_3d, *_innovations(association), _lost(association))


def _bearings(association: Association, kept: np.ndarray, stations: Mapping[str, Mapping[str, Station]]) -> Scored:
    rows = association.rows[kept]
    true = true_bearings(association, stations)[kept]
    estimate = np.stack([float_column(rows, "azimuth_rad"), float_column(rows, "elevation_rad")], axis=1)
    errors = estimate - true
    errors[:, 0] = np.pi - (np.pi - errors[:, 0]) % (2 * np.pi)
    u, v = _directions(estimate), _directions(true)
    # arctan2 of sine and cosine: the arc cosine alone is zero below 1e-8 rad
    angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("nd,nd->n", u, v))
    sigmas = np.stack([float_column(rows, "std_azimuth_rad"), float_column(rows, "std_elevation_rad")], axis=1)
    nees = metrics.nees(errors, sigmas[:, :, None] ** 2 * np.eye(2))
    return Scored(kept, errors, angle[:, None], nees, None, *_innovations(association), _lost(association))


def outside_plane(association: Association, index: np.ndarray) -> np.ndarray:
    """Which bearings of the rows `index` (n,) are outside the plane of an array, where azimuths have errors."""
    return ~in_plane(float_column(association.rows.select("azimuth_rad")[index], "azimuth_rad"))


def in_plane(azimuth: np.ndarray) -> np.ndarray:
    """Which directions with these azimuths (n,), rad, lie in the plane of a flat array, where each azimuth is ± 90°."""
    lying: np.ndarray = np.abs(np.abs(azimuth) - np.pi / 2) < 1e-9
    return lying


def _directions(angles: np.ndarray) -> np.ndarray:
    azimuth, elevation = angles.T
    flat = np.cos(elevation)
    return np.stack([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat], axis=1)


def _innovations(association: Association) -> tuple[np.ndarray, np.ndarray, RankSums]:
    """NIS and its degrees of freedom (n,) of all rows, zero where there is no measurement, and NIS ranks."""
    nis, dof = float_column(association.rows, "nis"), float_column(association.rows, "nis_dof")
    known = np.isfinite(nis) & (dof > 0)
    nis, dof = np.where(known, nis, 0.0), np.where(known, dof, 0.0)
    return nis, dof, rank_sums(float_column(association.rows, "t_s"), nis, dof, association.starts)


def _lost(association: Association) -> np.ndarray:
    """Of each track (g, 4): seconds lost, seconds spanned, rows lost, and how often it was lost.

    A loss ends where the track starts again, or with the rows.
    """
    times, table = float_column(association.rows, "t_s"), np.zeros((len(association.starts) - 1, 4))
    if "status" not in association.rows.columns:
        return table
    status = association.rows["status"].cast(pl.String).fill_null("ok").to_numpy()
    lost, restarted = status == "lost", status == "restarted"
    for k, (a, b) in enumerate(pairwise(association.starts)):
        known = np.isfinite(times[a:b])
        at, lost_at = times[a:b][known], lost[a:b][known]
        if len(at):
            losses = restarted[a:b].sum() + lost_at[-1]
            table[k] = metrics.time_lost(at, lost_at).seconds, at[-1] - at[0], lost_at.sum(), losses
    return table
