"""Sites of real recordings, how each recording of a site is judged, and its limits.

A recording is judged with the tracker's default noise levels, where its site has set them with those found on other
sites, and calibrated on the other recordings of its site that have the same installation. Where there is no other one,
each half of it, in time, is calibrated on the other half: these figures are shown and not counted, since what changes
between days does not show in them.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from trackwright.experiments.lab.subprocesses import flights_folder, required_recordings
from trackwright.trackers.catalogue import build
from trackwright.trackers.core.errors import UnusableInput
from trackwright.trackers.evaluation.evaluate import evaluate
from trackwright.trackers.recordings.calibration import has_moved, has_turned
from trackwright.trackers.recordings.columns import float_column
from trackwright.trackers.recordings.folder import RecordingFolder, read_recordings
from trackwright.trackers.recordings.named_tracker import NamedTracker
from trackwright.tuning.calibrating import by_halves, calibrate
from trackwright.tuning.fitting import FitOptions, fit

WALKS = tuple(f"ble51-walk-u{k}-r1" for k in (1, 2, 3))

RANGES_SEEN = (
    "starloc-fast-s1",
    "starloc-2d-s5",
    "rcv-drone-3",
    "iasl-drone-1",
    "lias-planar-fast",
    "labyrinth",
    "ngbui-line-1-1",
    "ngbui-line-2-1",
)

SEEN_BY_DEFAULTS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "bearings": WALKS,
        "uwb": RANGES_SEEN,
        "body": RANGES_SEEN,
        "fusion": (*RANGES_SEEN, *WALKS),
        "uwb-imu": ("starloc-fast-s1", "iasl-drone-1"),
        "fix-mirror": ("tiers-1tag-01",),
        "tdoa": ("util-c1-t1-tdoa2", "util-c1-t1-tdoa3", "util-c4-t5-tdoa2"),
    }
)
"""The recordings on which the default noise levels of a tracker were set."""

OTHER_HALF = ("the other half",)
"""What a recording without others of its installation is calibrated on."""

OTHER_SITES = ("other sites",)
"""What the levels of a recording are found on whose site has set the default ones."""

LEAST_WAY = 1.0
"""Least way, m, of a recording that is judged: errors at one place are one sample, of which no share is inside."""


class Honest(NamedTuple):
    """Limits, lowest and highest, of the share of the truth inside the 95 % ellipse and of NEES/dof."""

    inside: tuple[float, float]
    nees: tuple[float, float]

    def __str__(self) -> str:
        (least, most), (low, high) = self
        return f"inside 95 %: {100 * least:.0f} to {100 * most:.0f} %, NEES/dof {low:g} to {high:g}"

    def holds(self, metrics: Mapping[str, Any]) -> bool | None:
        """Whether the covariances of a recording, as they are shown, are within these limits; None without any."""
        if metrics["coverage_95"] is None:
            return None
        (least, most), (low, high) = self
        return least <= round(metrics["coverage_95"], 3) <= most and low <= round(metrics["nees_ratio"], 2) <= high


class Setting(NamedTuple):
    """How recordings are judged. `goal`: least share of those whose covariances are within limits."""

    name: str
    honest: Honest
    goal: float


DEFAULTS = Setting("defaults", Honest((0.85, 0.99), (0.5, 2.0)), 0.80)
CALIBRATED = Setting("calibrated", Honest((0.90, 0.98), (0.7, 1.5)), 0.85)
SMOOTHED_GOAL = 0.80
"""As `Setting.goal`, of smoothed estimates in either setting."""


class Errors(NamedTuple):
    """Highest horizontal and 3-D RMSE of each recording, m, filtered and smoothed; None for no limit."""

    filtered: float | None = None
    spatial: float | None = None
    smoothed: float | None = None


class Site(NamedTuple):
    """The recordings whose names match `pattern`, their tracker, and limits of errors.

    `mean`: whether the limits are of the mean over the recordings. `tuned`: tunables fitted on the other recordings
    besides the calibration, by the 3-D RMSE. `levels`: whether the tracker runs at several levels of motion. `quick`:
    part of the run of two minutes.
    """

    name: str
    tracker: str
    pattern: str
    defaults: Errors = Errors()
    calibrated: Errors = Errors()
    mean: bool = False
    tuned: tuple[str, ...] = ()
    levels: bool = False
    quick: bool = False


# fmt: off
SITES = (
    Site("walks", "bearings", "ble51-walk-*", Errors(0.75), Errors(0.42, smoothed=0.30), mean=True, quick=True),
    Site("starloc-fast", "uwb", "starloc-fast-*", Errors(0.15), Errors(0.13)),
    Site("starloc-fast with IMU", "uwb-imu", "starloc-fast-*"),
    Site("starloc-2d", "uwb", "starloc-2d-*"),
    Site("lias", "uwb", "lias-*", Errors(0.075), Errors(0.05)),
    Site("rcv", "uwb", "rcv-drone-*", Errors(0.20), Errors(0.17), quick=True),
    Site("iasl", "uwb", "iasl-drone-*", Errors(0.055, 0.14), Errors(0.045, 0.10)),
    Site("isas", "uwb", "isas-walk-*", Errors(0.14), Errors(0.11)),
    Site("labyrinth", "uwb", "labyrinth*"),
    # A straight path: in the line of sight, behind a wall, and obstructed, without the path and along it.
    Site("ngbui line 1", "uwb", "ngbui-line-1-*", Errors(0.055), Errors(0.045)),
    Site("ngbui line 2", "uwb", "ngbui-line-2-*", Errors(0.42), Errors(0.30)),
    Site("ngbui line 3", "uwb", "ngbui-line-3-*", Errors(0.40), Errors(0.25)),
    Site("ngbui line 1, motion auto", "uwb", "ngbui-line-1-*", levels=True),
    Site("ngbui line 2, motion auto", "uwb", "ngbui-line-2-*", levels=True),
    Site("ngbui line 3, motion auto", "uwb", "ngbui-line-3-*", levels=True),
    Site("ngbui line 1, path known", "line-grid", "ngbui-line-1-*"),
    Site("ngbui line 2, path known", "line-grid", "ngbui-line-2-*"),
    Site("ngbui line 3, path known", "line-grid", "ngbui-line-3-*"),
    # Range differences of a quadrotor; limits: errors of an EKF tuned on the flight, in the clear room the larger.
    Site("util", "tdoa", "util-c1-*", Errors(0.047, 0.107)),
    Site("util, cluttered", "tdoa", "util-c4-*", Errors(0.152, 0.404)),
    # Late fixes of drones, which may be mirrored in the anchors' plane.
    Site("tiers", "fix-mirror", "tiers-*", tuned=("*latency*",)),
)
# fmt: on
"""Every site; the recordings of one need not have one installation."""

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


class Judged(NamedTuple):
    """The metrics of one recording in one setting, filtered or smoothed, and its estimate farthest outside the room.

    `on`: the recordings that it was calibrated or tuned on; none with default levels. `counted`: whether the
    covariances count: not where half of a recording is calibrated on the other, nor where its site has set the default
    levels, nor at several levels of motion, beside which it counts at the given one.
    """

    site: Site
    setting: Setting
    recording: str
    smoothed: bool
    metrics: Mapping[str, Any]
    outside: Outside
    on: tuple[str, ...] = ()
    counted: bool = True

    @property
    def holds(self) -> bool | None:
        """Whether the covariances are within the limits of the setting; None where none is reported."""
        return self.setting.honest.holds(self.metrics)


def site_of(tracker: str, name: str) -> str:
    """What is left out with a recording where levels of this tracker are found on others: what its name begins with.

    One building and one make of tags, but one use case of the walks, all of whose bearings are of one building.
    """
    return "-".join(name.split("-")[: 3 if tracker == "bearings" else 1])


def left_out_file(tracker: str) -> Path:
    """Where the levels of a tracker are that are found without a site, by site and keyword."""
    return Path(__file__).with_name("fitted") / f"{tracker}.toml"


def left_out_levels(tracker: str, recording: str) -> dict[str, Any]:
    """The levels of a tracker found without the site of a recording; none where that has not set the default ones."""
    file = left_out_file(tracker)
    found = tomllib.loads(file.read_text("utf-8")) if file.is_file() else {}
    return dict(found.get(site_of(tracker, recording), {}))


def at_levels(named: NamedTracker, values: Mapping[str, Any]) -> NamedTracker:
    """The tracker at levels by keyword of its builder, which sensors may have for each anchor."""
    nodes = {name: (name.rpartition(".")[2], node.value) for name, node in named.tunables.items()}
    return named.with_values(
        {name: np.full(np.shape(now), values[word]) for name, (word, now) in nodes.items() if word in values}
    )


def recorded(pattern: str | Sequence[str]) -> list[RecordingFolder]:
    """The recordings of the folder TRACKWRIGHT_RECORDINGS, and flights, that match a pattern, or of these names.

    Raises UnusableInput without the folder.
    """
    root, flights = required_recordings(), flights_folder()
    if isinstance(pattern, str):
        files = [file for folder in (root, flights) if folder is not None for file in folder.glob("*/rig.toml")]
        paths = sorted(file.parent for file in files if fnmatch(file.parent.name, pattern))
    else:
        paths = [root / name for name in pattern]
    return read_recordings(paths) if paths else []


def judged(site: Site) -> Iterator[Judged]:
    """Every recording of a site in both settings, filtered and, where the tracker has a smoother, smoothed."""
    folders = recorded(site.pattern)
    seen = {site_of(site.tracker, name) for name in SEEN_BY_DEFAULTS.get(site.tracker, ())}
    for folder in filter(moves, folders):
        others = [other for other in folders if other is not folder and same_installation(folder, other)]
        as_it_is = [folder]
        named = build(site.tracker, folder)
        yield from _runs(
            site, DEFAULTS, folder, named, as_it_is, counted=site_of(site.tracker, folder.name) not in seen
        )
        if not site.levels and (levels := left_out_levels(site.tracker, folder.name)):
            yield from _runs(site, DEFAULTS, folder, at_levels(named, levels), as_it_is, OTHER_SITES)
        on = tuple(other.name for other in others)
        if site.tuned and others:
            tuned = named.with_values(_tuned(site, others), "the fit")
            yield from _runs(site, CALIBRATED, folder, tuned, as_it_is, on)
        elif others:
            parts = [folder.calibrated(calibrate(others))]
            yield from _runs(site, CALIBRATED, folder, build(site.tracker, parts), parts, on)
        elif not site.tuned:
            parts = by_halves(folder)
            yield from _runs(site, CALIBRATED, folder, build(site.tracker, parts), parts, OTHER_HALF, counted=False)


def _runs(
    site: Site,
    setting: Setting,
    folder: RecordingFolder,
    tracker: NamedTracker,
    parts: list[RecordingFolder],
    on: tuple[str, ...] = (),
    counted: bool = True,
) -> Iterator[Judged]:
    """The recording, as it is or calibrated in `parts`, filtered and smoothed."""
    kinds = [tracker]
    with suppress(UnusableInput):  # Grids and particles have no smoother.
        kinds.append(tracker.smoothing())
    for kind in kinds:
        estimates = (kind.with_motion_levels() if site.levels else kind).run(parts)
        metrics = evaluate(estimates, parts).overall
        outside = farthest_outside(estimates.to_polars(), room(folder))
        yield Judged(site, setting, folder.name, kind.smoothed, metrics, outside, on, counted and not site.levels)


def _tuned(site: Site, folders: list[RecordingFolder]) -> dict[str, Any]:
    """The values of the site's tunables, fitted to these recordings."""
    result = fit(build(site.tracker, folders), folders, "rmse", site.tuned, FitOptions(dimensions=3))
    return dict(result.tracker.values)


