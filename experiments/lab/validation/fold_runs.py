"""The figures of a fold: calibration, tuning, tracks and how far they leave the room, metrics and their limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.lab.validation.folds import OTHER_HALF, OTHERS, Fold
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder, read_recording
from trackwright.tuning.calibrating import calibrate
from trackwright.tuning.cross_calibration import by_halves, by_others
from trackwright.tuning.fitting import fit

MARGIN = 1.0
"""Largest distance, m, of an estimate outside its room."""


class Outside(NamedTuple):
    """The estimate farthest from its room: distance and larger reported standard deviation, m, and time, s.

    `rows`: how many estimates are more than `MARGIN` outside.
    """

    distance: float
    sigma: float
    time: float
    rows: int


class Figures(NamedTuple):
    """The metrics of one judged recording, filtered or smoothed, and its estimate farthest outside the room."""

    fold: Fold
    recording: str
    smoothed: bool
    metrics: dict[str, Any]
    outside: Outside


class Check(NamedTuple):
    """A figure of a fold, rounded as the page shows it, and its limits. `recording`: empty for a mean over several."""

    fold: str
    what: str
    figure: float
    lowest: float
    highest: float
    recording: str = ""
    smoothed: bool = False

    @property
    def met(self) -> bool:
        """Whether the figure is within its limits."""
        return self.lowest <= self.figure <= self.highest

    def __str__(self) -> str:
        limits = f"≤ {self.highest:g}" if self.lowest == 0.0 else f"{self.lowest:g} to {self.highest:g}"
        whose = f" of {self.recording}" if self.recording else ""
        return (
            f"{self.fold}: {self.what}{whose}{', smoothed,' if self.smoothed else ''} {self.figure:g}, limit {limits}"
        )


def run_fold(fold: Fold, root: Path) -> Iterator[Figures]:
    """The figures of every judged recording of a fold; `root`: the folder of the recordings."""
    folders = [read_recording(root / name) for name in fold.judged]
    values = _tuned(fold, root)
    for folder in folders:
        parts = _calibrated(fold, folder, folders, root)
        plain = build(fold.tracker, parts, fold.free_height).with_values(values, "the fit")
        for smoothed in (False, True) if fold.smoothes else (False,):
            tracker = plain.smoothing() if smoothed else plain
            estimates = tracker.run(parts)
            metrics = evaluate(estimates, parts).overall
            outside = farthest_outside(estimates.to_polars(), room(folder))
            yield Figures(fold, folder.name, smoothed, metrics, outside)


def _tuned(fold: Fold, root: Path) -> dict[str, Any]:
    """The values that the fold tunes on its own recordings."""
    if not fold.tuned_on:
        return {}
    folders = [read_recording(root / name) for name in fold.tuned_on]
    result = fit(build(fold.tracker, folders), folders, "rmse", tune=fold.tuned, dimensions=3)
    return dict(result.tracker.values)


def _calibrated(
    fold: Fold, folder: RecordingFolder, folders: list[RecordingFolder], root: Path
) -> list[RecordingFolder]:
    """The recording with the calibration of its fold; its halves where each is calibrated on the other."""
    if fold.calibrated_on == OTHER_HALF:
        return by_halves(folder)
    if fold.calibrated_on == OTHERS:
        return [by_others(folder, folders)]
    if fold.calibrated_on:
        return [folder.calibrated(calibrate([read_recording(root / name) for name in fold.calibrated_on]))]
    return [folder]


def room(folder: RecordingFolder) -> np.ndarray:
    """The lowest and the highest corner (2, 2), m, of the box around anchors, stations and truth in x and y."""
    rig, places = folder.rig, [_positions(folder.tables["truth"])] if "truth" in folder.tables else []
    places += [np.asarray(place, float)[None, :2] for place in rig.anchors.values()]
    places += [np.asarray(station.position, float)[None, :2] for station in rig.stations.values()]
    every = np.concatenate(places)
    return np.stack([np.nanmin(every, axis=0), np.nanmax(every, axis=0)])


def farthest_outside(estimates: pl.DataFrame, corners: np.ndarray) -> Outside:
    """The estimate that is farthest from the box, at distance 0 where all are inside; rows without one are left out."""
    found = _positions(estimates)
    low, high = corners
    distances = np.nan_to_num(np.hypot(*np.maximum(np.maximum(low - found, found - high), 0.0).T))
    row = int(np.argmax(distances))
    sigma = max(float_column(estimates, f"std_{axis}_m")[row] for axis in "xy")
    time = float_column(estimates, "t_s")[row]
    return Outside(float(distances[row]), float(sigma), float(time), int(np.sum(distances > MARGIN)))


def _positions(table: pl.DataFrame) -> np.ndarray:
    return np.stack([float_column(table, f"{axis}_m") for axis in "xy"], axis=1)


def checks(fold: Fold, figures: Sequence[Figures]) -> list[Check]:
    """The limits of a fold: of mean errors, and of the covariances of each recording, filtered and smoothed."""
    found = []
    for what, metric, smoothed, limit in fold.limits:
        if limit is not None:
            mean = mean_of(figures, metric, smoothed)
            found.append(Check(fold.name, what, round(mean, 3), 0.0, limit, smoothed=smoothed))
    return found + [check for one in figures for check in covariance_checks(one)]


def mean_of(figures: Sequence[Figures], metric: str, smoothed: bool) -> float:
    """The mean of a metric over the recordings of a fold, filtered or smoothed; NaN without any."""
    values = [one.metrics[metric] for one in figures if one.smoothed == smoothed]
    return float(np.mean(values)) if values else float("nan")


def covariance_checks(one: Figures) -> list[Check]:
    """The limits of the covariances of a recording; none where the fold has none or no covariance is reported."""
    inside, nees, honest = one.metrics["coverage_95"], one.metrics["nees_ratio"], one.fold.honest
    if honest is None or inside is None:
        return []
    whose = (one.recording, one.smoothed)
    return [
        Check(one.fold.name, "share inside 95 %", round(inside, 3), *honest.inside, *whose),
        Check(one.fold.name, "NEES/dof", round(nees, 2), *honest.nees, *whose),
    ]
