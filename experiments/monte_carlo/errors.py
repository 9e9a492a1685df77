"""Errors, NEES and NIS of tracked trajectories, accumulated per trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from experiments.monte_carlo.accumulators import BEARING, BINS, COLUMN, KINDS, POSITION, SUMS, histograms
from trackers.core.chi_square import chi_square_quantile
from trackers.core.estimates import Status
from trackers.core.metrics import nees_of_leading
from trackers.recordings.folder import RecordingFolder


class TrackedRuns(NamedTuple):
    """A tracker's estimates of n trajectories of T rows beside their truth: the argument of a study's measures.

    Positions: `times` (n, T) s, `estimates` and `truth` (n, T, 3) m, `covariance` (n, T, d, d) of the d estimated axes;
    NaN without an estimate, and a known height filled in. Bearings have an axis of S stations: `estimates` and `truth`
    (n, T, S, 2) rad, azimuth and elevation, `covariance` (n, T, S, 2, 2). `known`: rows with both truth and a usable
    estimate. `status` (codes of `Status`), `nis`, `dof`: per row, and per station for bearings.
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

    def at_station(self, number: int) -> TrackedRuns:
        """The rows of one of the stations."""
        one = {name: x[:, :, number] for name, x in self._asdict().items() if name not in ("times", "folder")}
        return self._replace(**one)

    @property
    def error(self) -> np.ndarray:
        """Estimates less truth, m or rad; NaN for rows that are not scored."""
        return np.where(self.known[..., None], self.estimates - self.truth, np.nan)


def joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of `scored` of all trajectories, from those of some after others."""
    first = 0
    for part in parts:
        for name in part:
            if name.startswith("cells "):
                part[name] = part[name] + first * BINS
        first += len(part["sums"])
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def scored(tracked: TrackedRuns) -> dict[str, np.ndarray]:
    """Arrays of n trajectories: `sums` (n, columns), `largest` (n, kinds), and a histogram for each kind of error."""
    n = len(tracked.estimates)
    sums, largest = np.zeros((n, len(SUMS))), np.full((n, len(KINDS)), np.nan)
    arrays: dict[str, np.ndarray] = {"sums": sums, "largest": largest}
    bearing = tracked.estimates.ndim == 4
    # The rows of all stations count as rows of their trajectory.
    counts = tracked.known.reshape(n, -1)
    error = (tracked.estimates - tracked.truth).reshape(n, counts.shape[1], -1)
    for kinds, size, valid in _bearing_errors(tracked, error, counts) if bearing else _position_errors(error, counts):
        columns = {"n": valid.sum(axis=1), "sum": _sum(size, valid), "squares": _sum(size * size, valid)}
        any_valid = columns["n"] > 0
        top = _masked(size, valid, -1.0).max(axis=1)[any_valid]
        cells, numbers = histograms(size, valid)
        for kind in kinds:
            for name, values in columns.items():
                sums[:, COLUMN[f"{name} {kind}"]] = values
            largest[any_valid, KINDS.index(kind)] = top
            arrays[f"cells {kind}"], arrays[f"counts {kind}"] = cells, numbers
    d = tracked.covariance.shape[-1]
    covariance = tracked.covariance.reshape(n, counts.shape[1], d, d)
    _add_nees(sums, error[..., :d], covariance, counts)
    status = tracked.status.reshape(n, -1)
    rows = status != Status.PADDING
    nis, dof = tracked.nis.reshape(n, -1).astype(float), tracked.dof.reshape(n, -1).astype(float)
    has_nis = np.isfinite(nis) & (dof > 0) & rows
    columns = {
        "nis": _sum(nis, has_nis),
        "dof": _sum(dof, has_nis),
        "lost rows": (status == Status.LOST).sum(axis=1),
        "rows": rows.sum(axis=1),
        "diverged": np.isin(status, (Status.LOST, Status.RESTARTED, Status.NON_FINITE)).any(axis=1),
        "failed": (status == Status.NON_FINITE).any(axis=1) | ~counts.any(axis=1),
    }
    for name, values in columns.items():
        sums[:, COLUMN[name]] = values
    return arrays


def _masked(values: np.ndarray, valid: np.ndarray, other: float = 0.0) -> np.ndarray:
    """The values (n, T), `other` where they are not valid."""
    return values if valid.all() else np.where(valid, values, other)


def _sum(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The sums (n,) of the valid ones of the values (n, T)."""
    found: np.ndarray = _masked(values, valid).sum(axis=1)
    return found


Errors = list[tuple[tuple[str, ...], np.ndarray, np.ndarray]]
"""Kinds of errors, their size (n, T), and the mask of valid rows."""


def _position_errors(error: np.ndarray, counts: np.ndarray) -> Errors:
    """Horizontal and 3-D errors."""
    horizontal = np.hypot(error[..., 0], error[..., 1])
    if not error[..., 2].any() and np.isfinite(horizontal).all():
        # The height is known: the same numbers, since the root of a number's square is exactly that number.
        return [(POSITION, horizontal, counts)]
    spatial = np.sqrt(horizontal * horizontal + error[..., 2] ** 2)
    return [(POSITION[:1], horizontal, counts), (POSITION[1:], spatial, counts & np.isfinite(spatial))]


def _bearing_errors(tracked: TrackedRuns, error: np.ndarray, counts: np.ndarray) -> Errors:
    """Errors of the angle between the two directions, of azimuth and of elevation; wraps azimuth in `error`."""
    error[..., 0] = np.pi - (np.pi - error[..., 0]) % (2 * np.pi)
    (x, y, z), (p, q, r) = (_direction(angles) for angles in (tracked.estimates, tracked.truth))
    cross = np.sqrt((y * r - z * q) ** 2 + (z * p - x * r) ** 2 + (x * q - y * p) ** 2)
    # In the order of a sum of pairs, as einsum has it.
    angle = np.arctan2(cross, x * p + z * r + y * q).reshape(counts.shape)
    sizes = (angle, np.abs(error[..., 0]), np.abs(error[..., 1]))
    return [((kind,), size, counts) for kind, size in zip(BEARING, sizes, strict=True)]


def _direction(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The components of the unit vectors of angles (…, 2)."""
    azimuth, elevation = angles[..., 0], angles[..., 1]
    flat = np.cos(elevation)
    return np.sin(azimuth) * flat, np.sin(elevation), np.cos(azimuth) * flat


def _add_nees(sums: np.ndarray, error: np.ndarray, covariance: np.ndarray, counts: np.ndarray) -> None:
    """Add the NEES of two axes, and of three, to `sums`; of two also the number of errors inside the 95 % ellipse."""
    whole = counts.all()
    rows = error.reshape(-1, error.shape[-1]), covariance.reshape(-1, *covariance.shape[2:])
    of_leading = nees_of_leading(*(rows if whole else (x[counts.ravel()] for x in rows)))
    for axes, suffix in enumerate(("", "_3d")[: len(of_leading) - 1], start=2):
        if whole:
            values = of_leading[axes - 1].reshape(counts.shape)
        else:
            values = np.full(counts.shape, np.nan)
            values[counts] = of_leading[axes - 1]
        finite = np.isfinite(values)
        sums[:, COLUMN[f"nees{suffix}"]] = _sum(values, finite)
        sums[:, COLUMN[f"nees{suffix} n"]] = finite.sum(axis=1)
        if axes == 2:
            sums[:, COLUMN["inside"]] = (finite & (values <= chi_square_quantile(0.95, axes))).sum(axis=1)