def same_installation(a: RecordingFolder, b: RecordingFolder) -> bool:
    """Whether two recordings have stations or anchors in common, and those stand where they stood."""
    stations = [name for name in a.rig.stations if name in b.rig.stations]
    anchors = [name for name in a.rig.anchors if name in b.rig.anchors]
    moved = any(has_turned(a.rig.stations[name], b.rig.stations[name]) for name in stations)
    moved |= any(has_moved(a.rig.anchors[name], b.rig.anchors[name]) for name in anchors)
    return bool(stations or anchors) and not moved


def moves(folder: RecordingFolder) -> bool:
    """Whether a tag covers `LEAST_WAY` between the farthest true positions, along x or y."""
    places = _positions(folder.tables["truth"])
    return bool(np.nanmax(np.nanmax(places, axis=0) - np.nanmin(places, axis=0)) >= LEAST_WAY)


def room(folder: RecordingFolder) -> np.ndarray:
    """The lowest and the highest corner (2, 2), m, of the box around anchors, stations and truth in x and y."""
    rig, places = folder.rig, [_positions(folder.tables["truth"])] if "truth" in folder.tables else []
    places += [np.asarray(place, float)[None, :2] for place in rig.anchors.values()]
    places += [np.asarray(station.position, float)[None, :2] for station in rig.stations.values()]
    every = np.concatenate(places)
    return np.stack([np.nanmin(every, axis=0), np.nanmax(every, axis=0)])


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
