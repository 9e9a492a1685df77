"""Estimates with their errors, as the figures and the page of `track` show them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import polars as pl

from trackwright.trackers.core.data.consistency import student_t_dof_of
from trackwright.trackers.core.data.estimates import Estimates
from trackwright.trackers.core.data.recording import Recording
from trackwright.trackers.core.errors import zero_of
from trackwright.trackers.core.model.rig import Rig
from trackwright.trackers.evaluation.evaluate import rows_of, truths_of
from trackwright.trackers.evaluation.rows import ANGLES, AXES, in_plane, main_size, scored_rows, wrapped
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder
from trackwright.trackers.recordings.kinds import KINDS, first_time
from trackwright.trackers.recordings.tracks import TrackerBatch, Tracks
from trackwright.trackers.recordings.tracks_table import is_bearing

AnyEstimates = Tracks | Estimates
AnyRecording = RecordingFolder | Recording

DRAWN = 4  # the most recordings with figures


class Component(NamedTuple):
    """A coordinate or angle of all rows: its name and unit, and values, errors and standard deviations (n,) in it."""

    name: str
    unit: str
    values: np.ndarray
    errors: np.ndarray
    sigmas: np.ndarray


@dataclass(frozen=True)
class ScoredRecording:
    """The estimates of one recording with their errors, its `scored_rows`.

    `student_t_dof`: of the noise behind the NIS; None for normal noise, NaN where it is not known.
    """

    folder: RecordingFolder
    rows: pl.DataFrame
    student_t_dof: float | None

    def columns(self, *names: str) -> np.ndarray:
        """Columns of the table (n, k); NaN where a value is missing."""
        return np.stack([float_column(self.rows, name) for name in names], axis=1)

    @cached_property
    def times(self) -> np.ndarray:
        """The times (n,) of the rows, s."""
        return float_column(self.rows, "t_s")

    @property
    def angles(self) -> bool:
        """Whether the estimates are bearings."""
        return is_bearing(self.rows)

    @cached_property
    def miss(self) -> np.ndarray:
        """The horizontal error (n,), m, or the angle between estimated and true direction, rad."""
        return float_column(self.rows, main_size(self.rows))

    @cached_property
    def starts(self) -> np.ndarray:
        """The first row of each of the g tracks, then their number (g + 1,)."""
        return np.append(0, np.cumsum(self.rows["track"].rle().struct.field("len").to_numpy())).astype(int)

    @property
    def first(self) -> pl.DataFrame:
        """The first row of each track."""
        return self.rows[self.starts[:-1]]

    @cached_property
    def zero(self) -> float:
        """The time, s, from which times are shown: zero, or the first reading's where they count from 1970."""
        tables = {name: table for name, table in self.folder.tables.items() if name in KINDS}
        return zero_of(first_time(tables) if tables else float(np.min(self.times, initial=np.inf)))

    def components(self) -> list[Component]:
        """x, y and an estimated z, m, or azimuth and elevation, °; a direction in an array's plane is one angle."""
        names = ANGLES if self.angles else AXES
        values, errors, sigmas = (self.columns(*(kind + name for name in names)) for kind in ("", "error_", "std_"))
        sigmas[sigmas == 0] = np.nan
        if not self.angles:
            errors[np.isnan(sigmas[:, 2]), 2] = np.nan
            count = 2 + bool(np.isfinite(sigmas[:, 2]).any())
            return [Component("xyz"[k], "m", values[:, k], errors[:, k], sigmas[:, k]) for k in range(count)]
        words, known = ["azimuth", "elevation"], values[np.isfinite(values[:, 0]), 0]
        # In the plane of a flat array each azimuth is ± 90°.
        if len(known) and in_plane(known).all():
            shown, true = (np.arctan2(np.sin(b), np.sin(a) * np.cos(b)) for a, b in (values.T, (values - errors).T))
            values, errors, sigmas = shown[:, None], wrapped(shown - true)[:, None], sigmas[:, 1:]
            words = ["in-plane angle"]
        parts = (np.degrees(part).T for part in (values, errors, sigmas))
        return [Component(name, "°", *of) for name, *of in zip(words, *parts, strict=True)]

    def rows_of(self, track: int) -> slice:
        """The rows of a track by its number."""
        return slice(*map(int, self.starts[track : track + 2]))

    @cached_property
    def rmse(self) -> np.ndarray:
        """The RMSE of each track (g,), horizontal in m or of the direction in rad; NaN without truth."""
        return rmse_by(self.rows, "track")

    def worst_first(self) -> list[int]:
        """The numbers of the tracks from the largest RMSE to the smallest, those without truth last."""
        return np.argsort(-np.nan_to_num(self.rmse, nan=-1.0), kind="stable").tolist()


@dataclass(frozen=True)
class ScoredTracks:
    """The `scored_rows` of all recordings; `batches`: their trajectories with the trackers."""

    rows: pl.DataFrame
    folders: Sequence[RecordingFolder]
    batches: Sequence[TrackerBatch]

    @cached_property
    def drawn(self) -> list[int]:
        """The numbers of the recordings with figures: all, or the worst, the median and the best."""
        names = self.rows["recording"].unique(maintain_order=True)
        rmse = dict(zip(names, rmse_by(self.rows, "recording"), strict=True))
        return drawn_of(np.array([rmse.get(of.name, np.nan) for of in self.folders]))

    @cached_property
    def recordings(self) -> list[ScoredRecording]:
        """Each recording with its rows."""
        made = []
        for folder in self.folders:
            own = (one.tracker for one in self.batches if any(part.folder is folder for part in one.trajectories))
            rows = self.rows.filter(pl.col("recording") == folder.name)
            try:
                tracker = next(own, None)
                nu = math.nan if tracker is None else student_t_dof_of(tracker.nis_sensors)
            except ValueError:
                nu = math.nan
            made.append(ScoredRecording(folder, rows, None if nu is None else float(np.asarray(nu))))
        return made


def rmse_by(rows: pl.DataFrame, key: str) -> np.ndarray:
    """The RMSE of each group of rows, horizontal in m or of the direction in rad; NaN without truth."""
    rmse = (pl.col(main_size(rows)) ** 2).mean().sqrt()
    return float_column(rows.group_by(key, maintain_order=True).agg(rmse=rmse), "rmse")


def scored_tracks(estimates: AnyEstimates, recording: AnyRecording, truth: bool = False) -> ScoredTracks:
    """The estimates of one recording, in arrays too, with their errors; `truth`: refused where it has none."""
    table = estimates.to_polars()
    if truth or truths_of(recording):
        rows = rows_of(estimates, recording)
    else:
        rows = scored_rows(table if "tag" in table.columns else table.with_columns(tag=pl.lit("")), {})
    # A recording in arrays has no installation and no tables of readings.
    none = RecordingFolder(recording.name, None, Rig(recording.name), {})
    folder = recording if isinstance(recording, RecordingFolder) else none
    return ScoredTracks(rows, [folder], estimates.batches if isinstance(estimates, Tracks) else ())


def drawn_of(rmse: np.ndarray, most: int = DRAWN) -> list[int]:
    """The numbers of the recordings or tracks that are drawn, by their RMSE (n,).

    All of few; of more than `most` the worst, the median and the best, or the first where fewer than three have a RMSE.
    """
    ranked = [k for k in np.argsort(-np.nan_to_num(rmse, nan=-1.0), kind="stable").tolist() if np.isfinite(rmse[k])]
    if len(rmse) <= most or len(ranked) < 3:
        return list(range(min(len(rmse), most)))
    return [ranked[0], ranked[(len(ranked) - 1) // 2], ranked[-1]]
