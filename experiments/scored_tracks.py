"""Estimates with their errors, as the figures and the page of `track` show them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from trackers.bounds import bounds_of
from trackers.recordings.association import Association
from trackers.recordings.columns import float_column
from trackers.recordings.folder import RecordingFolder
from trackers.recordings.tracker_spec import TrackerBatch
from trackers.recordings.tracks_table import is_bearing
from trackers.scoring import Scored, score

BOUNDED = 4
"""The most recordings whose Cramér–Rao bound is computed."""


@dataclass(frozen=True)
class ScoredRecording:
    """The estimates of one recording, sorted by track and time.

    `errors` (n, 3) m, of bearings (n, 2) rad, `nees` and `nees_3d` (n,): NaN in rows that are not scored; `nees_3d` is
    None for bearings. `bounds`: times (t,), s, and bounds (t, 3), m, on the standard deviations; None without.
    """

    folder: RecordingFolder
    association: Association
    errors: np.ndarray
    nees: np.ndarray
    nees_3d: np.ndarray | None
    bounds: tuple[np.ndarray, np.ndarray] | None

    @property
    def times(self) -> np.ndarray:
        """The times (n,) of the rows, s."""
        return float_column(self.association.rows, "t_s")

    @property
    def angles(self) -> bool:
        """Whether the estimates are bearings."""
        return self.errors.shape[1] == 2

    @property
    def in_plane(self) -> bool:
        """Whether the estimates are angles in the plane of a flat array: their azimuth is ± 90° and has no σ."""
        azimuth, elevation = np.isfinite(self.sigmas()[:, :2]).any(axis=0)
        return self.angles and bool(elevation and not azimuth)

    def sigmas(self) -> np.ndarray:
        """The reported standard deviations, with shape and unit of `errors`; NaN for a known height."""
        names = ("std_azimuth_rad", "std_elevation_rad") if self.angles else ("std_x_m", "std_y_m", "std_z_m")
        sigmas = np.stack([float_column(self.association.rows, name) for name in names], axis=1)
        sigmas[sigmas == 0] = np.nan
        return sigmas

    @cached_property
    def rmse(self) -> np.ndarray:
        """The RMSE of each track (g,), horizontal in m or of both angles in rad; NaN without truth."""
        squares = (self.errors[:, :2] ** 2).sum(axis=1)
        known, starts = np.isfinite(squares), self.association.starts
        total = np.concatenate([[0.0], np.cumsum(np.where(known, squares, 0.0))])
        count = np.concatenate([[0], np.cumsum(known)])
        found, rows = total[starts[1:]] - total[starts[:-1]], count[starts[1:]] - count[starts[:-1]]
        return np.where(rows > 0, np.sqrt(np.maximum(found, 0) / np.maximum(rows, 1)), np.nan)

    def worst_first(self) -> list[int]:
        """The numbers of the tracks from the largest RMSE to the smallest, those without truth last."""
        order = np.argsort(-np.nan_to_num(self.rmse, nan=-1.0), kind="stable")
        return [int(k) for k in order]


@dataclass(frozen=True)
class ScoredTracks:
    """The estimates of all recordings with their errors; `batches`: the trajectories, for their bounds."""

    association: Association
    folders: Sequence[RecordingFolder]
    batches: Sequence[TrackerBatch]

    @property
    def bearing(self) -> bool:
        """Whether the estimates are bearings, not positions."""
        return is_bearing(self.association.rows)

    @cached_property
    def scored(self) -> Scored:
        """Errors and consistency of the rows with a truth."""
        return score(self.association, {folder.name: folder.rig.stations for folder in self.folders})

    @cached_property
    def recordings(self) -> list[ScoredRecording]:
        """Each recording with its rows; the first few with their bounds."""
        rows, scored = self.association.rows, self.scored
        errors, nees, nees_3d = np.full((len(rows), 2 if self.bearing else 3), np.nan), *np.full((2, len(rows)), np.nan)
        errors[scored.index], nees[scored.index] = scored.errors, scored.nees
        if scored.nees_3d is not None:
            nees_3d[scored.index] = scored.nees_3d
        if not self.bearing:
            errors[~(float_column(rows, "std_z_m") > 0), 2] = np.nan
        names, found = rows["recording"], []
        for number, folder in enumerate(self.folders):
            own = (names == folder.name).to_numpy()
            part = self.association.of_recording(folder.name)
            bounded = number < BOUNDED and not self.bearing and part.scored.any()
            bounds = bounds_of(folder, self.batches) if bounded else None
            spatial = None if scored.nees_3d is None else nees_3d[own]
            found.append(ScoredRecording(folder, part, errors[own], nees[own], spatial, bounds))
        return found
