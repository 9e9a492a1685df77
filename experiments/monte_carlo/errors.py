"""Errors, NEES and NIS of tracked trajectories as sums and histograms of each; metrics are as in `evaluate`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.consistency import nees_of_leading, upper_entries
from trackwright.trackers.core.data.estimates import Status
from trackwright.trackers.evaluation.metrics import terms_of
from trackwright.trackers.evaluation.rows import ANGLES, AXES, bearing_sizes, position_sizes
from trackwright.trackers.recordings.folder import RecordingFolder

SMALLEST, BIN_WIDTH, BINS = 1e-6, 0.02, 1201
"""Bins from 1e-6 to 2.6e4 (m, rad or NEES), of relative width BIN_WIDTH; other values fall in the end bins."""

EDGES = SMALLEST * np.exp(BIN_WIDTH * np.arange(BINS))
"""Upper edges of the bins."""


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
    """Arrays of n trajectories by name: each `sum` and `largest` (n,) as of `metrics.sums`, and of each kind a
    histogram. The histogram is sparse: `cells`, indices in one (n, BINS), and their `counts`. The rows of all stations
    count as rows of their trajectory."""
    n, bearing = len(tracked.estimates), tracked.estimates.ndim == 4
    known, status = tracked.known.reshape(n, -1), tracked.status.reshape(n, -1)
    there = status != Status.PADDING
    if bearing:
        error, sizes = bearing_sizes(tracked.estimates, tracked.truth)
    else:
        error = tracked.estimates - tracked.truth
        sizes = position_sizes(error)
    errors = np.where(known.reshape(-1, 1), error.reshape(known.size, -1), np.nan)
    columns = {f"error_{name}": x for name, x in zip(ANGLES if bearing else AXES, errors.T, strict=True)}
    columns |= {f"size_{kind}": np.where(known, x.reshape(known.shape), np.nan).ravel() for kind, x in sizes.items()}
    d = tracked.covariance.shape[-1]
    entries = upper_entries(tracked.covariance.reshape(known.size, d, d))
    columns |= dict(zip(("nees", "nees_3d"), nees_of_leading(errors[:, :d], entries)[1:], strict=False))
    columns["nis"] = np.where(there, tracked.nis.reshape(there.shape), np.nan).ravel()
    columns |= {"nis_dof": tracked.dof.ravel(), "lost": (status == Status.LOST).ravel()}
    columns["track"] = np.where(there, 0.0, np.nan).ravel()
    rows = pl.DataFrame({name: pl.Series(x, nan_to_null=True) for name, x in columns.items()})
    sums = {
        term.name: term.cast(pl.Float64).fill_null(0.0).to_numpy().reshape(known.shape).sum(axis=1)
        for term in terms_of(rows)
    }
    sums |= {
        "n": known.sum(axis=1),
        "diverged": np.isin(status, (Status.LOST, Status.RESTARTED, Status.NON_FINITE)).any(axis=1),
        "failed": (status == Status.NON_FINITE).any(axis=1) | ~known.any(axis=1),
        "trajectories": np.ones(n),
    }
    arrays = {f"sum {name}": x.astype(float) for name, x in sums.items()}
    for kind in sizes:
        size = columns[f"size_{kind}"].reshape(known.shape)
        top = np.where(np.isnan(size), -1.0, size).max(axis=1)
        arrays[f"largest {kind}"] = np.where(top < 0, np.nan, top)
        arrays[f"cells {kind}"], arrays[f"counts {kind}"] = _histograms(size)
    return arrays


def _histograms(size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A sparse (n, BINS) histogram of sizes (n, T), NaN left out: flat indices and their counts."""
    there = ~np.isnan(size)
    cells = np.bincount(np.broadcast_to(BINS * np.arange(len(size))[:, None], size.shape)[there] + bins(size[there]))
    filled = np.flatnonzero(cells)
    return filled, cells[filled]


def bins(values: np.ndarray) -> np.ndarray:
    """The bin number of each value."""
    with np.errstate(divide="ignore"):
        at = np.ceil(np.log(np.maximum(values, 0.0) / SMALLEST) / BIN_WIDTH)
    return np.clip(at, 0, BINS - 1).astype(np.int64)
