"""Folds over the real recordings: which are judged, by which tracker, what each saw, their figures and their limits.

A fold is judged on recordings that its calibration and its tuning have not seen. Where no earlier run of the site
exists, each half of a recording is judged with the calibration of the other half (`OTHER_HALF`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Final, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.lab.subprocesses import required_recordings
from trackwright.trackers.catalogue import build
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.tuning.calibrating import by_halves, by_others, calibrate
from trackwright.tuning.fitting import FitOptions, fit

WALKS = tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3))

SEEN_BY_DEFAULTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "bearings": WALKS,
        "uwb": (
            "starloc-fast-s1",
            "starloc-2d-s5",
            "rcv-drone-3",
            "iasl-drone-1",
            "lias-planar-fast",
            "labyrinth",
            "ngbui-line-1-1",
            "ngbui-line-2-1",
        ),
        "uwb-imu": ("starloc-fast-s1", "iasl-drone-1"),
        "fix-mirror": ("tiers-1tag-01",),
    }
)
"""The recordings on which the default noise levels of a tracker were set."""

OTHER_HALF: Final = ("the other half",)
"""Calibrated on the other half, in time, of the judged recording."""

OTHERS: Final = ("the others",)
"""Calibrated on the other judged recordings of the fold."""


def recorded(names: Sequence[str]) -> list[RecordingFolder]:
    """These recordings of the folder TRACKWRIGHT_RECORDINGS; raises UnusableInput without it."""
    root = required_recordings()
    return read_recordings([root / name for name in names])


class Honest(NamedTuple):
    """Limits, lowest and highest, of the share of the truth inside the 95 % ellipse and of NEES/dof."""

    inside: tuple[float, float]
    nees: tuple[float, float]

    def __str__(self) -> str:
        (least, most), (low, high) = self
        return f"inside 95 %: {100 * least:.0f} to {100 * most:.0f} %, NEES/dof {low:g} to {high:g}"


BY_DEFAULTS = Honest((0.85, 0.99), (0.5, 2.0))
CALIBRATED = Honest((0.90, 0.98), (0.7, 1.5))


class Fold(NamedTuple):
    """Recordings judged by one tracker, and the limits of their errors, m.

    `rmse`, `smoothed`, `spatial`: highest horizontal RMSE of the filter and of the smoother, and 3-D RMSE of the
    filter, means over the recordings; None for no limit. `honest`: limits of each recording, filtered and smoothed.
    `calibrated_on`: recordings, `OTHER_HALF` or `OTHERS`. `tuned_on`, `tuned`: recordings and tunables of a fit of the
    3-D RMSE. `smoothes`: whether the tracker has a smoother. `quick`: part of the run of two minutes.
    """

    name: str
    tracker: str
    judged: tuple[str, ...]
    honest: Honest | None = BY_DEFAULTS
    rmse: float | None = None
    smoothed: float | None = None
    spatial: float | None = None
    calibrated_on: tuple[str, ...] = ()
    tuned_on: tuple[str, ...] = ()
    tuned: tuple[str, ...] = ()
    smoothes: bool = True
    free_height: bool = False
    quick: bool = False

    @property
    def limits(self) -> tuple[tuple[str, str, bool, float | None], ...]:
        """Name, metric, whether smoothed, and highest mean of each error."""
        horizontal = ("RMSE", "rmse_m", False, self.rmse), ("RMSE", "rmse_m", True, self.smoothed)
        return *horizontal, ("3-D RMSE", "rmse_3d_m", False, self.spatial)


SECOND_RUNS = tuple(f"ble51-walk-u{k}-r2" for k in (1, 2, 3))
STILL = ("lias-still-p1-0", "lias-still-p3-180", "lias-still-p5-0")
FLIGHTS = ("tiers-2tag-01", "tiers-2tag-03", "tiers-2tag-06")

# fmt: off
FOLDS = (
    # Bearings of Bluetooth arrays, height known.
    Fold("walks", "bearings", SECOND_RUNS, rmse=0.80, quick=True),
    Fold("walks, calibrated", "bearings", SECOND_RUNS, CALIBRATED, 0.50, 0.40, calibrated_on=WALKS, quick=True),
    Fold("walks, use case left out", "bearings", WALKS, None, calibrated_on=OTHERS),
    Fold("walks, height unknown", "bearings", SECOND_RUNS, None, calibrated_on=WALKS, free_height=True),
    # Ranges.
    Fold("starloc-fast", "uwb", ("starloc-fast-s1",), rmse=0.20),
    Fold("starloc-fast, calibrated", "uwb", ("starloc-fast-s1",), CALIBRATED, 0.15, spatial=0.26,
         calibrated_on=OTHER_HALF),
    Fold("starloc-fast with IMU", "uwb-imu", ("starloc-fast-s1",)),
    Fold("starloc-2d", "uwb", ("starloc-2d-s5",)),
    Fold("starloc-2d, calibrated", "uwb", ("starloc-2d-s5",), CALIBRATED, calibrated_on=OTHER_HALF),
    Fold("lias trolley", "uwb", ("lias-planar-fast",), rmse=0.08),
    Fold("lias trolley, calibrated", "uwb", ("lias-planar-fast",), CALIBRATED, 0.06, calibrated_on=STILL),
    Fold("rcv drone", "uwb", ("rcv-drone-3",), rmse=0.22, quick=True),
    Fold("rcv drone, calibrated", "uwb", ("rcv-drone-3",), CALIBRATED, 0.20, spatial=0.90, calibrated_on=OTHER_HALF,
         quick=True),
    Fold("iasl drone", "uwb", ("iasl-drone-1",), rmse=0.06),
    Fold("iasl drone, calibrated", "uwb", ("iasl-drone-1",), CALIBRATED, 0.05, spatial=0.11, calibrated_on=OTHER_HALF),
    Fold("labyrinth", "uwb", ("labyrinth",)),
    # A straight path behind walls, which this tracker is not given.
    Fold("ngbui lines without the path", "uwb", ("ngbui-line-2-1", "ngbui-line-3-1"), None),
    # Ranges along a known path; the limits are the errors of earlier versions.
    Fold("ngbui line 1", "line-grid", ("ngbui-line-1-1",), rmse=0.032, smoothes=False),
    Fold("ngbui line 2", "line-grid", ("ngbui-line-2-1",), rmse=0.062, smoothes=False),
    Fold("ngbui line 3", "line-grid", ("ngbui-line-3-1",), rmse=0.442, smoothes=False),
    # Late fixes of drones, which may be mirrored in the anchors' plane; the limit is the mean of earlier versions.
    Fold("tiers drones", "fix-mirror", FLIGHTS, rmse=0.074, tuned_on=("tiers-1tag-01",), tuned=("*latency*",)),
)
# fmt: on
"""Every fold, the limits of default noise levels before those of a calibrated site."""


class Site(NamedTuple):
    """The recordings of one installation, and the tracker whose noise levels are fitted to them."""

    name: str
    tracker: str
    recordings: tuple[str, ...]


SITES = (
    Site("rcv", "uwb", ("rcv-drone-3", "rcv-drone-6")),
    Site("isas", "uwb", ("isas-walk-1",)),
    Site("starloc-2d", "uwb", ("starloc-2d-s5",)),
    Site("tiers", "fix-mirror", ("tiers-1tag-01", *FLIGHTS)),
    Site("starloc-fast", "uwb", ("starloc-fast-s1",)),
    Site("iasl", "uwb", ("iasl-drone-1", "iasl-drone-2")),
    Site("labyrinth", "uwb", ("labyrinth",)),
    Site("walks", "bearings", (*WALKS, *SECOND_RUNS)),
    Site("lias", "uwb", ("lias-planar-fast", *STILL)),
    *(Site(f"ngbui line {k}", "line-grid", (f"ngbui-line-{k}-1", f"ngbui-line-{k}-2")) for k in (1, 2, 3)),
)
"""The sites of the recordings, for fits with one recording left out each."""

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


def run_fold(fold: Fold) -> Iterator[Figures]:
    """The figures of every judged recording of a fold."""
    folders, values = recorded(fold.judged), _tuned(fold)
    for folder in folders:
        parts = _calibrated(fold, folder, folders)
        plain = build(fold.tracker, parts, fold.free_height).with_values(values, "the fit")
        for smoothed in (False, True) if fold.smoothes else (False,):
            tracker = plain.smoothing() if smoothed else plain
            estimates = tracker.run(parts)
            metrics = evaluate(estimates, parts).overall
            outside = farthest_outside(estimates.to_polars(), room(folder))
            yield Figures(fold, folder.name, smoothed, metrics, outside)


def _tuned(fold: Fold) -> dict[str, Any]:
    """The values that the fold tunes on its own recordings."""
    if not fold.tuned_on:
        return {}
    folders = recorded(fold.tuned_on)
    result = fit(build(fold.tracker, folders), folders, "rmse", fold.tuned, FitOptions(dimensions=3))
    return dict(result.tracker.values)


def _calibrated(fold: Fold, folder: RecordingFolder, folders: list[RecordingFolder]) -> list[RecordingFolder]:
    """The recording with the calibration of its fold; its halves where each is calibrated on the other."""
    if fold.calibrated_on == OTHER_HALF:
        return by_halves(folder)
    if fold.calibrated_on == OTHERS:
        return [by_others(folder, folders)]
    if fold.calibrated_on:
        return [folder.calibrated(calibrate(recorded(fold.calibrated_on)))]
    return [folder]


def room(folder: RecordingFolder) -> np.ndarray:
    """The lowest and the highest corner (2, 2), m, of the box around anchors, stations and truth in x and y."""
    rig, places = folder.rig, [_positions(folder.tables["truth"])] if "truth" in folder.tables else []
    places += [np.asarray(place, float)[None, :2] for place in rig.anchors.values()]
    places += [np.asarray(station.position, float)[None, :2] for station in rig.stations.values()]
    points = np.concatenate(places)
    return np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)])


def farthest_outside(estimates: pl.DataFrame, corners: np.ndarray) -> Outside:
    """The estimate that is farthest from the box, at distance 0 where all are inside; rows without one are left out."""
    positions = _positions(estimates)
    low, high = corners
    distances = np.nan_to_num(np.hypot(*np.maximum(np.maximum(low - positions, positions - high), 0.0).T))
    row = int(np.argmax(distances))
    sigma = max(float_column(estimates, f"std_{axis}_m")[row] for axis in "xy")
    time = float_column(estimates, "t_s")[row]
    return Outside(float(distances[row]), float(sigma), float(time), int(np.sum(distances > MARGIN)))


def _positions(table: pl.DataFrame) -> np.ndarray:
    return np.stack([float_column(table, f"{axis}_m") for axis in "xy"], axis=1)


def checks(fold: Fold, figures: Sequence[Figures]) -> list[Check]:
    """The limits of a fold: of mean errors, and of the covariances of each recording, filtered and smoothed."""
    of_means = []
    for what, metric, smoothed, limit in fold.limits:
        if limit is not None:
            mean = mean_of(figures, metric, smoothed)
            of_means.append(Check(fold.name, what, round(mean, 3), 0.0, limit, smoothed=smoothed))
    return of_means + [check for one in figures for check in covariance_checks(one)]


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
