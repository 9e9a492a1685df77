"""From a tracker's estimates with their truth to what is kept of every trajectory."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from experiments.monte_carlo.accumulators import BEARING, COLUMN, KINDS, POSITION, SUMS, histograms
from trackers.core.estimates import Status
from trackers.core.metrics import chi_square_quantile, nees
from trackers.recordings.folder import RecordingFolder


class TrackedRuns(NamedTuple):
    """A tracker's estimates of n trajectories with their truth, for the measures of a study.

    `times` (n, T) s. `estimates` (n, T, 3) m, NaN where there is none, a known height put in; `covariance` (n, T, d, d)
    of the estimated axes. Bearings have an axis of stations: `estimates` and `truth` (n, T, S, 2) rad, azimuth and
    elevation, `covariance` (n, T, S, 2, 2). `known`: rows that count, of which the truth and an estimate are known.
    `status` (codes of `Status`), `nis`, `dof`: for every row, and every station.
    """

    times: np.ndarray
    estimates: np.ndarray
    covariance: np.ndarray
    truth: np.ndarray
    known: np.ndarray
    status: np.ndarray
    nis: np.ndarray
    dof: np.ndarray
    folder: RecordingFolder


def scored(tracked: TrackedRuns) -> dict[str, np.ndarray]:
    """Of n trajectories `sums` (n, columns), `largest` (n, kinds) and for each kind of error its histogram."""
    n = len(tracked.estimates)
    sums, largest = np.zeros((n, len(SUMS))), np.full((n, len(KINDS)), np.nan)
    kept: dict[str, np.ndarray] = {"sums": sums, "largest": largest}
    bearing = tracked.estimates.ndim == 4
    # Stations' rows are rows of their trajectory.
    counts = tracked.known.reshape(n, -1)
    error = (tracked.estimates - tracked.truth).reshape(n, counts.shape[1], -1)
    for kind, size, valid in _bearing_errors(tracked, error, counts) if bearing else _errors(error, counts):
        add = {"n": valid.sum(axis=1), "sum": np.where(valid, size, 0.0).sum(axis=1)}
        add["squares"] = np.where(valid, size * size, 0.0).sum(axis=1)
        for what, values in add.items():
            sums[:, COLUMN[f"{what} {kind}"]] = values
        heard = valid.any(axis=1)
        largest[heard, KINDS.index(kind)] = np.where(valid, size, -1.0).max(axis=1)[heard]
        kept[f"cells {kind}"], kept[f"counts {kind}"] = histograms(size, valid)
    d = tracked.covariance.shape[-1]
    covariance = tracked.covariance.reshape(n, counts.shape[1], d, d)
    _believed(sums, error, covariance, counts, 2, "")
    if d == 3:
        _believed(sums, error, covariance, counts, 3, "_3d")
    status = tracked.status.reshape(n, -1)
    rows = status != Status.PADDING
    nis, dof = tracked.nis.reshape(n, -1).astype(float), tracked.dof.reshape(n, -1).astype(float)
    told = np.isfinite(nis) & (dof > 0) & rows
    columns = {
        "nis": np.where(told, nis, 0.0).sum(axis=1),
        "dof": np.where(told, dof, 0.0).sum(axis=1),
        "lost rows": (status == Status.LOST).sum(axis=1),
        "rows": rows.sum(axis=1),
        "diverged": np.isin(status, (Status.LOST, Status.RESTARTED, Status.NON_FINITE)).any(axis=1),
        "failed": (status == Status.NON_FINITE).any(axis=1) | ~counts.any(axis=1),
    }
    for name, values in columns.items():
        sums[:, COLUMN[name]] = values
    return kept


def _errors(error: np.ndarray, counts: np.ndarray) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """Kind, size (n, T) and which count, of horizontal and spatial errors."""
    flat = np.hypot(error[..., 0], error[..., 1])
    solid = np.sqrt(flat * flat + error[..., 2] ** 2)
    return [(POSITION[0], flat, counts), (POSITION[1], solid, counts & np.isfinite(solid))]


def _bearing_errors(
    tracked: TrackedRuns, error: np.ndarray, counts: np.ndarray
) -> list[tuple[str, np.ndarray, np.ndarray]]:
    """The same of the angle between the directions, of azimuth and of elevation."""
    error[..., 0] = np.pi - (np.pi - error[..., 0]) % (2 * np.pi)
    u, v = (_direction(x).reshape(*counts.shape, 3) for x in (tracked.estimates, tracked.truth))
    apart = np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), np.einsum("ntd,ntd->nt", u, v))
    sizes = (apart, np.abs(error[..., 0]), np.abs(error[..., 1]))
    return [(kind, size, counts) for kind, size in zip(BEARING, sizes, strict=True)]


def _direction(angles: np.ndarray) -> np.ndarray:
    azimuth, elevation = angles[..., 0], angles[..., 1]
    flat = np.cos(elevation)
    return np.stack([np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat], axis=-1)


def _believed(
    sums: np.ndarray, error: np.ndarray, covariance: np.ndarray, counts: np.ndarray, d: int, suffix: str
) -> None:
    """Add up the NEES of the first d axes, and in the plane how often it is inside the 95 % ellipse."""
    values = np.full(counts.shape, np.nan)
    values[counts] = nees(error[counts][:, :d], covariance[counts][:, :d, :d])
    told = np.isfinite(values)
    sums[:, COLUMN[f"nees{suffix}"]] = np.where(told, values, 0.0).sum(axis=1)
    sums[:, COLUMN[f"nees{suffix} n"]] = told.sum(axis=1)
    if d == 2:
        sums[:, COLUMN["inside"]] = (told & (values <= chi_square_quantile(0.95, d))).sum(axis=1)
