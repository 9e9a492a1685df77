"""Errors, NEES and NIS of tracked trajectories as sums and histograms of each, as in `Scores`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from trackwright.trackers.core.data.consistency import nees_of_leading, upper_entries
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.evaluation.metrics import bearing_sizes, position_sizes
from trackwright.trackers.evaluation.scores import BINS, bins, error_sums, nees_sums
from trackwright.trackers.evaluation.scoring import COMPONENTS, in_plane
from trackwright.trackers.recordings.folder import RecordingFolder


class TrackedRuns(NamedTuple):
    """A tracker's estimates of n trajectories of T rows beside their truth: the argument of a study's measures.
    Positions: `times` (n, T) s, `estimates` and `truth` (n, T, 3) m, `covariance` (n, T, d, d) of the d estimated axes;
    NaN without an estimate, and a known height filled in. Bearings have an axis of S stations: `estimates` and `truth`
    (n, T, S, 2) rad, azimuth and elevation, `covariance` (n, T, S, 2, 2). `known`: rows with both truth and a usable
    estimate. `status` (codes of `Status`), `nis`, `dof`: per row, and per station for bearings."""

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
        of_station = {name: x[:, :, number] for name, x in self._asdict().items() if name not in ("times", "folder")}
        return self._replace(**of_station)

    @property
    def error(self) -> np.ndarray:
        """Estimates less truth, m or rad; NaN for rows that are not scored."""
        return np.where(self.known[..., None], self.estimates - self.truth, np.nan)


class Masked:
    """The rows of n trajectories in the mask `valid` (n, T), as groups of rows of `Scores`."""

    def __init__(self, valid: np.ndarray) -> None:
        self.valid, self.all = valid, bool(valid.all())

    @property
    def count(self) -> np.ndarray:
        """The number of rows (n,)."""
        count: np.ndarray = self.valid.sum(axis=1)
        return count

    def sum(self, values: np.ndarray) -> np.ndarray:
        """The sums (n,) of values (n, T)."""
        sums: np.ndarray = self._masked(values, 0).sum(axis=1)
        return sums

    def max(self, values: np.ndarray) -> np.ndarray:
        """The largest (n,) of values (n, T) ≥ 0, NaN of none."""
        top = self._masked(values, -1.0).max(axis=1)
        return np.where(top < 0, np.nan, top)

    def histograms(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A sparse (n, BINS) histogram of values (n, T): flat indices and their counts."""
        first = BINS * np.arange(len(values))[:, None]
        if self.all:
            cells = np.bincount((first + bins(values)).ravel())
        else:
            cells = np.bincount(np.broadcast_to(first, values.shape)[self.valid] + bins(values[self.valid]))
        filled = np.flatnonzero(cells)
        return filled, cells[filled]

    def _masked(self, values: np.ndarray, other: float) -> np.ndarray:
        return values if self.all else np.where(self.valid, values, other)


def joined(parts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of `scored` of all trajectories, from some after others."""
    first = 0
    for part in parts:
        for name in part:
            if name.startswith("cells "):
                part[name] = part[name] + first * BINS
        first += len(part["sum n"])
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def scored(tracked: TrackedRuns) -> dict[str, np.ndarray]:
    """Arrays of n trajectories by name: each `sum` and `largest` (n,) of `Scores`, and of each kind a histogram. The
    histogram is sparse: `cells`, indices in one (n, BINS), and their `counts`."""
    n = len(tracked.estimates)
    bearing = tracked.estimates.ndim == 4
    # The rows of all stations count as rows of their trajectory.
    counts = Masked(tracked.known.reshape(n, -1))
    if bearing:
        error, sizes = bearing_sizes(tracked.estimates, tracked.truth)
        plane = in_plane(tracked.estimates[..., 0])
        sizes |= {kind: np.where(plane, np.nan, sizes[kind]) for kind in COMPONENTS[2]}
        sizes = {kind: size.reshape(counts.valid.shape) for kind, size in sizes.items()}
    else:
        error = tracked.estimates - tracked.truth
        sizes = position_sizes(error)
    error = error.reshape(n, counts.valid.shape[1], -1)
    sums, largest = {"n": counts.count}, dict[str, np.ndarray]()
    arrays: dict[str, np.ndarray] = {}
    main, latest = next(iter(sizes.values())), None
    for kind, size in sizes.items():
        rows = counts if size is main else Masked(counts.valid & np.isfinite(size))
        if size is not latest:
            latest, histogram = size, rows.histograms(size)
        more, top = error_sums(kind, size, rows)
        sums, largest = sums | more, largest | top
        arrays[f"cells {kind}"], arrays[f"counts {kind}"] = histogram
    for k, component in enumerate(COMPONENTS[error.shape[-1]]):
        rows = counts.valid & np.isfinite(sizes[component] if bearing else error[..., k])
        sums[f"bias {component}"] = Masked(rows).sum(error[..., k])
    d = tracked.covariance.shape[-1]
    sums |= _nees(error[..., :d], tracked.covariance.reshape(n, counts.valid.shape[1], d, d), counts)
    status = tracked.status.reshape(n, -1)
    there = status != Status.PADDING
    nis, dof = tracked.nis.reshape(n, -1).astype(float), tracked.dof.reshape(n, -1).astype(float)
    has_nis = Masked(np.isfinite(nis) & (dof > 0) & there)
    bad = np.isin(status, (Status.LOST, Status.RESTARTED, Status.NON_FINITE))
    sums |= {
        "nis": has_nis.sum(nis),
        "dof": has_nis.sum(dof),
        "lost rows": (status == Status.LOST).sum(axis=1),
        "n_rows": there.sum(axis=1),
        "diverged": np.any(bad, axis=1),
        "failed": np.isin(status, Status.NON_FINITE).any(axis=1) | (counts.count == 0),
        "trajectories": np.ones(n),
    }
    arrays |= {f"sum {name}": x.astype(float) for name, x in sums.items()}
    return arrays | {f"largest {name}": x for name, x in largest.items()}


def _nees(error: np.ndarray, covariance: np.ndarray, counts: Masked) -> dict[str, np.ndarray]:
    """The sums of the NEES of two axes, and of three."""
    sums: dict[str, np.ndarray] = {}
    rows = error.reshape(-1, error.shape[-1]), covariance.reshape(-1, *covariance.shape[2:])
    errors, covs = rows if counts.all else (x[counts.valid.ravel()] for x in rows)
    of_leading = nees_of_leading(errors, upper_entries(covs))
    for axes, name in enumerate(("nees", "nees_3d")[: len(of_leading) - 1], start=2):
        if counts.all:
            values = of_leading[axes - 1].reshape(counts.valid.shape)
        else:
            values = np.full(counts.valid.shape, np.nan)
            values[counts.valid] = of_leading[axes - 1]
        sums |= nees_sums(name, values, axes, Masked(np.isfinite(values)))
    return sums
