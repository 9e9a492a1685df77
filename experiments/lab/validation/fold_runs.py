"""The figures of a fold: calibration, tuning, tracks and their evaluation in this process, and the fold's limits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from experiments.lab.validation.folds import OTHER_HALF, OTHERS, Fold
from experiments.lab.validation.rooms import Outside, farthest_outside, room
from trackers.catalogue import build
from trackers.evaluation.evaluate import evaluate
from trackers.recordings.folder import RecordingFolder, read_recording
from tuning.calibrating import calibrate
from tuning.cross_calibration import by_halves, by_others
from tuning.fitting import fit


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


def checks(fold: Fold, figures: Sequence[Figures]) -> list[Check]:
    """The limits of a fold: of mean errors, and of the covariances of each recording, filtered and smoothed."""
    found = []
    for what, limit, metric, smoothed in (
        ("RMSE", fold.rmse, "rmse_m", False),
        ("RMSE", fold.smoothed, "rmse_m", True),
        ("3-D RMSE", fold.spatial, "rmse_3d_m", False),
    ):
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
