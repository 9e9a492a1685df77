"""Estimates that are associated with truth as errors and NEES of rows, and as the `Scores` of their tracks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import polars as pl

from trackwright.trackers.core.data.consistency import Entries, eliminated, nees_of_leading
from trackwright.trackers.core.model.rig import Station
from trackwright.trackers.evaluation.association import Association, true_bearings
from trackwright.trackers.evaluation.judge import correlation_times, energy_scores
from trackwright.trackers.evaluation.metrics import RESIDUALS, bearing_sizes, position_sizes
from trackwright.trackers.evaluation.scores import Groups, Scores, Values, error_sums, nees_sums
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.tracks_table import HEADING, is_bearing
from trackwright.trackers.recordings.truth import TruthStatus


@dataclass(frozen=True)
class Scored:
    """Errors and NEES of the n scored rows.

    `index`: their position in the association; `errors` (n, 3), m, or of bearings (n, 2), rad; `sizes` (n,) by kind,
    NaN of rows without one; `nees` of the horizontal position or of both angles, infinite of a zero or singular
    covariance, NaN of a missing or infinite one; `nees_3d` likewise, None for bearings. `covariance`: its entries (n,)
    in the upper triangle, by row and column.
    """

    index: np.ndarray
    errors: np.ndarray
    sizes: Mapping[str, np.ndarray]
    nees: np.ndarray
    nees_3d: np.ndarray | None
    covariance: Entries

    @property
    def size(self) -> np.ndarray:
        """The horizontal error (n,), m, or of bearings the angle between estimated and true direction, rad."""
        return next(iter(self.sizes.values()))

    @cached_property
    def _eliminated(self) -> tuple[np.ndarray, np.ndarray]:
        """The parts (n, d) of errors, and their variances, of which NEES is the sum of squares, d axes."""
        parts = eliminated(self.errors, self.covariance)
        return np.stack([x for x, _ in parts], axis=1), np.stack([variance for _, variance in parts], axis=1)

    def log_density(self, dimensions: int) -> np.ndarray:
        """The log density (n,), nats, of the truth under the normal distribution that the row reports.

        `dimensions`: 3 for positions in space, 2 for those over the floor and for bearings. NaN without a covariance.
        """
        square, variances = (self.nees_3d if dimensions == 3 else self.nees), self._eliminated[1][:, :dimensions]
        return -0.5 * (square + np.log(2 * np.pi * variances).sum(axis=1))

    def energy_score(self, known: np.ndarray, dimensions: int) -> np.ndarray:
        """The energy scores, m, of the rows in the mask `known` (n,), which have a covariance."""
        upper = {at: x[known] for at, x in self.covariance.items() if max(at) < dimensions}
        return energy_scores(self.errors[known, :dimensions], _whole(upper, dimensions))

    def error_samples(self, known: np.ndarray, dimensions: int, starts: np.ndarray) -> np.ndarray:
        """Rows (g,) with the information of one on NEES, of the tracks of the rows in the mask `known` (n,)."""
        errors, variances = (x[known, :dimensions] for x in self._eliminated)
        return correlation_times(errors / np.sqrt(variances), starts)


def score(
    association: Association,
    stations: Mapping[str, Mapping[str, Station]] | None = None,
    every: float | None = None,
) -> Scored:
    """Errors and NEES of associated estimates; `stations`, `every` as in `evaluate_association`."""
    kept = last_of_every(association, every) if every else np.flatnonzero(association.scored)
    if is_bearing(association.rows):
        return _bearings(association, kept, stations or {})
    return _positions(association, kept)


def scores_of_tracks(association: Association, scored: Scored) -> Scores:
    """The scores of each track: errors and NEES of its scored rows, NIS and track loss of all of them."""
    all_rows, status = Groups(association.starts), association.truth_status
    rows = Groups(np.searchsorted(scored.index, association.starts))
    sums = {"n": rows.count, "n_rows": all_rows.count}
    for name, why in EXCLUDED.items():
        sums[name] = all_rows.sum(status == why)
    # Residuals are judged by recording.
    largest = dict.fromkeys(RESIDUALS, np.full(len(rows.count), np.nan))
    values = {}
    for kind, size in scored.sizes.items():
        groups, known = rows.where(~np.isnan(size), size)
        more, top = error_sums(kind, known, groups)
        sums, largest, values[kind] = sums | more, largest | top, Values(known, groups.starts)
    for component, errors in zip(COMPONENTS[scored.errors.shape[1]], scored.errors.T, strict=True):
        groups, known = rows.where(~np.isnan(scored.sizes.get(component, errors)), errors)
        sums[f"bias {component}"] = groups.sum(known)
    for name, each, dof in (("nees", scored.nees, 2), ("nees_3d", scored.nees_3d, 3)):
        if each is not None:
            finite = np.isfinite(each)
            groups, known = rows.where(finite, each)
            sums |= nees_sums(name, known, dof, groups)
            sums[f"slow {name}"] = groups.count * scored.error_samples(finite, dof, groups.starts)
            sums[f"log density {name}"] = groups.sum(scored.log_density(dof)[finite])
            if scored.nees_3d is not None:
                sums[f"energy {name}"] = groups.sum(scored.energy_score(finite, dof))
            values[name] = Values(known, groups.starts)
            zero = rows.sum(np.isinf(each))
            total = rows.count if dof == 2 else np.where(groups.count + zero > 0, sums["n 3d_m"], 0)
            sums |= {f"zero {name}": zero, f"no {name}": total - groups.count}
    sums |= _innovations(association, all_rows) | _lost(association, all_rows)
    return Scores(sums, largest, {}, values)


EXCLUDED = {
    "n_no_estimate": TruthStatus.NO_ESTIMATE,
    "n_no_truth": TruthStatus.NO_TRUTH,
    "n_hole": TruthStatus.HOLE,
}
"""The counts of rows that are not scored, and why."""

COMPONENTS = {3: ("x_m", "y_m", "z_m"), 2: ("azimuth_rad", "elevation_rad")}
"""The components of errors by their number, of positions and of bearings."""


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
    return _whole(_upper_entries(rows), 3)


def _whole(upper: Entries, dimensions: int) -> np.ndarray:
    """Covariances (n, d, d) from their entries in the upper triangle."""
    covs = np.empty((dimensions, dimensions, len(upper[0, 0])))
    for (i, j), entry in upper.items():
        covs[i, j] = covs[j, i] = entry
    return np.moveaxis(covs, -1, 0)


def _upper_entries(rows: pl.DataFrame) -> dict[tuple[int, int], np.ndarray]:
    """The entries (n,) of `covariances` by row and column, those of the upper triangle."""
    # A negative one is no variance.
    entries = {(i, i): (std := float_column(rows, f"std_{a}_m")) * np.abs(std) for i, a in enumerate("xyz")}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        cov = float_column(rows, f"cov_{'xyz'[i]}{'xyz'[j]}_m2")
        entries[i, j] = cov if np.isfinite(cov).all() else np.nan_to_num(cov)
    return entries


def _positions(association: Association, kept: np.ndarray) -> Scored:
    rows, truth = association.rows, association.truth
    if len(kept) < len(rows):
        rows, truth = rows[kept], truth[kept]
    errors = np.stack([float_column(rows, f"{axis}_m") - true for axis, true in zip("xyz", truth.T, strict=True)]).T
    upper, cov = _upper_entries(rows), float_column(rows, "cov_xy_m2")
    _, flat, spatial = nees_of_leading(errors, upper)
    # One that other rows have is missing; a known height has no standard deviation in any row of its track.
    plane = [*errors.T[:2], upper[0, 0], upper[1, 1], cov if np.nan_to_num(cov).any() else np.zeros(len(rows))]
    tracks = Groups(association.starts)
    free = tracks.sum(np.nan_to_num(float_column(association.rows, "std_z_m")) != 0) > 0
    height = np.where(np.repeat(free, tracks.count)[kept], upper[2, 2], np.nan)
    flat, spatial = _judged(flat, *plane), _judged(spatial, *plane, errors[:, 2], height)
    sizes = position_sizes(errors)
    if association.headings is not None:
        turned = float_column(rows, HEADING) - association.headings[kept]
        sizes["heading_rad"] = np.abs(np.pi - (np.pi - turned) % (2 * np.pi))
    return Scored(kept, errors, sizes, flat, spatial, upper)


def _judged(nees: np.ndarray, *reported: np.ndarray) -> np.ndarray:
    """NEES (n,) as `Scored` has it, of errors and covariances as they are `reported`."""
    return np.where(np.isfinite(reported).all(axis=0), np.where(np.isfinite(nees), nees, np.inf), np.nan)


def _bearings(association: Association, kept: np.ndarray, stations: Mapping[str, Mapping[str, Station]]) -> Scored:
    rows = association.rows[kept]
    true = true_bearings(association, stations)[kept]
    estimate = np.stack([float_column(rows, "azimuth_rad"), float_column(rows, "elevation_rad")], axis=1)
    errors, sizes = bearing_sizes(estimate, true)
    # In the plane of an array each azimuth is ± 90°, and its error says nothing.
    plane = in_plane(estimate[:, 0])
    sizes |= {kind: np.where(plane, np.nan, sizes[kind]) for kind in COMPONENTS[2]}
    azimuth, elevation = (float_column(rows, f"std_{name}") for name in COMPONENTS[2])
    upper = {(0, 0): azimuth * np.abs(azimuth), (0, 1): np.zeros(len(rows)), (1, 1): elevation * np.abs(elevation)}
    each = _judged(nees_of_leading(errors, upper)[-1], *errors.T, azimuth, elevation)
    return Scored(kept, errors, sizes, each, None, upper)


def in_plane(azimuth: np.ndarray) -> np.ndarray:
    """Which directions with these azimuths (n,), rad, lie in the plane of a flat array, where each azimuth is ± 90°."""
    lying: np.ndarray = np.abs(np.abs(azimuth) - np.pi / 2) < 1e-9
    return lying


def _innovations(association: Association, rows: Groups) -> dict[str, np.ndarray]:
    """The sums of NIS and of its degrees of freedom, and its rows; rows without a measurement have none."""
    nis, dof = float_column(association.rows, "nis"), float_column(association.rows, "nis_dof")
    known = np.isfinite(nis) & (dof > 0)
    nis, dof = np.where(known, nis, 0.0), np.where(known, dof, 0.0)
    total, freedom = rows.sum(nis), rows.sum(dof)
    sums = {"nis": total, "dof": freedom, "n nis": rows.sum(known)}
    with np.errstate(invalid="ignore"):
        about = nis - np.repeat(total / freedom, rows.count) * dof
    groups, about = rows.where(known, about)
    return sums | {"slow nis": groups.count * correlation_times(about[:, None], groups.starts, power=1)}


def _lost(association: Association, rows: Groups) -> dict[str, np.ndarray]:
    """Seconds lost, seconds spanned, rows lost, and how often a track was lost.

    The status of a row holds until the next. A loss ends where the track starts again, or with the rows.
    """
    times = float_column(association.rows, "t_s")
    if "status" not in association.rows.columns:
        none = np.zeros(len(rows.count))
        return {"lost s": none, "span s": none, "lost rows": none.astype(int), "losses": none.astype(int)}
    status = association.rows["status"].cast(pl.String).fill_null("ok")
    lost, known = (status == "lost").to_numpy(), np.isfinite(times)
    (timed, at), (_, lost_at) = rows.where(known, times), rows.where(known, lost)
    some = timed.count > 0
    first, last = timed.starts[:-1][some], timed.starts[1:][some] - 1
    steps = np.diff(at, append=0.0)
    steps[last] = 0.0
    span, ended = np.zeros(len(some)), np.zeros(len(some), int)
    span[some], ended[some] = at[last] - at[first], lost_at[last]
    return {
        "lost s": timed.sum(np.where(lost_at, steps, 0.0)),
        "span s": span,
        "lost rows": timed.sum(lost_at),
        "losses": np.where(some, rows.sum((status == "restarted").to_numpy()), 0) + ended,
    }
